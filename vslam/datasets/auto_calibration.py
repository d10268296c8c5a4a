"""Calibrates the camera of a recording from its own images (``--calib auto``)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vslam.datasets.frames import RawSource, Size
from vslam.datasets.quicktime import focal_length_35_mm
from vslam.support.errors import BrokenSourceError, InputError, UnreadableImageError
from vslam.types.camera import Image
from vslam.types.source_options import SourceOptions

if TYPE_CHECKING:
    from vslam.calibration.from_motion import MotionFit, StatedFocalLength

SECONDS = 60.0
"""Length of the beginning of a recording that is used."""

_EXIF, _FOCAL_LENGTH_35_MM = 0x8769, 0xA405  # tags of EXIF 2.32
# Relative standard deviations of what files state: it is rounded to millimetres, and images are
# cropped; those of videos are often cropped further, to hide that the camera shakes. [own]
_EXIF_SIGMA, _VIDEO_SIGMA = 0.05, 0.1
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
    return camera_from_motion(_images(raw), size, name, _stated(raw, data, size))


def _stated(raw: RawSource, data: str, size: Size) -> StatedFocalLength | None:
    """Return the focal length that EXIF states for the first image, or that a video states, as the
    equivalent for a film of 36x24 mm with the same diagonal (CIPA DCG-001). None if there is none.
    """
    from vslam.calibration.from_motion import StatedFocalLength

    file = raw.stored[0].file if raw.stored else None
    equivalent: float | None = None
    with suppress(Exception):  # many kinds of errors
        equivalent = focal_length_35_mm(Path(data)) if file is None else _of_exif(file)
    focal = (equivalent or 0.0) / float(np.hypot(36.0, 24.0)) * float(np.hypot(*size))
    if not 0.0 < focal < float("inf"):
        return None
    where, sigma = ("the video", _VIDEO_SIGMA) if file is None else ("EXIF", _EXIF_SIGMA)
    return StatedFocalLength(round(focal, 3), sigma, where)


def _of_exif(file: Path) -> float:
    from PIL import Image as PillowImage

    with PillowImage.open(file) as image:
        return float(image.getexif().get_ifd(_EXIF).get(_FOCAL_LENGTH_35_MM, 0))


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
