"""Sequences and streams that a reader of another package opens, checked as vslam's own are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, DepthImage, Image, ImageMap
from vslam.datasets.image_files import select_frames
from vslam.datasets.sequence import Sequence
from vslam.datasets.stream import Selection, Stream, TimedFrame
from vslam.errors import BrokenSourceError, InputError, UnreadableImageError
from vslam.plugins import PlugIn, reason

_Raw = TypeVar("_Raw", Sequence, Stream)


@dataclass(frozen=True)
class _Opened(Generic[_Raw]):
    """What a package has opened.

    Attributes:
        raw: as the package opened it.
        camera: its own, or the left one of it.
    """

    plugin: PlugIn
    root: Path
    raw: _Raw
    camera: Camera

    @property
    def dataset(self) -> str:
        return self.plugin.name

    @property
    def name(self) -> str:
        return str(self.raw.name)


@dataclass(frozen=True)
class PlugInSequence(_Opened[Sequence]):
    """The selected frames of a sequence that a package has opened; see `Sequence`.

    Attributes:
        chosen: ``(N,)`` int64, those selected.
    """

    chosen: NDArray[np.int64]

    @property
    def timestamps(self) -> NDArray[np.float64]:
        return np.asarray(self.raw.timestamps, np.float64)[self.chosen]

    @property
    def ground_truth(self) -> NDArray[np.float64] | None:
        truth = self.raw.ground_truth
        return None if truth is None else np.asarray(truth, np.float64)[self.chosen]

    def __len__(self) -> int:
        return len(self.chosen)

    def read(
        self, index: int, image_map: ImageMap = map
    ) -> tuple[Image, Image | DepthImage | None]:
        """See `Sequence.read`; whatever fails in the package costs this frame alone."""
        number = int(self.chosen[index])
        read = partial(self.raw.read, number)
        return _read(self.plugin, self.root, self.camera, read, f"frame {number}", image_map)


@dataclass(frozen=True)
class PlugInStream(_Opened[Stream]):
    """The selected frames of a stream that a package has opened; see `Stream`."""

    selection: Selection

    @property
    def live(self) -> bool:
        return bool(self.raw.live)

    @property
    def n_expected(self) -> int | None:
        whole = self.raw.n_expected
        return self.selection.count(None if whole is None else int(whole))

    def frames(self) -> Iterator[TimedFrame]:
        """See `Stream.frames`; where the package fails, the stream ends."""
        for frame in self.selection.of(self._all(), self.name):
            at = f"{frame.timestamp:.3f} s"
            read = partial(_read, self.plugin, self.root, self.camera, frame.read, at)
            yield TimedFrame(frame.timestamp, read)

    def _all(self) -> Iterator[TimedFrame]:
        frames = self.plugin.guarded(self.raw.frames)
        while True:
            try:
                frame = next(frames)
                timestamp, read = float(frame.timestamp), frame.read
            except StopIteration:
                return
            except (InputError, BrokenSourceError):
                raise
            except Exception as error:  # a package of other people raises what it likes
                raise BrokenSourceError(f"{self.plugin} failed ({reason(error)}).") from error
            if not np.isfinite(timestamp):
                raise BrokenSourceError(f"{self.plugin} gave a frame of {timestamp} s.")
            yield TimedFrame(timestamp, read)


def _read(
    plugin: PlugIn,
    root: Path,
    camera: Camera,
    read: Callable[[ImageMap], tuple[Image, Image | DepthImage | None]],
    at: str,
    image_map: ImageMap,
) -> tuple[Image, Image | DepthImage | None]:
    """A frame as the package gives it, if it has the camera's size and type."""
    try:
        left, second = read(image_map)
    except UnreadableImageError:
        raise
    except Exception as error:  # a package of other people raises what it likes
        raise UnreadableImageError(root, f"{plugin} failed at {at} ({reason(error)}).") from error
    second = None if camera.monocular else second
    wrong = _wrong_images(left, second, camera)
    if wrong:
        raise UnreadableImageError(root, f"{plugin} gave {wrong} at {at}.")
    return left, second


def open_plugin(
    plugin: PlugIn,
    root: Path,
    name: str | None,
    *,
    start: int,
    every: int,
    max_frames: int | None,
    monocular: bool,
) -> PlugInSequence | PlugInStream:
    """Let the package open a sequence or a stream, and select frames of it.

    Raises:
        InputError: as the reader says; the package is broken, or what it gives is no sequence.
        UnreadableImageError: the first frame cannot be read.
    """
    raw = plugin.call(root, name)
    streams = hasattr(raw, "frames") and not hasattr(raw, "read")
    wrong = plugin.guarded(_wrong_stream if streams else _wrong_sequence, raw)
    if wrong:
        raise InputError(f"{plugin}: {wrong}; repair or uninstall the package.")
    if streams:
        if start < 0 or every < 1 or (max_frames is not None and max_frames < 1):
            raise InputError("--start must be at least 0, --every and --max-frames at least 1.")
        camera = raw.camera.left_camera() if monocular else raw.camera
        return PlugInStream(plugin, root, raw, camera, Selection(start, every, max_frames))
    chosen = select_frames(root, len(raw), start, every, max_frames)
    camera = raw.camera.left_camera() if monocular else raw.camera
    sequence = PlugInSequence(plugin, root, raw, camera, chosen)
    sequence.read(0)
    return sequence


def _wrong_sequence(raw: Sequence) -> str:
    """What is wrong with a sequence; empty if nothing is."""
    for name in ("name", "camera", "timestamps", "ground_truth", "read", "__len__"):
        if not hasattr(raw, name):
            return f"{type(raw).__name__} has no {name}"
    n = len(raw)
    if not isinstance(raw.camera, Camera):
        return f"camera is {type(raw.camera).__name__}, no vslam.camera.Camera"
    times = np.asarray(raw.timestamps, np.float64)
    if times.shape != (n,) or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        return f"timestamps are not {n} increasing seconds"
    truth = raw.ground_truth
    if truth is not None and np.shape(truth) != (n, 4, 4):
        return f"ground_truth is of shape {np.shape(truth)}, not ({n}, 4, 4)"
    return "" if n else "the sequence has no frame"


def _wrong_stream(raw: Stream) -> str:
    """What is wrong with a stream; empty if nothing is."""
    for name in ("name", "camera", "live", "n_expected"):
        if not hasattr(raw, name):
            return f"{type(raw).__name__} has no {name}"
    if not isinstance(raw.camera, Camera):
        return f"camera is {type(raw.camera).__name__}, no vslam.camera.Camera"
    n = raw.n_expected
    return (
        "" if n is None or (isinstance(n, int) and n > 0) else "n_expected is no number of frames"
    )


def _wrong_images(left: Image, second: Image | DepthImage | None, camera: Camera) -> str:
    kinds: list[np.dtype[Any]] = [np.dtype(np.uint8)]
    if not camera.monocular:
        kinds.append(np.dtype(np.float32 if camera.depth else np.uint8))
    images = [left] if second is None else [left, second]
    found = [(getattr(x, "dtype", None), getattr(x, "shape", None)) for x in images]
    if found == [(kind, (camera.height, camera.width)) for kind in kinds]:
        return ""
    return f"{' and '.join(f'{kind} {shape}' for kind, shape in found)}"
