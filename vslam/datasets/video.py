"""Video files of one camera or of a stereo pair side by side, decoded by FFmpeg."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import partial
from itertools import islice
from pathlib import Path

from vslam.camera import Image
from vslam.datasets.capture import Capture, left_in_colour, open_capture, read_sides, sizes_of
from vslam.datasets.frames import RawSource, TimedFrame
from vslam.errors import BrokenSourceError, InputError
from vslam.untrusted import MOST_PIXELS

_log = logging.getLogger(__name__)

_CONVERT = "convert the video, for example with ffmpeg -i VIDEO -c:v libx264 -crf 12 NEW.mp4"
_SAME_RATE = 0.02  # 30 and 29.97 frames per second are the same
_MISSING_SHARE = 0.05  # tolerated at the end, because the file's number of frames is an estimate


def open_video(
    path: Path | str,
    *,
    fps: float | None = None,
    side_by_side: bool = False,
    monocular: bool = False,
) -> RawSource:
    """Open a video and decode its first frames.

    Args:
        fps: frames per second, instead of the file's time stamps; None uses the time stamps.
        side_by_side: each frame holds the left image and, right of it, the right one.
        monocular: read the left images alone.

    Raises:
        InputError: the file is missing or cannot be decoded, there are neither time stamps nor
            ``fps``, or a frame has one image but two are needed.
    """
    if not side_by_side and not monocular:
        raise InputError(
            f"{path}: a video has one image per frame; use --side-by-side if it holds both images "
            "of a stereo pair, or run with --sensor mono."
        )
    path = Path(path)
    capture = _open(path)
    _check_size(path, capture)
    n, own = _count(capture), _own_rate(capture)
    first = list(islice(_images(capture), 2))
    if not first:
        raise InputError(f"{path}: holds no image that can be decoded; {_CONVERT}.")
    times = [timestamp for timestamp, _ in first]
    if fps is None and len(times) == 2 and times[1] <= times[0]:
        raise InputError(f"{path}: the video has no time stamps; give --fps.")
    if fps is not None and len(times) == 2 and times[1] > times[0]:
        _compare_rates(path, fps, own)
    return RawSource(
        dataset="video",
        name=path.stem,
        sizes=sizes_of(first[0][1], side_by_side, monocular),
        play=partial(_play, path, n, fps, side_by_side, monocular),
        n_expected=n,
    )


def _play(
    path: Path, n_expected: int | None, fps: float | None, side_by_side: bool, monocular: bool
) -> Iterator[TimedFrame]:
    n = 0
    for timestamp, image in _images(_open(path)):
        timestamp = timestamp if fps is None else n / fps
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
    if not path.is_file():
        raise InputError(f"{path}: no such file; name a video with --data.")
    capture = open_capture(str(path))
    if capture is None:
        raise InputError(
            f"{path}: not a video, truncated, or in a codec unknown to OpenCV's FFmpeg; {_CONVERT}."
        )
    return capture


def _check_size(path: Path, capture: Capture) -> None:
    """Refuse large frames before decoding allocates the memory that the header asks for."""
    import cv2

    kinds = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT
    width, height = (capture.get(kind) for kind in kinds)
    if width * height > MOST_PIXELS:
        raise InputError(
            f"{path}: frames of {width:.0f}x{height:.0f} exceed the limit of "
            f"{MOST_PIXELS / 1e6:.0f} million pixels; scale the video down."
        )


def _count(capture: Capture) -> int | None:
    import cv2

    n = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    return n if n > 0 else None


def _own_rate(capture: Capture) -> float:
    """Frames per second stated in the file, 0 if it states none."""
    import cv2

    return float(capture.get(cv2.CAP_PROP_FPS))


def _compare_rates(path: Path, fps: float, own: float) -> None:
    if own > 0 and abs(fps - own) > _SAME_RATE * own:
        _log.warning(
            "%s: --fps %g contradicts the video's own %.4g frames per second; leave the option out "
            "unless the video is wrong.",
            path,
            fps,
            own,
        )


def _images(capture: Capture) -> Iterator[tuple[float, Image]]:
    """Yield times in seconds and decoded images; then close the capture."""
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
