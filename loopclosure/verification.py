"""Verifies loop candidates geometrically, using ORB descriptors.

Verification tests whether two keyframes show the same place, and estimates their relative pose.

The first steps follow ORB-SLAM (T-RO 2015, section VII-B) and, for stereo, ORB-SLAM2 (T-RO 2017,
section III-D). The descriptors of two keyframes are matched, and a motion is estimated by RANSAC.
Then all landmarks of the place are matched near their projections, and the pose is refined.

ORB-SLAM then only counts inliers. However, two different facades or cars that look alike also give
many inliers. This module therefore weighs further evidence (``vslam.loopclosure.evidence``).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.config import VerificationConfig
from vslam.frontend.matching import (
    Projections,
    Searchable,
    consistent_orientation,
    predict_view,
    search_all,
    search_windows,
)
from vslam.frontend.pose import optimise_pose, pose_covariance
from vslam.loopclosure.evidence import evidence_of, weighed
from vslam.loopclosure.sim3_ransac import ObservedPoints, align
from vslam.types.camera import Camera
from vslam.types.context import Context
from vslam.types.features import FeatureGrid
from vslam.types.geometry import Matrix, inverse, orthonormalised, transform
from vslam.types.loops import LoopCandidate, LoopEdge
from vslam.types.map import Map
from vslam.types.map_kernels import collect_landmarks
from vslam.types.reprojection import stack_uvr

# Upper bound of the descriptor distance of a match, in bits. [OS1 VII-B, customary]
MATCH_DISTANCE = 50
# Upper bound of the ratio of the best to the second-best distance. [OS1 VII-B, own]
MATCH_RATIO = 0.8
# At least this many landmarks must be matched by descriptor. [OS1 VII-B, customary]
_MIN_MATCHES = 20
# Upper bound of the number of RANSAC draws. [OS1 VII-B, own]
_MAX_DRAWS = 600
# The probability with which RANSAC must draw at least one sample without outliers. [OS1 VII-B,
# own]
_CONFIDENCE = 0.99
# RANSAC must find at least this many inliers. [OS1 VII-B, own]
_MIN_CONSENSUS = 15
# The landmarks of the matched keyframe and of this many covisible keyframes form the place that
# guided search looks for. [own]
_PLACE_KEYFRAMES = 10
# Search radius of the first guided search, in pixels at octave 0. [OS1 VII-B, own]
_FIRST_WINDOW = 8.0
# Search radius of the second guided search, in pixels at octave 0. [OS1 VII-B, own]
_SECOND_WINDOW = 4.0
# Upper bound of the descriptor distance in guided search, in bits. [OS1 VII-B, own]
_GUIDED_DISTANCE = 64

MIN_DEPTHS = 10  # least number of features with landmarks on both sides to estimate the scale


class GuidedMatches(NamedTuple):
    """The landmarks that should be visible from a camera pose, and the features that match them.

    Attributes:
        landmarks: ``(M,)`` int32 ids of the landmarks that should be visible.
        feature: ``(M,)`` int32 index, within the keyframe, of the inlier feature that matches each
            landmark; -1 if there is no such feature.
        uv: ``(M, 2)`` float64 predicted positions of the landmarks in the image, pixels.
        n_matches: number of landmarks that were matched near their predicted positions, including
            outliers.
        T_cw: ``(4, 4)`` pose of the camera (world to camera), in the world frame of the landmarks.
        covariance: ``(6, 6)`` covariance of the error of this pose (``LoopEdge.covariance``).
    """

    landmarks: NDArray[np.int32]
    feature: NDArray[np.int32]
    uv: Matrix
    n_matches: int
    T_cw: Matrix
    covariance: Matrix

    @property
    def seen(self) -> NDArray[np.bool_]:
        """``(M,)`` bool, True for landmarks with an inlier feature."""
        return self.feature >= 0


def verify(map_: Map, candidate: LoopCandidate, context: Context) -> LoopEdge:
    """Decide whether the query keyframe of a loop candidate shows the place of the match keyframe.
    The map is not changed.

    Returns:
        A loop edge. It is accepted with the reason "verified", or rejected with a different reason.
        Its pose and counts come from the last step that was completed. Its inliers are pairs of a
        feature of the query keyframe and a landmark of the place, without duplicates.
    """
    query, match = candidate.query, candidate.match
    edge = LoopEdge.of(candidate)
    rows_q, rows_m = match_keyframes(map_, query, match)
    edge = replace(edge, n_matches=len(rows_q))
    if len(rows_q) < _MIN_MATCHES:
        return replace(edge, reason=f"only {len(rows_q)} descriptors match")

    T_query_match, scale, n_inliers = _consensus(map_, query, match, rows_q, rows_m, context.camera)
    if T_query_match is None:
        return replace(edge, reason=f"no motion has {_MIN_CONSENSUS} inliers among the matches")
    edge = replace(edge, n_inliers=n_inliers, T_query_match=T_query_match, scale=scale)
    return verify_near(map_, edge, context)


def verify_near(map_: Map, edge: LoopEdge, context: Context) -> LoopEdge:
    """Verify a loop edge that already has a pose. In contrast to ``verify``, descriptors are
    matched only near the projections of landmarks.

    Raises:
        ValueError: the edge has no pose.
    """
    if edge.T_query_match is None:
        raise ValueError(f"the edge from {edge.query} to {edge.match} has no pose")
    camera, config = context.camera, context.config.verification
    place = place_of(map_, edge.match, edge.query)
    T_mw = map_.keyframe_pose(edge.match)
    landmarks = collect_landmarks(map_.arrays, place, map_.n_landmarks)
    guided = guided_match(map_, edge.query, landmarks, edge.T_query_match @ T_mw, camera)
    T_query_match = orthonormalised(guided.T_cw @ inverse(T_mw))
    edge = replace(
        edge,
        n_matches=guided.n_matches,
        n_inliers=int(np.count_nonzero(guided.seen)),
        T_query_match=T_query_match,
        features=guided.feature[guided.seen],
        landmarks=guided.landmarks[guided.seen],
        covariance=guided.covariance,
        matched_by="orb",
    )
    if camera.monocular:
        scale = relative_scale(map_, edge, guided.T_cw, default=edge.scale)
        edge = replace(edge, scale=scale)
    if reason := distance_reason(edge, config):
        return replace(edge, reason=reason)
    if edge.n_inliers < config.min_inliers:
        return replace(edge, reason=f"only {edge.n_inliers} landmarks of the place fit")
    evidence = evidence_of(
        guided.uv,
        guided.seen,
        map_.arrays.xyz[guided.landmarks],
        guided.T_cw,
        guided.covariance,
        camera.intrinsics[0],
        camera.width,
        seen_of(map_, edge.match, guided),
        seen_of(map_, edge.query, reverse_match(map_, edge, camera)),
    )
    return weighed(edge, evidence)


def match_keyframes(
    map_: Map, query: int, match: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Match the descriptors of two keyframes. Features without a landmark are not used.

    Returns:
        Two ``(N,)`` arrays of row indices into the observation arrays of the map. The first array
        belongs to the query, and the second array to the match.
    """
    a = map_.arrays
    rows_q, rows_m = (
        np.flatnonzero(a.landmark[map_.rows(k)] >= 0) + a.first_row[k] for k in (query, match)
    )
    found = search_all(a.descriptor[rows_q], a.descriptor[rows_m], MATCH_DISTANCE, MATCH_RATIO)
    hit = np.flatnonzero(found >= 0)
    rows_q, rows_m = rows_q[hit], rows_m[found[hit]]
    keep = consistent_orientation(a.angle[rows_q], a.angle[rows_m])
    return rows_q[keep], rows_m[keep]


