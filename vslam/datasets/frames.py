"""Sources of frames. A reader opens a source, and a run takes its images from the source.

Every source yields its frames in the order of their times. The frames of image files can also be
read in any order. A video, a bag or a camera is a *stream*: its frames can only be read in order.

A reader returns a `RawSource` if the images still have to be rectified (by
`vslam.datasets.rectified`), and a `Source` if they are rectified already.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from collections.abc import Sequence as Several
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.models import Calibration
from vslam.datasets.association import Pairing
from vslam.datasets.imu import Imu
from vslam.datasets.times import Timing, in_order
from vslam.support.errors import BrokenSourceError, InputError, UnreadableImageError
from vslam.types.camera import Camera, DepthImage, Image, ImageMap

Images = tuple[Image, Image | DepthImage | None]
Size = tuple[int, int]

FIRST_FRAMES = 120  # a few seconds; a stereo pair of 752x480 pixels takes 0.7 MB


@dataclass(frozen=True)
class TimedFrame:
    """A frame whose images are decoded on demand.

    The functions ``read``, ``sides``, ``colour`` and ``mask`` raise UnreadableImageError if a file
    is damaged or if an image has the wrong size. ``read`` can be called in any thread.

    Attributes:
        timestamp: seconds.
        read: function that decodes the left and the second image. Its argument is a map function
            (`vslam.types.camera.ImageMap`), which may decode both images in parallel. The left
            image is ``(H, W)`` uint8. For stereo, the second image is the right image, ``(H, W)``
            uint8. For RGB-D, it is the depth of the left image's pixels, ``(H, W)`` float32
            metres, 0 where the depth is unknown. For a monocular source, it is None.
        sides: a function that decodes only the left image, and a function that decodes only the
            second image. None if both images can only be decoded together, or if there is no second
            image.
        file: file of the left image. None if the image has no file of its own, or if it has to be
            rectified or converted to 8 bits.
        colour: function that decodes the left image in colour, ``(H, W, 3)`` uint8 red, green,
            blue. A grey image is ``(H, W)``. None if the source has no colours.
        name: file name of the left image; None if the image has no file of its own.
        mask: function that reads the mask of the left image, ``(H, W)`` uint8. Pixels at which the
            mask is 0 are not used. None if all pixels are used.
    """

    timestamp: float
    read: Callable[[ImageMap], Images]
    sides: tuple[Callable[[], Image], Callable[[], Image | DepthImage]] | None = None
    file: Path | None = None
    colour: Callable[[], NDArray[np.uint8]] | None = None
    name: str | None = None
    mask: Callable[[], Image] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class _Frames:
    """The attributes that `Source` and `RawSource` share. `Source` describes them."""

    dataset: str
    name: str
    stored: tuple[TimedFrame, ...] = ()
    play: Callable[[], Iterator[TimedFrame]] | None = None
    n_expected: int | None = None
    live: bool = False
    ground_truth: NDArray[np.float64] | None = None
    pairing: Pairing | None = None
    timing: Timing | None = None
    warnings: tuple[str, ...] = ()
    imu: Imu | None = None

    def __post_init__(self) -> None:
        if not self.seekable:
            return
        object.__setattr__(self, "n_expected", len(self.stored))
        times = self.timestamps
        if not len(times) or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise InputError(f"{self.name}: the times of the frames do not increase; correct them.")
        if self.ground_truth is not None and self.ground_truth.shape != (len(times), 4, 4):
            raise ValueError(f"ground_truth must be of shape ({len(times)}, 4, 4)")

    @property
    def seekable(self) -> bool:
        """Whether the frames are stored, so that they can be read in any order."""
        return self.play is None

    def frames(self) -> Iterator[TimedFrame]:
        """Yield all frames in order.

        Each call starts from the first frame, except for a live camera. Only the images of the
        current frame are held in memory.

        Raises:
            BrokenSourceError: a file is truncated or a device was unplugged. All frames before the
                damage are yielded first.
            InputError: the stream ends before the first selected frame.
        """
        return iter(self.stored) if self.play is None else self.play()

    @cached_property
    def timestamps(self) -> NDArray[np.float64]:
        """``(N,)`` float64 times of the frames in seconds, strictly increasing.

        Raises:
            TypeError: the source cannot seek.
        """
        return np.array([frame.timestamp for frame in self._stored()], np.float64)

    def __len__(self) -> int:
        return len(self._stored())

    def read(self, index: int, image_map: ImageMap = map) -> Images:
        """Read the left and the second image of one frame, as described for ``TimedFrame.read``.

        Raises:
            UnreadableImageError: a file is damaged, or its size differs from the calibration.
            TypeError: the source cannot seek.
        """
        return self._stored()[index].read(image_map)

    def _stored(self) -> tuple[TimedFrame, ...]:
        if not self.seekable:
            raise TypeError(f"{self.name}: the frames of a stream can only be read in order")
        return self.stored


@dataclass(frozen=True, kw_only=True, eq=False)
class Source(_Frames):
    """A source of rectified images: stereo pairs, left images only, or images with depth.

    Attributes:
        dataset: kind of source, for example ``kitti`` or ``video``.
        name: name of the sequence, file or device.
        camera: calibration. ``camera.sensor`` tells which images each frame has.
        stored: N frames that can be read in any order, for example from `stored_frames`; empty for
            a stream.
        play: function that yields the frames of a stream; None if the frames are stored.
        n_expected: number of frames. For a stream, it is approximate. None if it is unknown.
        live: whether frames arrive in real time, as from a camera. Such frames are lost if they are
            not read in time.
        ground_truth: ``(N, 4, 4)`` float64 ``T_wc`` of ``camera``, NaN for frames without a pose.
            None if there is no ground truth.
        pairing: how many images were paired with a second image by time, and how many images were
            left out. For a stream, only the images that have been read so far are counted. None if
            images are not paired by time.
        timing: how the times were read, and how many frames were left out because of their times.
            For a stream, only the frames that have been read so far are counted. None if all frames
            have their recorded times.
        warnings: what the report of a run must say about the data, in sentences.
        imu_refused: why a run does not use the IMU of the data, as a sentence; empty if it does.
        imu: the IMU on the camera; None if there is none. Its calibration refers to the left camera
            of ``camera``.
        calibration: calibration of the images before rectification; None if the reader finds them
            rectified.
        rectify_mask: function that rectifies an ``(H, W)`` uint8 mask of the original left images.
            None if vslam does not rectify the images.
        world: name of the world frame of the ground truth, which all drives along a rendered route
            share. Empty if no other sequence has the same world frame.

    Raises:
        InputError: the times of stored frames do not increase.
        ValueError: the ground truth has the wrong shape.
    """

    camera: Camera
    imu_refused: str = ""
    world: str = ""
    calibration: Calibration | None = None
    rectify_mask: Callable[[Image], Image] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class RawSource(_Frames):
    """A source of unrectified images. Its other attributes have the same meaning as in `Source`.

    Attributes:
        sizes: width and height of each camera's images. It has only one entry if the second image
            contains depth.
        depth: whether the second image contains the depth of the first image's pixels.
        ground_truth: poses of the left camera before rectification.
        imu: its calibration refers to the left camera before rectification.
    """

    sizes: tuple[Size, ...]
    depth: bool = False


_AnySource = TypeVar("_AnySource", Source, RawSource)


def stored_frames(
    timestamps: NDArray[np.float64], read: Callable[[int, ImageMap], Images]
) -> tuple[TimedFrame, ...]:
    """Make the stored frames of a source from a function that reads images by frame index.

    Args:
        timestamps: ``(N,)`` float64 seconds, increasing.
        read: function that decodes the images of a frame. Its first argument is the index of the
            frame. Its second argument and its results are the same as for ``TimedFrame.read``.
    """
    return tuple(TimedFrame(time, partial(read, k)) for k, time in enumerate(timestamps.tolist()))


def decoded(sides: Several[Callable[[], Image | DepthImage]], image_map: ImageMap = map) -> Images:
    """Decode the images of a frame, using one function for each image."""
    left, *second = image_map(_call, sides)
    return np.asarray(left, np.uint8), second[0] if second else None


def _call(decode: Callable[[], Image | DepthImage]) -> Image | DepthImage:
    return decode()


def selected(
    source: _AnySource, *, start: int = 0, every: int = 1, max_frames: int | None = None
) -> _AnySource:
    """Select frames of a source. The frames of a stream get increasing times (`in_order`).

    Args:
        start, every, max_frames: read the frames ``start``, ``start + every`` and so on, at most
            ``max_frames`` frames.

    Raises:
        InputError: an option is out of range, or ``start`` is beyond the last frame.
    """
    whole = source.n_expected
    chosen = selection(source.name, whole, start, every, max_frames, exact=source.seekable)
    if source.seekable:
        truth = source.ground_truth
        truth = None if truth is None else truth[chosen]
        return replace(source, stored=source.stored[chosen], ground_truth=truth)
    n = max_frames if whole is None else len(range(*chosen.indices(whole)))
    timing = Timing(source.name)
    play = partial(_play_selected, source, chosen, timing)
    return replace(source, n_expected=n, play=play, timing=timing)


def selection(
    source: str | Path,
    n: int | None,
    start: int,
    every: int,
    max_frames: int | None,
    *,
    exact: bool = True,
) -> slice:
    """Return the slice of at most ``max_frames`` frames: ``start``, ``start + every`` and so on.

    Args:
        source: name of the source or folder of the frames, for error messages.
        n: number of frames, at least 1; None if it is unknown.
        exact: whether ``n`` is exact.

    Raises:
        InputError: an option is out of range, or ``start`` is beyond the last frame.
    """
    if start < 0 or every < 1 or (max_frames is not None and max_frames < 1):
        raise InputError("--start must be at least 0, --every and --max-frames at least 1.")
    if n is not None and start >= n:
        about, most = ("", f"at most {n - 1}") if exact else ("about ", "a smaller number")
        raise InputError(f"--start {start}: {source} has {about}{n} frames; choose {most}.")
    return slice(start, None if max_frames is None else start + every * max_frames, every)


def _play_selected(
    source: Source | RawSource, chosen: slice, timing: Timing
) -> Iterator[TimedFrame]:
    frame = None
    frames = in_order(((frame.timestamp, frame) for frame in source.frames()), timing)
    for timestamp, frame in islice(frames, chosen.start, chosen.stop, chosen.step):
        yield frame if frame.timestamp == timestamp else replace(frame, timestamp=timestamp)
    if frame is None:
        raise InputError(
            f"--start {chosen.start}: {source.name} has no such frame; choose a smaller number."
        )


def frames_at(source: Source, indices: Several[int]) -> Iterator[TimedFrame]:
    """Yield the frames of a source with the given indices. The indices must increase.

    If the source ends earlier, fewer frames are yielded.
    """
    if source.seekable:
        yield from (source.stored[k] for k in indices if k < len(source))
        return
    wanted = set(indices)
    played = islice(source.frames(), max(wanted, default=-1) + 1)
    yield from (frame for k, frame in enumerate(played) if k in wanted)


def first_frames(source: Source, n: int = FIRST_FRAMES) -> Source:
    """Load the first ``n`` frames of a stream into memory, so that they can be read in any order.

    A source whose frames are stored is returned unchanged. If a frame cannot be decoded, the error
    is raised only when this frame is read.

    Raises:
        InputError: the stream has no frames.
    """
    if source.seekable:
        return source
    frames = []
    problem = "it has no frames"
    try:
        for frame in islice(source.frames(), n):
            frames.append(_preloaded(frame))
    except BrokenSourceError as error:
        problem = str(error).rstrip(".")
    if not frames:
        raise InputError(f"{source.name}: {problem}; give another source.")
    return replace(source, stored=tuple(frames), play=None, live=False)


def _preloaded(frame: TimedFrame) -> TimedFrame:
    """Decode a frame now, and keep its images in memory. If decoding fails, keep the error."""
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
