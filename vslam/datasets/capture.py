"""Code that videos and cameras share: OpenCV's captures, and frames with both sides of a pair."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from vslam.camera import Image, ImageMap
from vslam.datasets.frames import Size

if TYPE_CHECKING:
    from numpy.typing import NDArray

Capture = Any  # cv2.VideoCapture, which has no types


def open_capture(source: str | int, *parameters: int) -> Capture | None:
    """A capture of a file, URL or device; None if OpenCV cannot open it.

    Args:
        parameters: properties, each followed by its value.
    """
    import cv2

    # FFmpeg and OpenCV would write to the terminal in the middle of the progress bar.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        backend = cv2.CAP_ANY if isinstance(source, int) else cv2.CAP_FFMPEG
        capture = cv2.VideoCapture(source, backend, list(parameters))
    finally:
        cv2.utils.logging.setLogLevel(level)
    return capture if capture.isOpened() else None


def sizes_of(image: NDArray[np.uint8], side_by_side: bool, monocular: bool) -> tuple[Size, ...]:
    """Width and height of each image that `read_sides` returns."""
    height, width = image.shape[:2]
    if not side_by_side:
        return ((width, height),)
    return ((width // 2, height),) * (1 if monocular else 2)


def read_sides(
    image: NDArray[np.uint8], side_by_side: bool, monocular: bool, image_map: ImageMap
) -> tuple[Image, Image | None]:
    """Grey images of a frame: the frame itself, or with ``side_by_side`` its left and right half.

    Args:
        image: ``(H, W, 3)`` uint8 blue, green, red, or ``(H, W)`` grey.
        monocular: return only the left half.
    """
    width = image.shape[1] // 2
    halves = [image[:, :width], image[:, width : 2 * width]] if side_by_side else [image]
    left, *rest = image_map(_grey, halves[:1] if monocular else halves)
    return left, rest[0] if rest else None


def left_in_colour(image: NDArray[np.uint8], side_by_side: bool) -> NDArray[np.uint8]:
    """The left image of a frame: ``(H, W, 3)`` uint8 red, green, blue, or ``(H, W)`` grey.

    Args:
        image: as for `read_sides`.
    """
    import cv2

    left = image[:, : image.shape[1] // 2] if side_by_side else image
    # Decoders return grey videos in three equal channels.
    if left.ndim == 2 or (left == left[..., :1]).all():
        return np.ascontiguousarray(left if left.ndim == 2 else left[..., 0])
    return np.asarray(cv2.cvtColor(left, cv2.COLOR_BGR2RGB), np.uint8)


def _grey(image: NDArray[np.uint8]) -> Image:
    import cv2

    if image.ndim == 2:
        return np.ascontiguousarray(image)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
