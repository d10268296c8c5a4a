"""Image velocities of points in a rectified stereo pair whose right camera exposes later.

The velocities follow Longuet-Higgins and Prazdny (Proc. R. Soc. B, 1980), eq. 2.9 to 2.11, for the
point (x z, y z, z) in the frame of the left camera. The paper uses the motion of the camera. Here,
the twist [v, w] is the motion of the points relative to the camera, so all signs are reversed. In
the right camera, x is smaller by the baseline divided by z.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.types.camera import Camera
from vslam.types.features import MIN_DISPARITY, shifted_columns
from vslam.types.geometry import Matrix

_ROUNDS = 3  # rounds of a fixed-point iteration: speed and disparity depend on each other


def rays(
    xy: NDArray[np.float32], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ``(N,)`` normalised image coordinates x and y of ``(N, 2)`` pixels."""
    u, v = xy.astype(np.float64).T
    return (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy


def column_speeds(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    inverse_depth: NDArray[np.float64],
    baseline: float,
) -> NDArray[np.float64]:
    """Return ``(N, 6)`` derivatives of column velocities in the right image by the twist.

    They are given in focal lengths.
    """
    zero, right = np.zeros_like(x), x - baseline * inverse_depth
    return np.column_stack(
        [inverse_depth, zero, -right * inverse_depth, -right * y, 1.0 + right * x, -y]
    )


def columns_without_delay(
    xy: NDArray[np.float32],
    u_right: NDArray[np.float32],
    twist: Matrix,
    delay: float,
    camera: Camera,
) -> NDArray[np.float32]:
    """Compute the columns that stereo matches would have without the delay of the right image.

    Args:
        xy: ``(N, 2)`` pixels in the left image.
        u_right: ``(N,)`` columns of the stereo matches in the right image. NaN stays NaN.
        twist: ``(6,)`` twist of the points relative to the camera, per second.

    Returns:
        ``(N,)`` columns of the matches if the right image had been taken ``delay`` seconds earlier.
    """
    x, y = rays(xy, camera)
    measured = xy[:, 0].astype(np.float64) - u_right
    disparity = measured
    for _ in range(_ROUNDS):
        inverse_depth = np.maximum(disparity, MIN_DISPARITY) / camera.bf
        speed = camera.fx * column_speeds(x, y, inverse_depth, camera.baseline) @ twist
        disparity = measured + delay * speed
    return shifted_columns(u_right, xy[:, 0], disparity - measured)
