"""Follows the state of an IMU: an extended Kalman filter between inertial samples and poses.

Samples move the state from one time to the next, and poses that the images gave correct it. Because
the whole covariance is kept, what gravity and the biases have in common is not lost: in a short
time, only the sum of gravity and the bias of the accelerometer is known well, and this sum is what
a prediction needs.

The error is defined in ``InertialState``. Rotations are corrected on the right (Forster et al.,
T-RO 2017). The filter is loosely coupled: it sees poses, not images. Where images give no pose, it
goes on alone (dead reckoning), and its covariance grows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vslam.backend.bundle_adjustment import cholesky_solve
from vslam.backend.preintegration import (
    Preintegration,
    cross_matrix,
    preintegrate,
    right_jacobian,
    so3_exp,
    so3_log,
    times,
)
from vslam.support.kernels import inner_kernel, kernel
from vslam.types.geometry import Matrix, adjoint, compose, inverse, orthonormalised
from vslam.types.imu import GRAVITY, ImuNoise, InertialState

N = 18
_TURN, _PLACE, _SPEED, _FALL, _GYRO, _ACCEL = range(0, N, 3)
TURN, PLACE, SPEED, FALL, GYRO, ACCEL = (slice(k, k + 3) for k in range(0, N, 3))
BIAS, FALL_AND_BIAS = slice(12, N), slice(9, N)
# Share of the vibration that is added to the density of the noise. A vibration as strong as white
# noise of density 1 disturbs motions over 0.5 to 2 s like white noise of this density. With it, the
# squared errors of the positions of EuRoC's V1_01 and V1_03 are 0.7 to 1.2 times the expected ones
# if the positions of the ground truth correct the filter [own].
VIBRATION = 0.2
# Errors of the scale, of the axes and of the clock grow with the motion. Share of the root mean
# square of the rate, and of what changes in the force, that is added to the density. If the axes of
# a gyroscope are wrong by 1 degree, rotations over 1 s are 1.23 times as wrong as without an IMU
# with 0, and 1.05 times with 0.002. Between 0 and 0.002, NEES falls further below 1. [own]
MOTION = 0.0015
NEWEST_S, FEWEST_SAMPLES = 1.0, 10  # seconds and number of samples that show vibration and motion


@dataclass(frozen=True, eq=False)
class Correction:
    """A state after a measurement, and how well the measurement fitted.

    Attributes:
        state: the corrected state.
        chi2: squared Mahalanobis distance of the measurement from its prediction.
    """

    state: InertialState
    chi2: float


def noise_in_motion(noise: ImuNoise, samples: Matrix) -> ImuNoise:
    """Return the noise of an IMU that moves and vibrates as its newest samples show.

    Second differences of neighbouring samples contain the white noise and vibrations, but hardly
    the motion. Most of a vibration is gone after integration, so only its share ``VIBRATION``
    counts.

    Args:
        noise: densities of the data sheet, which are those at rest.
        samples: ``(N, 7)``, see ``preintegrate``. Those of the last ``NEWEST_S`` are used.
    """
    since = samples[-1, 0] - NEWEST_S if len(samples) else 0.0
    rows = samples[np.searchsorted(samples[:, 0], since) :]
    if len(rows) < FEWEST_SAMPLES:
        return noise
    gyro, accel = _disturbances(rows)
    return replace(
        noise,
        gyro=float(np.sqrt(noise.gyro**2 + gyro)),
        accel=float(np.sqrt(noise.accel**2 + accel)),
    )


@kernel
def _disturbances(rows):
    """Return what vibration and motion add to the squared densities of the rate and the force."""
    n = len(rows)
    step = np.median(rows[1:, 0] - rows[:-1, 0])
    mean, second = np.zeros(6), np.zeros(6)
    n_even = 0
    for k in range(n):
        for i in range(6):
            mean[i] += rows[k, 1 + i] / n
        # Not if a sample is missing.
        if 0 < k < n - 1 and rows[k + 1, 0] - rows[k - 1, 0] < 2.5 * step:
            n_even += 1
            for i in range(6):
                change = rows[k + 1, 1 + i] - 2.0 * rows[k, 1 + i] + rows[k - 1, 1 + i]
                second[i] += change * change
    added = np.zeros(2)
    # The second difference of white noise has six times its variance.
    vibration = VIBRATION**2 * step / (6.0 * 3.0 * max(n_even, 1))
    for i in range(6):
        added[i // 3] += vibration * second[i]
        centre = 0.0 if i < 3 else mean[i]
        for k in range(n):
            added[i // 3] += MOTION**2 / n * (rows[k, 1 + i] - centre) ** 2
    return added[0], added[1]


def propagated(
    state: InertialState, samples: Matrix, timestamp: float, noise: ImuNoise
) -> InertialState:
    """Return the state at a later time, according to the samples in between.

    Args:
        samples: ``(N, 7)``, at least one, see ``preintegrate``.
        timestamp: seconds, not before the time of the state.
        noise: noise of the samples (``noise_in_motion``).

    Raises:
        ValueError: there are no samples, or the time is before that of the state.
    """
    motion = preintegrate(samples, state.timestamp, timestamp, noise, state.bias)
    return moved(state, motion, noise)


def moved(state: InertialState, motion: Preintegration, noise: ImuNoise) -> InertialState:
    """Return the state after a motion that was preintegrated with the biases of the state."""
    t = motion.seconds
    T, velocity, P = _moved(
        state.T_world_imu,
        state.velocity,
        state.gravity,
        state.covariance,
        t,
        motion.rotation,
        motion.velocity,
        motion.position,
        motion.by_bias,
        motion.covariance,
        noise.gyro_walk,
        noise.accel_walk,
    )
    return InertialState(state.timestamp + t, T, velocity, state.gravity, state.bias, P)


@kernel
def _moved(
    T_world_imu, speed, gravity, covariance, t, rotation, velocity, position, by_bias, of_motion,
    gyro_walk, accel_walk,
):  # fmt: skip
    """Return the ``(4, 4)`` pose, the ``(3,)`` velocity and the ``(18, 18)`` covariance after a
    motion."""
    R = np.ascontiguousarray(T_world_imu[:3, :3])
    T, after = np.eye(4), np.empty(3)
    T[:3, :3] = times(R, rotation)
    F = np.eye(N)
    of_velocity, of_position = times(R, cross_matrix(velocity)), times(R, cross_matrix(position))
    by_velocity, by_position = times(R, by_bias[3:6]), times(R, by_bias[6:])
    to_world = np.zeros((N, 9))  # errors of the preintegrated motion as errors of the state
    for i in range(3):
        gained, gone = 0.0, 0.0
        for j in range(3):
            gained += R[i, j] * velocity[j]
            gone += R[i, j] * position[j]
            F[_TURN + i, _TURN + j] = rotation[j, i]
            F[_SPEED + i, _TURN + j] = -of_velocity[i, j]
            F[_PLACE + i, _TURN + j] = -of_position[i, j]
            to_world[_SPEED + i, 3 + j] = to_world[_PLACE + i, 6 + j] = R[i, j]
        after[i] = speed[i] + t * gravity[i] + gained
        T[i, 3] = T_world_imu[i, 3] + t * speed[i] + 0.5 * t * t * gravity[i] + gone
        for j in range(6):
            F[_TURN + i, _GYRO + j] = by_bias[i, j]
            F[_SPEED + i, _GYRO + j] = by_velocity[i, j]
            F[_PLACE + i, _GYRO + j] = by_position[i, j]
        F[_SPEED + i, _FALL + i] = F[_PLACE + i, _SPEED + i] = t
        F[_PLACE + i, _FALL + i] = 0.5 * t * t
        to_world[_TURN + i, i] = 1.0
    P = _seen_through(F, covariance) + _seen_through(to_world, of_motion)
    for i in range(3):
        P[_GYRO + i, _GYRO + i] += gyro_walk * gyro_walk * t
        P[_ACCEL + i, _ACCEL + i] += accel_walk * accel_walk * t
    return orthonormalised(T), after, 0.5 * (P + P.T)


def corrected_by_pose(
    state: InertialState, T_world_camera: Matrix, covariance: Matrix, T_imu_camera: Matrix
) -> Correction:
    """Correct a state with a pose of the camera at the same time.

    Args:
        T_world_camera: ``(4, 4)`` pose of the camera.
        covariance: ``(6, 6)`` of the error ``xi = [v, w]`` of the pose in the frame of the camera:
            the true pose is ``T_world_camera exp(-xi)`` (``PoseUncertainty``).
        T_imu_camera: ``(4, 4)``.
    """
    H, error, noise = _pose_error(state.T_world_imu, T_world_camera, covariance, T_imu_camera)
    return _corrected(state, H, error, noise)


def drifted(state: InertialState, covariance: Matrix, T_imu_camera: Matrix) -> InertialState:
    """Return the state in a world frame that has drifted.

    The world frame is that of the odometry. With each keyframe, its position and direction change
    relative to the true world. What the IMU knows about velocity and gravity in its own frame does
    not change.

    Args:
        covariance: ``(6, 6)`` of the drift, as an error of the pose of the camera
            (``corrected_by_pose``).
    """
    R, A = state.T_world_imu[:3, :3], _from_camera(state.T_world_imu, T_imu_camera)
    G = np.zeros((N, 6))
    G[TURN], G[PLACE] = A[:3], A[3:]
    G[SPEED] = -cross_matrix(state.velocity) @ R @ A[:3]
    G[FALL] = -cross_matrix(state.gravity) @ R @ A[:3]
    return replace(state, covariance=state.covariance + G @ covariance @ G.T)


def corrected_by_rest(state: InertialState, sigma: float) -> Correction:
    """Correct a state with the knowledge that the IMU does not move.

    Args:
        sigma: standard deviation of the velocity, along each axis, in m/s.
    """
    H = np.zeros((3, N))
    H[:, SPEED] = np.eye(3)
    return _corrected(state, H, -state.velocity, sigma**2 * np.eye(3))


def camera_pose(state: InertialState, T_imu_camera: Matrix) -> Matrix:
    """Return ``(4, 4)`` ``T_world_camera``."""
    return state.T_world_imu @ T_imu_camera


def camera_covariance(state: InertialState, T_imu_camera: Matrix) -> Matrix:
    """Return the ``(6, 6)`` covariance of the pose of the camera (``PoseUncertainty``)."""
    R, A = state.T_world_imu[:3, :3], adjoint(inverse(T_imu_camera))
    A = np.concatenate([A[:, 3:], A[:, :3] @ R.T], axis=1)
    total: Matrix = A @ state.covariance[:6, :6] @ A.T
    return total


@kernel
def fall_in_imu(R: Matrix, gravity: Matrix, covariance: Matrix) -> tuple[Matrix, float]:
    """Return the ``(3,)`` direction of free fall in the frame of the IMU, and its variance along
    each direction across it, in rad^2.

    Args:
        R: ``(3, 3)``, maps directions of the IMU to the world.
        gravity: ``(3,)`` m/s^2 in the world.
        covariance: ``(18, 18)`` of the state.
    """
    to_imu = np.ascontiguousarray(R.T) / GRAVITY
    direction = np.zeros(3)
    for i in range(3):
        for j in range(3):
            direction[i] += to_imu[i, j] * gravity[j]
    A = np.zeros((3, N))
    A[:, _TURN : _TURN + 3] = cross_matrix(direction)
    A[:, _FALL : _FALL + 3] = to_imu
    P = _seen_through(A, covariance)
    return direction, 0.5 * (P[0, 0] + P[1, 1] + P[2, 2])


def in_another_world(state: InertialState, T_new_world: Matrix) -> InertialState:
    """Return the state in another world frame.

    Args:
        T_new_world: ``(4, 4)``, maps points of the present world frame to the new one.
    """
    R = T_new_world[:3, :3]
    F = np.eye(N)
    F[PLACE, PLACE] = F[SPEED, SPEED] = F[FALL, FALL] = R
    return replace(
        state,
        T_world_imu=orthonormalised(T_new_world @ state.T_world_imu),
        velocity=R @ state.velocity,
        gravity=R @ state.gravity,
        covariance=F @ state.covariance @ F.T,
    )


def anchored(state: InertialState, T_world_imu: Matrix) -> InertialState:
    """Return the state in a world frame in which the IMU is known to be at a given pose.

    The error of the pose becomes zero. What the IMU knows about velocity and gravity in its own
    frame stays as uncertain as it was.
    """
    R, F = state.T_world_imu[:3, :3], np.eye(N)
    F[TURN] = F[PLACE] = 0.0
    F[SPEED, TURN] = cross_matrix(state.velocity) @ R
    F[FALL, TURN] = cross_matrix(state.gravity) @ R
    T_new_world = T_world_imu @ inverse(state.T_world_imu)
    known = replace(state, covariance=F @ state.covariance @ F.T)
    return in_another_world(known, T_new_world)


@kernel
def _pose_error(T_world_imu, T_world_camera, covariance, T_imu_camera):
    """Return a measured pose of the camera as a measurement of the error of the state: its
    derivatives ``(6, 18)``, the measured error ``(6,)``, and its covariance."""
    T_measured = compose(T_world_camera, inverse(T_imu_camera))
    R = np.ascontiguousarray(T_world_imu[:3, :3])
    error, H = np.empty(6), np.eye(6, N)
    error[:3] = so3_log(times(R.T, T_measured[:3, :3]))
    error[3:] = T_measured[:3, 3] - T_world_imu[:3, 3]
    return H, error, _seen_through(_from_camera(T_world_imu, T_imu_camera), covariance)


@kernel
def _from_camera(T_world_imu, T_imu_camera):
    """Return ``(6, 6)``, from the error of the pose of the camera to the rotation of the IMU and
    its position in the world."""
    R, R_imu_camera = T_world_imu[:3, :3], T_imu_camera[:3, :3]
    A, turned = np.zeros((6, 6)), times(R, R_imu_camera)
    A[:3, 3:] = R_imu_camera
    A[3:, :3] = turned
    A[3:, 3:] = times(times(R, cross_matrix(T_imu_camera[:3, 3])), R_imu_camera)
    return A


@inner_kernel
def _seen_through(A, P):
    """Return ``A P A'``."""
    return times(times(A, P), np.ascontiguousarray(A.T))


