"""Converts the depths of keypoints to columns in the right image of a virtual stereo pair (section
III-A of the ORB-SLAM2 paper)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.config import DepthConfig
from vslam.support.kernels import kernel
from vslam.types.camera import Camera


def columns_of_depth(
    xy: NDArray[np.float32],
    scale: NDArray[np.float64],
    depth: NDArray[np.float32],
    camera: Camera,
    config: DepthConfig,
) -> NDArray[np.float32]:
    """Compute the column that each keypoint would have in the right image of a virtual stereo pair,
    in pixels.

    A keypoint at column u with depth d gets the column ``u - fx b / d``. A constant error in pixels
    then corresponds to a depth error that grows with the square of the depth. Structured-light
    cameras have such errors.

    Keypoints at a depth discontinuity get no column. Where the contour of a near object crosses the
    background, a corner is not a point of the scene. It slides along the contour as the camera
    moves.

    Args:
        xy: ``(N, 2)`` keypoints of the left image, pixels.
        scale: ``(N,)`` full-resolution pixels per pixel of the keypoint's octave.
        depth: ``(H, W)`` metres along the z axis of the left camera, 0 where unknown. The depth
            image is registered to the left image.

    Returns:
        ``(N,)`` float32, NaN where the depth is unknown, out of range, or discontinuous around the
        keypoint.
    """
    radius = np.rint(config.edge_radius * scale).astype(np.int64)
    d = depth_around(xy, radius, np.ascontiguousarray(depth), 1.0 + config.edge_ratio)
    known = (d >= config.min_metres) & (d <= config.max_metres)
    u_right = np.full(len(xy), np.nan, np.float32)
    u_right[known] = xy[known, 0] - np.float32(camera.bf) / d[known]
    return u_right


@kernel
def depth_around(xy, radius, depth, max_ratio):
    """Look up the depth of each keypoint, in metres, at the nearest pixel of the depth image.

    Args:
        radius: ``(N,)`` int64, half width of the neighbourhood that is checked, pixels.
        max_ratio: largest accepted ratio of the farthest to the nearest known depth in the
            neighbourhood.

    Returns:
        ``(N,)`` float32 depths; 0 where the depth is unknown or the ratio is exceeded.
    """
    height, width = depth.shape
    found = np.zeros(len(xy), np.float32)
    for i in range(len(xy)):
        column = min(int(np.rint(xy[i, 0])), width - 1)
        row = min(int(np.rint(xy[i, 1])), height - 1)
        middle = depth[row, column]
        if not middle > 0.0:  # also true for NaN
            continue
        nearest, farthest, r = middle, middle, radius[i]
        for y in range(max(row - r, 0), min(row + r + 1, height)):
            for x in range(max(column - r, 0), min(column + r + 1, width)):
                z = depth[y, x]
                if z > 0.0:
                    nearest, farthest = min(nearest, z), max(farthest, z)
        if farthest <= max_ratio * nearest:
            found[i] = middle
    return found