def _consensus(
    map_: Map,
    query: int,
    match: int,
    rows_q: NDArray[np.int64],
    rows_m: NDArray[np.int64],
    camera: Camera,
) -> tuple[Matrix | None, float, int]:
    """Estimate the motion between two keyframes using RANSAC.

    Returns:
        ``T_query_match``, the scale and the number of inliers. ``T_query_match`` is None if no
        motion has enough inliers.
    """
    found = align(
        _observed_points(map_, query, rows_q),
        _observed_points(map_, match, rows_m),
        camera.intrinsics,
        seed=query << 32 | match,
        min_inliers=_MIN_CONSENSUS,
        max_draws=_MAX_DRAWS,
        confidence=_CONFIDENCE,
        fix_scale=not camera.monocular,
    )
    if found is None:
        return None, 1.0, 0
    T_query_match = found.T_a_b.copy()
    T_query_match[:3, 3] /= found.scale  # to the unit around the match
    return T_query_match, found.scale, int(np.count_nonzero(found.inlier))


def relative_scale(map_: Map, edge: LoopEdge, T_cw: Matrix, *, default: float) -> float:
    """Estimate the scale of a monocular loop: the factor that converts lengths around the match
    keyframe to lengths around the query keyframe.

    An inlier feature of the query keyframe may also observe a landmark that was mapped on the
    query's side of the loop. The depth of this landmark, divided by the depth of the matched
    landmark of the place, is one estimate of the scale. The median of these estimates is returned.

    Args:
        T_cw: ``(4, 4)`` pose of the query keyframe (world to camera), in the world frame of the
            place.
        default: the result if too few features observe landmarks on both sides.
    """
    a = map_.arrays
    assert edge.features is not None
    assert edge.landmarks is not None
    own = a.landmark[map_.rows(edge.query)][edge.features]
    both = own >= 0
    if np.count_nonzero(both) < MIN_DEPTHS:
        return default
    depth = transform(a.T_cw[edge.query], a.xyz[own[both]])[:, 2]
    depth_of_place = transform(T_cw, a.xyz[edge.landmarks[both]])[:, 2]
    return float(np.median(depth / depth_of_place))


