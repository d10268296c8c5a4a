"""Decodes and perturbs frames and extracts their features, a few frames ahead of tracking.

Each frame is prepared independently of the others by a small thread pool, and the order is kept, so
that the result does not depend on the number of threads. In real time, a frame is prepared when it
arrives, its two images in parallel. Frames that arrive too fast are dropped; which ones depends on
the machine.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from vslam.camera import DepthImage, Image, ImageMap
from vslam.datasets.frames import TimedFrame
from vslam.errors import DroppedFrameError, UnreadableImageError
from vslam.frontend.extraction import FrameImages
from vslam.frontend.sides import Sides, compare_sides
from vslam.frontend.tracking import TrackingContext
from vslam.run.outcome import RunSettings
from vslam.run.realtime import Played, play


@dataclass(frozen=True)
class PreparedFrame:
    """A frame ready to be tracked, or the reason why it cannot be read; ``dropped`` tells
    whether a perturbation dropped it."""

    images: FrameImages | None
    stage_ms: dict[str, float]
    problem: str | None = None
    dropped: bool = False
    sides: Sides = field(default_factory=Sides)


def in_their_time(
    frames: Iterator[TimedFrame], context: TrackingContext, settings: RunSettings, *, live: bool
) -> Iterator[Played[PreparedFrame]]:
    """Prepared frames with their arrival times: at once, or in real time each at its own time."""
    if settings.realtime:
        with ThreadPoolExecutor(2, "side") as pool:
            image_map = map if settings.threads == 1 else pool.map
            yield from play(
                frames,
                lambda frame: prepare_frame(frame, context, image_map),
                settings.threads,
                live=live,
            )
        return
    start = time.perf_counter()
    for timestamp, prepared in prepared_frames(frames, context, settings.threads):
        yield Played(timestamp, prepared, start)


def prepared_frames(
    frames: Iterator[TimedFrame], context: TrackingContext, threads: int
) -> Iterator[tuple[float, PreparedFrame]]:
    """Frames in order with their times; with more than one thread, prepared a few frames ahead."""
    if threads == 1:
        for frame in frames:
            yield frame.timestamp, prepare_frame(frame, context)
        return
    ahead: deque[tuple[float, Future[PreparedFrame]]] = deque()
    with ThreadPoolExecutor(threads, "extraction") as pool:
        try:
            for frame in frames:
                ahead.append((frame.timestamp, pool.submit(prepare_frame, frame, context)))
                if len(ahead) == 2 * threads:
                    timestamp, prepared = ahead.popleft()
                    yield timestamp, prepared.result()
            for timestamp, prepared in ahead:
                yield timestamp, prepared.result()
        finally:
            pool.shutdown(cancel_futures=True)


def prepare_frame(
    frame: TimedFrame, context: TrackingContext, image_map: ImageMap = map
) -> PreparedFrame:
    """Read one frame and extract its features."""
    start = time.perf_counter()
    try:
        left, second = frame.read(image_map)
    except UnreadableImageError as error:
        dropped = isinstance(error, DroppedFrameError)
        return PreparedFrame(None, {}, str(error), dropped)
    read = time.perf_counter()
    sides = _sides(left, second, context)
    images = FrameImages(left, second, context, image_map, sides)
    if not context.tracks_patches:
        images.extracted  # noqa: B018
    done = time.perf_counter()
    stage_ms = {"read": 1e3 * (read - start), "extract": 1e3 * (done - read)}
    return PreparedFrame(images, stage_ms, sides=sides)


def _sides(left: Image, second: Image | DepthImage | None, context: TrackingContext) -> Sides:
    if second is None or second.dtype != np.uint8:
        return Sides()
    return compare_sides(left, np.asarray(second, np.uint8), context.config.stereo)
