"""Runs each cell of a benchmark in its own process, and writes its results into a folder.

A cell is one run of vslam. The folder of a cell appears only when its results are complete. If a
benchmark is killed, only the cells that were running are lost.

The result files of a cell (a few MB) are passed in memory, because the cell may have been run on
another machine. Only this module writes to the folder of the benchmark.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Collection, Generator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from vslam.support.errors import InputError, ResultsError
from vslam_lab.bench.grid import Cell, is_finished, tracked_nothing

_POLL_S = 0.1
_NOT_KEPT = {"map.npz"}  # hundreds of MB for a long sequence; the report does not need it
_PARTS, _FAILED = ".parts", "failed"


@dataclass(frozen=True)
class CellOptions:
    """Options that are the same for all runs of a benchmark.

    Attributes:
        data: root folder of the data set on the machine that runs the cell; None for rendered
            towns.
        config: thresholds, as the text of a file ``config.json``.
        threads: number of threads of each run. It does not change the results of the runs.
        command: program that is run instead of ``vslam``, with the same arguments.
        others: programs of other SLAM systems by ``Cell.detector``. They accept the same arguments
            as ``vslam``.
        scratch: folder for the files of unfinished runs; None for the temporary folder of the
            machine.
        source: arguments of ``vslam run`` that describe how to read the data.
    """

    data: Path | None
    config: str
    threads: int
    command: tuple[str, ...] | None = None
    scratch: Path | None = None
    others: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    source: tuple[str, ...] = ()


@dataclass(frozen=True)
class Finished:
    """A complete run, and the contents of its files. File paths are relative to ``folder``."""

    cell: Cell
    folder: str
    files: dict[str, bytes]


@dataclass(frozen=True)
class Failed:
    """A run without results: a one-line reason, and the output of the run."""

    cell: Cell
    message: str
    log: str = ""


CellOutcome = Finished | Failed


def run_cell(
    cell: Cell, options: CellOptions, stopped: Callable[[], bool] = lambda: False
) -> CellOutcome:
    """Run one cell of a benchmark (a single run) in a temporary folder, and return its files.

    Args:
        stopped: called repeatedly during the run. If it returns True, the run is killed.
    """
    if options.scratch is not None:
        options.scratch.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"{cell.name}.", dir=options.scratch) as name:
        work = Path(name)
        (work / "config.json").write_text(options.config)
        program = options.others.get(cell.detector) or options.command
        command = list(program or (sys.executable, "-m", "vslam_lab.cli.child"))
        command += ["run", *cell.arguments(), "--threads", str(options.threads)]
        command += ["--data", str(options.data)] if options.data else []
        command += options.source
        command += ["--config", str(work / "config.json"), "--no-record", "--no-report", "--quiet"]
        code = _call([*command, "--out", str(work / "runs")], work / "log.txt", stopped)
        log = (work / "log.txt").read_text(errors="replace")
        for folder in (path.parent for path in work.glob("runs/*/report.json")):
            # A run that was lost in every frame exits with 1. Its report is a valid result.
            done = code == 0 or (code == 1 and tracked_nothing(folder))
            if done and is_finished(cell, folder, options.config):
                return Finished(cell, str(folder), _read(folder) | {"log.txt": log.encode()})
        if code:
            return Failed(cell, _reason(code, log), log)
        return Failed(cell, "its report is missing, incomplete or of another version of vslam", log)


def run_here(
    cells: Collection[Cell], options: CellOptions, jobs: int, out: Path
) -> Generator[CellOutcome, None, None]:
    """Run the cells of a benchmark on this machine, ``jobs`` cells at a time.

    A cell is one run. Its results are written to ``out`` before its outcome is yielded. If the
    generator is closed, the running cells are killed.

    Raises:
        ResultsError: the results of a cell cannot be written.
    """
    stop = threading.Event()

    # A thread writes its own results, so that they are not lost if the caller is interrupted.
    def run_and_publish(cell: Cell) -> CellOutcome:
        try:
            outcome = run_cell(cell, options, stop.is_set)
        except OSError as error:  # the run cannot be started, or its files cannot be read
            outcome = Failed(cell, error.strerror or str(error))
        if not stop.is_set() or isinstance(outcome, Finished):
            publish(outcome, out)
        return outcome

    with ThreadPoolExecutor(jobs, "cell") as pool:
        try:
            futures = [pool.submit(run_and_publish, cell) for cell in cells]
            for future in as_completed(futures):
                yield future.result()
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


def finished_cells(cells: Collection[Cell], out: Path, config: str) -> list[Cell]:
    """Return the cells of a benchmark whose results are already in the folder ``out``."""
    return [cell for cell in cells if is_finished(cell, out / cell.name, config)]


def publish(outcome: CellOutcome, out: Path) -> None:
    """Write the results of a run into the folder ``out``, either completely or not at all.

    If the run failed, only its log is written.

    Raises:
        ResultsError: the folder cannot be written.
    """
    cell = outcome.cell
    failed = out / _FAILED / f"{cell.name}.txt"
    try:
        if isinstance(outcome, Failed):
            failed.parent.mkdir(parents=True, exist_ok=True)
            failed.write_text(f"{outcome.message}\n\n{outcome.log}")
            return
        target = out / cell.name
        part = scratch_folder(out) / cell.name
        shutil.rmtree(part, ignore_errors=True)
        for name, data in outcome.files.items():
            path = part / name
            if not path.resolve().is_relative_to(part.resolve()):
                raise ResultsError(f"{name}: a worker sent a file outside its folder.")
            path.parent.mkdir(parents=True, exist_ok=True)
            # These files contain the command that reproduces the ATE, which names the folder.
            if path.suffix in (".json", ".md", ".html"):
                data = data.replace(outcome.folder.encode(), shlex.quote(str(target)).encode())
            path.write_bytes(data)
        shutil.rmtree(target, ignore_errors=True)  # it is damaged, or of another version
        part.rename(target)
        failed.unlink(missing_ok=True)
    except OSError as error:
        raise ResultsError(
            f"{out}: the results of {cell.name} cannot be written ({error.strerror}); free some "
            "space and repeat the command: finished cells are kept."
        ) from error


def prepare(out: Path, data: str) -> None:
    """Create the folder of a benchmark, and remove files that a killed benchmark left there.

    Args:
        data: text that identifies the data set. A folder can only contain results of one data set,
            because sequences of different data sets may have the same names.

    Raises:
        InputError: the folder cannot be written, or it contains runs on different data.
    """
    import psutil

    note = out / "data.txt"
    try:
        out.mkdir(parents=True, exist_ok=True)
        if not note.exists():
            note.write_text(f"{data}\n")
        if (known := note.read_text().strip()) != data:
            raise InputError(
                f"{out}: contains runs on {known}, not on {data}; give another folder with --out."
            )
        for folder in (out / _PARTS).glob("*"):
            if not (folder.name.isdecimal() and psutil.pid_exists(int(folder.name))):
                shutil.rmtree(folder, ignore_errors=True)
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror}); give another folder with --out."
        ) from error


def scratch_folder(out: Path) -> Path:
    """Return the folder to which the unfinished runs of this process write."""
    return out / _PARTS / str(os.getpid())


def tidy(out: Path) -> None:
    """Remove the scratch folder of this process."""
    shutil.rmtree(scratch_folder(out), ignore_errors=True)
    with suppress(OSError):  # not empty if another process uses the same folder
        (out / _PARTS).rmdir()


def _call(command: list[str], log: Path, stopped: Callable[[], bool]) -> int:
    """Run a command and return its exit code, or kill it when ``stopped`` returns True.

    The command runs in its own session, so that Ctrl-C reaches only this process. Its standard
    input is a pipe that closes when this process dies (:mod:`vslam_lab.cli.child`).
    """
    with log.open("wb") as output:
        child = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            while not stopped():
                with suppress(subprocess.TimeoutExpired):
                    return child.wait(_POLL_S)
            return -1
        finally:
            if child.poll() is None:
                child.kill()
                child.wait()
            if child.stdin is not None:
                child.stdin.close()


def _reason(code: int, log: str) -> str:
    if code < 0:
        return f"killed by signal {-code}" + (" (out of memory?)" if code == -9 else "")
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("error: ")]
    return (errors or lines or [f"exit code {code}"])[-1].removeprefix("error: ")


def _read(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in _NOT_KEPT
    }
