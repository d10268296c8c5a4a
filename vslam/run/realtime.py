"""A recorded sequence played as a camera would send it: a frame that a newer one overtakes is
dropped."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from queue import SimpleQueue
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")


def play(
    timestamps: NDArray[np.float64], prepare: Callable[[int], T], threads: int
) -> Iterator[tuple[int, T, float]]:
    """Frames as they come, each from its time on; of several that wait only the newest is taken.

    One frame is prepared while the one before it is used, so that a frame waits for at most one
    other. The first comes at once.

    Args:
        timestamps: ``(N,)`` seconds, increasing.
        prepare: what is done to a frame when it has come, in a thread of its own.
        threads: with one, a frame is not prepared before the last one was used.

    Yields:
        Its number, what ``prepare`` made of it, and when it came (``time.perf_counter``).
    """
    begin = time.perf_counter()
    arrivals = begin + timestamps - timestamps[0]
    free = threading.Semaphore(min(threads, 2))
    coming: SimpleQueue[tuple[int, Future[T]] | None] = SimpleQueue()
    stop = threading.Event()

    def film(pool: ThreadPoolExecutor) -> None:
        try:
            shoot(pool)
        finally:
            coming.put(None)

    def shoot(pool: ThreadPoolExecutor) -> None:
        following = 0
        while following < len(arrivals):
            free.acquire()
            newest = int(np.searchsorted(arrivals, time.perf_counter(), "right")) - 1
            taken = max(following, newest) if following else 0  # a run begins with the first one
            if stop.wait(max(0.0, arrivals[taken] - time.perf_counter())):
                break
            coming.put((taken, pool.submit(prepare, taken)))
            following = taken + 1

    with ThreadPoolExecutor(min(threads, 2), "extraction") as pool:
        camera = threading.Thread(target=film, args=(pool,), name="camera", daemon=True)
        camera.start()
        try:
            while (frame := coming.get()) is not None:
                index, future = frame
                yield index, future.result(), float(arrivals[index])
                free.release()
        finally:
            stop.set()
            free.release()
            camera.join()
            pool.shutdown(cancel_futures=True)
