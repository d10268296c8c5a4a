"""How long a grid will take and how much disk, before it starts and while it runs."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from vslam.errors import InputError
from vslam.lab.bench.grid import Cell
from vslam.report.schema import ReportJson

# Before any cell of the grid is finished: two threads of a Xeon, KITTI's images, loops closed.
_FRAME_S, _START_S = 0.06, 5.0
# Measured, rounded up: kept files of a cell, and the map that a run writes and the grid drops.
_CELL_BYTES, _FRAME_BYTES, _SCRATCH_FRAME_BYTES = 100_000, 1_000, 45_000


@dataclass(frozen=True)
class Estimate:
    """``seconds`` with all jobs at work; ``kept`` and ``scratch`` in bytes; ``basis`` in words."""

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
    """Judge what is missing by what is finished, detector by detector where it can.

    Args:
        finished: cells and their reports.
        frames: of each sequence.
        jobs: cells at a time.
    """
    spent: dict[str, list[float]] = {}  # seconds a frame
    start: list[float] = []
    for cell, report in list(finished.items()):  # the table is drawn while cells end
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
    """Refuse a grid that the disk has no room for.

    Raises:
        InputError: too little is free.
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
    """In MB or GB."""
    return f"{n_bytes / 1e6:.0f} MB" if n_bytes < 1e9 else f"{n_bytes / 1e9:.1f} GB"


def _mean(values: Collection[float], otherwise: float) -> float:
    return sum(values) / len(values) if values else otherwise
