"""Depth images as the second view of a stereo pair (ORB-SLAM2, section III-A)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
from vslam.config import DepthConfig
from vslam.kernels import kernel


def columns_of_depth(
    xy: NDArray[np.float32],
    scale: NDArray[np.float64],
    depth: NDArray[np.float32],
    camera: Camera,
    config: DepthConfig,
) -> NDArray[np.float32]:
    """Column that each keypoint would have in the right camera of a virtual stereo pair.

    With the depth d of the nearest pixel it is ``u - fx b / d``. A pixel of it then stands for an
    error of depth that grows with its square, as that of structured light does.

    A corner at an edge of depth has two depths, and where the contour of something near crosses
    what is behind it, it is no point of the scene at all but slides along as the camera moves.
    Block matching of a stereo pair refuses most of these; here they are left without a column.

    Args:
        xy: ``(N, 2)`` keypoints of the left image.
        scale: ``(N,)`` pixels that one of the keypoint's octave takes.
        depth: ``(H, W)`` metres along the left camera's z, registered to it; 0 is unknown.

    Returns:
        ``(N,)`` float32, NaN where the depth is unknown, beyond its limits, or not one around the
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
    """``(N,)`` float32 depth of each keypoint's pixel, 0 where known depths around it differ by
    more than the ratio; ``radius`` ``(N,)`` int64 pixels to each side."""
    height, width = depth.shape
    found = np.zeros(len(xy), np.float32)
    for i in range(len(xy)):
        column = min(int(np.rint(xy[i, 0])), width - 1)
        row = min(int(np.rint(xy[i, 1])), height - 1)
        middle = depth[row, column]
        if not middle > 0.0:  # NaN, too
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
