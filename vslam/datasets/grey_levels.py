"""Converts images with more than 8 bits to 8 bits.

The values of a camera with 10, 12 or 14 bits are stored in 16 bits, and a scene rarely fills the
range of the sensor. The upper eight bits may therefore contain only a few grey levels. vslam scales
the values linearly by the range that it measures in a few frames. All frames of a drive and both
cameras use the same range, so that a point keeps its brightness.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from collections.abc import Sequence as Several
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.png import decode_with_opencv
from vslam.support.untrusted import is_image

Levels = NDArray[np.uint8]  # (65536,) the 8-bit grey level of each 16-bit value

_VALUES = 1 << 16
_FRAMES = 8  # frames of a folder in which the range is measured
_STRIDE = 2  # every second row and column is enough
_OUTLIERS = 0.005  # share of dead pixels and reflections at each end of the range
# The range is widened at both ends by this share, because other frames may be darker or brighter.
_HEADROOM = 0.1
_FULL = _VALUES // 2  # a range that the upper eight bits resolve into at least 128 levels


def upper_bits() -> Levels:
    """Return the levels that keep the upper eight bits."""
    return (np.arange(_VALUES) >> 8).astype(np.uint8)


def levels_of(images: Iterable[NDArray[Any]]) -> Levels | None:
    """Choose the grey levels for the images of a drive from samples of these images.

    If the values fill at least half of the 16-bit range, their upper eight bits are kept. Values of
    0 are ignored, because they often mark the border of an image.

    Args:
        images: images of any shape. Only uint16 images count.

    Returns:
        The levels. None if no image has 16 bits.
    """
    counts = np.zeros(_VALUES, np.int64)
    n = 0
    for image in images:
        if image.dtype.kind == "u" and image.dtype.itemsize == 2:
            n += 1
            values = image[::_STRIDE, ::_STRIDE].ravel().astype(np.int64)
            counts += np.bincount(values, minlength=_VALUES)
    if not n:
        return None
    counts[0] = 0
    below = np.cumsum(counts)
    ends = np.array([_OUTLIERS, 1.0 - _OUTLIERS]) * below[-1]
    low, high = np.searchsorted(below, ends).clip(0, _VALUES - 1).tolist()
    if below[-1] == 0 or high - low >= _FULL:
        return upper_bits()
    # Eight-bit values in 16 bits are not spread any further.
    wider = max(_HEADROOM * (high - low), (255 - (high - low)) / 2)
    low, high = max(low - wider, 0.0), high + wider
    scaled = (np.arange(_VALUES) - low) * (255.0 / (high - low))
    return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


def levels_of_files(firsts: Several[Path]) -> Levels | None:
    """Choose the grey levels for the image files of a drive.

    The range is measured in files that are spread over the folders of the drive. It therefore does
    not depend on which frames are selected.

    Args:
        firsts: an image of each camera. The other files in its folder count if their names differ
            from its name only in digits.

    Returns:
        The levels. None if none of these images has 16 bits.
    """
    deep = [path for path in firsts if _is_deep(_any_depth(path))]
    files = [path for first in deep for path in _spread(_siblings(first))]
    return levels_of(image for path in files if (image := _any_depth(path)) is not None)


def decode(data: bytes, flags: int, levels: Levels | None) -> NDArray[np.uint8] | None:
    """Decode an image file to 8 bits; None if it cannot be decoded.

    Args:
        flags: ``cv2.IMREAD_GRAYSCALE`` or ``cv2.IMREAD_ANYCOLOR``.
        levels: the grey level of each 16-bit value. None keeps the upper eight bits.

    Raises:
        cv2.error: the image is too large, or the file is empty.
    """
    import cv2

    if levels is not None:
        image = decode_with_opencv(data, flags | cv2.IMREAD_ANYDEPTH)
        if image is not None and _is_deep(image):
            return levels[image]
    return decode_with_opencv(data, flags)


def _is_deep(image: NDArray[Any] | None) -> bool:
    return image is not None and image.dtype == np.uint16


def _any_depth(path: Path) -> NDArray[Any] | None:
    """Decode a file to grey values of its own depth; None if it cannot be decoded."""
    import cv2

    try:
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
        return decode_with_opencv(path.read_bytes(), flags)
    except (OSError, ValueError, cv2.error):  # the reader of the images reports the error
        return None


def _siblings(first: Path) -> list[Path]:
    def letters(path: Path) -> str:
        return re.sub(r"\d+", "0", path.name)

    return sorted(
        path
        for path in first.parent.iterdir()
        if is_image(path) and letters(path) == letters(first)
    )


def _spread(files: list[Path]) -> list[Path]:
    chosen = np.unique(np.linspace(0, len(files) - 1, _FRAMES).round().astype(int))
    return [files[k] for k in chosen.tolist()]
