"""A map that a job in another thread may be writing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
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
        self._failure = ""

    @property
    def is_busy(self) -> bool:
        """Whether a job may be writing the map."""
        return self._job is not None

    @property
    def map(self) -> Map:
        """The map.

        Raises:
            RuntimeError: a job may be writing it, or one failed.
        """
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
            future: Future[None] = self._executor.submit(job, map_)
            self._job = future.result

    def wait(self) -> Map:
        """The map, once the job is done.

        Raises:
            RuntimeError: an earlier job failed. This one's own error is raised as it is.
        """
        if self._job is not None:
            job, self._job = self._job, None
            with self._whole():
                job()
        return self.map

    @contextmanager
    def change(self) -> Iterator[Map]:
        """The map, once no job is working on it, to be changed.

        Raises:
            RuntimeError: as ``wait``.
        """
        map_ = self.wait()
        with self._whole():
            yield map_

    @contextmanager
    def _whole(self) -> Iterator[None]:
        """Give the map to nobody any more if what changes it fails half way."""
        try:
            yield
        except BaseException as error:
            self._failure = (
                f"mapping a keyframe failed ({error!r}), which leaves the map incomplete; continue "
                "from a map that was saved before"
            )
            raise
