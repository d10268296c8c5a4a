"""Verification of loop candidates, and relocalisation, by learned local descriptors, for changes of
appearance that ORB descriptors do not survive.

The steps are those of :mod:`vslam.loopclosure.verification`: an initial pose, guided matching with
all landmarks of the place, refinement, and the same tests against similar-looking places.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, Image
from vslam.config import Config, LearnedMatchingConfig, VerificationConfig
from vslam.features import Features
from vslam.geometry import Matrix, inverse, orthonormalised, transform
from vslam.loopclosure.learned_localisation import Sight, localise, project, view_of
from vslam.loopclosure.local_matching import DescriptorMaps, likeness, locate_near
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.loopclosure.verification import (
    guided_match,
    place_of,
    relative_scale,
    spread_reason,
)
from vslam.loops import LoopCandidate, LoopEdge, Sighting
from vslam.map import Map
from vslam.map_kernels import collect_landmarks
from vslam.states import VerifierState

_DEPTHS_AGREE = 0.15  # largest relative difference of the depths of two landmarks of one feature


class LearnedTrials:
    """Chooses the candidates for learned verification, which takes forty times as long as
    verification by ORB.

    Candidates are chosen if the local descriptors of their images are among the most similar ones
    and similar enough. After a failed attempt, only clearly more similar candidates are chosen for
    the next ``learned.rest`` keyframes.

    Attributes:
        state: what is remembered of the last attempt.
    """

    def __init__(self, config: LearnedMatchingConfig) -> None:
        self._config = config
        self.state = VerifierState()

    def choose(self, keyframe: int, candidates: Collection[LoopCandidate]) -> set[int]:
        """Ids of the matches to try; candidates without a rating are never chosen."""
        config = self._config
        least = config.min_alike
        if keyframe < self.state.resting_until:
            least = max(least, config.more_alike * self.state.failed_alike)
        alike = [(one.alike, one.match) for one in candidates if one.alike is not None]
        best = sorted(alike, reverse=True)[: config.max_candidates]
        return {match for likeness, match in best if likeness >= least}

    def record(self, candidate: LoopCandidate, *, located: bool) -> None:
        """Remember the result of an attempt.

        Args:
            located: whether the attempt found a pose, even if the loop was then rejected.
        """
        if located:
            self.state = replace(self.state, resting_until=0)
        else:
            until = candidate.query + 1 + self._config.rest
            self.state = VerifierState(until, candidate.alike or 0.0)


def rated(
    candidates: Sequence[LoopCandidate],
    glance: Callable[[], DescriptorMaps],
    images: KeyframeImages,
    config: LearnedMatchingConfig,
    beyond: NDArray[np.float64] | None = None,
) -> list[LoopCandidate]:
    """Set ``alike``, the similarity by local descriptors, of candidates that the detector has not
    rated.

    Args:
        candidates: best first; of those without a rating, the first ``config.rated`` get one.
        glance: returns the coarse descriptors of the query image; called only if there is a
            candidate to rate.
        beyond: result of :func:`vslam.loopclosure.reach.beyond_reach`; keyframes out of reach are
            not rated. None if the camera may be anywhere.

    Returns:
        The candidates in the same order.
    """
    unrated = [one.match for one in candidates if one.alike is None and one.match in images]
    if beyond is not None:
        unrated = [match for match in unrated if beyond[match] <= 0.0]
    if not unrated:
        return list(candidates)
    query = glance()
    alike = {
        match: likeness(query, images.glance(match), config.coarse_alike)
        for match in unrated[: config.rated]
    }
    return [replace(one, alike=alike.get(one.match, one.alike)) for one in candidates]


def is_image_redundant(
    map_: Map, keyframe: int, images: KeyframeImages, config: LearnedMatchingConfig
) -> bool:
    """Whether the image of a keyframe need not be kept, because another image shows nearly the same
    view: the previous keyframe has an image, or a keyframe with an image shares most of its
    landmarks.

    If keyframes are far apart, every second image is enough. The test by shared landmarks covers
    slow motion, turns, and revisits of mapped places alike, whatever the keyframe policy.
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
    camera: Camera,
    config: LearnedMatchingConfig,
    gates: VerificationConfig,
) -> LoopEdge:
    """:func:`verification.verify` by local descriptors of the keyframes' images.

    Returns:
        The edge, accepted or with a reason; its features and landmarks are those inliers at which
        the query has a keypoint.
    """
    query, match = candidate.query, candidate.match
    edge = LoopEdge.of(candidate, matched_by="learned")
    keyframes = [k for k in place_of(map_, match, query, gates).tolist() if k in images]
    if query not in images or not keyframes:
        return replace(edge, reason="no image is kept")
    sight = localise(
        map_, images.maps(query), keyframes, images, camera, config, seed=query << 32 | match
    )
    if isinstance(sight, str):
        return replace(edge, reason=sight)
    feature, landmark = observed_features(map_, query, sight, camera, config)
    # Once the pose is known, ORB features may match after all, and they are located more precisely,
    # to a tenth of a pixel.
    place = collect_landmarks(map_.arrays, np.array(keyframes, np.int64), map_.n_landmarks)
    guided = guided_match(map_, query, place, sight.T_cw, camera, gates)
    if np.count_nonzero(guided.seen) >= gates.min_inliers:
        sight = sight._replace(T_cw=guided.T_cw)
        pairs = guided.feature[guided.seen], guided.landmarks[guided.seen]
        feature, landmark = joined(pairs, (feature, landmark))
    T_query_match = orthonormalised(sight.T_cw @ inverse(map_.keyframe_pose(match)))
    edge = replace(
        edge,
        n_matches=sight.n_matches,
        n_inliers=int(np.count_nonzero(sight.seen)),
        T_query_match=T_query_match,
        features=feature,
        landmarks=landmark,
    )
    if camera.monocular:
        scale = relative_scale(map_, edge, sight.T_cw, default=np.nan)
        if not np.isfinite(scale):
            return replace(edge, reason="too few depths on both sides to estimate the scale")
        edge = replace(edge, scale=scale)
    seen = _seen_of_query(map_, edge, keyframes[0], images, camera, config)
    reason = _rejection_reason(edge, sight, seen, camera, config, gates)
    return replace(edge, accepted=not reason, reason=reason or "verified")


