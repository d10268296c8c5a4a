"""Estimates of the time and disk space that a grid needs, before it starts and while it runs."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from vslam.errors import InputError
from vslam.lab.bench.grid import Cell
from vslam.report.schema import ReportJson

# Used before any cell is finished: two threads of a Xeon, KITTI's images, with loop closing.
_FRAME_S, _START_S = 0.06, 5.0
# Measured and rounded up: the kept files of a cell, and the map, which is deleted after the run.
_CELL_BYTES, _FRAME_BYTES, _SCRATCH_FRAME_BYTES = 100_000, 1_000, 45_000


@dataclass(frozen=True)
class Estimate:
    """``seconds`` with all jobs busy; ``kept`` and ``scratch`` bytes; ``basis`` as a text."""

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
    """Estimate the missing cells from the finished ones, separately by detector if possible.

    Args:
        finished: finished cells and their reports.
        frames: number of frames of each sequence.
        jobs: cells that run at a time.
    """
    spent: dict[str, list[float]] = {}  # seconds a frame
    start: list[float] = []
    for cell, report in list(finished.items()):  # a copy, because cells end meanwhile
        if report.fps > 0:
            spent.setdefault(cell.detector, []).append(1.0 / report.fps)
            start.append(report.startup_s)
    every = [s for seconds in spent.values() for s in seconds]
    startup = _mean(start, _START_S)
    seconds = sum(
        startup + frames[cell.sequence] * _mean(spent.get(cell.detector, every), _FRAME_S)
        for cell in missing
    )
    longest = sorted((frames[cell.sequence] for cell in missing), reverse=True)[:jobs]
    basis = f"by {len(every)} finished cells" if every else "a guess until the first is finished"
    return Estimate(
        seconds=seconds / max(1, min(jobs, len(missing))),
        kept=sum(_CELL_BYTES + _FRAME_BYTES * frames[cell.sequence] for cell in missing),
        scratch=_SCRATCH_FRAME_BYTES * sum(longest),
        basis=basis,
    )


def check_disk(needed: Estimate, out: Path) -> None:
    """Refuse a grid that does not fit on the disk.

    Raises:
        InputError: the free space is too small.
    """
    free = shutil.disk_usage(out).free
    if needed.kept + needed.scratch > free:
        raise InputError(
            f"{out}: the grid needs {size(needed.kept + needed.scratch)} but {size(free)} are "
            "free; free some space or name a folder on another disk with --out."
        )


def duration(seconds: float) -> str:
    """``2 h 05 min``, ``7 min`` or ``40 s``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


def size(n_bytes: float) -> str:
    """A size in MB or GB, as a text."""
    return f"{n_bytes / 1e6:.0f} MB" if n_bytes < 1e9 else f"{n_bytes / 1e9:.1f} GB"


def _mean(values: Collection[float], otherwise: float) -> float:
    return sum(values) / len(values) if values else otherwise
