"""Inertial samples, and the calibration of an inertial measurement unit (IMU).

N samples are an ``(N, 7)`` float64 array. A row contains the time in seconds, the angular rate
(gyroscope) in rad/s along x, y and z, and the specific force (accelerometer) in m/s^2 along x, y
and z, in the frame of the IMU. The specific force is the acceleration minus gravity: at rest, it
points up and is 9.81 m/s^2 long. Times are those of the camera's clock (``in_camera_time``).
Rows are sorted by time, no time is repeated, and all numbers are finite (``tidied``).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vslam.types.geometry import Matrix

GRAVITY = 9.81  # m/s^2; on the earth's surface, it is 9.78 to 9.83
# Largest deviation of R'R from the identity. Files with four digits are accepted.
_NOT_A_ROTATION = 1e-2


@dataclass(frozen=True)
class ImuNoise:
    """The noise of an IMU, as continuous densities in the units of Kalibr's ``imu.yaml``.

    The defaults are those of cheap IMUs, such as Bosch's BMI055. Give the densities of the data
    sheet or of a measurement at rest. Vibration and misalignment, which they leave out, are taken
    into account where the noise is used (``backend/inertial_filter.py``).

    Attributes:
        gyro: density of the noise of the angular rate, in rad/s/sqrt(Hz).
        accel: density of the noise of the specific force, in m/s^2/sqrt(Hz).
        gyro_walk: density of the random walk of the gyroscope's bias, in rad/s^2/sqrt(Hz).
        accel_walk: density of the random walk of the accelerometer's bias, in m/s^3/sqrt(Hz).

    Raises:
        ValueError: a density is not positive or not finite. The message names it.
    """

    gyro: float = 2.5e-4
    accel: float = 2e-3
    gyro_walk: float = 2e-5
    accel_walk: float = 3e-3

    def __post_init__(self) -> None:
        for name in ("gyro", "accel", "gyro_walk", "accel_walk"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"the noise density {name} is {value}, but must be positive")


@dataclass(frozen=True, eq=False)
class ImuCalibration:
    """Where the IMU is on the camera, how noisy it is, and how its clock differs.

    Attributes:
        T_imu_camera: ``(4, 4)`` float64. It maps points of the frame of the (left) camera to the
            frame of the IMU. Kalibr calls it ``T_ic``, and its inverse ``T_cam_imu``.
        noise: densities of the noise and of the random walks of the biases.
        time_offset: seconds to be added to times of the camera to get times of the IMU. Kalibr
            calls it ``timeshift_cam_imu``.

    Raises:
        ValueError: ``T_imu_camera`` is not a rigid motion, or ``time_offset`` is not finite.
    """

    T_imu_camera: Matrix
    noise: ImuNoise = ImuNoise()
    time_offset: float = 0.0

    def __post_init__(self) -> None:
        T = np.array(self.T_imu_camera, np.float64)
        if T.shape != (4, 4) or not np.isfinite(T).all():
            raise ValueError(f"T_imu_camera must be 4x4 finite numbers, but has shape {T.shape}")
        R = T[:3, :3]
        turned = np.abs(R.T @ R - np.eye(3)).max() <= _NOT_A_ROTATION and np.linalg.det(R) > 0.0
        if not turned or np.abs(T[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-9:
            raise ValueError(
                "T_imu_camera is not a rigid motion: its first three columns must be a rotation, "
                "and its last row 0 0 0 1"
            )
        if not np.isfinite(self.time_offset):
            raise ValueError(f"time_offset is {self.time_offset}, but must be finite")
        U, _, V = np.linalg.svd(R)
        T[:3, :3] = U @ V  # round-off of the file would stretch all motions
        T.flags.writeable = False
        object.__setattr__(self, "T_imu_camera", T)


@dataclass(frozen=True)
class TidySamples:
    """Samples that are sorted, finite and not repeated, and what was changed for it.

    Attributes:
        samples: ``(N, 7)`` float64, see the top of this module.
        n_late: number of samples that had come after a sample with a later time. They were sorted.
        n_repeated: number of samples that were left out because their time was repeated. The first
            sample of each time is kept.
        n_invalid: number of samples that were left out because a number is not finite.
    """

    samples: Matrix
    n_late: int = 0
    n_repeated: int = 0
    n_invalid: int = 0

    @property
    def notes(self) -> tuple[str, ...]:
        """One sentence without a full stop for each kind of change; empty if nothing was changed.

        For example "3 inertial samples were not in order of time and were sorted".
        """
        said = (
            (self.n_invalid, "not a finite number", "left out"),
            (self.n_late, "not in order of time", "sorted"),
            (self.n_repeated, "at the time of another", "left out"),
        )
        return tuple(
            f"{n} inertial samples were {what} and were {done}"
            if n > 1
            else f"1 inertial sample was {what} and was {done}"
            for n, what, done in said
            if n
        )


def no_samples() -> Matrix:
    """Return ``(0, 7)`` float64."""
    return np.empty((0, 7))


def tidied(samples: ArrayLike) -> TidySamples:
    """Sort inertial samples by time, and leave out repeated times and numbers that are not finite.

    The order of rows with equal times is kept, so the result does not depend on the sort.

    Args:
        samples: ``(N, 7)`` numbers, in any order. They are copied only if something is changed.

    Raises:
        ValueError: the shape is not ``(N, 7)``.
    """
    rows = np.asarray(samples, np.float64)
    if rows.size == 0 and rows.ndim in (1, 2):
        return TidySamples(no_samples())
    if rows.ndim != 2 or rows.shape[1] != 7:
        raise ValueError(
            f"inertial samples have shape {rows.shape} instead of (N, 7): seconds, angular rate "
            "xyz in rad/s, specific force xyz in m/s^2"
        )
    if np.isfinite(rows).all() and (rows[1:, 0] > rows[:-1, 0]).all():
        return TidySamples(rows)
    finite = np.isfinite(rows).all(axis=1)
    n_invalid = int(np.count_nonzero(~finite))
    if n_invalid:
        rows = rows[finite]
    n_late = _n_late(rows[:, 0])
    if n_late:
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
    first = np.ones(len(rows), np.bool_)
    first[1:] = np.diff(rows[:, 0]) > 0.0
    n_repeated = int(np.count_nonzero(~first))
    if n_repeated:
        rows = rows[first]
    return TidySamples(rows, n_late, n_repeated, n_invalid)


def in_camera_time(samples: Matrix, time_offset: float) -> Matrix:
    """Return a copy of ``(N, 7)`` samples of the IMU's clock with times of the camera's clock.

    Args:
        time_offset: see ``ImuCalibration``.
    """
    moved = samples.copy()
    moved[:, 0] -= time_offset
    return moved


def _n_late(times: NDArray[np.float64]) -> int:
    """Return how many times are earlier than one before them."""
    if len(times) < 2:
        return 0
    return int(np.count_nonzero(times[1:] < np.maximum.accumulate(times)[:-1]))


@dataclass(frozen=True, eq=False)
class InertialState:
    """The state of an IMU that is moving through a world whose gravity is known.

    The error of a state is ``(18,)``: the rotation (the true one is ``R exp(e)``), the position,
    the velocity, gravity, and the biases of gyroscope and accelerometer, in this order.

    Attributes:
        timestamp: seconds, in the camera's clock.
        T_world_imu: ``(4, 4)`` pose of the IMU.
        velocity: ``(3,)`` m/s in the world frame.
        gravity: ``(3,)`` acceleration of free fall in the world frame, ``GRAVITY`` m/s^2 long.
        bias: ``(6,)`` bias of the gyroscope in rad/s and of the accelerometer in m/s^2.
        covariance: ``(18, 18)`` of the error.
    """

    timestamp: float
    T_world_imu: Matrix
    velocity: Matrix
    gravity: Matrix
    bias: Matrix
    covariance: Matrix


@dataclass(frozen=True, eq=False)
class GravityDirection:
    """The direction of free fall in the frame of a camera.

    Attributes:
        direction: ``(3,)`` unit vector.
        sigma: standard deviation along each of the two axes across it, in radians.
    """

    direction: Matrix
    sigma: float


@dataclass(frozen=True, eq=False)
class Inertia:
    """What is known from the IMU, between two frames.

    Attributes:
        samples: ``(N, 7)`` recent samples, see the top of this module.
        state: the state of the IMU at the last frame, in the frame of the odometry; None if gravity
            is not known.
        times: ``(M,)`` seconds of the frames whose poses are collected for the start.
        poses: ``(M, 4, 4)`` ``T_odom_camera`` of these frames.
        carried_s: for how long the camera has been carried by the IMU alone, in seconds.
        refused: number of poses in a row that the filter refused.
        disagreements: how often poses and samples did not agree.
        tried: time of the last start, in seconds.
        known_since: time since when gravity is known, in seconds; -1 if it never was.
        gyro_bias: ``(3,)`` bias of the gyroscope in rad/s, as long as the state is unknown.
        gyro_sigma: its standard deviation along each axis, in rad/s; -1 if it is unknown.
        scale_sigma: standard deviation of the logarithm of the scale of the map of one camera; -1
            if its unit is not known to be the metre. Unused for cameras that measure depth.
        metric_since: time since when this scale is known, in seconds; -1 if it never was.
    """

    samples: Matrix = field(default_factory=no_samples)
    state: InertialState | None = None
    times: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    poses: Matrix = field(default_factory=lambda: np.empty((0, 4, 4)))
    carried_s: float = 0.0
    refused: int = 0
    disagreements: int = 0
    tried: float = -1.0
    known_since: float = -1.0
    gyro_bias: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    gyro_sigma: float = -1.0
    scale_sigma: float = -1.0
    metric_since: float = -1.0


@dataclass(frozen=True, eq=False)
class InertialWindow:
    """What local bundle adjustment needs to know from the IMU at a frame.

    Attributes:
        samples: ``(N, 7)`` samples up to the frame, see the top of this module.
        state: the state of the IMU, in the frame of the odometry.
        R_odom_camera: ``(3, 3)`` rotation of the tracked camera in the frame of the odometry.
        T_imu_camera: ``(4, 4)``, maps points of the tracked camera to the IMU.
        noise: of the samples, see ``noise_in_motion``.
        longest_gap: seconds between two samples above which they do not tell the motion.
        noise_factor: by how much ``noise`` is larger than the samples show.
    """

    samples: Matrix
    state: InertialState
    R_odom_camera: Matrix
    T_imu_camera: Matrix
    noise: ImuNoise
    longest_gap: float
    noise_factor: float = 1.0
