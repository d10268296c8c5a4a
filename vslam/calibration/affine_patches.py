"""Aligns image patches to those of an earlier image, from which they differ by an affine map.

A corner that is followed from image to image drifts: each step assumes that its surroundings only
shift, and starts where the last step ended. Shi and Tomasi ("Good features to track", CVPR 1994)
therefore compare a corner with its first image, under an affine deformation. The method is inverse
compositional Gauss-Newton (Baker and Matthews, "Lucas-Kanade 20 years on", IJCV 2004, section
3.2). Brightness and contrast are estimated together with the deformation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.models import Array
from vslam.support.kernels import inner_kernel, kernel
from vslam.types.camera import Image

_RADIUS = 10  # of a patch, pixels: the window in which corners are followed from image to image
_SIGMA = 6.0  # standard deviation of the weights around the middle of a patch, pixels
_UNKNOWNS = 8  # shift, affine deformation, contrast and brightness
_ITERATIONS, _STILL = 20, 0.003  # most steps, and length in pixels of the step that is the last
_LARGEST = 0.5  # of the change of the deformation in a step
_LEAST_AREA = 0.1  # of a patch after a step, relative
_LITTLE = 1e-6  # squared grey levels, so that a patch without texture can be computed
# Upper bound, in x and in y, of the distance in pixels between where a corner was followed to and
# where it is aligned. [own]
_MAX_SHIFT = 3.0
# Standard deviation of the grey values of an aligned patch that its first image does not explain,
# relative to that of those which it explains. A correlation of 0.89 corresponds to it. [own]
_MOST_DIFFERENT = 0.5

_at = np.arange(-_RADIUS, _RADIUS + 1)
_OFFSETS: Array = np.stack(np.meshgrid(_at, _at), axis=-1).reshape(-1, 2).astype(np.float64)
_WEIGHTS: Array = np.exp(-np.sum(_OFFSETS**2, axis=1) / (2.0 * _SIGMA**2))
_WEIGHTS /= _WEIGHTS.sum()


@dataclass(frozen=True)
class Patches:
    """The surroundings of N corners in an image.

    Attributes:
        grey: ``(N, P)`` float64 grey values.
        contrast: ``(N,)`` float64 standard deviations of ``grey``.
        solve: ``(N, 8, P)`` float64, by which differences of grey values are multiplied for a step.
    """

    grey: Array
    contrast: Array
    solve: Array

    @classmethod
    def around(cls, image: Image, xy: NDArray[np.floating[Any]]) -> Patches:
        """Cut out the patches around the ``(N, 2)`` pixels of an image."""
        grey, J = _cut(image, xy.astype(np.float64), _OFFSETS)
        weighted = _WEIGHTS[:, None] * J
        H = weighted.swapaxes(1, 2) @ J + _LITTLE * np.eye(_UNKNOWNS)
        deviations = grey - (grey @ _WEIGHTS)[:, None]
        contrast = np.sqrt(deviations**2 @ _WEIGHTS)
        return cls(grey, contrast, np.linalg.inv(H) @ weighted.swapaxes(1, 2))

    def aligned(
        self,
        image: Image,
        rows: NDArray[np.int64],
        xy: NDArray[np.floating[Any]],
        shape: Array,
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Align some of the patches to another image.

        Args:
            rows: ``(M,)`` places of the patches.
            xy: ``(M, 2)`` pixels near which they are.
            shape: ``(M, 2, 2)`` float64, the deformations to start with: by what an offset in the
                first image is multiplied.

        Returns:
            ``(M, 2)`` float64 pixels; ``(M, 2, 2)`` float64 deformations; and ``(M,)`` whether a
            patch was found near its pixel, and looks as in the first image.
        """
        at, deformed, different = _align(
            image, self.grey, self.solve, rows, xy.astype(np.float64), shape, _OFFSETS, _WEIGHTS
        )
        return at, deformed, different < _MOST_DIFFERENT * self.contrast[rows]