def _observed_points(map_: Map, keyframe: int, rows: NDArray[np.int64]) -> ObservedPoints:
    a = map_.arrays
    points = transform(a.T_cw[keyframe], a.xyz[a.landmark[rows]])
    return ObservedPoints(points, *_observations(map_, rows))


def _observations(map_: Map, rows: NDArray[np.int64]) -> tuple[Matrix, Matrix]:
    """Read the ``(N, 3)`` u, v, u_right and the ``(N,)`` inverse variances of some rows of the
    observation arrays."""
    a = map_.arrays
    uvr = stack_uvr(a.xy[rows], a.u_right[rows])
    return uvr, map_.scales[a.octave[rows]] ** -2.0


def place_of(map_: Map, match: int, query: int) -> NDArray[np.int64]:
    """Return the ids of the match keyframe and its most covisible keyframes. Keyframes that are
    covisible with the query keyframe are excluded."""
    near_query = {query, *map_.covisible(query)[0].tolist()}
    around = [k for k in map_.covisible(match)[0].tolist() if k not in near_query]
    return np.array([match, *around[:_PLACE_KEYFRAMES]], np.int64)


def guided_match(
    map_: Map,
    keyframe: int,
    landmarks: NDArray[np.int32],
    T_cw: Matrix,
    camera: Camera,
) -> GuidedMatches:
    """Match ``(N,)`` landmarks with the features of a keyframe, and refine the pose of the
    keyframe.

    The landmarks are searched for near their projections, and the pose is refined with all matches.
    Both steps are then repeated with narrower windows.

    Args:
        T_cw: ``(4, 4)`` estimated pose of the keyframe (world to camera), in the world frame of the
            landmarks. If the map has drifted, this pose differs from the pose of the keyframe in
            the map.
    """
    a, rows = map_.arrays, map_.rows(keyframe)
    grid = FeatureGrid.of_positions(a.xy[rows], camera.width, camera.height)
    features = Searchable(a.xy[rows], a.octave[rows], a.u_right[rows], a.descriptor[rows], grid)
    free = np.ones(rows.stop - rows.start, np.bool_)
    for window in (_FIRST_WINDOW, _SECOND_WINDOW):
        expected, radius, octave = predict_view(
            T_cw,
            a.xyz[landmarks],
            a.normal[landmarks],
            a.distance_range[landmarks],
            camera.intrinsics,
            camera.width,
            camera.height,
            map_.scales,
            window,
        )
        found, _ = search_windows(
            Projections(expected, radius, octave - 1, octave + 1, a.landmark_descriptor[landmarks]),
            features,
            free,
            _GUIDED_DISTANCE,
            1.0,
        )
        hit = np.flatnonzero(found >= 0)
        xyz = a.xyz[landmarks[hit]]
        uvr, inverse_sigma2 = _observations(map_, found[hit].astype(np.int64) + rows.start)
        T_cw, inlier = optimise_pose(T_cw, xyz, uvr, inverse_sigma2, camera.intrinsics)
    disparity_weight = np.full(np.count_nonzero(inlier), camera.intrinsics[5])
    covariance = pose_covariance(
        T_cw, xyz[inlier], uvr[inlier], inverse_sigma2[inlier], camera.intrinsics, disparity_weight
    )
    visible = np.flatnonzero(radius > 0)
    feature = np.full(len(landmarks), -1, np.int32)
    feature[hit[inlier]] = found[hit[inlier]]
    return GuidedMatches(
        landmarks[visible], feature[visible], expected[visible, :2], len(hit), T_cw, covariance
    )


def distance_reason(edge: LoopEdge, config: VerificationConfig) -> str:
    """Return the reason to reject a loop whose keyframes are too far apart, or ""."""
    assert edge.T_query_match is not None
    distance = float(np.linalg.norm(inverse(edge.T_query_match)[:3, 3]))
    return f"the pose is {distance:.0f} m from the place" if distance > config.max_distance else ""


def reverse_match(
    map_: Map,
    edge: LoopEdge,
    camera: Camera,
) -> GuidedMatches:
    """Search for the landmarks of a loop's query keyframe in the image of its match keyframe."""
    assert edge.T_query_match is not None
    T_match_query = inverse(edge.T_query_match)
    T_match_query[:3, 3] *= edge.scale  # lengths in the unit around the query, like the landmarks
    T_mw = T_match_query @ map_.keyframe_pose(edge.query)
    return guided_match(map_, edge.match, map_.landmarks_of(edge.query), T_mw, camera)


def seen_of(map_: Map, keyframe: int, guided: GuidedMatches) -> tuple[int, int]:
    """Return how many landmarks of a keyframe were found by guided matching, and how many of them
    should be visible."""
    own = np.isin(guided.landmarks, map_.landmarks_of(keyframe))
    return int(np.count_nonzero(guided.seen & own)), int(np.count_nonzero(own))
