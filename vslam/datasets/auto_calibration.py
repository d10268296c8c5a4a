"""Calibrates the camera of a recording from its own images (``--calib auto``)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from vslam.datasets.frames import RawSource, Size
from vslam.support.errors import BrokenSourceError, InputError, UnreadableImageError
from vslam.types.camera import Image
from vslam.types.source_options import SourceOptions

if TYPE_CHECKING:
    from vslam.calibration.from_motion import MotionFit

SECONDS = 60.0
"""Length of the beginning of a recording that is used."""

_EXIF, _FOCAL_LENGTH_35_MM = 0x8769, 0xA405  # tags of EXIF 2.32
_CALIBRATED = ("images", "video", "bag")


def single_camera(dataset: str, options: SourceOptions) -> SourceOptions:
    """Return the options of a source that ``--calib auto`` calibrates: with ``sensor`` ``mono``.

    Raises:
        InputError: the source has its own calibration, is a live camera, or has two cameras.
    """
    if dataset == "camera":
        raise InputError(
            "--calib auto: the images of a live camera are not known before; record a video, and "
            "calibrate its camera with vslam calibrate VIDEO --auto."
        )
    if dataset not in _CALIBRATED:
        raise InputError(
            f"--calib auto: {dataset} has its own calibration; leave the option out, or give the "
            "folder of the images of one camera."
        )
    if (
        options.side_by_side
        or options.right
        or options.depth
        or options.sensor not in (None, "mono")
    ):
        raise InputError(
            "--calib auto: finds the calibration of one camera; run with --sensor mono, or "
            "calibrate the pair with a board (docs/howto/calibrate.md)."
        )
    return options.model_copy(update={"sensor": "mono"})


def calibrate_source(raw: RawSource, data: str) -> MotionFit:
    """Estimate the camera of a source of one camera from its first minute.

    Args:
        data: name of the source, for error messages.

    Raises:
        InputError: the motion does not determine the focal length.
    """
    from vslam.calibration.from_motion import camera_from_motion

    size, name = raw.sizes[0], f"{data}: --calib auto"
    return camera_from_motion(_images(raw), size, name, _stated_focal_length(raw, size))


def _stated_focal_length(raw: RawSource, size: Size) -> float | None:
    """Return the focal length in pixels that EXIF states for the first image, as the equivalent for
    a film of 36x24 mm with the same diagonal (CIPA DCG-001). None if there is none."""
    file = raw.stored[0].file if raw.stored else None
    if file is None:
        return None
    from PIL import Image as PillowImage

    with suppress(Exception), PillowImage.open(file) as image:  # many kinds of errors
        equivalent = float(image.getexif().get_ifd(_EXIF).get(_FOCAL_LENGTH_35_MM, 0))
        focal = equivalent / float(np.hypot(36.0, 24.0)) * float(np.hypot(*size))
        return round(focal, 3) if 0.0 < focal < float("inf") else None
    return None


def _images(raw: RawSource) -> Iterator[tuple[float, Image]]:
    """Yield the images of the first minute that can be read."""
    begun: float | None = None
    with suppress(BrokenSourceError):
        for frame in raw.frames():
            begun = frame.timestamp if begun is None else begun
            if frame.timestamp - begun > SECONDS:
                return
            try:
                left, _ = frame.read(map)
            except UnreadableImageError:
                continue
            yield frame.timestamp, left
