"""Finds gravity, velocity, biases and the scale of one camera from a short stretch of poses.

All are found from 0.5 to 1 s of poses by linear least squares, with the length of gravity fixed
(Qin and Shen, "Robust initialization of monocular visual-inertial estimation", IROS 2017; here with
one velocity, because samples are integrated from the first pose to every other one). The stretch
need not contain a certain motion, unless the scale is unknown: also at rest, poses and samples tell
how the camera is tilted. The scale takes a few seconds in which the camera accelerates.

In the frame of the first pose, with the preintegrated position ``d(t)`` and its derivative
``D(t)`` by the bias ``b`` of the accelerometer, the position of the IMU is

    s c(t) + R(t) l = p + v t + g t^2 / 2 + R(0) (d(t) + D(t) b)

with the position ``c`` of the camera in units of the map, the scale ``s`` in metres per unit, and
the lever arm ``l`` from the camera to the IMU in the frame of the camera. Both sides are divided by
``s``, and ``1 / s`` is the unknown. With ``s`` as the unknown, its factor ``c`` would have noise,
and least squares finds factors of noisy quantities too small (attenuation; Fuller, "Measurement
Error Models", 1987, section 1.1): a walk of 2 s gave half the true scale.

Poses have white noise. The noise of the samples is integrated, so the errors of all positions are
correlated. Both are the same along each axis, which leaves one N x N covariance for N poses.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vslam.backend.inertial_filter import (
    ACCEL,
    FALL,
    GYRO,
    PLACE,
    SPEED,
    TURN,
    N,
    corrected_by_pose,
    propagated,
)
from vslam.backend.preintegration import Preintegration, preintegrate, so3_exp, so3_log
from vslam.types.geometry import Matrix, inverse
from vslam.types.imu import GRAVITY, ImuCalibration, InertialState

# Biases that are expected of an IMU whose biases are unknown, as standard deviations in rad/s and
# m/s^2. In a short time, the bias of the accelerometer cannot be told from gravity.
GYRO_BIAS, ACCEL_BIAS = 0.1, 0.2
# The first state of the filter: it is about as uncertain as if nothing were known.
_TURN, _PLACE, _SPEED, _FALL = 0.1, 1.0, 1.0, 0.1  # rad, m, m/s, rad
LONGEST_GAP = 0.03  # s without a sample, above which a stretch is not used
# A result is refused if the largest standard deviation of the velocity (m/s) or that of the
# logarithm of the scale is larger. ORB-SLAM3's start waits for motion instead. Poses that fit worse
# than expected make the scale as much less certain.
MAX_SPEED_SIGMA, MAX_SCALE_SIGMA = 0.1, 0.02
# Largest ratio of the sum of squared errors to its expectation. Poses that images gave have errors
# that are not independent, so the limit is far above that of independent errors.
MAX_MISFIT = 4.0
_ITERATIONS = 4


@dataclass(frozen=True, eq=False)
class PoseStretch:
    """N poses of the camera at increasing times.

    Attributes:
        times: ``(N,)`` seconds.
        T_world_camera: ``(N, 4, 4)``.
        sigma_m, sigma_rad: standard deviations of the noise of the poses along each axis, in metres
            (in units of the map for one camera) and in radians.
    """

    times: NDArray[np.float64]
    T_world_camera: Matrix
    sigma_m: float
    sigma_rad: float


@dataclass(frozen=True, eq=False)
class GyroBias:
    """The bias of a gyroscope, found from rotations.

    Attributes:
        bias: ``(3,)`` rad/s.
        covariance: ``(3, 3)``.
        misfit: sum of squared errors, divided by its expectation. It is far above 1 if the
            rotations of the poses are not those of the samples.
    """

    bias: Matrix
    covariance: Matrix
    misfit: float


@dataclass(frozen=True, eq=False)
class GravityState:
    """What a stretch of poses and samples tells about gravity and motion.

    Attributes:
        state: at the last pose, in the world frame of the poses, in metres.
        scale: metres per unit of the poses; 1 if it was known.
        scale_sigma: standard deviation of the logarithm of the scale, multiplied by the root of
            ``misfit`` if that is above 1; 0 if the scale was known.
        speed_sigma: largest standard deviation of the velocity, in m/s.
        condition: condition number of the least squares, whose unknowns are in units of their
            expected sizes.
        misfit: sum of squared errors, divided by its expectation.
        doubt: why the result should not be used, in a few words; empty if it is good.
    """

    state: InertialState
    scale: float
    scale_sigma: float
    speed_sigma: float
    condition: float
    misfit: float
    doubt: str


def find_gyro_bias(
    stretch: PoseStretch, samples: Matrix, calibration: ImuCalibration
) -> GyroBias | None:
    """Find the bias of the gyroscope from the rotations of poses.

    Args:
        stretch: at least two poses.
        samples: ``(M, 7)``, see ``vslam/types/imu.py``.

    Returns:
        None if samples are missing for more than ``LONGEST_GAP`` seconds.
    """
    rotations = _imu_poses(stretch, calibration)[:, :3, :3]
    motions = _motions(stretch, samples, calibration, np.zeros(6))
    if motions is None or len(rotations) < 2:
        return None
    times = stretch.times - stretch.times[0]
    noise = calibration.noise
    C = stretch.sigma_rad**2 * np.eye(len(times))
    C += noise.gyro**2 * np.minimum.outer(times, times)
    L: Matrix = np.linalg.cholesky(C).astype(np.float64)
    bias = np.zeros(6)
    start, x, H, rhs = rotations[0], np.zeros(6), np.eye(6), np.zeros(6)
    for _ in range(_ITERATIONS):
        now = [motion.with_bias(bias) for motion in motions]
        A = np.zeros((len(times), 3, 6))
        e = np.empty((len(times), 3))
        for k, motion in enumerate(now):
            A[k, :, :3] = np.eye(3)
            A[k, :, 3:] = motion.rotation @ motion.by_bias[:3, :3]
            e[k] = motion.rotation @ so3_log(
                np.ascontiguousarray((start @ motion.rotation).T @ rotations[k])
            )
        A, e = _whitened(L, A, e)
        prior = np.diag(np.repeat([0.0, GYRO_BIAS**-2], 3))
        H = A.T @ A + prior
        rhs = e - A @ np.zeros(6)
        x = np.linalg.solve(H, A.T @ e - prior @ np.r_[np.zeros(3), bias[:3]])
        start = start @ so3_exp(x[:3])
        bias[:3] += x[3:]
    misfit = float(np.sum((rhs - A @ x) ** 2) / max(3 * len(times) - 6, 1))
    covariance: Matrix = np.linalg.inv(H)[3:, 3:].astype(np.float64)
    return GyroBias(bias[:3], covariance, misfit)


def find_gravity(
    stretch: PoseStretch, samples: Matrix, calibration: ImuCalibration, *, known_scale: bool
) -> GravityState | None:
    """Find gravity, velocity, biases and, if needed, the scale from a stretch of poses.

    Args:
        stretch: poses over 0.5 to 2 s, or 2 to 8 s if the scale is unknown, in a world frame that
            does not jump.
        samples: ``(M, 7)``, see ``vslam/types/imu.py``.
        known_scale: whether the poses are in metres.

    Returns:
        The result, which ``doubt`` may refuse. None if there are fewer than five poses, samples
        are missing for more than ``LONGEST_GAP`` seconds, or no positive scale fits.
    """
    if len(stretch.times) < 5:
        return None
    gyro = find_gyro_bias(stretch, samples, calibration)
    if gyro is None:
        return None
    bias = np.concatenate([gyro.bias, np.zeros(3)])
    motions = _motions(stretch, samples, calibration, bias)
    if motions is None:
        return None
    line = _fit(stretch, motions, calibration, known_scale=known_scale)
    if line is None:
        return None
    scaled = stretch.T_world_camera.copy()
    scaled[:, :3, 3] *= line.scale
    metric = replace(stretch, T_world_camera=scaled, sigma_m=stretch.sigma_m * line.scale)
    state, filter_misfit = _filtered(metric, samples, calibration, line, bias)
    speed_sigma = float(np.sqrt(np.linalg.eigvalsh(state.covariance[SPEED, SPEED])[-1]))
    misfit = max(line.misfit, gyro.misfit, filter_misfit)
    scale_sigma = line.scale_sigma * max(misfit, 1.0) ** 0.5
    doubt = ""
    if not scale_sigma <= MAX_SCALE_SIGMA:
        doubt = "the motion does not tell the scale yet"
    elif not (np.isfinite(misfit) and misfit <= MAX_MISFIT):
        doubt = "poses and inertial samples do not agree"
    elif speed_sigma > MAX_SPEED_SIGMA:
        doubt = "the velocity is not certain yet"
    return GravityState(state, line.scale, scale_sigma, speed_sigma, line.condition, misfit, doubt)


@dataclass(frozen=True, eq=False)
class _Fit:
    """The unknowns of the least squares: state at the first pose, in metres, and the scale."""

    position: Matrix
    velocity: Matrix
    gravity: Matrix
    accel_bias: Matrix
    scale: float
    scale_sigma: float
    condition: float
    misfit: float


def _fit(
    stretch: PoseStretch,
    motions: list[Preintegration],
    calibration: ImuCalibration,
    *,
    known_scale: bool,
) -> _Fit | None:
    """Fit the positions of all poses, see the top of this module. None if the scale is not
    positive."""
    T_wc, times = stretch.T_world_camera, stretch.times - stretch.times[0]
    T_wi = _imu_poses(stretch, calibration)
    R, n = T_wi[0, :3, :3], len(times)
    origin = T_wc[0, :3, 3]
    c = T_wc[:, :3, 3] - origin
    arm = T_wi[:, :3, 3] - T_wc[:, :3, 3]
    d = np.array([R @ motion.position for motion in motions])
    D = np.array([R @ motion.by_bias[6:, 3:] for motion in motions])
    gravity, unit = _mean_force_down(R, motions[-1]), 1.0
    for _ in range(_ITERATIONS):
        C = _position_covariance(times, stretch.sigma_m / unit, calibration) * unit**2
        L: Matrix = np.linalg.cholesky(C).astype(np.float64)
        B = _tangent(gravity)  # gravity changes by B w, which keeps its length to first order
        A = np.zeros((n, 3, 12))
        A[:, :, 0:3] = np.eye(3)
        A[:, :, 3:6] = times[:, None, None] * np.eye(3)
        A[:, :, 6:8] = 0.5 * times[:, None, None] ** 2 * B
        A[:, :, 8:11] = D
        A[:, :, 11] = 0.5 * times[:, None] ** 2 * gravity + d - arm
        A, y = _whitened(L, A, c)
        if known_scale:
            A, y = A[:, :11], y - A[:, 11]
        prior = np.zeros(A.shape[1])
        prior[8:11] = (unit * ACCEL_BIAS) ** -2
        H = A.T @ A + np.diag(prior)
        x = np.linalg.solve(H, A.T @ y).astype(np.float64)
        unit = 1.0 if known_scale else float(x[11])
        if not unit > 0.0:
            return None
        gravity = gravity + B @ x[6:8] / unit
        gravity *= GRAVITY / np.linalg.norm(gravity)
    expected = np.repeat([1.0, 1.0, GRAVITY, 1.0, 1.0], [3, 3, 2, 3, 1])[: len(x)]
    sized = H * np.outer(expected, expected)
    misfit = float(np.sum((y - A @ x) ** 2) / max(3 * n - 8, 1))
    sigma = 0.0 if known_scale else float(np.sqrt(np.linalg.inv(H)[11, 11]) / unit)
    condition = float(np.linalg.cond(sized))
    p = (x[:3] + origin) / unit
    return _Fit(p, x[3:6] / unit, gravity, x[8:11] / unit, 1.0 / unit, sigma, condition, misfit)


def _filtered(
    stretch: PoseStretch,
    samples: Matrix,
    calibration: ImuCalibration,
    fit: _Fit,
    bias: Matrix,
) -> tuple[InertialState, float]:
    """Run the filter over the stretch, from the fitted state with the uncertainty of an unknown
    one. Because it begins near the solution, it gives the covariance of all unknowns together.

    Returns:
        The state at the last pose, and the mean of its squared errors relative to the expected one.
    """
    variances = np.zeros(N)
    for part, sigma in ((TURN, _TURN), (PLACE, _PLACE), (SPEED, _SPEED)):
        variances[part] = sigma**2
    variances[GYRO], variances[ACCEL] = GYRO_BIAS**2, ACCEL_BIAS**2
    P, g = np.diag(variances), fit.gravity
    P[FALL, FALL] = _FALL**2 * (g @ g * np.eye(3) - np.outer(g, g))
    T = _imu_poses(stretch, calibration)[0]
    T[:3, 3] = fit.position
    biases = np.concatenate([bias[:3], fit.accel_bias])
    state = InertialState(float(stretch.times[0]), T, fit.velocity, g, biases, P)
    sigmas = np.repeat([stretch.sigma_m, stretch.sigma_rad], 3)
    covariance, total = np.diag(sigmas**2), 0.0
    for time, T_wc in zip(stretch.times, stretch.T_world_camera, strict=True):
        if time > state.timestamp:
            state = propagated(state, samples, float(time), calibration.noise)
        found = corrected_by_pose(state, T_wc, covariance, calibration.T_imu_camera)
        state, total = found.state, total + found.chi2
    return state, total / max(6 * len(stretch.times) - 15, 1)


def _imu_poses(stretch: PoseStretch, calibration: ImuCalibration) -> Matrix:
    poses: Matrix = stretch.T_world_camera @ inverse(calibration.T_imu_camera)
    return poses


def _motions(
    stretch: PoseStretch, samples: Matrix, calibration: ImuCalibration, bias: Matrix
) -> list[Preintegration] | None:
    """Return the motions from the first pose to each pose; None if samples are missing."""
    if not len(samples):
        return None
    times, noise = stretch.times, calibration.noise
    motions = [preintegrate(samples, float(times[0]), float(times[0]), noise, bias)]
    for before, now in itertools.pairwise(times.tolist()):
        motions.append(motions[-1].followed_by(preintegrate(samples, before, now, noise, bias)))
    return None if motions[-1].longest_gap > LONGEST_GAP else motions


def _position_covariance(
    times: NDArray[np.float64], sigma_m: float, calibration: ImuCalibration
) -> Matrix:
    """Return the ``(N, N)`` covariance of positions along one axis: white noise of the poses, and
    the noise of accelerometer and gyroscope, which tilts gravity, integrated two and three times.
    """
    first, last = np.minimum.outer(times, times), np.maximum.outer(times, times)
    twice = first**2 * last / 2.0 - first**3 / 6.0
    thrice = first**3 * (10.0 * last**2 - 5.0 * first * last + first**2) / 120.0
    noise = calibration.noise
    C: Matrix = sigma_m**2 * np.eye(len(times)) + noise.accel**2 * twice
    return C + (GRAVITY * noise.gyro) ** 2 * thrice


def _whitened(L: Matrix, A: Matrix, y: Matrix) -> tuple[Matrix, Matrix]:
    """Whiten ``(N, 3, M)`` rows and ``(N, 3)`` right sides, and stack the three axes."""
    n, _, m = A.shape
    rows: Matrix = np.linalg.solve(L, A.reshape(n, 3 * m)).reshape(3 * n, m).astype(np.float64)
    right: Matrix = np.linalg.solve(L, y).reshape(3 * n).astype(np.float64)
    return rows, right


def _mean_force_down(R: Matrix, motion: Preintegration) -> Matrix:
    """Return gravity as if the velocity were the same at both ends of a motion."""
    force = R @ motion.velocity
    down: Matrix = -force * (GRAVITY / np.linalg.norm(force))
    return down


def _tangent(g: Matrix) -> Matrix:
    """Return ``(3, 2)`` orthonormal directions across a vector."""
    along = np.eye(3)[np.argmin(np.abs(g))]
    one = np.cross(g, along)
    one /= np.linalg.norm(one)
    two = np.cross(g / np.linalg.norm(g), one)
    return np.column_stack([one, two])
