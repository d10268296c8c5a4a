"""The same cells on a Dask cluster: workers run them, results come back here.

The scheduler gives a cell to another worker when the one that had it dies. Nothing but the data
must be on the workers, under the same path, and vslam with the extra ``cluster``.
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
_ASK_S = 2.0  # each question whether to stop goes to the scheduler


def run_on_cluster(
    cells: Collection[Cell], options: RunOptions, scheduler: str, out: Path
) -> Generator[CellOutcome, None, None]:
    """Run cells on the workers of a scheduler, publish each here and yield it as it arrives.

    A worker takes as many cells at a time as it has threads. Leaving the iteration stops them.

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
        resolve_address(scheduler)  # a client of no address would not close without a traceback
        client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--scheduler {scheduler}: nothing answers there; start one with "
            "'dask scheduler' and name it as it says, tcp://HOST:8786 for example."
        ) from error
    stop = Event(f"vslam-bench-{uuid.uuid4().hex}", client=client)
    try:
        futures = client.map(_run_on_worker, cells, options=options, stop=stop.name, pure=False)
        cell_of = {future.key: cell for future, cell in zip(futures, cells, strict=True)}
        for future in as_completed(futures, loop=client.loop):
            cell, defect = cell_of[future.key], future.exception()
            outcome = future.result() if defect is None else Failed(cell, _said(defect))
            future.release()  # or the death of a worker would run again all that it ever ran
            publish(outcome, out)
            yield outcome
    finally:
        with suppress(OSError):  # the scheduler is gone, and all that it ran with it
            stop.set()
        client.close()


def _require_certificates(scheduler: str) -> None:
    """Refuse an address of TLS where Dask's client would have none, and not close."""
    from distributed.security import Security

    if not scheduler.startswith("tls://"):
        return
    try:
        context = Security().get_connection_args("client")["ssl_context"]
    except (OSError, ValueError):  # files that are missing, or no certificates
        context = None
    if context is None:
        raise InputError(
            f"--scheduler {scheduler}: Dask has no certificates for it; name them in its "
            "configuration (distributed.comm.tls), or start the scheduler with tcp://."
        )


def _run_on_worker(cell: Cell, options: RunOptions, stop: str) -> CellOutcome:
    """Run a cell where this is called, until the benchmark sets the event ``stop``."""
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
