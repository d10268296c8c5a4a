"""A map that a job in another thread may be writing."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from contextlib import contextmanager

from vslam.map import Map


def mapping_executor(threads: int) -> Executor | None:
    """What runs mapping jobs: a thread beside tracking, or nothing with one thread in all."""
    return ThreadPoolExecutor(1, "mapping") if threads > 1 else None


class SharedMap:
    """A map and the job that is working on it, of which there is one at a time."""

    def __init__(self, map_: Map, executor: Executor | None) -> None:
        """``executor``: runs the jobs; None runs each where its result is needed."""
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
            RuntimeError: a job may be writing it, or one failed, or this process is a fork.
        """
        self._refuse_fork()
        if self._failure:
            raise RuntimeError(self._failure)
        if self._job is not None:
            raise RuntimeError("a keyframe is being mapped: call finish() first")
        return self._map

    def start(self, job: Callable[[Map], None]) -> None:
        """Leave the map to a job until ``wait`` is called."""
        map_ = self.map
        if self._executor is None:
            self._job = lambda: job(map_)
        else:
            self._future = self._executor.submit(job, map_)
            self._job = self._future.result

    def wait(self) -> Map:
        """The map, once the job is done.

        Raises:
            RuntimeError: an earlier job failed, or this process is a fork. This job's own error is
                raised as it is.
        """
        self._refuse_fork()
        if self._job is not None:
            if self._future is not None:
                wait_for([self._future])  # Ctrl-C here leaves the job to be waited for again
            job, self._job = self._job, None
            with self._invalidated_on_error():
                job()
        return self.map

    @contextmanager
    def change(self) -> Iterator[Map]:
        """The map, once no job is working on it, to be changed.

        Raises:
            RuntimeError: as ``wait``.
        """
        map_ = self.wait()
        with self._invalidated_on_error():
            yield map_

    @contextmanager
    def _invalidated_on_error(self) -> Iterator[None]:
        """After an exception, the map is incomplete: every later access raises."""
        try:
            yield
        except BaseException as error:
            self._failure = (
                f"mapping a keyframe failed ({error!r}), which leaves the map incomplete; continue "
                "from a map that was saved before"
            )
            raise

    def _refuse_fork(self) -> None:
        """A fork has no copy of the thread that does the jobs: it would wait for ever."""
        if self._executor is not None and os.getpid() != self._process:
            raise RuntimeError(
                "this Slam was made by another process, whose threads a fork does not copy; make "
                "one after the fork, or use threads=1"
            )
