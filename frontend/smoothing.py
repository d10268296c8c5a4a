"""The Gaussian blur before BRIEF, in OpenCV's fixed-point numbers.

``cv2.GaussianBlur`` with 7x7 pixels and a deviation of 2 weights bytes by 1/256 in rows and columns
and rounds once at the end. Here every sum of a pass fits 16 bits, so that a register takes twice as
many pixels as with 32: the sums of the rows are split into whole grey levels and 256ths, and the
columns are summed over both.
"""

from __future__ import annotations

import numpy as np

from vslam.kernels import borrowed, inner_kernel, kernel

REACH = 3  # pixels to both sides


@kernel
def smoothed(pixels):
    """Blurred image, ``(H, W)`` uint8, of one of at least 4x4 pixels, mirrored at its border."""
    height, width = pixels.shape
    taps = 2 * REACH + 1
    out = np.empty((height, width), np.uint8)
    row = np.empty(width + 2 * REACH, np.uint16)
    rows = np.empty((taps, 2 * width), np.uint16)  # of the last rows, wholes and 256ths
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
    """The weights of a deviation of 2 in 256ths, as OpenCV rounds them so that their sum is 256."""
    for x in range(np.uintp(len(out))):
        out[x] = 18 * (a[x] + g[x]) + 34 * (b[x] + f[x]) + 48 * (c[x] + e[x]) + 56 * d[x]
