"""Playback of frames in real time: a frame is dropped if a newer one arrives before it is used."""

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
    """A frame that was played.

    Attributes:
        timestamp: its time, seconds.
        made: the prepared frame; None if the frame was dropped.
        came: its arrival by ``time.perf_counter``.
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
    prepare: Callable[[int, TimedFrame], T],
    threads: int,
    *,
    live: bool = False,
) -> Iterator[Played[T]]:
    """Play frames at their own times; if several are waiting, only the newest is prepared.

    One frame is prepared while the previous one is used, so that a frame waits for at most one
    other. Dropped frames are not kept in memory.

    Args:
        frames: frames to play; the first one arrives at once, the others at their timestamps.
        prepare: function that prepares a frame after its arrival, called in a separate thread. Its
            first argument is the number of frames that arrived before, dropped ones included.
        threads: with 1, a frame is prepared only after the previous one was used.
        live: each frame arrives when ``frames`` yields it.

    Yields:
        Every frame in order; dropped frames come just before the one that replaced them.

    Raises:
        Exception: raised by ``prepare`` or ``frames``, after all earlier frames were yielded.
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
        n = 0
        try:
            while True:
                free.acquire()
                dropped, newest = mailbox.take()
                if newest is None:
                    coming.put(mailbox.error)
                    return
                missed = [Played[T](timestamp, None, newest.came) for timestamp in dropped]
                n += len(dropped)
                coming.put((missed, newest, pool.submit(prepare, n, newest.frame)))
                n += 1
        except Exception as error:  # otherwise the consumer would wait for ever
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
    """Holds the newest frame, between the thread that plays frames and the one that uses them."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._newest: _Arrival | None = None
        self._dropped: list[float] = []  # times of frames dropped since the last one was taken
        self._first = True
        self._ended = False
        self.stopped = False
        self.error: Exception | None = None

    def put(self, arrival: _Arrival) -> None:
        """Replace the newest frame, but wait until the first frame of a run has been taken."""
        with self._changed:
            if self._newest is not None:
                self._dropped.append(self._newest.frame.timestamp)
            self._newest = arrival
            self._changed.notify_all()
            self._changed.wait_for(lambda: not self._first or self.stopped)

    def take(self) -> tuple[list[float], _Arrival | None]:
        """The times of the dropped frames, and the newest frame (None after the last one)."""
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
        """Announce the end of the frames, with the error that caused it."""
        with self._changed:
            self._ended, self.error = True, error
            self._changed.notify_all()

    def stop(self) -> None:
        """Announce that no more frames will be taken."""
        with self._changed:
            self.stopped = True
            self._changed.notify_all()
