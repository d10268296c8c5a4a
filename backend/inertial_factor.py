"""The inertial factor: what samples between two keyframes tell about their states.

With the notation of ``backend/preintegration.py``, and the biases ``b``, the residuals are (Forster
et al., T-RO 2017, section VI-B, extended by the random walk of the biases and by gravity):

    r_R = log(rotation^T R_w0^T R_w1)
    r_v = R_w0^T (v_1 - v_0 - g t) - velocity
    r_p = R_w0^T (p_1 - p_0 - v_0 t - g t^2 / 2) - position
    r_b = b_1 - b_0

The preintegrated motion is corrected to first order for the biases ``b_0``. Poses are those of the
camera, ``T_cw``, and their increments are twists on the left, as in all bundle adjustment of vslam.
Such an increment ``(rho, phi)`` turns the IMU by ``-R_ic phi`` on the right, and moves it in the
world by ``R_wc (p_ci x phi - rho)``, where ``p_ci`` is the position of the IMU in the camera.
"""

from __future__ import annotations

import numpy as np

from vslam.backend.preintegration import (
    Preintegration,
    cross_matrix,
    right_jacobian,
    so3_exp,
    so3_log,
)
from vslam.types.geometry import Matrix
from vslam.types.imu import ImuNoise

N_RESIDUALS = 15
# Columns of the Jacobian: the poses, then velocity and biases of both keyframes, then gravity.
POSE_0, POSE_1, STATE_0, STATE_1, GRAVITY_ = (
    slice(0, 6),
    slice(6, 12),
    slice(12, 21),
    slice(21, 30),
    slice(30, 33),
)


def inertial_factor(
    motion: Preintegration,
    T_0w: Matrix,
    T_1w: Matrix,
    state_0: Matrix,
    state_1: Matrix,
    gravity: Matrix,
    T_imu_camera: Matrix,
) -> tuple[Matrix, Matrix]:
    """Compute the residuals of an inertial factor and their derivatives.

    Args:
        motion: between the two keyframes.
        T_0w, T_1w: ``(4, 4)`` poses of the camera (world to camera).
        state_0, state_1: ``(9,)`` velocity in the world in m/s, and biases of gyroscope (rad/s) and
            accelerometer (m/s^2).
        gravity: ``(3,)`` acceleration of free fall in the world, m/s^2.

    Returns:
        ``(15,)`` residuals of rotation (rad), velocity (m/s), position (m) and biases, and their
        ``(15, 33)`` derivatives by the increments of both poses, both states, and gravity.
    """
    dt, R_ic = motion.seconds, T_imu_camera[:3, :3]
    p_ci = -R_ic.T @ T_imu_camera[:3, 3]
    R_w0c, R_w1c = T_0w[:3, :3].T, T_1w[:3, :3].T
    R_0, R_1 = R_w0c @ R_ic.T, R_w1c @ R_ic.T
    p_0, p_1 = R_w0c @ (p_ci - T_0w[:3, 3]), R_w1c @ (p_ci - T_1w[:3, 3])
    v_0, v_1, b_0, b_1 = state_0[:3], state_1[:3], state_0[3:], state_1[3:]
    change = motion.by_bias @ (b_0 - motion.bias)
    error = (motion.rotation @ so3_exp(change[:3])).T @ R_0.T @ R_1
    gained = R_0.T @ (v_1 - v_0 - gravity * dt)
    moved = R_0.T @ (p_1 - p_0 - v_0 * dt - 0.5 * dt * dt * gravity)

    r = np.empty(N_RESIDUALS)
    r[:3] = so3_log(error)
    r[3:6] = gained - motion.velocity - change[3:6]
    r[6:9] = moved - motion.position - change[6:]
    r[9:] = b_1 - b_0

    J = np.zeros((N_RESIDUALS, 33))
    of_0, of_1, by_0, by_1, by_g = (
        J[:, one] for one in (POSE_0, POSE_1, STATE_0, STATE_1, GRAVITY_)
    )
    of_log = np.linalg.inv(right_jacobian(r[:3]))
    of_0[:3, 3:] = of_log @ R_1.T @ R_0 @ R_ic
    of_1[:3, 3:] = -of_log @ R_ic
    by_0[:3, 3:6] = -of_log @ error.T @ right_jacobian(change[:3]) @ motion.by_bias[:3, :3]

    of_0[3:6, 3:] = -cross_matrix(gained) @ R_ic
    by_0[3:6, :3], by_1[3:6, :3] = -R_0.T, R_0.T
    by_0[3:6, 3:] = -motion.by_bias[3:6]
    by_g[3:6] = -dt * R_0.T

    lever = cross_matrix(p_ci)
    of_0[6:9, :3] = R_0.T @ R_w0c
    of_0[6:9, 3:] = -cross_matrix(moved) @ R_ic - R_0.T @ R_w0c @ lever
    of_1[6:9, :3] = -R_0.T @ R_w1c
    of_1[6:9, 3:] = R_0.T @ R_w1c @ lever
    by_0[6:9, :3] = -dt * R_0.T
    by_0[6:9, 3:] = -motion.by_bias[6:]
    by_g[6:9] = -0.5 * dt * dt * R_0.T

    by_0[9:, 3:], by_1[9:, 3:] = -np.eye(6), np.eye(6)
    return r, J


def information(motion: Preintegration, noise: ImuNoise) -> Matrix:
    """Return the ``(15, 15)`` inverse covariance of the residuals of an inertial factor.

    Args:
        noise: gives the random walks of the biases.
    """
    walks = np.repeat(np.square([noise.gyro_walk, noise.accel_walk]), 3) * motion.seconds
    result = np.zeros((N_RESIDUALS, N_RESIDUALS))
    result[:9, :9] = np.linalg.inv(motion.covariance)
    result[9:, 9:] = np.diag(1.0 / walks)
    return result
