"""Tracks one frame against the map (ORB-SLAM2 paper, section III; ORB-SLAM paper, section V).

All functions depend only on the frame, the previous frame and a ``LocalMap``, and change none of
them. The map itself is never accessed, so local mapping can write to it at the same time.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vslam.frontend.alignment import align_matches
from vslam.frontend.masks import Mask
from vslam.frontend.matching import (
    Projections,
    Searchable,
    consistent_orientation,
    predict_view,
    search_all,
    search_windows,
)
from vslam.frontend.pnp import ransac_pose
from vslam.frontend.pose import MIN_TRUSTED, offset_effect, optimise_pose, pose_covariance
from vslam.frontend.prediction import Prediction
from vslam.types.camera import DISPARITY_WEIGHT, Camera
from vslam.types.context import Context
from vslam.types.features import NO_PATCHES, Features, LandmarkPatches, TrackingState
from vslam.types.geometry import Matrix, compose, inverse, transform
from vslam.types.map_view import LocalMap, MapView
from vslam.types.reprojection import stack_uvr
from vslam.types.track import Track

# Upper bound of the descriptor distance when landmarks are matched near their projections, in
# bits. [OS1 V-D, customary]
_MATCH_DISTANCE = 100
# Upper bound of the ratio of the best to the second-best distance when the local map is matched.
# [OS1 V-D, customary]
_MATCH_RATIO = 0.8
# Upper bound of the descriptor distance when a frame is matched with the reference keyframe, in
# bits. [OS1 V-B, customary]
_REFERENCE_DISTANCE = 50
# Upper bound of the ratio of the best to the second-best distance when a frame is matched with
# the reference keyframe. [OS1 V-B, customary]
_REFERENCE_RATIO = 0.7
# Search radius if the motion has changed so suddenly that a frame would be LOST, in pixels at
# octave 0. The pose is then found by RANSAC among the matches with the previous frame. [own]
_SUDDEN_WINDOW = 100.0
# A frame is tracked from the reference keyframe if tracking from the previous frame has fewer
# inliers than this. [OS1 V-B, customary]
MIN_INLIERS_MOTION = 20
# A frame of an RGB-D camera is also LOST if less than this fraction of its matches are inliers.
# [own]
_DEPTH_MIN_INLIER_RATIO = 0.2
# Replaces `local_window` for a frame that could be matched with neither the previous frame nor
# the reference keyframe, in pixels at octave 0. [own]
_PREDICTED_WINDOW = 7.0
# A frame is matched with the local map only if tracking from the previous frame, from the
# reference keyframe, with `_PREDICTED_WINDOW` or with `_SUDDEN_WINDOW` gives at least this many
# inliers. Otherwise, the frame is LOST. [OS1 V-B, customary]
MIN_INLIERS_FRAME = 10
# A frame with fewer inliers than this in the local map is LOST. Its pose is only predicted. [own]
MIN_INLIERS_LOST = 15
# Upper bound of the number of RANSAC draws. [OS1 V-C, own]
_MAX_DRAWS = 600
# The probability with which RANSAC must draw at least one sample without outliers. [OS1 V-C,
# customary]
_CONFIDENCE = 0.99


def feature_depth(features: Features, camera: Camera) -> NDArray[np.float64]:
    """Compute the ``(N,)`` float64 stereo depth of each feature, in metres; NaN without a stereo
    match."""
    return camera.bf / (features.xy[:, 0].astype(np.float64) - features.u_right)


def track_previous_frame(
    track: Track, mask: Mask | None, predicted: Prediction, view: MapView, context: Context
) -> Track:
    """Find a first pose and first matches of a frame. ``n_inliers`` is 0 if there are none.

    Four methods are tried in turn: tracking against the last frame, tracking against the reference
    keyframe, matching the local map in a wider window, and ``track_sudden_motion``. Only the second
    method works if the motion is unknown.

    Args:
        track: the frame with its features, which are not matched yet.
        mask: the mask of the image; None uses all pixels.
    """
    config, T_cw = context.config.tracking, predicted.T_cw
    last, local = predicted.last, view.local_landmarks
    if last is None and not (predicted.is_resumed and predicted.lost_frames == 0):
        return track
    if last is not None and last.twist is not None:
        found = track_motion(track, last, T_cw, local, context)
        if _is_trusted(found, config.min_inlier_ratio):
            return found
    found = track_descriptors(track, view.reference_landmarks, T_cw, context)
    if found.n_inliers >= MIN_INLIERS_FRAME or predicted.twist is None:
        return found
    # After a sudden change in brightness, landmarks that older frames observed may match when the
    # landmarks of the last frame do not.
    found = track_local_map(track, local, context, mask, _PREDICTED_WINDOW, view.patches)
    if _is_trusted(found, config.min_inlier_ratio):
        return found
    if last is not None and predicted.is_tracking:
        found = track_sudden_motion(track, last, T_cw, local, context)
        if _is_trusted(found, config.sudden_min_inlier_ratio):
            return found
    return track


def _is_trusted(track: Track, min_ratio: float) -> bool:
    return track.n_inliers >= max(MIN_INLIERS_MOTION, min_ratio * track.n_matches)


def track_motion(
    track: Track, previous: Track, T_cw: Matrix, local: LocalMap, context: Context
) -> Track:
    """Track a frame against the points of the previous frame. The points are matched near their
    projections with the predicted pose, and the pose is optimised.

    The points are the landmarks of the previous frame and its other close stereo points (the
    visual-odometry points of ORB-SLAM2).

    Args:
        track: the frame with its features.
        T_cw: ``(4, 4)`` predicted pose (world to camera).
        local: tells which landmarks are confirmed.

    Returns:
        The frame with its pose and its matches. ``n_inliers`` is 0 if too few points match.
    """
    found = track
    for widening in (1.0, 2.0, 4.0):
        window = widening * context.motion_window
        matched = _match_previous(track, previous, T_cw, context, window, 1.0)
        if matched.n_matches < MIN_INLIERS_MOTION:
            continue
        found = refine(matched, T_cw, local, context)
        if found.n_inliers >= MIN_INLIERS_MOTION:
            break
    return found


def track_sudden_motion(
    track: Track, previous: Track, T_cw: Matrix, local: LocalMap, context: Context
) -> Track:
    """Track a frame against the points of the previous frame, although the predicted pose is wrong.

    In a sudden turn, optimisation that starts at the predicted pose does not find the pose.
    Therefore, the pose is first estimated by P3P inside RANSAC. Arguments and result are those of
    ``track_motion``.
    """
    least = MIN_INLIERS_MOTION
    matched = _match_previous(track, previous, T_cw, context, _SUDDEN_WINDOW, _MATCH_RATIO)
    if matched.n_matches < least:
        return track
    feature = np.flatnonzero(np.isfinite(matched.xyz[:, 0]))
    T_sampled, inlier = sampled_pose(
        track.features, feature, matched.xyz[feature], context, min_inliers=least, seed=track.index
    )
    if np.count_nonzero(inlier) < least:
        return track
    return refine(matched.without(feature[~inlier]), T_sampled, local, context)


def sampled_pose(
    features: Features,
    chosen: NDArray[np.integer],
    points: NDArray[np.float64],
    context: Context,
    *,
    min_inliers: int,
    seed: int,
) -> tuple[Matrix, NDArray[np.bool_]]:
    """Estimate the pose of a frame from N matches by P3P inside RANSAC (``ransac_pose``).

    Args:
        chosen: ``(N,)`` indices of the matched features.
        points: ``(N, 3)`` points of the matches, in the world frame.
        min_inliers: least number of inliers of an acceptable pose.
        seed: seed of the random samples.

    Returns:
        The ``(4, 4)`` pose (world to camera), and an ``(N,)`` bool mask of the inliers. There may
        be fewer inliers than ``min_inliers``.
    """
    return ransac_pose(
        points,
        *observations(features, chosen, context),
        context.camera.intrinsics,
        np.uint64(seed),
        min_inliers,
        _MAX_DRAWS,
        _CONFIDENCE,
    )


def _match_previous(
    track: Track, previous: Track, T_cw: Matrix, context: Context, window: float, ratio: float
) -> Track:
    """Match the points of the previous frame near their projections.

    Args:
        window: search radius at octave 0, in pixels.
    """
    camera = context.camera
    points, source = trackable_points(previous, context)
    before = previous.features
    octave = before.octave[source].astype(np.int64)
    in_camera = transform(T_cw, points)
    ahead = in_camera[:, 2] > 0.1
    uvr = camera.project(np.where(ahead[:, None], in_camera, 1.0))
    advance = compose(previous.T_cw, inverse(T_cw))[2, 3]
    # If the camera has moved forwards by more than the baseline, the octave of a feature can only
    # rise. If it has moved backwards, the octave can only fall. A monocular camera has no baseline
    # to compare the motion with.
    low, high = octave - 1, octave + 1
    if advance > camera.baseline > 0.0:
        low, high = octave, np.full_like(octave, len(context.scales))
    elif advance < -camera.baseline < 0.0:
        low, high = np.zeros_like(octave), octave
    radius = np.where(ahead, window * context.scales[octave], 0.0)
    feature, point = _search(
        track.features,
        Projections(uvr, radius, low, high, before.descriptors[source].view(np.uint64)),
        np.ones(len(track.features), np.bool_),
        context,
        ratio,
    )
    keep = consistent_orientation(before.angle[source[point]], track.features.angle[feature])
    feature, point = feature[keep], point[keep]
    matched = track.without().matching(feature, previous.landmark[source[point]], points[point])
    return replace(matched, n_matches=len(feature))


def trackable_points(
    previous: Track, context: Context
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the points that a frame observed: its landmarks and its other close stereo points.

    Returns:
        ``(M, 3)`` points in the world frame, and ``(M,)`` indices of their features in the frame.
    """
    points = previous.xyz.copy()
    known = np.isfinite(points[:, 0])
    depth = feature_depth(previous.features, context.camera)
    close = ~known & (depth < context.close_depth) & (depth > 0)
    lifted = context.camera.backproject(previous.features.xy[close], depth[close])
    points[close] = transform(inverse(previous.T_cw), lifted)
    source = np.flatnonzero(known | close)
    return points[source], source


