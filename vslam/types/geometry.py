"""Functions of SE(3) algebra, which both Python code and Numba kernels can call.

In the camera frame, x points right, y down and z forward. The world frame is the frame of the left
camera at the first frame. ``T_a_b`` is a 4x4 float64 matrix that maps points of frame b to frame a.
``T_cw`` is used where points are projected, and ``T_wc`` where poses are saved. A twist is ``[v,
w]``, with the translation before the rotation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import kernel

Matrix = NDArray[np.float64]


@kernel
def compose(T_a_b: Matrix, T_b_c: Matrix) -> Matrix:
    """Return ``T_a_c``, the product of two ``(4, 4)`` float64 rigid motions."""
    T = np.zeros((4, 4))
    for i in range(3):
        for j in range(4):
            for k in range(3):
                T[i, j] += T_a_b[i, k] * T_b_c[k, j]
        T[i, 3] += T_a_b[i, 3]
    T[3, 3] = 1.0
    return T


@kernel
def inverse(T_a_b: Matrix) -> Matrix:
    """Return ``T_b_a``, the inverse of a ``(4, 4)`` rigid motion."""
    T = np.zeros((4, 4))
    for i in range(3):
        for j in range(3):
            T[i, j] = T_a_b[j, i]
            T[i, 3] -= T_a_b[j, i] * T_a_b[j, 3]
    T[3, 3] = 1.0
    return T


@kernel
def orthonormalised(T_a_b: Matrix) -> Matrix:
    """Project the rotation of a ``(4, 4)`` motion back onto SO(3), to remove round-off errors.

    One Newton step of the polar decomposition, R (3 I - R'R) / 2, is enough to correct the
    round-off of a few compositions.
    """
    T = T_a_b.copy()
    for i in range(3):
        for j in range(3):
            value = 3.0 * T_a_b[i, j]
            for k in range(3):
                dot = 0.0
                for m in range(3):
                    dot += T_a_b[m, k] * T_a_b[m, j]
                value -= T_a_b[i, k] * dot
            T[i, j] = 0.5 * value
    return T


@kernel
def se3_exp(twist: Matrix) -> Matrix:
    """Return the ``(4, 4)`` motion of a ``(6,)`` twist ``[v, w]``.

    This is the exponential map of SE(3) (Solà et al., "A micro Lie theory", D.2).
    """
    v, w = twist[:3], twist[3:]
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if angle2 < 1e-6:
        a = 1.0 - angle2 / 6.0 * (1.0 - angle2 / 20.0)
        b = 0.5 - angle2 / 24.0 * (1.0 - angle2 / 30.0)
        c = 1.0 / 6.0 - angle2 / 120.0 * (1.0 - angle2 / 42.0)
    else:
        angle = np.sqrt(angle2)
        a = np.sin(angle) / angle
        b = 2.0 * np.sin(0.5 * angle) ** 2 / angle2
        c = (1.0 - a) / angle2
    T = np.zeros((4, 4))
    W = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    for i in range(3):
        for j in range(3):
            w_ij = w[i] * w[j] - (angle2 if i == j else 0.0)
            T[i, j] = a * W[i, j] + b * w_ij + (1.0 if i == j else 0.0)
            T[i, 3] += (b * W[i, j] + c * w_ij + (1.0 if i == j else 0.0)) * v[j]
    T[3, 3] = 1.0
    return T


@kernel
def se3_log(T: Matrix) -> Matrix:
    """Return the ``(6,)`` twist ``[v, w]`` of a ``(4, 4)`` motion.

    This is the logarithm of SE(3). The angle of the rotation must be below 180 degrees.
    """
    cos = 0.5 * (T[0, 0] + T[1, 1] + T[2, 2] - 1.0)
    w = 0.5 * np.array([T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]])
    sin = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    angle = np.arctan2(sin, cos)
    if sin > 1e-10:
        w *= angle / sin
    angle2 = angle * angle
    if angle < 1e-4:
        c = 1.0 / 12.0 + angle2 / 720.0
    else:
        c = 1.0 / angle2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    t = T[:3, 3]
    cross = np.array(
        [w[1] * t[2] - w[2] * t[1], w[2] * t[0] - w[0] * t[2], w[0] * t[1] - w[1] * t[0]]
    )
    dot = w[0] * t[0] + w[1] * t[1] + w[2] * t[2]
    twist = np.empty(6)
    for i in range(3):
        twist[i] = t[i] - 0.5 * cross[i] + c * (w[i] * dot - angle2 * t[i])
        twist[3 + i] = w[i]
    return twist


@kernel
def solve_positive(H: Matrix, b: Matrix) -> Matrix:
    """Solve ``H x = b`` by Cholesky factorisation for a small symmetric positive definite ``H``.

    Args:
        H: ``(n, n)``. Only the lower triangle is read.
        b: ``(n,)``.

    Returns:
        ``(n,)`` the solution, or zeros if ``H`` is not positive definite.
    """
    n = len(b)
    L = np.zeros((n, n))
    x = np.zeros(n)
    for i in range(n):
        for j in range(i + 1):
            value = H[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            if i == j:
                if value <= 0.0:
                    return np.zeros(n)
                L[i, i] = np.sqrt(value)
            else:
                L[i, j] = value / L[j, j]
    for i in range(n):
        value = b[i]
        for k in range(i):
            value -= L[i, k] * x[k]
        x[i] = value / L[i, i]
    for i in range(n - 1, -1, -1):
        value = x[i]
        for k in range(i + 1, n):
            value -= L[k, i] * x[k]
        x[i] = value / L[i, i]
    return x


@kernel
def symmetric_eigen(A: Matrix) -> tuple[Matrix, Matrix]:
    """Compute the eigenvalues and eigenvectors of a small symmetric matrix.

    The function uses cyclic Jacobi rotations (Golub and Van Loan, "Matrix Computations", 8.5). The
    results are exact to round-off even if eigenvalues coincide.

    Returns:
        ``(n,)`` eigenvalues, unsorted, and ``(n, n)`` eigenvectors as columns.
    """
    n = len(A)
    D, V = A.copy(), np.eye(n)
    for _ in range(30):
        off, size = 0.0, 0.0
        for p in range(n):
            size += D[p, p] * D[p, p]
            for q in range(p):
                off += D[p, q] * D[p, q]
        if off <= 1e-32 * size or off == 0.0:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                if D[p, q] == 0.0:
                    continue
                theta = 0.5 * (D[q, q] - D[p, p]) / D[p, q]
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(n):
                    x, y = D[k, p], D[k, q]
                    D[k, p], D[k, q] = c * x - s * y, s * x + c * y
                for k in range(n):
                    x, y = D[p, k], D[q, k]
                    D[p, k], D[q, k] = c * x - s * y, s * x + c * y
                for k in range(n):
                    x, y = V[k, p], V[k, q]
                    V[k, p], V[k, q] = c * x - s * y, s * x + c * y
    values = np.empty(n)
    for p in range(n):
        values[p] = D[p, p]
    return values, V


def transform(T_a_b: Matrix, p_b: Matrix) -> Matrix:
    """Transform ``(N, 3)`` points from frame b to frame a."""
    return p_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def inverses(T_a_b: Matrix) -> Matrix:
    """Return ``(N, 4, 4)`` ``T_b_a``, the inverses of N rigid motions."""
    T_b_a = np.zeros((len(T_a_b), 4, 4))
    T_b_a[:, :3, :3] = T_a_b[:, :3, :3].transpose(0, 2, 1)
    T_b_a[:, :3, 3] = -np.einsum("nij,nj->ni", T_b_a[:, :3, :3], T_a_b[:, :3, 3])
    T_b_a[:, 3, 3] = 1.0
    return T_b_a


def adjoint(T: Matrix) -> Matrix:
    """Return the ``(6, 6)`` adjoint matrix of a motion, for twists ``xi = [v, w]``.

    It satisfies ``T exp(xi) = exp(adjoint(T) xi) T``.
    """
    R, t = T[:3, :3], T[:3, 3]
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = R
    A[:3, 3:] = np.cross(t, R, axisb=0, axisc=0)
    return A
