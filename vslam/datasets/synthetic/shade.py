"""The grey of each pixel: trilinear texture, sun, shadow, haze and sky."""

from __future__ import annotations

import math

import numpy as np

from vslam.datasets.synthetic.rasterise import (
    AMBIENT,
    DETAIL,
    DETAIL_U,
    DETAIL_V,
    GLOW,
    NUMBER,
    SUN,
    TEXTURE,
)
from vslam.kernels import inline, kernel

_SCALE = 0.5 ** np.arange(24)  # of the levels of a mipmap
MAX_TAPS = 2  # trilinear samples along the long side of a pixel's footprint
_DETAIL_ENDS = 12.0  # texels of the fine texture in a pixel that leave nothing of its contrast
_SKY_HAZE = 185.0  # haze under which the panorama shows its own grey
SKY_RISE = 1.0  # tangent of the elevation at the upper edge of the sky's panorama
SKY_FALL = 0.1  # and of the depression at its lower edge
_SHADE_BIAS = 0.35  # m that an occluder must rise above a point to shade it


@inline
def _bilinear(texels, at, log_w, log_h, level, u, v):
    """Texture at ``(u, v)``, given in texels of level 0; it repeats endlessly."""
    scale = _SCALE[level]
    x = u * scale - np.float32(0.5)
    y = v * scale - np.float32(0.5)
    x0, y0 = math.floor(x), math.floor(y)
    fx, fy = np.float32(x - x0), np.float32(y - y0)
    row_log = max(log_w - level, 0)
    mask_u = (1 << row_log) - 1
    mask_v = (1 << max(log_h - level, 0)) - 1
    c0, r0 = int(x0), int(y0)
    c1, r1 = (c0 + 1) & mask_u, at + (((r0 + 1) & mask_v) << row_log)
    c0, r0 = c0 & mask_u, at + ((r0 & mask_v) << row_log)
    # Unsigned indices: no check for those that count from the end.
    a, b = np.float32(texels[np.uintp(r0 + c0)]), np.float32(texels[np.uintp(r0 + c1)])
    c, d = np.float32(texels[np.uintp(r1 + c0)]), np.float32(texels[np.uintp(r1 + c1)])
    upper = a + (b - a) * fx
    return upper + (c + (d - c) * fx - upper) * fy


@inline
def _log2(size):
    """Integer part and, linear between powers of two, the fraction of a logarithm; size >= 1."""
    bits = np.float32(size).view(np.int32)
    return (int(bits) >> 23) - 127, np.float32(int(bits) & 0x7FFFFF) * np.float32(1.0 / 0x800000)


@kernel
def _trilinear(texels, offset, number, log_w, log_h, size, u, v):
    """Texture ``number`` at ``(u, v)`` averaged over about ``size`` texels of level 0."""
    if size <= 1.0:
        return _bilinear(texels, offset[number, 0], log_w, log_h, 0, u, v)
    low, part = _log2(size)
    top = max(log_w, log_h)
    if low >= top:
        return np.float32(texels[np.uintp(offset[number, top])])
    near = _bilinear(texels, offset[number, low], log_w, log_h, low, u, v)
    far = _bilinear(texels, offset[number, low + 1], log_w, log_h, low + 1, u, v)
    return near + (far - near) * part


@kernel
def _sky(texels, offset, log_size, number, x, y, z, pixel):
    """Panorama in the world direction ``(x, y, z)``; ``pixel``: angle of a pixel in radians."""
    log_w, log_h = log_size[number, 0], log_size[number, 1]
    flat = math.sqrt(x * x + z * z)
    rise = (SKY_RISE + y / flat) / (SKY_RISE + SKY_FALL)
    u = (math.atan2(x, z) / (2.0 * math.pi) + 0.5) * (1 << log_w)
    v = min(max(rise, 0.0), 0.9999) * ((1 << log_h) - 1) + 0.5
    size = pixel * max((1 << log_w) / (2.0 * math.pi), (1 << log_h) / (SKY_RISE + SKY_FALL))
    return _trilinear(texels, offset, number, log_w, log_h, size, u, v)


