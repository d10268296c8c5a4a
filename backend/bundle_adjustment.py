"""Bundle adjustment of keyframe poses and landmarks: Levenberg-Marquardt on the Schur complement.

As in ORB-SLAM2 (section III-C), the reprojection errors of monocular (u, v) and stereo (u, v,
u_right) observations are minimised with the Huber loss. Landmarks are eliminated one at a time. The
reduced camera system is dense and is solved by Cholesky factorisation (Triggs et al., "Bundle
adjustment - a modern synthesis", section 6).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.backend.inertial_factor import InertialLinks
from vslam.support.kernels import inner_kernel, kernel
from vslam.types.geometry import compose, orthonormalised, se3_exp
from vslam.types.reprojection import chi_square, residual, unpacked


@dataclass(frozen=True)
class BundleProblem:
    """The input of bundle adjustment: K cameras, P landmarks, and O observations, sorted by
    landmark.

    Attributes:
        T_cw: ``(K, 4, 4)`` poses of the cameras (world to camera).
        n_free: number of cameras that are optimised. They come first in ``T_cw``. All other cameras
            are held fixed.
        points: ``(P, 3)`` landmarks in the world frame.
        first: ``(P + 1,)`` int64; the observations of point p are ``first[p]:first[p + 1]``.
        camera: ``(O,)`` int64, index of the camera of each observation.
        uvr: ``(O, 3)`` float64 observed u, v, u_right, in pixels; u_right is NaN for a monocular
            observation.
        inverse_sigma2: ``(O,)`` float64, inverse variance of u and v.
        intrinsics: ``(6,)``, see ``Camera.intrinsics``.
        disparity_weight: ``(O,)`` float64, ratio of the standard deviation of u and v to the
            standard deviation of the disparity; None uses the ratio in ``intrinsics``.
        gravity, gravity_sigma: ``(K, 3)`` and ``(K,)``, see ``PoseGraph``; None if gravity is
            unknown. Only global bundle adjustment uses them.
        links: inertial factors between keyframes; None if there are none. Only global bundle
            adjustment uses them.
    """

    T_cw: NDArray[np.float64]
    n_free: int
    points: NDArray[np.float64]
    first: NDArray[np.int64]
    camera: NDArray[np.int64]
    uvr: NDArray[np.float64]
    inverse_sigma2: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    disparity_weight: NDArray[np.float64] | None = None
    gravity: NDArray[np.float64] | None = None
    gravity_sigma: NDArray[np.float64] | None = None
    links: InertialLinks | None = None

    def disparity_weights(self) -> NDArray[np.float64]:
        """Return ``(O,)`` float64: ``disparity_weight``, or the ratio in ``intrinsics`` if it is
        None."""
        if self.disparity_weight is not None:
            return self.disparity_weight
        return np.full(len(self.camera), self.intrinsics[5])


class Observations(NamedTuple):
    """The observations of a ``BundleProblem``, as arguments of kernels. ``used`` is an ``(O,)``
    bool mask of the observations that are used."""

    first: NDArray[np.int64]
    camera: NDArray[np.int64]
    uvr: NDArray[np.float64]
    inverse_sigma2: NDArray[np.float64]
    disparity_weight: NDArray[np.float64]
    used: NDArray[np.bool_]
    intrinsics: NDArray[np.float64]


class NormalEquations(NamedTuple):
    """The block-wise normal equations of Gauss-Newton.

    Attributes:
        W: ``(O, 3, 6)`` blocks that couple a point and a camera, one block for each observation.
        V, g: ``(P, 3, 3)`` Hessian and ``(P, 3)`` right-hand side of the points.
        U, b: ``(K, 6, 6)`` Hessian and ``(K, 6)`` right-hand side of the free cameras.
    """

    W: NDArray[np.float64]
    V: NDArray[np.float64]
    g: NDArray[np.float64]
    U: NDArray[np.float64]
    b: NDArray[np.float64]


@dataclass(frozen=True)
class BundleSolution:
    """The result of bundle adjustment.

    Attributes:
        T_cw: ``(K, 4, 4)`` poses of the cameras (world to camera).
        points: ``(P, 3)`` landmarks in the world frame.
        cost: half the sum of the Huber losses.
        inlier: ``(O,)`` bool, True for observations that pass the chi-square test.
    """

    T_cw: NDArray[np.float64]
    points: NDArray[np.float64]
    cost: float
    inlier: NDArray[np.bool_]
    iterations: int


def adjust(
    problem: BundleProblem,
    *,
    iterations: int,
    use: NDArray[np.bool_] | None = None,
    tolerance: float = 1e-6,
) -> BundleSolution:
    """Minimise the robust reprojection error by Levenberg-Marquardt.

    Args:
        use: ``(O,)`` bool mask of the observations that are used; None uses all.
        tolerance: the optimisation stops when an iteration reduces the cost by a smaller fraction
            than this.
    """
    T_cw, points, cost, inlier, count = _adjust(
        problem.T_cw,
        problem.n_free,
        problem.points,
        observations_of(problem, use),
        empty_equations(problem.n_free, len(problem.points), len(problem.camera)),
        iterations,
        tolerance,
    )
    return BundleSolution(T_cw, points, cost, inlier, count)


def observations_of(problem: BundleProblem, use: NDArray[np.bool_] | None) -> Observations:
    """Convert the observations of a bundle problem to the form in which kernels take them. ``use``
    is an ``(O,)`` bool mask of the observations that are used; None uses all."""
    return Observations(
        problem.first,
        problem.camera,
        problem.uvr,
        problem.inverse_sigma2,
        problem.disparity_weights(),
        np.ones(len(problem.camera), np.bool_) if use is None else use,
        problem.intrinsics,
    )


def empty_equations(n_free: int, n_points: int, n_observations: int) -> NormalEquations:
    """Allocate arrays for the normal equations. The array W is filled with 0, because its blocks
    for fixed cameras and unused observations are never written."""
    return NormalEquations(
        np.zeros((n_observations, 3, 6)),
        np.empty((n_points, 3, 3)),
        np.empty((n_points, 3)),
        np.empty((n_free, 6, 6)),
        np.empty((n_free, 6)),
    )


@inner_kernel
def _in_camera(T, p, q):
    for i in range(3):
        q[i] = T[i, 0] * p[0] + T[i, 1] * p[1] + T[i, 2] * p[2] + T[i, 3]


@kernel
def robust_cost(T_cw, points, observations, inlier):
    """Compute half the sum of the Huber losses, and write into ``inlier`` whether each observation
    passes the chi-square test."""
    first, camera, uvr, inverse_sigma2, disparity_weight, used, intrinsics = observations
    fx, fy, cx, cy, bf, _ = unpacked(intrinsics)
    cost = 0.0
    q = np.empty(3)
    for p in range(len(points)):
        for o in range(first[p], first[p + 1]):
            _in_camera(T_cw[camera[o]], points[p], q)
            pinhole = (fx, fy, cx, cy, bf, disparity_weight[o])
            r_u, r_v, r_disparity, stereo = residual(
                q[0], q[1], q[2], uvr[o, 0], uvr[o, 1], uvr[o, 2], pinhole
            )
            chi2, limit = chi_square(r_u, r_v, r_disparity, stereo, inverse_sigma2[o])
            inlier[o] = q[2] > 0.0 and chi2 <= limit
            if used[o]:
                cost += 0.5 * chi2 if chi2 <= limit else np.sqrt(chi2 * limit) - 0.5 * limit
    return cost


@kernel
def _adjust(T_start, n_free, points_start, observations, equations, iterations, tolerance):
    n_points, n_observations = len(points_start), len(observations.camera)
    size = 6 * n_free
    T_cw, points = T_start.copy(), points_start.copy()
    T_trial, points_trial = T_start.copy(), points_start.copy()
    inlier = np.ones(n_observations, np.bool_)
    cost = robust_cost(T_cw, points, observations, inlier)
    S, rhs = np.empty((size, size)), np.empty(size)
    V_inverse = np.empty((n_points, 3, 3))
    damping, growth = 1e-5, 2.0
    done = 0
    for _ in range(iterations):
        linearise(T_cw, n_free, points, observations, equations)
        improved, small = False, False
        for _ in range(8):
            reduce_points(n_free, observations, equations, damping, S, rhs, V_inverse)
            solved = cholesky_solve(S, rhs)
            if solved:
                step_points(n_free, observations, equations, rhs, V_inverse, points, points_trial)
                step_cameras(n_free, rhs, T_cw, T_trial)
                trial = robust_cost(T_trial, points_trial, observations, inlier)
                if trial < cost:
                    small = cost - trial < tolerance * cost
                    cost = trial
                    # Swap instead of copying. The next step overwrites the whole trial.
                    T_cw, T_trial = T_trial, T_cw
                    points, points_trial = points_trial, points
                    damping, growth, improved = max(damping * 0.1, 1e-9), 2.0, True
                    break
            damping *= growth * 5.0
            growth *= 2.0
        done += 1
        if not improved or small:
            break
    cost = robust_cost(T_cw, points, observations, inlier)
    return T_cw, points, cost, inlier, done


@kernel
def linearise(T_cw, n_free, points, observations, equations):
    """Linearise the reprojection errors, and write the normal equations into ``equations``."""
    first, camera, uvr, inverse_sigma2, disparity_weight, used, intrinsics = observations
    W, V, g, U, b = equations
    fx, fy, cx, cy, bf, _ = unpacked(intrinsics)
    U[:] = 0.0
    b[:] = 0.0
    q = np.empty(3)
    C, P = np.empty((3, 6)), np.empty((3, 3))
    for p in range(len(points)):
        v00, v01, v02, v11, v12, v22 = 1e-9, 0.0, 0.0, 1e-9, 0.0, 1e-9
        g0, g1, g2 = 0.0, 0.0, 0.0
        for o in range(first[p], first[p + 1]):
            if not used[o]:
                continue
            k = camera[o]
            T = T_cw[k]
            _in_camera(T, points[p], q)
            pinhole = (fx, fy, cx, cy, bf, disparity_weight[o])
            r0, r1, r2, stereo = residual(
                q[0], q[1], q[2], uvr[o, 0], uvr[o, 1], uvr[o, 2], pinhole
            )
            weight = inverse_sigma2[o]
            chi2, limit = chi_square(r0, r1, r2, stereo, weight)
            if chi2 > limit:
                weight *= np.sqrt(limit / chi2)
            iz = 1.0 / q[2]
            a = fx * iz
            c = -fx * q[0] * iz * iz
            e = fy * iz
            f = -fy * q[1] * iz * iz
            h = disparity_weight[o] * bf * iz * iz if stereo else 0.0
            # Rows of d(u, v, -disparity)/d(point): projection times rotation.
            for i in range(3):
                P[0, i] = a * T[0, i] + c * T[2, i]
                P[1, i] = e * T[1, i] + f * T[2, i]
                P[2, i] = h * T[2, i]
            w0, w1, w2 = weight * r0, weight * r1, weight * r2
            g0 += P[0, 0] * w0 + P[1, 0] * w1 + P[2, 0] * w2
            g1 += P[0, 1] * w0 + P[1, 1] * w1 + P[2, 1] * w2
            g2 += P[0, 2] * w0 + P[1, 2] * w1 + P[2, 2] * w2
            v00 += weight * (P[0, 0] * P[0, 0] + P[1, 0] * P[1, 0] + P[2, 0] * P[2, 0])
            v01 += weight * (P[0, 0] * P[0, 1] + P[1, 0] * P[1, 1] + P[2, 0] * P[2, 1])
            v02 += weight * (P[0, 0] * P[0, 2] + P[1, 0] * P[1, 2] + P[2, 0] * P[2, 2])
            v11 += weight * (P[0, 1] * P[0, 1] + P[1, 1] * P[1, 1] + P[2, 1] * P[2, 1])
            v12 += weight * (P[0, 1] * P[0, 2] + P[1, 1] * P[1, 2] + P[2, 1] * P[2, 2])
            v22 += weight * (P[0, 2] * P[0, 2] + P[1, 2] * P[1, 2] + P[2, 2] * P[2, 2])
            if k >= n_free:
                continue
            x, y, z = q[0], q[1], q[2]
            C[0, 0], C[0, 1], C[0, 2] = a, 0.0, c
            C[0, 3], C[0, 4], C[0, 5] = c * y, a * z - c * x, -a * y
            C[1, 0], C[1, 1], C[1, 2] = 0.0, e, f
            C[1, 3], C[1, 4], C[1, 5] = -e * z + f * y, -f * x, e * x
            C[2, 0], C[2, 1], C[2, 2] = 0.0, 0.0, h
            C[2, 3], C[2, 4], C[2, 5] = h * y, -h * x, 0.0
            block, vector = U[k], b[k]
            for i in range(6):
                c0, c1, c2 = weight * C[0, i], weight * C[1, i], weight * C[2, i]
                vector[i] += c0 * r0 + c1 * r1 + c2 * r2
                for j in range(6):
                    block[i, j] += c0 * C[0, j] + c1 * C[1, j] + c2 * C[2, j]
                for j in range(3):
                    W[o, j, i] = c0 * P[0, j] + c1 * P[1, j] + c2 * P[2, j]
        V[p, 0, 0], V[p, 0, 1], V[p, 0, 2] = v00, v01, v02
        V[p, 1, 0], V[p, 1, 1], V[p, 1, 2] = v01, v11, v12
        V[p, 2, 0], V[p, 2, 1], V[p, 2, 2] = v02, v12, v22
        g[p, 0], g[p, 1], g[p, 2] = g0, g1, g2


@inner_kernel
def reduce_points(n_free, observations, equations, damping, S, rhs, V_inverse):
    """Eliminate the points from the normal equations by the Schur complement.

    The upper triangle of the reduced camera system ``S x = rhs`` is written into ``S`` and ``rhs``.
    The inverses of the damped point blocks are written into ``V_inverse``.
    """
    first, camera, used = observations.first, observations.camera, observations.used
    W, V, g, U, b = equations
    S[:] = 0.0
    for k in range(n_free):
        for i in range(6):
            rhs[6 * k + i] = b[k, i]
            for j in range(6):
                S[6 * k + i, 6 * k + j] = U[k, i, j]
            S[6 * k + i, 6 * k + i] *= 1.0 + damping
    Y = np.empty((3, 6))
    for p in range(len(V)):
        N = V_inverse[p]
        invert_damped(V[p], damping, N)
        for o in range(first[p], first[p + 1]):
            k = camera[o]
            if k >= n_free or not used[o]:
                continue
            w = W[o]
            for i in range(6):
                w0, w1, w2 = w[0, i], w[1, i], w[2, i]
                Y[0, i] = N[0, 0] * w0 + N[0, 1] * w1 + N[0, 2] * w2
                Y[1, i] = N[1, 0] * w0 + N[1, 1] * w1 + N[1, 2] * w2
                Y[2, i] = N[2, 0] * w0 + N[2, 1] * w1 + N[2, 2] * w2
                rhs[6 * k + i] -= Y[0, i] * g[p, 0] + Y[1, i] * g[p, 1] + Y[2, i] * g[p, 2]
            for other in range(first[p], first[p + 1]):
                # Visit each pair of cameras once, for the upper triangle.
                m = camera[other]
                if m < k or m >= n_free or not used[other]:
                    continue
                w = W[other]
                for i in range(6):
                    y0, y1, y2 = Y[0, i], Y[1, i], Y[2, i]
                    target = S[6 * k + i, 6 * m : 6 * m + 6]
                    for j in range(6):
                        target[j] -= y0 * w[0, j] + y1 * w[1, j] + y2 * w[2, j]


@kernel
def reduced_system(n_free, observations, equations, damping, S, rhs, V_inverse):
    """Do the same as ``reduce_points``, for callers that are not kernels. ``S`` and ``rhs`` may
    have further unknowns after the cameras."""
    reduce_points(n_free, observations, equations, damping, S, rhs, V_inverse)


@inner_kernel
def invert_damped(V, damping, N):
    """Damp the diagonal of a point's ``(3, 3)`` block, and write the inverse of the block into
    ``N``. If the block is singular, zeros are written, so that the point does not move."""
    scale = 1.0 + damping
    v00, v11, v22 = V[0, 0] * scale, V[1, 1] * scale, V[2, 2] * scale
    v01, v02, v12 = V[0, 1], V[0, 2], V[1, 2]
    i00, i01, i02 = v11 * v22 - v12 * v12, v02 * v12 - v01 * v22, v01 * v12 - v02 * v11
    determinant = v00 * i00 + v01 * i01 + v02 * i02
    inverse = 1.0 / determinant if determinant > 0.0 else 0.0
    N[0, 0], N[0, 1], N[0, 2] = i00 * inverse, i01 * inverse, i02 * inverse
    N[1, 1] = (v00 * v22 - v02 * v02) * inverse
    N[1, 2] = (v01 * v02 - v00 * v12) * inverse
    N[2, 2] = (v00 * v11 - v01 * v01) * inverse
    N[1, 0], N[2, 0], N[2, 1] = N[0, 1], N[0, 2], N[1, 2]


@kernel
def step_points(n_free, observations, equations, camera_step, V_inverse, points, points_trial):
    """Compute the steps of the points from the steps of the cameras (back-substitution)."""
    first, camera, used = observations.first, observations.camera, observations.used
    W, g = equations.W, equations.g
    for p in range(len(points)):
        d0, d1, d2 = g[p, 0], g[p, 1], g[p, 2]
        for o in range(first[p], first[p + 1]):
            k = camera[o]
            if k >= n_free or not used[o]:
                continue
            for i in range(6):
                s = camera_step[6 * k + i]
                d0 -= W[o, 0, i] * s
                d1 -= W[o, 1, i] * s
                d2 -= W[o, 2, i] * s
        N = V_inverse[p]
        for i in range(3):
            points_trial[p, i] = points[p, i] + N[i, 0] * d0 + N[i, 1] * d1 + N[i, 2] * d2


@kernel
def step_cameras(n_free, camera_step, T_cw, T_trial):
    """Move each free camera by its step, which is a twist.

    Matrices are copied element by element, because Numba takes seconds to compile the broadcasting
    check of a whole-array assignment.
    """
    for k in range(n_free):
        T = orthonormalised(compose(se3_exp(camera_step[6 * k : 6 * k + 6]), T_cw[k]))
        for i in range(4):
            for j in range(4):
                T_trial[k, i, j] = T[i, j]


@kernel
def cholesky_solve(S, x):
    """Solve the linear system ``S x = rhs`` in place. ``x`` holds the right-hand side on entry and
    the solution on return. Only the upper triangle of S is read. Returns False if S is not positive
    definite."""
    n = len(x)
    for i in range(n):
        row = S[i]
        if not row[i] > 0.0:
            return False
        pivot = np.sqrt(row[i])
        inverse = 1.0 / pivot
        row[i] = pivot
        for j in range(i + 1, n):
            row[j] *= inverse
        for k in range(i + 1, n):
            factor = row[k]
            if factor == 0.0:
                continue
            target = S[k, k:]
            source = row[k:]
            for j in range(np.uintp(n - k)):
                target[j] -= factor * source[j]
    for i in range(n):
        value = x[i] / S[i, i]
        x[i] = value
        for j in range(i + 1, n):
            x[j] -= S[i, j] * value
    for i in range(n - 1, -1, -1):
        value = x[i]
        for j in range(i + 1, n):
            value -= S[i, j] * x[j]
        x[i] = value / S[i, i]
    return True
