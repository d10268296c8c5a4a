"""Verifies loop candidates and relocalises frames using learned local descriptors.

Learned descriptors still match when the appearance has changed too much for ORB descriptors.

The steps and the tests are the same as in :mod:`vslam.loopclosure.verification`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vslam.config import LearnedMatchingConfig
from vslam.loopclosure.evidence import evidence_of, probability_wrong, weighed
from vslam.loopclosure.learned_alignment import aligned
from vslam.loopclosure.learned_localisation import SIGMA, PoseEstimate, localise, project, view_of
from vslam.loopclosure.local_matching import (
    GUIDED_REACH,
    MIN_COARSE_SIMILARITY,
    MIN_FINE_SIMILARITY,
    DescriptorMaps,
    likeness,
    locate_near,
)
from vslam.loopclosure.reach import within_reach
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.loopclosure.verification import (
    distance_reason,
    guided_match,
    place_of,
    relative_scale,
)
from vslam.types.camera import Camera, Image
from vslam.types.context import Context
from vslam.types.features import Features, nearest_features
from vslam.types.geometry import inverse, orthonormalised, transform
from vslam.types.loops import LastSeen, Localisation, LoopCandidate, LoopEdge, LoopEvidence
from vslam.types.map import Map
from vslam.types.map_kernels import collect_landmarks

# A keypoint can observe a matched landmark only if it lies within this distance of the landmark's
# projection, in pixels at octave 0. [own]
_FUSE_PIXELS = 2.0

# A lost frame is not recognised if its pose is wrong with a larger probability. Between different
# places that look alike, the smallest probability in 15 rendered drives is 0.9.
_MAX_WRONG_POSE = 0.2
_DEPTHS_AGREE = 0.15  # largest relative difference in depth between two landmarks of one feature


def with_similarities(
    candidates: Sequence[LoopCandidate],
    glance: Callable[[], DescriptorMaps],
    images: KeyframeImages,
    config: LearnedMatchingConfig,
    beyond: NDArray[np.float64] | None = None,
) -> list[LoopCandidate]:
    """Compute the ``similarity`` of candidates that do not have one yet, using local descriptors.

    Args:
        candidates: the loop candidates, best first. At most ``config.max_compared`` candidates are
            compared.
        glance: function that returns the coarse descriptors of the query image. It is called only
            if there is a candidate to compare.
        beyond: result of :func:`vslam.loopclosure.reach.beyond_reach`. Keyframes that the camera
            cannot be revisiting are not compared. None excludes no keyframe.

    Returns:
        The candidates in the same order.
    """
    unknown = [one.match for one in candidates if one.similarity is None and one.match in images]
    if beyond is not None:
        unknown = [match for match in unknown if beyond[match] <= 0.0]
    if not unknown:
        return list(candidates)
    query = glance()
    similarity = {
        match: likeness(query, images.glance(match), MIN_COARSE_SIMILARITY)
        for match in unknown[: config.max_compared]
    }
    return [
        replace(one, similarity=similarity.get(one.match, one.similarity)) for one in candidates
    ]


def is_image_redundant(
    map_: Map, keyframe: int, images: KeyframeImages, config: LearnedMatchingConfig
) -> bool:
    """Return whether the image of a keyframe need not be stored.

    An image is redundant if the image of the previous keyframe is stored. It is also redundant if a
    keyframe whose image is stored shares most landmarks with this keyframe. This happens when the
    camera moves slowly, turns, or revisits a mapped place.
    """
    if keyframe - 1 in images:
        return True
    observed = np.count_nonzero(map_.arrays.landmark[map_.rows(keyframe)] >= 0)
    known, _ = map_.covisible(keyframe, int(np.ceil(config.most_shared * observed)))
    return any(one in images for one in known.tolist())


def verify_learned(
    map_: Map,
    candidate: LoopCandidate,
    images: KeyframeImages,
    context: Context,
) -> LoopEdge:
    """Verify a candidate using learned local descriptors. :func:`verification.verify` does the same
    using ORB descriptors.

    Returns:
        The loop edge, either accepted or rejected with a reason. Its features and landmarks are the
        inliers that coincide with a keypoint of the query.
    """
    camera, config, gates = context.camera, context.config.learned, context.config.verification
    query, match = candidate.query, candidate.match
    edge = LoopEdge.of(candidate, matched_by="learned")
    keyframes = [k for k in place_of(map_, match, query).tolist() if k in images]
    if query not in images or not keyframes:
        return replace(edge, reason="no image is stored")
    maps = images.maps(query)
    estimate = localise(map_, maps, keyframes, images, camera, seed=query << 32 | match)
    if isinstance(estimate, str):
        return replace(edge, reason=estimate)
    learned = estimate
    refined = aligned(map_, query, keyframes, learned, images, camera, gates.min_inliers)
    if refined is not None:
        estimate = refined
    feature, landmark = observed_features(map_, query, estimate, camera)
    # Now that the pose is known, ORB features may match. Their pairs of features and landmarks are
    # preferred, and their pose if too few patches could be aligned.
    place = collect_landmarks(map_.arrays, np.array(keyframes, np.int64), map_.n_landmarks)
    guided = guided_match(map_, query, place, estimate.T_cw, camera)
    if np.count_nonzero(guided.seen) >= gates.min_inliers:
        if refined is None:
            estimate = estimate._replace(T_cw=guided.T_cw, covariance=guided.covariance)
        pairs = guided.feature[guided.seen], guided.landmarks[guided.seen]
        feature, landmark = joined(pairs, (feature, landmark))
    T_query_match = orthonormalised(estimate.T_cw @ inverse(map_.keyframe_pose(match)))
    edge = replace(
        edge,
        n_matches=estimate.n_matches,
        n_inliers=int(np.count_nonzero(estimate.seen)),
        T_query_match=T_query_match,
        features=feature,
        landmarks=landmark,
        covariance=estimate.covariance,
    )
    if camera.monocular:
        scale = relative_scale(map_, edge, estimate.T_cw, default=np.nan)
        if not np.isfinite(scale):
            return replace(edge, reason="too few landmarks on both sides to estimate the scale")
        edge = replace(edge, scale=scale)
    if reason := distance_reason(edge, gates):
        return replace(edge, reason=reason)
    if edge.n_inliers < config.min_inliers:
        return replace(edge, reason=f"only {edge.n_inliers} learned matches fit")
    seen_of_query = _seen_of_query(map_, edge, keyframes[0], images, camera)
    return weighed(edge, _evidence_of(map_, learned, camera, maps.scale, seen_of_query))


def recognise(
    map_: Map,
    query: DescriptorMaps,
    features: Features,
    match: int,
    images: KeyframeImages,
    context: Context,
) -> Localisation | None:
    """Estimate the pose of a frame outside the map at the place of a keyframe, using learned local
    descriptors.

    Args:
        query: local descriptors of the frame's image.
        features: ORB features of the frame.
        match: id of the keyframe.

    Returns:
        The pose and the observed landmarks. None if the frame fails the tests that a loop must
        pass, or if too few of its keypoints coincide with landmarks to continue tracking.
    """
    config, around = context.config, [match, *map_.covisible(match)[0].tolist()]
    keyframes = [k for k in around if k in images]
    estimate = localise(map_, query, keyframes, images, context.camera, seed=match)
    if isinstance(estimate, str):
        return None
    index = np.flatnonzero(estimate.seen)
    if len(index) < config.learned.min_inliers:
        return None
    # A frame has no landmarks of its own that could be looked for in the keyframe.
    seen = len(index), len(estimate.seen)
    evidence = _evidence_of(map_, estimate, context.camera, query.scale, seen)
    if probability_wrong(evidence, "learned") > _MAX_WRONG_POSE:
        return None
    feature, near = nearest_features(
        estimate.uv[index], features.xy, features.octave, map_.scales, _FUSE_PIXELS
    )
    if len(feature) < config.tracking.min_inliers:
        return None
    return Localisation(match, estimate.T_cw, feature, estimate.landmarks[index[near]])


def observed_features(
    map_: Map, query: int, estimate: PoseEstimate, camera: Camera
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Pair features of the query image with landmarks at the same image position. The image
    positions of landmarks are predicted from the estimated pose.

    If a feature already observes a landmark, the depths of both landmarks must agree. Otherwise, a
    corner of a car could be paired with a corner of the facade behind the car.

    Returns:
        ``(N,)`` indices of features and ``(N,)`` ids of landmarks, without duplicates.
    """
    a, rows = map_.arrays, map_.rows(query)
    landmarks, uv = estimate.landmarks[estimate.seen], estimate.uv[estimate.seen]
    feature, index = nearest_features(uv, a.xy[rows], a.octave[rows], map_.scales, _FUSE_PIXELS)
    own = a.landmark[rows][feature]
    depth = transform(estimate.T_cw, a.xyz[landmarks[index]])[:, 2]
    ratio = np.where(own >= 0, transform(a.T_cw[query], a.xyz[own])[:, 2] / depth, np.nan)
    known = np.isfinite(ratio)
    # Scale drift of a monocular map changes all ratios by the same factor.
    drift = float(np.median(ratio[known])) if camera.monocular and known.any() else 1.0
    keep = ~known | (np.abs(np.where(known, ratio, drift) / drift - 1.0) < _DEPTHS_AGREE)
    return feature[keep].astype(np.int32), landmarks[index[keep]]