def match_descriptors(
    features: Features, local: LocalMap, max_distance: int, ratio: float
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Match features with landmarks, using only their descriptors (``search_all``).

    Returns:
        ``(M,)`` indices of the matched features, and ``(M,)`` indices of their landmarks in
        ``local``.
    """
    descriptors = features.descriptors.view(np.uint64)
    feature = search_all(local.descriptor, descriptors, max_distance, ratio)
    landmark = np.flatnonzero(feature >= 0)
    return feature[landmark], landmark


def track_descriptors(track: Track, reference: LocalMap, T_cw: Matrix, context: Context) -> Track:
    """Match landmarks using only their descriptors, without a predicted pose, and then optimise the
    pose.

    Args:
        track: the frame with its features.
        reference: the landmarks of the reference keyframe.
        T_cw: ``(4, 4)`` initial pose for the optimisation (world to camera).

    Returns:
        The frame with its pose and its matches. ``n_inliers`` is 0 if too few landmarks match.
    """
    feature, landmark = match_descriptors(
        track.features, reference, _REFERENCE_DISTANCE, _REFERENCE_RATIO
    )
    if len(feature) < MIN_INLIERS_LOST:
        return track
    points = reference.xyz[landmark]
    matched = track.without().matching(feature, reference.ids[landmark], points)
    found = refine(matched, T_cw, reference, context)
    T_sampled, inlier = sampled_pose(
        track.features,
        feature,
        points,
        context,
        min_inliers=max(found.n_inliers + 1, MIN_INLIERS_LOST),
        seed=track.index,
    )
    if np.count_nonzero(inlier) <= found.n_inliers:
        return found
    # The initial pose was so wrong that the pose of a moving object was nearer.
    return refine(matched.without(feature[~inlier]), T_sampled, reference, context)


def track_local_map(
    track: Track,
    local: LocalMap,
    context: Context,
    mask: Mask | None = None,
    window: float | None = None,
    patches: LandmarkPatches = NO_PATCHES,
) -> Track:
    """Match all landmarks of the local map that should be visible, align the matches to the image
    with sub-pixel accuracy, and optimise the pose.

    Args:
        track: the frame with a first pose. Its matches are kept.
        mask: the mask of the image; None uses all pixels.
        window: search radius at octave 0, pixels; None uses ``context.local_window``.
        patches: image patches of landmarks. Only the matches of these landmarks are aligned.
    """
    config, intrinsics = context.config, context.camera.intrinsics
    tracked = np.isin(local.ids, track.tracked)
    if window is None:
        window = context.local_window
    uvr, radius, octave = predict_landmarks(track.T_cw, local, window, mask, context)
    visible = radius > 0
    radius[tracked] = 0.0
    feature, landmark = _search(
        track.features,
        Projections(uvr, radius, octave - 1, octave, local.descriptor),
        track.landmark < 0,
        context,
        _MATCH_RATIO,
    )
    in_map = track.without(track.landmark < 0)  # without the points that are not in the map
    matched = in_map.matching(feature, local.ids[landmark], local.xyz[landmark])
    shift = align_matches(matched, patches, context.scales, intrinsics, config.alignment)
    found = refine(matched, track.T_cw, local, context, shift)
    return replace(found, n_matches=len(matched.tracked), visible=local.ids[visible | tracked])


def predict_landmarks(
    T_cw: Matrix,
    local: LocalMap,
    window: float,
    mask: Mask | None,
    context: Context,
) -> tuple[Matrix, Matrix, NDArray[np.int64]]:
    """Predict where the landmarks of a local map appear in the image (``predict_view``). Landmarks
    on masked pixels are marked as not visible."""
    camera = context.camera
    uvr, radius, octave = predict_view(
        T_cw,
        local.xyz,
        local.normal,
        local.distance_range,
        camera.intrinsics,
        camera.width,
        camera.height,
        context.scales,
        window,
    )
    if mask is not None:
        radius[~mask.shows(uvr[:, :2], octave)] = 0.0
    return uvr, radius, octave


def _search(
    features: Features,
    projections: Projections,
    free: NDArray[np.bool_],
    context: Context,
    ratio: float,
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Return the ``(M,)`` indices of the features that ``search_windows`` matches, and the ``(M,)``
    indices of their projections."""
    camera, max_distance = context.camera, _MATCH_DISTANCE
    searchable = Searchable.of_features(features, camera.width, camera.height)
    found, _ = search_windows(projections, searchable, free, max_distance, ratio)
    matched = np.flatnonzero(found >= 0)
    return found[matched], matched


def refine(
    track: Track,
    T_cw: Matrix,
    local: LocalMap,
    context: Context,
    shift: NDArray[np.float32] | None = None,
) -> Track:
    """Optimise the pose of a frame using all its matches, and drop the outliers.

    Args:
        T_cw: ``(4, 4)`` initial pose (world to camera).
        local: tells which landmarks are confirmed.
        shift: ``Track.shift`` of the matches; None if no match is aligned.
    """
    matched, track = np.flatnonzero(np.isfinite(track.xyz[:, 0])), replace(track, shift=shift)
    confirmed = local.confirms(track.landmark[matched])
    T_found, inlier = optimise_pose(
        T_cw,
        *observed_points(track, matched, context),
        trusted=trusted_landmarks(confirmed, track.xyz[matched], T_cw, context),
        confirmed=confirmed,
    )
    inliers = track.without(matched[~inlier])
    return replace(inliers, T_cw=T_found, n_inliers=int(np.count_nonzero(inlier)))


def judge(n_matches: int, n_inliers: int, context: Context) -> TrackingState:
    """Decide from the number of matches and of inliers whether the pose of a frame can be used."""
    config = context.config.tracking
    # The search windows of an RGB-D camera are wide, so that even a wrong pose has some inliers.
    share = _DEPTH_MIN_INLIER_RATIO if context.camera.depth else 0.0
    if n_inliers < MIN_INLIERS_LOST or n_inliers < share * n_matches:
        return TrackingState.LOST
    return TrackingState.WEAK if n_inliers < config.min_inliers else TrackingState.OK


def trusted_landmarks(
    confirmed: NDArray[np.bool_], xyz: Matrix, T_cw: Matrix, context: Context
) -> NDArray[np.bool_]:
    """Choose the landmarks that tell the pose of the camera from that of a moving object: confirmed
    close landmarks. Far landmarks agree with both. If there are few close ones, all confirmed
    landmarks are chosen.

    Args:
        confirmed: ``(N,)`` bool, see ``LocalMap``.
        xyz: ``(N, 3)`` positions in the world frame.
        T_cw: ``(4, 4)`` approximate pose (world to camera).
    """
    close = confirmed & (transform(T_cw, xyz)[:, 2] < context.close_depth)
    return close if np.count_nonzero(close) >= MIN_TRUSTED else confirmed


def uncertainty_of(
    track: Track, offset_sigma: float, context: Context
) -> tuple[Matrix, Matrix | None]:
    """Estimate the uncertainty of the pose and of the motion of a tracked frame.

    Args:
        offset_sigma: standard deviation of the disparity offset, pixels; 0 for cameras without one.

    Returns:
        Two matrices. The first is the ``(6, 6)`` covariance of the pose ``T_cw`` relative to the
        points that the frame tracks (``pose_covariance``). The second is the ``(6, 3)`` effect on
        the motion if the disparity offset is wrong by ``offset_sigma`` (``offset_effect``). It is
        None if ``offset_sigma`` is 0.
    """
    matched = np.flatnonzero(np.isfinite(track.xyz[:, 0]))
    observed = observed_points(track, matched, context)
    covariance, effect = pose_covariance(track.T_cw, *observed), None
    if offset_sigma > 0.0:
        effect = offset_sigma * offset_effect(track.T_cw, *observed[:4])
    return covariance, effect


def observed_points(
    track: Track, matched: NDArray[np.integer], context: Context
) -> tuple[NDArray[np.float64], ...]:
    """Return the arguments of ``optimise_pose`` that follow ``T_cw``, for the points that the
    features ``matched`` track. Aligned matches have their aligned positions."""
    uvr, weight = observations(track.features, matched, context)
    certainty = np.ones(len(matched))
    if track.shift is not None:
        shift = track.shift[matched]
        aligned = np.isfinite(shift[:, 0])
        uvr[aligned] += shift[aligned][:, [0, 1, 0]]
        certainty[aligned] = context.aligned_certainty
    disparity_weight = DISPARITY_WEIGHT / np.sqrt(certainty)
    intrinsics = context.camera.intrinsics
    return track.xyz[matched], uvr, weight * certainty, intrinsics, disparity_weight


def observations(
    features: Features, chosen: NDArray[np.integer], context: Context
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the observed image positions of N features of a frame, and their weights.

    Args:
        chosen: ``(N,)`` indices of the features.

    Returns:
        ``(N, 3)`` float64 u, v and u_right in pixels, and ``(N,)`` float64 inverse variances of u
        and v.
    """
    uvr = stack_uvr(features.xy[chosen], features.u_right[chosen])
    return uvr, context.scales[features.octave[chosen]] ** -2.0
