"""The beginning of a monocular map: two keyframes, their landmarks, and the unit of length.

Two views tell the direction of a motion and not its length. The unit is chosen so that the median
landmark is ``initialization.median_depth`` units away. With 15 of them a unit is roughly a metre
in a street, which keeps what else is in metres in the configuration in proportion; nothing more
is meant by it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.backend.bundle_adjustment import BundleProblem, adjust
from vslam.camera import Camera
from vslam.features import Features
from vslam.geometry import Matrix, compose, inverse, transform
from vslam.map import Map
from vslam.map_kernels import link_many, refresh_landmarks
from vslam.reprojection import stack_uvr

ITERATIONS = 20


def adjust_two_views(
    T_2_1: Matrix, points: Matrix, uv: Matrix, sigma: Matrix, camera: Camera, depth: float
) -> tuple[Matrix, Matrix, NDArray[np.bool_]]:
    """Bundle adjustment of two views, scaled to a median depth.

    Args:
        T_2_1: ``(4, 4)`` start.
        points: ``(N, 3)`` in camera 1, start.
        uv: ``(N, 2, 2)`` pixels of each point in view 1 and in view 2.
        sigma: ``(N,)`` their standard deviation, pixels.
        depth: median depth in view 1 of the points that are kept.

    Returns:
        ``T_2_1``, points, and ``(N,)`` bool: those that fit both views.
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


def map_two_views(
    map_: Map,
    features: tuple[Features, Features],
    matches: tuple[NDArray[np.int64], NDArray[np.int64]],
    T_1_w: Matrix,
    T_2_1: Matrix,
    points: Matrix,
    timestamps: tuple[float, float],
    frames: tuple[int, int],
) -> tuple[int, int]:
    """Add two keyframes and what both of them see to the map.

    Args:
        features: of both views; matches: ``(N,)`` features of each that see the same point.
        T_1_w: where the map puts the first view.
        T_2_1, points: result of ``adjust_two_views``; ``(N, 3)`` in camera 1.
        timestamps, frames: seconds and frame index of both.

    Returns:
        The ids of both keyframes.
    """
    first = map_.add_keyframe(features[0], T_1_w, timestamps[0], frames[0])
    second = map_.add_keyframe(features[1], compose(T_2_1, T_1_w), timestamps[1], frames[1])
    xyz = transform(inverse(T_1_w), points)
    rows = [map_.rows(k).start + match for k, match in zip((first, second), matches, strict=True)]
    ids = map_.add_landmarks(xyz, map_.arrays.descriptor[rows[1]], first)
    for of_view in rows:
        link_many(map_.arrays, of_view, ids)
    refresh_landmarks(map_.arrays, ids, map_.scales)
    return first, second
