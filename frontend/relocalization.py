"""Finds the pose of a lost camera in the map (ORB-SLAM, T-RO 2015, V-C)."""

from __future__ import annotations

import numpy as np

from vslam.frontend.frame import Frame
from vslam.frontend.matching import count_elsewhere, search_all
from vslam.frontend.pnp import ransac_pose
from vslam.frontend.tracking import TrackingContext, observations, refine, track_local_map
from vslam.map_view import LocalMap


def relocalise(
    frame: Frame, place: LocalMap, surroundings: LocalMap, context: TrackingContext, seed: int
) -> int:
    """Find the pose of a frame, without any prediction, at a place that it resembles.

    Its descriptors are matched with the landmarks of the place, and P3P inside RANSAC, which needs
    no stereo, estimates a pose. Then all landmarks of the surroundings are searched for near their
    projections, first in a wide window, then in the usual one.

    Args:
        frame: receives its pose and its landmarks on success; otherwise both are reset.
        place: the landmarks of a candidate keyframe.
        surroundings: the landmarks of the candidate and its covisible keyframes.
        seed: seed of the random samples; the same seed gives the same result.

    Returns:
        Number of inliers, at least ``relocalization.min_inliers`` and not all on one object
        (``count_elsewhere``); 0 if the frame was not found.
    """
    inliers = _locate(frame, place, surroundings, context, seed)
    config = context.config.relocalization
    elsewhere = count_elsewhere(frame.features.xy[frame.landmark >= 0, 0], context.camera.width)
    if inliers >= config.min_inliers and elsewhere >= config.min_elsewhere:
        return inliers
    frame.T_cw = np.eye(4)
    frame.landmark[:] = -1
    frame.xyz[:] = np.nan
    return 0


def _locate(
    frame: Frame, place: LocalMap, surroundings: LocalMap, context: TrackingContext, seed: int
) -> int:
    config = context.config.relocalization
    found = search_all(
        place.descriptor,
        frame.features.descriptors.view(np.uint64),
        config.match_distance,
        config.match_ratio,
    )
    hit = np.flatnonzero(found >= 0)
    if len(hit) < config.min_matches:
        return 0
    feature = found[hit]
    T_camera_w, inlier = ransac_pose(
        place.xyz[hit],
        *observations(frame, feature, context),
        context.camera.intrinsics,
        np.uint64(seed),
        config.min_consensus,
        config.max_draws,
        config.confidence,
    )
    if np.count_nonzero(inlier) < config.min_consensus:
        return 0
    frame.landmark[:] = -1
    frame.xyz[:] = np.nan
    frame.landmark[feature[inlier]] = place.ids[hit[inlier]]
    frame.xyz[feature[inlier]] = place.xyz[hit[inlier]]
    frame.set_camera_pose(T_camera_w)
    inliers = refine(frame, frame.T_cw, context)
    for window in (config.first_window, context.config.tracking.local_window):
        if inliers < config.min_consensus:
            return 0
        _, inliers, _ = track_local_map(frame, surroundings, context, window)
    return inliers
