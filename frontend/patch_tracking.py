"""Tracking without features: the patches of the newest keyframes are found in the image itself.

After SVO (Forster et al., ICRA 2014, and T-RO 2017): first the pose, by laying small windows around
all landmarks of the last frame over the new image ("sparse image alignment", III-A), coarse to
fine; then each landmark by itself, by laying the patch of the keyframe that saw it over the image
("feature alignment", III-B); at last the pose once more, from where the landmarks were found.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.features import PATCH_RADIUS, Features, Pyramid
from vslam.frontend.alignment import HALF, align, warps
from vslam.frontend.frame import Frame
from vslam.frontend.matching import predict_view
from vslam.frontend.patches import patches_around
from vslam.frontend.pose import optimise_pose
from vslam.frontend.tracking import TrackingContext
from vslam.geometry import Matrix, inverse, orthonormalised, se3_exp, solve_positive
from vslam.kernels import kernel
from vslam.map_view import MapView

WINDOW = 4
SETTLED = 0.02  # pixels of the level


class CoarseImages(NamedTuple):
    """Small images of a frame: ``levels`` (h, w) u1, coarsest first, and how many full-resolution
    pixels a pixel of each is wide and high."""

    levels: tuple[NDArray[np.uint8], ...]
    sizes: tuple[tuple[float, float], ...]

    @classmethod
    def of(cls, pyramid: Pyramid, which=(7, 4)) -> CoarseImages:
        height, width = pyramid.shapes[0]
        levels = [np.ascontiguousarray(pyramid.level(k)) for k in which]
        h, w = levels[0].shape
        levels.insert(0, cv2.resize(levels[0], (w // 2, h // 2), interpolation=cv2.INTER_AREA))
        sizes = [(width / one.shape[1], height / one.shape[0]) for one in levels]
        return cls(tuple(levels), tuple(sizes))


def align_pose(
    now: CoarseImages, before: CoarseImages, xyz: Matrix, T_before: Matrix, T_cw: Matrix, intrinsics
) -> tuple[Matrix, float]:
    """Pose ``T_cw`` by sparse image alignment and the correlation of the windows."""
    T = T_cw @ inverse(T_before)
    p = xyz @ T_before[:3, :3].T + T_before[:3, 3]
    p = np.ascontiguousarray(p[p[:, 2] > 0.1])
    quality = 0.0
    for image, old, size in zip(now.levels, before.levels, now.sizes, strict=True):
        T, quality = _align_pose(image, old, p, T, intrinsics, size[0], size[1], 10)
    return orthonormalised(T @ T_before), quality


@kernel
def _align_pose(image, before, points, T_start, intrinsics, size_x, size_y, iterations):
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    n = len(points)
    count = WINDOW * WINDOW
    h, w = before.shape
    template = np.empty((n, count), np.float32)
    J = np.empty((n, count, 6), np.float32)
    kept = np.empty(n, np.int64)
    m = 0
    row = np.empty(6)
    for i in range(n):
        x, y, z = points[i]
        u = (fx * x / z + cx + 0.5) / size_x - 0.5 - 0.5 * (WINDOW - 1)
        v = (fy * y / z + cy + 0.5) / size_y - 0.5 - 0.5 * (WINDOW - 1)
        left, top = int(np.floor(u)), int(np.floor(v))
        if left < 1 or top < 1 or left + WINDOW + 2 > w - 1 or top + WINDOW + 2 > h - 1:
            continue
        a, b = u - left, v - top
        mean = 0.0
        means = np.zeros(6)
        iz = 1.0 / z
        for r in range(WINDOW):
            for c in range(WINDOW):
                k = r * WINDOW + c
                yy, xx = top + r, left + c
                value = 0.0
                gx = 0.0
                gy = 0.0
                for dy in range(2):
                    for dx in range(2):
                        f = (b if dy else 1.0 - b) * (a if dx else 1.0 - a)
                        q, s = yy + dy, xx + dx
                        value += f * before[q, s]
                        gx += f * 0.5 * (np.float64(before[q, s + 1]) - np.float64(before[q, s - 1]))
                        gy += f * 0.5 * (np.float64(before[q + 1, s]) - np.float64(before[q - 1, s]))
                gu, gv = gx * fx / size_x, gy * fy / size_y
                row[0] = gu * iz
                row[1] = gv * iz
                row[2] = -(gu * x + gv * y) * iz * iz
                row[3] = -gu * x * y * iz * iz - gv * (1.0 + y * y * iz * iz)
                row[4] = gu * (1.0 + x * x * iz * iz) + gv * x * y * iz * iz
                row[5] = -gu * y * iz + gv * x * iz
                template[m, k] = value
                mean += value
                for j in range(6):
                    J[m, k, j] = row[j]
                    means[j] += row[j]
        mean /= count
        for k in range(count):
            template[m, k] -= mean
            for j in range(6):
                J[m, k, j] -= means[j] / count
        kept[m] = i
        m += 1
    T = T_start.copy()
    gain = 1.0
    quality = 0.0
    seen = np.empty((max(m, 1), count), np.float32)
    usable = np.zeros(max(m, 1), np.bool_)
    errors = np.empty(max(m, 1))
    for turn in range(iterations):
        product, energy, square = 0.0, 0.0, 0.0
        n_seen = 0
        for i in range(m):
            usable[i] = False
            p = points[kept[i]]
            x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
            y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
            z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
            if z < 0.1:
                continue
            u = (fx * x / z + cx + 0.5) / size_x - 0.5 - 0.5 * (WINDOW - 1)
            v = (fy * y / z + cy + 0.5) / size_y - 0.5 - 0.5 * (WINDOW - 1)
            left, top = int(np.floor(u)), int(np.floor(v))
            if left < 0 or top < 0 or left + WINDOW > w - 1 or top + WINDOW > h - 1:
                continue
            a, b = u - left, v - top
            mean = 0.0
            for r in range(WINDOW):
                for c in range(WINDOW):
                    q, s = top + r, left + c
                    value = (1 - b) * ((1 - a) * image[q, s] + a * image[q, s + 1]) + b * (
                        (1 - a) * image[q + 1, s] + a * image[q + 1, s + 1]
                    )
                    seen[i, r * WINDOW + c] = value
                    mean += value
            mean /= count
            for k in range(count):
                seen[i, k] -= mean
                product += seen[i, k] * template[i, k]
                energy += template[i, k] * template[i, k]
                square += seen[i, k] * seen[i, k]
            usable[i] = True
            n_seen += 1
        if n_seen < 20 or product <= 0.0:
            return T_start, 0.0
        gain = product / energy
        quality = product / np.sqrt(energy * square)
        for i in range(m):
            if usable[i]:
                e = 0.0
                for k in range(count):
                    d = seen[i, k] / gain - template[i, k]
                    e += d * d
                errors[i] = np.sqrt(e / count)
        limit = 1.5 * np.median(errors[:m][usable[:m]]) + 1e-6
        H = np.zeros((6, 6))
        b6 = np.zeros(6)
        for i in range(m):
            if not usable[i]:
                continue
            weight = 1.0 if errors[i] <= limit else limit / errors[i]
            for k in range(count):
                d = seen[i, k] / gain - template[i, k]
                for j in range(6):
                    f = weight * J[i, k, j]
                    b6[j] += f * d
                    for l in range(j + 1):
                        H[j, l] += f * J[i, k, l]
        for j in range(6):
            for l in range(j):
                H[l, j] = H[j, l]
            H[j, j] *= 1.0 + 1e-6
        step = solve_positive(H, b6)
        E = se3_exp(-step)
        T_new = np.zeros((4, 4))
        for r in range(4):
            for c in range(4):
                for k in range(4):
                    T_new[r, c] += T[r, k] * E[k, c]
        T = T_new
        moved = max(abs(step[3]), abs(step[4]), abs(step[5])) * fx / size_x
        if moved < SETTLED and np.abs(step[:3]).max() < 0.005:
            break
    return T, quality


def track_patches(frame: Frame, last: Frame, T_cw: Matrix, view: MapView, context: TrackingContext, stats) -> tuple[int, int, NDArray[np.int32]]:
    """Track; fills the frame. Returns matches, inliers, visible ids."""
    none = np.empty(0, np.int32)
    known, local = view.patches, view.local_landmarks
    if len(known.ids) < 60 or frame.pyramid is None:
        return 0, 0, none
    camera, config = context.camera, context.config.alignment
    intr, scales = camera.intrinsics, context.scales
    w, h = camera.width, camera.height
    if last.coarse is not None:
        seen = last.xyz[np.isfinite(last.xyz[:, 0])]
        T, q = align_pose(frame.coarse, last.coarse, seen, last.T_cw, T_cw, intr)
        stats.setdefault("q", []).append(q)
        if q > 0.6:
            T_cw = T
    at = np.searchsorted(local.ids, known.ids)
    xyz = local.xyz[at]
    uvr, radius, octave = predict_view(
        T_cw, xyz, local.normal[at], local.distance_range[at], intr, w, h, scales, 1.0
    )
    visible = known.ids[radius > 0]
    margin = (PATCH_RADIUS + 2) * scales[octave]
    ok = (radius > 0) & (uvr[:, 0] > margin) & (uvr[:, 0] < w - 1 - margin)
    ok &= (uvr[:, 1] > margin) & (uvr[:, 1] < h - 1 - margin)
    k = np.flatnonzero(ok)
    oc = octave[k].astype(np.uint8)
    ratio_x = w / frame.pyramid.shapes[oc, 1]
    ratio_y = h / frame.pyramid.shapes[oc, 0]
    px = np.rint((uvr[k, 0] + 0.5) / ratio_x - 0.5)
    py = np.rint((uvr[k, 1] + 0.5) / ratio_y - 0.5)
    xy = np.stack([(px + 0.5) * ratio_x - 0.5, (py + 0.5) * ratio_y - 0.5], 1).astype(np.float32)
    size = scales[oc]
    warp = warps(T_cw, xyz[k], known.T_cw, known.view[k], known.size[k], size, intr)
    shift = align(
        patches_around(frame.pyramid, xy, oc), known.pixels, known.shift, known.where[k], warp,
        config.iterations, config.max_shift, config.min_correlation,
    )
    good = np.isfinite(shift[:, 0])
    stats.setdefault("aligned", []).append(good.sum() / max(len(k), 1))
    k, xy, size, oc = k[good], xy[good] + shift[good] * size[good, None].astype(np.float32), size[good], oc[good]
    if len(k) < 40:
        return len(k), 0, visible
    obs = np.full((len(k), 3), np.nan)
    obs[:, :2] = xy
    T, inlier = optimise_pose(T_cw, xyz[k], obs, config.certainty * size**-2.0, intr)
    n = int(inlier.sum())
    if n < 40 or n < 0.5 * len(k):
        return len(k), 0, visible
    k, xy, oc = k[inlier], xy[inlier], oc[inlier]
    m = len(k)
    frame.features = Features(
        xy, oc, np.zeros(m, np.float32),
        local.descriptor[at[k]].view(np.uint8).reshape(m, 32), np.full(m, np.nan, np.float32),
    )
    frame.landmark, frame.xyz = known.ids[k].astype(np.int32), xyz[k]
    frame.shift = None
    frame.T_cw = orthonormalised(T)
    frame.by_patches = True
    return int(good.sum()), n, visible
