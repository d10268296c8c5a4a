"""Frames as a camera sends them: one that a newer one overtakes is dropped."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Generic, TypeVar

from vslam.datasets.frames import TimedFrame

T = TypeVar("T")


@dataclass(frozen=True)
class Played(Generic[T]):
    """What became of a frame.

    Attributes:
        timestamp: seconds, of the frame.
        made: what was prepared of it, or None: it was dropped.
        came: when it came (``time.perf_counter``).
    """

    timestamp: float
    made: T | None
    came: float


@dataclass(frozen=True)
class _Arrival:
    frame: TimedFrame
    came: float


def play(
    frames: Iterator[TimedFrame],
    prepare: Callable[[TimedFrame], T],
    threads: int,
    *,
    live: bool = False,
) -> Iterator[Played[T]]:
    """Frames as they come; of several that wait only the newest is prepared.

    One frame is prepared while the one before it is used, so that a frame waits for at most one
    other. A frame that waits is held, one that was dropped is not.

    Args:
        frames: waited for, each from its time on; the first comes at once.
        prepare: what is done to a frame when it has come, in a thread of its own.
        threads: with one, a frame is not prepared before the last one was used.
        live: each frame comes when ``frames`` yields it.

    Yields:
        Every frame in order, dropped ones just before the one that overtook them.

    Raises:
        Exception: of ``prepare`` or ``frames``, after all frames before it.
    """
    free = threading.Semaphore(min(threads, 2))
    mailbox = _Mailbox()
    coming: SimpleQueue[tuple[list[Played[T]], _Arrival, Future[T]] | Exception | None] = (
        SimpleQueue()
    )

    def film() -> None:
        try:
            begin = None
            for frame in frames:
                came = time.perf_counter()
                if not live:
                    begin = came - frame.timestamp if begin is None else begin
                    came = begin + frame.timestamp
                    mailbox.wait_until(came)
                if mailbox.stopped:
                    return
                mailbox.put(_Arrival(frame, came))
            mailbox.end(None)
        except Exception as error:
            mailbox.end(error)

    def hand_on(pool: ThreadPoolExecutor) -> None:
        try:
            while True:
                free.acquire()
                dropped, newest = mailbox.take()
                if newest is None:
                    coming.put(mailbox.error)
                    return
                missed = [Played[T](timestamp, None, newest.came) for timestamp in dropped]
                coming.put((missed, newest, pool.submit(prepare, newest.frame)))
        except Exception as error:  # nobody else would end the wait for the next frame
            coming.put(error)

    with ThreadPoolExecutor(min(threads, 2), "extraction") as pool:
        camera = threading.Thread(target=film, name="camera", daemon=True)
        handing = threading.Thread(target=hand_on, args=(pool,), name="handing", daemon=True)
        camera.start()
        handing.start()
        try:
            while (arrived := coming.get()) is not None:
                if isinstance(arrived, Exception):
                    raise arrived
                missed, newest, future = arrived
                yield from missed
                yield Played(newest.frame.timestamp, future.result(), newest.came)
                free.release()
        finally:
            mailbox.stop()
            free.release()
            camera.join()
            handing.join()
            pool.shutdown(cancel_futures=True)


class _Mailbox:
    """Between the thread that films and the one that hands on: holds the newest frame alone."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._newest: _Arrival | None = None
        self._dropped: list[float] = []  # times of frames overtaken since the last one was taken
        self._first = True
        self._ended = False
        self.stopped = False
        self.error: Exception | None = None

    def put(self, arrival: _Arrival) -> None:
        """Replace the newest frame; the first of a run is always taken."""
        with self._changed:
            if self._newest is not None:
                self._dropped.append(self._newest.frame.timestamp)
            self._newest = arrival
            self._changed.notify_all()
            self._changed.wait_for(lambda: not self._first or self.stopped)

    def take(self) -> tuple[list[float], _Arrival | None]:
        """The newest frame and the times of those it overtook; None after the last one."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest or self._ended or self.stopped)
            newest, self._newest = (None if self.stopped else self._newest), None
            dropped, self._dropped = self._dropped, []
            self._first = False
            self._changed.notify_all()
            return dropped, newest

    def wait_until(self, when: float) -> None:
        """Sleep until a time of ``time.perf_counter``, or until stopped."""
        with self._changed:
            self._changed.wait_for(lambda: self.stopped, max(0.0, when - time.perf_counter()))

    def end(self, error: Exception | None) -> None:
        """Say that there are no more frames, and why."""
        with self._changed:
            self._ended, self.error = True, error
            self._changed.notify_all()

    def stop(self) -> None:
        """Say that nobody takes frames any more."""
        with self._changed:
            self.stopped = True
            self._changed.notify_all()
