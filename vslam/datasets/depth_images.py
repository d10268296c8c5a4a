"""Colour images with depth images, as files."""

from __future__ import annotations

from collections.abc import Sequence as Several
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.models import Calibration
from vslam.camera import Camera, ImageMap
from vslam.datasets.frames import Images, RawSource, stored_frames
from vslam.datasets.image_files import (
    check_not_empty,
    image_size,
    read_colour,
    read_grey_of_size,
    size_text,
)
from vslam.errors import UnreadableImageError

# Distance in metres from a Kinect's projector to its camera (ORB-SLAM2, section III-A).
_VIRTUAL_BASELINE = 0.08


def depth_files(
    dataset: str,
    name: str,
    timestamps: NDArray[np.float64],
    ground_truth: NDArray[np.float64] | None,
    colour: Several[Path],
    depth: Several[Path],
    depth_scale: float,
) -> RawSource:
    """Check all files, decode the first frame and make a source of colour and depth images.

    Args:
        timestamps: ``(N,)`` float64 seconds of the colour images.
        ground_truth: ``(N, 4, 4)`` float64 ``T_wc``, or None.
        colour, depth: N image files each.
        depth_scale: units of the depth images per metre.

    Raises:
        UnreadableImageError: a file is empty, the first frame cannot be decoded, its two images
            differ in size, or its depth does not have 16 bits.
    """
    for path in (*colour, *depth):
        check_not_empty(path)
    size = image_size(colour[0])

    def read(index: int, image_map: ImageMap) -> Images:
        left = read_grey_of_size(colour[index], *size)
        return left, _read_steps(depth[index], *size) * np.float32(1.0 / depth_scale)

    source = RawSource(
        dataset=dataset,
        name=name,
        sizes=(size,),
        depth=True,
        stored=stored_frames(timestamps, read, colour, read_colour),
        ground_truth=ground_truth,
    )
    source.read(0)
    return source


def with_depth(camera: Camera, calibration: Calibration) -> Camera:
    """Give an RGB-D camera the calibration's virtual baseline, or that of a Kinect."""
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
            f"depth of {8 * image.dtype.itemsize} bits and {channels} channels, but it must be one "
            "channel of 16 bits; take the original.",
        )
    if image.shape != (height, width):
        raise UnreadableImageError(
            path,
            f"depth has {size_text(image.shape)} pixels but the colour image has {width}x{height}; "
            "take depth that is registered to the colour images.",
        )
    return np.asarray(image, np.uint16)
