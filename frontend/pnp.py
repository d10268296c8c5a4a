"""Estimates a camera pose from matched landmarks without an initial guess: P3P inside RANSAC.

The P3P solver follows Persson and Nordberg, "Lambda Twist: An Accurate Fast Robust Perspective
Three Point (P3P) Solver", ECCV 2018.
"""

from __future__ import annotations

import numpy as np

from vslam.support.kernels import inner_kernel, kernel
from vslam.support.ransac import draw_three, draws_needed
from vslam.types.geometry import symmetric_eigen
from vslam.types.reprojection import chi_square_ratio, unpacked


@kernel
def solve_p3p(points, rays, T_cw):
    """Find the poses of a camera that sees three points along three rays.

    Args:
        points: ``(3, 3)`` float64, one point per row, in the world frame.
        rays: ``(3, 3)`` float64, one unit vector per row, in the camera frame.
        T_cw: ``(4, 4, 4)`` float64, receives the poses (world to camera).

    Returns:
        Number of poses, 0 to 4; always 0 for collinear points.
    """
    a12, a13, a23 = _squared(points, 0, 1), _squared(points, 0, 2), _squared(points, 1, 2)
    b12, b13, b23 = _dot(rays, 0, 1), _dot(rays, 0, 2), _dot(rays, 1, 2)
    longest = max(a12, a13, a23)
    normal = np.empty(3)
    _cross(points, normal)
    area = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]
    if area <= 1e-12 * longest * longest:
        return 0
    # The depths l solve l' M_ij l = a_ij (paper, eq. 4-6). Two homogeneous combinations of these
    # equations are l' D1 l = 0 and l' D2 l = 0 (eq. 8).
    D1, D2 = np.zeros((3, 3)), np.zeros((3, 3))
    D1[0, 0], D1[0, 1], D1[1, 1] = a23, -b12 * a23, a23 - a12
    D1[1, 2], D1[2, 2] = b23 * a12, -a12
    D2[0, 0], D2[0, 2], D2[1, 1] = a23, -b13 * a23, -a13
    D2[1, 2], D2[2, 2] = b23 * a13, a23 - a13
    for i in range(3):
        for j in range(i):
            D1[i, j], D2[i, j] = D1[j, i], D2[j, i]
    # If the determinant of D1 + g D2 is zero, this combination describes a pair of planes (eq.
    # 9-11).
    g = _real_root(
        _determinant(D2),
        _mixed(D2, D1),
        _mixed(D1, D2),
        _determinant(D1),
    )
    D0 = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            D0[i, j] = D1[i, j] + g * D2[i, j]
    values, vectors = symmetric_eigen(D0)
    # One of the three eigenvalues is zero; the other two must differ in sign.
    zero = 0
    for i in range(1, 3):
        if abs(values[i]) < abs(values[zero]):
            zero = i
    p, q = (zero + 1) % 3, (zero + 2) % 3
    if values[p] == 0.0 or values[q] / values[p] > 0.0:
        return 0
    ratio = np.sqrt(-values[q] / values[p])
    count = 0
    depth = np.empty(3)
    for sign in (-1.0, 1.0):
        # The plane through the origin  n . l = 0  (eq. 12-13).
        n0 = vectors[0, p] - sign * ratio * vectors[0, q]
        n1 = vectors[1, p] - sign * ratio * vectors[1, q]
        n2 = vectors[2, p] - sign * ratio * vectors[2, q]
        if abs(n0) < 1e-14 * (abs(n1) + abs(n2)):
            continue
        w1, w2 = -n1 / n0, -n2 / n0  # l1 = w1 l2 + w2 l3
        # Substituting l3 = t l2 into l' D l = 0, where D is D1 or D2, gives a quadratic equation in
        # t. The equation is better conditioned for the matrix that contributes less to D0.
        D = D1 if abs(g) > 1.0 else D2
        A = D[0, 0] * w2 * w2 + 2.0 * D[0, 2] * w2 + D[2, 2]
        B = 2.0 * (D[0, 0] * w1 * w2 + D[0, 1] * w2 + D[0, 2] * w1 + D[1, 2])
        C = D[0, 0] * w1 * w1 + 2.0 * D[0, 1] * w1 + D[1, 1]
        discriminant = B * B - 4.0 * A * C
        if discriminant < 0.0:
            continue
        # Vieta's formula avoids cancellation where A is small.
        half = -0.5 * (B + (np.sqrt(discriminant) if B >= 0.0 else -np.sqrt(discriminant)))
        for root in range(2):
            if root == 0:
                if A == 0.0:
                    continue
                t = half / A
            else:
                if half == 0.0 or discriminant == 0.0:
                    continue
                t = C / half
            if not t > 0.0:
                continue
            length = a23 / (1.0 + t * t - 2.0 * b23 * t)
            if not length > 0.0:
                continue
            depth[1] = np.sqrt(length)
            depth[2] = t * depth[1]
            depth[0] = w1 * depth[1] + w2 * depth[2]
            if not depth[0] > 0.0:
                continue
            _refine_depths(depth, a12, a13, a23, b12, b13, b23)
            _pose_of_triangle(points, rays, depth, T_cw[count])
            count += 1
    return count


