"""Relocalisation: finds the pose of a lost or doubtful frame anywhere in the map (Mur-Artal et al.,
ORB-SLAM, T-RO 2015, section V-C).

A frame is doubtful if it has so few inliers that its matches may be wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vslam.frontend.images import Images
from vslam.frontend.masks import Mask
from vslam.frontend.matching import count_elsewhere
from vslam.frontend.tracking import (
    judge,
    match_descriptors,
    refine,
    sampled_pose,
    track_local_map,
)
from vslam.types.camera import Image
from vslam.types.context import Context
from vslam.types.features import Features, TrackingState
from vslam.types.loops import LastSeen, Localisation, LoopCandidate
from vslam.types.map import Map
from vslam.types.map_view import LocalMap, local_map
from vslam.types.track import By, Track

# Upper bound of the descriptor distance of a match, in bits. [OS1 V-C, customary]
_MATCH_DISTANCE = 50
# Upper bound of the ratio of the best to the second-best distance. [OS1 V-C, customary]
_MATCH_RATIO = 0.75
# At least this many landmarks must be matched by descriptor. [OS1 V-C, customary]
_MIN_MATCHES = 15
# RANSAC must find at least this many inliers. [OS1 V-C, customary]
_MIN_CONSENSUS = 10
# Search radius of the first guided search, in pixels at octave 0. [OS1 V-C, own]
_FIRST_WINDOW = 8.0
# The landmarks of this many keyframes around a candidate place are matched. [own]
_NEIGHBOURS = 20

Locate = Callable[[Image | None, Features, Map], list[LoopCandidate]]
# Finds the pose of a frame near one of the candidates by other means than ORB descriptors.
# Candidates that the camera cannot have reached since it was last tracked are left out. The result
# is None if it finds no pose.
Recognise = Callable[
    [Map, Image | None, Features, list[LoopCandidate], LastSeen | None], Localisation | None
]


class Relocaliser:
    """Relocalises lost and doubtful frames at keyframes that look similar."""

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

    def check(self, track: Track, images: Images, map_: Map, last: LastSeen | None) -> Track:
        """Relocalise a lost or doubtful frame.

        Args:
            map_: the map, to which no other thread writes.
            last: where and when the camera was last tracked; None if it may be anywhere.

        Returns:
            The relocalised frame; it is lost if no place is found. A doubtful frame is returned
            unchanged, unless the relocalised pose has more than ``relocalization.better`` times as
            many inliers.
        """
        found = self._find(track, images, map_, last)
        better = self._context.config.relocalization.better
        return found if track.is_lost or found.n_inliers > better * track.n_inliers else track

    def _find(self, track: Track, images: Images, map_: Map, last: LastSeen | None) -> Track:
        config, context = self._context.config.relocalization, self._context
        lost = replace(
            track.without(), state=TrackingState.LOST, by=By.PREDICTION, n_matches=0, n_inliers=0
        )
        candidates = self._locate(images.image, track.features, map_)
        for candidate in candidates[: config.max_candidates]:
            place = local_map(map_, candidate.match, 1)
            around = local_map(map_, candidate.match, _NEIGHBOURS)
            seed = candidate.match
            found = relocalised(lost, place, around, context, seed=seed, mask=images.mask)
            if found is not None:
                return self._result(lost, found, candidate.match)
        localised = self._recognise(map_, images.image, track.features, candidates, last)
        if localised is None:
            return lost
        xyz = map_.arrays.xyz[localised.landmark]
        found = lost.matching(localised.feature, localised.landmark, xyz)
        found = replace(found, T_cw=localised.T_cw, shift=None, n_inliers=len(localised.feature))
        return self._result(lost, found, localised.keyframe)

    def _result(self, lost: Track, found: Track, keyframe: int) -> Track:
        n = found.n_inliers
        state = judge(n, n, self._context)
        if state == TrackingState.LOST:
            return replace(lost, n_matches=n, n_inliers=n)
        nothing = lost.visible[:0]
        return replace(found, state=state, by=By.PLACE, near=keyframe, n_matches=n, visible=nothing)


def relocalised(
    track: Track,
    place: LocalMap,
    surroundings: LocalMap,
    context: Context,
    *,
    seed: int,
    mask: Mask | None = None,
) -> Track | None:
    """Find the pose of a frame at a place that looks similar, without a predicted pose.

    The descriptors of the frame are matched with the landmarks of the place. A pose is estimated
    from the matches by P3P inside RANSAC, which needs no stereo. Then all landmarks of the
    surroundings are searched for near their projections. The first search uses wide windows, and
    the second search uses windows of the usual size.

    Args:
        place: the landmarks of a candidate keyframe.
        surroundings: the landmarks of the candidate and its covisible keyframes.
        seed: seed of the random samples.
        mask: the mask of the image; None uses all pixels.

    Returns:
        The frame with its pose and its matches, or None if the pose was not found. A pose is
        accepted if it has at least ``relocalization.min_inliers`` inliers and the inliers do not
        all lie on a single object (``count_elsewhere``).
    """
    config = context.config.relocalization
    features = track.features
    feature, landmark = match_descriptors(features, place, _MATCH_DISTANCE, _MATCH_RATIO)
    if len(feature) < _MIN_MATCHES:
        return None
    points = place.xyz[landmark]
    T_cw, inlier = sampled_pose(
        features, feature, points, context, min_inliers=_MIN_CONSENSUS, seed=seed
    )
    if np.count_nonzero(inlier) < _MIN_CONSENSUS:
        return None
    matched = track.without().matching(feature[inlier], place.ids[landmark[inlier]], points[inlier])
    found = refine(matched, T_cw, surroundings, context)
    for window in (_FIRST_WINDOW, context.config.tracking.local_window):
        if found.n_inliers < _MIN_CONSENSUS:
            return None
        found = track_local_map(found, surroundings, context, mask, window)
    elsewhere = count_elsewhere(features.xy[found.landmark >= 0, 0], context.camera.width)
    enough = found.n_inliers >= config.min_inliers and elsewhere >= config.min_elsewhere
    return found if enough else None
