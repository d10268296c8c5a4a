"""Determines which surface is visible at each sample (projection, culling and z-buffer)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import borrowed, inline, kernel

NEAR = 0.2  # m
FAR = 400.0  # m
LAYER_STEP = 1e-3  # relative depth by which a layer is drawn in front of the next lower one
_SEAM = 1e-6  # overlap of adjacent surfaces as a fraction of an edge, so that there are no gaps

# Columns of the result of ``find_visible``. Columns 0 to 8 have 3 x 3 coefficients of s/z, t/z and
# 1/z, which are affine functions of the pixel (u, v). TEXTURE has 2 x 3 coefficients of the two
# texture coordinates divided by z. Each of the other columns is a single number.
TEXTURE, FIRST_ROW, LAST_ROW, TRIANGLE, LAYER = 9, 15, 16, 17, 18
NUMBER, DETAIL_U, DETAIL_V, DETAIL, AMBIENT, SUN, GLOW, KEY, COLUMNS = range(19, 28)


class _Span(NamedTuple):
    """Neighbouring samples of one image row at which the same surface is drawn.

    The samples are ``begin`` to ``end - 1`` (i8), in row ``v`` in pixels (f8). Sample ``i`` lies at
    column ``shift + step i`` in pixels (f8), and has the inverse depth 1/z = ``value + slope i``
    (f8).
    """

    begin: int
    end: int
    v: float
    shift: float
    step: float
    value: float
    slope: float


class _AlphaMap(NamedTuple):
    """Alpha channel of one texture.

    ``alpha`` has the values of all textures, (N,) u1. ``offset`` is the start of each mipmap level
    of this texture in ``alpha``, (L,) i8. ``log_size`` has the binary logarithms of the width and
    height of level 0, (2,) i8.
    """

    alpha: NDArray[np.uint8]
    offset: NDArray[np.int64]
    log_size: NDArray[np.int64]


@kernel
def find_visible(surfaces, atlas, camera, light):
    """Project the surfaces that may be visible in a camera, and sort them by distance.

    Args:
        surfaces: `scene.Surfaces`.
        atlas: `scene.Atlas`.
        camera: `scene.PosedCamera`.
        light: `scene.LightValues`.

    Returns:
        ``(V, COLUMNS)`` float64. The columns are defined at the beginning of this module.
    """
    origin, edge_s, edge_t, T_wc = (
        borrowed(surfaces.origin), borrowed(surfaces.edge_s), borrowed(surfaces.edge_t),
        borrowed(camera.T_wc))  # fmt: skip
    uv, texture, gain, material = surfaces.uv, surfaces.texture, surfaces.gain, surfaces.material
    detail, detail_size = surfaces.detail, surfaces.detail_size
    triangle, layer, log_size = surfaces.triangle, surfaces.layer, atlas.log_size
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    height, width = camera.height, camera.width
    sun_x, sun_y, sun_z = light.sun_x, light.sun_y, light.sun_z
    direct, ambient, glow = light.direct, light.ambient, light.glow
    found = np.empty((1024, COLUMNS))
    n = 0
    corner = np.empty((4, 3))
    left, right = (-1.0 - cx) / fx, (width - cx) / fx
    for q in range(len(origin)):
        # Products are written out, because matrix products are slow for vectors of length three.
        ox, oy, oz = origin[q, 0] - T_wc[0, 3], origin[q, 1] - T_wc[1, 3], origin[q, 2] - T_wc[2, 3]
        sx, sy, sz = edge_s[q, 0], edge_s[q, 1], edge_s[q, 2]
        tx, ty, tz = edge_t[q, 0], edge_t[q, 1], edge_t[q, 2]
        # Discard surfaces whose bounding sphere is outside of the view.
        mx, my, mz = ox + 0.5 * (sx + tx), oy + 0.5 * (sy + ty), oz + 0.5 * (sz + tz)
        radius = 0.5 * (
            math.sqrt(sx * sx + sy * sy + sz * sz) + math.sqrt(tx * tx + ty * ty + tz * tz)
        )
        zc = T_wc[0, 2] * mx + T_wc[1, 2] * my + T_wc[2, 2] * mz
        if zc < NEAR - radius or zc > FAR + radius:
            continue
        xc = T_wc[0, 0] * mx + T_wc[1, 0] * my + T_wc[2, 0] * mz
        reach = max(zc, 0.0)
        slack = radius * (1.0 + max(abs(left), abs(right)))
        if xc < left * reach - slack or xc > right * reach + slack:
            continue
        ax, ay, az = _in_camera_frame(T_wc, ox, oy, oz)
        bx, by, bz = _in_camera_frame(T_wc, sx, sy, sz)
        dx, dy, dz = _in_camera_frame(T_wc, tx, ty, tz)
        # [edge_s edge_t origin]^-1 by cross products.
        nx, ny, nz = by * dz - bz * dy, bz * dx - bx * dz, bx * dy - by * dx
        det = nx * ax + ny * ay + nz * az
        norm = math.sqrt(nx * nx + ny * ny + nz * nz)
        if abs(det) <= 1e-7 * norm or norm == 0.0:
            continue
        for k in range(4):
            a = 1.0 if k == 1 or k == 2 else 0.0
            b = 1.0 if k >= 2 else 0.0
            if triangle[q] and k == 2:
                b = 0.0
            corner[k, 0] = ax + a * bx + b * dx
            corner[k, 1] = ay + a * by + b * dy
            corner[k, 2] = az + a * bz + b * dz
        u0, u1, v0, v1 = _box(corner, fx, fy, cx, cy)
        if u1 < -1.0 or u0 > width or v1 < -1.0 or v0 > height or v0 > v1:
            continue
        if n == len(found):
            grown = np.empty((2 * n, COLUMNS))
            grown[:n] = found
            found = grown
        row = found[n]
        n += 1
        _affine(row, 0, (dy * az - dz * ay) / det, (dz * ax - dx * az) / det,
                (dx * ay - dy * ax) / det, fx, fy, cx, cy)  # fmt: skip
        _affine(row, 3, (ay * bz - az * by) / det, (az * bx - ax * bz) / det,
                (ax * by - ay * bx) / det, fx, fy, cx, cy)  # fmt: skip
        _affine(row, 6, nx / det, ny / det, nz / det, fx, fy, cx, cy)
        number = texture[q]
        texels_u, texels_v = float(1 << log_size[number, 0]), float(1 << log_size[number, 1])
        for k in range(3):
            row[TEXTURE + k] = texels_u * (
                uv[q, 0] * row[6 + k] + uv[q, 1] * row[k] + uv[q, 2] * row[3 + k]
            )
            row[TEXTURE + 3 + k] = texels_v * (
                uv[q, 3] * row[6 + k] + uv[q, 4] * row[k] + uv[q, 5] * row[3 + k]
            )
        row[FIRST_ROW] = max(math.floor(v0) - 1.0, 0.0)
        row[LAST_ROW] = min(math.ceil(v1) + 1.0, height - 1.0)
        row[TRIANGLE] = 1.0 if triangle[q] else 0.0
        row[LAYER] = 1.0 + LAYER_STEP * layer[q]
        row[NUMBER] = number
        row[DETAIL] = detail[q]
        if detail[q] >= 0:
            # Texels of the detail texture per texel of the base texture, along u and v.
            span_u = max(abs(uv[q, 1]), abs(uv[q, 2]), 1e-9)
            length_s = math.sqrt(sx * sx + sy * sy + sz * sz)
            length_t = math.sqrt(tx * tx + ty * ty + tz * tz)
            metres_u = (length_s if abs(uv[q, 1]) >= abs(uv[q, 2]) else length_t) / span_u
            span_v = max(abs(uv[q, 4]), abs(uv[q, 5]), 1e-9)
            metres_v = (length_s if abs(uv[q, 4]) > abs(uv[q, 5]) else length_t) / span_v
            fine = float(1 << log_size[detail[q], 0])
            row[DETAIL_U] = metres_u / texels_u / detail_size[q] * fine
            row[DETAIL_V] = metres_v / texels_v / detail_size[q] * fine
        # World normal, turned towards the camera.
        wx, wy, wz = sy * tz - sz * ty, sz * tx - sx * tz, sx * ty - sy * tx
        sign = -1.0 / norm if wx * ox + wy * oy + wz * oz > 0.0 else 1.0 / norm
        up = -sign * wy
        facing = sign * (wx * sun_x + wy * sun_y + wz * sun_z)
        if material[q] == 1:
            row[AMBIENT] = gain[q] * ambient * 0.75
            row[SUN] = gain[q] * direct * (0.42 + 0.2 * facing)
        else:
            row[AMBIENT] = gain[q] * ambient * (0.62 + 0.38 * up)
            row[SUN] = gain[q] * direct * max(facing, 0.0)
        row[GLOW] = gain[q] * glow if material[q] == 2 else 0.0
        row[KEY] = mx * mx + my * my + mz * mz - radius * radius
    found = found[:n]
    return found[np.argsort(found[:, KEY], kind="mergesort")]


@inline
def _in_camera_frame(T_wc, x, y, z):
    return (
        T_wc[0, 0] * x + T_wc[1, 0] * y + T_wc[2, 0] * z,
        T_wc[0, 1] * x + T_wc[1, 1] * y + T_wc[2, 1] * z,
        T_wc[0, 2] * x + T_wc[1, 2] * y + T_wc[2, 2] * z,
    )


@inline
def _affine(row, at, x, y, z, fx, fy, cx, cy):
    """Store the coefficients of u, v and 1 in ``(x, y, z) . K^-1 (u, v, 1)`` in ``row``."""
    row[at] = x / fx
    row[at + 1] = y / fy
    row[at + 2] = z - x * cx / fx - y * cy / fy


@kernel
def _box(corner, fx, fy, cx, cy):
    """Return the bounding box ``u0, u1, v0, v1`` of a quadrilateral in pixels.

    The quadrilateral has the ``(4, 3)`` corners ``corner`` and is clipped at the near plane.
    """
    u0, u1, v0, v1 = 1e9, -1e9, 1e9, -1e9
    for k in range(4):
        a, b = corner[k], corner[(k + 1) % 4]
        for end in range(2):
            x, y, z = a[0], a[1], a[2]
            if end == 1:
                if (a[2] < NEAR) == (b[2] < NEAR):
                    continue
                f = (NEAR - a[2]) / (b[2] - a[2])
                x, y, z = a[0] + f * (b[0] - a[0]), a[1] + f * (b[1] - a[1]), NEAR
            elif z < NEAR:
                continue
            u, v = fx * x / z + cx, fy * y / z + cy
            u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
    return u0, u1, v0, v1


@kernel
def rasterise(visible, atlas, band):
    """Draw surfaces into a band of samples.

    Args:
        visible: from `find_visible`.
        atlas: `scene.Atlas`.
        band: `scene.SampleBand`, whose ``inverse_depth`` and ``seen`` are updated.
    """
    visible, alpha = borrowed(visible), borrowed(atlas.alpha)
    alpha_offset, log_size = borrowed(atlas.alpha_offset), borrowed(atlas.log_size)
    inverse_depth, seen = borrowed(band.inverse_depth), borrowed(band.seen)
    samples = band.samples
    first_row = band.first_row * samples  # in samples
    height, width = inverse_depth.shape
    step = 1.0 / samples
    shift = 0.5 * step - 0.5  # pixel coordinate of sample 0
    held = np.empty((6, 3))
    bound = borrowed(held)
    for k in range(len(visible)):
        q = visible[k]
        first = max(int(q[FIRST_ROW]) * samples - first_row, 0)
        last = min((int(q[LAST_ROW]) + 1) * samples - first_row, height)
        if first >= last:
            continue
        for i in range(3):
            bound[0, i] = q[i] + _SEAM * q[6 + i]
            bound[1, i] = q[3 + i] + _SEAM * q[6 + i]
            bound[2, i] = (1.0 + _SEAM) * q[6 + i] - q[i]
            bound[3, i] = (1.0 + _SEAM) * q[6 + i] - q[3 + i]
            if q[TRIANGLE] > 0.0:
                bound[2, i] = (1.0 + _SEAM) * q[6 + i] - q[i] - q[3 + i]
                bound[3, i] = bound[2, i]
            bound[4, i] = q[6 + i]
            bound[5, i] = -q[6 + i]
        bound[4, 2] -= 1.0 / FAR
        bound[5, 2] += 1.0 / NEAR
        number = int(q[NUMBER])
        cut_out = alpha_offset[number, 0] >= 0
        for j in range(first, last):
            v = (j + first_row) * step + shift
            low, high = 0.0, width - 1.0
            for i in range(6):
                slope = bound[i, 0] * step
                value = bound[i, 0] * shift + bound[i, 1] * v + bound[i, 2]
                if slope > 0.0:
                    low = max(low, -value / slope)
                elif slope < 0.0:
                    high = min(high, -value / slope)
                elif value < 0.0:
                    high = -1.0
            begin, end = math.ceil(low), math.floor(high) + 1
            if begin >= end:
                continue
            slope = q[6] * step
            value = q[6] * shift + q[7] * v + q[8]
            if cut_out:
                span = _Span(begin, end, v, shift, step, value, slope)
                mask = _AlphaMap(alpha, alpha_offset[number], log_size[number])
                _fill_cut_out(q, k, span, mask, inverse_depth[j], seen[j])
            else:
                _fill(
                    value * q[LAYER],
                    slope * q[LAYER],
                    k,
                    float(begin),
                    inverse_depth[j, begin:end],
                    seen[j, begin:end],
                )
    held[0, 0] = 0.0  # keeps the array alive while ``bound`` is in use


@kernel
def _fill(value, slope, number, begin, inverse_depth, seen):
    """Draw a surface on the part of a row that begins at sample ``begin``.

    At sample ``i`` of the row, the surface has the inverse depth 1/z = ``value + slope i``.
    """
    value += slope * begin
    for i in range(np.uintp(len(seen))):
        near = np.float32(value + slope * np.float64(np.int32(i)))
        old = inverse_depth[i]
        nearer = near > old
        inverse_depth[i] = near if nearer else old
        seen[i] = number if nearer else seen[i]


@kernel
def _fill_cut_out(q, number, span, mask, inverse_depth, seen):
    """Draw a surface where the alpha of its texture is at least one half.

    Args:
        q: the row of the result of `find_visible` that describes the surface.
        number: the index of this row.
        span: `_Span`.
        mask: `_AlphaMap`.
        inverse_depth, seen: one row of the `scene.SampleBand`, updated.
    """
    begin, end, v = span.begin, span.end, span.v
    shift, step, value, slope = span.shift, span.step, span.value, span.slope
    alpha, offset, log_size = mask.alpha, mask.offset, mask.log_size
    u_slope, v_slope = q[TEXTURE] * step, q[TEXTURE + 3] * step
    u_value = q[TEXTURE] * shift + q[TEXTURE + 1] * v + q[TEXTURE + 2]
    v_value = q[TEXTURE + 3] * shift + q[TEXTURE + 4] * v + q[TEXTURE + 5]
    # One mipmap level is enough for a row, because cut-outs are small or far away.
    middle = 0.5 * (begin + end)
    z = 1.0 / (value + slope * middle)
    a, b = (u_value + u_slope * middle) * z, (v_value + v_slope * middle) * z
    along = math.hypot(u_slope - a * slope, v_slope - b * slope) * z
    across = math.hypot(q[TEXTURE + 1] - a * q[7], q[TEXTURE + 4] - b * q[7]) * z * step
    size = max(math.sqrt(along * across), 1.0)
    level = min(int(math.log2(size) + 0.6), max(log_size[0], log_size[1]))
    scale = 1.0 / (1 << level)
    at = offset[level]
    row_log = max(log_size[0] - level, 0)
    mask_u = (1 << row_log) - 1
    mask_v = (1 << max(log_size[1] - level, 0)) - 1
    for i in range(begin, end):
        inverse = value + slope * i
        if np.float32(inverse) <= inverse_depth[i]:
            continue
        z = 1.0 / inverse
        x = (u_value + u_slope * i) * z * scale - 0.5
        y = (v_value + v_slope * i) * z * scale - 0.5
        if (
            level > 0
        ):  # the texels of level 0 are smaller than samples, so no interpolation is needed
            c0, r0 = math.floor(x + 0.5) & mask_u, math.floor(y + 0.5) & mask_v
            if alpha[np.uintp(at + (r0 << row_log) + c0)] < 128:
                continue
        else:
            x0, y0 = math.floor(x), math.floor(y)
            fx, fy = x - x0, y - y0
            c0, r0 = int(x0), int(y0)
            c1, r1 = (c0 + 1) & mask_u, at + (((r0 + 1) & mask_v) << row_log)
            c0, r0 = c0 & mask_u, at + ((r0 & mask_v) << row_log)
            upper = alpha[np.uintp(r0 + c0)] * (1.0 - fx) + alpha[np.uintp(r0 + c1)] * fx
            lower = alpha[np.uintp(r1 + c0)] * (1.0 - fx) + alpha[np.uintp(r1 + c1)] * fx
            if upper * (1.0 - fy) + lower * fy < 127.5:
                continue
        inverse_depth[i] = np.float32(inverse)
        seen[i] = number
