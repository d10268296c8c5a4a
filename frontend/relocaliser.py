"""When a lost or doubtful frame is searched in the whole map, and at which places (ORB-SLAM, T-RO
2015, V-C)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from vslam.camera import Image
from vslam.features import Features, TrackingState
from vslam.frontend.frame import Frame
from vslam.frontend.relocalization import relocalise
from vslam.frontend.tracker import Found, judge
from vslam.frontend.tracking import TrackingContext
from vslam.loops import LoopCandidate, Sighting
from vslam.map import Map
from vslam.map_view import local_map

Locate = Callable[[Image | None, Features, Map], list[LoopCandidate]]


class Recognise(Protocol):
    """Finds a frame at one of the candidates after matching by ORB descriptors has failed."""

    def __call__(
        self, map_: Map, image: Image | None, features: Features, candidates: list[LoopCandidate]
    ) -> Sighting | None: ...


class MapAccess(Protocol):
    """Access to the map when it may be read."""

    @property
    def is_merged(self) -> bool:
        """Whether tracking sees everything that has been mapped, i.e. no keyframe is being
        mapped."""
        ...

    def merge(self) -> Map:
        """Wait for the keyframe that is being mapped, make it visible to tracking, and return the
        map."""
        ...


class Relocaliser:
    """Searches for a frame at the keyframes that it resembles."""

    def __init__(self, context: TrackingContext, locate: Locate, recognise: Recognise) -> None:
        """
        Args:
            locate: returns the keyframes that a frame resembles, best first.
            recognise: called if matching by ORB descriptors fails at all of them.
        """
        self._context = context
        self._locate = locate
        self._recognise = recognise

    def relocalise_if_needed(self, frame: Frame, found: Found, owner: MapAccess) -> Found:
        """Search the whole map for a frame that is lost or doubtful; returns ``found`` if it is
        neither, or if relocalisation fails.

        A lost frame is searched only while no keyframe is being mapped. A doubtful frame waits for
        the mapping, and keeps its tracked pose unless relocalisation finds
        ``relocalization.better`` times as many inliers.
        """
        if found.is_lost:
            return self._find(frame, owner.merge()) if owner.is_merged else found
        if not found.is_doubtful:
            return found
        map_ = owner.merge()  # worth the wait, because a doubtful frame will ask for a keyframe
        before = frame.snapshot()
        elsewhere = self._find(frame, map_)
        if elsewhere.n_inliers > self._context.config.relocalization.better * found.n_inliers:
            return elsewhere
        frame.restore(before)
        return found

    def _find(self, frame: Frame, map_: Map) -> Found:
        """Search for a frame at the candidates, first by ORB descriptors, then by ``recognise``."""
        config = self._context.config.relocalization
        candidates = self._locate(frame.image, frame.features, map_)
        for candidate in candidates[: config.max_candidates]:
            place = local_map(map_, candidate.match, 1)
            around = local_map(map_, candidate.match, config.neighbours)
            n_inliers = relocalise(frame, place, around, self._context, seed=candidate.match)
            if n_inliers:
                return self._found(n_inliers, candidate.match)
        sighting = self._recognise(map_, frame.image, frame.features, candidates)
        if sighting is None:
            return Found(TrackingState.LOST)
        frame.set_camera_pose(sighting.T_cw)
        frame.landmark[sighting.feature] = sighting.landmark
        frame.shift = None
        frame.xyz[sighting.feature] = map_.arrays.xyz[sighting.landmark]
        return self._found(len(sighting.feature), sighting.keyframe)

    def _found(self, n_inliers: int, keyframe: int) -> Found:
        state = judge(n_inliers, n_inliers, self._context)
        lost = state == TrackingState.LOST
        return Found(state, n_inliers, n_inliers, keyframe=-1 if lost else keyframe)
