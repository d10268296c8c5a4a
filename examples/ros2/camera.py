"""Makes the camera of a rectified stereo pair from ``sensor_msgs/CameraInfo``, without ROS."""

from __future__ import annotations

from typing import Any

import numpy as np

from vslam import Camera


def camera_of(left: Any, right: Any) -> Camera:
    """Return the camera of a rectified stereo pair, from the matrices P of its ``camera_info``.

    Args:
        left, right: ``sensor_msgs/CameraInfo``.

    Raises:
        ValueError: the cameras are not calibrated, or the pair is not rectified.
    """
    P_left, P_right = (np.reshape(info.p, (3, 4)).astype(float) for info in (left, right))
    if not P_left[0, 0]:
        raise ValueError("P of the left camera_info is zero; calibrate the camera")
    if (left.width, left.height) != (right.width, right.height):
        raise ValueError("the two cameras have images of different sizes; rectify them")
    if not np.allclose(P_left[:, :3], P_right[:, :3]):
        raise ValueError("P of the two cameras differs; rectify them with one principal point")
    baseline = -P_right[0, 3] / P_right[0, 0]
    if not baseline > 0:
        raise ValueError(f"the baseline is {baseline:.3f} m; is the left camera the right one?")
    return Camera(
        fx=P_left[0, 0],
        fy=P_left[1, 1],
        cx=P_left[0, 2],
        cy=P_left[1, 2],
        baseline=baseline,
        width=left.width,
        height=left.height,
    )
