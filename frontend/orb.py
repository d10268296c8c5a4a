"""ORB features: evenly spread FAST corners in an image pyramid, with oriented BRIEF descriptors.

Extraction follows Rublee et al. (ICCV 2011). The even distribution of corners follows ORB-SLAM
(Mur-Artal et al., T-RO 2015, section V-A).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.config import OrbConfig
from vslam.frontend.corners import fast_scores, local_maxima, spread
from vslam.support.kernels import borrowed, inner_kernel, kernel
from vslam.types.context import scale_factors
from vslam.types.features import Pyramid, level_of

# Side of the square cells in which the FAST threshold adapts, in pixels. [OS1 V-A, customary]
_CELL_SIZE = 35

# Radius of the disc for the intensity centroid, pixels (Rublee et al., section 3.2).
PATCH_RADIUS = 15
LANES = 32  # pixels read per row of the disc: its 31 columns, and one more with weight 0
SPARE = 64  # bytes of padding at the end of a pyramid
KEYPOINT_REACH = 2.0  # pixels of a level; features that are closer together show the same corner
BLUR_REACH = 3  # radius of the Gaussian before BRIEF, pixels
MARGIN = 19  # largest distance of a rotated test point from its keypoint (13 sqrt 2), rounded up
EVERYWHERE = np.empty(0, np.uint8)  # ``allowed`` of the kernels if corners may lie anywhere
PATTERN: NDArray[np.int8] = np.load(Path(__file__).with_name("orb_pattern.npy"))


@dataclass(frozen=True)
class Extraction:
    """Features of one image, sorted by octave. ``Features`` (vslam/types/features.py) describes the
    fields.

    At every pyramid level, coordinate 0 is the centre of the first pixel. If the image is ``w``
    times wider than a level, column x of the level corresponds to column ``(x + 0.5) w - 0.5`` of
    the image.
    """

    xy: NDArray[np.float32]
    octave: NDArray[np.uint8]
    angle: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    pyramid: Pyramid

    def joined(self, other: Extraction) -> tuple[Extraction, NDArray[np.int64]]:
        """Join these features with other features that were extracted from the same image.

        Returns:
            The joined features, sorted by octave, and the ``(N,)`` order that sorted them. To sort
            another array in the same way, concatenate its values for these features and for
            ``other``, and index the result with this order.
        """
        octave = np.concatenate([self.octave, other.octave])
        order = np.argsort(octave, kind="stable")
        both = Extraction(
            np.concatenate([self.xy, other.xy])[order],
            octave[order],
            np.concatenate([self.angle, other.angle])[order],
            np.concatenate([self.descriptors, other.descriptors])[order],
            self.pyramid,
        )
        return both, order


def extract(
    image: NDArray[np.uint8],
    config: OrbConfig,
    allowed: Pyramid | None = None,
    pyramid: Pyramid | None = None,
) -> Extraction:
    """Extract up to ``config.n_features`` ORB features from an ``(H, W)`` uint8 image.

    Args:
        allowed: mask pyramid, 1 where a corner may lie and 0 elsewhere; None allows all pixels.
        pyramid: the pyramid of the image, if it has already been built.
    """
    pyramid = pyramid or build_pyramid(image, config)
    xy, octave, angle, descriptors = extract_levels(
        pyramid.pixels,
        pyramid.offsets,
        pyramid.shapes,
        EVERYWHERE if allowed is None else allowed.pixels,
        features_per_level(config),
        config.fast_threshold,
        config.fast_threshold_min,
        _CELL_SIZE,
        DISC,
        PATTERN,
    )
    return Extraction(xy, octave, angle, descriptors, pyramid)


def extract_at(found: Extraction, xy: NDArray[np.float32], octave: NDArray[np.uint8]) -> Extraction:
    """Extract features at N given positions. Positions near the border of the image or near an
    existing feature are skipped.

    Args:
        found: the features that were already extracted from the image.
        xy: ``(N, 2)`` positions in full-resolution pixels. They are rounded to whole pixels of the
            levels.
        octave: ``(N,)`` pyramid levels.
    """
    shapes = found.pyramid.shapes
    parts = [(found.xy[:0], found.octave[:0], found.angle[:0], found.descriptors[:0])]
    for level in np.unique(octave).tolist():
        ratio = shapes[0, ::-1] / shapes[level, ::-1]
        pixel = np.rint((xy[octave == level] + 0.5) / ratio - 0.5)
        inside = (pixel >= MARGIN) & (pixel < shapes[level, ::-1] - MARGIN)
        pixel = pixel[inside.all(axis=1)]
        near = np.abs(found.octave.astype(np.int64) - level) <= 1
        existing = (found.xy[near] + 0.5) / ratio - 0.5
        corners = pixel[_is_free(pixel, existing)].astype(np.float32)
        if not len(corners):
            continue
        image = found.pyramid.level(level)
        angles = orientations(image, corners, DISC)
        position = ((corners + 0.5) * ratio - 0.5).astype(np.float32)
        descriptors = describe(smoothed(image), corners, angles, PATTERN)
        parts.append((position, np.full(len(corners), level, np.uint8), angles, descriptors))
    xy, octave, angle, descriptors = map(np.concatenate, zip(*parts, strict=True))
    return Extraction(xy, octave, angle, descriptors, found.pyramid)


@kernel
def _is_free(pixel, existing):
    """Return ``(N,)`` bool, True for ``(N, 2)`` pixels that are far from all ``(M, 2)`` existing
    features."""
    free = np.ones(len(pixel), np.bool_)
    for i in range(len(pixel)):
        x, y = pixel[i, 0], pixel[i, 1]
        for k in range(len(existing)):
            dx, dy = abs(existing[k, 0] - x), abs(existing[k, 1] - y)
            if dx <= KEYPOINT_REACH and dy <= KEYPOINT_REACH:
                free[i] = False
                break
    return free


@cache
def features_per_level(config: OrbConfig) -> NDArray[np.int64]:
    """Return the ``(L,)`` maximum number of features of each pyramid level. ``n_features`` is
    divided among the levels in proportion to 1 / scale (section V-A of the ORB-SLAM paper)."""
    weights = 1.0 / scale_factors(config)
    share = config.n_features * weights / weights.sum()
    quota = np.floor(share).astype(np.int64)
    # The features that are lost by rounding down go to the levels that lost the largest fractions.
    missing = config.n_features - quota.sum()
    quota[np.argsort(quota - share, kind="stable")[:missing]] += 1
    return quota


@cache
def _layout(
    height: int, width: int, config: OrbConfig
) -> tuple[int, NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the number of bytes of a pyramid, and the offsets, shapes and scales of its levels."""
    scales = scale_factors(config)
    shapes = np.round(np.array([height, width]) / scales[:, None]).astype(np.int64).clip(min=1)
    sizes = shapes.prod(axis=1)
    offsets = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64)
    return int(sizes.sum()), offsets, shapes, scales


