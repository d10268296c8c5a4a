"""Estimates the motion between two cameras from matched 3D landmarks using RANSAC.

Three matches of landmarks determine the motion in closed form (Horn, JOSA A 1987; the scale is
computed as in Umeyama, PAMI 1991). As in ORB-SLAM (T-RO 2015, section VII-B), RANSAC scores a
motion by the reprojection errors in both keyframes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import inner_kernel, kernel
from vslam.support.ransac import draw_three, draws_needed
from vslam.types.geometry import compose, orthonormalised, se3_exp, solve_positive, symmetric_eigen
from vslam.types.reprojection import chi_square, chi_square_ratio, residual, unpacked

REFITS = 4
SAMPLE_ITERATIONS, REFIT_ITERATIONS = 3, 5
# Least height of a triangle over its longest side. Flatter triangles hardly constrain the rotation
# about the longest side.
MIN_FLATNESS = 0.03


class ObservedPoints(NamedTuple):
    """The landmarks of N matches on one side of a loop, and their observations in the keyframe.

    Attributes:
        points: ``(N, 3)`` landmarks in the camera frame, in the unit of the map.
        uvr: ``(N, 3)`` observed u, v, u_right, in pixels; u_right is NaN for a monocular
            observation.
        inverse_sigma2: ``(N,)`` inverse variance of u and v.
    """

    points: NDArray[np.float64]
    uvr: NDArray[np.float64]
    inverse_sigma2: NDArray[np.float64]


class Alignment(NamedTuple):
    """A similarity transform between two cameras: ``p_a = scale * R p_b + t``.

    Attributes:
        T_a_b: ``(4, 4)`` rigid motion with R and t.
        scale: factor that converts lengths in b to lengths in a.
        inlier: ``(N,)`` bool, True for matches that agree with the similarity.
    """

    T_a_b: NDArray[np.float64]
    scale: float
    inlier: NDArray[np.bool_]


def align(
    a: ObservedPoints,
    b: ObservedPoints,
    intrinsics: NDArray[np.float64],
    *,
    seed: int,
    min_inliers: int,
    max_draws: int,
    confidence: float,
    fix_scale: bool = True,
) -> Alignment | None:
    """Find the rigid motion or similarity between two cameras that has the highest MSAC score.
    Returns None if the best motion has fewer than ``min_inliers`` inliers.

    Args:
        a, b: the landmarks of the same N matches, as observed by camera a and by camera b.
        intrinsics: ``(6,)`` of both cameras, see ``Camera.intrinsics``.
        seed: seed of the random samples; the same seed gives the same result.
        max_draws: maximum number of samples.
        confidence: probability with which a better motion, if there is one, is found before
            sampling ends.
        fix_scale: whether the scale is fixed to 1. True for metric maps (stereo, RGB-D), False for
            monocular maps.
    """
    if len(a.points) < max(3, min_inliers):
        return None
    T, scale, inlier, count = _ransac(
        a,
        b,
        intrinsics,
        np.uint64(seed),
        min_inliers,
        max_draws,
        confidence,
        fix_scale,
    )
    return Alignment(T, float(scale), inlier) if count >= min_inliers else None


@kernel
def fit_motion(p_a, p_b, weights, fix_scale):
    """Fit the motion ``p_a = scale * R p_b + t`` to two point sets by weighted least squares (Horn
    1987).

    Args:
        p_a, p_b: ``(N, 3)`` float64 points. There must be at least three points that are not
            collinear (see ``is_degenerate``).
        weights: ``(N,)`` float64; a point with weight 0 is ignored.

    Returns:
        The ``(4, 4)`` motion with R and t, and the scale, which is 1 if ``fix_scale`` is True.
    """
    n = len(p_a)
    total = 0.0
    mean_a, mean_b = np.zeros(3), np.zeros(3)
    for i in range(n):
        total += weights[i]
        for k in range(3):
            mean_a[k] += weights[i] * p_a[i, k]
            mean_b[k] += weights[i] * p_b[i, k]
    for k in range(3):
        mean_a[k] /= total
        mean_b[k] /= total
    S = np.zeros((3, 3))
    spread = 0.0
    for i in range(n):
        if weights[i] == 0.0:
            continue
        for j in range(3):
            from_b = weights[i] * (p_b[i, j] - mean_b[j])
            spread += from_b * (p_b[i, j] - mean_b[j])
            for k in range(3):
                S[j, k] += from_b * (p_a[i, k] - mean_a[k])
    # The quaternion of the best rotation is the eigenvector of the largest eigenvalue (Horn, 4.A).
    N = np.empty((4, 4))
    N[0, 0] = S[0, 0] + S[1, 1] + S[2, 2]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        N[0, i + 1] = S[j, k] - S[k, j]
        N[i + 1, 0] = N[0, i + 1]
        N[i + 1, i + 1] = S[i, i] - S[j, j] - S[k, k]
        N[i + 1, j + 1] = S[i, j] + S[j, i]
        N[j + 1, i + 1] = N[i + 1, j + 1]
    values, vectors = symmetric_eigen(N)
    best = np.argmax(values)
    w, x, y, z = vectors[0, best], vectors[1, best], vectors[2, best], vectors[3, best]
    T = np.zeros((4, 4))
    T[0, 0], T[0, 1], T[0, 2] = (
        w * w + x * x - y * y - z * z,
        2 * (x * y - w * z),
        2 * (x * z + w * y),
    )
    T[1, 0], T[1, 1], T[1, 2] = (
        2 * (x * y + w * z),
        w * w - x * x + y * y - z * z,
        2 * (y * z - w * x),
    )
    T[2, 0], T[2, 1], T[2, 2] = (
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        w * w - x * x - y * y + z * z,
    )
    T[3, 3] = 1.0
    scale = 1.0
    if not fix_scale:
        scale = 0.0
        for i in range(3):
            for j in range(3):
                scale += T[i, j] * S[j, i]
        scale /= spread
    for i in range(3):
        T[i, 3] = mean_a[i]
        for j in range(3):
            T[i, 3] -= scale * T[i, j] * mean_b[j]
    return T, scale


@kernel
def is_degenerate(p):
    """Return whether three points, the rows of the ``(3, 3)`` array ``p``, are nearly collinear."""
    longest = 0.0
    for i in range(3):
        side = 0.0
        for k in range(3):
            side += (p[i, k] - p[(i + 1) % 3, k]) ** 2
        longest = max(longest, side)
    area = 0.0
    for k in range(3):
        m, n = (k + 1) % 3, (k + 2) % 3
        cross = (p[1, m] - p[0, m]) * (p[2, n] - p[0, n])
        cross -= (p[1, n] - p[0, n]) * (p[2, m] - p[0, m])
        area += cross * cross
    return area <= (MIN_FLATNESS * longest) ** 2


@inner_kernel
def _same_sides(p_a, p_b, bf):
    """Return whether the side lengths of two triangles agree within the error of stereo depths.
    Both triangles are ``(3, 3)``, one point per row. This fast test rejects most samples that
    contain a wrong match.

    A disparity error of one pixel moves a point by z^2 / bf. Both ends of a side may have this
    error in both cameras.
    """
    for i in range(3):
        j = (i + 1) % 3
        a, b = 0.0, 0.0
        for k in range(3):
            a += (p_a[i, k] - p_a[j, k]) ** 2
            b += (p_b[i, k] - p_b[j, k]) ** 2
        slack = p_a[i, 2] ** 2 + p_a[j, 2] ** 2 + p_b[i, 2] ** 2 + p_b[j, 2] ** 2
        if abs(np.sqrt(a) - np.sqrt(b)) > slack / bf:
            return False
    return True


@inner_kernel
def _add_residual(p, motion, uvr, inverse_sigma2, intrinsics, H, b):
    """Add the reprojection error of one observation to the normal equations, with the Huber loss.

    Args:
        p: ``(3,)`` point in the camera frame.
        motion: ``(3, 7)`` derivative of the point with respect to the parameters of the similarity.
        H, b: ``(7, 7)`` and ``(7,)`` normal equations, which are updated in place.
    """
    if p[2] <= 0.1:
        return
    pinhole = unpacked(intrinsics)
    fx, fy, _, _, bf, disparity_weight = intrinsics
    iz = 1.0 / p[2]
    r_u, r_v, r_disparity, stereo = residual(p[0], p[1], p[2], uvr[0], uvr[1], uvr[2], pinhole)
    chi2, limit = chi_square(r_u, r_v, r_disparity, stereo, inverse_sigma2)
    weight = inverse_sigma2 * (np.sqrt(limit / chi2) if chi2 > limit else 1.0)
    J = np.zeros((3, 7))
    for k in range(7):
        J[0, k] = fx * iz * (motion[0, k] - p[0] * iz * motion[2, k])
        J[1, k] = fy * iz * (motion[1, k] - p[1] * iz * motion[2, k])
        if stereo:
            J[2, k] = disparity_weight * bf * iz * iz * motion[2, k]
    for k in range(7):
        b[k] += weight * (J[0, k] * r_u + J[1, k] * r_v + J[2, k] * r_disparity)
        for m in range(k + 1):
            H[k, m] += weight * (J[0, k] * J[0, m] + J[1, k] * J[1, m] + J[2, k] * J[2, m])


@kernel
def refine_motion(T, scale, a, b, chosen, intrinsics, iterations, fix_scale):
    """Refine a motion by Gauss-Newton on the reprojection errors in both cameras, with the Huber
    loss.

    ``fit_motion`` weights all directions equally, but stereo points are ten times less certain
    along the line of sight than across it.

    Args:
        T, scale: initial ``(4, 4)`` motion and scale.
        a, b: ``ObservedPoints`` of both cameras.
        chosen: ``(M,)`` indices of the matches that are used.

    Returns:
        The refined ``(4, 4)`` motion and scale.
    """
    points_a, uvr_a, weight_a = a
    points_b, uvr_b, weight_b = b
    T = T.copy()  # the caller may keep the initial motion as the best one
    p = np.empty(3)
    derivative_a, derivative_b = np.empty((3, 7)), np.empty((3, 7))
    for _ in range(iterations):
        H, g = np.zeros((7, 7)), np.zeros(7)
        for i in chosen:
            # Camera a observes p = scale R p_b + t.
            for row in range(3):
                p[row] = T[row, 3]
                for k in range(3):
                    p[row] += scale * T[row, k] * points_b[i, k]
            _derivative(p, fix_scale, derivative_a)
            _add_residual(p, derivative_a, uvr_a[i], weight_a[i], intrinsics, H, g)
            # Camera b observes R' (p_a - t) / scale, which is the inverse of the same motion.
            _derivative(points_a[i], fix_scale, derivative_a)
            for row in range(3):
                p[row] = 0.0
                for k in range(3):
                    p[row] += T[k, row] * (points_a[i, k] - T[k, 3]) / scale
                for column in range(7):
                    derivative_b[row, column] = 0.0
                    for k in range(3):
                        derivative_b[row, column] -= T[k, row] * derivative_a[k, column] / scale
            _add_residual(p, derivative_b, uvr_b[i], weight_b[i], intrinsics, H, g)
        for k in range(7):
            H[k, k] = H[k, k] * (1.0 + 1e-9) if k < 6 or not fix_scale else 1.0
        step = solve_positive(H, g)
        growth = np.exp(step[6])
        for row in range(3):
            T[row, 3] *= growth
        scale *= growth
        T = orthonormalised(compose(se3_exp(step[:6]), T))
        largest = 0.0
        for k in range(7):
            largest = max(largest, abs(step[k]))
        if largest < 1e-6:
            break
    return T, scale


@inner_kernel
def _derivative(p, fix_scale, out):
    """Write the derivative of a moved point, ``[I, -[p]x, p]``, into the ``(3, 7)`` array ``out``.
    The columns are translation, rotation and the logarithm of the scale."""
    for row in range(3):
        for column in range(3):
            out[row, column] = 1.0 if row == column else 0.0
        out[row, 3 + row] = 0.0
        out[row, 6] = 0.0 if fix_scale else p[row]
    out[0, 4], out[0, 5] = p[2], -p[1]
    out[1, 3], out[1, 5] = -p[2], p[0]
    out[2, 3], out[2, 4] = p[1], -p[0]


@inner_kernel
def _error(x, y, z, uvr, inverse_sigma2, intrinsics):
    """Return the ``chi_square_ratio`` of an observation, or 2 if the point is not in front of the
    camera."""
    if z <= 0.1:
        return 2.0
    pinhole = unpacked(intrinsics)
    return chi_square_ratio(x, y, z, uvr[0], uvr[1], uvr[2], inverse_sigma2, pinhole)


@inner_kernel
def _score_motion(T, scale, a, b, intrinsics, to_beat, inlier):
    """Compute the MSAC score of a motion (Torr and Zisserman, CVIU 2000) and its number of inliers.

    The inliers are written into ``inlier``, ``(N,)`` bool. As soon as the score can no longer
    exceed ``to_beat``, the function stops and returns (-1, 0).
    """
    points_a, uvr_a, weight_a = a
    points_b, uvr_b, weight_b = b
    n = len(points_a)
    score, count = 0.0, 0
    for i in range(n):
        inlier[i] = False
        if score + (n - i) <= to_beat:
            return -1.0, 0
        p = points_b[i]
        x = scale * (T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2]) + T[0, 3]
        y = scale * (T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2]) + T[1, 3]
        z = scale * (T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2]) + T[2, 3]
        in_a = _error(x, y, z, uvr_a[i], weight_a[i], intrinsics)
        if not in_a <= 1.0:  # also true for NaN, if the refinement has diverged
            continue
        dx, dy, dz = points_a[i, 0] - T[0, 3], points_a[i, 1] - T[1, 3], points_a[i, 2] - T[2, 3]
        x = (T[0, 0] * dx + T[1, 0] * dy + T[2, 0] * dz) / scale
        y = (T[0, 1] * dx + T[1, 1] * dy + T[2, 1] * dz) / scale
        z = (T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz) / scale
        in_b = _error(x, y, z, uvr_b[i], weight_b[i], intrinsics)
        if not in_b <= 1.0:
            continue
        inlier[i] = True
        count += 1
        score += 1.0 - 0.5 * (in_a + in_b)
    return score, count


@kernel
def _ransac(a, b, intrinsics, seed, min_inliers, max_draws, confidence, fix_scale):
    """Run RANSAC on samples of three matches. Each motion with a new best score is refitted to its
    inliers.

    Returns:
        The ``(4, 4)`` rigid motion, the scale, the ``(N,)`` bool inliers, and their number.
    """
    points_a, points_b = a.points, b.points
    n = len(points_a)
    state = np.empty(1, np.uint64)
    state[0] = seed
    best_T, best_scale, best_score, best_count = np.eye(4), 1.0, 0.0, 0
    best_inlier, inlier = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    sample = np.empty(3, np.int64)
    three_a, three_b, ones = np.empty((3, 3)), np.empty((3, 3)), np.ones(3)
    # This number of samples suffices if at least min_inliers of the matches are correct.
    draws = draws_needed(min_inliers / n, confidence, max_draws)
    turn = 0
    while turn < draws:
        turn += 1
        sample[0], sample[1], sample[2] = draw_three(state, n)
        for i in range(3):
            for k in range(3):
                three_a[i, k] = points_a[sample[i], k]
                three_b[i, k] = points_b[sample[i], k]
        if is_degenerate(three_a) or is_degenerate(three_b):
            continue
        if fix_scale and not _same_sides(three_a, three_b, intrinsics[4]):
            continue
        T, scale = fit_motion(three_a, three_b, ones, fix_scale)
        chosen, iterations = sample, SAMPLE_ITERATIONS
        for refit in range(REFITS + 1):
            T, scale = refine_motion(T, scale, a, b, chosen, intrinsics, iterations, fix_scale)
            score, count = _score_motion(T, scale, a, b, intrinsics, best_score, inlier)
            if score <= best_score:
                break
            best_T, best_scale, best_score, best_count = T, scale, score, count
            for i in range(n):
                best_inlier[i] = inlier[i]
            if count < 4 or refit == REFITS:
                break
            chosen, iterations = np.flatnonzero(inlier), REFIT_ITERATIONS
        if best_count >= min_inliers:
            draws = min(draws, draws_needed(best_count / n, confidence, max_draws))
    return best_T, best_scale, best_inlier, best_count
