"""The Gaussian blur before BRIEF, with the same result as OpenCV's fixed-point version.

``cv2.GaussianBlur`` with a 7x7 kernel and a sigma of 2 weights bytes in multiples of 1/256, first
along rows, then along columns, and rounds once at the end. Here every intermediate sum fits 16
bits, so that a vector register holds twice as many pixels as with 32 bits: row sums are split into
whole grey levels and 256ths, and both parts are summed along the columns.
"""

from __future__ import annotations

import numpy as np

from vslam.kernels import borrowed, inner_kernel, kernel

REACH = 3  # radius of the kernel, pixels


@kernel
def smoothed(pixels):
    """Blur an ``(H, W)`` uint8 image of at least 4x4 pixels, with mirrored borders."""
    height, width = pixels.shape
    taps = 2 * REACH + 1
    out = np.empty((height, width), np.uint8)
    row = np.empty(width + 2 * REACH, np.uint16)
    rows = np.empty((taps, 2 * width), np.uint16)  # the last row sums: whole levels, then 256ths
    total = np.empty(2 * width, np.uint16)
    n = np.uintp(width)
    for y in range(-REACH, height + REACH):
        source = pixels[abs(y) if y < height else 2 * (height - 1) - y]
        for x in range(n):
            row[x + REACH] = source[x]
        for x in range(REACH):
            row[x] = source[REACH - x]
            row[width + REACH + x] = source[width - 2 - x]
        r = borrowed(row)
        weigh(r, r[1:], r[2:], r[3:], r[4:], r[5:], r[6:], borrowed(total)[:width])
        split = rows[y % taps]
        for x in range(n):
            split[x] = total[x] >> 8
            split[n + x] = total[x] & 255
        if y < REACH:
            continue
        s = borrowed(rows)
        weigh(
            s[(y + 1) % taps],
            s[(y + 2) % taps],
            s[(y + 3) % taps],
            s[(y + 4) % taps],
            s[(y + 5) % taps],
            s[(y + 6) % taps],
            s[y % taps],
            borrowed(total),
        )
        line = out[y - REACH]
        for x in range(n):
            line[x] = np.uint16(total[x] + (total[n + x] >> 8) + 128) >> 8
    return out


@inner_kernel
def weigh(a, b, c, d, e, f, g, out):
    """Weighted sum of seven rows or shifted copies of one. The weights are those of a Gaussian of
    sigma 2 in 256ths, rounded as OpenCV does so that they sum to 256."""
    for x in range(np.uintp(len(out))):
        out[x] = 18 * (a[x] + g[x]) + 34 * (b[x] + f[x]) + 48 * (c[x] + e[x]) + 56 * d[x]
