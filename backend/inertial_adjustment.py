"""Local bundle adjustment with the samples of an IMU.

The newest keyframes, in the order of time, get a velocity and biases. Inertial factors
(``backend/inertial_factor.py``) connect consecutive keyframes, and gravity is a further unknown.
Landmarks are eliminated as without an IMU. Then, the factors are added to the dense reduced system
of the cameras. The velocities, biases and gravity exist only during one adjustment: the poses give
good start values, and a prior brings what the filter has learned of gravity and the biases.

A window in which samples and images do not agree is adjusted without the samples.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vslam.backend.bundle_adjustment import (
    BundleProblem,
    BundleSolution,
    cholesky_solve,
    empty_equations,
    linearise,
    observations_of,
    reduced_system,
    robust_cost,
    step_cameras,
    step_points,
)
from vslam.backend.inertial_factor import Motions, add_factors, add_prior
from vslam.backend.inertial_filter import FALL_AND_BIAS
from vslam.types.geometry import Matrix, inverses
from vslam.types.imu import InertialWindow

N_STATE = 9  # velocity and biases of a keyframe
# The mean chi-square of the residuals of rotation, velocity and position per factor, above which
# samples and images do not agree. Each factor has nine residuals. Real samples of EuRoC with
# simulated observations have at most 7.7, rendered drives at most 1. Samples that are 15 ms late,
# or stretched by 5 %, have 29 or more with the samples of EuRoC. [own]
MAX_MISFIT = 9.0


@dataclass(frozen=True, eq=False)
class InertialChain:
    """Keyframes that inertial factors connect, in the order of time.

    Attributes:
        camera: ``(M,)`` int64, indices of the keyframes in the bundle problem.
        motions: the M - 1 motions between consecutive keyframes.
        gravity: ``(3,)`` expected acceleration of free fall in the world, m/s^2.
        bias: ``(6,)`` expected biases.
        information: ``(9, 9)`` inverse covariance of the expected gravity and biases.
        weight: factor of the information of the motions (``weighed``).
    """

    camera: NDArray[np.int64]
    motions: Motions
    gravity: Matrix
    bias: Matrix
    information: Matrix
    weight: float = 1.0

    @property
    def n_unknowns(self) -> int:
        """Number of unknowns besides the poses: gravity, and the state of each keyframe."""
        return 3 + N_STATE * len(self.camera)

    def weighed(self, noise_factor: float, variance: float) -> InertialChain:
        """Weigh the samples against images as both really err.

        Args:
            noise_factor: by how much the noise of the samples was enlarged when they were
                integrated. It is taken back.
            variance: mean square of the residuals of the images, divided by the expected one. All
                other information is multiplied by it, which weighs the images by its inverse, and
                leaves the limits for their outliers as they are.
        """
        weight = variance * noise_factor**2
        information = variance * self.motions.information
        information[:, :9, :9] *= noise_factor**2
        return replace(
            self,
            motions=self.motions._replace(information=information),
            information=variance * self.information,
            weight=weight,
        )


def chain_of(
    window: InertialWindow,
    motions: Motions,
    camera: NDArray[np.int64],
    R_world_camera: Matrix,
) -> InertialChain | None:
    """Connect keyframes by inertial factors. None if the last motion is unknown.

    The chain begins after the last unknown motion.

    Args:
        motions: between M keyframes, in the order of time.
        camera: ``(M,)`` indices of these keyframes in the bundle problem.
        R_world_camera: ``(3, 3)`` rotation of the last of these keyframes.
    """
    unknown = np.flatnonzero(motions.seconds == 0.0)
    first = int(unknown[-1]) + 1 if len(unknown) else 0
    if first == len(motions.seconds):
        return None
    state, R_world_odom = window.state, R_world_camera @ window.R_odom_camera.T
    to_world = np.eye(9)
    to_world[:3, :3] = R_world_odom
    covariance = state.covariance[FALL_AND_BIAS, FALL_AND_BIAS]
    expected = np.linalg.inv(to_world @ covariance @ to_world.T)
    return InertialChain(
        camera[first:],
        motions.some(slice(first, None)),
        R_world_odom @ state.gravity,
        state.bias,
        0.5 * (expected + expected.T),
    )


def adjust_with_imu(
    problem: BundleProblem,
    chain: InertialChain,
    *,
    iterations: int,
    use: NDArray[np.bool_] | None = None,
    tolerance: float = 1e-6,
) -> BundleSolution | None:
    """Minimise the reprojection errors and the residuals of the inertial factors together, by
    Levenberg-Marquardt.

    Args:
        use, tolerance: see ``adjust``.

    Returns:
        The solution, whose cost contains that of the factors. None if samples and images do not
        agree.
    """
    n_free, n_poses = problem.n_free, 6 * problem.n_free
    observations = observations_of(problem, use)
    equations = empty_equations(n_free, len(problem.points), len(problem.camera))
    size = n_poses + chain.n_unknowns
    S, rhs, V_inverse = (
        np.empty((size, size)),
        np.empty(size),
        np.empty((len(problem.points), 3, 3)),
    )
    inlier = np.ones(len(problem.camera), np.bool_)
    T_cw, points, inertial = problem.T_cw, problem.points, start_values(problem.T_cw, chain)
    factors = linear_factors(T_cw, inertial, chain, n_free)
    cost = robust_cost(T_cw, points, observations, inlier) + factors.cost
    damping, growth, done = 1e-5, 2.0, 0
    while done < iterations:
        done += 1
        linearise(T_cw, n_free, points, observations, equations)
        before = cost
        for _ in range(8):
            reduced_system(n_free, observations, equations, damping, S, rhs, V_inverse)
            S += factors.hessian
            S[np.diag_indices(size)] += damping * np.diag(factors.hessian)
            rhs[n_poses:] = 0.0
            rhs += factors.gradient
            if cholesky_solve(S, rhs):
                T_trial, points_trial = T_cw.copy(), points.copy()
                step_points(n_free, observations, equations, rhs, V_inverse, points, points_trial)
                step_cameras(n_free, rhs, T_cw, T_trial)
                trial = linear_factors(T_trial, inertial + rhs[n_poses:], chain, n_free)
                total = robust_cost(T_trial, points_trial, observations, inlier) + trial.cost
                if total < cost:
                    T_cw, points, cost, factors = T_trial, points_trial, total, trial
                    inertial = inertial + rhs[n_poses:]
                    damping, growth = max(damping * 0.1, 1e-9), 2.0
                    break
            damping *= growth * 5.0
            growth *= 2.0
        if not cost < before * (1.0 - tolerance):
            break
    if not factors.misfit <= MAX_MISFIT:
        return None
    robust_cost(T_cw, points, observations, inlier)
    return BundleSolution(T_cw, points, cost, inlier, done)


@dataclass(frozen=True, eq=False)
class LinearFactors:
    """The inertial factors and the prior, linearised.

    Attributes:
        hessian, gradient: ``(S, S)``, of which only the upper triangle is used, and ``(S,)`` of
            the unknowns: the increments of the free cameras, of gravity, and of the states of the
            keyframes.
        cost: half the sum of the squared residuals.
        misfit: mean chi-square of the residuals of rotation, velocity and position, with the noise
            with which the samples were integrated.
    """

    hessian: Matrix
    gradient: Matrix
    cost: float
    misfit: float


def start_values(T_cw: Matrix, chain: InertialChain) -> Matrix:
    """Return ``(U,)`` gravity and the states of the keyframes, for given ``(K, 4, 4)`` poses."""
    g, motions = chain.gravity, chain.motions
    states = np.tile(np.r_[np.zeros(3), chain.bias], (len(chain.camera), 1))
    poses = inverses(motions.T_imu_camera[0] @ T_cw[chain.camera])
    R, t = poses[:-1, :3, :3], motions.seconds[:, None]
    moved = np.diff(poses[:, :3, 3], axis=0) - np.einsum("nij,nj->ni", R, motions.position)
    states[:-1, :3] = moved / t - 0.5 * t * g
    gained = t * g + np.einsum("nij,nj->ni", R, motions.velocity)
    states[-1, :3] = states[-2, :3] + gained[-1]
    return np.concatenate([g, states.ravel()])


def linear_factors(
    T_cw: Matrix, inertial: Matrix, chain: InertialChain, n_free: int
) -> LinearFactors:
    """Linearise the factors of a chain.

    Args:
        T_cw: ``(K, 4, 4)`` poses, of which the first ``n_free`` are optimised.
        inertial: ``(U,)`` gravity and the states of the keyframes.
    """
    size = 6 * n_free + len(inertial)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    chi2, of_motion = add_factors(
        chain.motions, chain.camera, T_cw, n_free, inertial, hessian, gradient
    )
    error = np.concatenate([inertial[:3] - chain.gravity, inertial[6:12] - chain.bias])
    chi2 += add_prior(error, chain.information, n_free, hessian, gradient)
    misfit = of_motion / (chain.weight * len(chain.motions.seconds))
    return LinearFactors(hessian, gradient, 0.5 * chi2, misfit)
