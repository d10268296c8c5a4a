"""Adjusts the two views that a monocular map starts from, and defines its unit of length.

Two views determine the direction of a translation but not its length. So the unit of length is
chosen such that the median depth of the landmarks is ``initialization.median_depth``. With the
value 15, a unit is roughly a metre in a street, so that thresholds of the configuration in metres
are of the right order of magnitude; it is not a metric scale.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.backend.bundle_adjustment import BundleProblem, adjust
from vslam.camera import Camera
from vslam.geometry import Matrix
from vslam.reprojection import stack_uvr

ITERATIONS = 20


def adjust_two_views(
    T_2_1: Matrix, points: Matrix, uv: Matrix, sigma: Matrix, camera: Camera, depth: float
) -> tuple[Matrix, Matrix, NDArray[np.bool_]]:
    """Bundle adjustment of two views, scaled to a median depth.

    Args:
        T_2_1: ``(4, 4)`` initial transform from camera 1 to camera 2.
        points: ``(N, 3)`` initial points in the frame of camera 1.
        uv: ``(N, 2, 2)`` pixels of each point in view 1 and in view 2.
        sigma: ``(N,)`` standard deviation of these pixels, pixels.
        depth: median depth that the kept points are to have in view 1.

    Returns:
        ``(4, 4)`` ``T_2_1``, ``(N, 3)`` points in the frame of camera 1, and ``(N,)`` bool, points
        that are inliers in both views.
    """
    n = len(points)
    uvr = stack_uvr(uv.reshape(2 * n, 2), np.full(2 * n, np.nan))
    problem = BundleProblem(
        T_cw=np.stack([T_2_1, np.eye(4)]),
        n_free=1,
        points=points,
        first=np.arange(0, 2 * n + 1, 2, dtype=np.int64),
        camera=np.tile(np.array([1, 0], np.int64), n),
        uvr=uvr,
        inverse_sigma2=np.repeat(sigma**-2.0, 2),
        intrinsics=camera.intrinsics,
    )
    solution = adjust(problem, iterations=ITERATIONS)
    kept = np.logical_and(solution.inlier[0::2], solution.inlier[1::2])
    T_2_1, points = solution.T_cw[0].copy(), solution.points
    if kept.any():
        scale = depth / float(np.median(points[kept, 2]))
        T_2_1[:3, 3] *= scale
        points = points * scale
    return T_2_1, points, kept
