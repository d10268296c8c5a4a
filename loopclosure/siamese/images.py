"""From a camera image to the input of a network."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vslam.errors import UnreadableImageError

Fit = Literal["squash", "crop"]


def to_square(image: NDArray[np.uint8], pixels: int, fit: Fit = "squash") -> NDArray[np.uint8]:
    """Resize ``(H, W)`` to ``(pixels, pixels)``.

    ``squash`` keeps the whole view and loses the aspect; ``crop`` keeps the aspect and loses what
    is beyond the central square.
    """
    import cv2

    if fit == "crop":
        height, width = image.shape
        side = min(height, width)
        y, x = (height - side) // 2, (width - side) // 2
        image = image[y : y + side, x : x + side]
    if image.shape == (pixels, pixels):
        return image
    shrinking = image.shape[0] > pixels or image.shape[1] > pixels
    way = cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (pixels, pixels), interpolation=way), np.uint8)


def to_tensor(squares: NDArray[np.uint8]) -> Tensor:
    """``(N, S, S)`` grey images to ``(N, 3, S, S)`` float32 in [0, 1], the grey replicated."""
    x = torch.from_numpy(np.ascontiguousarray(squares)).float().div_(255.0)
    return x[:, None].expand(-1, 3, -1, -1)


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
