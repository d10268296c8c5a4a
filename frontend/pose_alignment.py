"""Sparse image alignment: estimates the motion between two frames from the grey values around
landmarks.

The motion of the camera is optimised until small windows around all landmarks of the last frame
agree with the new image (SVO: Forster et al., ICRA 2014, section III-A, and T-RO 2017, section
IV-A). The images are reduced in size, and the smallest image is aligned first. Therefore, the
predicted pose may be wrong by about twenty pixels in the image, for example at the beginning of a
turn.

The lighting may change between two frames. Therefore, the mean of each window is subtracted, and a
common contrast factor of all windows is estimated.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import inner_kernel, kernel
from vslam.types.features import Pyramid
from vslam.types.geometry import (
    Matrix,
    compose,
    inverse,
    orthonormalised,
    se3_exp,
    solve_positive,
    transform,
)

WINDOW = 4  # pixels along each side
PIXELS = WINDOW * WINDOW
ITERATIONS = 10
MIN_WINDOWS, MAX_WINDOWS = 20, 256
MIN_CORRELATION = 0.6  # least correlation of all windows with the image, or the alignment failed
# The iteration ends when a step rotates the image by less than STILL pixels of the level and moves
# the camera by less than STILL_M units of the map.
STILL, STILL_M = 0.02, 0.005
ROBUST = 1.5  # Huber threshold of a window's error, in multiples of the median error


def coarse_levels(pyramid: Pyramid) -> Pyramid:
    """Return the three small images of a frame for sparse image alignment, coarsest first: the
    smallest pyramid level at half size, the smallest level, and the middle level."""
    height, width = pyramid.shapes[0]
    last, middle = len(pyramid.shapes) - 1, len(pyramid.shapes) // 2
    smallest = pyramid.level(last)
    shapes = coarse_shapes(pyramid.shapes)
    half = cv2.resize(smallest, (shapes[0, 1], shapes[0, 0]), interpolation=cv2.INTER_AREA)
    levels = [np.asarray(half, np.uint8), smallest, pyramid.level(middle)]
    pixels = np.concatenate([level.ravel() for level in levels])
    return coarse_pyramid(pixels, shapes, (int(height), int(width)))


def is_coarse(pyramid: Pyramid, shapes: NDArray[np.int64], size: tuple[int, int]) -> bool:
    """Return whether a pyramid that was read from a file can be a result of ``coarse_levels``.

    Args:
        shapes: ``(L, 2)`` heights and widths of the levels of the whole pyramid.
        size: height and width of the whole image, pixels.
    """
    expected = coarse_shapes(shapes)
    if len(pyramid.pixels) != expected.prod(axis=1).sum():
        return False
    made = coarse_pyramid(pyramid.pixels, expected, size)
    return (
        np.array_equal(pyramid.offsets, made.offsets)
        and np.array_equal(pyramid.shapes, made.shapes)
        and np.array_equal(pyramid.scales, made.scales)
    )


def coarse_shapes(shapes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the ``(3, 2)`` heights and widths of the images that ``coarse_levels`` returns.

    Args:
        shapes: ``(L, 2)`` heights and widths of the levels of the whole pyramid.
    """
    smallest, middle = shapes[-1], shapes[len(shapes) // 2]
    return np.array([np.maximum(smallest // 2, 1), smallest, middle])


def coarse_pyramid(
    pixels: NDArray[np.uint8], shapes: NDArray[np.int64], size: tuple[int, int]
) -> Pyramid:
    """Return the small images with the given pixels.

    Args:
        shapes: the result of ``coarse_shapes``.
        size: height and width of the whole image, pixels.
    """
    offsets = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))[:-1]]).astype(np.int64)
    return Pyramid(pixels, offsets, shapes, size[1] / shapes[:, 1])


