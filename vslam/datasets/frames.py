"""Sources of frames, which readers open and from which a run takes its images.

Every source yields its frames in the order of their times. Images in files can also be read in any
order; a video, a bag or a camera cannot seek. Readers return a `RawSource` if the images need to be
rectified (`vslam.datasets.rectified`), and a `Source` if they do not.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from collections.abc import Sequence as Several
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, DepthImage, Image, ImageMap
from vslam.errors import BrokenSourceError, InputError, UnreadableImageError

Images = tuple[Image, Image | DepthImage | None]
Size = tuple[int, int]

_log = logging.getLogger(__name__)

_FIRST_FRAMES = 120  # a few seconds; a pair of 752x480 takes 0.7 MB


@dataclass(frozen=True)
class TimedFrame:
    """A frame that is yet to be decoded.

    Attributes:
        timestamp: seconds.
        read: decodes the left and the second image; safe to call in any thread. The left image is
            ``(H, W)`` uint8. The second one is the right image, ``(H, W)`` uint8; or the depth of
            the left image's pixels, ``(H, W)`` float32 metres, 0 if unknown; or None (monocular).
            The argument is a map function over both images, which may decode them in parallel.
            Raises UnreadableImageError if a file is damaged or not of the calibration's size.
        sides: decode the left and the right image alone, so that one of them need not be read;
            they give the images of ``read``, and raise as it does. None if both are decoded
            together, or if there is no right image.
        file: the left image's file, if its pixels need no rectification; else None.
        colour: decodes the left image as it was taken, ``(H, W, 3)`` uint8 red, green, blue, or
            ``(H, W)`` if it is grey; None for a source without colours. Raises as ``read``.
        name: file name of the left image; None if it has none.
        mask: reads the mask of the left image, ``(H, W)`` uint8, 0 where it is not to be used; None
            if all of it is used. Raises UnreadableImageError.
    """

    timestamp: float
    read: Callable[[ImageMap], Images]
    sides: tuple[Callable[[], Image], Callable[[], Image]] | None = None
    file: Path | None = None
    colour: Callable[[], NDArray[np.uint8]] | None = None
    name: str | None = None
    mask: Callable[[], Image] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class _Frames:
    """See `Source`."""

    dataset: str
    name: str
    stored: tuple[TimedFrame, ...] = ()
    play: Callable[[], Iterator[TimedFrame]] | None = None
    n_expected: int | None = None
    live: bool = False
    ground_truth: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if not self.seekable:
            return
        object.__setattr__(self, "n_expected", len(self.stored))
        times = self.timestamps
        if not len(times) or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise InputError(f"{self.name}: the times of its frames do not increase; repair them.")
        if self.ground_truth is not None and self.ground_truth.shape != (len(times), 4, 4):
            raise ValueError(f"ground_truth must be of shape ({len(times)}, 4, 4)")

    @property
    def seekable(self) -> bool:
        """Whether the frames are stored and can be read in any order."""
        return self.play is None

    def frames(self) -> Iterator[TimedFrame]:
        """All frames in order; every call starts at the first one, unless the source is live.

        Only the images of the current frame are held in memory.

        Raises:
            BrokenSourceError: after the last good frame of a truncated file or unplugged device.
            InputError: the stream ends before the first selected frame.
        """
        return iter(self.stored) if self.play is None else self.play()

    @cached_property
    def timestamps(self) -> NDArray[np.float64]:
        """``(N,)`` float64 seconds, strictly increasing.

        Raises:
            TypeError: the source cannot seek.
        """
        return np.array([frame.timestamp for frame in self._stored()], np.float64)

    def __len__(self) -> int:
        return len(self._stored())

    def read(self, index: int, image_map: ImageMap = map) -> Images:
        """Left and second image of one frame; see `TimedFrame`.

        Raises:
            UnreadableImageError: a file is damaged or not of the calibration's size.
            TypeError: the source cannot seek.
        """
        return self._stored()[index].read(image_map)

    def _stored(self) -> tuple[TimedFrame, ...]:
        if not self.seekable:
            raise TypeError(f"{self.name}: the frames of a stream come one by one, in order")
        return self.stored


@dataclass(frozen=True, kw_only=True, eq=False)
class Source(_Frames):
    """Rectified stereo images, left images alone, or images with depth.

    Attributes:
        dataset: kind of source, ``kitti`` or ``video`` for example.
        name: name of the sequence, file or device.
        camera: calibration; ``camera.sensor`` is the kind of images in the frames.
        stored: N frames that can be read in any order; see `stored_frames`.
        play: yields the frames of a stream, which cannot seek; None if they are stored.
        n_expected: the number of frames, approximate for a stream, or None if unknown.
        live: frames arrive in real time and are lost if they are not read, as from a camera.
        ground_truth: ``(N, 4, 4)`` float64 ``T_wc``, NaN for frames without a pose, or None.
        rectify_mask: maps an ``(H, W)`` uint8 mask of the left images as they were taken to one of
            the rectified images; None if the images were not changed.

    Raises:
        InputError: the times of stored frames do not increase.
        ValueError: the ground truth has the wrong shape.
    """

    camera: Camera
    rectify_mask: Callable[[Image], Image] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class RawSource(_Frames):
    """Images as the cameras took them; see `Source` for the other attributes.

    Attributes:
        sizes: width and height of each camera's images; one entry if the second images are depth.
        depth: whether the second images are the depth of the first images' pixels.
        ground_truth: poses of the left camera before rectification.
    """

    sizes: tuple[Size, ...]
    depth: bool = False


_AnySource = TypeVar("_AnySource", Source, RawSource)


def stored_frames(
    timestamps: NDArray[np.float64],
    read: Callable[[int, ImageMap], Images],
    files: Several[Path] | None = None,
    colour: Callable[[Path], NDArray[np.uint8]] | None = None,
) -> tuple[TimedFrame, ...]:
    """Frames that one function reads by their index.

    Args:
        timestamps: ``(N,)`` float64 seconds, increasing.
        read: decodes the frame of an index, see `TimedFrame`.
        files: the files of the left images.
        colour: decodes a file in colour, see `TimedFrame`.
    """
    frames = [TimedFrame(time, partial(read, k)) for k, time in enumerate(timestamps.tolist())]
    if files is None:
        return tuple(frames)
    return tuple(
        replace(
            frame,
            file=file,
            colour=None if colour is None else partial(colour, file),
            name=file.name,
        )
        for frame, file in zip(frames, files, strict=True)
    )


def decoded(sides: Several[Callable[[], Image | DepthImage]], image_map: ImageMap = map) -> Images:
    """The images of a frame, each from a function that decodes one side."""
    left, *second = image_map(_call, sides)
    return np.asarray(left, np.uint8), second[0] if second else None


def _call(decode: Callable[[], Image | DepthImage]) -> Image | DepthImage:
    return decode()


def selected(
    source: _AnySource, *, start: int = 0, every: int = 1, max_frames: int | None = None
) -> _AnySource:
    """Select every N-th frame of a source from frame ``start`` on.

    Raises:
        InputError: options out of range, or a start beyond the last frame.
    """
    if start < 0 or every < 1 or (max_frames is not None and max_frames < 1):
        raise InputError("--start must be at least 0, --every and --max-frames at least 1.")
    whole = source.n_expected
    if whole is not None and start >= whole:
        about = "" if source.seekable else "about "
        raise InputError(
            f"--start {start}: {source.name} has {about}{whole} frames; choose a smaller number."
        )
    chosen = slice(start, None if max_frames is None else start + every * max_frames, every)
    if source.seekable:
        truth = source.ground_truth
        truth = None if truth is None else truth[chosen]
        return replace(source, stored=source.stored[chosen], ground_truth=truth)
    n = max_frames if whole is None else len(range(*chosen.indices(whole)))
    return replace(source, n_expected=n, play=partial(_play_selected, source, chosen))


def _play_selected(source: Source | RawSource, chosen: slice) -> Iterator[TimedFrame]:
    frame = None
    frames = _increasing(source.frames(), source.name)
    for frame in islice(frames, chosen.start, chosen.stop, chosen.step):
        yield frame
    if frame is None:
        raise InputError(
            f"--start {chosen.start}: {source.name} has no such frame; choose a smaller number."
        )


def _increasing(frames: Iterator[TimedFrame], name: str) -> Iterator[TimedFrame]:
    """Leave out frames that are not later than their predecessor, with a warning for each."""
    last = None
    for frame in frames:
        if last is not None and frame.timestamp <= last:
            _log.warning(
                "%s: the frame at %.6f s is left out because it comes after the one at %.6f s",
                name,
                frame.timestamp,
                last,
            )
            continue
        last = frame.timestamp
        yield frame


def frames_at(source: Source, indices: Several[int]) -> Iterator[TimedFrame]:
    """Yield selected frames of a source; a stream is played up to the last of them. There are
    fewer frames if the source ends early.

    Args:
        indices: indices of the frames, increasing.
    """
    if source.seekable:
        yield from (source.stored[k] for k in indices if k < len(source))
        return
    wanted = set(indices)
    played = islice(source.frames(), max(wanted, default=-1) + 1)
    yield from (frame for k, frame in enumerate(played) if k in wanted)


def first_frames(source: Source) -> Source:
    """Load the first frames of a stream into memory, so that they can be read in any order. A
    source that can seek is returned unchanged.

    A frame that cannot be decoded raises its UnreadableImageError whenever it is read.

    Raises:
        InputError: there is no frame.
    """
    if source.seekable:
        return source
    frames = []
    problem = "it has no frames"
    try:
        for frame in islice(source.frames(), _FIRST_FRAMES):
            frames.append(_held(frame))
    except BrokenSourceError as error:
        problem = str(error).rstrip(".")
    if not frames:
        raise InputError(f"{source.name}: {problem}; name another source.")
    return replace(source, stored=tuple(frames), play=None, live=False)


def _held(frame: TimedFrame) -> TimedFrame:
    """Decode a frame now; keep the images, or the error that decoding raised."""
    images: Images | UnreadableImageError
    try:
        images = frame.read(map)
    except UnreadableImageError as error:
        images = error

    def read(image_map: ImageMap) -> Images:
        if isinstance(images, UnreadableImageError):
            raise images
        return images

    return replace(frame, read=read, sides=None)
