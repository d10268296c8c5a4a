"""Threads that run the jobs of a pipeline. A thread that waits for a job runs other jobs meanwhile.

Jobs start in order of ``Urgency``. The result of a job must not depend on when the job runs or on
which thread runs it. Global bundle adjustment would delay the other jobs by seconds. It therefore
has its own thread (``vslam/method/closing.py``).
"""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from enum import IntEnum
from functools import partial
from typing import Any, Generic, TypeVar

T = TypeVar("T")
Given = TypeVar("Given")


class Urgency(IntEnum):
    """The kinds of jobs, most urgent first."""

    MAPPING = 0
    CORNERS = 1  # of the next keyframe
    LOOPS = 2
    READING = 3


class Workers:
    """Runs jobs in ``threads - 1`` threads, and in every thread that waits for a result.

    With one thread, a job therefore runs when its result is needed.
    """

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._queue = queue = _Queue()
        self._process = os.getpid()
        self._started = [
            threading.Thread(target=queue.work, name=f"worker-{k}", daemon=True)
            for k in range(1, threads)
        ]
        for thread in self._started:
            thread.start()
        # Also called at the end of the process, while a running job can still be completed.
        weakref.finalize(self, _stop, queue, self._started)

    def submit(self, work: Callable[[], T], urgency: Urgency) -> Job[T]:
        """Queue a function. The returned job gives its result."""
        return self._queue.add(work, urgency)

    def map(
        self, function: Callable[[Given], T], items: Iterable[Given], urgency: Urgency
    ) -> Iterator[T]:
        """Apply a function to each item, in parallel. The results keep the order of the items."""
        jobs = [self.submit(partial(function, item), urgency) for item in items]
        return (job.result() for job in jobs)

    def refuse_fork(self) -> None:
        """Raise a RuntimeError in a forked process, which does not inherit the worker threads."""
        if self._started and os.getpid() != self._process:
            raise RuntimeError(
                "this Slam was created before the process was forked, which does not copy its "
                "threads; create it after the fork, or use threads=1"
            )


class Job(Generic[T]):
    """A function that was queued by ``Workers.submit``, and its result."""

    def __init__(self, work: Callable[[], T], urgency: Urgency, queue: _Queue) -> None:
        self.urgency = urgency
        self.is_done = False
        self.error: BaseException | None = None
        self._work: Callable[[], T] | None = work
        self._queue = queue
        self._value: T | None = None

    def wait(self) -> None:
        """Wait until the job is done, even if the job fails.

        If the job has not started, the calling thread runs it. Otherwise, the calling thread runs
        other queued jobs while it waits. If Ctrl-C interrupts the wait, this method can be called
        again.
        """
        self._queue.wait_for(self)

    def result(self) -> T:
        """Wait for the job, and return its result or raise its exception.

        If the job was cancelled, ``CancelledError`` is raised.
        """
        self.wait()
        if self.error is not None:
            raise self.error
        return self._value  # type: ignore[return-value]

    def cancel(self) -> None:
        """Cancel the job if it has not started. Otherwise, wait until it is done."""
        self._queue.cancel(self)

    def run(self) -> None:
        """Run the function, and keep its result or its exception."""
        work, self._work = self._work, None  # what it refers to is not needed any more
        assert work is not None
        try:
            self._value = work()
        except BaseException as error:
            self.error = error


class _Thread(threading.local):
    runs_job = False


class _Queue:
    """Jobs that have not started, and the threads that wait for a change of the queue."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._thread = _Thread()
        self._jobs: list[Job[Any]] = []  # in the order in which they were added
        self._closed = False

    def add(self, work: Callable[[], T], urgency: Urgency) -> Job[T]:
        job = Job(work, urgency, self)
        with self._changed:
            self._jobs.append(job)
            self._changed.notify_all()
        return job

    def work(self) -> None:
        """Run jobs until the queue is closed."""
        while True:
            with self._changed:
                while not self._jobs:
                    if self._closed:
                        return
                    self._changed.wait()
                job = self._take()
            self._run(job)
            del job  # and its result, while this thread waits for the next job

    def wait_for(self, awaited: Job[Any]) -> None:
        """Wait for a job (``Job.wait``).

        A job that waits for another job does not run further jobs meanwhile, because these would
        delay the waiting job.
        """
        while True:
            with self._changed:
                while not (awaited.is_done or awaited in self._jobs or self._can_help()):
                    self._changed.wait()
                if awaited.is_done:
                    return
                job = self._take(awaited if awaited in self._jobs else None)
            self._run(job)
            if job is not awaited and isinstance(job.error, KeyboardInterrupt):
                raise job.error  # Ctrl-C is meant for the caller

    def cancel(self, job: Job[Any]) -> None:
        with self._changed:
            if job in self._jobs:
                self._drop(job)
        self.wait_for(job)

    def close(self) -> None:
        """Cancel all jobs that have not started, and let the threads end."""
        with self._changed:
            for job in self._jobs.copy():
                self._drop(job)
            self._closed = True
            self._changed.notify_all()

    def _drop(self, job: Job[Any]) -> None:
        self._jobs.remove(job)
        job.error, job.is_done = CancelledError(), True

    def _can_help(self) -> bool:
        return bool(self._jobs) and not self._thread.runs_job

    def _take(self, job: Job[Any] | None = None) -> Job[Any]:
        """Remove a job from the queue: the given job, or the first of the most urgent jobs."""
        chosen = job or min(self._jobs, key=lambda job: job.urgency)
        self._jobs.remove(chosen)
        return chosen

    def _run(self, job: Job[Any]) -> None:
        outer, self._thread.runs_job = self._thread.runs_job, True
        job.run()
        self._thread.runs_job = outer
        with self._changed:
            job.is_done = True
            self._changed.notify_all()


def _stop(queue: _Queue, threads: list[threading.Thread]) -> None:
    queue.close()
    for thread in threads:
        if thread is not threading.current_thread():
            thread.join()
