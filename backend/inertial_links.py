"""Inertial factors between the keyframes of global bundle adjustment.

Gravity, and the velocity and the biases of each keyframe, are further unknowns. In the sparse
system of the cameras (``backend/block_cholesky.py``), each is one block, like a camera:
``[g, 0]``, ``[v, 0]`` and ``[b_g, b_a]``. Three unknowns of a block may therefore be unused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vslam.backend.block_cholesky import BLOCK, Structure, panel
from vslam.backend.inertial_factor import InertialLinks, Motions, add_residuals, factor_of
from vslam.backend.inertial_start import ACCEL_BIAS, GYRO_BIAS
from vslam.support.kernels import inner_kernel, kernel
from vslam.types.geometry import Matrix, inverses
from vslam.types.imu import GRAVITY

GRAVITY_SIGMA = 0.02  # m/s^2; on the earth's surface, gravity is 9.78 to 9.83 m/s^2
# The blocks that a factor connects, as columns of its derivatives: the pose, the velocity and the
# biases of the first keyframe, those of the last keyframe, and gravity.
_BEGIN = np.array([0, 12, 15, 6, 21, 24, 30])
_WIDTH = np.array([6, 3, 6, 6, 3, 6, 3])


@dataclass(frozen=True, eq=False)
class LinkedStates:
    """The unknowns of inertial factors besides the poses, and the factors.

    The B blocks of all unknowns are those of the free cameras and those of the states. Fixed
    cameras follow them.

    Attributes:
        motions: N motions.
        blocks: ``(N, 7)`` int64 blocks that each factor connects.
        start: ``(B, 6)`` start values of all blocks; zero for cameras.
        prior: ``(B, 6)`` inverse variances of these values.
        of_gravity: the block of gravity.
        hessian, gradient: ``(N, 33, 33)`` and ``(N, 33)`` of the factors, which ``linearise``
            writes.
    """

    motions: Motions
    blocks: NDArray[np.int64]
    start: Matrix
    prior: Matrix
    of_gravity: int
    hessian: Matrix
    gradient: Matrix

    @classmethod
    def of(cls, links: InertialLinks, T_cw: Matrix, n_free: int) -> LinkedStates:
        """Define the unknowns. Their blocks follow those of the free cameras.

        Args:
            T_cw: ``(K, 4, 4)`` poses, of which the first ``n_free`` are optimised.
        """
        motions, first, last, g = links.motions, links.first, links.last, links.gravity
        linked, place = np.unique(np.concatenate([first, last]), return_inverse=True)
        n_states = 1 + 2 * len(linked)
        ends = n_free + 1 + 2 * place.reshape(2, -1)  # the velocities of both keyframes
        poses = np.where(linked < n_free, linked, linked + n_states)[place].reshape(2, -1)
        of_gravity = np.full(len(first), n_free)
        blocks = np.stack(
            [poses[0], ends[0], ends[0] + 1, poses[1], ends[1], ends[1] + 1, of_gravity], axis=1
        )
        start, prior = np.zeros((n_free + n_states, BLOCK)), np.zeros((n_free + n_states, BLOCK))
        start[n_free, :3] = g
        T_0, T_1 = (inverses(motions.T_imu_camera @ T_cw[end]) for end in (first, last))
        R, t = T_0[:, :3, :3], motions.seconds[:, None]
        fall = 0.5 * t * g + np.einsum("nij,nj->ni", R, motions.position) / t
        velocity = (T_1[:, :3, 3] - T_0[:, :3, 3]) / t - fall
        gained = t * g + np.einsum("nij,nj->ni", R, motions.velocity)
        start[ends[1], :3], start[ends[1] + 1] = velocity + gained, motions.bias
        start[ends[0], :3], start[ends[0] + 1] = velocity, motions.bias
        begins = np.setdiff1d(ends[0], ends[1])  # no factor ends there
        prior[begins + 1] = np.repeat([GYRO_BIAS**-2, ACCEL_BIAS**-2], 3)
        prior[n_free, 3:] = prior[n_free + 1 :: 2, 3:] = 1.0  # unused
        n = len(first)
        return cls(motions, blocks, start, prior, n_free, np.empty((n, 33, 33)), np.empty((n, 33)))

    @property
    def pairs(self) -> NDArray[np.int64]:
        """``(M, 2)`` pairs of blocks that factors couple."""
        a, b = np.triu_indices(self.blocks.shape[1], 1)
        pairs = np.stack([self.blocks[:, a], self.blocks[:, b]], axis=2).reshape(-1, 2)
        found: NDArray[np.int64] = pairs[(pairs < len(self.start)).all(axis=1)]
        return found

    def in_order(self, order: NDArray[np.int64], rank: NDArray[np.int64]) -> LinkedStates:
        """Sort the blocks.

        Args:
            order: ``(B,)`` block at each place of the new order.
            rank: place of each block and of each fixed camera.
        """
        return replace(
            self,
            blocks=rank[self.blocks],
            start=self.start[order],
            prior=self.prior[order],
            of_gravity=int(rank[self.of_gravity]),
        )

    def cost(self, T_cw: Matrix, values: Matrix) -> float:
        """Return half the sum of the squared residuals, with those of the priors."""
        found = self.chi2(T_cw, values)[0] + np.sum(self.prior * (values - self.start) ** 2)
        error = np.linalg.norm(values[self.of_gravity, :3]) - GRAVITY
        return 0.5 * float(found + (error / GRAVITY_SIGMA) ** 2)

    def chi2(self, T_cw: Matrix, values: Matrix) -> tuple[float, float]:
        """Return the chi-square of all factors, and that of their rotations, velocities and
        positions."""
        chi2, of_motion = _chi_square(self.motions, self.blocks, T_cw, values)
        return chi2, of_motion

    def misfit(self, T_cw: Matrix, values: Matrix) -> float:
        """Return the mean chi-square of rotation, velocity and position per factor."""
        return self.chi2(T_cw, values)[1] / len(self.motions.seconds)

    def linearise(self, T_cw: Matrix, values: Matrix) -> None:
        """Write the Hessians and the gradients of the factors."""
        _linearise(self.motions, self.blocks, T_cw, values, self.hessian, self.gradient)

    def add_to(
        self, structure: Structure, values: Matrix, damping: float, S: Matrix, x: Matrix
    ) -> None:
        """Add the factors and the priors to the system of ``factor_solve``."""
        _add_factors(structure, self.blocks, self.hessian, self.gradient, damping, S, x)
        _add_prior(structure, self.prior, self.start, self.of_gravity, values, damping, S, x)


@inner_kernel
def _linear(motions, k, blocks, T_cw, values):
    states = np.empty((2, 9))
    for end in range(2):
        for i in range(3):
            states[end, i] = values[blocks[k, 3 * end + 1], i]
        for i in range(6):
            states[end, 3 + i] = values[blocks[k, 3 * end + 2], i]
    gravity = values[blocks[k, 6], :3]
    T_0w, T_1w = T_cw[blocks[k, 0]], T_cw[blocks[k, 3]]
    return factor_of(motions, k, T_0w, T_1w, states[0], states[1], gravity)


@kernel
def _chi_square(motions, blocks, T_cw, values):
    chi2, of_motion = 0.0, 0.0
    for k in range(len(blocks)):
        r, _ = _linear(motions, k, blocks, T_cw, values)
        weight = motions.information[k]
        for i in range(15):
            error = 0.0
            for j in range(15):
                error += weight[i, j] * r[j]
            chi2 += r[i] * error
            if i < 9:
                of_motion += r[i] * error
    return chi2, of_motion


@kernel
def _linearise(motions, blocks, T_cw, values, hessian, gradient):
    at = np.arange(33)
    hessian[:] = 0.0
    gradient[:] = 0.0
    for k in range(len(blocks)):
        r, J = _linear(motions, k, blocks, T_cw, values)
        add_residuals(r, J, motions.information[k], at, hessian[k], gradient[k])
        for i in range(33):
            for j in range(i):
                hessian[k, i, j] = hessian[k, j, i]


@kernel
def _add_factors(structure, blocks, hessian, gradient, damping, S, x):
    n = len(x)
    for k in range(len(blocks)):
        for a in range(len(_BEGIN)):
            column, at = blocks[k, a], _BEGIN[a]
            if column >= n:
                continue  # a fixed camera
            begin, width = panel(structure, column)
            for j in range(_WIDTH[a]):
                x[column, j] += gradient[k, at + j]
                S[begin + j * width + j] += damping * hessian[k, at + j, at + j]
            for b in range(len(_BEGIN)):
                row, below = blocks[k, b], _BEGIN[b]
                if not column <= row < n:
                    continue
                slot = structure.first[column]
                while structure.row[slot] != row:
                    slot += 1
                block = begin + BLOCK * (slot - structure.first[column])
                for j in range(_WIDTH[a]):
                    for i in range(_WIDTH[b]):
                        S[block + j * width + i] += hessian[k, below + i, at + j]


@kernel
def _add_prior(structure, prior, start, of_gravity, values, damping, S, x):
    for k in range(len(x)):
        begin, width = panel(structure, k)
        for i in range(6):
            S[begin + i * width + i] += (1.0 + damping) * prior[k, i]
            x[k, i] += prior[k, i] * (start[k, i] - values[k, i])
    begin, width = panel(structure, of_gravity)
    g = values[of_gravity, :3]
    length = np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    weight = GRAVITY_SIGMA**-2.0
    for i in range(3):
        x[of_gravity, i] += weight * (GRAVITY - length) * g[i] / length
        for j in range(3):
            S[begin + j * width + i] += weight * g[i] * g[j] / (length * length)
