"""Images with the depth of their pixels, as files, and how depth is counted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.models import Calibration
from vslam.camera import Camera, DepthImage, Image, ImageMap
from vslam.datasets.image_files import (
    check_not_empty,
    read_grey,
    read_grey_of_size,
    size_text,
)
from vslam.errors import UnreadableImageError

# Of a Kinect: its projector stands so far from its camera (ORB-SLAM2, section III-A).
_VIRTUAL_BASELINE = 0.08


@dataclass(frozen=True)
class DepthFiles:
    """The selected frames as the camera took them; see `vslam.datasets.rectified.RawSequence`.

    Attributes:
        dataset: kind of source, ``tum`` for example.
        name: of the folder.
        timestamps: ``(N,)`` float64 seconds of the colour images.
        ground_truth: ``(N, 4, 4)`` float64 ``T_wc``, or None.
        colour, depth: N image files each; depth is empty for the colour images alone.
        size: width and height of the images.
        depth_scale: what depth images count in a metre.
    """

    dataset: str
    name: str
    timestamps: NDArray[np.float64]
    ground_truth: NDArray[np.float64] | None
    colour: tuple[Path, ...]
    depth: tuple[Path, ...]
    size: tuple[int, int]
    depth_scale: float

    def __len__(self) -> int:
        return len(self.colour)

    def read(self, index: int, image_map: ImageMap = map) -> tuple[Image, DepthImage | None]:
        """Grey image ``(H, W)`` uint8 and depth ``(H, W)`` float32 metres, None without depth.

        Raises:
            UnreadableImageError: a file is missing, damaged, of another size, or the depth not of
                16 bits.
        """
        left = read_grey_of_size(self.colour[index], *self.size)
        if not self.depth:
            return left, None
        steps = _read_steps(self.depth[index], *self.size)
        return left, steps * np.float32(1.0 / self.depth_scale)


def checked_depth_files(files: DepthFiles) -> DepthFiles:
    """The same, after a look at every file and the first frame.

    Raises:
        UnreadableImageError: a file is empty, or the first frame as `DepthFiles.read`.
    """
    for path in (*files.colour, *files.depth):
        check_not_empty(path)
    files.read(0)
    return files


def image_size(path: Path) -> tuple[int, int]:
    """Width and height.

    Raises:
        UnreadableImageError: missing or damaged.
    """
    height, width = read_grey(path).shape
    return width, height


def with_depth(camera: Camera, calibration: Calibration) -> Camera:
    """The camera of images with depth, with the calibration's virtual baseline or a Kinect's."""
    baseline = calibration.virtual_baseline or _VIRTUAL_BASELINE
    return replace(camera, baseline=baseline, depth=True)


def _read_steps(path: Path, width: int, height: int) -> NDArray[np.uint16]:
    import cv2

    from vslam.datasets.png import decode_with_opencv

    try:
        image = decode_with_opencv(path.read_bytes(), cv2.IMREAD_UNCHANGED)
    except (OSError, ValueError, cv2.error):
        image = None
    if image is None:
        raise UnreadableImageError(path, "cannot be decoded; download the file again.")
    if image.dtype != np.uint16 or image.ndim != 2:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise UnreadableImageError(
            path,
            f"depth of {8 * image.dtype.itemsize} bits and {channels} channels; it must be one "
            "channel of 16 bits, so take the original.",
        )
    if image.shape != (height, width):
        raise UnreadableImageError(
            path,
            f"depth of {size_text(image.shape)} pixels but the colour image has {width}x{height}; "
            "take depth that is registered to the colour images.",
        )
    return np.asarray(image, np.uint16)
