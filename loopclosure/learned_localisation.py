"""Estimates the pose of an image at a place in the map, using learned local descriptors.

Landmarks of the place are searched for everywhere in the image, not only at its keypoints. The
reason is that at night or in a different lane, the corner detector finds different points. If one
keyframe of the place does not give enough matches, further keyframes of the place are matched as
well.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.frontend.pnp import ransac_pose
from vslam.frontend.pose import optimise_pose, pose_covariance
from vslam.loopclosure.local_matching import (
    GUIDED_REACH,
    MIN_COARSE_SIMILARITY,
    MIN_FINE_SIMILARITY,
    REACH,
    DescriptorMaps,
    homography_share,
    locate,
    locate_near,
    match_coarse,
)
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.types.camera import Camera
from vslam.types.geometry import Matrix, transform
from vslam.types.map import Map
from vslam.types.reprojection import stack_uvr

# Upper bound of the number of keyframes that are matched at each place. [own]
_VIEWS = 2
# At least this fraction of the cells of the network's coarse feature map must agree with one
# homography. [own]
_MIN_SHARE = 0.1
# Standard deviation of the position of a match, in pixels of the network's input image. With a
# larger value, matches with larger errors count as inliers. [own]
SIGMA = 1.5
# Upper bound of the number of RANSAC draws. [own]
_MAX_DRAWS = 1000
# The probability with which RANSAC must draw at least one sample without outliers. [own]
_CONFIDENCE = 0.99
# RANSAC must find at least this many inliers. [own]
_MIN_CONSENSUS = 40
# At least this fraction of the landmarks that are searched for must be inliers of RANSAC. [own]
_MIN_CONSENSUS_RATIO = 0.15


class View(NamedTuple):
    """The local descriptors and the landmarks of one keyframe.

    Attributes:
        maps: local descriptors of the keyframe's image.
        landmarks: ``(N,)`` ids of the landmarks that the keyframe observes.
        xy: ``(N, 2)`` positions of these landmarks in the keyframe's image, pixels.
    """

    maps: DescriptorMaps
    landmarks: NDArray[np.int32]
    xy: NDArray[np.float32]


class PoseEstimate(NamedTuple):
    """An estimated camera pose at a place, and the landmarks that should be visible from there.

    Attributes:
        landmarks: ``(M,)`` int32 ids of the landmarks that should be visible.
        uv: ``(M, 2)`` float64 predicted positions of these landmarks in the image, pixels.
        seen: ``(M,)`` bool, True for landmarks that were found at their predicted positions.
        n_matches: number of landmarks that were matched near their predicted positions, including
            outliers.
        T_cw: ``(4, 4)`` pose of the camera (world to camera), in the world frame of the landmarks.
        covariance: ``(6, 6)`` covariance of the error of this pose (``LoopEdge.covariance``).
    """

    landmarks: NDArray[np.int32]
    uv: Matrix
    seen: NDArray[np.bool_]
    n_matches: int
    T_cw: Matrix
    covariance: Matrix


def localise(
    map_: Map,
    query: DescriptorMaps,
    keyframes: list[int],
    images: KeyframeImages,
    camera: Camera,
    seed: int,
) -> PoseEstimate | str:
    """Estimate the pose of an image at a place of the map, using learned local descriptors.

    Args:
        query: local descriptors of the image.
        keyframes: ids of the keyframes of the place whose images are stored, most similar first.
        seed: seed of the random samples; the same seed gives the same result.

    Returns:
        The pose and the landmarks, or a short explanation of why no pose was found.
    """
    views: list[View] = []
    xyz, uv = np.empty((0, 3)), np.empty((0, 2))
    n_searched, reason = 0, ""
    for keyframe in keyframes[:_VIEWS]:
        view = view_of(map_, keyframe, images)
        coarse = match_coarse(view.maps, query, MIN_COARSE_SIMILARITY)
        share = homography_share(coarse, view.maps, query)
        if share < _MIN_SHARE:
            return reason or f"only {100 * share:.0f} % of the image matches"
        views.append(view)
        n_searched += len(view.xy)
        min_inliers = max(_MIN_CONSENSUS, round(_MIN_CONSENSUS_RATIO * n_searched))
        located = locate(view.xy, view.maps, query, coarse, REACH, MIN_FINE_SIMILARITY)
        found = located.found
        xyz = np.vstack([xyz, map_.arrays.xyz[view.landmarks[found]]])
        uv = np.vstack([uv, located.xy[found]])
        T_cw, inlier = ransac_pose(
            xyz,
            *_observed(uv, query),
            camera.intrinsics,
            np.uint64(seed),
            min_inliers,
            _MAX_DRAWS,
            _CONFIDENCE,
        )
        if np.count_nonzero(inlier) >= min_inliers:
            return guided_search(map_, views, T_cw, query, camera)
        reason = f"no pose has {min_inliers} inliers among {len(uv)} learned matches"
    return reason or "no image of the place is stored"


def view_of(map_: Map, keyframe: int, images: KeyframeImages) -> View:
    a, rows = map_.arrays, map_.rows(keyframe)
    landmark = a.landmark[rows]
    observing = np.flatnonzero(landmark >= 0)
    return View(images.maps(keyframe), landmark[observing], a.xy[rows][observing])


def guided_search(
    map_: Map,
    views: list[View],
    T_cw: Matrix,
    query: DescriptorMaps,
    camera: Camera,
) -> PoseEstimate:
    """Refine the pose of an image. The landmarks of ``views`` are searched for near their
    projections, and the pose is optimised with all matches. Both steps are done twice."""
    _, first = np.unique(np.concatenate([view.landmarks for view in views]), return_index=True)
    landmarks = np.concatenate([view.landmarks for view in views])[first]
    xyz = map_.arrays.xyz[landmarks]
    for _ in range(2):
        expected = project(xyz, T_cw, camera)
        found = np.full((len(first), 2), np.nan)
        start = 0
        for view in views:
            chosen = np.flatnonzero((first >= start) & (first < start + len(view.landmarks)))
            xy = view.xy[first[chosen] - start]
            least, reach = MIN_FINE_SIMILARITY, GUIDED_REACH
            found[chosen] = locate_near(xy, expected[chosen], view.maps, query, reach, least).xy
            start += len(view.landmarks)
        hit = np.flatnonzero(np.isfinite(found[:, 0]))
        observed = _observed(found[hit], query)
        T_cw, inlier = optimise_pose(T_cw, xyz[hit], *observed, camera.intrinsics)
    hit = hit[inlier]
    seen = np.zeros(len(landmarks), np.bool_)
    seen[hit] = True
    observed = observed[0][inlier], observed[1][inlier]
    return estimate_at(T_cw, map_, landmarks, seen, len(inlier), xyz[hit], observed, camera)


def estimate_at(
    T_cw: Matrix,
    map_: Map,
    landmarks: NDArray[np.int32],
    seen: NDArray[np.bool_],
    n_matches: int,
    xyz: Matrix,
    observed: tuple[Matrix, Matrix],
    camera: Camera,
) -> PoseEstimate:
    """Return the estimate whose pose was optimised with some observations.

    Args:
        T_cw: ``(4, 4)`` optimised pose (world to camera).
        landmarks, seen, n_matches: see ``PoseEstimate``. Landmarks outside the image are left out.
        xyz, observed: ``(N, 3)`` positions of the inliers in the world frame, and their
            observations, from ``observations``.
    """
    covariance = pose_covariance(
        T_cw, xyz, *observed, camera.intrinsics, np.full(len(xyz), camera.intrinsics[5])
    )
    expected = project(map_.arrays.xyz[landmarks], T_cw, camera)
    visible = np.flatnonzero(np.isfinite(expected[:, 0]))
    return PoseEstimate(
        landmarks[visible], expected[visible], seen[visible], n_matches, T_cw, covariance
    )


def project(xyz: Matrix, T_cw: Matrix, camera: Camera) -> Matrix:
    """Project ``(N, 3)`` points in the world frame to ``(N, 2)`` pixels. Points outside the image
    become NaN."""
    p = transform(T_cw, xyz)
    uv = np.full((len(p), 2), np.nan)
    ahead = p[:, 2] > 0.1
    uv[ahead] = camera.project(p[ahead])[:, :2]
    inside = (uv >= 0).all(1) & (uv <= [camera.width - 1, camera.height - 1]).all(1)
    uv[~inside] = np.nan
    return uv


def _observed(uv: Matrix, query: DescriptorMaps) -> tuple[Matrix, Matrix]:
    return observations(uv, SIGMA / query.scale)


def observations(uv: Matrix, sigma: float) -> tuple[Matrix, Matrix]:
    """Convert ``(N, 2)`` pixels to monocular observations.

    Args:
        sigma: standard deviation of u and v, in pixels.

    Returns:
        ``(N, 3)`` u, v, u_right, where u_right is NaN, and ``(N,)`` inverse variances of u and v.
    """
    return stack_uvr(uv, np.full(len(uv), np.nan)), np.full(len(uv), sigma**-2.0)