@inner_kernel
def _squared(points, i, j):
    total = 0.0
    for k in range(3):
        total += (points[i, k] - points[j, k]) ** 2
    return total


@inner_kernel
def _dot(rays, i, j):
    return rays[i, 0] * rays[j, 0] + rays[i, 1] * rays[j, 1] + rays[i, 2] * rays[j, 2]


@inner_kernel
def _cross(points, out):
    """Write the normal of a triangle into ``out``. Its length is twice the area of the triangle."""
    for k in range(3):
        m, n = (k + 1) % 3, (k + 2) % 3
        out[k] = (points[1, m] - points[0, m]) * (points[2, n] - points[0, n])
        out[k] -= (points[1, n] - points[0, n]) * (points[2, m] - points[0, m])


@inner_kernel
def _determinant(A):
    return (
        A[0, 0] * (A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1])
        - A[0, 1] * (A[1, 0] * A[2, 2] - A[1, 2] * A[2, 0])
        + A[0, 2] * (A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0])
    )


@inner_kernel
def _mixed(A, B):
    """Compute the coefficient of g in the polynomial det(A + g B): the sum of the entries of B
    times the cofactors of A."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            i1, i2, j1, j2 = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            total += (A[i1, j1] * A[i2, j2] - A[i1, j2] * A[i2, j1]) * B[i, j]
    return total


@inner_kernel
def _real_root(c3, c2, c1, c0):
    """Compute a real root of ``c3 x^3 + c2 x^2 + c1 x + c0``."""
    b, c, d = c2 / c3, c1 / c3, c0 / c3
    shift = b / 3.0
    p = c - b * b / 3.0
    q = 2.0 * shift**3 - shift * c + d
    discriminant = 0.25 * q * q + p * p * p / 27.0
    if discriminant >= 0.0:
        s = np.sqrt(discriminant)
        # The larger of the two cube roots has no cancellation. The smaller one follows from p.
        u = np.cbrt(-0.5 * q - s) if q >= 0.0 else np.cbrt(-0.5 * q + s)
        x = u - (p / (3.0 * u) if u != 0.0 else 0.0)
    else:
        r = np.sqrt(-p / 3.0)
        cos = min(1.0, max(-1.0, -0.5 * q / (r * r * r)))
        # Of three real roots, take the one that is farthest from the others.
        angle = np.arccos(cos) / 3.0
        x = 2.0 * r * np.cos(angle) if q <= 0.0 else 2.0 * r * np.cos(angle + 2.0 * np.pi / 3.0)
    x -= shift
    for _ in range(4):
        value = ((x + b) * x + c) * x + d
        slope = (3.0 * x + 2.0 * b) * x + c
        if slope == 0.0:
            break
        x -= value / slope
    return x


@inner_kernel
def _refine_depths(depth, a12, a13, a23, b12, b13, b23):
    """Refine the depths of the three points by Newton's method (section 3.6 of the Lambda Twist
    paper). The equations are the law of cosines for each pair of points."""
    for _ in range(5):
        l1, l2, l3 = depth[0], depth[1], depth[2]
        r1 = l1 * l1 + l2 * l2 - 2.0 * b12 * l1 * l2 - a12
        r2 = l1 * l1 + l3 * l3 - 2.0 * b13 * l1 * l3 - a13
        r3 = l2 * l2 + l3 * l3 - 2.0 * b23 * l2 * l3 - a23
        if abs(r1) + abs(r2) + abs(r3) < 1e-15 * (a12 + a13 + a23):
            return
        p, q = l1 - b12 * l2, l2 - b12 * l1  # half the derivatives of r1 with respect to l1, l2
        r, s = l1 - b13 * l3, l3 - b13 * l1
        t, v = l2 - b23 * l3, l3 - b23 * l2
        # J = [[p, q, 0], [r, 0, s], [0, t, v]]; Cramer's rule.
        determinant = -p * s * t - q * r * v
        if determinant == 0.0:
            return
        f = 0.5 / determinant
        d1 = (-s * t * r1 - q * v * r2 + q * s * r3) * f
        d2 = (-r * v * r1 + p * v * r2 - p * s * r3) * f
        d3 = (r * t * r1 - p * t * r2 - q * r * r3) * f
        depth[0] -= d1
        depth[1] -= d2
        depth[2] -= d3


@inner_kernel
def _pose_of_triangle(points, rays, depth, T):
    """Write into ``T`` the pose (world to camera) that maps three points to the given depths along
    their rays."""
    placed = np.empty((3, 3))
    for i in range(3):
        for k in range(3):
            placed[i, k] = depth[i] * rays[i, k]
    in_world, in_camera = np.empty((3, 3)), np.empty((3, 3))
    _triad(points, in_world)
    _triad(placed, in_camera)
    for i in range(3):
        for j in range(3):
            T[i, j] = 0.0
            for k in range(3):
                T[i, j] += in_camera[k, i] * in_world[k, j]
    for i in range(3):
        T[i, 3] = placed[0, i]
        for j in range(3):
            T[i, 3] -= T[i, j] * points[0, j]
        T[3, i] = 0.0
    T[3, 3] = 1.0


@inner_kernel
def _triad(points, axes):
    """Write an orthonormal frame of a triangle into the rows of ``axes``: the direction of the
    first side, the normal of the triangle, and the cross product of both."""
    _cross(points, axes[1])
    for k in range(3):
        axes[0, k] = points[1, k] - points[0, k]
    for row in range(2):
        norm = np.sqrt(axes[row, 0] ** 2 + axes[row, 1] ** 2 + axes[row, 2] ** 2)
        for k in range(3):
            axes[row, k] /= norm
    for k in range(3):
        m, n = (k + 1) % 3, (k + 2) % 3
        axes[2, k] = axes[0, m] * axes[1, n] - axes[0, n] * axes[1, m]


@inner_kernel
def _score_pose(T, points, uvr, inverse_sigma2, intrinsics, to_beat, inlier):
    """Compute the MSAC score of a pose (Torr and Zisserman, CVIU 2000) and its number of inliers.
    The inliers are written into ``inlier``.

    As soon as the score can no longer exceed ``to_beat``, the function returns -1, 0.
    """
    pinhole = unpacked(intrinsics)
    n = len(points)
    score, count = 0.0, 0
    for i in range(n):
        inlier[i] = False
        if score + (n - i) <= to_beat:
            return -1.0, 0
        p = points[i]
        z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        if z <= 0.1:
            continue
        x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
        y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
        error = chi_square_ratio(
            x, y, z, uvr[i, 0], uvr[i, 1], uvr[i, 2], inverse_sigma2[i], pinhole
        )
        if error <= 1.0:
            inlier[i] = True
            count += 1
            score += 1.0 - error
    return score, count


@kernel
def ransac_pose(points, uvr, inverse_sigma2, intrinsics, seed, min_inliers, max_draws, confidence):
    """Find the pose with the highest MSAC score for N matches.

    P3P uses only the left image, so samples may contain monocular features. The score of a pose
    also uses u_right where it is known.

    Args:
        points: ``(N, 3)`` float64 landmarks in the world frame.
        uvr: ``(N, 3)`` float64 observed u, v, u_right, in pixels; u_right is NaN for a monocular
            feature.
        inverse_sigma2: ``(N,)`` float64, inverse variance of u and v.
        intrinsics: ``(6,)``, see ``Camera.intrinsics``.
        seed: uint64 seed of the random samples.
        min_inliers: least number of inliers of an acceptable pose.
        confidence: sampling ends when a better pose with at least ``min_inliers`` inliers would
            have been found with this probability.

    Returns:
        The best pose ``T_cw``, ``(4, 4)``, and an ``(N,)`` bool mask of its inliers. The pose may
        have fewer than ``min_inliers`` inliers.
    """
    fx, fy, cx, cy, _, _ = intrinsics
    n = len(points)
    best_T, best_score = np.eye(4), 0.0
    best_inlier, inlier = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    if n < 3:
        return best_T, best_inlier
    state = np.empty(1, np.uint64)
    state[0] = seed
    rays = np.empty((n, 3))
    for i in range(n):
        x, y = (uvr[i, 0] - cx) / fx, (uvr[i, 1] - cy) / fy
        norm = np.sqrt(x * x + y * y + 1.0)
        rays[i, 0], rays[i, 1], rays[i, 2] = x / norm, y / norm, 1.0 / norm
    sample = np.empty(3, np.int64)
    three, three_rays, poses = np.empty((3, 3)), np.empty((3, 3)), np.empty((4, 4, 4))
    draws = draws_needed(min_inliers / n, confidence, max_draws)
    turn = 0
    while turn < draws:
        turn += 1
        sample[0], sample[1], sample[2] = draw_three(state, n)
        for i in range(3):
            for k in range(3):
                three[i, k] = points[sample[i], k]
                three_rays[i, k] = rays[sample[i], k]
        for s in range(solve_p3p(three, three_rays, poses)):
            score, count = _score_pose(
                poses[s], points, uvr, inverse_sigma2, intrinsics, best_score, inlier
            )
            if score <= best_score:
                continue
            best_T, best_score = poses[s].copy(), score
            for i in range(n):
                best_inlier[i] = inlier[i]
            if count >= min_inliers:
                draws = min(draws, draws_needed(count / n, confidence, max_draws))
    return best_T, best_inlier
