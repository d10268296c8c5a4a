"""A map that a job in another thread may write."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

from vslam.support.workers import Job, Urgency, Workers
from vslam.types.map import Map

T = TypeVar("T")


class SharedMap:
    """A map, and the job that may write it. There is at most one such job at a time."""

    def __init__(self, map_: Map, workers: Workers) -> None:
        self._map = map_
        self._workers = workers
        self._job: Job[None] | None = None
        self._failure = ""

    @property
    def is_busy(self) -> bool:
        """Whether a job in another thread may be writing the map."""
        return self._job is not None

    @property
    def map(self) -> Map:
        """The map.

        Raises:
            RuntimeError: a job may be writing the map, an earlier job failed, or this process is a
                fork.
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
        """Start a job that only reads the map. The job must end before the map is written again."""
        return self._workers.submit(partial(job, self.map), Urgency.LOOPS)

    def wait(self) -> Map:
        """Wait for the running job, if there is one, and return the map.

        If the running job fails, its exception is raised unchanged.

        Raises:
            RuntimeError: an earlier job failed, or this process is a fork.
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
        """Do the same as ``wait``, and yield the map for changes."""
        map_ = self.wait()
        with self._invalidated_on_error():
            yield map_

    @contextmanager
    def _invalidated_on_error(self) -> Iterator[None]:
        """If the ``with`` block raises an exception, make every later access to the map raise one.

        The map may then be incomplete.
        """
        try:
            yield
        except BaseException as error:
            self._failure = (
                f"mapping a keyframe failed ({error!r}), which leaves the map incomplete; continue "
                "from a map that was saved before"
            )
            raise
