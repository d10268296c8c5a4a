"""Resizes images to the input size of a network."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Fit = Literal["squash", "crop"]
Size = tuple[int, int]
"""Height and width, pixels."""


def to_size(image: NDArray[np.uint8], size: Size, fit: Fit = "squash") -> NDArray[np.uint8]:
    """Resize an ``(H, W)`` uint8 image to the height and width ``size``.

    ``squash`` keeps the whole view but changes the aspect ratio. ``crop`` cuts out the largest
    central rectangle with the aspect ratio of ``size``.
    """
    import cv2

    if fit == "crop":
        scale = min(image.shape[0] / size[0], image.shape[1] / size[1])
        height, width = round(scale * size[0]), round(scale * size[1])
        y, x = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
        image = image[y : y + height, x : x + width]
    if image.shape == size:
        return image
    shrinking = image.shape[0] > size[0] or image.shape[1] > size[1]
    interpolation = cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size[::-1], interpolation=interpolation), np.uint8)
