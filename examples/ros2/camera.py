"""Makes the camera of a rectified stereo pair from ``sensor_msgs/CameraInfo``, and its pose on the
robot from a parameter, without ROS."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vslam import Camera
from vslam.support.errors import InputError

LOOKS_AHEAD = [0.0, 0.0, 0.0, -0.5, 0.5, -0.5, 0.5]
"""The parameter ``base_to_camera`` of a camera at the origin of ``base_link`` that looks ahead."""


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


def pose_of(numbers: Sequence[float]) -> NDArray[np.float64]:
    """Return the ``(4, 4)`` transformation from the camera to ``base_link``.

    Args:
        numbers: x, y, z in metres, and the quaternion x, y, z, w, as ``tf2_echo base_link CAMERA``
            prints them.

    Raises:
        InputError: these are not seven numbers, or the quaternion does not have length 1.
    """
    if len(numbers) != 7 or not abs(np.linalg.norm(numbers[3:]) - 1.0) < 0.01:
        raise InputError(
            f"base_to_camera {list(numbers)}: give x, y, z and a quaternion x, y, z, w of length 1."
        )
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(numbers[3:]).as_matrix()
    T[:3, 3] = numbers[:3]
    return T
