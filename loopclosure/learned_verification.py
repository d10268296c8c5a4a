"""Places found again by learned local descriptors, where ORB's do not survive the change.

As :mod:`vslam.loopclosure.verification`: a pose, guided matching with all that the place knows,
refinement, and the same evidence against look-alikes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
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

_DEPTHS_AGREE = 0.15  # a keypoint that observes a landmark has its depth, to this share


class LearnedTrials:
    """Chooses the candidates for learned verification, which takes forty times as long as ORB's.

    These are the ones whose images local descriptors find most alike, and alike enough. After a
    failed attempt only clearly more alike candidates are chosen for some keyframes.

    Attributes:
        state: what is remembered of the last attempt.
    """

    def __init__(self, config: LearnedMatchingConfig) -> None:
        self._config = config
        self.state = VerifierState()

    def choose(self, keyframe: int, candidates: Collection[LoopCandidate]) -> set[int]:
        """Matches to try, of the candidates that are rated."""
        config = self._config
        least = config.min_alike
        if keyframe < self.state.resting_until:
            least = max(least, config.more_alike * self.state.failed_alike)
        alike = [(one.alike, one.match) for one in candidates if one.alike is not None]
        best = sorted(alike, reverse=True)[: config.max_candidates]
        return {match for likeness, match in best if likeness >= least}

    def record(self, candidate: LoopCandidate, *, located: bool) -> None:
        """Remember an attempt.

        Args:
            located: whether it found a pose, even if that was refused later.
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
    """Say of candidates how much local descriptors find alike, where the detector has not said it.

    Args:
        candidates: best first; of those without a rating, the first ``config.rated`` get one.
        glance: at the image that they are candidates of; called if there is something to rate.
        beyond: of :func:`vslam.loopclosure.reach.beyond_reach`, if the camera cannot be anywhere.
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
    """Whether a keyframe shows mostly what a keyframe with an image shows: no network need see it.

    One that follows a keyframe with an image is not seen either: of few keyframes, far apart, every
    second one is enough. A camera that moves slowly, one that turns, and one that drives through a
    mapped place again are told from one that sees something new in the same way, whatever makes
    keyframes.
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

    The edge's features and landmarks are the inliers at which the query has a keypoint.
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
    # Once the pose is known, ORB features may match again: they are at home to a tenth of a pixel.
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
            return replace(edge, reason="too few depths on both sides tell the scale")
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
    """Find the camera of a frame outside the map at the place of a keyframe.

    Args:
        query: descriptors of the frame's image.
        features: of the frame.

    Returns:
        None unless it sees the place as a loop would have to, and enough keypoints lie where its
        landmarks appear to go on tracking.
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
    """Features of the query at which it sees landmarks of the place, and these, ``(N,)`` each,
    neither twice.

    A feature that observes a landmark already must give it the depth of the other: a corner of a
    car before a facade is no corner of the facade.
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
    """Pairs of features and landmarks, and those of a second list that repeat neither."""
    new = ~(np.isin(second[0], first[0]) | np.isin(second[1], first[1]))
    return np.r_[first[0], second[0][new]], np.r_[first[1], second[1][new]]


def nearest_features(
    uv: Matrix,
    xy: NDArray[np.float32],
    octave: NDArray[np.uint8],
    scales: NDArray[np.float64],
    config: LearnedMatchingConfig,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Features ``(K,)`` next to some of ``(N, 2)`` pixels, and which of these, the nearest pairs
    first."""
    if not len(uv) or not len(xy):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    # 3 ms. SciPy's tree takes less, but 27 MB and 0.2 s to import, and of features at the same
    # pixel it takes any; this takes the finest.
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
    """What speaks against a refined loop, "" if nothing does."""
    assert edge.T_query_match is not None
    distance = float(np.linalg.norm(inverse(edge.T_query_match)[:3, 3]))
    if distance > gates.max_distance:
        return f"{distance:.0f} m from the place"
    if reason := _too_little(sight, camera, config, gates):
        return reason
    seen, total = of_query
    if seen < config.min_seen_ratio * total:
        return f"the place saw only {seen} of {total} landmarks of the query"
    return ""


def _too_little(
    sight: Sight, camera: Camera, config: LearnedMatchingConfig, gates: VerificationConfig
) -> str:
    """Why too little of a place is seen, "" if it is enough."""
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
    """How many landmarks of the query the image of a keyframe at the place shows where the pose
    puts them, and how many it should."""
    assert edge.T_query_match is not None
    T_match_query = inverse(edge.T_query_match)
    T_match_query[:3, 3] *= edge.scale  # to the query's unit, which its landmarks are in
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
    # 95 % of the radii of a two-dimensional normal distribution are below 2.45 deviations.
    return int(np.count_nonzero(off < 2.45 * config.sigma)), int(np.isfinite(expected[:, 0]).sum())
