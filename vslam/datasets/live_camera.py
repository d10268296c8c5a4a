"""Live cameras: a local device or a URL, with one camera or a stereo pair side by side.

A frame's time stamp is the machine's monotonic clock when the image arrives.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

from vslam.datasets.capture import Capture, open_capture, read_sides, sizes_of
from vslam.datasets.frames import RawSource, TimedFrame
from vslam.errors import BrokenSourceError, InputError

_TIMEOUT_MS = 10_000
_DEVICES = Path("/dev")


def open_camera(device: str, *, side_by_side: bool = False, monocular: bool = False) -> RawSource:
    """Open a camera and take a first image; its frames can be read only once.

    The source is named by the device's number or by the URL without user name and password.

    Args:
        device: a number, or a URL.
        side_by_side: each frame holds the left image and, right of it, the right one.
        monocular: read the left images alone.

    Raises:
        InputError: there is no such device, it is busy or gives no image, or it has one image per
            frame but two are needed.
    """
    name = _name(device)
    if not side_by_side and not monocular:
        raise InputError(
            f"camera {name}: a camera has one image per frame; use --side-by-side if it holds both "
            "images of a stereo pair, or run with --sensor mono."
        )
    capture = _open_device(int(device)) if device.isdecimal() else _open_url(device, name)
    decoded, image = capture.read()
    if not decoded:
        capture.release()
        raise InputError(
            f"camera {name}: gives no image; end other programs that use it, or name another one."
        )
    return RawSource(
        dataset="camera",
        name=name,
        sizes=sizes_of(image, side_by_side, monocular),
        play=partial(_play, capture, name, side_by_side, monocular),
        live=True,
    )


def _play(capture: Capture, name: str, side_by_side: bool, monocular: bool) -> Iterator[TimedFrame]:
    n = 0
    try:
        while True:
            decoded, image = capture.read()
            if not decoded:
                break
            sides = partial(read_sides, image, side_by_side, monocular)
            yield TimedFrame(time.monotonic(), sides)
            n += 1
    finally:
        capture.release()
    raise BrokenSourceError(f"camera {name}: no image came after {n}; check its cable or network.")


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
            f"camera {number}: the device is busy or not a camera; end other programs that use it, "
            "or name another number with --data."
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
