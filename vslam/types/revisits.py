"""Observations of frames at known places, which measure these places again.

At a known place, an old keyframe becomes the reference keyframe, and no keyframe is inserted. A
*revisit* keeps what the frame observed there. It is a camera of global bundle adjustment
(``backend/global_mapping.py``). In contrast to a keyframe, it has only the features that observe
landmarks, and no descriptors. It is neither tracked nor searched for loops.

There are at most four revisits for each keyframe. The map therefore stays small, however often the
camera returns.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vslam.types.geometry import Matrix, orthonormalised
from vslam.types.loops import ranges

MAX_REVISITS = 4  # of a keyframe; a revisit takes about a twentieth of the memory of a keyframe


@dataclass(frozen=True)
class Revisits:
    """V revisits with O observations, in the order in which they were added.

    Attributes:
        keyframe: ``(V,)`` int64, the old keyframe that became the reference keyframe.
        T_c_keyframe: ``(V, 4, 4)`` float64, maps points from the camera of this keyframe to the
            camera of the frame.
        first: ``(V + 1,)`` int64. Revisit v has the observations ``first[v]:first[v + 1]``.
        landmark: ``(O,)`` int32, the observed landmark, or -1 if it was culled.
        uvr: ``(O, 3)`` float32 u, v, u_right in pixels. u_right is NaN without a stereo match.
        octave: ``(O,)`` uint8 pyramid level.
        certainty: ``(O,)`` uint8, see ``Arrays.certainty``.
    """

    keyframe: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    T_c_keyframe: Matrix = field(default_factory=lambda: np.zeros((0, 4, 4)))
    first: NDArray[np.int64] = field(default_factory=lambda: np.zeros(1, np.int64))
    landmark: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    uvr: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    octave: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    certainty: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))

    def __len__(self) -> int:
        return len(self.keyframe)

    def followed_by(self, other: Revisits, keyframes: int = 0, landmarks: int = 0) -> Revisits:
        """Append other revisits.

        Args:
            keyframes, landmarks: numbers that are added to the ids of ``other``.
        """
        shifted = np.where(other.landmark >= 0, other.landmark + landmarks, -1).astype(np.int32)
        return Revisits(
            np.concatenate([self.keyframe, other.keyframe + keyframes]),
            np.concatenate([self.T_c_keyframe, other.T_c_keyframe]),
            np.concatenate([self.first, self.first[-1] + other.first[1:]]),
            np.concatenate([self.landmark, shifted]),
            np.concatenate([self.uvr, other.uvr]),
            np.concatenate([self.octave, other.octave]),
            np.concatenate([self.certainty, other.certainty]),
        )

    def select(self, revisits: NDArray[np.integer]) -> Revisits:
        """Return the revisits with the given ``(M,)`` indices."""
        count = np.diff(self.first)[revisits]
        rows = ranges(self.first[:-1][revisits], count)
        return Revisits(
            self.keyframe[revisits],
            self.T_c_keyframe[revisits],
            np.concatenate([[0], np.cumsum(count)]).astype(np.int64),
            self.landmark[rows],
            self.uvr[rows],
            self.octave[rows],
            self.certainty[rows],
        )

    def observing(self, landmark: NDArray[np.int32]) -> Revisits:
        """Return the revisits with ``(O,)`` new landmarks.

        If a revisit then observes a landmark twice, because two landmarks were fused, only its
        first observation keeps the landmark.
        """
        revisit = np.repeat(np.arange(len(self)), np.diff(self.first))
        _, once = np.unique(np.stack([revisit, landmark]), axis=1, return_index=True)
        kept = np.full(len(landmark), -1, np.int32)
        kept[once] = landmark[once]
        return replace(self, landmark=kept)

    def scaled(self, growth: NDArray[np.float64]) -> Revisits:
        """Multiply the translation of each revisit by ``growth[keyframe]``."""
        T = self.T_c_keyframe.copy()
        T[:, :3, 3] *= growth[self.keyframe, None]
        return replace(self, T_c_keyframe=T)

    def moved(self, T_c_keyframe: Matrix) -> Revisits:
        """Replace the poses of the first N revisits by ``(N, 4, 4)`` new poses."""
        T = self.T_c_keyframe.copy()
        for revisit, new in enumerate(T_c_keyframe):
            T[revisit] = orthonormalised(new)
        return replace(self, T_c_keyframe=T)
