"""From a camera image to the input of a network."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vslam.errors import InputError, UnreadableImageError

_FIELD_OF_VIEW = 80.0  # degrees, of the camera that turn_homography turns

Fit = Literal["squash", "crop"]


Size = tuple[int, int]
"""Height and width, pixels."""


def parse_size(text: str) -> Size:
    """``129`` or ``81x145`` to height and width.

    Raises:
        InputError: anything else, or fewer than 32 pixels.
    """
    height, by, width = text.lower().partition("x")
    if not by:
        width = height
    if not (height.isdecimal() and width.isdecimal()):
        raise InputError(f"--pixels {text}: write the side, 129, or height and width, 81x145.")
    if min(int(height), int(width)) < 32:
        raise InputError(f"--pixels {text}: a network needs 32 pixels each way at least.")
    return int(height), int(width)


def to_size(image: NDArray[np.uint8], size: Size, fit: Fit = "squash") -> NDArray[np.uint8]:
    """Resize ``(H, W)`` to ``size``.

    ``squash`` keeps the whole view and loses the aspect; ``crop`` keeps the aspect and loses what
    is beyond the largest rectangle of the wanted aspect in the middle.
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
    way = cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size[::-1], interpolation=way), np.uint8)


def read_grey(source: Path | NDArray[np.uint8], name: str = "") -> NDArray[np.uint8]:
    """Decode an image as ``(H, W)`` uint8.

    Args:
        source: file, or its ``(B,)`` encoded bytes.
        name: of an image given as bytes, for the message.

    Raises:
        UnreadableImageError: missing, empty or damaged.
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
    """Pixels before to pixels after a camera turned to the right where it stands, ``(3, 3)``.

    Of a camera that sees 80 degrees across, as those on cars do. Heights only scale, so it holds
    for images that were squashed, too.
    """
    focal = width / 2 / np.tan(np.radians(_FIELD_OF_VIEW / 2))
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    R = np.array([[c, 0, -s], [0, 1.0, 0], [s, 0, c]])
    return np.asarray(K @ R @ np.linalg.inv(K))
