"""Keeps the image patches that matches are aligned to, and weights aligned observations."""

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

    Frames without an image pyramid (those of an RGB-D camera, for example) are not aligned.
    """

    def __init__(self, config: AlignmentConfig) -> None:
        self._config = config
        self._recent = RecentPatches(config.keyframes)

    def remember(self, frame: Frame, keyframe: int, scales: NDArray[np.float64]) -> None:
        """Keep the patches around the features of a frame that became a keyframe, and forget the
        patches of the oldest keyframe.

        Args:
            keyframe: id of the new keyframe.
            scales: ``(levels,)`` full-resolution pixels per pixel of each octave.
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
        """``(N,)`` uint8, the factor by which the variance of each feature's position is smaller
        than that of a keypoint (``Arrays.certainty``); 1 for all features of a frame without a
        pyramid.

        An aligned match is certain. So is a feature without a match: the landmark that it creates
        is defined by this very position. A match that was not aligned is about half a pixel off.
        """
        if frame.pyramid is None:
            return 1
        unaligned = (frame.landmark >= 0) & ~frame.aligned
        return np.where(unaligned, 1, self._config.certainty).astype(np.uint8)

    def patches_of(self, map_: Map, ids: NDArray[np.int32]) -> LandmarkPatches:
        """The patches of ``(L,)`` landmarks with sorted ids, each from the newest keyframe that
        observes it; valid until ``remember`` is called."""
        return self._recent.of(map_, ids)

    def state(self) -> tuple[KeyframePatches, ...]:
        """The patches of all remembered keyframes, oldest first."""
        return self._recent.all()

    def restore(self, state: tuple[KeyframePatches, ...]) -> None:
        """Keep the patches that ``state`` returned."""
        for patches in state:
            self._recent.add(patches)
