"""Stereo matching of ORB features in a rectified pair (section III-A of the ORB-SLAM2 paper)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.frontend.orb import Extraction
from vslam.support.kernels import hamming, inline, inner_kernel, kernel
from vslam.types.camera import Camera
from vslam.types.features import MIN_DISPARITY, level_of, level_pixel

# Upper bound of the descriptor distance of a match, in bits. [OS2 III-A, customary]
_MAX_DESCRIPTOR_DISTANCE = 75
# Half width of the patch that is compared using the sum of absolute differences (SAD), in pixels
# of the keypoint's octave. [OS2 III-A, customary]
_SAD_WINDOW = 5
# The patch is searched for up to this distance to the left and to the right, in pixels of the
# keypoint's octave. [OS2 III-A, customary]
_SAD_SEARCH = 5

LANES = 16  # shifts of the SAD window that are evaluated at once
# Half width of the patch for sub-pixel refinement, pixels. A larger patch would more often include
# a nearer object.
REFINE_HALF = 4
MEDIAN_FACTOR = 1.5 * 1.4826  # 1.5 standard deviations, as estimated from the median


class StereoMatches(NamedTuple):
    """Stereo matches of N left features, including outliers.

    Attributes:
        right: the features of the right image.
        u_right: ``(N,)`` float32 column in the right image, pixels; NaN for features without a
            match.
        sad: ``(N,)`` float32 sum of absolute differences (SAD) of each match, -1 for features
            without a match.
    """

    right: Extraction
    u_right: NDArray[np.float32]
    sad: NDArray[np.float32]

    def joined(self, other: StereoMatches, order: NDArray[np.int64]) -> StereoMatches:
        """Concatenate these matches and the other matches, and sort the result. Entry i of
        ``order`` is the index, before sorting, of the match that becomes match i."""
        u_right = np.concatenate([self.u_right, other.u_right])[order]
        return StereoMatches(self.right, u_right, np.concatenate([self.sad, other.sad])[order])


def match_stereo(left: Extraction, right: Extraction, camera: Camera) -> StereoMatches:
    """Match each left feature with a right feature, independently of the other left features.

    A right feature is a candidate if it meets three conditions. It lies in the same row as the left
    feature, within 2 px at the scale of the right feature. The octaves of the two features differ
    by at most one. The disparity is between 0 and the disparity of a point at a distance of one
    baseline.

    The candidate with the closest descriptor is chosen. Then a window around the right feature is
    shifted along the row, at the pyramid level of the left feature. The shift with the least sum of
    absolute differences (SAD) gives the match with sub-pixel accuracy.
    """
    u_right, sad = _match(
        _Side.of_extraction(left),
        _Side.of_extraction(right),
        left.pyramid.offsets,
        left.pyramid.shapes,
        left.pyramid.scales,
        camera.fx,
        _MAX_DESCRIPTOR_DISTANCE,
        _SAD_WINDOW,
        _SAD_SEARCH,
    )
    return StereoMatches(right, u_right, sad)


class _Side(NamedTuple):
    """One image of a stereo pair, as an argument of kernels: N features, and the pixels of its
    pyramid.

    Attributes:
        xy, octave, descriptor: ``(N, 2)``, ``(N,)`` and ``(N, 4)``.
    """

    xy: NDArray[np.float32]
    octave: NDArray[np.uint8]
    descriptor: NDArray[np.uint64]
    pixels: NDArray[np.uint8]

    @classmethod
    def of_extraction(cls, found: Extraction) -> _Side:
        descriptor = found.descriptors.view(np.uint64)
        return cls(found.xy, found.octave, descriptor, found.pyramid.pixels)


@kernel
def rows_to_features(xy, octave, scales, height):
    """Index the features of the right image by the image rows in which they may match.

    Returns:
        ``start``, ``(height + 1,)`` int64, and ``items``, int32. The features of row r are
        ``items[start[r]:start[r + 1]]``.
    """
    start = np.zeros(height + 1, np.int64)
    n = len(xy)
    for fill in range(2):
        if fill == 1:
            for row in range(height):
                start[row + 1] += start[row]
            items = np.empty(start[height], np.int32)
            cursor = start[:height].copy()
        for i in range(n):
            band = 2.0 * scales[octave[i]]
            first = max(0, int(np.floor(xy[i, 1] - band)))
            last = min(height - 1, int(np.ceil(xy[i, 1] + band)))
            for row in range(first, last + 1):
                if fill == 0:
                    start[row + 1] += 1
                else:
                    items[cursor[row]] = i
                    cursor[row] += 1
    return start, items


@kernel
def _match(left, right, offsets, shapes, scales, max_disparity, max_distance, half, reach):
    """Return the ``(N,)`` float32 column of each match in the right image, and its ``(N,)`` float32
    sum of absolute differences (SAD). For features without a match, the column is NaN and the SAD
    is -1."""
    xy_l, octave_l, descriptors_l, pixels_l = left
    xy_r, octave_r, descriptors_r, pixels_r = right
    n = len(xy_l)
    u_right = np.full(n, np.nan, np.float32)
    sad = np.full(n, -1.0, np.float32)
    start, items = rows_to_features(xy_r, octave_r, scales, shapes[0, 0])
    candidates = np.empty(len(xy_r), np.int32)
    for i in range(n):
        u, v = xy_l[i, 0], xy_l[i, 1]
        row = int(v)
        # Candidates are listed without a branch. A branch that tests whether each feature of the
        # row is a candidate would often be mispredicted.
        n_candidates = 0
        for k in range(start[row], start[row + 1]):
            j = items[k]
            disparity = u - xy_r[j, 0]
            candidates[n_candidates] = j
            n_candidates += (
                (disparity >= -1.0)
                & (disparity <= max_disparity)
                & (abs(int(octave_r[j]) - int(octave_l[i])) <= 1)
            )
        best, best_distance = -1, max_distance
        for j in candidates[:n_candidates]:
            distance = hamming(descriptors_l[i], descriptors_r[j])
            if distance < best_distance:
                best, best_distance = j, distance
        if best < 0:
            continue
        level = octave_l[i]
        height, width = shapes[level]
        image_l = level_of(pixels_l, offsets, shapes, level)
        image_r = level_of(pixels_r, offsets, shapes, level)
        ratio_x, ratio_y = shapes[0, 1] / width, shapes[0, 0] / height
        x_l, y_l = level_pixel(u, ratio_x), level_pixel(v, ratio_y)
        x_r = level_pixel(xy_r[best, 0], ratio_x)
        shift, score = slide(image_l, image_r, x_l, y_l, x_r, half, reach)
        if np.isnan(shift):
            continue
        # The disparity is applied to the column of the left feature itself, not to the rounded
        # ``x_l``.
        disparity = (x_l - x_r - shift) * ratio_x
        if disparity < max_disparity and disparity > -1.0:
            u_right[i] = u - max(disparity, MIN_DISPARITY)
            sad[i] = score
    return u_right, sad


def inliers_only(matches: StereoMatches, octave: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the columns of the matches in the right image, with NaN for outliers. A match is an
    outlier if its sum of absolute differences (SAD) exceeds ``MEDIAN_FACTOR`` times the median SAD
    of its octave.

    Args:
        octave: ``(N,)`` uint8 octave of each feature, sorted.
    """
    return _inliers_only(matches.u_right, matches.sad, octave)


