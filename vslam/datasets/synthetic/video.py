"""A stereo sequence as one video, left and right images side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vslam.camera import Camera
from vslam.datasets.frames import Source
from vslam.errors import InputError


def write_side_by_side(sequence: Source, path: Path) -> Path:
    """Write the images losslessly (codec FFV1), and vslam's calibration file beside them.

    Args:
        sequence: a stereo sequence; the video gets its mean frame rate.
        path: path of the video, for example with the suffix ``.mkv``.

    Returns:
        The calibration file, which has the same name with ``.yaml``.

    Raises:
        InputError: a file cannot be written.
    """
    import cv2

    camera, times = sequence.camera, sequence.timestamps
    seconds = float(times[-1] - times[0])
    fps = (len(times) - 1) / seconds if seconds > 0 else 10.0
    calibration = path.with_suffix(".yaml")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        calibration.write_text(_calibration(camera))
    except OSError as error:
        raise InputError(
            f"{calibration}: cannot be written ({error.strerror}); name another file."
        ) from error
    size = (2 * camera.width, camera.height)
    fourcc = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, fps, size, isColor=False)
    if not writer.isOpened():
        raise InputError(f"{path}: cannot be written as a video; name a file like town.mkv.")
    try:
        for index in range(len(sequence)):
            left, right = sequence.read(index)
            if right is None:
                raise InputError(f"{path}: a side-by-side video needs a stereo sequence.")
            writer.write(np.hstack([left, right]))
    finally:
        writer.release()
    return calibration


def _calibration(camera: Camera) -> str:
    side = (
        f"{{size: [{camera.width}, {camera.height}], focal: [{camera.fx!r}, {camera.fy!r}], "
        f"centre: [{camera.cx!r}, {camera.cy!r}]}}"
    )
    return f"left: {side}\nright: {side}\nbaseline: {camera.baseline!r}\n"
