"""Finding a lost frame in the whole map (ORB-SLAM, T-RO 2015, V-C)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Image
from vslam.features import Features
from vslam.frontend.frame import Frame
from vslam.frontend.relocalization import relocalise
from vslam.frontend.tracking import TrackingContext
from vslam.geometry import Matrix
from vslam.loops import LoopCandidate
from vslam.map import Map
from vslam.map_view import local_map

Locate = Callable[[Image | None, Features, Map], list[LoopCandidate]]


class Sighting(Protocol):
    """Where a frame was recognised: near ``keyframe``, at ``T_cw``; feature ``feature[i]`` of the
    frame observes landmark ``landmark[i]``."""

    @property
    def keyframe(self) -> int: ...
    @property
    def T_cw(self) -> Matrix: ...
    @property
    def feature(self) -> NDArray[np.int64]: ...
    @property
    def landmark(self) -> NDArray[np.int32]: ...


class Recognise(Protocol):
    """Finds a frame at one of the candidates where ORB descriptors do not."""

    def __call__(
        self, map_: Map, image: Image | None, features: Features, candidates: list[LoopCandidate]
    ) -> Sighting | None: ...


class Relocaliser:
    """Looks for a frame at the places that resemble it."""

    def __init__(self, context: TrackingContext, locate: Locate, recognise: Recognise) -> None:
        """
        Args:
            locate: gives the keyframes that a frame resembles, best first.
            recognise: asked where ORB descriptors find the frame at none of them.
        """
        self._context = context
        self._locate = locate
        self._recognise = recognise

    def find(self, frame: Frame, map_: Map) -> tuple[int, int]:
        """Look for a frame in the whole map.

        Returns:
            Inliers, and the keyframe near which it was found; the frame has its pose and landmarks.
            0 and -1 if it was found nowhere; the frame is left as it may be.
        """
        config = self._context.config.relocalization
        candidates = self._locate(frame.image, frame.features, map_)
        for candidate in candidates[: config.max_candidates]:
            place = local_map(map_, candidate.match, 1)
            around = local_map(map_, candidate.match, config.neighbours)
            inliers = relocalise(frame, place, around, self._context, seed=candidate.match)
            if inliers:
                return inliers, candidate.match
        found = self._recognise(map_, frame.image, frame.features, candidates)
        if found is None:
            return 0, -1
        frame.T_cw = found.T_cw
        frame.landmark[found.feature] = found.landmark
        frame.shift = None
        frame.xyz[found.feature] = map_.arrays.xyz[found.landmark]
        return len(found.feature), found.keyframe

    def find_better(self, frame: Frame, map_: Map, n_inliers: int) -> tuple[int, int]:
        """Look for a frame that was tracked with so few inliers that it may be elsewhere. It stays
        as it is, and 0 and -1 are returned, unless there are clearly more inliers there."""
        before = frame.snapshot()
        inliers, keyframe = self.find(frame, map_)
        if inliers > self._context.config.relocalization.better * n_inliers:
            return inliers, keyframe
        frame.restore(before)
        return 0, -1
