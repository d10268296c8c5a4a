"""Shades pixels with trilinear textures, sun, shadows, lamps, haze and sky."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import borrowed, inline, kernel
from vslam_lab.towns.rasterise import (
    AMBIENT,
    DETAIL,
    DETAIL_U,
    DETAIL_V,
    GLOW,
    NUMBER,
    SUN,
    TEXTURE,
)
from vslam_lab.towns.scene import Atlas, PosedCamera
from vslam_lab.towns.shadows import LampPools, ShadowMap

_SCALE = 0.5 ** np.arange(24)  # scale of each mipmap level
_TWO_TAPS = 1.25  # a pixel is sampled twice if the aspect ratio of its footprint is above this
_DETAIL_ENDS = 12.0  # texels of the detail texture per pixel at which its contrast vanishes
_SKY_HAZE = 185.0  # grey level of the haze at which the panorama of the sky is not scaled
SKY_RISE = 1.0  # tangent of the elevation at the upper edge of the sky's panorama
SKY_FALL = 0.1  # tangent of the depression at the lower edge of the sky's panorama
# Grey levels that the glare adds at the sun, and 1 - cos(angle) at which the glare is a quarter.
_GLARE, _GLARE_WIDTH = 120.0, 0.10
_POOL_GAIN = 2.5  # brightness under a street lamp relative to a lit window
_SHADE_BIAS = 0.35  # m; an occluder must be this much higher than a point to shade it


class _PixelRun(NamedTuple):
    """Neighbouring pixels of one image row in which the same surface is visible.

    The pixels are in the columns ``start`` to ``end - 1``, i8. ``x`` and ``y`` are the position of
    the sample in the first pixel, f8. In the other pixels, the sample has the same offset.
    ``weight`` is the fraction of each pixel that the surface covers, f8.
    """

    start: int
    end: int
    x: float
    y: float
    weight: float


class _RowBuffers(NamedTuple):
    """Working memory for one row of W pixels.

    ``total`` is the sum of the radiance so far, (W,) f8. ``nearest`` is the largest 1/z so far,
    (W,) f8.

    The other arrays describe the current run. ``texel`` is (6, W) f8. Its rows are the depth, s, t,
    half the distance of two texture samples in s, the same in t, and the albedo. ``size`` is the
    number of texels per pixel, (W,) f4. ``bits`` is a view of the bits of ``size``, (W,) i4.
    """

    total: NDArray[np.float64]
    nearest: NDArray[np.float64]
    texel: NDArray[np.float64]
    size: NDArray[np.float32]
    bits: NDArray[np.int32]


@inline
def _bilinear(texels, at, log_w, log_h, level, u, v):
    """Sample a repeating texture bilinearly at ``(u, v)``, in texels of level 0."""
    scale = _SCALE[level]
    x = u * scale - 0.5
    y = v * scale - 0.5
    x0, y0 = math.floor(x), math.floor(y)
    fx, fy = np.float32(x - x0), np.float32(y - y0)
    row_log = max(log_w - level, 0)
    mask_u = (1 << row_log) - 1
    mask_v = (1 << max(log_h - level, 0)) - 1
    c0, r0 = int(x0), int(y0)
    c1, r1 = (c0 + 1) & mask_u, at + (((r0 + 1) & mask_v) << row_log)
    c0, r0 = c0 & mask_u, at + ((r0 & mask_v) << row_log)
    # Unsigned indices avoid Numba's check for negative ones.
    a, b = np.float32(texels[np.uintp(r0 + c0)]), np.float32(texels[np.uintp(r0 + c1)])
    c, d = np.float32(texels[np.uintp(r1 + c0)]), np.float32(texels[np.uintp(r1 + c1)])
    upper = a + (b - a) * fx
    return upper + (c + (d - c) * fx - upper) * fy


@inline
def _log2(bits):
    """Return the integer part and the fraction of log2 of a float32, which is given by its bits.

    The fraction is interpolated linearly between powers of two.
    """
    return (int(bits) >> 23) - 127, np.float32(int(bits) & 0x7FFFFF) * np.float32(1.0 / 0x800000)


@inline
def _trilinear(texels, offset, number, log_w, log_h, bits, u, v):
    """Sample a texture at ``(u, v)``, averaged over a pixel.

    ``bits`` are the bits of a float32: the number of texels of level 0 per pixel in one direction.
    Two mipmap levels are blended over the middle half of an octave.
    """
    low, part = _log2(bits)
    top = max(log_w, log_h)
    part = (part - np.float32(0.25)) * np.float32(2.0)
    if low < 0:
        low, part = 0, np.float32(0.0)
    if low >= top:
        low, part = top, np.float32(0.0)
    # There is only one return statement. With more of them, Numba would count references here.
    row = np.uintp(number)
    high = low
    if part >= 1.0:
        low = high = low + 1
    elif part > 0.0:
        high = low + 1
    grey = _bilinear(texels, offset[row, np.uintp(low)], log_w, log_h, low, u, v)
    if high > low:
        far = _bilinear(texels, offset[row, np.uintp(high)], log_w, log_h, high, u, v)
        grey += (far - grey) * part
    return grey


@inline
def _sky(atlas, number, light, x, y, z, bits):
    """Return the grey level of the sky in the world direction ``(x, y, z)``, with sun glare.

    ``bits`` are the bits of a float32: the number of texels of level 0 per pixel.
    """
    texels, offset, log_size = atlas.texels, atlas.offset, atlas.log_size
    log_w, log_h = log_size[number, 0], log_size[number, 1]
    square = x * x + z * z
    flat = math.sqrt(square)
    rise = (SKY_RISE + y / flat) / (SKY_RISE + SKY_FALL)
    u = (math.atan2(x, z) / (2.0 * math.pi) + 0.5) * (1 << log_w)
    v = min(max(rise, 0.0), 0.9999) * ((1 << log_h) - 1) + 0.5
    away = 1.0 - (x * light.sun_x + y * light.sun_y + z * light.sun_z) / math.sqrt(square + y * y)
    glow = light.direct * (_GLARE / (1.0 + away / _GLARE_WIDTH) ** 2)
    return _trilinear(texels, offset, number, log_w, log_h, bits, u, v) + glow


@inline
def _lit(shadow, frame, light, slope, x, y, z):
    """Return the fraction of the sunlight at a world point. Shadows have soft edges."""
    up = -y
    a = (x - light.sun_x * slope * up - frame[0]) / frame[2] - 0.5
    b = (z - light.sun_z * slope * up - frame[1]) / frame[2] - 0.5
    a0, b0 = math.floor(a), math.floor(b)
    c, r = int(a0), int(b0)
    part = 1.0
    if c >= 0 and r >= 0 and c < shadow.shape[1] - 1 and r < shadow.shape[0] - 1:
        level = (up + _SHADE_BIAS - frame[3]) * 100.0
        fa, fb = a - a0, b - b0
        part = 0.0
        r, c = np.uintp(r), np.uintp(c)
        one = np.uintp(1)
        if shadow[r, c] <= level:
            part += (1.0 - fa) * (1.0 - fb)
        if shadow[r, c + one] <= level:
            part += fa * (1.0 - fb)
        if shadow[r + one, c] <= level:
            part += (1.0 - fa) * fb
        if shadow[r + one, c + one] <= level:
            part += fa * fb
    return part


@inline
def _pool(pools, frame, x, z):
    """Return the light of the street lamps at a world point. It is 1 under a lamp."""
    a = (x - frame[0]) / frame[2]
    b = (z - frame[1]) / frame[2]
    c, r = math.floor(a), math.floor(b)
    light = 0.0
    if c >= 0 and r >= 0 and c < pools.shape[1] - 1 and r < pools.shape[0] - 1:
        fa, fb = a - c, b - r
        r, c = np.uintp(r), np.uintp(c)
        one = np.uintp(1)
        upper = pools[r, c] * (1.0 - fa) + pools[r, c + one] * fa
        lower = pools[r + one, c] * (1.0 - fa) + pools[r + one, c + one] * fa
        light = upper * (1.0 - fb) + lower * fb
    return light


@kernel
def shade(visible, band, atlas, sky, light, shadows, pools, camera, view):
    """Shade the rows of a view that belong to a band of samples.

    Neighbouring pixels in which only one surface is visible are shaded together (a run). If several
    surfaces are visible in a pixel, the pixel is shaded once for each of them.

    Args:
        visible: result of `rasterise.find_visible`.
        band: `scene.SampleBand`, after `rasterise.rasterise`.
        atlas: `scene.Atlas`.
        sky: number of the sky's panorama in the atlas.
        light: `scene.LightValues`.
        shadows: `shadows.ShadowMap`.
        pools: `shadows.LampPools`.
        camera: `scene.PosedCamera`.
        view: `render.RenderedView`, output.
    """
    visible, seen = borrowed(visible), borrowed(band.seen)
    first_row, samples = band.first_row, band.samples
    image, depth = view.image, view.depth
    atlas = Atlas(
        borrowed(atlas.texels), borrowed(atlas.alpha), borrowed(atlas.offset),
        borrowed(atlas.alpha_offset), borrowed(atlas.log_size))  # fmt: skip
    shadows = ShadowMap(borrowed(shadows.height_cm), borrowed(shadows.frame))
    pools = LampPools(borrowed(pools.light), borrowed(pools.frame))
    camera = PosedCamera(
        borrowed(camera.T_wc), camera.fx, camera.fy, camera.cx, camera.cy, camera.height,
        camera.width)  # fmt: skip
    width = image.shape[1]
    room = samples * samples
    held_number, held = np.empty(room, np.int64), np.empty((3, room))
    number = borrowed(held_number)
    weight, shift_u, shift_v = borrowed(held[0]), borrowed(held[1]), borrowed(held[2])
    held_rows, held_size = np.empty((8, width)), np.empty(width, np.float32)
    texel, total, nearest = borrowed(held_rows[2:]), borrowed(held_rows[0]), borrowed(held_rows[1])
    size, bits = borrowed(held_size), borrowed(held_size.view(np.int32))
    buffers = _RowBuffers(total, nearest, texel, size, bits)
    for j in range(seen.shape[0] // samples):
        v = first_row + j
        total[:] = 0.0
        nearest[:] = 0.0
        start = 0
        while start < width:
            first = seen[j * samples, start * samples]
            end = start
            while end < width and _is_alone_in_pixel(
                seen, j * samples, end * samples, samples, first
            ):
                end += 1
            if end > start:
                number[0], weight[0], shift_u[0], shift_v[0] = first, room, 0.0, 0.0
                kinds = 1
            else:
                end = start + 1
                kinds = _kinds(
                    seen, j * samples, start * samples, samples, number, weight, shift_u, shift_v
                )
            for k in range(kinds):
                x, y = start + shift_u[k] / weight[k], v + shift_v[k] / weight[k]
                run = _PixelRun(start, end, x, y, weight[k] / room)
                if number[k] < 0:
                    _add_sky_to_run(run, atlas, sky, light, camera, buffers)
                else:
                    _add_surface_to_run(
                        run, visible, number[k], atlas, light, shadows, pools, camera, buffers
                    )
            start = end
        for u in range(width):
            image[v, u] = total[u] * light.exposure
            depth[v, u] = 1.0 / nearest[u] if nearest[u] > 0.0 else 0.0
    # This keeps the arrays alive whose memory is used above.
    held[0, 0] = held_number[0] + held_rows[0, 0] + held_size[0]


@inline
def _kinds(seen, row, column, samples, number, weight, shift_u, shift_v):
    """Collect the surfaces that are visible at the samples of a pixel, and return their number.

    For each surface, ``weight`` becomes the number of samples at which the surface is visible.
    ``shift_u`` and ``shift_v`` become the sums of the offsets of these samples from the centre of
    the pixel.
    """
    kinds = 0
    step = 1.0 / samples
    for a in range(samples):
        for b in range(samples):
            s = seen[np.uintp(row + a), np.uintp(column + b)]
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
    return kinds


@inline
def _is_alone_in_pixel(seen, row, column, samples, first):
    """Return whether the surface ``first`` is visible at all samples of a pixel."""
    alike = True
    for a in range(samples):
        for b in range(samples):
            alike &= seen[np.uintp(row + a), np.uintp(column + b)] == first
    return alike


@inline
def _add_sky_to_run(run, atlas, sky, light, camera, buffers):
    start, end, x0, y, weight = run.start, run.end, run.x, run.y, run.weight
    log_size, T_wc = atlas.log_size, camera.T_wc
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    size, bits, total = buffers.size, buffers.bits, buffers.total
    scale_u = (1 << log_size[sky, 0]) / (2.0 * math.pi)
    scale_v = (1 << log_size[sky, 1]) / (SKY_RISE + SKY_FALL)
    size[0] = max(scale_u, scale_v) / fx
    ry = (y - cy) / fy
    for u in range(start, end):
        rx = (x0 + (u - start) - cx) / fx
        grey = _sky(
            atlas, sky, light, T_wc[0, 0] * rx + T_wc[0, 1] * ry + T_wc[0, 2],
            T_wc[1, 0] * rx + T_wc[1, 1] * ry + T_wc[1, 2],
            T_wc[2, 0] * rx + T_wc[2, 1] * ry + T_wc[2, 2], bits[0],
        )  # fmt: skip
        total[u] += weight * grey * light.haze / _SKY_HAZE


@inline
def _add_surface_to_run(run, visible, number, atlas, light, shadows, pools, camera, buffers):
    """Add the surface ``visible[number]`` to ``buffers.total`` and ``buffers.nearest``.

    The other arguments have the same meaning as for `shade`.
    """
    start, end, x0, y, weight = run.start, run.end, run.x, run.y, run.weight
    texels, offset, log_size, T_wc = atlas.texels, atlas.offset, atlas.log_size, camera.T_wc
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    texel, size, bits = buffers.texel, buffers.size, buffers.bits
    total, nearest = buffers.total, buffers.nearest
    shadow, frame, pool, pool_frame = shadows.height_cm, shadows.frame, pools.light, pools.frame
    ry = (y - cy) / fy
    count = end - start
    # The direction of the ray of pixel i is base + i step.
    step_x, step_y, step_z = T_wc[0, 0] / fx, T_wc[1, 0] / fx, T_wc[2, 0] / fx
    base_x = T_wc[0, 1] * ry + T_wc[0, 2] + (x0 - cx) * step_x
    base_y = T_wc[1, 1] * ry + T_wc[1, 2] + (x0 - cx) * step_y
    base_z = T_wc[2, 1] * ry + T_wc[2, 2] + (x0 - cx) * step_z
    n = np.uintp(number)  # a view of the row would be slower: Numba would count its references
    au, av = visible[n, TEXTURE], visible[n, TEXTURE + 3]
    bu, bv = visible[n, TEXTURE + 1], visible[n, TEXTURE + 4]
    inverse_0 = visible[n, 6] * x0 + visible[n, 7] * y + visible[n, 8]
    u_0 = au * x0 + bu * y + visible[n, TEXTURE + 2]
    v_0 = av * x0 + bv * y + visible[n, TEXTURE + 5]
    p6, p7 = visible[n, 6], visible[n, 7]
    for i in range(np.uintp(count)):
        at = np.float64(np.int64(i))
        z = 1.0 / (inverse_0 + at * p6)
        s, t = (u_0 + at * au) * z, (v_0 + at * av) * z
        s_u, t_u = (au - s * p6) * z, (av - t * p6) * z
        s_v, t_v = (bu - s * p7) * z, (bv - t * p7) * z
        along_u, along_v = s_u * s_u + t_u * t_u, s_v * s_v + t_v * t_v
        wide = along_u > along_v
        long, short = math.sqrt(max(along_u, along_v)), math.sqrt(min(along_u, along_v))
        twice = long > _TWO_TAPS * max(short, 1.0)
        texel[0, i], texel[1, i], texel[2, i] = z, s, t
        texel[3, i] = (0.25 * (s_u if wide else s_v)) if twice else 0.0
        texel[4, i] = (0.25 * (t_u if wide else t_v)) if twice else 0.0
        size[i] = max(0.5 * long if twice else long, short)
    texture, fine = int(visible[n, NUMBER]), int(visible[n, DETAIL])
    log_w, log_h = log_size[texture, 0], log_size[texture, 1]
    for i in range(count):
        s, t = texel[1, i], texel[2, i]
        ds, dt = texel[3, i], texel[4, i]
        taps = 2 if ds != 0.0 or dt != 0.0 else 1
        albedo = np.float32(0.0)
        for tap in range(taps):
            f = taps - 1 - 2 * tap  # 0 for one texture sample, 1 and -1 for two
            albedo += _trilinear(
                texels, offset, texture, log_w, log_h, bits[i], s + f * ds, t + f * dt
            )
        texel[5, i] = albedo / np.float32(taps)
    if fine >= 0:
        detail_u, detail_v = visible[n, DETAIL_U], visible[n, DETAIL_V]
        finer = max(detail_u, detail_v)
        log_d = log_size[fine, 0]
        for i in range(count):
            size[i] = min(size[i] * finer, 2.0 * _DETAIL_ENDS)
            if size[i] < _DETAIL_ENDS:
                texel[5, i] *= (
                    _trilinear(
                        texels, offset, fine, log_d, log_d, bits[i], texel[1, i] * detail_u,
                        texel[2, i] * detail_v,
                    )
                    / 128.0
                )  # fmt: skip
    ambient, sun = visible[n, AMBIENT] + visible[n, GLOW], visible[n, SUN]
    slope = 1.0 / max(-light.sun_y, 0.05)
    rate = 1.0 / light.visibility
    glow, headlight, haze = light.glow, light.headlight, light.haze
    lamps, beams = glow > 0.0, headlight > 0.0
    gain = visible[n, AMBIENT] / max(light.ambient, 1e-6)
    for i in range(count):
        z = texel[0, i]
        received = ambient
        if sun > 0.0 or lamps:
            x = T_wc[0, 3] + z * (base_x + i * step_x)
            up = T_wc[1, 3] + z * (base_y + i * step_y)
            far = T_wc[2, 3] + z * (base_z + i * step_z)
            if sun > 0.0:
                received += sun * _lit(shadow, frame, light, slope, x, up, far)
            if lamps:
                received += _POOL_GAIN * gain * glow * _pool(pool, pool_frame, x, far)
        if beams:
            rx = (x0 + i - cx) / fx
            beam = math.exp(-3.0 * rx * rx - 30.0 * (ry - 0.08) * (ry - 0.08))
            received += headlight * beam * 200.0 / (100.0 + z * z)
        clear = 1.0 / (1.0 + z * rate * (1.0 + 0.5 * z * rate))
        total[start + i] += weight * (texel[5, i] * received * clear + haze * (1.0 - clear))
        nearest[start + i] = max(nearest[start + i], 1.0 / z)
