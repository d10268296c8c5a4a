"""Reads video files and live cameras, using OpenCV.

Each frame is either one monocular image, or a stereo pair side by side. The time stamp of a live
camera's frame is the time at which the frame arrives, by the monotonic clock of the machine.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.frames import RawSource, Size, TimedFrame
from vslam.datasets.grey_levels import Levels, levels_of
from vslam.support.errors import BrokenSourceError, InputError
from vslam.support.file_kinds import identify
from vslam.support.untrusted import MOST_PIXELS
from vslam.types.camera import Image, ImageMap

_log = logging.getLogger(__name__)

Capture = Any  # cv2.VideoCapture, which has no types
_TIMEOUT_MS = 10_000  # for a camera at a URL
_DEVICES = Path("/dev")
_CONVERT = "convert the video, for example with ffmpeg -i VIDEO -c:v libx264 -crf 12 NEW.mp4"
_GREY_16_BITS = int.from_bytes(b"Y1\x00\x10", "little")  # FFmpeg's pixel format gray16le
_SAMPLES = 8  # images in which the range of the grey values is measured
_SAME_RATE = 0.02  # relative; 30 and 29.97 frames per second count as the same rate
# Share of the frames that may be missing at the end without an error. The number of frames that a
# container states is only an estimate.
_MISSING_SHARE = 0.05


def open_capture(source: str | int, *parameters: int) -> Capture | None:
    """Open a video file, URL or camera. None if OpenCV cannot open it.

    Args:
        parameters: properties of OpenCV's capture, each followed by its value.
    """
    import cv2

    # The messages of FFmpeg and OpenCV are suppressed, because they would break the progress bar in
    # the terminal.
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
    """Return the width and height of each image that `read_sides` returns."""
    height, width = image.shape[:2]
    if not side_by_side:
        return ((width, height),)
    return ((width // 2, height),) * (1 if monocular else 2)


def read_sides(
    image: NDArray[np.uint8], side_by_side: bool, monocular: bool, image_map: ImageMap
) -> tuple[Image, Image | None]:
    """Convert a frame to one or two grey images.

    Args:
        image: ``(H, W, 3)`` uint8 blue, green, red, or ``(H, W)`` grey.
        side_by_side: whether the frame contains the left and the right image side by side.
        monocular: return only the left image.
    """
    width = image.shape[1] // 2
    halves = [image[:, :width], image[:, width : 2 * width]] if side_by_side else [image]
    left, *rest = image_map(_grey, halves[:1] if monocular else halves)
    return left, rest[0] if rest else None


def left_in_colour(image: NDArray[np.uint8], side_by_side: bool) -> NDArray[np.uint8]:
    """Return the left image of a frame: ``(H, W, 3)`` uint8 red, green, blue, or ``(H, W)`` grey.

    Args:
        image: ``(H, W, 3)`` uint8 blue, green, red, or ``(H, W)`` grey.
    """
    import cv2

    left = image[:, : image.shape[1] // 2] if side_by_side else image
    # Decoders return grey videos as three equal channels.
    if left.ndim == 2 or (left == left[..., :1]).all():
        return np.ascontiguousarray(left if left.ndim == 2 else left[..., 0])
    return np.asarray(cv2.cvtColor(left, cv2.COLOR_BGR2RGB), np.uint8)


def _grey(image: NDArray[np.uint8]) -> Image:
    import cv2

    if image.ndim == 2:
        return np.ascontiguousarray(image)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def open_video(
    path: Path | str,
    *,
    fps: float | None = None,
    side_by_side: bool = False,
    monocular: bool = False,
) -> RawSource:
    """Open a video and decode its first frames.

    Args:
        fps: frames per second. If it is given, the time stamps in the file are not used.
        side_by_side: whether each frame contains the left and the right image side by side.
        monocular: read only the left images.

    Raises:
        InputError: the file is missing or cannot be decoded, there are neither time stamps nor
            ``fps``, or neither ``side_by_side`` nor ``monocular`` is set.
    """
    import cv2

    path = Path(path)
    _check_sides(f"{path}: a video", side_by_side, monocular)
    capture = _open(path)
    width, height, count, own_fps = (
        float(capture.get(key))
        for key in (
            cv2.CAP_PROP_FRAME_WIDTH,
            cv2.CAP_PROP_FRAME_HEIGHT,
            cv2.CAP_PROP_FRAME_COUNT,
            cv2.CAP_PROP_FPS,
        )
    )
    # This is checked before the decoder allocates memory for the size in the header.
    if width * height > MOST_PIXELS:
        raise InputError(
            f"{path}: frames of {width:.0f}x{height:.0f} exceed the limit of "
            f"{MOST_PIXELS / 1e6:.0f} million pixels; scale the video down."
        )
    first = list(islice(_images(capture), 2))
    if not first:
        raise InputError(f"{path}: holds no image that can be decoded; {_CONVERT}.")
    stamped = len(first) < 2 or first[1][0] > first[0][0]
    if fps is None and not stamped:
        raise InputError(f"{path}: the video has no time stamps; give --fps.")
    if fps is not None and stamped and own_fps > 0 and abs(fps / own_fps - 1.0) > _SAME_RATE:
        _log.warning(
            "%s: --fps %g contradicts the video's own %.4g frames per second; leave the option out "
            "unless the video is wrong.",
            path,
            fps,
            own_fps,
        )
    n = int(count) if count >= 1 else None
    levels = levels_of(image for _, image in first)
    if levels is not None:
        levels = levels_of(_spread(path, n or 1))
    return RawSource(
        dataset="video",
        name=path.stem,
        sizes=sizes_of(first[0][1], side_by_side, monocular),
        play=partial(_play, path, n, fps, side_by_side, monocular, levels),
        n_expected=n,
    )


def _check_sides(source: str, side_by_side: bool, monocular: bool) -> None:
    if not side_by_side and not monocular:
        raise InputError(
            f"{source} has one image per frame; use --side-by-side if each frame holds both "
            "images of a stereo pair, or run with --sensor mono."
        )


def _play(
    path: Path,
    n_expected: int | None,
    fps: float | None,
    side_by_side: bool,
    monocular: bool,
    levels: Levels | None,
) -> Iterator[TimedFrame]:
    n = 0
    for timestamp, image in _images(_open(path)):
        timestamp = timestamp if fps is None else n / fps
        image = image if levels is None else levels[image]
        yield TimedFrame(
            timestamp,
            partial(read_sides, image, side_by_side, monocular),
            colour=partial(left_in_colour, image, side_by_side),
        )
        n += 1
    if n_expected is not None and n + 1 < (1.0 - _MISSING_SHARE) * n_expected:
        raise BrokenSourceError(
            f"{path}: the video ends after {n} of about {n_expected} frames; copy it again."
        )


def _open(path: Path) -> Capture:
    import cv2

    if not path.is_file():
        raise InputError(f"{path}: no such file; give a video with --data.")
    if (kind := identify(path)) is not None and kind.fix and not kind.is_stream:
        raise InputError(f"{path}: {kind.name} instead of a video; {kind.fix}.")
    capture = open_capture(str(path))
    if capture is not None and capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT) == _GREY_16_BITS:
        capture.release()  # OpenCV would convert the images to 8 bits
        capture = open_capture(str(path), cv2.CAP_PROP_CONVERT_RGB, 0)
    if capture is None:
        raise InputError(
            f"{path}: not a video, truncated, or in a codec unknown to OpenCV's FFmpeg; {_CONVERT}."
        )
    return capture


def _spread(path: Path, n: int) -> Iterator[NDArray[Any]]:
    """Yield images that are spread over a video of about ``n`` frames."""
    import cv2

    capture = _open(path)
    try:
        for k in np.unique(np.linspace(0, n - 1, _SAMPLES).astype(int)).tolist():
            capture.set(cv2.CAP_PROP_POS_FRAMES, k)
            decoded, image = capture.read()
            if decoded:
                yield image
    finally:
        capture.release()


def _images(capture: Capture) -> Iterator[tuple[float, Image]]:
    """Yield the time in seconds and the image of each frame, and close the capture at the end."""
    import cv2

    try:
        while capture.grab():
            timestamp = round(1e3 * capture.get(cv2.CAP_PROP_POS_MSEC)) / 1e6  # to microseconds
            decoded, image = capture.retrieve()
            if not decoded:
                return
            yield timestamp, image
    finally:
        capture.release()


def open_camera(device: str, *, side_by_side: bool = False, monocular: bool = False) -> RawSource:
    """Open a camera and take a first image. The frames of the source can be read only once.

    The name of the source is the device number, or the URL without user name and password.

    Args:
        device: a number, or a URL.
        side_by_side: whether each frame contains the left and the right image side by side.
        monocular: read only the left images.

    Raises:
        InputError: there is no such device, it is busy or returns no image, or neither
            ``side_by_side`` nor ``monocular`` is set.
    """
    name = _name(device)
    _check_sides(f"camera {name}: a camera", side_by_side, monocular)
    capture = _open_device(int(device)) if device.isdecimal() else _open_url(device, name)
    decoded, image = capture.read()
    if not decoded:
        capture.release()
        raise InputError(
            f"camera {name}: returns no image; close other programs that use it, or give another "
            "camera."
        )
    return RawSource(
        dataset="camera",
        name=name,
        sizes=sizes_of(image, side_by_side, monocular),
        play=partial(_play_live, capture, name, side_by_side, monocular),
        live=True,
    )


def _play_live(
    capture: Capture, name: str, side_by_side: bool, monocular: bool
) -> Iterator[TimedFrame]:
    n = 0
    try:
        while True:
            decoded, image = capture.read()
            if not decoded:
                break
            yield TimedFrame(
                time.monotonic(),
                partial(read_sides, image, side_by_side, monocular),
                colour=partial(left_in_colour, image, side_by_side),
            )
            n += 1
    finally:
        capture.release()
    raise BrokenSourceError(f"camera {name}: stopped after {n} images; check its cable or network.")


def _name(device: str) -> str:
    if device.isdecimal():
        return device
    parts = urlsplit(device)
    return f"{parts.hostname or ''}{parts.path}"


def _open_device(number: int) -> Capture:
    import cv2

    capture = open_capture(number, cv2.CAP_PROP_BUFFERSIZE, 1)
    if capture is not None:
        return capture
    if (_DEVICES / f"video{number}").exists():
        raise InputError(
            f"camera {number}: the device is busy or not a camera; close other programs that use "
            "it, or give another number with --data."
        )
    there = sorted(path.name.removeprefix("video") for path in _DEVICES.glob("video*"))
    choice = f"there are {', '.join(there)}" if there else "no camera is connected"
    raise InputError(f"camera {number}: no such device; {choice}.")


def _open_url(url: str, name: str) -> Capture:
    import cv2

    timeouts = (cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, cv2.CAP_PROP_READ_TIMEOUT_MSEC)
    capture = open_capture(url, *(number for key in timeouts for number in (key, _TIMEOUT_MS)))
    if capture is None:
        raise InputError(
            f"camera {name}: cannot be opened; check whether the URL plays in another program."
        )
    return capture