def recognise(
    map_: Map,
    query: DescriptorMaps,
    features: Features,
    match: int,
    images: KeyframeImages,
    camera: Camera,
    config: Config,
) -> Sighting | None:
    """Estimate the pose of a frame outside the map at the place of a keyframe.

    Args:
        query: local descriptors of the frame's image.
        features: ORB features of the frame.
        match: id of the keyframe.

    Returns:
        None unless the frame passes the tests of a loop, and enough of its keypoints coincide with
        landmarks to continue tracking.
    """
    gates = config.verification
    around = [match, *map_.covisible(match)[0].tolist()]
    keyframes = [k for k in around if k in images]
    sight = localise(map_, query, keyframes, images, camera, config.learned, seed=match)
    if isinstance(sight, str) or _too_little(sight, camera, config.learned, gates):
        return None
    index = np.flatnonzero(sight.seen)
    feature, near = nearest_features(
        sight.uv[index], features.xy, features.octave, map_.scales, config.learned
    )
    if len(feature) < config.tracking.min_inliers:
        return None
    return Sighting(match, sight.T_cw, feature, sight.landmarks[index[near]])


def observed_features(
    map_: Map, query: int, sight: Sight, camera: Camera, config: LearnedMatchingConfig
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Pairs of features of the query and landmarks of the place that coincide in the image.

    If a feature already observes a landmark of its own, the depths of both landmarks must agree: a
    corner of a car in front of a facade is not a corner of the facade.

    Returns:
        ``(N,)`` indices of features and ``(N,)`` ids of landmarks, without repetitions.
    """
    a, rows = map_.arrays, map_.rows(query)
    landmarks, uv = sight.landmarks[sight.seen], sight.uv[sight.seen]
    feature, index = nearest_features(uv, a.xy[rows], a.octave[rows], map_.scales, config)
    own = a.landmark[rows][feature]
    depth = transform(sight.T_cw, a.xyz[landmarks[index]])[:, 2]
    ratio = np.where(own >= 0, transform(a.T_cw[query], a.xyz[own])[:, 2] / depth, np.nan)
    known = np.isfinite(ratio)
    usual = float(np.median(ratio[known])) if camera.monocular and known.any() else 1.0
    keep = ~known | (np.abs(np.where(known, ratio, usual) / usual - 1.0) < _DEPTHS_AGREE)
    return feature[keep].astype(np.int32), landmarks[index[keep]]


def joined(
    first: tuple[NDArray[np.int32], NDArray[np.int32]],
    second: tuple[NDArray[np.int32], NDArray[np.int32]],
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """All pairs of features and landmarks of the first list, followed by those pairs of the second
    list whose feature and landmark both do not occur in the first."""
    new = ~(np.isin(second[0], first[0]) | np.isin(second[1], first[1]))
    return np.r_[first[0], second[0][new]], np.r_[first[1], second[1][new]]


def nearest_features(
    uv: Matrix,
    xy: NDArray[np.float32],
    octave: NDArray[np.uint8],
    scales: NDArray[np.float64],
    config: LearnedMatchingConfig,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Match pixels to the nearest features within ``config.fuse_pixels``, measured in pixels of the
    feature's octave.

    Args:
        uv: ``(N, 2)`` pixels.
        xy, octave: features of the image.

    Returns:
        ``(K,)`` indices of features, without repetitions, and ``(K,)`` indices of the pixels; the
        nearest pairs come first.
    """
    if not len(uv) or not len(xy):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    # This takes 3 ms. A k-d tree of SciPy is faster, but its import takes 27 MB and 0.2 s, and of
    # several features at the same pixel it returns any; this returns the one of the finest octave.
    x, y = xy.T.astype(np.float64)
    feature = np.array([np.argmin((x - u) ** 2 + (y - v) ** 2) for u, v in uv.tolist()])
    distance = np.sqrt((x[feature] - uv[:, 0]) ** 2 + (y[feature] - uv[:, 1]) ** 2)
    near = np.flatnonzero(distance <= config.fuse_pixels * scales[octave[feature]])
    near = near[np.argsort(distance[near], kind="stable")]
    _, first = np.unique(feature[near], return_index=True)
    near = near[np.sort(first)]
    return np.asarray(feature[near], np.int64), near


def _rejection_reason(
    edge: LoopEdge,
    sight: Sight,
    of_query: tuple[int, int],
    camera: Camera,
    config: LearnedMatchingConfig,
    gates: VerificationConfig,
) -> str:
    """Why a refined loop must be rejected, "" if it passes all tests."""
    assert edge.T_query_match is not None
    distance = float(np.linalg.norm(inverse(edge.T_query_match)[:3, 3]))
    if distance > gates.max_distance:
        return f"the pose is {distance:.0f} m from the place"
    if reason := _too_little(sight, camera, config, gates):
        return reason
    seen, total = of_query
    if seen < config.min_seen_ratio * total:
        return f"the place saw only {seen} of {total} landmarks of the query"
    return ""


def _too_little(
    sight: Sight, camera: Camera, config: LearnedMatchingConfig, gates: VerificationConfig
) -> str:
    """Why a camera sees too little of a place, "" if it sees enough."""
    seen, total = int(np.count_nonzero(sight.seen)), len(sight.seen)
    if seen < config.min_inliers:
        return f"only {seen} learned matches fit"
    if seen < gates.min_inlier_ratio * sight.n_matches:
        return f"only {seen} of {sight.n_matches} learned matches fit"
    if reason := spread_reason(sight.uv, sight.seen, camera, gates, config.min_elsewhere):
        return reason
    if seen < config.min_seen_ratio * total:
        return f"only {seen} of {total} landmarks of the place are seen"
    return ""


def _seen_of_query(
    map_: Map,
    edge: LoopEdge,
    keyframe: int,
    images: KeyframeImages,
    camera: Camera,
    config: LearnedMatchingConfig,
) -> tuple[int, int]:
    """How many landmarks of the query are found at their projections in the image of a keyframe of
    the place, and how many should be visible in it."""
    assert edge.T_query_match is not None
    T_match_query = inverse(edge.T_query_match)
    T_match_query[:3, 3] *= edge.scale  # in the query's unit, like its landmarks
    view = view_of(map_, edge.query, images)
    T_wm = inverse(map_.keyframe_pose(edge.match))
    T_wm[:3, 3] *= edge.scale
    T_wk = inverse(map_.keyframe_pose(keyframe))
    T_wk[:3, 3] *= edge.scale
    T_kw = inverse(T_wk) @ T_wm @ T_match_query @ map_.keyframe_pose(edge.query)
    expected = project(map_.arrays.xyz[view.landmarks], T_kw, camera)
    match = images.maps(keyframe)
    found = locate_near(view.xy, expected, view.maps, match, config.guided_reach, config.alike)
    off = np.linalg.norm(found.xy - expected, axis=1) * match.scale
    # For a two-dimensional normal distribution, 95 % of the distances are below 2.45 sigma.
    return int(np.count_nonzero(off < 2.45 * config.sigma)), int(np.isfinite(expected[:, 0]).sum())


class LearnedRelocalisation:
    """Implements ``Recognise`` by the images of keyframes; finds nothing if there are no images."""

    def __init__(self, images: KeyframeImages | None, camera: Camera, config: Config) -> None:
        self._images = images
        self._camera = camera
        self._config = config

    def __call__(
        self, map_: Map, image: Image | None, features: Features, candidates: list[LoopCandidate]
    ) -> Sighting | None:
        """Search for a frame at the candidates whose images are most similar to it; returns None if
        it is found at none of them."""
        images, config = self._images, self._config
        if images is None or image is None:
            return None
        candidates = rated(candidates, lambda: images.glance_at(image), images, config.learned)
        alike = [one for one in candidates if one.alike is not None]
        alike.sort(key=lambda one: -(one.alike or 0.0))
        if not alike:
            return None
        maps = images.network.describe(image)
        for candidate in alike[: config.learned.max_candidates]:
            found = recognise(map_, maps, features, candidate.match, images, self._camera, config)
            if found is not None:
                return found
        return None
