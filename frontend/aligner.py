"""What alignment needs of the newest keyframes, and what it is worth to the map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.config import AlignmentConfig
from vslam.features import KeyframePatches, LandmarkPatches
from vslam.frontend.frame import Frame
from vslam.frontend.patches import RecentPatches, patches_around
from vslam.map import Map


class Aligner:
    """Keeps the image patches of the newest keyframes, to which later frames are aligned.

    Frames without an image pyramid, those of RGB-D cameras for example, are not aligned.
    """

    def __init__(self, config: AlignmentConfig) -> None:
        self._config = config
        self._recent = RecentPatches(config.keyframes)

    def remember(self, frame: Frame, keyframe: int, scales: NDArray[np.float64]) -> None:
        """Keep the patches around the features of a frame that became a keyframe, and forget those
        of the oldest one.

        Args:
            scales: ``(levels,)`` full-resolution pixels for a pixel of each octave.
        """
        features = frame.features
        if frame.pyramid is None:
            return
        shift = np.zeros((len(features), 2), np.float32)
        if frame.shift is not None:
            aligned = frame.aligned
            shift[aligned] = frame.shift[aligned] / scales[features.octave[aligned]][:, None]
        pixels = patches_around(frame.pyramid, features.xy, features.octave)
        self._recent.add(KeyframePatches(keyframe, pixels, shift))

    def certainty(self, frame: Frame) -> NDArray[np.uint8] | int:
        """``(N,)`` how many times smaller the variance of each feature's position is than that of
        a keypoint (``Arrays.certainty``).

        A landmark that is new with this frame is defined by where the frame saw it, so that this
        position has no error; a match that was not aligned is half a pixel off.
        """
        if frame.pyramid is None:
            return 1
        unaligned = (frame.landmark >= 0) & ~frame.aligned
        return np.where(unaligned, 1, self._config.certainty).astype(np.uint8)

    def patches_of(self, map_: Map, ids: NDArray[np.int32]) -> LandmarkPatches:
        """Those of ``(L,)`` sorted landmarks, as the newest keyframe saw each; valid until
        ``remember`` is called."""
        return self._recent.of(map_, ids)

    def state(self) -> tuple[KeyframePatches, ...]:
        """The patches of all keyframes that are kept, oldest first."""
        return self._recent.all()

    def restore(self, state: tuple[KeyframePatches, ...]) -> None:
        """Keep the patches that ``state`` gave."""
        for patches in state:
            self._recent.add(patches)
