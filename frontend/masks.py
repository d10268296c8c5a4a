"""Image masks. They exclude pixels that are not to be used, such as the hood of the car."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.config import OrbConfig
from vslam.frontend.orb import build_pyramid
from vslam.types.camera import Image
from vslam.types.features import Pyramid

# Least distance between a feature and a masked pixel, in pixels of the feature's level. Corner
# detection and alignment read no pixels that are farther from the feature, so the edge of the mask
# does not affect them. (Alignment shifts a patch by at most two pixels.)
REACH = 4
_WINDOW = np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8)


@dataclass(frozen=True)
class Mask:
    """The mask of one image.

    Attributes:
        used: ``(H, W)`` bool, False for pixels that are not to be used.
        levels: mask pyramid, 1 for pixels where a feature may lie and 0 elsewhere.
    """

    used: NDArray[np.bool_]
    levels: Pyramid

    @classmethod
    def of(cls, mask: NDArray[np.uint8] | NDArray[np.bool_], config: OrbConfig) -> Self:
        """Create a mask from an ``(H, W)`` array that is 0 for pixels that are not to be used."""
        used = mask > 0
        levels = build_pyramid(used * np.uint8(255), config)
        for index in range(config.n_levels):
            level = levels.level(index)  # below 255 where a masked pixel contributes
            level[:] = cv2.erode(level, _WINDOW) == 255
        return cls(used, levels)

    def shows(self, xy: NDArray[np.floating], octave: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Return ``(N,)`` bool, True for features that the mask allows.

        Positions outside the image are clamped to its border.

        Args:
            xy: ``(N, 2)`` positions in full-resolution pixels.
            octave: ``(N,)`` pyramid levels.
        """
        shapes = self.levels.shapes[octave]
        ratio = self.levels.shapes[0, ::-1] / shapes[:, ::-1]
        pixel = np.rint((np.nan_to_num(xy) + 0.5) / ratio - 0.5)
        column, row = pixel.clip(0, shapes[:, ::-1] - 1).astype(np.int64).T
        at = self.levels.offsets[octave] + row * shapes[:, 1] + column
        return self.levels.pixels[at] > 0

    def filled(self, image: Image) -> Image:
        """Copy an ``(H, W)`` uint8 image, and give all masked pixels the mean grey value of the
        other pixels. The copy is for networks that read the whole image."""
        mean = np.uint8(image[self.used].mean()) if self.used.any() else np.uint8(0)
        return np.where(self.used, image, mean)
