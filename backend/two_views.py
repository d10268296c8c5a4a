"""Adjusts the first two views of a monocular map, and defines the unit of length of the map.

Two views determine the direction of a translation, but not its length. The unit of length is
therefore chosen such that the median depth of the landmarks is ``initialization.median_depth``.
With the default of 15, a unit is roughly a metre in a street. Thresholds that the configuration
gives in metres then have the right order of magnitude. The true scale remains unknown.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.backend.bundle_adjustment import BundleProblem, adjust
from vslam.types.camera import Camera
from vslam.types.geometry import Matrix
from vslam.types.reprojection import stack_uvr

ITERATIONS = 20


def adjust_two_views(
    T_2_1: Matrix, points: Matrix, uv: Matrix, sigma: Matrix, camera: Camera, depth: float
) -> tuple[Matrix, Matrix, NDArray[np.bool_]]:
    """Run bundle adjustment of two views, and scale the result to a given median depth.

    Args:
        T_2_1: ``(4, 4)`` initial transform from camera 1 to camera 2.
        points: ``(N, 3)`` initial points in the frame of camera 1.
        uv: ``(N, 2, 2)`` position of each point in view 1 and in view 2, pixels.
        sigma: ``(N,)`` standard deviation of these positions, pixels.
        depth: median depth of the inliers in view 1 after scaling, in units of the map.

    Returns:
        ``(4, 4)`` ``T_2_1``; ``(N, 3)`` points in the frame of camera 1; ``(N,)`` bool, True for
        points that are inliers in both views.
    """
    T_c_1, points, inlier = adjust_views(
        np.stack([np.eye(4), T_2_1]), points, uv.swapaxes(0, 1), np.tile(sigma, (2, 1)), camera
    )
    both = np.logical_and(inlier[0], inlier[1])
    return *scaled(T_c_1[1], points, both, depth), both


def adjust_views(
    T_c_1: Matrix, points: Matrix, uv: Matrix, sigma: Matrix, camera: Camera
) -> tuple[Matrix, Matrix, NDArray[np.bool_]]:
    """Run bundle adjustment of K views. The unit of length of the result is arbitrary.

    Args:
        T_c_1: ``(K, 4, 4)`` initial transforms from camera 1 to each camera. The first one is the
            identity, and stays fixed.
        points: ``(N, 3)`` initial points in the frame of camera 1.
        uv: ``(K, N, 2)`` position of each point in each view, pixels; NaN where it is not seen.
        sigma: ``(K, N)`` standard deviation of these positions, pixels.

    Returns:
        ``(K, 4, 4)`` transforms; ``(N, 3)`` points; ``(K, N)`` bool, True for observations that
        are inliers.
    """
    seen = np.isfinite(uv[..., 0])
    point, view = np.nonzero(seen.T)
    n_views, first = len(T_c_1), np.append(0, np.cumsum(seen.sum(axis=0)))
    observed = uv[view, point]
    problem = BundleProblem(
        T_cw=np.roll(T_c_1, -1, axis=0),  # the fixed camera is the last
        n_free=n_views - 1,
        points=points,
        first=first,
        camera=(view - 1) % n_views,
        uvr=stack_uvr(observed, np.full(len(observed), np.nan)),
        inverse_sigma2=sigma[view, point] ** -2.0,
        intrinsics=camera.intrinsics,
    )
    solution = adjust(problem, iterations=ITERATIONS)
    inlier = np.zeros(seen.shape, np.bool_)
    inlier[view, point] = solution.inlier
    return np.roll(solution.T_cw, 1, axis=0), solution.points, inlier


def scaled(
    T_2_1: Matrix, points: Matrix, inlier: NDArray[np.bool_], depth: float
) -> tuple[Matrix, Matrix]:
    """Scale a motion and ``(N, 3)`` points to a median depth of the inliers."""
    if not inlier.any():
        return T_2_1, points
    scale, T_2_1 = depth / float(np.median(points[inlier, 2])), T_2_1.copy()
    T_2_1[:3, 3] *= scale
    return T_2_1, scale * points
