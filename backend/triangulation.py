"""Creates new landmarks from stereo features of a keyframe, or from features of two keyframes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import inner_kernel, kernel, popcount
from vslam.types.context import Context
from vslam.types.geometry import inverse, transform
from vslam.types.map import NONE, Map
from vslam.types.map_kernels import link_many
from vslam.types.reprojection import chi_square_ratio, unpacked

# Replaces `neighbours` for a monocular camera. [OS1 VI-C, customary]
_MONOCULAR_NEIGHBOURS = 20
# Upper bound of the cosine of the parallax of a triangulated point. The default corresponds to
# 1.1 degrees. A larger value also accepts points with less parallax. [OS1 VI-C, customary]
_MIN_PARALLAX_COSINE = 0.9998
# With a monocular camera, landmarks are triangulated between two keyframes only if the distance
# between the keyframes is at least this fraction of the median depth. [OS1 VI-C, customary]
_MIN_BASELINE_RATIO = 0.01

EPIPOLAR_CHI2 = 3.84  # 95 % quantile with 1 degree of freedom
SECTIONS = 512  # number of bins for the direction of an epipolar plane


def map_stereo_points(
    map_: Map, keyframe: int, context: Context, *, far: bool = False
) -> NDArray[np.int32]:
    """Create landmarks from the close stereo features of a keyframe that observe no landmark yet.

    If fewer than ``mapping.min_stereo_points`` features are close, the nearest
    ``min_stereo_points`` stereo features are used instead (section III-E of the ORB-SLAM2 paper).

    Args:
        far: whether landmarks are also created from far stereo features.

    Returns:
        ``(N,)`` ids of the new landmarks.
    """
    camera, a, rows = context.camera, map_.arrays, map_.rows(keyframe)
    xy = a.xy[rows].astype(np.float64)
    depth = camera.bf / (xy[:, 0] - a.u_right[rows])
    nearest = np.argsort(depth, kind="stable")
    nearest = nearest[: np.count_nonzero(np.isfinite(depth))]
    close = depth[nearest] < context.close_depth
    among_nearest = np.arange(len(nearest)) < context.config.mapping.min_stereo_points
    nearest = nearest[far | close | among_nearest]
    new = nearest[a.landmark[rows][nearest] == NONE]
    xyz = transform(inverse(a.T_cw[keyframe]), camera.backproject(xy[new], depth[new]))
    ids = map_.add_landmarks(xyz, a.descriptor[rows][new], keyframe)
    link_many(map_.arrays, rows.start + new, ids)
    return ids


def triangulate_with_neighbours(map_: Map, keyframe: int, context: Context) -> None:
    """Create landmarks by triangulating features of a keyframe and its covisible keyframes.

    Features that observe no landmark yet are matched along epipolar lines (section VI-C of the
    ORB-SLAM paper).
    """
    camera, config = context.camera, context.config
    neighbours, _ = map_.covisible(keyframe)
    limit, min_baseline = config.mapping.neighbours, camera.baseline
    if camera.monocular:
        limit = _MONOCULAR_NEIGHBOURS
    for neighbour in neighbours[:limit]:
        a = map_.arrays
        if camera.monocular:
            depth = median_depth(map_, int(neighbour))
            min_baseline = _MIN_BASELINE_RATIO * depth
        xyz, rows_1, rows_2 = triangulate_pair(
            a,
            keyframe,
            int(neighbour),
            camera.intrinsics,
            map_.scales,
            min_baseline,
            config.mapping.epipolar_distance,
            _MIN_PARALLAX_COSINE,
        )
        ids = map_.add_landmarks(xyz, a.descriptor[rows_1], keyframe)
        link_many(map_.arrays, rows_1, ids)
        link_many(map_.arrays, rows_2, ids)
        # The match was not aligned, so its position is no more accurate than that of a keypoint.
        map_.arrays.certainty[rows_2] = 1


def median_depth(map_: Map, keyframe: int) -> float:
    points, T_cw = map_.arrays.xyz[map_.landmarks_of(keyframe)], map_.arrays.T_cw[keyframe]
    return float(np.median(points @ T_cw[2, :3] + T_cw[2, 3]))


@inner_kernel
def unmapped_rows(a, keyframe):
    """Return the ``(N,)`` int64 rows, in the observation arrays of the map, of the features of a
    keyframe that do not observe a landmark."""
    first, last = a.first_row[keyframe], a.first_row[keyframe + 1]
    return first + np.flatnonzero(a.landmark[first:last] < 0)


@kernel
def triangulate_pair(a, k1, k2, intrinsics, scales, min_baseline, max_distance, max_cosine):
    """Triangulate new landmarks from two keyframes.

    Args:
        a: the arrays of the map.
        k1, k2: ids of the keyframes.
        intrinsics: ``(6,)``, see ``Camera.intrinsics``.
        scales: ``(levels,)`` pyramid scale factors.
        min_baseline: least distance between the cameras, in units of the map.
        max_distance: largest Hamming distance of a match, bits.
        max_cosine: largest cosine of the parallax angle of a match without stereo depth.

    Returns:
        ``(N, 3)`` positions of the landmarks in the world frame; ``(N,)`` int64 rows of their
        features in keyframe ``k1``; ``(N,)`` int64 rows of their features in keyframe ``k2``. The
        rows are indices into the observation arrays of the map.
    """
    fx, fy, cx, cy, bf, _ = intrinsics
    T1, T2 = a.T_cw[k1], a.T_cw[k2]
    centre_1, centre_2, gap = np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        centre_1[i] = -(T1[0, i] * T1[0, 3] + T1[1, i] * T1[1, 3] + T1[2, i] * T1[2, 3])
        centre_2[i] = -(T2[0, i] * T2[0, 3] + T2[1, i] * T2[1, 3] + T2[2, i] * T2[2, 3])
        gap[i] = centre_1[i] - centre_2[i]
    rows_1, rows_2 = unmapped_rows(a, k1), unmapped_rows(a, k2)
    n1, n2 = len(rows_1), len(rows_2)
    xyz = np.empty((n1, 3))
    out_1, out_2 = np.empty(n1, np.int64), np.empty(n1, np.int64)
    count = 0
    if dot3(gap, gap) < min_baseline**2 or dot3(gap, gap) == 0.0 or n2 == 0:
        return xyz[:0], out_1[:0], out_2[:0]
    # t is the centre of camera 1 in the frame of camera 2. Its projection is the epipole.
    t, d, point = np.empty(3), np.empty(3), np.empty(3)
    ray_1, ray_2, from_1, from_2 = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        t[i] = T2[i, 0] * gap[0] + T2[i, 1] * gap[1] + T2[i, 2] * gap[2]
    x2, y2 = np.empty(n2, np.float32), np.empty(n2, np.float32)
    gate = np.empty(n2, np.float32)
    descriptor_2 = a.descriptor[rows_2]
    for j in range(n2):
        x2[j], y2[j] = a.xy[rows_2[j], 0], a.xy[rows_2[j], 1]
        gate[j] = EPIPOLAR_CHI2 * scales[a.octave[rows_2[j]]] ** 2
    taken = np.zeros(n2, np.bool_)
    across = perpendicular(t)
    start, items = sorted_about_epipole(x2, y2, gate, intrinsics, across)
    for i in range(n1):
        row_1 = rows_1[i]
        world_ray(T1, a.xy[row_1], intrinsics, ray_1)
        # d is the ray in the frame of camera 2. The cross product t x d is normal to the epipolar
        # plane.
        for m in range(3):
            d[m] = T2[m, 0] * ray_1[0] + T2[m, 1] * ray_1[1] + T2[m, 2] * ray_1[2]
        n_x, n_y = t[1] * d[2] - t[2] * d[1], t[2] * d[0] - t[0] * d[2]
        n_z = t[0] * d[1] - t[1] * d[0]
        l_x, l_y = n_x / fx, n_y / fy
        norm = np.sqrt(l_x * l_x + l_y * l_y)
        if norm < 1e-12:
            continue
        p, q = np.float32(l_x / norm), np.float32(l_y / norm)
        s = np.float32((n_z - l_x * cx - l_y * cy) / norm)
        stereo_1 = not np.isnan(a.u_right[row_1])
        d_0, d_1, d_2, d_3 = a.descriptor[row_1]
        best, best_distance = -1, max_distance + 1
        along = direction(dot3(d, across[0]), dot3(d, across[1]))
        section = int(along * (0.5 * SECTIONS)) % SECTIONS
        for j in items[start[section] : start[section + 1]]:
            off = p * x2[j] + q * y2[j] + s
            if off * off >= gate[j] or taken[j]:
                continue
            # Half of the bits suffice to refuse most candidates.
            distance = popcount(d_0 ^ descriptor_2[j, 0]) + popcount(d_1 ^ descriptor_2[j, 1])
            if distance >= best_distance:
                continue
            distance += popcount(d_2 ^ descriptor_2[j, 2]) + popcount(d_3 ^ descriptor_2[j, 3])
            if distance >= best_distance:
                continue
            if not stereo_1 and np.isnan(a.u_right[rows_2[j]]) and t[2] > 0.0:
                # Near the epipole, monocular rays have no parallax.
                e_x, e_y = fx * t[0] / t[2] + cx - x2[j], fy * t[1] / t[2] + cy - y2[j]
                if e_x * e_x + e_y * e_y < 100.0 * scales[a.octave[rows_2[j]]]:
                    continue
            best, best_distance = j, distance
        if best < 0:
            continue
        row_2 = rows_2[best]
        world_ray(T2, a.xy[row_2], intrinsics, ray_2)
        ok = intersect(
            bf / (a.xy[row_1, 0] - a.u_right[row_1]),
            bf / (a.xy[row_2, 0] - a.u_right[row_2]),
            ray_1,
            ray_2,
            centre_1,
            centre_2,
            bf / fx,
            max_cosine,
            point,
        )
        if (
            ok
            and agrees(
                T1, point, a.xy[row_1], a.u_right[row_1], scales[a.octave[row_1]], intrinsics
            )
            and agrees(
                T2, point, a.xy[row_2], a.u_right[row_2], scales[a.octave[row_2]], intrinsics
            )
        ):
            # The ratio of the distances must agree with the ratio of the scales. The tolerance is a
            # factor of 1.5 times the scale factor of one level.
            for m in range(3):
                from_1[m], from_2[m] = point[m] - centre_1[m], point[m] - centre_2[m]
            far = np.sqrt(dot3(from_1, from_1) / dot3(from_2, from_2))
            change = far * scales[a.octave[row_1]] / scales[a.octave[row_2]]
            slack = 1.5 * scales[1]
            if change * slack > 1.0 and change < slack:
                taken[best] = True
                for m in range(3):
                    xyz[count, m] = point[m]
                out_1[count], out_2[count] = row_1, row_2
                count += 1
    return xyz[:count], out_1[:count], out_2[:count]


@kernel
def perpendicular(t):
    """Compute two unit vectors that are orthogonal to the vector ``t`` and to each other. Returns
    ``(2, 3)``."""
    across = np.zeros((2, 3))
    least = 0
    for i in range(1, 3):
        if abs(t[i]) < abs(t[least]):
            least = i
    j, k = (least + 1) % 3, (least + 2) % 3
    across[0, j], across[0, k] = -t[k], t[j]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        across[1, i] = t[j] * across[0, k] - t[k] * across[0, j]
    for m in range(2):
        norm = np.sqrt(dot3(across[m], across[m]))
        for i in range(3):
            across[m, i] /= norm
    return across


@kernel
def direction(u, v):
    """Return the direction of the line through the origin and (u, v), as a number in [0, 2).

    The number grows with the angle of the line from 0 to 180 degrees. It needs no trigonometric
    functions.
    """
    if v < 0.0 or (v == 0.0 and u < 0.0):
        u, v = -u, -v
    if u > 0.0:
        return v / (u + v)
    return 1.0 - u / (v - u) if v > 0.0 else 0.0


@kernel
def sorted_about_epipole(x, y, gate, intrinsics, across):
    """Index features by the directions of the epipolar planes that they can match.

    All epipolar planes contain the baseline. In a view along the baseline, each plane is a line
    through the origin and has a direction. A feature matches planes that cross a square around the
    feature. In the view along the baseline, the square covers an interval of directions, or all
    directions if the epipole is inside the square.

    Args:
        x, y: ``(n,)`` float32, pixels.
        gate: ``(n,)`` float32, largest squared distance from the epipolar line, pixels squared. Its
            square root is half the side of the square.
        intrinsics: ``(6,)``, see ``Camera.intrinsics``.
        across: ``(2, 3)``, the two axes of the view along the baseline, see ``perpendicular``.

    Returns:
        ``start``, ``(SECTIONS + 1,)``, and ``items``, int32. The features near a plane whose
        direction is in bin s are among ``items[start[s]:start[s + 1]]``, in ascending order.
    """
    n = len(x)
    low, high = np.empty(n, np.int64), np.empty(n, np.int64)
    start = np.zeros(SECTIONS + 1, np.int64)
    for j in range(n):
        u, v = seen_along(x[j], y[j], intrinsics, across)
        middle = direction(u, v)
        reach = 1.01 * np.sqrt(gate[j]) + 0.01  # a small margin, so that rounding loses no feature
        least, most = 0.0, 0.0
        for corner in range(4):
            x_k = x[j] + (reach if corner % 2 else -reach)
            y_k = y[j] + (reach if corner // 2 else -reach)
            u_k, v_k = seen_along(x_k, y_k, intrinsics, across)
            if u * u_k + v * v_k <= 0.0:
                least, most = -1.0, 1.0  # 90 degrees or more: the epipole may be inside
                break
            apart = direction(u_k, v_k) - middle
            apart += 2.0 * ((apart < -1.0) - (apart > 1.0))
            least, most = min(least, apart), max(most, apart)
        low[j] = int(np.floor((middle + least) * (0.5 * SECTIONS)))
        high[j] = int(np.floor((middle + most) * (0.5 * SECTIONS)))
        high[j] = min(high[j], low[j] + SECTIONS - 1)
        for section in range(low[j], high[j] + 1):
            start[section % SECTIONS + 1] += 1
    for section in range(SECTIONS):
        start[section + 1] += start[section]
    items = np.empty(start[SECTIONS], np.int32)
    cursor = start[:SECTIONS].copy()
    for j in range(n):
        for section in range(low[j], high[j] + 1):
            items[cursor[section % SECTIONS]] = j
            cursor[section % SECTIONS] += 1
    return start, items


@inner_kernel
def seen_along(x, y, intrinsics, across):
    """Return the two components of the viewing ray of a pixel along the two axes in ``across``."""
    fx, fy, cx, cy, _, _ = intrinsics
    d_x, d_y = (x - cx) / fx, (y - cy) / fy
    u = d_x * across[0, 0] + d_y * across[0, 1] + across[0, 2]
    v = d_x * across[1, 0] + d_y * across[1, 1] + across[1, 2]
    return u, v


@inner_kernel
def dot3(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner_kernel
def world_ray(T_cw, xy, intrinsics, ray):
    """Write the viewing ray of a pixel into ``ray``, ``(3,)`` in the world frame. Its length is
    such that z = 1 in the camera frame."""
    x = (xy[0] - intrinsics[2]) / intrinsics[0]
    y = (xy[1] - intrinsics[3]) / intrinsics[1]
    for i in range(3):
        ray[i] = T_cw[0, i] * x + T_cw[1, i] * y + T_cw[2, i]


@inner_kernel
def intersect(depth_1, depth_2, ray_1, ray_2, centre_1, centre_2, baseline, max_cosine, point):
    """Triangulate a landmark from two views, and write its position in the world frame into
    ``point``, ``(3,)``.

    Usually, the two viewing rays are intersected. If the stereo pair of one keyframe sees the
    landmark with more parallax than the two rays have, its stereo point is used instead.

    Args:
        depth_1, depth_2: stereo depths of the features; NaN for a feature without stereo depth.
        ray_1, ray_2: ``(3,)`` rays, see ``world_ray``.
        centre_1, centre_2: ``(3,)`` positions of the cameras, in the world frame.
        baseline: baseline of the stereo pair.
        max_cosine: largest cosine of the angle between the two rays if neither feature has a stereo
            depth.

    Returns:
        False if there is neither enough parallax nor a stereo depth, or if the rays do not meet in
        front of both cameras.
    """
    dot = dot3(ray_1, ray_2)
    square_1, square_2 = dot3(ray_1, ray_1), dot3(ray_2, ray_2)
    cosine = dot / np.sqrt(square_1 * square_2)
    # Angle between the rays of the left and the right camera at the stereo point.
    angle_1 = 2.0 * np.arctan(0.5 * baseline / (depth_1 * np.sqrt(square_1)))
    angle_2 = 2.0 * np.arctan(0.5 * baseline / (depth_2 * np.sqrt(square_2)))
    stereo_1, stereo_2 = depth_1 > 0.0, depth_2 > 0.0  # False for NaN
    stereo_cosine = min(np.cos(angle_1) if stereo_1 else 2.0, np.cos(angle_2) if stereo_2 else 2.0)
    if 0.0 < cosine < stereo_cosine and (stereo_1 or stereo_2 or cosine < max_cosine):
        # Midpoint of the shortest segment between the rays. Bundle adjustment refines it later.
        on_1, on_2 = 0.0, 0.0
        for i in range(3):
            on_1 += (centre_2[i] - centre_1[i]) * ray_1[i]
            on_2 += (centre_2[i] - centre_1[i]) * ray_2[i]
        determinant = square_1 * square_2 - dot * dot
        s = (square_2 * on_1 - dot * on_2) / determinant
        t = (dot * on_1 - square_1 * on_2) / determinant
        for i in range(3):
            point[i] = 0.5 * (centre_1[i] + s * ray_1[i] + centre_2[i] + t * ray_2[i])
        return s > 0.0 and t > 0.0
    if stereo_1 and (not stereo_2 or angle_1 >= angle_2):
        for i in range(3):
            point[i] = centre_1[i] + depth_1 * ray_1[i]
        return True
    for i in range(3):
        point[i] = centre_2[i] + depth_2 * ray_2[i]
    return stereo_2


@inner_kernel
def agrees(T, p, xy, u_right, scale, intrinsics):
    """Return whether a point lies in front of the camera and its reprojection error passes the
    chi-square test."""
    z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
    if z <= 0.0:
        return False
    x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
    y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
    u, v, right = np.float64(xy[0]), np.float64(xy[1]), np.float64(u_right)
    weight, pinhole = 1.0 / (scale * scale), unpacked(intrinsics)
    return chi_square_ratio(x, y, z, u, v, right, weight, pinhole) <= 1.0
