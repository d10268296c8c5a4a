"""A map that a job in another thread may write."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from contextlib import contextmanager
from functools import cache
from typing import TypeVar

from vslam.map import Map

T = TypeVar("T")


def mapping_executor(threads: int) -> Executor | None:
    """A second thread for mapping jobs; None if there is only one thread in all."""
    return ThreadPoolExecutor(1, "mapping") if threads > 1 else None


class SharedMap:
    """A map, and the job that may write it; there is at most one job at a time."""

    def __init__(self, map_: Map, executor: Executor | None) -> None:
        """``executor`` runs the jobs; with None, each job runs when its result is needed."""
        self._map = map_
        self._executor = executor
        self._job: Callable[[], None] | None = None
        self._future: Future[None] | None = None
        self._failure = ""
        self._process = os.getpid()

    @property
    def is_busy(self) -> bool:
        """Whether a job may be writing the map."""
        return self._job is not None

    @property
    def map(self) -> Map:
        """The map.

        Raises:
            RuntimeError: a job may be writing it, a job failed, or this process is a fork.
        """
        self._refuse_fork()
        if self._failure:
            raise RuntimeError(self._failure)
        if self._job is not None:
            raise RuntimeError("a keyframe is being mapped: call finish() first")
        return self._map

    def start(self, job: Callable[[Map], None]) -> None:
        """Start a job that may write the map until ``wait`` is called."""
        map_ = self.map
        if self._executor is None:
            self._job = lambda: job(map_)
        else:
            self._future = self._executor.submit(job, map_)
            self._job = self._future.result

    def start_reading(self, job: Callable[[Map], T]) -> Callable[[], T]:
        """Start a job that only reads the map; returns a function that waits for the job's result.
        That function must be called before the map is written again."""
        map_ = self.map
        if self._executor is None:
            return cache(lambda: job(map_))
        future = self._executor.submit(job, map_)

        def result() -> T:
            wait_for([future])  # after Ctrl-C here, a later call can wait again
            return future.result()

        return result

    def wait(self) -> Map:
        """Wait for the job, if there is one, and return the map.

        Raises:
            RuntimeError: an earlier job failed, or this process is a fork. An error of this job is
                raised unchanged.
        """
        self._refuse_fork()
        if self._job is not None:
            if self._future is not None:
                wait_for([self._future])  # after Ctrl-C here, a later call can wait again
            job, self._job = self._job, None
            with self._invalidated_on_error():
                job()
        return self.map

    @contextmanager
    def change(self) -> Iterator[Map]:
        """Wait for the job, if there is one, and yield the map for changes.

        Raises:
            RuntimeError: as ``wait``.
        """
        map_ = self.wait()
        with self._invalidated_on_error():
            yield map_

    @contextmanager
    def _invalidated_on_error(self) -> Iterator[None]:
        """After an exception, which leaves the map incomplete, make every access raise an error."""
        try:
            yield
        except BaseException as error:
            self._failure = (
                f"mapping a keyframe failed ({error!r}), which leaves the map incomplete; continue "
                "from a map that was saved before"
            )
            raise

    def _refuse_fork(self) -> None:
        """Raise an error in a forked process: it lacks the thread that runs the jobs, and would
        wait for it forever."""
        if self._executor is not None and os.getpid() != self._process:
            raise RuntimeError(
                "this Slam was created before the process was forked, which does not copy its "
                "threads; create it after the fork, or use threads=1"
            )
