"""Global bundle adjustment: optimises hundreds of keyframes whose trajectory contains loops.

The problem, the loss and the optimisation steps are the same as in ``bundle_adjustment``. Only the
reduced camera system is solved differently. Keyframes that share no landmark are not coupled in
this system. It is therefore stored as sparse 6x6 blocks and factorised by ``block_cholesky``
(Triggs et al., "Bundle adjustment - a modern synthesis", section 6.3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vslam.backend.block_cholesky import analyse, factor_solve, panel
from vslam.backend.bundle_adjustment import (
    BundleProblem,
    BundleSolution,
    NormalEquations,
    Observations,
    empty_equations,
    invert_damped,
    linearise,
    robust_cost,
    step_cameras,
    step_points,
)
from vslam.backend.inertial_adjustment import MAX_MISFIT
from vslam.backend.inertial_links import LinkedStates
from vslam.support.kernels import inner_kernel, kernel


def adjust_globally(
    problem: BundleProblem,
    *,
    iterations: int,
    tolerance: float = 1e-6,
    stop: Callable[[], bool] | None = None,
) -> BundleSolution:
    """Minimise the robust reprojection error of many keyframes, like ``bundle_adjustment.adjust``,
    but exploiting the sparsity of the problem. The global interpreter lock is released nearly all
    the time.

    Args:
        problem: a keyframe must not observe a landmark more than once.
        tolerance: the optimisation stops when an iteration reduces the cost by a smaller fraction
            than this.
        stop: called before each iteration. If it returns True, the current estimate is returned.

    Inertial factors that do not agree with the images are not used.
    """
    if problem.links is not None:
        solution, misfit = _adjusted(problem, iterations, tolerance, stop)
        if misfit <= MAX_MISFIT:
            return solution
    return _adjusted(replace(problem, links=None), iterations, tolerance, stop)[0]


def _adjusted(
    problem: BundleProblem, iterations: int, tolerance: float, stop: Callable[[], bool] | None
) -> tuple[BundleSolution, float]:
    """Do what ``adjust_globally`` does. Also return the misfit of the inertial factors."""
    n_cameras, n_observations, states = problem.n_free, len(problem.camera), None
    if problem.links is not None:
        states = LinkedStates.of(problem.links, problem.T_cw, n_cameras)
        problem = _with_states(problem, states)
    n_free = problem.n_free
    pairs = coupled_cameras(problem.first, problem.camera, n_free)
    if states is not None:
        pairs = np.concatenate([pairs, states.pairs])
    structure = analyse(n_free, pairs)
    # The free cameras in elimination order, followed by the fixed cameras.
    cameras = np.concatenate([structure.order, np.arange(n_free, len(problem.T_cw))])
    rank = np.argsort(cameras)
    points_order, order = working_order(problem.first, rank[problem.camera], len(cameras))
    observations = Observations(
        first=np.concatenate([[0], np.cumsum(np.diff(problem.first)[points_order])]),
        camera=rank[problem.camera[order]],
        uvr=problem.uvr[order],
        inverse_sigma2=problem.inverse_sigma2[order],
        disparity_weight=problem.disparity_weights()[order],
        used=np.ones(n_observations, np.bool_),
        intrinsics=problem.intrinsics,
    )
    slots = pair_slots(structure, observations.first, observations.camera, n_free)
    T_cw, points = problem.T_cw[cameras], problem.points[points_order]
    T_trial, points_trial = T_cw.copy(), points.copy()
    inlier = np.ones(n_observations, np.bool_)
    level = _Level.of(problem, cameras)
    cost = robust_cost(T_cw, points, observations, inlier) + level.cost(T_cw)
    values, values_trial = np.empty((n_free, 6)), np.empty((n_free, 6))
    if states is not None:
        states = states.in_order(structure.order, rank)
        values = states.start
        cost += states.cost(T_cw, values)
    equations = empty_equations(n_free, len(points), n_observations)
    S, x = np.empty(36 * len(structure.row)), np.empty((n_free, 6))
    V_inverse = np.empty((len(points), 3, 3))
    damping, growth, done = 1e-5, 2.0, 0
    for _ in range(iterations):
        if stop is not None and stop():
            break
        cost -= level.cost(T_cw)
        level = level.turned(T_cw)
        cost += level.cost(T_cw)
        linearise(T_cw, n_free, points, observations, equations)
        level.add_to(equations, T_cw)
        if states is not None:
            states.linearise(T_cw, values)
        improved, small = False, False
        for _ in range(8):
            reduce_points_sparsely(
                structure, slots, n_free, observations, equations, damping, S, x, V_inverse
            )
            if states is not None:
                states.add_to(structure, values, damping, S, x)
            if factor_solve(structure, S, x):
                step = x.reshape(-1)
                step_points(n_free, observations, equations, step, V_inverse, points, points_trial)
                step_cameras(n_free, step, T_cw, T_trial)
                trial = robust_cost(T_trial, points_trial, observations, inlier)
                trial += level.cost(T_trial)
                if states is not None:
                    values_trial = values + x
                    trial += states.cost(T_trial, values_trial)
                if trial < cost:
                    small = cost - trial < tolerance * cost
                    cost = trial
                    T_cw, T_trial = T_trial, T_cw
                    points, points_trial = points_trial, points
                    values, values_trial = values_trial, values
                    damping, growth, improved = max(damping * 0.1, 1e-9), 2.0, True
                    break
            damping *= growth * 5.0
            growth *= 2.0
        done += 1
        if not improved or small:
            break
    cost = robust_cost(T_cw, points, observations, inlier)
    points_trial[points_order] = points
    inlier_unsorted = np.empty_like(inlier)
    inlier_unsorted[order] = inlier
    misfit = 0.0 if states is None else states.misfit(T_cw, values)
    T_cw = np.delete(T_cw[rank], np.s_[n_cameras:n_free], axis=0)
    return BundleSolution(T_cw, points_trial, cost, inlier_unsorted, done), misfit


def _with_states(problem: BundleProblem, states: LinkedStates) -> BundleProblem:
    """Add one camera, which observes nothing, for each block of states. Where gravity is an
    unknown, what a keyframe sensed of it is left out, because it is part of the samples."""
    n, added = problem.n_free, len(states.start) - problem.n_free

    def widened(array: NDArray[np.float64], value: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([array[:n], np.broadcast_to(value, (added, *value.shape)), array[n:]])

    gravity, sigma = problem.gravity, problem.gravity_sigma
    if gravity is not None and sigma is not None and problem.links is not None:
        sigma = sigma.copy()
        sigma[problem.links.first] = sigma[problem.links.last] = 0.0
        gravity, sigma = widened(gravity, np.zeros(3)), widened(sigma, np.zeros(()))
    return replace(
        problem,
        T_cw=widened(problem.T_cw, np.eye(4)),
        n_free=n + added,
        camera=np.where(problem.camera < n, problem.camera, problem.camera + added),
        gravity=gravity,
        gravity_sigma=sigma,
    )


@dataclass(frozen=True)
class _Level:
    """What cameras sense of gravity, as an error to be minimised.

    Attributes:
        down: ``(3,)`` direction of free fall in the world frame.
        known: ``(M,)`` int64 cameras at which gravity is known.
        gravity: ``(M, 3)`` direction of free fall in their frames.
        information: ``(M,)`` inverse variances.
    """

    down: NDArray[np.float64]
    known: NDArray[np.int64]
    gravity: NDArray[np.float64]
    information: NDArray[np.float64]

    @classmethod
    def of(cls, problem: BundleProblem, cameras: NDArray[np.int64]) -> _Level:
        """Take gravity from a problem, whose cameras are sorted."""
        if problem.gravity is None or problem.gravity_sigma is None:
            return cls(np.zeros(3), np.empty(0, np.int64), np.empty((0, 3)), np.empty(0))
        sigma = problem.gravity_sigma[cameras]
        known = np.flatnonzero(sigma > 0.0)
        return cls(np.zeros(3), known, problem.gravity[cameras[known]], sigma[known] ** -2.0)

    def turned(self, T_cw: NDArray[np.float64]) -> _Level:
        """Choose the direction in the world that agrees best with the poses."""
        if not len(self.known):
            return self
        R_cw = T_cw[self.known, :3, :3]
        total = np.einsum("n,nji,nj->i", self.information, R_cw, self.gravity)
        return replace(self, down=total / np.linalg.norm(total))

    def cost(self, T_cw: NDArray[np.float64]) -> float:
        error = T_cw[self.known, :3, :3] @ self.down - self.gravity
        return 0.5 * float(self.information @ (error**2).sum(axis=1))

    def add_to(self, equations: NormalEquations, T_cw: NDArray[np.float64]) -> None:
        """Add the error to the normal equations of the cameras that are optimised."""
        free = self.known < len(equations.U)
        k, w = self.known[free], self.information[free, None]
        found = T_cw[k, :3, :3] @ self.down
        across = np.eye(3) - found[:, :, None] * found[:, None, :]
        equations.U[k, 3:, 3:] += w[:, :, None] * across
        equations.b[k, 3:] += w * np.cross(found, self.gravity[free])


@kernel
def working_order(first, rank, n_cameras):
    """Sort points and observations for cache-friendly access to the reduced camera system.

    The observations of a point are sorted by the elimination order of their cameras. Points are
    sorted by their first camera. Blocks that are written one after another are then close together
    in memory.

    Args:
        first: ``(P + 1,)``, see ``BundleProblem``.
        rank: ``(O,)`` position of each observation's camera in the elimination order.

    Returns:
        ``(P,)`` int64 order of the points and ``(O,)`` int64 order of the observations.
    """
    n_points = len(first) - 1
    start = np.zeros(n_cameras + 2, np.int64)
    earliest = np.full(n_points, n_cameras)
    for p in range(n_points):
        for o in range(first[p], first[p + 1]):
            earliest[p] = min(earliest[p], rank[o])
        start[earliest[p] + 1] += 1
    for k in range(n_cameras + 1):
        start[k + 1] += start[k]
    points = np.empty(n_points, np.int64)
    for p in range(n_points):
        points[start[earliest[p]]] = p
        start[earliest[p]] += 1
    observations = np.empty(len(rank), np.int64)
    n = 0
    for p in points:
        begin = n
        for o in range(first[p], first[p + 1]):
            k = n
            while k > begin and rank[observations[k - 1]] > rank[o]:
                observations[k] = observations[k - 1]
                k -= 1
            observations[k] = o
            n += 1
    return points, observations


@kernel
def coupled_cameras(first, camera, n_free):
    """Return the ``(M, 2)`` int64 pairs of free cameras that observe a common point. Each pair
    occurs once."""
    start, points = points_of_cameras(first, camera, n_free)
    met = np.empty(n_free, np.int64)
    last = np.full(n_free, -1)  # the last camera ``i`` that each camera was paired with
    count = 0
    for i in range(n_free):
        count += cameras_met(i, start, points, first, camera, n_free, last, met)
    last[:] = -1
    pairs = np.empty((count, 2), np.int64)
    count = 0
    for i in range(n_free):
        n = cameras_met(i, start, points, first, camera, n_free, last, met)
        met[:n].sort()
        for k in range(n):
            pairs[count, 0], pairs[count, 1] = i, met[k]
            count += 1
    return pairs


@inner_kernel
def points_of_cameras(first, camera, n_free):
    """List the points that each free camera observes.

    Returns:
        ``start``, int64, and ``points``, ``(N,)`` int32. Camera k observes
        ``points[start[k]:start[k + 1]]``.
    """
    start = np.zeros(n_free + 2, np.int64)
    for o in range(len(camera)):
        if camera[o] < n_free:
            start[camera[o] + 2] += 1
    for k in range(n_free + 1):
        start[k + 1] += start[k]
    points = np.empty(start[n_free + 1], np.int32)
    for p in range(len(first) - 1):
        for o in range(first[p], first[p + 1]):
            if camera[o] < n_free:
                points[start[camera[o] + 1]] = p
                start[camera[o] + 1] += 1
    return start, points


@inner_kernel
def cameras_met(i, start, points, first, camera, n_free, last, met):
    """Write into ``met`` the indices of the free cameras after ``i`` that observe a point of camera
    ``i``, and return their number. The array ``last`` is used to list each camera only once."""
    n = 0
    for p in points[start[i] : start[i + 1]]:
        for o in range(first[p], first[p + 1]):
            j = camera[o]
            if i < j < n_free and last[j] != i:
                last[j] = i
                met[n] = j
                n += 1
    return n


@kernel
def pair_slots(structure, first, camera, n_free):
    """For each pair of observations of the same point, find the block of the Cholesky factor that
    couples their two cameras. Returns ``(N,)`` int32 slots.

    The pairs are in the order in which ``reduce_points_sparsely`` visits them. Cameras are in
    elimination order.
    """
    count = 0
    for p in range(len(first) - 1):
        seen = 0
        for o in range(first[p], first[p + 1]):
            if camera[o] < n_free:
                count += seen
                seen += 1
    slots = np.empty(count, np.int32)
    count = 0
    for p in range(len(first) - 1):
        for o in range(first[p], first[p + 1]):
            if camera[o] >= n_free:
                continue
            slot = structure.first[camera[o]]
            for other in range(o + 1, first[p + 1]):
                if camera[other] < n_free:
                    while structure.row[slot] < camera[other]:
                        slot += 1
                    slots[count] = slot
                    count += 1
    return slots


@kernel
def reduce_points_sparsely(
    structure, slots, n_free, observations, equations, damping, S, x, V_inverse
):
    """Eliminate the points from the normal equations by the Schur complement.

    The reduced camera system is ``S x = rhs``. Its matrix is written into ``S`` as panels of
    ``block_cholesky``, and its right-hand side into ``x``.
    """
    first, camera = observations.first, observations.camera
    W, V, g, U, b = equations
    for i in range(len(S)):
        S[i] = 0.0
    for k in range(n_free):
        begin, width = panel(structure, k)
        for i in range(6):
            x[k, i] = b[k, i]
            for j in range(6):
                S[begin + i * width + j] = U[k, i, j]
            S[begin + i * width + i] *= 1.0 + damping
    Y = np.empty((3, 6))
    pair = 0
    for p in range(len(V)):
        N = V_inverse[p]
        invert_damped(V[p], damping, N)
        for o in range(first[p], first[p + 1]):
            k = camera[o]
            if k >= n_free:
                continue
            for i in range(6):
                w0, w1, w2 = W[o, 0, i], W[o, 1, i], W[o, 2, i]
                Y[0, i] = N[0, 0] * w0 + N[0, 1] * w1 + N[0, 2] * w2
                Y[1, i] = N[1, 0] * w0 + N[1, 1] * w1 + N[1, 2] * w2
                Y[2, i] = N[2, 0] * w0 + N[2, 1] * w1 + N[2, 2] * w2
                x[k, i] -= Y[0, i] * g[p, 0] + Y[1, i] * g[p, 1] + Y[2, i] * g[p, 2]
            begin, width = panel(structure, k)
            subtract_coupling(Y, W, o, S, begin, width)
            for other in range(o + 1, first[p + 1]):
                if camera[other] < n_free:
                    offset = begin + 6 * (slots[pair] - structure.first[k])
                    subtract_coupling(Y, W, other, S, offset, width)
                    pair += 1


@inner_kernel
def subtract_coupling(Y, W, o, S, offset, width):
    """Subtract the product ``Y' W[o]`` from the block of ``S`` that starts at ``offset``."""
    start, step = np.uintp(offset), np.uintp(width)
    for i in range(np.uintp(6)):
        y0, y1, y2 = Y[0, i], Y[1, i], Y[2, i]
        for j in range(np.uintp(6)):
            S[start + j] -= y0 * W[o, 0, j] + y1 * W[o, 1, j] + y2 * W[o, 2, j]
        start += step
