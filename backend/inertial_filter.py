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
    times, values = rows[:, 0], rows[:, 1:]
    step = float(np.median(np.diff(times)))
    even = times[2:] - times[:-2] < 2.5 * step  # no sample is missing
    second = values[2:] - 2.0 * values[1:-1] + values[:-2]
    # The second difference of white noise has six times its variance.
    vibration = VIBRATION**2 * step / 6.0 * np.mean(second[even] ** 2, axis=0)
    mean = values.mean(axis=0)
    mean[:3] = 0.0
    motion = MOTION**2 * np.sum(np.mean((values - mean) ** 2, axis=0).reshape(2, 3), axis=1)
    gyro, accel = vibration.reshape(2, 3).mean(axis=1) + motion
    return replace(
        noise,
        gyro=float(np.sqrt(noise.gyro**2 + gyro)),
        accel=float(np.sqrt(noise.accel**2 + accel)),
    )


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
    A = _from_camera(state, T_imu_camera)
    error = np.concatenate(
        [
            so3_log(np.ascontiguousarray(R.T @ T_measured[:3, :3])),
            T_measured[:3, 3] - state.T_world_imu[:3, 3],
        ]
    )
    return _corrected(state, np.eye(6, N), error, A @ covariance @ A.T)


def drifted(state: InertialState, covariance: Matrix, T_imu_camera: Matrix) -> InertialState:
    """Return the state in a world frame that has drifted.

    The world frame is that of the odometry. With each keyframe, its position and direction change
    relative to the true world. What the IMU knows about velocity and gravity in its own frame does
    not change.

    Args:
        covariance: ``(6, 6)`` of the drift, as an error of the pose of the camera
            (``corrected_by_pose``).
    """
    R, A = state.T_world_imu[:3, :3], _from_camera(state, T_imu_camera)
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


def _from_camera(state: InertialState, T_imu_camera: Matrix) -> Matrix:
    """Return ``(6, 6)``, from the error of the pose of the camera to the rotation of the IMU and
    its position in the world."""
    R = state.T_world_imu[:3, :3]
    R_imu_camera, arm = T_imu_camera[:3, :3], T_imu_camera[:3, 3]
    A = np.zeros((6, 6))
    A[:3, 3:] = R_imu_camera
    A[3:, :3] = R @ R_imu_camera
    A[3:, 3:] = R @ cross_matrix(arm) @ R_imu_camera
    return A


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