def align_pose(
    now: Pyramid,
    before: Pyramid,
    xyz: Matrix,
    T_before: Matrix,
    T_cw: Matrix,
    intrinsics: NDArray[np.float64],
    size: tuple[int, int],
) -> Matrix:
    """Estimate the pose of a frame by sparse image alignment to another frame.

    Args:
        now, before: the results of ``coarse_levels`` for the frame and for the other frame.
        xyz: ``(N, 3)`` landmarks that the other frame tracks, in the world frame.
        T_before: ``(4, 4)`` pose of the other frame (world to camera).
        T_cw: ``(4, 4)`` predicted pose of the frame (world to camera).
        intrinsics: ``(6,)``, see ``Camera.intrinsics``.
        size: height and width of the whole images, pixels.

    Returns:
        ``(4, 4)`` pose (world to camera). It is the predicted pose if the alignment fails.
    """
    stride = -(-len(xyz) // MAX_WINDOWS) or 1
    points = np.ascontiguousarray(transform(T_before, xyz[::stride]))
    T, correlation = T_cw @ inverse(T_before), 0.0
    for level, (height, width) in enumerate(now.shapes.tolist()):
        T, correlation = _align(
            now.level(level),
            before.level(level),
            points,
            T,
            intrinsics,
            size[1] / width,
            size[0] / height,
        )
    return orthonormalised(T @ T_before) if correlation >= MIN_CORRELATION else T_cw


@kernel
def _align(image, before, points, T_start, intrinsics, ratio_x, ratio_y):
    """Align one pyramid level of two frames by inverse compositional Gauss-Newton.

    Args:
        image, before: ``(h, w)`` uint8.
        points: ``(N, 3)`` landmarks in the camera frame of ``before``.
        T_start: ``(4, 4)`` initial transform from the camera frame of ``before`` to the camera
            frame of ``image``.
        ratio_x, ratio_y: full-resolution pixels per pixel of the level.

    Returns:
        The ``(4, 4)`` transform, and the correlation between the windows of ``before`` and
        ``image``. If the alignment fails, ``T_start`` and 0 are returned.
    """
    n = len(points)
    template = np.empty((n, PIXELS), np.float32)
    jacobian = np.empty((n, PIXELS, 6), np.float32)
    hessian = np.empty((n, 6, 6), np.float32)
    used = np.empty(n, np.int64)
    m = 0
    for i in range(n):
        if _draw_template(
            before, points[i], intrinsics, ratio_x, ratio_y, template[m], jacobian[m]
        ):
            _square(jacobian[m], hessian[m])
            used[m] = i
            m += 1
    T = T_start.copy()
    correlation = 0.0
    seen, error = np.empty((n, PIXELS), np.float32), np.empty(n)
    for _ in range(ITERATIONS):
        product, energy, square = 0.0, 0.0, 0.0
        count = 0
        for i in range(m):
            error[i] = -1.0
            if not _read_window(image, T, points[used[i]], intrinsics, ratio_x, ratio_y, seen[i]):
                continue
            error[i] = 0.0
            count += 1
            for k in range(PIXELS):
                product += seen[i, k] * template[i, k]
                energy += template[i, k] * template[i, k]
                square += seen[i, k] * seen[i, k]
        if count < MIN_WINDOWS or product <= 0.0:
            return T_start, 0.0
        contrast = product / energy
        correlation = product / np.sqrt(energy * square)
        step = _step(seen, template, jacobian, hessian, error, m, contrast)
        T = compose(T, se3_exp(-step))
        turn = max(abs(step[3]), abs(step[4]), abs(step[5])) * intrinsics[0] / ratio_x
        if turn < STILL and max(abs(step[0]), abs(step[1]), abs(step[2])) < STILL_M:
            break
    return T, correlation


@inner_kernel
def _corner(point, intrinsics, ratio_x, ratio_y):
    """Project a point into a pyramid level, and return the column and the row of the first pixel of
    the window around it."""
    u = intrinsics[0] * point[0] / point[2] + intrinsics[2]
    v = intrinsics[1] * point[1] / point[2] + intrinsics[3]
    middle = 0.5 + 0.5 * (WINDOW - 1)
    return (u + 0.5) / ratio_x - middle, (v + 0.5) / ratio_y - middle


@inner_kernel
def _draw_template(before, point, intrinsics, ratio_x, ratio_y, template, jacobian):
    """Read the window around a projected point. The grey values are written into ``template``, and
    their derivatives with respect to the motion into ``jacobian``. The mean over the window is
    subtracted from both. Returns False if the window is not inside the image."""
    height, width = before.shape
    x, y, z = point[0], point[1], point[2]
    if not z > 0.1:
        return False
    u, v = _corner(point, intrinsics, ratio_x, ratio_y)
    if not (1.0 <= u < width - WINDOW - 2 and 1.0 <= v < height - WINDOW - 2):
        return False
    left, top = int(u), int(v)
    a, b = u - left, v - top
    w00, w01, w10, w11 = (1.0 - b) * (1.0 - a), (1.0 - b) * a, b * (1.0 - a), b * a
    fx, fy = intrinsics[0] / (ratio_x * z), intrinsics[1] / (ratio_y * z)
    mean = np.float32(0.0)
    means = np.zeros(6, np.float32)
    for r in range(WINDOW):
        for c in range(WINDOW):
            k, q, s = r * WINDOW + c, top + r, left + c
            value, slope_u, slope_v = 0.0, 0.0, 0.0
            for down in range(2):
                for right in range(2):
                    part = (w11 if right else w10) if down else (w01 if right else w00)
                    p, t = q + down, s + right
                    value += part * before[p, t]
                    slope_u += part * (np.float64(before[p, t + 1]) - np.float64(before[p, t - 1]))
                    slope_v += part * (np.float64(before[p + 1, t]) - np.float64(before[p - 1, t]))
            # d(grey value)/d(v, w) for a point moved by exp([v, w]).
            gu, gv = 0.5 * slope_u * fx, 0.5 * slope_v * fy
            gz = -(gu * x + gv * y) / z
            jacobian[k, 0], jacobian[k, 1], jacobian[k, 2] = gu, gv, gz
            jacobian[k, 3] = gz * y - gv * z
            jacobian[k, 4] = gu * z - gz * x
            jacobian[k, 5] = gv * x - gu * y
            template[k] = value
            mean += template[k]
            for j in range(6):
                means[j] += jacobian[k, j]
    for k in range(PIXELS):
        template[k] -= mean / np.float32(PIXELS)
        for j in range(6):
            jacobian[k, j] -= means[j] / np.float32(PIXELS)
    return True


@inner_kernel
def _read_window(image, T, p, intrinsics, ratio_x, ratio_y, seen):
    """Move a point by ``T``, and read the window around its projection. The grey values minus their
    mean are written into ``seen``. Returns False if the window is not inside the image."""
    height, width = image.shape
    x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
    y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
    z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
    if not z > 0.1:
        return False
    u, v = _corner((x, y, z), intrinsics, ratio_x, ratio_y)
    if not (0.0 <= u < width - WINDOW and 0.0 <= v < height - WINDOW):
        return False
    left, top = int(u), int(v)
    a, b = np.float32(u - left), np.float32(v - top)
    one = np.float32(1.0)
    mean = np.float32(0.0)
    for r in range(WINDOW):
        for c in range(WINDOW):
            q, s = top + r, left + c
            above = (one - a) * np.float32(image[q, s]) + a * np.float32(image[q, s + 1])
            below = (one - a) * np.float32(image[q + 1, s]) + a * np.float32(image[q + 1, s + 1])
            value = (one - b) * above + b * below
            seen[r * WINDOW + c] = value
            mean += value
    for k in range(PIXELS):
        seen[k] -= mean / np.float32(PIXELS)
    return True


@inner_kernel
def _square(jacobian, hessian):
    """Write the lower triangle of the normal matrix of one window into ``hessian``."""
    for j in range(6):
        for t in range(j + 1):
            total = np.float32(0.0)
            for k in range(PIXELS):
                total += jacobian[k, j] * jacobian[k, t]
            hessian[j, t] = total


@inner_kernel
def _step(seen, template, jacobian, hessian, error, m, contrast):
    """Compute the ``(6,)`` Gauss-Newton step that reduces the differences between the windows in
    ``seen`` and the templates.

    On entry, ``error`` must be negative for windows outside the image. For the other windows, the
    norm of the differences is written into ``error``.
    """
    inside = 0
    scale = np.float32(1.0 / contrast)
    valid_errors = np.empty(m)
    for i in range(m):
        if error[i] < 0.0:
            continue
        total = 0.0
        for k in range(PIXELS):
            difference = scale * seen[i, k] - template[i, k]
            total += difference * difference
        error[i] = np.sqrt(total)
        valid_errors[inside] = error[i]
        inside += 1
    limit = ROBUST * np.median(valid_errors[:inside]) + 1e-6
    H, b = np.zeros((6, 6)), np.zeros(6)
    for i in range(m):
        if error[i] < 0.0:
            continue
        weight = 1.0 if error[i] <= limit else limit / error[i]
        for j in range(6):
            product = np.float32(0.0)
            for k in range(PIXELS):
                product += jacobian[i, k, j] * (scale * seen[i, k] - template[i, k])
            b[j] += weight * product
            for t in range(j + 1):
                H[j, t] += weight * hessian[i, j, t]
    for j in range(6):
        H[j, j] *= 1.0 + 1e-6
        for t in range(j):
            H[t, j] = H[j, t]
    return solve_positive(H, b)