@inner_kernel
def _grey(image, x, y):
    """Interpolate an image linearly. Beyond the border, its outermost pixels are repeated."""
    height, width = image.shape
    x = min(max(x, 0.0), width - 1.001)
    y = min(max(y, 0.0), height - 1.001)
    column, row = int(x), int(y)
    a, b = x - column, y - row
    above = (1.0 - a) * image[row, column] + a * image[row, column + 1]
    below = (1.0 - a) * image[row + 1, column] + a * image[row + 1, column + 1]
    return (1.0 - b) * above + b * below


@kernel
def _cut(image, xy, offsets):
    """Return the ``(N, P)`` grey values of patches, and their ``(N, P, 8)`` derivatives by a shift,
    the rows of an affine deformation, contrast and brightness."""
    N, P = len(xy), len(offsets)
    grey, J = np.empty((N, P)), np.empty((N, P, _UNKNOWNS))
    for i in range(N):
        for p in range(P):
            dx, dy = offsets[p]
            x, y = xy[i, 0] + dx, xy[i, 1] + dy
            grey[i, p] = _grey(image, x, y)
            across = 0.5 * (_grey(image, x + 1.0, y) - _grey(image, x - 1.0, y))
            down = 0.5 * (_grey(image, x, y + 1.0) - _grey(image, x, y - 1.0))
            J[i, p, 0], J[i, p, 1] = across, down
            J[i, p, 2], J[i, p, 3] = across * dx, across * dy
            J[i, p, 4], J[i, p, 5] = down * dx, down * dy
            J[i, p, 6], J[i, p, 7] = grey[i, p], 1.0
    return grey, J


@kernel
def _align(image, grey, solve, rows, xy, shape, offsets, weights):
    M, P = len(rows), len(offsets)
    found, deformed, different = xy.copy(), shape.copy(), np.full(M, np.inf)
    r, step = np.empty(P), np.empty(_UNKNOWNS)
    for i in range(M):
        row = rows[i]
        x, y = xy[i]
        (a, b), (c, d) = shape[i]
        failed = False
        for _ in range(_ITERATIONS):
            for p in range(P):
                dx, dy = offsets[p]
                r[p] = _grey(image, x + a * dx + b * dy, y + c * dx + d * dy) - grey[row, p]
            for k in range(_UNKNOWNS):
                total = 0.0
                for p in range(P):
                    total += solve[row, k, p] * r[p]
                step[k] = total
            # The inverse of the step's deformation is applied first.
            for k in range(2, 6):
                step[k] = min(max(step[k], -_LARGEST), _LARGEST)
            e, f, g, h = 1.0 + step[2], step[3], step[4], 1.0 + step[5]
            det = e * h - f * g
            if not det > _LEAST_AREA:
                failed = True
                break
            a, b = (a * h - b * g) / det, (b * e - a * f) / det
            c, d = (c * h - d * g) / det, (d * e - c * f) / det
            move_x, move_y = a * step[0] + b * step[1], c * step[0] + d * step[1]
            x, y = x - move_x, y - move_y
            failed = not (abs(x - xy[i, 0]) < _MAX_SHIFT and abs(y - xy[i, 1]) < _MAX_SHIFT)
            if failed or not move_x * move_x + move_y * move_y > _STILL * _STILL:
                break
        if failed:
            continue
        found[i] = x, y
        deformed[i, 0, 0], deformed[i, 0, 1] = a, b
        deformed[i, 1, 0], deformed[i, 1, 1] = c, d
        squared = 0.0
        for p in range(P):
            # The last residuals, without what contrast and brightness explain.
            left = r[p] - step[6] * grey[row, p] - step[7]
            squared += weights[p] * left * left
        if 1.0 + step[6] > 0.0:  # otherwise a negative
            different[i] = np.sqrt(squared) / (1.0 + step[6])
    return found, deformed, different
