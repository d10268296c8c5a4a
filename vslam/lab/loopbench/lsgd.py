"""Grey-level histograms of superpixels on a grid (LSGD), compared cell by cell, without training.

This is the descriptor of LSGDDN-LCD (Zhang, Dong, Qi, Li and Ma, arXiv:2304.03872). We have the
paper without its equations; sizes, distances and the similarity are those of the authors' program
(github.com/BaoshengZhang0/LSGDDN-LCD, commit d3c1b34), described here in our own words:

- *Grid.* Cells of about 100 pixels. Each has a centre in the middle, which moves to the one of its
  eight neighbours with the smallest grey difference relative to its distance.
- *Superpixels* (SLIC, Achanta et al., TPAMI 2012, on grey images). Each pixel is assigned to the
  centre, at most one cell away in each direction, with the smallest combined distance in grey level
  and position; centres move to the mean of their pixels. This is done ten times. A pixel changes
  its centre only for one that is nearer than its own was when it was assigned.
- *Descriptor.* The grey-level histogram (256 bins) of each superpixel.
- *Similarity.* 1 / (1 + d), where d is the mean over the superpixels of the square root of the sum
  of absolute differences of the counts, over 256.

Differences: centres settle by grey level instead of colour, and a centre that has lost all its
pixels stays. All images are compared, as in the authors' program; the paper's dynamic nodes, which
save comparisons, are left out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.errors import InputError
from vslam.kernels import kernel
from vslam.lab.loopbench.conditions import Image
from vslam.lab.loopbench.detectors import DescribedImage

Histograms = NDArray[np.int32]

_CELL = 100  # pixels
_ROUNDS = 10
_GREY, _PLACE = 2.3, 1.0  # divisors of squared distances, grey levels and pixels
_LEVELS = 256


class LsgdScorer:
    """See :class:`vslam.lab.loopbench.detectors.Scorer`."""

    name = "lsgd"
    probability = False

    def store(self, gallery: list[DescribedImage]) -> Histograms:
        """Descriptors ``(G, S, 256)``.

        Raises:
            InputError: images of different sizes.
        """
        if len({one.image.shape for one in gallery}) > 1:
            raise InputError("lsgd: compares images of one size; leave it out of --detectors.")
        return np.stack([lsgd(one.image) for one in gallery])

    def scores(self, queries: list[DescribedImage], stored: Histograms) -> NDArray[np.float64]:
        """See :func:`similarities`."""
        return similarities(self.store(queries), stored)


def lsgd(image: Image) -> Histograms:
    """Descriptor ``(S, 256)`` of a grey image ``(H, W)``, superpixels row by row."""
    return histograms(image, superpixels(image, _ROUNDS), int(np.prod(grid(image))))


def grid(image: Image) -> tuple[int, int]:
    """Rows and columns of superpixels."""
    height, width = image.shape
    return height // _CELL + 1, width // _CELL + 1


def centres(image: Image) -> NDArray[np.int64]:
    """``(S, 2)`` row and column where the superpixels begin."""
    found = np.empty((int(np.prod(grid(image))), 2), np.int64)
    _settle(image, *grid(image), found)
    return found


def superpixels(image: Image, rounds: int) -> NDArray[np.int64]:
    """``(H, W)`` index of the superpixel of each pixel."""
    return _superpixels(image, centres(image), *grid(image), rounds)


def histograms(image: Image, superpixel: NDArray[np.int64], n: int) -> Histograms:
    """``(n, 256)`` histogram of the grey levels of each superpixel."""
    counts = np.bincount((superpixel * _LEVELS + image).ravel(), minlength=n * _LEVELS)
    return counts.reshape(n, _LEVELS).astype(np.int32)


def similarities(queries: Histograms, gallery: Histograms) -> NDArray[np.float64]:
    """``(Q, G)`` in (0, 1], 1 for the same image.

    Raises:
        InputError: images of different sizes.
    """
    if queries.shape[1:] != gallery.shape[1:]:
        raise InputError("lsgd: compares images of one size; leave it out of --detectors.")
    return 1.0 / (1.0 + _differences(queries, gallery) / _LEVELS)


@kernel
def _settle(image, rows, columns, found):
    height, width = image.shape
    for r in range(rows):
        for c in range(columns):
            y, x = int((r + 0.5) * height / rows), int((c + 0.5) * width / columns)
            found[r * columns + c, 0], found[r * columns + c, 1] = y, x
            least = np.inf
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    inside = 0 <= y + dy < height and 0 <= x + dx < width
                    if not inside or (dy == 0 and dx == 0):
                        continue
                    far = np.sqrt(float(dy * dy + dx * dx))
                    differs = abs(np.int64(image[y + dy, x + dx]) - np.int64(image[y, x])) / far
                    if differs < least:
                        least = differs
                        found[r * columns + c, 0], found[r * columns + c, 1] = y + dy, x + dx


@kernel
def _superpixels(image, centre, rows, columns, rounds):
    height, width = image.shape
    reach_y, reach_x = height // rows, width // columns
    label = np.full((height, width), -1, np.int64)
    nearest = np.full((height, width), np.inf, np.float32)
    n = len(centre)
    position = centre.copy()
    for _ in range(rounds):
        for k in range(n):
            y, x = position[k]
            grey = np.int64(image[y, x])
            for i in range(max(0, y - reach_y), min(height, y + reach_y + 1)):
                for j in range(max(0, x - reach_x), min(width, x + reach_x + 1)):
                    shade = np.int64(image[i, j]) - grey
                    place = (i - y) * (i - y) + (j - x) * (j - x)
                    far = np.float32(shade * shade / _GREY + place / _PLACE)
                    if far < nearest[i, j]:
                        nearest[i, j], label[i, j] = far, k
        total = np.zeros((n, 3), np.int64)
        for i in range(height):
            for j in range(width):
                k = label[i, j]
                total[k, 0] += i
                total[k, 1] += j
                total[k, 2] += 1
        for k in range(n):
            if total[k, 2] > 0:
                position[k] = total[k, 0] // total[k, 2], total[k, 1] // total[k, 2]
    return label


@kernel
def _differences(queries, gallery):
    """``(Q, G)`` distances: see *Similarity* in the module's docstring."""
    superpixels, levels = gallery.shape[1:]
    found = np.zeros((len(queries), len(gallery)))
    for q in range(len(queries)):
        for g in range(len(gallery)):
            for s in range(superpixels):
                total = 0
                for level in range(levels):
                    total += abs(queries[q, s, level] - gallery[g, s, level])
                found[q, g] += np.sqrt(float(total))
    return found / superpixels