@kernel
def _lit(shadow, frame, lamp, x, y, z):
    """Part of the sun that reaches a world point: 0 in shadow to 1, soft at the edge."""
    up = -y
    slope = 1.0 / max(-lamp[1], 0.05)
    a = (x - lamp[0] * slope * up - frame[0]) / frame[2] - 0.5
    b = (z - lamp[2] * slope * up - frame[1]) / frame[2] - 0.5
    a0, b0 = math.floor(a), math.floor(b)
    c, r = int(a0), int(b0)
    if c < 0 or r < 0 or c >= shadow.shape[1] - 1 or r >= shadow.shape[0] - 1:
        return 1.0
    level = (up + _SHADE_BIAS - frame[3]) * 100.0
    fa, fb = a - a0, b - b0
    light = 0.0
    r, c = np.uintp(r), np.uintp(c)
    one = np.uintp(1)
    if shadow[r, c] <= level:
        light += (1.0 - fa) * (1.0 - fb)
    if shadow[r, c + one] <= level:
        light += fa * (1.0 - fb)
    if shadow[r + one, c] <= level:
        light += (1.0 - fa) * fb
    if shadow[r + one, c + one] <= level:
        light += fa * fb
    return light


@kernel
def shade(
    visible,
    first_row,
    samples,
    seen,
    texels,
    offset,
    log_size,
    sky,
    shadow,
    frame,
    T_wc,
    intrinsics,
    lamp,
    image,
    depth,
):
    """Fill the rows of ``image`` and ``depth`` that belong to a band of samples.

    Args:
        visible: from `rasterise.find_visible`.
        first_row: first row of the band in the image.
        samples: samples a pixel in each direction.
        seen: ``(samples h, samples W)`` int32 from `rasterise.rasterise`.
        texels, offset, log_size: see `scene.Atlas`.
        sky: number of the sky's panorama.
        shadow, frame: see `shadows.ShadowMap`.
        T_wc, intrinsics, lamp: pose, ``fx fy cx cy``, `render.Light.as_array`.
        image, depth: ``(H, W)`` float32, written; see `render.View`.
    """
    fx, fy, cx, cy = intrinsics
    width = image.shape[1]
    step = 1.0 / samples
    number = np.empty(samples * samples, np.int64)
    weight = np.empty(samples * samples)
    shift_u = np.empty(samples * samples)
    shift_v = np.empty(samples * samples)
    rate = 1.0 / lamp[7]
    for j in range(seen.shape[0] // samples):
        v = first_row + j
        for u in range(width):
            kinds = 1
            first = seen[j * samples, u * samples]
            number[0], weight[0], shift_u[0], shift_v[0] = first, samples * samples, 0.0, 0.0
            alike = True
            for a in range(samples):
                for b in range(samples):
                    alike &= seen[j * samples + a, u * samples + b] == first
            if not alike:
                kinds = 0
                for a in range(samples):
                    for b in range(samples):
                        s = seen[j * samples + a, u * samples + b]
                        k = 0
                        while k < kinds and number[k] != s:
                            k += 1
                        if k == kinds:
                            number[k] = s
                            weight[k] = shift_u[k] = shift_v[k] = 0.0
                            kinds += 1
                        weight[k] += 1.0
                        shift_u[k] += (b + 0.5) * step - 0.5
                        shift_v[k] += (a + 0.5) * step - 0.5
            total = 0.0
            nearest = 0.0
            for k in range(kinds):
                x = u + shift_u[k] / weight[k]
                y = v + shift_v[k] / weight[k]
                rx, ry = (x - cx) / fx, (y - cy) / fy
                wx = T_wc[0, 0] * rx + T_wc[0, 1] * ry + T_wc[0, 2]
                wy = T_wc[1, 0] * rx + T_wc[1, 1] * ry + T_wc[1, 2]
                wz = T_wc[2, 0] * rx + T_wc[2, 1] * ry + T_wc[2, 2]
                if number[k] < 0:
                    grey = _sky(texels, offset, log_size, sky, wx, wy, wz, 1.0 / fx)
                    total += weight[k] * grey * lamp[6] / _SKY_HAZE
                    continue
                # No row view here: counting its references costs more than the arithmetic.
                n = np.uintp(number[k])
                inverse = visible[n, 6] * x + visible[n, 7] * y + visible[n, 8]
                z = 1.0 / inverse
                s = (
                    visible[n, TEXTURE] * x + visible[n, TEXTURE + 1] * y + visible[n, TEXTURE + 2]
                ) * z
                t = (
                    visible[n, TEXTURE + 3] * x
                    + visible[n, TEXTURE + 4] * y
                    + visible[n, TEXTURE + 5]
                ) * z
                s_u, t_u = (
                    (visible[n, TEXTURE] - s * visible[n, 6]) * z,
                    (visible[n, TEXTURE + 3] - t * visible[n, 6]) * z,
                )
                s_v, t_v = (
                    (visible[n, TEXTURE + 1] - s * visible[n, 7]) * z,
                    (visible[n, TEXTURE + 4] - t * visible[n, 7]) * z,
                )
                along_u, along_v = (
                    math.sqrt(s_u * s_u + t_u * t_u),
                    math.sqrt(s_v * s_v + t_v * t_v),
                )
                if along_u > along_v:
                    long, short, ds, dt = along_u, along_v, s_u, t_u
                else:
                    long, short, ds, dt = along_v, along_u, s_v, t_v
                taps = 1
                if long > 1.0:
                    taps = min(math.ceil(long / max(short, 1.0) - 0.25), MAX_TAPS)
                size = max(long / taps, short)
                texture = int(visible[n, NUMBER])
                log_w, log_h = log_size[texture, 0], log_size[texture, 1]
                albedo = 0.0
                for tap in range(taps):
                    f = (tap + 0.5) / taps - 0.5
                    albedo += _trilinear(
                        texels, offset, texture, log_w, log_h, size, s + f * ds, t + f * dt
                    )
                albedo /= taps
                fine = int(visible[n, DETAIL])
                if fine >= 0:
                    detail_size = size * max(visible[n, DETAIL_U], visible[n, DETAIL_V])
                    log_d = log_size[fine, 0]
                    if detail_size < _DETAIL_ENDS:
                        albedo *= (
                            _trilinear(
                                texels,
                                offset,
                                fine,
                                log_d,
                                log_d,
                                detail_size,
                                s * visible[n, DETAIL_U],
                                t * visible[n, DETAIL_V],
                            )
                            / 128.0
                        )
                light = visible[n, AMBIENT]
                if visible[n, SUN] > 0.0:
                    light += visible[n, SUN] * _lit(
                        shadow,
                        frame,
                        lamp,
                        T_wc[0, 3] + z * wx,
                        T_wc[1, 3] + z * wy,
                        T_wc[2, 3] + z * wz,
                    )
                if lamp[9] > 0.0:
                    beam = math.exp(-3.0 * rx * rx - 30.0 * (ry - 0.08) * (ry - 0.08))
                    light += lamp[9] * beam * 200.0 / (100.0 + z * z)
                grey = albedo * (light + visible[n, GLOW])
                clear = 1.0 / (1.0 + z * rate * (1.0 + 0.5 * z * rate))
                total += weight[k] * (grey * clear + lamp[6] * (1.0 - clear))
                nearest = max(nearest, inverse)
            image[v, u] = total * lamp[8] / (samples * samples)
            depth[v, u] = 1.0 / nearest if nearest > 0.0 else 0.0
