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

from vslam.backend.preintegration import (
    Preintegration,
    cross_matrix,
    preintegrate,
    right_jacobian,
    so3_exp,
    so3_log,
)
from vslam.types.geometry import Matrix, adjoint, inverse, orthonormalised
from vslam.types.imu import GRAVITY, ImuNoise, InertialState

N = 18
TURN, PLACE, SPEED, FALL, GYRO, ACCEL = (slice(k, k + 3) for k in range(0, N, 3))
BIAS, FALL_AND_BIAS = slice(12, N), slice(9, N)
# The world frame of the filter is that of the odometry, whose direction drifts. In rad/sqrt(s); at
# 10 m/s, this is 0.3 degrees in 100 m, as the worst of KITTI's sequences.
DRIFT = 1.5e-3
# Densities of the noise are multiplied by this factor, as in OKVIS2. They leave out vibration,
# misaligned axes and errors of the clock. With the densities of its data sheet, the squared errors
# of EuRoC's V1_03 over 2 s are 20 times the expected ones, and with this factor, twice.
INFLATION = 10.0


@dataclass(frozen=True, eq=False)
class Correction:
    """A state after a measurement, and how well the measurement fitted.

    Attributes:
        state: the corrected state.
        chi2: squared Mahalanobis distance of the measurement from its prediction.
    """

    state: InertialState
    chi2: float


def inflated(noise: ImuNoise) -> ImuNoise:
    """Return the noise of an IMU that is moving."""
    return replace(noise, gyro=INFLATION * noise.gyro, accel=INFLATION * noise.accel)


def propagated(
    state: InertialState, samples: Matrix, timestamp: float, noise: ImuNoise
) -> InertialState:
    """Return the state at a later time, according to the samples in between.

    Args:
        samples: ``(N, 7)``, at least one, see ``preintegrate``.
        timestamp: seconds, not before the time of the state.
        noise: noise of the IMU at rest; it is inflated.

    Raises:
        ValueError: there are no samples, or the time is before that of the state.
    """
    noise = inflated(noise)
    motion = preintegrate(samples, state.timestamp, timestamp, noise, state.bias)
    return moved(state, motion, noise)


def moved(state: InertialState, motion: Preintegration, noise: ImuNoise) -> InertialState:
    """Return the state after a motion that was preintegrated with the biases of the state."""
    t, g = motion.seconds, state.gravity
    R, p = state.T_world_imu[:3, :3], state.T_world_imu[:3, 3]
    T = np.eye(4)
    T[:3, :3] = R @ motion.rotation
    T[:3, 3] = p + state.velocity * t + 0.5 * t * t * g + R @ motion.position

    F, by_bias = np.eye(N), motion.by_bias
    F[TURN, TURN] = motion.rotation.T
    F[TURN, BIAS] = by_bias[:3]
    F[SPEED, TURN] = -R @ cross_matrix(motion.velocity)
    F[SPEED, FALL] = t * np.eye(3)
    F[SPEED, BIAS] = R @ by_bias[3:6]
    F[PLACE, TURN] = -R @ cross_matrix(motion.position)
    F[PLACE, SPEED] = t * np.eye(3)
    F[PLACE, FALL] = 0.5 * t * t * np.eye(3)
    F[PLACE, BIAS] = R @ by_bias[6:]

    to_world = np.zeros((N, 9))  # errors of the preintegrated motion as errors of the state
    to_world[TURN, :3] = np.eye(3)
    to_world[SPEED, 3:6] = to_world[PLACE, 6:] = R
    P = F @ state.covariance @ F.T + to_world @ motion.covariance @ to_world.T
    P[GYRO, GYRO] += noise.gyro_walk**2 * t * np.eye(3)
    P[ACCEL, ACCEL] += noise.accel_walk**2 * t * np.eye(3)
    P[FALL, FALL] += DRIFT**2 * t * (g @ g * np.eye(3) - np.outer(g, g))
    return InertialState(
        state.timestamp + t,
        orthonormalised(T),
        state.velocity + t * g + R @ motion.velocity,
        g,
        state.bias,
        0.5 * (P + P.T),
    )


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
    R = state.T_world_imu[:3, :3]
    T_measured = T_world_camera @ inverse(T_imu_camera)
    R_imu_camera, arm = T_imu_camera[:3, :3], T_imu_camera[:3, 3]
    A = np.zeros((6, 6))  # from xi to the rotation of the IMU, and its position in the world
    A[:3, 3:] = R_imu_camera
    A[3:, :3] = R @ R_imu_camera
    A[3:, 3:] = R @ cross_matrix(arm) @ R_imu_camera
    error = np.concatenate(
        [
            so3_log(np.ascontiguousarray(R.T @ T_measured[:3, :3])),
            T_measured[:3, 3] - state.T_world_imu[:3, 3],
        ]
    )
    return _corrected(state, np.eye(6, N), error, A @ covariance @ A.T)


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


def _corrected(state: InertialState, H: Matrix, error: Matrix, noise: Matrix) -> Correction:
    """Correct a state with a measurement ``H e`` of its error (Joseph's form)."""
    P = state.covariance
    S = H @ P @ H.T + noise
    solved = np.linalg.solve(S, np.column_stack([H @ P, error]))
    K = solved[:, :N].T
    x = K @ error
    keep = np.eye(N) - K @ H
    P = keep @ P @ keep.T + K @ noise @ K.T
    turned = np.eye(N)
    turned[TURN, TURN] = right_jacobian(x[TURN])
    T = state.T_world_imu.copy()
    T[:3, :3] = T[:3, :3] @ so3_exp(x[TURN])
    T[:3, 3] += x[PLACE]
    gravity = state.gravity + x[FALL]
    P = turned @ P @ turned.T
    corrected = InertialState(
        state.timestamp,
        orthonormalised(T),
        state.velocity + x[SPEED],
        gravity * (GRAVITY / np.linalg.norm(gravity)),
        state.bias + x[BIAS],
        0.5 * (P + P.T),
    )
    return Correction(corrected, float(error @ solved[:, N]))