def joined(
    first: tuple[NDArray[np.int32], NDArray[np.int32]],
    second: tuple[NDArray[np.int32], NDArray[np.int32]],
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Join two lists of pairs (feature, landmark). A pair of the second list is added only if
    neither its feature nor its landmark is in the first list."""
    new = ~(np.isin(second[0], first[0]) | np.isin(second[1], first[1]))
    return np.r_[first[0], second[0][new]], np.r_[first[1], second[1][new]]


def _evidence_of(
    map_: Map,
    estimate: PoseEstimate,
    camera: Camera,
    zoom: float,
    seen_of_query: tuple[int, int],
) -> LoopEvidence:
    return evidence_of(
        estimate.uv,
        estimate.seen,
        map_.arrays.xyz[estimate.landmarks],
        estimate.T_cw,
        estimate.covariance,
        camera.intrinsics[0] * zoom,
        camera.width,
        (int(np.count_nonzero(estimate.seen)), len(estimate.seen)),
        seen_of_query,
    )


def _seen_of_query(
    map_: Map,
    edge: LoopEdge,
    keyframe: int,
    images: KeyframeImages,
    camera: Camera,
) -> tuple[int, int]:
    """Return how many landmarks of the query are found at their projections in the image of a
    keyframe, and how many should be visible in this image."""
    assert edge.T_query_match is not None
    T_match_query = inverse(edge.T_query_match)
    T_match_query[:3, 3] *= edge.scale  # in the unit around the query, like the landmarks
    view = view_of(map_, edge.query, images)
    T_wm = inverse(map_.keyframe_pose(edge.match))
    T_wm[:3, 3] *= edge.scale
    T_wk = inverse(map_.keyframe_pose(keyframe))
    T_wk[:3, 3] *= edge.scale
    T_kw = inverse(T_wk) @ T_wm @ T_match_query @ map_.keyframe_pose(edge.query)
    expected = project(map_.arrays.xyz[view.landmarks], T_kw, camera)
    match = images.maps(keyframe)
    least, reach = MIN_FINE_SIMILARITY, GUIDED_REACH
    found = locate_near(view.xy, expected, view.maps, match, reach, least)
    error = np.linalg.norm(found.xy - expected, axis=1) * match.scale
    # For a two-dimensional normal distribution, 95 % of the distances are below 2.45 sigma.
    seen = np.count_nonzero(error < 2.45 * SIGMA)
    return int(seen), int(np.isfinite(expected[:, 0]).sum())


class LearnedRelocalisation:
    """Relocalises frames using learned local descriptors of the stored keyframe images (implements
    ``Recognise``). Without stored images, it finds nothing."""

    def __init__(self, images: KeyframeImages | None, context: Context) -> None:
        self._images = images
        self._context = context

    def __call__(
        self,
        map_: Map,
        image: Image | None,
        features: Features,
        candidates: list[LoopCandidate],
        last: LastSeen | None,
    ) -> Localisation | None:
        images, config = self._images, self._context.config
        if images is None or image is None:
            return None
        if last is not None and candidates:
            # Unlike a loop, a relocalised pose is not confirmed by a second keyframe.
            reachable = within_reach(map_, last, config.siamese)
            candidates = [one for one in candidates if reachable[one.match]]
        candidates = with_similarities(
            candidates, lambda: images.glance_at(image), images, config.learned
        )
        candidates = [one for one in candidates if one.similarity is not None]
        candidates.sort(key=lambda one: -(one.similarity or 0.0))
        if not candidates:
            return None
        maps = images.network.describe(image)
        for candidate in candidates[: config.learned.max_candidates]:
            localised = recognise(map_, maps, features, candidate.match, images, self._context)
            if localised is not None:
                return localised
        return None
