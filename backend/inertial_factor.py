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

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.backend.preintegration import (
    Preintegration,
    cross_matrix,
    inverse_right_jacobian,
    right_jacobian,
    so3_exp,
    so3_log,
    times,
)
from vslam.support.kernels import inner_kernel, kernel
from vslam.types.geometry import Matrix

N_RESIDUALS = 15


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
        ``(15, 33)`` derivatives by the increments of both poses (columns 0 to 11), of both states
        (columns 12 to 29), and of gravity.
    """
    return _factor(
        motion.seconds,
        motion.rotation,
        motion.velocity,
        motion.position,
        motion.bias,
        motion.by_bias,
        T_0w,
        T_1w,
        state_0,
        state_1,
        gravity,
        T_imu_camera,
    )


@inner_kernel
def _fill(J, row, column, block):
    for i in range(3):
        for j in range(3):
            J[row + i, column + j] = block[i, j]


@inner_kernel
def _applied(A, v):
    result = np.empty(3)
    for i in range(3):
        result[i] = A[i, 0] * v[0] + A[i, 1] * v[1] + A[i, 2] * v[2]
    return result


@kernel
def _factor(
    dt, rotation, velocity, position, bias, by_bias, T_0w, T_1w, state_0, state_1, gravity, T_ic
):
    R_ic = T_ic[:3, :3]
    p_ci = -_applied(R_ic.T, T_ic[:3, 3])
    R_w0c, R_w1c = T_0w[:3, :3].T, T_1w[:3, :3].T
    R_0, R_1 = times(R_w0c, R_ic.T), times(R_w1c, R_ic.T)
    p_0, p_1 = _applied(R_w0c, p_ci - T_0w[:3, 3]), _applied(R_w1c, p_ci - T_1w[:3, 3])
    change = np.zeros(9)
    for i in range(9):
        for j in range(6):
            change[i] += by_bias[i, j] * (state_0[3 + j] - bias[j])
    error = times(times(rotation, so3_exp(change[:3])).T, times(R_0.T, R_1))
    gained = _applied(R_0.T, state_1[:3] - state_0[:3] - gravity * dt)
    moved = _applied(R_0.T, p_1 - p_0 - state_0[:3] * dt - 0.5 * dt * dt * gravity)

    r, J = np.empty(15), np.zeros((15, 33))
    turn = so3_log(error)
    for i in range(3):
        r[i] = turn[i]
        r[3 + i] = gained[i] - velocity[i] - change[3 + i]
        r[6 + i] = moved[i] - position[i] - change[6 + i]
    for i in range(6):
        r[9 + i] = state_1[3 + i] - state_0[3 + i]
        J[9 + i, 15 + i], J[9 + i, 24 + i] = -1.0, 1.0
        for j in range(6):
            J[3 + j, 15 + i] = -by_bias[3 + j, i]

    of_log = inverse_right_jacobian(turn)
    _fill(J, 0, 3, times(of_log, times(times(R_1.T, R_0), R_ic)))
    _fill(J, 0, 9, -times(of_log, R_ic))
    by_rate = times(right_jacobian(change[:3]), by_bias[:3, :3])
    _fill(J, 0, 15, -times(of_log, times(error.T, by_rate)))

    _fill(J, 3, 3, -times(cross_matrix(gained), R_ic))
    _fill(J, 3, 12, -R_0.T)
    _fill(J, 3, 21, R_0.T)
    _fill(J, 3, 30, -dt * R_0.T)

    lever, of_0, of_1 = cross_matrix(p_ci), times(R_0.T, R_w0c), times(R_0.T, R_w1c)
    _fill(J, 6, 0, of_0)
    _fill(J, 6, 3, -times(cross_matrix(moved), R_ic) - times(of_0, lever))
    _fill(J, 6, 6, -of_1)
    _fill(J, 6, 9, times(of_1, lever))
    _fill(J, 6, 12, -dt * R_0.T)
    _fill(J, 6, 30, -0.5 * dt * dt * R_0.T)
    return r, J


class Motions(NamedTuple):
    """N motions between two keyframes each, as an argument of kernels.

    Attributes:
        seconds: ``(N,)``.
        rotation, velocity, position, bias, by_bias: ``(N, 3, 3)``, ``(N, 3)``, ``(N, 3)``,
            ``(N, 6)`` and ``(N, 9, 6)``, see ``Preintegration``.
        information: ``(N, 15, 15)`` inverse covariances of the residuals.
        T_imu_camera: ``(N, 4, 4)``, maps points of the camera to the IMU.
    """

    seconds: Matrix
    rotation: Matrix
    velocity: Matrix
    position: Matrix
    bias: Matrix
    by_bias: Matrix
    information: Matrix
    T_imu_camera: Matrix

    def some(self, which: slice | NDArray[np.bool_]) -> Motions:
        """Return some of these motions."""
        return Motions._make(column[which] for column in self)


@dataclass(frozen=True, eq=False)
class InertialLinks:
    """Motions between keyframes of a bundle problem.

    Attributes:
        first, last: ``(N,)`` int64 indices of the keyframes at both ends of each motion. A keyframe
            is the first one, and the last one, of at most one motion.
        motions: the motions.
        gravity: ``(3,)`` start value of the acceleration of free fall in the world, m/s^2.
    """

    first: NDArray[np.int64]
    last: NDArray[np.int64]
    motions: Motions
    gravity: Matrix


@inner_kernel
def factor_of(motions, k, T_0w, T_1w, state_0, state_1, gravity):
    """Compute the residuals of a motion and their derivatives (``inertial_factor``)."""
    return _factor(
        motions.seconds[k],
        motions.rotation[k],
        motions.velocity[k],
        motions.position[k],
        motions.bias[k],
        motions.by_bias[k],
        T_0w,
        T_1w,
        state_0,
        state_1,
        gravity,
        motions.T_imu_camera[k],
    )


@kernel
def add_factors(motions, camera, T_cw, n_free, inertial, hessian, gradient):
    """Add the inertial factors between consecutive keyframes to the normal equations.

    Args:
        camera: ``(N + 1,)`` int64, indices of the keyframes.
        T_cw: ``(K, 4, 4)`` poses, of which the first ``n_free`` are optimised.
        inertial: gravity, and the state of each of these keyframes (``inertial_factor``).
        hessian, gradient: of the increments of the free cameras, of gravity, and of the states.
            Only the upper triangle of the Hessian is written.

    Returns:
        Chi-square of all residuals, and of those of rotation, velocity and position.
    """
    at = np.empty(33, np.int64)
    n_poses = 6 * n_free
    gravity = inertial[:3]
    chi2, of_motion = 0.0, 0.0
    for k in range(len(motions.seconds)):
        first = 3 + 9 * k
        r, J = factor_of(
            motions,
            k,
            T_cw[camera[k]],
            T_cw[camera[k + 1]],
            inertial[first : first + 9],
            inertial[first + 9 : first + 18],
            gravity,
        )
        for i in range(6):
            for end in range(2):
                at[6 * end + i] = 6 * camera[k + end] + i if camera[k + end] < n_free else -1
        for i in range(18):
            at[12 + i] = n_poses + first + i
        for i in range(3):
            at[30 + i] = n_poses + i
        one, moved = add_residuals(r, J, motions.information[k], at, hessian, gradient)
        chi2 += one
        of_motion += moved
    return chi2, of_motion


@kernel
def add_prior(error, information, n_free, hessian, gradient):
    """Add a prior of gravity and of the biases of the first keyframe, and return its chi-square.

    Args:
        error: ``(9,)`` deviation of gravity and the biases from what is expected.
        n_free, hessian, gradient: see ``add_factors``.
    """
    at = np.arange(6 * n_free, 6 * n_free + 9)
    at[3:] += 3  # the velocity is between gravity and the biases
    chi2, _ = add_residuals(error, np.eye(9), information, at, hessian, gradient)
    return chi2


@inner_kernel
def add_residuals(r, J, information, at, hessian, gradient):
    """Add residuals to the normal equations.

    Args:
        at: index of the unknown of each column of ``J``; -1 if it is held fixed.

    Returns:
        Chi-square of all residuals, and of the first nine.
    """
    n, m = J.shape
    weighted, error = np.zeros((n, m)), np.zeros(n)
    chi2, of_motion = 0.0, 0.0
    for i in range(n):
        for k in range(n):
            w = information[i, k]
            if w != 0.0:
                error[i] += w * r[k]
                for j in range(m):
                    weighted[i, j] += w * J[k, j]
        chi2 += r[i] * error[i]
        if i < 9:
            of_motion += r[i] * error[i]
    for a in range(m):
        row = at[a]
        if row < 0:
            continue
        for i in range(n):
            value = J[i, a]
            if value == 0.0:
                continue
            gradient[row] -= value * error[i]
            for b in range(m):
                if at[b] >= row:
                    hessian[row, at[b]] += value * weighted[i, b]
    return chi2, of_motion
