"""Estimates how much time and disk space a benchmark needs, before it starts and while it runs."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from vslam.report.schema import ReportJson
from vslam.support.errors import InputError, counted
from vslam_lab.bench.grid import Cell

# Seconds per frame, and seconds to start a run. They are used until a cell is finished. They were
# measured on KITTI with loop closing, with two threads of a Xeon.
_FRAME_S, _START_S = 0.06, 5.0
# Bytes of the kept files per cell and per frame, and bytes per frame of the map, which is deleted
# after the run. The values were measured and rounded up.
_CELL_BYTES, _FRAME_BYTES, _SCRATCH_FRAME_BYTES = 100_000, 1_000, 45_000


@dataclass(frozen=True)
class Estimate:
    """The time and the disk space that the missing runs of a benchmark need.

    Attributes:
        seconds: estimated wall time of all missing runs together.
        kept: size in bytes of the files that are kept.
        scratch: size in bytes of the files that are deleted after each run.
        basis: text that says on what ``seconds`` is based.
    """

    seconds: float
    kept: int
    scratch: int
    basis: str


def estimate(
    missing: Collection[Cell],
    finished: Mapping[Cell, ReportJson],
    frames: Mapping[str, int],
    jobs: int,
) -> Estimate:
    """Estimate how much time and disk space the missing runs of a benchmark need.

    The speed is taken from the finished runs, if possible from those with the same detector.

    Args:
        missing: cells of the benchmark (one run each) that have not been run yet.
        finished: finished cells and the reports of their runs.
        frames: number of frames of each sequence.
        jobs: number of cells that run at the same time.
    """
    frame_s: dict[str, list[float]] = {}  # for each detector, seconds per frame of finished cells
    starts: list[float] = []
    for cell, report in list(finished.items()):  # a copy, because other threads add cells
        if report.fps > 0:
            frame_s.setdefault(cell.detector, []).append(1.0 / report.fps)
            starts.append(report.startup_s)
    every = [s for seconds in frame_s.values() for s in seconds]
    startup = _mean(starts, _START_S)
    seconds = sum(
        startup + frames[cell.sequence] * _mean(frame_s.get(cell.detector, every), _FRAME_S)
        for cell in missing
    )
    longest = sorted((frames[cell.sequence] for cell in missing), reverse=True)[:jobs]
    basis = (
        f"based on {counted(len(every), 'finished run')}"
        if every
        else "a guess until the first run is finished"
    )
    return Estimate(
        seconds=seconds / max(1, min(jobs, len(missing))),
        kept=sum(_CELL_BYTES + _FRAME_BYTES * frames[cell.sequence] for cell in missing),
        scratch=_SCRATCH_FRAME_BYTES * sum(longest),
        basis=basis,
    )


def check_disk(needed: Estimate, out: Path) -> None:
    """Check that the disk has enough free space for the results of a benchmark.

    Raises:
        InputError: the free space is too small.
    """
    free = shutil.disk_usage(out).free
    if needed.kept + needed.scratch > free:
        raise InputError(
            f"{out}: the grid needs {size(needed.kept + needed.scratch)} of disk space, but only "
            f"{size(free)} are free; free some space or give a folder on another disk with --out."
        )


def duration(seconds: float) -> str:
    """Format a duration, for example as ``2 h 05 min``, ``7 min`` or ``40 s``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


def size(n_bytes: float) -> str:
    """Format a number of bytes in MB or GB."""
    return f"{n_bytes / 1e6:.0f} MB" if n_bytes < 1e9 else f"{n_bytes / 1e9:.1f} GB"


def _mean(values: Collection[float], default: float) -> float:
    return sum(values) / len(values) if values else default
