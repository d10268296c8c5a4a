"""Sources whose frames come one after the other: videos, bags and cameras."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Protocol, runtime_checkable

from vslam.camera import Camera, DepthImage, Image, ImageMap
from vslam.datasets.sequence import Sequence
from vslam.errors import InputError

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TimedFrame:
    """A frame that has come and is yet to be decoded.

    Attributes:
        timestamp: seconds.
        read: as :meth:`vslam.datasets.sequence.Sequence.read` of this frame: decodes, once, in any
            thread; raises UnreadableImageError.
    """

    timestamp: float
    read: Callable[[ImageMap], tuple[Image, Image | DepthImage | None]]


class RawStream(Protocol):
    """A `Stream` without its camera: the images need not be rectified.

    Attributes:
        sizes: width and height of the images of each side, one of a single camera.
    """

    @property
    def dataset(self) -> str: ...
    @property
    def name(self) -> str: ...
    @property
    def live(self) -> bool: ...
    @property
    def n_expected(self) -> int | None: ...
    @property
    def sizes(self) -> tuple[tuple[int, int], ...]: ...

    def frames(self) -> Iterator[TimedFrame]:
        """As `Stream.frames`, save that times need not increase."""
        ...


@runtime_checkable
class Stream(Protocol):
    """Rectified stereo or left images, each to be had once and in order; how many is known at the
    end. There is no ground truth.

    Attributes:
        dataset: kind of source, ``video`` for example.
        name: of the file or device.
        camera: calibration; ``camera.monocular`` without right images.
        live: frames come at their own times and do not wait: a camera, not a file.
        n_expected: about how many frames there are, None where nobody knows.
    """

    @property
    def dataset(self) -> str: ...
    @property
    def name(self) -> str: ...
    @property
    def camera(self) -> Camera: ...
    @property
    def live(self) -> bool: ...
    @property
    def n_expected(self) -> int | None: ...

    def frames(self) -> Iterator[TimedFrame]:
        """All frames, times strictly increasing; from the first one on at every call, save live.

        No images are held but those of the frame that is handed out.

        Raises:
            BrokenSourceError: after the last good frame of a file cut off or a device unplugged.
        """
        ...


@dataclass(frozen=True)
class Selection:
    """The frames of a stream that ``--start``, ``--every`` and ``--max-frames`` select."""

    start: int = 0
    every: int = 1
    max_frames: int | None = None

    def count(self, whole: int | None) -> int | None:
        """About how many of ``whole`` frames they are, None where nobody knows."""
        if whole is None:
            return self.max_frames
        n = len(range(self.start, whole, self.every))
        return n if self.max_frames is None else min(n, self.max_frames)

    def of(self, frames: Iterator[TimedFrame], name: str) -> Iterator[TimedFrame]:
        """Hand them out, with increasing times; see `increasing`.

        Raises:
            InputError: the stream ends before ``start``.
        """
        frame = None
        stop = None if self.max_frames is None else self.start + self.every * self.max_frames
        for frame in islice(increasing(frames, name), self.start, stop, self.every):
            yield frame
        if frame is None:
            raise InputError(
                f"--start {self.start}: {name} has no frame there; choose a smaller one."
            )


def timed_frames(source: Sequence | Stream) -> Iterator[TimedFrame]:
    """The frames of any source, in order."""
    if isinstance(source, Stream):
        return source.frames()
    return (
        TimedFrame(timestamp, partial(source.read, index))
        for index, timestamp in enumerate(source.timestamps.tolist())
    )


def count_expected(source: Sequence | Stream) -> int | None:
    """About how many frames a source has, None where nobody knows."""
    return source.n_expected if isinstance(source, Stream) else len(source)


def is_live(source: Sequence | Stream) -> bool:
    """Whether frames come at their own times: they cannot be had twice."""
    return isinstance(source, Stream) and source.live


def increasing(frames: Iterator[TimedFrame], name: str) -> Iterator[TimedFrame]:
    """Leave out frames that are not later than the one before them, with a warning each.

    Args:
        frames: as a file or device gives them.
        name: of the source, for the warning.
    """
    last = None
    for frame in frames:
        if last is not None and frame.timestamp <= last:
            _log.warning(
                "%s: a frame of %.6f s is left out, it comes after one of %.6f s",
                name,
                frame.timestamp,
                last,
            )
            continue
        last = frame.timestamp
        yield frame
