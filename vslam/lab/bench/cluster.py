"""Running the cells of a benchmark on a Dask cluster; the workers send their results back.

If a worker dies, the scheduler gives its cell to another one. The workers need vslam with the
extra ``cluster``, and the data under the same path.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Collection, Generator
from contextlib import suppress
from pathlib import Path

from vslam.errors import InputError
from vslam.lab.bench.execute import CellOutcome, Failed, RunOptions, publish, run_cell
from vslam.lab.bench.grid import Cell

_CONNECT_S = 10
_ASK_S = 2.0  # between questions whether to stop, since each one goes to the scheduler


def run_on_cluster(
    cells: Collection[Cell], options: RunOptions, scheduler: str, out: Path
) -> Generator[CellOutcome, None, None]:
    """Run cells on the workers of a scheduler; publish and yield each one here when it arrives.

    A worker runs as many cells at a time as it has threads. Leaving the iteration stops them.

    Raises:
        InputError: Dask is not installed, or no scheduler answers.
        ResultsError: as :func:`vslam.lab.bench.execute.publish`.
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
        resolve_address(scheduler)  # for a bad address, a client prints a traceback on closing
        client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--scheduler {scheduler}: nothing answers there; start one with 'dask scheduler' and "
            "give the address that it prints, for example tcp://HOST:8786."
        ) from error
    stop = Event(f"vslam-bench-{uuid.uuid4().hex}", client=client)
    try:
        futures = client.map(_run_on_worker, cells, options=options, stop=stop.name, pure=False)
        cell_of = {future.key: cell for future, cell in zip(futures, cells, strict=True)}
        for future in as_completed(futures, loop=client.loop):
            cell, defect = cell_of[future.key], future.exception()
            outcome = future.result() if defect is None else Failed(cell, _said(defect))
            future.release()  # otherwise Dask repeats the finished cells of a worker that dies
            publish(outcome, out)
            yield outcome
    finally:
        with suppress(OSError):  # the scheduler has ended, and with it all that it ran
            stop.set()
        client.close()


def _require_certificates(scheduler: str) -> None:
    """Refuse a TLS address without certificates, because Dask's client would not close."""
    from distributed.security import Security

    if not scheduler.startswith("tls://"):
        return
    try:
        context = Security().get_connection_args("client")["ssl_context"]
    except (OSError, ValueError):  # the files are missing or are not certificates
        context = None
    if context is None:
        raise InputError(
            f"--scheduler {scheduler}: Dask has no certificates for it; name them in Dask's "
            "configuration (distributed.comm.tls), or start the scheduler with tcp://."
        )


def _run_on_worker(cell: Cell, options: RunOptions, stop: str) -> CellOutcome:
    """Run a cell on this worker, until the benchmark sets the event ``stop``."""
    from distributed import Event

    event = Event(stop)
    last = time.monotonic()
    is_stopped = False

    def stopped() -> bool:
        nonlocal last, is_stopped
        if time.monotonic() - last > _ASK_S and not is_stopped:
            last, is_stopped = time.monotonic(), event.is_set()
        return is_stopped

    return run_cell(cell, options, stopped)


def _said(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0]
