"""Streams of images as the cameras took them, rectified as they are decoded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice

import numpy as np

from vslam.calibration.models import Calibration
from vslam.calibration.rectification import Rectification, rectify
from vslam.camera import Camera, ImageMap
from vslam.datasets.sequence import Image
from vslam.datasets.stream import RawStream, TimedFrame, increasing
from vslam.errors import InputError


@dataclass(frozen=True)
class RectifiedStream:
    """See `rectified_stream`."""

    raw: RawStream
    rectification: Rectification
    start: int
    every: int
    max_frames: int | None

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
        whole = self.raw.n_expected
        if whole is None:
            return self.max_frames
        n = len(range(self.start, whole, self.every))
        return n if self.max_frames is None else min(n, self.max_frames)

    def frames(self) -> Iterator[TimedFrame]:
        """See `vslam.datasets.stream.Stream.frames`."""
        stop = None if self.max_frames is None else self.start + self.every * self.max_frames
        for frame in islice(increasing(self.raw.frames(), self.name), self.start, stop, self.every):
            yield TimedFrame(frame.timestamp, partial(_read, frame, self.rectification))


def rectified_stream(
    raw: RawStream,
    calibration: Calibration,
    *,
    start: int = 0,
    every: int = 1,
    max_frames: int | None = None,
) -> RectifiedStream:
    """Every N-th frame of a stream from a first one on, rectified.

    Raises:
        InputError: the images are not of the calibrated size, there is no calibration of the
            right one, the stream ends before ``start``, or as
            `vslam.calibration.rectification.rectify`.
    """
    if len(raw.sizes) == 1 and calibration.right is not None:
        calibration = calibration.left_alone()
    if len(raw.sizes) == 2 and calibration.right is None:
        raise InputError(
            f"{calibration.source}: the calibration of the right camera is missing; give that of "
            "both, or run on the left camera alone with --sensor mono."
        )
    models = [model for model in (calibration.left, calibration.right) if model is not None]
    for model, (width, height) in zip(models, raw.sizes, strict=True):
        if (model.width, model.height) != (width, height):
            raise InputError(
                f"{calibration.source}: made for {model.width}x{model.height} pixels but the "
                f"images have {width}x{height}; take the calibration of these images."
            )
    if raw.n_expected is not None and start >= raw.n_expected:
        raise InputError(f"--start {start}: {raw.name} has about {raw.n_expected} frames.")
    return RectifiedStream(raw, rectify(calibration), start, every, max_frames)


def _read(
    frame: TimedFrame, rectification: Rectification, image_map: ImageMap
) -> tuple[Image, Image | None]:
    left, right = frame.read(image_map)
    sides = [partial(rectification.left, left)]
    if right is not None:
        sides.append(partial(rectification.right, np.asarray(right, np.uint8)))
    left, *rest = image_map(partial.__call__, sides)
    return left, rest[0] if rest else None
