"""Decodes and perturbs frames and extracts their features, a few frames ahead of tracking.

Each frame is prepared independently of the others by a small thread pool, and the order is kept, so
that the result does not depend on the number of threads. In real time, a frame is prepared when it
arrives, its two images in parallel. Frames that arrive too fast are dropped; which ones depends on
the machine.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

from vslam.camera import DepthImage, Image, ImageMap
from vslam.config import OrbConfig
from vslam.datasets.frames import TimedFrame
from vslam.errors import DroppedFrameError, UnreadableImageError
from vslam.frontend.extraction import FrameImages
from vslam.frontend.masks import Mask
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


def in_their_time(
    frames: Iterator[TimedFrame],
    context: TrackingContext,
    settings: RunSettings,
    *,
    live: bool,
    begin: int = 0,
    next_extraction: Callable[[], int] = lambda: -1,
) -> Iterator[Played[PreparedFrame]]:
    """Prepared frames with their arrival times: at once, or in real time each at its own time.

    Args:
        begin: index of the first frame.
        next_extraction: ``Slam.next_extraction``: the features of this frame are extracted ahead.
    """
    if settings.realtime:
        with ThreadPoolExecutor(2, "side") as pool:
            image_map = map if settings.threads == 1 else pool.map

            def prepare(number: int, frame: TimedFrame) -> PreparedFrame:
                prepared = prepare_frame(frame, context, image_map)
                if prepared.images is not None and 0 <= next_extraction() <= begin + number:
                    prepared.images.find_corners()
                return prepared

            yield from play(frames, prepare, settings.threads, live=live)
        return
    start = time.perf_counter()
    ahead = prepared_frames(frames, context, settings.threads, begin, next_extraction)
    for timestamp, prepared in ahead:
        yield Played(timestamp, prepared, start)


def prepared_frames(
    frames: Iterator[TimedFrame],
    context: TrackingContext,
    threads: int,
    begin: int = 0,
    next_extraction: Callable[[], int] = lambda: -1,
) -> Iterator[tuple[float, PreparedFrame]]:
    """Frames in order with their times; with more than one thread, prepared a few frames ahead."""
    if threads == 1:
        for frame in frames:
            yield frame.timestamp, prepare_frame(frame, context)
        return
    ahead: deque[tuple[float, Future[PreparedFrame]]] = deque()
    asked = -1
    with ThreadPoolExecutor(threads, "extraction") as pool:
        try:
            for frame in frames:
                ahead.append((frame.timestamp, pool.submit(prepare_frame, frame, context)))
                if len(ahead) == 2 * threads:
                    timestamp, prepared = ahead.popleft()
                    yield timestamp, prepared.result()
                    begin += 1
                    due = next_extraction()
                    if due > asked and 0 <= due - begin < len(ahead):
                        pool.submit(_find_corners, ahead[due - begin][1])
                        asked = due
            for timestamp, prepared in ahead:
                yield timestamp, prepared.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _find_corners(prepared: Future[PreparedFrame]) -> None:
    images = prepared.result().images
    if images is not None:
        images.find_corners()


def prepare_frame(
    frame: TimedFrame, context: TrackingContext, image_map: ImageMap = map
) -> PreparedFrame:
    """Read one frame and extract its features. If frames are tracked by patches, features and the
    right image wait until tracking asks for them."""
    start = time.perf_counter()
    try:
        read_second: Callable[[], Image | DepthImage | None]
        if context.tracks_patches and frame.sides is not None:
            left, read_second = frame.sides[0](), frame.sides[1]
        else:
            left, second = frame.read(image_map)
            read_second = _giving(second)
        mask = None if frame.mask is None else _mask(frame.mask, context.config.orb)
    except UnreadableImageError as error:
        dropped = isinstance(error, DroppedFrameError)
        return PreparedFrame(None, {}, str(error), dropped)
    read = time.perf_counter()
    images = FrameImages(left, read_second, context, image_map, mask)
    if not context.tracks_patches:
        images.extracted  # noqa: B018
    done = time.perf_counter()
    stage_ms = {"read": 1e3 * (read - start), "extract": 1e3 * (done - read)}
    return PreparedFrame(images, stage_ms)


@lru_cache(maxsize=1)  # the frames of a static mask share its function
def _mask(read: Callable[[], Image], config: OrbConfig) -> Mask:
    return Mask.of(read(), config)


def _giving(second: Image | DepthImage | None) -> Callable[[], Image | DepthImage | None]:
    return lambda: second