def _corrected(state: InertialState, H: Matrix, error: Matrix, noise: Matrix) -> Correction:
    """Correct a state with a measurement ``H e`` of its error (Joseph's form)."""
    T, velocity, gravity, bias, P, chi2 = _update(
        state.T_world_imu,
        state.velocity,
        state.gravity,
        state.bias,
        state.covariance,
        H,
        error,
        noise,
    )
    corrected = InertialState(state.timestamp, T, velocity, gravity, bias, P)
    return Correction(corrected, chi2)


@kernel
def _update(T_world_imu, velocity, gravity, bias, P, H, error, noise):
    """Return the corrected pose, velocity, gravity, biases and covariance, and the squared
    distance of the measurement."""
    m = len(error)
    H_t = np.ascontiguousarray(H.T)
    across = times(P, H_t)
    S = times(H, across) + noise
    inverse_of_S = np.eye(m)
    for k in range(m):
        if not cholesky_solve(S.copy(), inverse_of_S[k]):
            inverse_of_S[k] = np.nan  # not a covariance: the measurement fits nothing
    K = times(across, inverse_of_S)
    x, chi2 = np.zeros(N), 0.0
    for i in range(m):
        for j in range(m):
            chi2 += error[i] * inverse_of_S[i, j] * error[j]
        for j in range(N):
            x[j] += K[j, i] * error[i]
    turned = np.eye(N)
    turned[:3, :3] = right_jacobian(x[:3])
    keep = np.eye(N) - times(K, H)
    P = _seen_through(turned, _seen_through(keep, P) + _seen_through(K, noise))
    T = T_world_imu.copy()
    T[:3, :3] = times(np.ascontiguousarray(T_world_imu[:3, :3]), so3_exp(x[:3]))
    T[:3, 3] += x[_PLACE : _PLACE + 3]
    fall = gravity + x[_FALL : _FALL + 3]
    fall *= GRAVITY / np.sqrt(fall[0] * fall[0] + fall[1] * fall[1] + fall[2] * fall[2])
    return (
        orthonormalised(T), velocity + x[_SPEED : _SPEED + 3], fall, bias + x[_GYRO:],
        0.5 * (P + P.T), chi2,
    )  # fmt: skip