def level_shapes(size: tuple[int, int], config: OrbConfig) -> NDArray[np.int64]:
    """Return the ``(L, 2)`` heights and widths of the pyramid levels of an image with the given
    height and width."""
    return _layout(*size, config)[2]


def build_pyramid(image: NDArray[np.uint8], config: OrbConfig) -> Pyramid:
    """Build the pyramid of an ``(H, W)`` uint8 image. Each level is resized bilinearly from the
    previous level."""
    size, offsets, shapes, scales = _layout(*image.shape, config)
    pixels = np.empty(size + SPARE, np.uint8)
    pixels[-SPARE:] = 0
    pyramid = Pyramid(pixels, offsets, shapes, scales)
    previous = pyramid.level(0)
    previous[:] = image
    for level in range(1, config.n_levels):
        target = pyramid.level(level)
        cv2.resize(previous, target.shape[::-1], dst=target, interpolation=cv2.INTER_LINEAR)
        previous = target
    return pyramid


@kernel
def extract_levels(
    pixels, offsets, shapes, allowed, quota, threshold, threshold_min, cell, inside, pattern
):
    """Extract the ORB features of all pyramid levels of an image.

    A single kernel processes all levels, so that the global interpreter lock is acquired only once
    per image.

    Args:
        pixels, offsets, shapes: fields of the ``Pyramid`` of the image.
        allowed: pixels of a mask pyramid of the same shapes, 1 where a corner may lie and 0
            elsewhere; an empty array allows all pixels.
        quota: ``(L,)`` int64 maximum number of features of each level.
        threshold, threshold_min, cell: see ``local_maxima``.
        inside: ``DISC``, the mask of the disc for the orientation.
        pattern: ``PATTERN``, ``(256, 4)`` int8 coordinates xa, ya, xb, yb of the two points of each
            BRIEF test.

    Returns:
        ``xy``, ``octave``, ``angle`` and ``descriptors``, see ``vslam.types.features.Features``.
    """
    capacity = quota.sum()
    xy, octave = np.empty((capacity, 2), np.float32), np.empty(capacity, np.uint8)
    angle, descriptors = np.empty(capacity, np.float32), np.empty((capacity, 32), np.uint8)
    n = 0
    for level in range(len(shapes)):
        height, width = shapes[level]
        first = offsets[level]
        image = level_of(pixels, offsets, shapes, level)
        here = allowed[first : first + height * width]
        corners = detect_corners(image, here, quota[level], threshold, threshold_min, cell)
        if len(corners) == 0:
            continue
        level_angles = orientations(image, corners, inside)
        level_descriptors = describe(smoothed(image), corners, level_angles, pattern)
        # Level sizes are rounded to whole pixels, so their ratios differ slightly from the scales.
        ratio_x, ratio_y = shapes[0, 1] / width, shapes[0, 0] / height
        for i in range(len(corners)):
            x, y = corners[i, 0] + 0.5, corners[i, 1] + 0.5
            xy[n, 0], xy[n, 1] = x * ratio_x - 0.5, y * ratio_y - 0.5
            octave[n], angle[n] = level, level_angles[i]
            for k in range(32):
                descriptors[n, k] = level_descriptors[i, k]
            n += 1
    return xy[:n], octave[:n], angle[:n], descriptors[:n]


