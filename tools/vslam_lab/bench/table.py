"""The table that the terminal shows while a benchmark runs."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.table import Table

from vslam.report.schema import ReportJson
from vslam.support.errors import counted
from vslam_lab.bench.estimate import duration, estimate
from vslam_lab.bench.execute import CellOutcome, Failed
from vslam_lab.bench.grid import Cell, read_report


class GridProgress:
    """The finished, failed and missing cells of a benchmark (one run each).

    Attributes:
        cells: all cells of the benchmark.
        reports: reports of the finished cells, in the order in which the cells ended.
        failed: for each failed cell, the reason in one line.
    """

    def __init__(
        self,
        cells: Collection[Cell],
        finished: Collection[Cell],
        frames: Mapping[str, int],
        out: Path,
        jobs: int,
    ) -> None:
        self.cells = cells
        self.reports: dict[Cell, ReportJson] = {}
        self.failed: dict[Cell, str] = {}
        self._frames, self._out, self._jobs = frames, out, jobs
        for cell in finished:
            self._add_report(cell)

    @property
    def missing(self) -> list[Cell]:
        """Cells (runs) that have neither finished nor failed."""
        return [c for c in self.cells if c not in self.reports and c not in self.failed]

    def add(self, outcome: CellOutcome) -> str:
        """Add the outcome of a run that has ended, and return a line of text about the run."""
        cell = outcome.cell
        if isinstance(outcome, Failed):
            self.failed[cell] = outcome.message
            result = f"failed: {outcome.message}"
        else:
            self._add_report(cell)
            ate = self.reports[cell].ate_rmse_m
            result = "finished" if ate is None else f"ATE {ate:.3f} m"
        return f"{len(self.reports) + len(self.failed)}/{len(self.cells)} {cell.name}: {result}"

    def table(self) -> Table:
        """Return a table with the number of finished runs and the median of their ATE.

        There is a row for each sequence and perturbation, and a column for each detector.
        """
        detectors = list(dict.fromkeys(cell.detector for cell in self.cells))
        caption = "Each entry gives the number of finished runs and their median ATE.\n"
        caption += f"{len(self.reports)} of {counted(len(self.cells), 'run')} finished"
        caption += f", {len(self.failed)} failed" if self.failed else ""
        if self.missing:
            left = estimate(self.missing, self.reports, self._frames, self._jobs).seconds
            caption += f", about {duration(left)} left"
        table = Table("sequence", "perturbation", *detectors, caption=caption)
        for group in dict.fromkeys((cell.sequence, cell.perturb) for cell in self.cells):
            cells = [cell for cell in self.cells if (cell.sequence, cell.perturb) == group]
            texts = (self._text([c for c in cells if c.detector == d]) for d in detectors)
            table.add_row(*group, *texts)
        return table

    def _text(self, cells: list[Cell]) -> str:
        done = [self.reports[cell] for cell in cells if cell in self.reports]
        failed = sum(cell in self.failed for cell in cells)
        ates = [report.ate_rmse_m for report in done if report.ate_rmse_m is not None]
        text = f"{len(done)} of {len(cells)}"
        text += f"  {statistics.median(ates):.3f} m" if ates else ""
        return text + (f"  [red]{failed} failed[/red]" if failed else "")

    def _add_report(self, cell: Cell) -> None:
        report = read_report(self._out / cell.name)
        if report is not None:
            self.reports[cell] = report


@contextmanager
def shown_live(progress: GridProgress, *, shown: bool) -> Iterator[Callable[[str], None]]:
    """Show the table of a benchmark on stderr, and update it while the benchmark runs.

    The context manager yields a function that prints a line of text if stderr is not a terminal.

    When the benchmark is complete, the table is erased, because the results are printed next. If
    runs are missing or have failed, the table stays.
    """
    console = Console(stderr=True, quiet=not shown, highlight=False, soft_wrap=True)
    live = (
        Live(get_renderable=progress.table, console=console, refresh_per_second=1, transient=True)
        if console.is_terminal
        else nullcontext()
    )
    try:
        with live:
            yield lambda line: None if console.is_terminal else console.print(line, markup=False)
    finally:
        if progress.missing or progress.failed:
            console.print(progress.table())
