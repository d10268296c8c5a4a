"""Optimises a camera pose from matched landmarks (motion-only bundle adjustment, section III-C of
the ORB-SLAM2 paper)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import inner_kernel, kernel
from vslam.types.geometry import compose, orthonormalised, se3_exp, solve_positive
from vslam.types.reprojection import chi_square, chi_square_ratio, residual, unpacked

ROUNDS = 4
ITERATIONS = 10
# Side of the cells of ``pose_covariance``, pixels. It equals the width of the window that is
# aligned in the coarsest octave. Larger cells give the same covariances
# (docs/research/uncertainty.md).
CELL = 32
ALL = slice(None)
MIN_TRUSTED = 30  # least number of trusted landmarks that determine a pose alone
TRUSTED_SHARE = 0.7  # a pose with which fewer of them agree may be that of a moving object


def optimise_pose(
    T_cw: NDArray[np.float64],
    points: NDArray[np.float64],
    uvr: NDArray[np.float64],
    inverse_sigma2: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    disparity_weight: NDArray[np.float64] | None = None,
    *,
    trusted: NDArray[np.bool_] | None = None,
    confirmed: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Find the camera pose that minimises the robust reprojection error of fixed landmarks.

    Gauss-Newton is run four times. After each run, all observations are classified again by the
    chi-square test, and the next run uses only the inliers. The first two runs use the Huber loss.

    A moving object may have more landmarks than the static scene. If too few trusted landmarks
    agree with the pose, they alone determine a first pose. Only observations that agree with the
    first pose are then used, whether they are trusted or not. A few trusted landmarks in a corner
    of the image can also give a wrong pose. It is not used if fewer confirmed landmarks agree with
    it.

    Args:
        T_cw: ``(4, 4)`` initial pose (world to camera).
        points: ``(N, 3)`` float64 landmarks in the world frame.
        uvr: ``(N, 3)`` float64 observed u, v, u_right, in pixels; u_right is NaN for a monocular
            observation.
        inverse_sigma2: ``(N,)`` float64, inverse variance of u and v.
        intrinsics: ``(6,)``, see ``Camera.intrinsics``.
        disparity_weight: ``(N,)`` float64, ratio of the standard deviation of u and v to the
            standard deviation of the disparity; None uses the ratio in ``intrinsics``.
        trusted: ``(N,)`` bool, True for landmarks that are known to be at rest. None if it is
            unknown for all of them.
        confirmed: ``(N,)`` bool, True for these and for confirmed landmarks that are far; None if
            there are no others.

    Returns:
        The pose ``T_cw``, ``(4, 4)``, and an ``(N,)`` bool mask of the inliers. There are no
        inliers if fewer than three observations are left.
    """
    if disparity_weight is None:
        disparity_weight = np.full(len(points), intrinsics[5])

    def optimised(
        T: NDArray[np.float64], used: NDArray[np.bool_] | slice = ALL
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        found: tuple[NDArray[np.float64], NDArray[np.bool_]] = _optimise(
            T, points[used], uvr[used], inverse_sigma2[used], disparity_weight[used], intrinsics
        )
        return found

    T_found, inlier = optimised(T_cw)
    if trusted is None or (n_trusted := int(np.count_nonzero(trusted))) < MIN_TRUSTED:
        return T_found, inlier
    n_agree = int(np.count_nonzero(inlier[trusted]))
    if n_agree >= TRUSTED_SHARE * n_trusted:
        return T_found, inlier
    T_trusted, kept = optimised(T_cw, trusted)
    if np.count_nonzero(kept) < max(MIN_TRUSTED, n_agree):
        return T_found, inlier
    agree = np.empty(len(points), np.bool_)
    _classify(T_trusted, points, uvr, inverse_sigma2, disparity_weight, intrinsics, agree)
    if confirmed is not None and np.sum(agree & confirmed) < np.sum(inlier & confirmed):
        return T_found, inlier
    T_found, kept = optimised(T_trusted, agree)
    agree[agree] = kept
    return T_found, agree


def pose_covariance(
    T_cw: NDArray[np.float64],
    points: NDArray[np.float64],
    uvr: NDArray[np.float64],
    inverse_sigma2: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    disparity_weight: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Estimate the covariance of an optimised pose relative to the landmarks.

    The inverse of the normal matrix would be the covariance if the errors of the observations were
    independent and had the assumed variances. Neither is the case. Observations of near landmarks
    have larger errors, because depth errors matter more at short distances. One corner is often
    observed in several octaves, so the errors are correlated.

    Therefore, the spread of the gradient is measured instead of assumed (the sandwich estimator of
    White, Econometrica 1980). The gradients are summed over the cells of a grid, within which
    errors may be correlated (Liang and Zeger, Biometrika 1986).

    Args:
        T_cw: ``(4, 4)`` optimised pose.
        points, uvr, inverse_sigma2, intrinsics, disparity_weight: inliers only; see
            ``optimise_pose``.

    Returns:
        ``(6, 6)`` covariance of ``xi = [v, w]``, in metres and radians, where ``exp(xi) T_cw`` is
        the true pose. NaN if the observations do not determine the pose.
    """
    cell = np.floor(uvr[:, :2] / CELL).astype(np.int64) @ np.array([1, 1 << 20])
    order = np.argsort(cell, kind="stable")
    _, first = np.unique(cell[order], return_index=True)
    H, gradients, chi2, n = _gradients(
        T_cw,
        points[order],
        uvr[order],
        inverse_sigma2[order],
        disparity_weight[order],
        intrinsics,
        np.append(first, len(cell)),
    )
    if n <= 6:
        return np.full((6, 6), np.nan)
    # A few cells do not determine the spread of the gradient. The measured spread is therefore
    # averaged with the spread that the weights of the observations imply. The implied spread counts
    # like as many cells as there are unknowns.
    share = 6.0 / (6.0 + len(gradients))
    spread = (1.0 - share) * gradients.T @ gradients + share * chi2 / n * H
    try:
        inverse_H = np.linalg.inv(H)
    except np.linalg.LinAlgError:
        return np.full((6, 6), np.nan)
    found: NDArray[np.float64] = inverse_H @ spread @ inverse_H * (n / (n - 6))
    return found


def offset_effect(
    T_cw: NDArray[np.float64],
    points: NDArray[np.float64],
    uvr: NDArray[np.float64],
    inverse_sigma2: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Compute how an error in the disparity offset of a stereo camera affects its estimated motion,
    to first order.

    If all disparities are too large by one pixel, a point at depth z seems too near by a fraction
    of ``z / bf``. The translation that this point suggests is then too short by the same fraction.

    Args:
        T_cw: ``(4, 4)`` optimised pose.
        points, uvr, inverse_sigma2, intrinsics: inliers only; see ``optimise_pose``.

    Returns:
        ``(6, 3)`` matrix that maps the translation of the motion to the error ``xi = [v, w]`` that
        an offset of one pixel causes. NaN if the observations do not determine the pose.
    """
    seen = np.full((len(points), 3), np.nan)
    seen[:, :2] = uvr[:, :2]
    share = (points @ T_cw[2, :3] + T_cw[2, 3]) / intrinsics[4]
    matrices = []
    for weight in (inverse_sigma2, inverse_sigma2 * share):
        cells, unused = np.array([0, len(points)]), np.zeros(len(points))
        matrices.append(_gradients(T_cw, points, seen, weight, unused, intrinsics, cells)[0])
    try:
        effect: NDArray[np.float64] = np.linalg.solve(*matrices)[:, :3]
    except np.linalg.LinAlgError:
        return np.full((6, 3), np.nan)
    return effect


@kernel
def _gradients(T_cw, points, uvr, inverse_sigma2, disparity_weight, intrinsics, first):
    """Compute the normal matrix of all observations, and the sum of the gradients in each cell of a
    grid.

    Args:
        first: ``(C + 1,)`` index of the first observation of each cell, followed by the number of
            observations.

    Returns:
        The ``(6, 6)`` normal matrix; ``(C, 6)`` gradients of the cells; sum of the chi-squares of
        all observations; number of coordinates of all observations.
    """
    n_cells = len(first) - 1
    H, gradients, chi2, n = np.zeros((6, 6)), np.empty((n_cells, 6)), 0.0, 0
    inlier = np.ones(len(points), np.bool_)
    for cell in range(n_cells):
        i = slice(first[cell], first[cell + 1])
        of_cell, gradients[cell], chi2_of_cell, _, n_of_cell = normal_equations(
            T_cw,
            points[i],
            uvr[i],
            inverse_sigma2[i],
            disparity_weight[i],
            intrinsics,
            inlier[i],
            False,
        )
        H += of_cell
        chi2 += chi2_of_cell
        n += n_of_cell
    for row in range(6):
        for column in range(row):
            H[column, row] = H[row, column]
    return H, gradients, chi2, n


@kernel
def _optimise(T_cw, points, uvr, inverse_sigma2, disparity_weight, intrinsics):
    n = len(points)
    T = T_cw.copy()
    inlier = np.ones(n, np.bool_)
    for turn in range(ROUNDS):
        for _ in range(ITERATIONS):
            H, b, _, used, _ = normal_equations(
                T, points, uvr, inverse_sigma2, disparity_weight, intrinsics, inlier, turn < 2
            )
            if used < 3:
                return T, np.zeros(n, np.bool_)
            for row in range(6):
                H[row, row] *= 1.0 + 1e-9
            step = solve_positive(H, b)
            T = orthonormalised(compose(se3_exp(step), T))
            moved = False
            for k in range(6):
                moved |= not abs(step[k]) < 1e-7
            if not moved:
                break
        classify(T, points, uvr, inverse_sigma2, disparity_weight, intrinsics, inlier)
    return T, inlier


@kernel
def _classify(T, points, uvr, inverse_sigma2, disparity_weight, intrinsics, inlier):
    classify(T, points, uvr, inverse_sigma2, disparity_weight, intrinsics, inlier)


@inner_kernel
def normal_equations(T, points, uvr, inverse_sigma2, disparity_weight, intrinsics, inlier, robust):
    """Linearise the reprojection errors of all inliers at pose ``T``, with the Huber loss if
    ``robust``.

    Returns:
        Lower triangle of the normal matrix, right-hand side, sum of the chi-squares, number of
        observations, and number of their coordinates.
    """
    fx, fy, cx, cy, bf, _ = unpacked(intrinsics)
    H = np.zeros((6, 6))
    b = np.zeros(6)
    J = np.empty((3, 6))
    r = np.empty(3)
    used, coordinates, total = 0, 0, 0.0
    for i in range(len(points)):
        if not inlier[i]:
            continue
        p = points[i]
        x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
        y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
        z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        if z <= 1e-6:
            continue
        pinhole = (fx, fy, cx, cy, bf, disparity_weight[i])
        r_u, r_v, r_disparity, stereo = residual(x, y, z, uvr[i, 0], uvr[i, 1], uvr[i, 2], pinhole)
        chi2, limit = chi_square(r_u, r_v, r_disparity, stereo, inverse_sigma2[i])
        r[0], r[1], r[2] = r_u, r_v, r_disparity
        weight = inverse_sigma2[i]
        iz = 1.0 / z
        if robust and chi2 > limit:
            weight *= np.sqrt(limit / chi2)
        rows = 3 if stereo else 2
        used += 1
        coordinates += rows
        total += chi2
        # d(u, v, -disparity)/d(v, w) for T <- exp([v, w]) T.
        J[0, 0], J[0, 1], J[0, 2] = fx * iz, 0.0, -fx * x * iz * iz
        J[1, 0], J[1, 1], J[1, 2] = 0.0, fy * iz, -fy * y * iz * iz
        J[2, 0], J[2, 1], J[2, 2] = 0.0, 0.0, disparity_weight[i] * bf * iz * iz
        for k in range(rows):
            J[k, 3] = -J[k, 1] * z + J[k, 2] * y
            J[k, 4] = J[k, 0] * z - J[k, 2] * x
            J[k, 5] = -J[k, 0] * y + J[k, 1] * x
            for row in range(6):
                scaled = weight * J[k, row]
                b[row] += scaled * r[k]
                for column in range(row + 1):
                    H[row, column] += scaled * J[k, column]
    return H, b, total, used, coordinates


@inner_kernel
def classify(T, points, uvr, inverse_sigma2, disparity_weight, intrinsics, inlier):
    """Write into ``inlier`` whether each observation passes the chi-square test at pose ``T``."""
    fx, fy, cx, cy, bf, _ = unpacked(intrinsics)
    for i in range(len(points)):
        p = points[i]
        x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
        y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
        z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        pinhole = (fx, fy, cx, cy, bf, disparity_weight[i])
        inlier[i] = z > 0.0 and (
            chi_square_ratio(x, y, z, uvr[i, 0], uvr[i, 1], uvr[i, 2], inverse_sigma2[i], pinhole)
            <= 1.0
        )
