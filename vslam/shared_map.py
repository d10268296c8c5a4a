"""A map that a job in another thread may write."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

from vslam.map import Map
from vslam.workers import Job, Urgency, Workers

T = TypeVar("T")


class SharedMap:
    """A map, and the job that may write it; there is at most one job at a time."""

    def __init__(self, map_: Map, workers: Workers) -> None:
        self._map = map_
        self._workers = workers
        self._job: Job[None] | None = None
        self._failure = ""

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
        self._workers.refuse_fork()
        if self._failure:
            raise RuntimeError(self._failure)
        if self._job is not None:
            raise RuntimeError("a keyframe is being mapped: call finish() first")
        return self._map

    def start(self, job: Callable[[Map], None]) -> None:
        """Start a job that may write the map until ``wait`` is called."""
        self._job = self._workers.submit(partial(job, self.map), Urgency.MAPPING)

    def start_reading(self, job: Callable[[Map], T]) -> Job[T]:
        """Start a job that only reads the map. It must be done before the map is written again."""
        return self._workers.submit(partial(job, self.map), Urgency.LOOPS)

    def wait(self) -> Map:
        """Wait for the job, if there is one, and return the map.

        Raises:
            RuntimeError: an earlier job failed, or this process is a fork. An error of this job is
                raised unchanged.
        """
        self._workers.refuse_fork()
        if self._job is not None:
            self._job.wait()
            job, self._job = self._job, None
            with self._invalidated_on_error():
                job.result()
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
