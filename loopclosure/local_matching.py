"""Coarse-to-fine matching of learned local descriptors, as in LoFTR (Sun et al., CVPR 2021).

Each image is divided into cells, and each cell has a descriptor. A coarse match is a pair of cells
in two images whose descriptors are mutual nearest neighbours. Coarse matches predict where each
keypoint of the first image lies in the second image. Fine matching searches around these
predictions, and refines the result to a fraction of a cell. A position is accepted only if the
reverse search, from the second to the first image, returns to the keypoint.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import inner_kernel, kernel

# Two coarse descriptors match only if their cosine is at least this value. [own]
MIN_COARSE_SIMILARITY = 0.3
# Two fine descriptors match only if their cosine is at least this value. [own]
MIN_FINE_SIMILARITY = 0.5
# The fine match is searched for up to this distance to each side of the coarse match, in cells of
# the network's fine feature map. [own]
REACH = 5
# A landmark is searched for up to this distance to each side of its projection, in cells of the
# network's fine feature map. [own]
GUIDED_REACH = 3

COARSE_STRIDE, FINE_STRIDE = 16, 4  # pixels of the network's input per cell
_HOMOGRAPHY_PIXELS = 12.0  # RANSAC threshold, pixels of the network's input
_HOMOGRAPHY_DRAWS = 300  # maximum number of RANSAC samples
# The same for fine matches, which are more accurate and have more outliers.
_FINE_HOMOGRAPHY_PIXELS, _FINE_HOMOGRAPHY_DRAWS = 6.0, 1000


class DescriptorMaps(NamedTuple):
    """Local descriptors of an image on a coarse and a fine grid of cells, normalised to length 1.

    Attributes:
        coarse: ``(h, w, C)`` float32, or float16 from ``coarse_alone``. Cell (i, j) lies at pixel
            (16 j, 16 i) of the network's input.
        fine: ``(H, W, D)`` float32. Cell (i, j) lies at pixel (4 j, 4 i) of the network's input.
        scale: pixels of the network's input per pixel of the camera image.
    """

    coarse: NDArray[np.float32] | NDArray[np.float16]
    fine: NDArray[np.float32]
    scale: float

    def coarse_alone(self) -> DescriptorMaps:
        """Return a copy with only the coarse descriptors, in half precision to save memory."""
        none = np.empty((0, *self.fine.shape[1:]), np.float32)
        return self._replace(coarse=self.coarse.astype(np.float16), fine=none)


class CoarseMatches(NamedTuple):
    """Pairs of coarse cells in two images whose descriptors are mutual nearest neighbours.

    Attributes:
        a, b: ``(N,)`` int64 indices of the cells in each image, row-major.
        similarity: ``(N,)`` float32 cosine similarities.
    """

    a: NDArray[np.int64]
    b: NDArray[np.int64]
    similarity: NDArray[np.float32]


class Located(NamedTuple):
    xy: NDArray[np.float64]

    @property
    def found(self) -> NDArray[np.bool_]:
        """``(N,)`` bool, True for keypoints that were found."""
        return np.asarray(np.isfinite(self.xy[:, 0]))


def match_coarse(a: DescriptorMaps, b: DescriptorMaps, least: float) -> CoarseMatches:
    """Find pairs of coarse cells whose descriptors are mutual nearest neighbours and have a cosine
    similarity of at least ``least``."""
    cells = [one.coarse.reshape(-1, one.coarse.shape[2]).astype(np.float32) for one in (a, b)]
    best_a, best_b, similarity = _nearest(cells[0], np.ascontiguousarray(cells[1].T))
    mutual = (best_b[best_a] == np.arange(len(best_a))) & (similarity >= least)
    chosen = np.flatnonzero(mutual)
    return CoarseMatches(chosen, best_a[chosen], similarity[chosen])


def positions(cells: NDArray[np.int64], maps: DescriptorMaps) -> NDArray[np.float64]:
    """Convert the indices of ``(N,)`` coarse cells to ``(N, 2)`` positions, in pixels of the camera
    image."""
    columns = maps.coarse.shape[1]
    return COARSE_STRIDE * np.stack([cells % columns, cells // columns], 1) / maps.scale


def locate(
    xy: NDArray[np.float32],
    a: DescriptorMaps,
    b: DescriptorMaps,
    coarse: CoarseMatches,
    reach: int,
    least: float,
) -> Located:
    """Search image b for the keypoints of image a, near the positions that coarse matches predict.

    Args:
        xy: ``(N, 2)`` keypoints, in pixels of camera image a.
        coarse: coarse matches from a to b.
        reach: half width of the search window, in fine cells.
        least: lowest accepted cosine similarity.
    """
    rows, columns, _ = a.coarse.shape
    cell_in_b = np.full(rows * columns, -1, np.int64)
    cell_in_b[coarse.a] = coarse.b
    found = _locate(
        xy.astype(np.float64) * (a.scale / FINE_STRIDE), a.fine, b.fine,
        cell_in_b.reshape(rows, columns), b.coarse.shape[1], reach, least,
    )  # fmt: skip
    return Located(found * (FINE_STRIDE / b.scale))


def locate_near(
    xy: NDArray[np.float32],
    expected: NDArray[np.float64],
    a: DescriptorMaps,
    b: DescriptorMaps,
    reach: int,
    least: float,
) -> Located:
    """Search image b for the keypoints of image a, in windows around given positions.

    Args:
        xy: ``(N, 2)`` keypoints, in pixels of camera image a.
        expected: ``(N, 2)`` predicted positions, in pixels of camera image b. A keypoint whose
            predicted position is NaN is skipped.
        reach: half width of the search window, in fine cells.
        least: lowest accepted cosine similarity.
    """
    found = _locate_near(
        xy.astype(np.float64) * (a.scale / FINE_STRIDE),
        expected * (b.scale / FINE_STRIDE),
        a.fine, b.fine, reach, least,
    )  # fmt: skip
    return Located(found * (FINE_STRIDE / b.scale))


def likeness(a: DescriptorMaps, b: DescriptorMaps, least: float) -> float:
    """Compute the similarity of two images from their coarse descriptors. It is 1 for identical
    images.

    The similarity is the sum of the cosine similarities of the coarse matches, divided by the
    number of cells of the smaller image. Matches with a cosine similarity below ``least`` are
    ignored.
    """
    return float(match_coarse(a, b, least).similarity.sum() / _fewest_cells(a, b))


def homography_share(coarse: CoarseMatches, a: DescriptorMaps, b: DescriptorMaps) -> float:
    """Compute the number of coarse matches that fit a single homography, divided by the number of
    cells of the smaller image."""
    return homography_inliers(coarse, a, b) / _fewest_cells(a, b)


def homography_inliers(coarse: CoarseMatches, a: DescriptorMaps, b: DescriptorMaps) -> int:
    """Count the coarse matches that fit a single homography.

    A homography is not an exact model of a street. However, distant points fit it, and near points
    deviate from it by only a cell or two. In images of different places, far fewer matches fit a
    common homography.
    """
    _, inlier = _fit_homography(
        a.scale * positions(coarse.a, a), b.scale * positions(coarse.b, b),
        _HOMOGRAPHY_PIXELS, _HOMOGRAPHY_DRAWS,
    )  # fmt: skip
    return int(inlier.sum())


def fine_agreement(
    xy: NDArray[np.float32], located: Located, a: DescriptorMaps, b: DescriptorMaps
) -> float:
    """Compute the share of the fine matches in the overlap of two images that fit a homography.

    The homography is fitted to the fine matches alone. A fine match lies in the overlap if the
    homography maps its keypoint into image b. Cells of sky or of a repeated facade may match
    coarsely in images of different places, but their keypoints then disagree.

    Args:
        xy: ``(N, 2)`` keypoints, in pixels of camera image a.
        located: where ``locate`` found them in image b.

    Returns:
        The share, from 0 to 1. It is 0 if no homography is found.
    """
    seen_a, seen_b = a.scale * xy[located.found], b.scale * located.xy[located.found]
    H, inlier = _fit_homography(seen_a, seen_b, _FINE_HOMOGRAPHY_PIXELS, _FINE_HOMOGRAPHY_DRAWS)
    if H is None:
        return 0.0
    mapped = np.column_stack([seen_a, np.ones(len(seen_a))]) @ H.T
    mapped = mapped[:, :2] / mapped[:, 2:]
    rows, columns, _ = b.fine.shape
    overlap = ((mapped >= 0) & (mapped < [FINE_STRIDE * columns, FINE_STRIDE * rows])).all(1)
    # Any four matches fit a homography, so four of the inliers prove nothing.
    return max(0.0, float((inlier.sum() - 4) / (overlap | inlier).sum()))


def _fit_homography(
    a: NDArray[Any], b: NDArray[Any], pixels: float, draws: int
) -> tuple[NDArray[Any] | None, NDArray[np.bool_]]:
    import cv2

    none = np.zeros(len(a), np.bool_)
    if len(a) < 4:
        return None, none
    H, inlier = cv2.findHomography(a, b, cv2.RANSAC, pixels, maxIters=draws)
    return H, none if inlier is None else inlier[:, 0].astype(np.bool_)


def _fewest_cells(a: DescriptorMaps, b: DescriptorMaps) -> int:
    return min(one.coarse.shape[0] * one.coarse.shape[1] for one in (a, b))


@kernel
def _nearest(a, b):
    """Find the nearest neighbours of two sets of descriptors by cosine similarity.

    Args:
        a, b: ``(N, C)`` and ``(C, M)`` float32 descriptors of length 1.

    Returns:
        ``(N,)`` int64 index of the nearest b for each a; ``(M,)`` int64 index of the nearest a for
        each b; ``(N,)`` float32 cosine similarity of each a and its nearest b.
    """
    n, channels = a.shape
    m = b.shape[1]
    best_a, best_b = np.zeros(n, np.int64), np.zeros(m, np.int64)
    alike_a, alike_b = np.full(n, -2.0, np.float32), np.full(m, -2.0, np.float32)
    row = np.empty(m, np.float32)
    for i in range(n):
        row[:] = 0.0
        for c in range(channels):
            x = a[i, c]
            for j in range(m):
                row[j] += x * b[c, j]
        for j in range(m):
            if row[j] > alike_a[i]:
                alike_a[i], best_a[i] = row[j], j
            if row[j] > alike_b[j]:
                alike_b[j], best_b[j] = row[j], i
    return best_a, best_b, alike_a


@inner_kernel
def _interpolate(fine, x, y, out):
    """Interpolate the descriptor at the cell coordinates (x, y) bilinearly, normalise it to length
    1, and write it into ``out``. Returns False if the position is outside the image."""
    rows, columns, channels = fine.shape
    if not (x >= 0.0 and y >= 0.0 and x <= columns - 1 and y <= rows - 1):
        return False
    j, i = min(int(x), columns - 2), min(int(y), rows - 2)
    u, v = np.float32(x - j), np.float32(y - i)
    one = np.float32(1.0)
    squared = np.float32(0.0)
    for c in range(channels):
        above = (one - u) * fine[i, j, c] + u * fine[i, j + 1, c]
        below = (one - u) * fine[i + 1, j, c] + u * fine[i + 1, j + 1, c]
        out[c] = (one - v) * above + v * below
        squared += out[c] * out[c]
    if squared <= 0.0:
        return False
    factor = one / np.sqrt(squared)
    for c in range(channels):
        out[c] *= factor
    return True


@inner_kernel
def _cosine(fine, i, j, descriptor):
    # Four partial sums are used. With a single sum, each addition would wait for the previous one.
    s0, s1, s2, s3 = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for c in range(0, len(descriptor), 4):
        s0 += fine[i, j, c] * descriptor[c]
        s1 += fine[i, j, c + 1] * descriptor[c + 1]
        s2 += fine[i, j, c + 2] * descriptor[c + 2]
        s3 += fine[i, j, c + 3] * descriptor[c + 3]
    return (s0 + s1) + (s2 + s3)


@inner_kernel
def _search(fine, descriptor, x, y, reach):
    """Return the column, the row and the cosine similarity of the most similar cell within
    ``reach`` of (x, y). The similarity is -2 if the window is outside the image."""
    rows, columns, _ = fine.shape
    best_i, best_j, best = -1, -1, np.float32(-2.0)
    middle_j, middle_i = int(np.rint(x)), int(np.rint(y))
    for i in range(max(0, middle_i - reach), min(rows, middle_i + reach + 1)):
        for j in range(max(0, middle_j - reach), min(columns, middle_j + reach + 1)):
            similarity = _cosine(fine, i, j, descriptor)
            if similarity > best:
                best_i, best_j, best = i, j, similarity
    return best_j, best_i, best


@inner_kernel
def _peak(fine, descriptor, j, i, best):
    """Refine the position of the best match to a fraction of a cell. In x and in y, a parabola is
    fitted to the similarities of the best cell and its two neighbours."""
    rows, columns, _ = fine.shape
    x, y = float(j), float(i)
    if 0 < j < columns - 1:
        before, after = _cosine(fine, i, j - 1, descriptor), _cosine(fine, i, j + 1, descriptor)
        curvature = 2.0 * best - before - after
        if curvature > 1e-6:
            x += min(0.5, max(-0.5, 0.5 * (after - before) / curvature))
    if 0 < i < rows - 1:
        before, after = _cosine(fine, i - 1, j, descriptor), _cosine(fine, i + 1, j, descriptor)
        curvature = 2.0 * best - before - after
        if curvature > 1e-6:
            y += min(0.5, max(-0.5, 0.5 * (after - before) / curvature))
    return x, y


@inner_kernel
def _accept_if_mutual(fine_a, fine_b, descriptor, x, y, j, i, best, reach, other, found):
    """Write the refined position of the best cell in b into ``found`` if the reverse search
    confirms it.

    The reverse search must end within 1.5 cells of the keypoint at ``(x, y)`` in a. ``other`` is a
    workspace for a descriptor.
    """
    peak_x, peak_y = _peak(fine_b, descriptor, j, i, best)
    if _interpolate(fine_b, peak_x, peak_y, other):
        back_j, back_i, _ = _search(fine_a, other, x, y, reach)
        if abs(back_j - x) <= 1.5 and abs(back_i - y) <= 1.5:
            found[0], found[1] = peak_x, peak_y


@kernel
def _locate(xy, fine_a, fine_b, cell_in_b, columns_b, reach, least):
    """Do the work of ``locate`` in units of fine cells. ``cell_in_b`` is the coarse match of each
    cell of a, or -1 if the cell has no match."""
    n, channels = len(xy), fine_a.shape[2]
    rows_a, columns_a = cell_in_b.shape
    found = np.full((n, 2), np.nan)
    descriptor, other = np.empty(channels, np.float32), np.empty(channels, np.float32)
    ratio = COARSE_STRIDE // FINE_STRIDE  # fine cells per coarse cell
    tried = np.empty((9, 2))
    for k in range(n):
        x, y = xy[k]
        if not _interpolate(fine_a, x, y, descriptor):
            continue
        cell_j, cell_i = int(np.rint(x / ratio)), int(np.rint(y / ratio))
        best_j, best_i, best = -1, -1, np.float32(-2.0)
        n_tried = 0
        for i in range(max(0, cell_i - 1), min(rows_a, cell_i + 2)):
            for j in range(max(0, cell_j - 1), min(columns_a, cell_j + 2)):
                match = cell_in_b[i, j]
                if match < 0:
                    continue
                guess_x = x + ratio * (match % columns_b - j)
                guess_y = y + ratio * (match // columns_b - i)
                repeated = False
                for t in range(n_tried):
                    repeated |= abs(tried[t, 0] - guess_x) < 2 and abs(tried[t, 1] - guess_y) < 2
                if repeated:
                    continue
                tried[n_tried, 0], tried[n_tried, 1] = guess_x, guess_y
                n_tried += 1
                found_j, found_i, similarity = _search(fine_b, descriptor, guess_x, guess_y, reach)
                if similarity > best:
                    best_j, best_i, best = found_j, found_i, similarity
        if best >= least:
            _accept_if_mutual(
                fine_a, fine_b, descriptor, x, y, best_j, best_i, best, reach, other, found[k]
            )
    return found


@kernel
def _locate_near(xy, expected, fine_a, fine_b, reach, least):
    """Do the work of ``locate_near`` in units of fine cells."""
    n, channels = len(xy), fine_a.shape[2]
    found = np.full((n, 2), np.nan)
    descriptor, other = np.empty(channels, np.float32), np.empty(channels, np.float32)
    for k in range(n):
        x, y = xy[k]
        if not (np.isfinite(expected[k, 0]) and _interpolate(fine_a, x, y, descriptor)):
            continue
        j, i, best = _search(fine_b, descriptor, expected[k, 0], expected[k, 1], reach)
        if best >= least:
            _accept_if_mutual(fine_a, fine_b, descriptor, x, y, j, i, best, reach, other, found[k])
    return found