@kernel
def detect_corners(pixels, allowed, quota, threshold, threshold_min, cell):
    """Detect up to ``quota`` FAST-9 corners in one pyramid level. The corners are evenly spread
    over the ``allowed`` pixels.

    Returns:
        ``(n, 2)`` float32 positions x, y, in pixels of the level.
    """
    height, width = pixels.shape
    if min(height, width) <= 2 * MARGIN or quota == 0:
        return np.empty((0, 2), np.float32)
    scores = fast_scores(pixels.reshape(height * width), height, width)
    if len(allowed):
        flat = scores.reshape(height * width)
        for i in range(len(flat)):
            flat[i] *= allowed[i]
    x, y, score = local_maxima(scores, MARGIN, threshold, threshold_min, cell)
    keep = spread(x, y, score, width, height, quota)
    corners = np.empty((len(keep), 2), np.float32)
    for i in range(len(keep)):
        corners[i, 0], corners[i, 1] = x[keep[i]], y[keep[i]]
    return corners


def disc(radius: int) -> NDArray[np.int16]:
    """Create a ``(2 radius + 1, LANES)`` mask that is 1 inside a disc. The centre of the disc is in
    column ``radius``."""
    x = np.arange(LANES) - radius
    y = np.arange(-radius, radius + 1)[:, None]
    return (abs(x) <= np.floor(np.sqrt(radius**2 - y**2 + 0.5))).astype(np.int16)


DISC = disc(PATCH_RADIUS)


@kernel
def orientations(pixels, corners, inside):
    """Compute the ``(n,)`` float32 orientation of each corner, in radians: the direction from the
    corner to the intensity centroid of the disc around it (Rublee et al., section 3.2)."""
    n = len(corners)
    angles = np.empty(n, np.float32)
    height, width = pixels.shape
    rows = len(inside)
    radius = rows // 2
    flat, weight = pixels.reshape(height * width), inside.reshape(rows * LANES)
    # Sum and first moment of each column. Both are at most 255 (1 + 2 + ... + 15), so 16 bits are
    # enough, and a vector register holds many columns.
    total, moment = np.empty(LANES, np.int16), np.empty(LANES, np.int16)
    for i in range(n):
        corner = (int(corners[i, 1]) - radius) * width + int(corners[i, 0]) - radius
        for k in range(np.uintp(LANES)):
            total[k] = 0
            moment[k] = 0
        for row in range(rows):
            from_pixel, from_weight = np.uintp(corner + row * width), np.uintp(row * LANES)
            y = np.int16(row - radius)
            for k in range(np.uintp(LANES)):
                value = np.int16(flat[from_pixel + k] * weight[from_weight + k])
                total[k] = np.int16(total[k] + value)
                moment[k] = np.int16(moment[k] + value * y)
        moment_x, moment_y = 0, 0
        for k in range(LANES):
            moment_x += (k - radius) * total[k]
            moment_y += moment[k]
        angles[i] = np.arctan2(np.float64(moment_y), np.float64(moment_x))
    return angles


