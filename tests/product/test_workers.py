"""Jobs run in the order of their urgency, in the workers and in threads that wait."""

from __future__ import annotations

import gc
import threading
import weakref
from concurrent.futures import CancelledError

import pytest

from vslam.support.workers import Job, Urgency, Workers

PATIENCE = 20.0  # seconds; an idle machine needs milliseconds


def occupy(workers: Workers) -> tuple[Job[bool], threading.Event]:
    """Let the only worker wait in a job. Return the job, and the event that ends it."""
    begun, end = threading.Event(), threading.Event()

    def work() -> bool:
        begun.set()
        return end.wait(PATIENCE)

    job = workers.submit(work, Urgency.READING)
    assert begun.wait(PATIENCE)
    return job, end


def test_with_one_thread_a_job_runs_when_its_result_is_needed():
    workers, done = Workers(1), []
    first = workers.submit(lambda: done.append("first"), Urgency.MAPPING)
    second = workers.submit(lambda: done.append("second"), Urgency.READING)
    assert done == []
    second.result()
    assert done == ["second"]
    first.result()
    assert done == ["second", "first"]


def test_a_worker_runs_a_job_that_nobody_waits_for():
    ran = threading.Event()
    workers = Workers(2)
    workers.submit(ran.set, Urgency.READING)
    assert ran.wait(PATIENCE)


def test_who_waits_runs_the_other_jobs_meanwhile_the_most_urgent_first():
    workers, done = Workers(2), []
    busy, end = occupy(workers)

    def note(name: str) -> None:
        done.append((name, threading.current_thread()))
        if len(done) == 4:
            end.set()

    for urgency in (Urgency.READING, Urgency.LOOPS, Urgency.CORNERS, Urgency.MAPPING):
        workers.submit(lambda urgency=urgency: note(urgency.name), urgency)
    assert busy.result()
    here = threading.current_thread()
    assert done == [(name, here) for name in ("MAPPING", "CORNERS", "LOOPS", "READING")]


def test_who_waits_within_a_job_runs_no_other_job():
    workers, done = Workers(1), []
    other = workers.submit(lambda: done.append("other"), Urgency.MAPPING)

    def outer() -> None:
        begun, end = threading.Event(), threading.Event()

        def inner_work() -> None:
            begun.set()
            end.wait(PATIENCE)

        inner = workers.submit(inner_work, Urgency.READING)
        elsewhere = threading.Thread(target=inner.wait)
        elsewhere.start()
        assert begun.wait(PATIENCE)
        threading.Timer(0.1, end.set).start()
        inner.result()
        elsewhere.join()
        done.append("outer")

    workers.submit(outer, Urgency.MAPPING).result()
    assert done == ["outer"]
    other.result()


def test_a_job_that_is_done_keeps_its_result_alone():
    class Work:
        def __call__(self) -> int:
            return 3

    workers, work = Workers(1), Work()
    gone = weakref.ref(work)
    job = workers.submit(work, Urgency.READING)
    del work
    assert job.result() == 3
    assert gone() is None


@pytest.mark.parametrize("threads", [1, 3])
def test_a_map_keeps_the_order_and_may_be_called_within_a_job(threads):
    workers = Workers(threads)

    def squares() -> list[int]:
        return list(workers.map(lambda x: x * x, range(20), Urgency.CORNERS))

    expected = [x * x for x in range(20)]
    assert squares() == expected
    assert workers.submit(squares, Urgency.CORNERS).result() == expected


@pytest.mark.parametrize("threads", [1, 2])
def test_an_exception_is_raised_at_each_result_and_ends_no_worker(threads):
    workers = Workers(threads)

    def fail() -> None:
        raise OSError("no such image")

    job = workers.submit(fail, Urgency.READING)
    job.wait()
    for _ in range(2):
        with pytest.raises(OSError, match="no such image"):
            job.result()
    assert workers.submit(lambda: 3, Urgency.READING).result() == 3


def test_ctrl_c_while_another_job_runs_reaches_who_waits():
    workers = Workers(2)
    busy, end = occupy(workers)

    def interrupted() -> None:
        end.set()
        raise KeyboardInterrupt

    workers.submit(interrupted, Urgency.READING)
    with pytest.raises(KeyboardInterrupt):
        busy.result()
    assert busy.result()  # the result can be requested again


def test_a_cancelled_job_never_runs_and_one_that_has_begun_is_completed():
    workers, done = Workers(2), []
    busy, end = occupy(workers)
    queued = workers.submit(lambda: done.append("queued"), Urgency.READING)
    queued.cancel()
    with pytest.raises(CancelledError):
        queued.result()
    threading.Timer(0.05, end.set).start()
    busy.cancel()
    assert busy.is_done
    assert busy.result()
    workers.submit(lambda: None, Urgency.READING).result()
    assert done == []


def test_threads_end_with_the_workers_and_queued_jobs_are_cancelled():
    before = set(threading.enumerate())
    workers, idle = Workers(3), Workers(1)
    started = set(threading.enumerate()) - before
    assert len(started) == 2
    queued = idle.submit(lambda: 3, Urgency.READING)
    del workers, idle
    gc.collect()
    assert not any(thread.is_alive() for thread in started)
    with pytest.raises(CancelledError):
        queued.result()
