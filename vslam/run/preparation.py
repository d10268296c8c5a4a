"""Prepares frames before tracking: decoding, perturbation and feature extraction.

A few frames are prepared in advance. Each frame is prepared independently of the other frames.
Therefore, the result does not depend on the number of threads. In a real-time run, a frame is
prepared when it arrives, and its two images are processed in parallel. Frames that arrive too fast
are dropped. Which frames are dropped depends on the speed of the machine.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from queue import SimpleQueue
from typing import Generic, TypeVar

from vslam.config import OrbConfig
from vslam.datasets.frames import TimedFrame
from vslam.frontend.extraction import FrameImages
from vslam.frontend.masks import Mask
from vslam.support.errors import DroppedFrameError, UnreadableImageError
from vslam.support.workers import Job, Urgency, Workers
from vslam.types.camera import DepthImage, Image, ImageMap
from vslam.types.context import Context

T = TypeVar("T")

_AHEAD = 2  # number of frames that are prepared in advance, for each thread


@dataclass(frozen=True)
class Played(Generic[T]):
    """A frame that has arrived, either prepared or dropped.

    Attributes:
        timestamp: seconds.
        prepared: the prepared frame. None if the frame was dropped because a newer frame arrived.
        arrived: time of arrival, measured with ``time.perf_counter``.
    """

    timestamp: float
    prepared: T | None
    arrived: float


@dataclass(frozen=True)
class _Arrival:
    frame: TimedFrame
    arrived: float


def play(
    frames: Iterator[TimedFrame],
    prepare: Callable[[int, TimedFrame], T],
    threads: int,
    *,
    live: bool = False,
) -> Iterator[Played[T]]:
    """Play frames in real time. If several frames are waiting, only the newest frame is prepared.

    While the caller uses one frame, the next frame is prepared.

    Args:
        frames: frames to play. The first frame arrives at once. The other frames arrive at their
            timestamps.
        prepare: function that prepares a frame after its arrival, in a separate thread. Its first
            argument is the number of frames that arrived earlier, including dropped frames.
        threads: number of threads. If it is 1, a frame is prepared only after the previous frame
            has been used.
        live: whether each frame arrives when ``frames`` yields it, regardless of its timestamp.

    Yields:
        Every frame in order. Dropped frames come directly before the frame that replaced them.

    Raises:
        Exception: ``prepare`` or ``frames`` raised this exception. The exception is passed on after
            all earlier frames have been yielded.
    """
    free = threading.Semaphore(min(threads, 2))
    mailbox = _Mailbox()
    queue: SimpleQueue[tuple[list[Played[T]], _Arrival, Future[T]] | Exception | None] = (
        SimpleQueue()
    )

    def receive_frames() -> None:
        try:
            begin = None
            for frame in frames:
                arrived = time.perf_counter()
                if not live:
                    begin = arrived - frame.timestamp if begin is None else begin
                    arrived = begin + frame.timestamp
                    mailbox.wait_until(arrived)
                if mailbox.stopped:
                    return
                mailbox.put(_Arrival(frame, arrived))
            mailbox.end(None)
        except Exception as error:
            mailbox.end(error)

    def start_preparing(pool: ThreadPoolExecutor) -> None:
        n = 0
        try:
            while True:
                free.acquire()
                dropped, newest = mailbox.take()
                if newest is None:
                    queue.put(mailbox.error)
                    return
                missed = [Played[T](timestamp, None, newest.arrived) for timestamp in dropped]
                n += len(dropped)
                queue.put((missed, newest, pool.submit(prepare, n, newest.frame)))
                n += 1
        except Exception as error:  # otherwise the consumer would wait forever
            queue.put(error)

    with ThreadPoolExecutor(min(threads, 2), "extraction") as pool:
        receiver = threading.Thread(target=receive_frames, name="camera", daemon=True)
        starter = threading.Thread(
            target=start_preparing, args=(pool,), name="preparation", daemon=True
        )
        receiver.start()
        starter.start()
        try:
            while (item := queue.get()) is not None:
                if isinstance(item, Exception):
                    raise item
                missed, newest, future = item
                yield from missed
                yield Played(newest.frame.timestamp, future.result(), newest.arrived)
                free.release()
        finally:
            mailbox.stop()
            free.release()
            receiver.join()
            starter.join()
            pool.shutdown(cancel_futures=True)


class _Mailbox:
    """Passes the newest frame from the thread that receives frames to the thread that uses them."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._newest: _Arrival | None = None
        self._dropped: list[float] = []  # times of frames dropped since the last frame was taken
        self._first = True
        self._ended = False
        self.stopped = False
        self.error: Exception | None = None

    def put(self, arrival: _Arrival) -> None:
        """Replace the frame in the mailbox with a newer frame.

        The first frame of a run must not be replaced. Therefore, wait until it has been taken.
        """
        with self._changed:
            if self._newest is not None:
                self._dropped.append(self._newest.frame.timestamp)
            self._newest = arrival
            self._changed.notify_all()
            self._changed.wait_for(lambda: not self._first or self.stopped)

    def take(self) -> tuple[list[float], _Arrival | None]:
        """Wait for a frame. Return the timestamps of the dropped frames, and the newest frame.

        After the last frame, the method returns None instead of a frame.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._newest or self._ended or self.stopped)
            newest, self._newest = (None if self.stopped else self._newest), None
            dropped, self._dropped = self._dropped, []
            self._first = False
            self._changed.notify_all()
            return dropped, newest

    def wait_until(self, when: float) -> None:
        """Sleep until ``time.perf_counter`` reaches a value, or until ``stop`` is called."""
        with self._changed:
            self._changed.wait_for(lambda: self.stopped, max(0.0, when - time.perf_counter()))

    def end(self, error: Exception | None) -> None:
        """Announce that no more frames will arrive, because of ``error`` or at the regular end."""
        with self._changed:
            self._ended, self.error = True, error
            self._changed.notify_all()

    def stop(self) -> None:
        """Announce that no more frames will be taken."""
        with self._changed:
            self.stopped = True
            self._changed.notify_all()


@dataclass(frozen=True)
class PreparedFrame:
    """A frame that is ready to be tracked, or the reason why it cannot be read.

    Attributes:
        images: the images and their features. None if the frame cannot be read.
        stage_ms: milliseconds that reading the images and extracting the features took.
        problem: the reason why the frame cannot be read. None if it can be read.
        dropped: whether the frame is missing because a perturbation dropped it.
    """

    images: FrameImages | None
    stage_ms: dict[str, float]
    problem: str | None = None
    dropped: bool = False


class FramesAhead:
    """Prepared frames in order, each with its time of arrival.

    In a real-time run, a frame arrives at its timestamp. In other runs, all frames count as arrived
    at the start of the run. If there are several threads, some frames are prepared in advance.
    """

    def __init__(
        self,
        frames: Iterator[TimedFrame],
        context: Context,
        workers: Workers,
        *,
        realtime: bool,
        live: bool,
        begin: int = 0,
    ) -> None:
        """
        Args:
            live: see ``play``.
            begin: index of the first frame.
        """
        self._frames = frames
        self._context = context
        self._workers = workers
        self._realtime = realtime
        self._live = live
        self._begin = begin
        self._requested = -1

    def request(self, index: int) -> None:
        """Extract the features of a later frame in advance (``TrackResult.next_extraction``)."""
        self._requested = index

    def __iter__(self) -> Iterator[Played[PreparedFrame]]:
        return self._as_they_arrive() if self._realtime else self._in_advance()

    def _as_they_arrive(self) -> Iterator[Played[PreparedFrame]]:
        threads = self._workers.threads
        with ThreadPoolExecutor(2, "side") as pool:
            image_map = map if threads == 1 else pool.map

            def prepare(number: int, frame: TimedFrame) -> PreparedFrame:
                prepared = prepare_frame(frame, self._context, image_map)
                is_due = 0 <= self._requested <= self._begin + number
                if prepared.images is not None and is_due and threads > 1:
                    prepared.images.start_corners(self._workers)
                return prepared

            yield from play(self._frames, prepare, threads, live=self._live)

    def _in_advance(self) -> Iterator[Played[PreparedFrame]]:
        workers, start, begin, started = self._workers, time.perf_counter(), self._begin, -1
        ahead: deque[tuple[float, Job[PreparedFrame]]] = deque()
        n_ahead = _AHEAD * workers.threads if workers.threads > 1 else 1
        try:
            for frame in self._frames:
                prepare = partial(prepare_frame, frame, self._context)
                ahead.append((frame.timestamp, workers.submit(prepare, Urgency.READING)))
                if len(ahead) == n_ahead:
                    timestamp, prepared = ahead.popleft()
                    yield Played(timestamp, prepared.result(), start)
                    begin += 1
                    due = self._requested
                    if due > started and 0 <= due - begin < len(ahead):
                        images = ahead[due - begin][1].result().images
                        if images is not None:
                            images.start_corners(workers)
                        started = due
            for timestamp, prepared in ahead:
                yield Played(timestamp, prepared.result(), start)
        finally:
            for _, prepared in reversed(ahead):
                prepared.cancel()


def prepare_frame(frame: TimedFrame, context: Context, image_map: ImageMap = map) -> PreparedFrame:
    """Read one frame and extract its features.

    Tracking by patches needs the right image and the features only for some frames. Therefore, only
    the left image is read in this case.
    """
    start = time.perf_counter()
    try:
        read_second: Callable[[], Image | DepthImage | None]
        if context.tracks_patches and frame.sides is not None:
            left, read_second = frame.sides[0](), frame.sides[1]
        else:
            left, second = frame.read(image_map)
            read_second = _returning(second)
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


@lru_cache(maxsize=1)  # frames that share a static mask pass the same function
def _mask(read: Callable[[], Image], config: OrbConfig) -> Mask:
    return Mask.of(read(), config)


def _returning(second: Image | DepthImage | None) -> Callable[[], Image | DepthImage | None]:
    return lambda: second
