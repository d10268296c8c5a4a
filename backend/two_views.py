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
    n = len(points)
    problem = BundleProblem(
        T_cw=np.stack([T_2_1, np.eye(4)]),
        n_free=1,
        points=points,
        first=np.arange(0, 2 * n + 1, 2, dtype=np.int64),
        camera=np.tile(np.array([1, 0], np.int64), n),
        uvr=stack_uvr(uv.reshape(2 * n, 2), np.full(2 * n, np.nan)),
        inverse_sigma2=np.repeat(sigma**-2.0, 2),
        intrinsics=camera.intrinsics,
    )
    solution = adjust(problem, iterations=ITERATIONS)
    inlier = np.logical_and(solution.inlier[0::2], solution.inlier[1::2])
    T_2_1, points = solution.T_cw[0].copy(), solution.points
    if inlier.any():
        scale = depth / float(np.median(points[inlier, 2]))
        T_2_1[:3, 3] *= scale
        points = points * scale
    return T_2_1, points, inlier