@kernel
def describe(smooth, corners, angles, pattern):
    """Compute the ``(n, 32)`` uint8 rotated BRIEF descriptor of each corner (Rublee et al., section
    4). Bit 0 of byte 0 is the result of the first test."""
    n = len(corners)
    height, width = smooth.shape
    flat = smooth.reshape(height * width)
    descriptors = np.empty((n, 32), np.uint8)
    tests = len(pattern)
    coordinates = pattern.astype(np.float32)
    xa, ya = coordinates[:, 0].copy(), coordinates[:, 1].copy()
    xb, yb = coordinates[:, 2].copy(), coordinates[:, 3].copy()
    first, second = np.empty(tests, np.int32), np.empty(tests, np.int32)
    for i in range(n):
        cos = np.float32(np.cos(np.float64(angles[i])))
        sin = np.float32(np.sin(np.float64(angles[i])))
        centre = int(corners[i, 1]) * width + int(corners[i, 0])
        stride = np.float32(width)
        for t in range(np.uintp(tests)):
            row = np.rint(sin * xa[t] + cos * ya[t])
            first[t] = np.int32(row * stride + np.rint(cos * xa[t] - sin * ya[t]))
            row = np.rint(sin * xb[t] + cos * yb[t])
            second[t] = np.int32(row * stride + np.rint(cos * xb[t] - sin * yb[t]))
        for byte in range(32):
            bits = 0
            for t in range(8):
                k = 8 * byte + t
                if flat[centre + first[k]] < flat[centre + second[k]]:
                    bits |= 1 << t
            descriptors[i, byte] = bits
    return descriptors


@kernel
def smoothed(pixels):
    """Blur an ``(H, W)`` uint8 image of at least 4x4 pixels, for BRIEF. The result is identical to
    that of ``cv2.GaussianBlur`` with a 7x7 kernel and a sigma of 2.

    OpenCV uses weights in multiples of 1/256, and rounds once at the end. Here, row sums are split
    into whole grey levels and 256ths. Every intermediate sum then fits into 16 bits, so a vector
    register holds twice as many pixels as with 32 bits.
    """
    height, width = pixels.shape
    taps = 2 * BLUR_REACH + 1
    out = np.empty((height, width), np.uint8)
    row = np.empty(width + 2 * BLUR_REACH, np.uint16)
    rows = np.empty((taps, 2 * width), np.uint16)  # newest row sums: grey levels, then 256ths
    total = np.empty(2 * width, np.uint16)
    n = np.uintp(width)
    for y in range(-BLUR_REACH, height + BLUR_REACH):
        source = pixels[abs(y) if y < height else 2 * (height - 1) - y]
        for x in range(n):
            row[x + BLUR_REACH] = source[x]
        for x in range(BLUR_REACH):
            row[x] = source[BLUR_REACH - x]
            row[width + BLUR_REACH + x] = source[width - 2 - x]
        r = borrowed(row)
        weigh(r, r[1:], r[2:], r[3:], r[4:], r[5:], r[6:], borrowed(total)[:width])
        split = rows[y % taps]
        for x in range(n):
            split[x] = total[x] >> 8
            split[n + x] = total[x] & 255
        if y < BLUR_REACH:
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
        line = out[y - BLUR_REACH]
        for x in range(n):
            line[x] = np.uint16(total[x] + (total[n + x] >> 8) + 128) >> 8
    return out


@inner_kernel
def weigh(a, b, c, d, e, f, g, out):
    """Write the weighted sum of seven rows into ``out``. The weights are samples of a Gaussian with
    a sigma of 2, in 256ths. They are rounded to a sum of 256, as in OpenCV."""
    for x in range(np.uintp(len(out))):
        out[x] = 18 * (a[x] + g[x]) + 34 * (b[x] + f[x]) + 48 * (c[x] + e[x]) + 56 * d[x]
