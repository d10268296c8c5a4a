"""Relocalisation: finds the pose of a lost or doubtful frame anywhere in the map (Mur-Artal et al.,
ORB-SLAM, T-RO 2015, section V-C).

A frame is doubtful if it has so few inliers that its matches may be wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from vslam.camera import Image
from vslam.context import Context
from vslam.features import Features, TrackingState
from vslam.frontend.frame import Frame
from vslam.frontend.matching import count_elsewhere
from vslam.frontend.tracker import Found, judge
from vslam.frontend.tracking import match_descriptors, refine, sampled_pose, track_local_map
from vslam.loops import LastSeen, Localisation, LoopCandidate
from vslam.map import Map
from vslam.map_view import LocalMap, local_map

Locate = Callable[[Image | None, Features, Map], list[LoopCandidate]]
# Finds the pose of a frame near one of the candidates by other means than ORB descriptors.
# Candidates that the camera cannot have reached since it was last tracked are left out. The result
# is None if it finds no pose.
Recognise = Callable[
    [Map, Image | None, Features, list[LoopCandidate], LastSeen | None], Localisation | None
]


class MapAccess(Protocol):
    """Gives access to the map at times when local mapping does not write to it."""

    @property
    def is_merged(self) -> bool:
        """Whether local mapping has finished with all keyframes, so that tracking sees the whole
        map."""
        ...

    def merge(self) -> Map:
        """Wait until no keyframe is being mapped, make the last keyframe visible to tracking, and
        return the map."""
        ...


class Relocaliser:
    """Relocalises lost and doubtful frames at keyframes that look similar. A frame is doubtful if
    it has so few inliers that its matches may be wrong."""

    def __init__(self, context: Context, locate: Locate, recognise: Recognise) -> None:
        """
        Args:
            locate: function that returns the keyframes that look similar to a frame, best first.
            recognise: function that is called if a frame cannot be located at any of these
                keyframes using ORB descriptors.
        """
        self._context = context
        self._locate = locate
        self._recognise = recognise

    def relocalise_if_needed(
        self, frame: Frame, found: Found, owner: MapAccess, last: LastSeen | None = None
    ) -> Found:
        """Relocalise a frame if it is lost or doubtful. A frame is doubtful if it has so few
        inliers that its matches may be wrong.

        A lost frame is relocalised only if no keyframe is being mapped at the moment. For a
        doubtful frame, the method first waits until no keyframe is being mapped. A doubtful frame
        keeps its tracked pose, unless the relocalised pose has more than ``relocalization.better``
        times as many inliers.

        Args:
            found: the result of tracking the frame.
            last: where and when the camera was last tracked; None if it may be anywhere.

        Returns:
            The result of the relocalisation, or ``found`` if the frame was not relocalised.
        """
        if found.is_lost:
            return self._find(frame, owner.merge(), last) if owner.is_merged else found
        if not found.is_doubtful:
            return found
        map_ = owner.merge()  # worth the wait: a doubtful frame soon becomes a keyframe
        before = frame.snapshot()
        relocalised = self._find(frame, map_, last)
        if relocalised.n_inliers > self._context.config.relocalization.better * found.n_inliers:
            return relocalised
        frame.restore(before)
        return found

    def _find(self, frame: Frame, map_: Map, last: LastSeen | None) -> Found:
        config = self._context.config.relocalization
        candidates = self._locate(frame.image, frame.features, map_)
        for candidate in candidates[: config.max_candidates]:
            place = local_map(map_, candidate.match, 1)
            around = local_map(map_, candidate.match, config.neighbours)
            n_inliers = relocalise(frame, place, around, self._context, seed=candidate.match)
            if n_inliers:
                return self._result(n_inliers, candidate.match)
        localised = self._recognise(map_, frame.image, frame.features, candidates, last)
        if localised is None:
            return Found(TrackingState.LOST)
        frame.T_cw = localised.T_cw
        frame.shift = None
        xyz = map_.arrays.xyz[localised.landmark]
        frame.match(localised.feature, localised.landmark, xyz)
        return self._result(len(localised.feature), localised.keyframe)

    def _result(self, n_inliers: int, keyframe: int) -> Found:
        state = judge(n_inliers, n_inliers, self._context)
        lost = state == TrackingState.LOST
        return Found(state, n_inliers, n_inliers, keyframe=-1 if lost else keyframe)


def relocalise(
    frame: Frame, place: LocalMap, surroundings: LocalMap, context: Context, seed: int
) -> int:
    """Find the pose of a frame at a place that looks similar, without a predicted pose.

    The descriptors of the frame are matched with the landmarks of the place. A pose is estimated
    from the matches by P3P inside RANSAC, which needs no stereo. Then all landmarks of the
    surroundings are searched for near their projections. The first search uses wide windows, and
    the second search uses windows of the usual size.

    Args:
        frame: receives the pose and the matches. On failure, both are reset.
        place: the landmarks of a candidate keyframe.
        surroundings: the landmarks of the candidate and its covisible keyframes.

    Returns:
        Number of inliers, or 0 if the pose was not found. A pose is accepted if it has at least
        ``relocalization.min_inliers`` inliers and the inliers do not all lie on a single object
        (``count_elsewhere``).
    """
    inliers = _locate(frame, place, surroundings, context, seed)
    config = context.config.relocalization
    elsewhere = count_elsewhere(frame.features.xy[frame.landmark >= 0, 0], context.camera.width)
    if inliers >= config.min_inliers and elsewhere >= config.min_elsewhere:
        return inliers
    frame.T_cw = np.eye(4)
    frame.drop_matches()
    return 0


def _locate(
    frame: Frame, place: LocalMap, surroundings: LocalMap, context: Context, seed: int
) -> int:
    config = context.config.relocalization
    feature, landmark = match_descriptors(frame, place, config.match_distance, config.match_ratio)
    if len(feature) < config.min_matches:
        return 0
    T_cw, inlier = sampled_pose(
        frame, feature, place.xyz[landmark], context, min_inliers=config.min_consensus, seed=seed
    )
    if np.count_nonzero(inlier) < config.min_consensus:
        return 0
    feature, landmark = feature[inlier], landmark[inlier]
    frame.drop_matches()
    frame.match(feature, place.ids[landmark], place.xyz[landmark])
    inliers = refine(frame, T_cw, surroundings, context)
    for window in (config.first_window, context.config.tracking.local_window):
        if inliers < config.min_consensus:
            return 0
        _, inliers, _ = track_local_map(frame, surroundings, context, window)
    return inliers
