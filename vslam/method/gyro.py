"""The rotation of the camera from its gyroscope alone, while gravity is not known.

It needs only the bias of the gyroscope, which each tracked frame measures by its rotation. The
measurements are averaged by their variances. If one contradicts the others, all are forgotten, so
that an IMU that is mounted differently than its calibration says does no harm.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vslam.backend.inertial_start import GYRO_BIAS
from vslam.backend.preintegration import Preintegration, preintegrate, so3_log
from vslam.frontend.initialization import KnownTurn
from vslam.types.geometry import Matrix
from vslam.types.imu import ImuCalibration, Inertia

LONGEST_GAP = 0.1  # s without a sample, above which samples do not tell the motion
# Standard deviations of a measured bias along each axis: because of the rotations of two poses
# (rad, divided by the time between them), of the time of the samples (rad/s), and of misaligned
# axes, as a share of the rate.
_POSES, _TIMES, _AXES = 0.0014, 0.02, 0.02
_CONTRADICTION = 16.3  # chi-square of three degrees of freedom, 0.001
# The gyroscope is used if the standard deviation of the bias is at most this one, in rad/s, which
# takes five frames, and lets the rotation err by at most 0.5 degrees.
_CERTAIN, _MOST_RAD = 0.012, np.radians(0.5)
_LEAST_TOLERANCE = 0.01  # rad, of the rotation of a motion that two views gave
_LEAST = 0.005  # rad/s: the bias is never considered more certain


def turn_by_gyro(
    inertia: Inertia, start: float, end: float, calibration: ImuCalibration
) -> Matrix | None:
    """Return the ``(3, 3)`` rotation that maps directions of the camera at one time to the camera
    at a later time. None if it is not certain, or samples are missing.

    Args:
        start, end: seconds.
    """
    sigma = inertia.gyro_sigma
    if not 0.0 <= sigma <= min(_CERTAIN, _MOST_RAD / (end - start)):
        return None
    motion = _motion(inertia, start, end, calibration)
    if motion is None:
        return None
    R = calibration.T_imu_camera[:3, :3]
    turn: Matrix = R.T @ motion.rotation.T @ R
    return turn


def turn_of_start(
    inertia: Inertia, start: float, end: float, calibration: ImuCalibration
) -> KnownTurn | None:
    """Return the rotation of the camera between the first two views of a map, also if the bias is
    not known yet. None if samples are missing.

    Args:
        start, end: seconds.
    """
    motion = _motion(inertia, start, end, calibration)
    if motion is None:
        return None
    R = calibration.T_imu_camera[:3, :3]
    sigma = GYRO_BIAS if inertia.gyro_sigma < 0.0 else 3.0 * inertia.gyro_sigma
    return KnownTurn(R.T @ motion.rotation.T @ R, _LEAST_TOLERANCE + sigma * (end - start))


def with_turn(
    inertia: Inertia, start: float, end: float, R_now_last: Matrix, calibration: ImuCalibration
) -> Inertia:
    """Learn the bias of the gyroscope from the rotation between two tracked frames.

    Args:
        start, end: times of the frames, in seconds.
        R_now_last: ``(3, 3)``, maps directions of the camera at ``start`` to the camera at ``end``.
    """
    motion, seconds = _motion(inertia, start, end, calibration), end - start
    if motion is None:
        return inertia
    R = calibration.T_imu_camera[:3, :3]
    rotation = R @ R_now_last.T @ R.T  # of the IMU
    missing = so3_log(np.ascontiguousarray(motion.rotation.T @ rotation)) / -seconds
    rate = float(np.linalg.norm(so3_log(np.ascontiguousarray(rotation)))) / seconds
    measured = (_POSES / seconds) ** 2 + _TIMES**2 + (_AXES * rate) ** 2
    known = (GYRO_BIAS if inertia.gyro_sigma < 0.0 else inertia.gyro_sigma) ** 2
    if not missing @ missing <= _CONTRADICTION * (known + measured):
        return replace(inertia, gyro_bias=np.zeros(3), gyro_sigma=-1.0)
    gain = known / (known + measured)
    sigma = max(float(np.sqrt(gain * measured)), _LEAST)
    return replace(inertia, gyro_bias=inertia.gyro_bias + gain * missing, gyro_sigma=sigma)


def with_known_bias(inertia: Inertia) -> Inertia:
    """Keep the bias of the gyroscope that the state of the IMU contains."""
    if inertia.state is None:
        return inertia
    return replace(inertia, gyro_bias=inertia.state.bias[:3].copy(), gyro_sigma=_LEAST)


def _motion(
    inertia: Inertia, start: float, end: float, calibration: ImuCalibration
) -> Preintegration | None:
    if not len(inertia.samples) or not end > start:
        return None
    bias = np.concatenate([inertia.gyro_bias, np.zeros(3)])
    motion = preintegrate(inertia.samples, start, end, calibration.noise, bias)
    return motion if motion.longest_gap <= LONGEST_GAP else None
