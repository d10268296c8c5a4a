"""Reads images and resizes them to the input size of a network."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vslam.support.errors import InputError, UnreadableImageError

_FIELD_OF_VIEW = 80.0  # horizontal field of view that turn_homography assumes, degrees

Fit = Literal["squash", "crop"]
Size = tuple[int, int]
"""Height and width, pixels."""


def parse_size(text: str) -> Size:
    """Parse an image size: ``129`` (a square) or ``81x145`` (height and width).

    Raises:
        InputError: the text has a different form, or a side is below 32 pixels.
    """
    height, by, width = text.lower().partition("x")
    if not by:
        width = height
    if not (height.isdecimal() and width.isdecimal()):
        raise InputError(
            f"--pixels {text}: write the side of a square, as in 129, or height and width, as in "
            "81x145."
        )
    if min(int(height), int(width)) < 32:
        raise InputError(f"--pixels {text}: a network needs 32 pixels or more on each side.")
    return int(height), int(width)


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


def read_grey(source: Path | NDArray[np.uint8], name: str = "") -> NDArray[np.uint8]:
    """Read and decode an image as ``(H, W)`` uint8.

    Args:
        source: the image file, or its encoded bytes as ``(B,)`` uint8.
        name: name of the image for error messages, if the image is given as bytes.

    Raises:
        UnreadableImageError: the image is missing, empty or damaged.
    """
    import cv2

    try:
        data = np.fromfile(source, np.uint8) if isinstance(source, Path) else source
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    except (OSError, cv2.error):
        image = None
    if image is None:
        path = source if isinstance(source, Path) else Path(name)
        raise UnreadableImageError(path, "cannot be decoded; get the file again or remove it.")
    return np.asarray(image, np.uint8)


def turn_homography(width: int, height: int, degrees: float) -> NDArray[np.float64]:
    """Compute the ``(3, 3)`` homography that maps pixels of an image to pixels of the image that
    the camera would take after a rotation to the right by ``degrees``.

    The horizontal field of view is assumed to be 80 degrees, which is common on cars. The
    homography is also valid for images whose height was scaled.
    """
    focal = width / 2 / np.tan(np.radians(_FIELD_OF_VIEW / 2))
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    R = np.array([[c, 0, -s], [0, 1.0, 0], [s, 0, c]])
    return np.asarray(K @ R @ np.linalg.inv(K))