@kernel
def _inliers_only(matched, sad, octave):
    u_right = matched.copy()
    first = 0
    while first < len(octave):
        last = first
        while last < len(octave) and octave[last] == octave[first]:
            last += 1
        costs = sad[first:last]
        costs = np.sort(costs[costs >= 0])
        n = len(costs)
        if n > 0:
            median = np.float32(0.5) * (costs[n // 2] + costs[(n - 1) // 2])
            limit = np.float32(MEDIAN_FACTOR) * median
            for i in range(first, last):
                if sad[i] > limit:
                    u_right[i] = np.nan
        first = last
    return u_right


@kernel
def slide(image_l, image_r, x_l, y_l, x_r, half, reach):
    """Slide a patch of the right image along its row, and find the shift at which it agrees best
    with a patch of the left image.

    Returns:
        The shift relative to the column ``x_r``, in pixels of the pyramid level, and the sum of
        absolute differences (SAD) at this shift. The shift is NaN if a patch would leave the image,
        or if the least SAD is at an end of the search range.
    """
    height, width = image_l.shape
    if (
        y_l < half
        or y_l + half >= height
        or x_l < half
        or x_l + half >= width
        or x_r - reach < half
        or x_r + reach + half >= width
    ):
        return np.nan, np.float32(-1.0)
    costs = np.zeros(-(-(2 * reach + 1) // LANES) * LANES, np.int32)
    add_differences(image_l, image_r, x_l, y_l, x_r, half, reach, costs)
    best = int(np.argmin(costs[: 2 * reach + 1]))
    if best == 0 or best == 2 * reach:
        return np.nan, np.float32(-1.0)
    before, here, after = costs[best - 1], costs[best], costs[best + 1]
    curvature = before + after - 2 * here
    if curvature <= 0:
        return np.nan, np.float32(-1.0)
    start = 0.5 * (before - after) / curvature
    refined = refine_shift(image_l, image_r, x_l, y_l, x_r + best - reach, start, REFINE_HALF)
    return best - reach + refined, np.float32(here)


@inner_kernel
def add_differences(image_l, image_r, x_l, y_l, x_r, half, reach, costs):
    """Add the sum of absolute differences of two patches at each shift to ``costs``.

    A vector register holds ``LANES`` shifts. Four columns of the patch are summed before the
    register is stored. Lanes beyond the last shift may read from the next row, and the caller
    ignores them.
    """
    width = image_l.shape[1]
    flat_l, flat_r = image_l.reshape(image_l.size), image_r.reshape(image_r.size)
    side = 2 * half + 1
    one, two, three = np.uintp(1), np.uintp(2), np.uintp(3)
    total = np.empty(LANES, np.uint16)  # sums over one row of the patch
    for first in range(0, len(costs), LANES):
        for dy in range(-half, half + 1):
            row = (y_l + dy) * width
            a = flat_l[row + x_l - half :]
            b = flat_r[row + x_r - reach - half + first :]
            for s in range(np.uintp(LANES)):
                total[s] = 0
            k = 0
            while k + 4 <= side:
                a0, a1, a2, a3 = a[k], a[k + 1], a[k + 2], a[k + 3]
                j = np.uintp(k)
                for s in range(np.uintp(LANES)):
                    total[s] = np.uint16(
                        total[s]
                        + difference(a0, b[j + s])
                        + difference(a1, b[j + s + one])
                        + difference(a2, b[j + s + two])
                        + difference(a3, b[j + s + three])
                    )
                k += 4
            while k < side:
                a0, j = a[k], np.uintp(k)
                for s in range(np.uintp(LANES)):
                    total[s] = np.uint16(total[s] + difference(a0, b[j + s]))
                k += 1
            for s in range(LANES):
                costs[first + s] += total[s]


@inline
def difference(a, b):
    """Return the absolute difference of two bytes. It is computed in bytes, so that a vector
    register holds many differences."""
    return np.uint16(np.uint8(max(a, b) - min(a, b)))


@inner_kernel
def refine_shift(image_l, image_r, x_l, y_l, x_r, shift, half):
    """Find the shift, in pixels, that minimises the sum of squared differences between two patches.
    ``shift`` is a first estimate in (-1, 1).

    The minimum of a parabola through three sums of absolute differences is biased towards whole
    pixels. Two Gauss-Newton steps on the interpolated patch remove this bias (Lucas and Kanade,
    IJCAI 1981). If these steps fail, ``shift`` is returned.
    """
    start = shift
    width = image_r.shape[1]
    if x_r - half - 2 < 0 or x_r + half + 3 >= width:
        return shift
    for _ in range(2):
        whole = int(np.floor(shift))
        part = np.float32(shift - whole)
        numerator, denominator = np.float32(0.0), np.float32(0.0)
        for dy in range(-half, half + 1):
            a = image_l[y_l + dy, x_l - half : x_l + half + 1]
            b = image_r[y_l + dy, x_r + whole - half - 1 : x_r + whole + half + 3]
            for k in range(np.uintp(2 * half + 1)):
                b0, b1 = np.float32(b[k]), np.float32(b[k + 1])
                b2, b3 = np.float32(b[k + 2]), np.float32(b[k + 3])
                value = b1 + part * (b2 - b1)
                # Central difference, interpolated with the same weights as the grey value.
                slope = np.float32(0.5) * (b2 - b0 + part * ((b3 - b1) - (b2 - b0)))
                numerator += slope * (np.float32(a[k]) - value)
                denominator += slope * slope
        if denominator < np.float32(1.0):
            return start
        step = numerator / denominator
        shift += step
        if abs(shift) > 1.0:
            return start
        if abs(step) < 0.005:
            break
    return shift
