"""Streams of images as the cameras took them, rectified as they are decoded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

from vslam.calibration.models import Calibration
from vslam.calibration.rectification import Rectification
from vslam.camera import Camera, ImageMap
from vslam.datasets.rectified import rectification_for, rectify_images
from vslam.datasets.sequence import DepthImage, Image
from vslam.datasets.stream import RawStream, Selection, TimedFrame
from vslam.errors import InputError


@dataclass(frozen=True)
class RectifiedStream:
    """See `rectified_stream`."""

    raw: RawStream
    rectification: Rectification
    selection: Selection

    @property
    def dataset(self) -> str:
        return self.raw.dataset

    @property
    def name(self) -> str:
        return self.raw.name

    @property
    def camera(self) -> Camera:
        return self.rectification.camera

    @property
    def live(self) -> bool:
        return self.raw.live

    @property
    def n_expected(self) -> int | None:
        return self.selection.count(self.raw.n_expected)

    def frames(self) -> Iterator[TimedFrame]:
        """See `vslam.datasets.stream.Stream.frames`.

        Raises:
            InputError: the stream ends before ``start``.
        """
        for frame in self.selection.of(self.raw.frames(), self.name):
            yield TimedFrame(frame.timestamp, partial(_read, frame, self.rectification))


def rectified_stream(
    raw: RawStream,
    calibration: Calibration,
    *,
    start: int = 0,
    every: int = 1,
    max_frames: int | None = None,
    depth: bool = False,
) -> RectifiedStream:
    """Every N-th frame of a stream from a first one on, rectified.

    Args:
        depth: see `vslam.datasets.rectified.rectified`.

    Raises:
        InputError: the stream ends before ``start``, or as `vslam.datasets.rectified.rectified`.
    """
    if raw.n_expected is not None and start >= raw.n_expected:
        raise InputError(
            f"--start {start}: {raw.name} has about {raw.n_expected} frames; choose a smaller one."
        )
    rectification = rectification_for(calibration, raw.sizes, depth=depth)
    return RectifiedStream(raw, rectification, Selection(start, every, max_frames))


def _read(
    frame: TimedFrame, rectification: Rectification, image_map: ImageMap
) -> tuple[Image, Image | DepthImage | None]:
    return rectify_images(rectification, *frame.read(image_map), image_map)
