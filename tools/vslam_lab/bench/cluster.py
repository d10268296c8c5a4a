"""Runs the cells of a benchmark (one run each) on a Dask cluster.

The workers send the results back to this machine. They need vslam with the extra ``cluster``, and
the data under the same path as on this machine.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Collection, Generator
from contextlib import suppress
from pathlib import Path

from vslam.support.errors import InputError
from vslam_lab.bench.execute import CellOptions, CellOutcome, Failed, publish, run_cell
from vslam_lab.bench.grid import Cell

_CONNECT_S = 10
_POLL_S = 2.0  # time between checks of the stop event; each check is a request to the scheduler


def run_on_cluster(
    cells: Collection[Cell], options: CellOptions, scheduler: str, out: Path
) -> Generator[CellOutcome, None, None]:
    """Run the cells of a benchmark (one run each) on the workers of a Dask scheduler.

    The results of each run are written to ``out`` before its outcome is yielded. A worker runs one
    cell per thread at a time. If the generator is closed, the running cells are stopped.

    Raises:
        InputError: Dask is not installed, or no scheduler answers.
        ResultsError: the results of a cell cannot be written.
    """
    try:
        from distributed import Client, Event, as_completed
        from distributed.comm import resolve_address
    except ImportError as error:
        raise InputError(
            "--scheduler: dask is not installed; pip install 'vslam[cluster]'."
        ) from error
    _require_certificates(scheduler)
    try:
        resolve_address(scheduler)  # a client with a bad address prints a traceback when it closes
        client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--scheduler {scheduler}: no scheduler answers; start one with 'dask scheduler' and "
            "give the address that it prints, for example tcp://HOST:8786."
        ) from error
    stop = Event(f"vslam-bench-{uuid.uuid4().hex}", client=client)
    try:
        futures = client.map(_run_on_worker, cells, options=options, stop=stop.name, pure=False)
        cell_of = {future.key: cell for future, cell in zip(futures, cells, strict=True)}
        for future in as_completed(futures, loop=client.loop):
            cell, failure = cell_of[future.key], future.exception()
            outcome = future.result() if failure is None else Failed(cell, _first_line(failure))
            future.release()  # otherwise Dask repeats the finished cells of a worker that dies
            publish(outcome, out)
            yield outcome
    finally:
        with suppress(OSError):  # the scheduler has ended, and its workers with it
            stop.set()
        client.close()


def _require_certificates(scheduler: str) -> None:
    """Reject a TLS address if Dask has no certificates. Its client would otherwise never close."""
    from distributed.security import Security

    if not scheduler.startswith("tls://"):
        return
    try:
        context = Security().get_connection_args("client")["ssl_context"]
    except (OSError, ValueError):  # a file is missing or is not a certificate
        context = None
    if context is None:
        raise InputError(
            f"--scheduler {scheduler}: Dask has no certificates for it; name them in Dask's "
            "configuration (distributed.comm.tls), or start the scheduler with tcp://."
        )


def _run_on_worker(cell: Cell, options: CellOptions, stop: str) -> CellOutcome:
    from distributed import Event

    event = Event(stop)
    last = time.monotonic()
    is_stopped = False

    def stopped() -> bool:
        nonlocal last, is_stopped
        if time.monotonic() - last > _POLL_S and not is_stopped:
            last, is_stopped = time.monotonic(), event.is_set()
        return is_stopped

    return run_cell(cell, options, stopped)


def _first_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0]
