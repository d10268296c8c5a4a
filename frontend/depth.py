"""Depth images as the second view of a stereo pair (ORB-SLAM2, section III-A)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
from vslam.config import DepthConfig


def columns_of_depth(
    xy: NDArray[np.float32], depth: NDArray[np.float32], camera: Camera, config: DepthConfig
) -> NDArray[np.float32]:
    """Column that each keypoint would have in the right camera of a virtual stereo pair.

    With the depth d of the nearest pixel it is ``u - fx b / d``. A pixel of it then stands for an
    error of depth that grows with its square, as that of structured light does.

    Args:
        xy: ``(N, 2)`` keypoints of the left image.
        depth: ``(H, W)`` metres along the left camera's z, registered to it; 0 is unknown.

    Returns:
        ``(N,)`` float32, NaN where the depth is unknown or beyond its limits.
    """
    column = np.minimum(np.rint(xy[:, 0]).astype(np.int64), camera.width - 1)
    row = np.minimum(np.rint(xy[:, 1]).astype(np.int64), camera.height - 1)
    d = depth[row, column]
    known = (d >= config.min_metres) & (d <= config.max_metres)  # false for NaN
    u_right = np.full(len(xy), np.nan, np.float32)
    u_right[known] = xy[known, 0] - np.float32(camera.bf) / d[known]
    return u_right
