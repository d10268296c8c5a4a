"""Runs all searches of a stress test together, in rounds.

In each round, every search that has not ended runs its next cell. A *cell* is one run.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterable
from contextlib import closing
from pathlib import Path

from vslam.report.schema import ReportJson
from vslam_lab.bench.execute import CellOutcome, Failed
from vslam_lab.bench.grid import Cell, is_finished, read_report
from vslam_lab.stress.criterion import Criterion
from vslam_lab.stress.plan import Search

RunCells = Callable[[Collection[Cell]], Generator[CellOutcome, None, None]]


class Results:
    """The results of runs: the reports in the folder, and the failures of this command."""

    def __init__(self, out: Path, config: str) -> None:
        self._out, self._config = out, config
        self._known: dict[Cell, ReportJson | str] = {}

    def __call__(self, cell: Cell) -> ReportJson | str | None:
        """Return the report of a run, or why the run failed; None if the run has not ended."""
        if cell not in self._known:
            folder = self._out / cell.name
            if not is_finished(cell, folder, self._config):
                return None
            report = read_report(folder)
            assert report is not None
            self._known[cell] = report
        return self._known[cell]

    def add(self, outcome: CellOutcome) -> None:
        if isinstance(outcome, Failed):
            self._known[outcome.cell] = outcome.message
        else:
            self._known.pop(outcome.cell, None)


def run_all(
    clean: Collection[Cell],
    searches: Collection[Search],
    others: Iterable[Cell],
    results: Results,
    criterion: Criterion,
    run: RunCells,
    say: Callable[[str], None] = lambda line: None,
) -> None:
    """Run all cells (one run each) of a stress test that are not finished yet.

    The runs on unperturbed images come first. The searches follow in rounds. ``others`` comes last.
    """
    _run(clean, results, run, say)
    while True:
        for search in searches:
            search.advance(results, criterion)
        wanted = list(dict.fromkeys(cell for s in searches if (cell := _wanted(s, results))))
        if not wanted:
            break
        _run(wanted, results, run, say)
    _run(list(dict.fromkeys(others)), results, run, say)


def _wanted(search: Search, results: Results) -> Cell | None:
    """Return the next cell (run) of a search.

    Returns None if the search has ended, or if the run on unperturbed images gave no results.
    """
    return search.wants() if isinstance(results(search.clean), ReportJson) else None


def _run(
    cells: Collection[Cell], results: Results, run: RunCells, say: Callable[[str], None]
) -> None:
    missing = [cell for cell in cells if results(cell) is None]
    if not missing:
        return
    with closing(run(missing)) as outcomes:
        for k, outcome in enumerate(outcomes, start=1):
            results.add(outcome)
            say(f"{k}/{len(missing)} {outcome.cell.name}: {_in_words(results(outcome.cell))}")


def _in_words(result: ReportJson | str | None) -> str:
    if not isinstance(result, ReportJson):
        return f"failed: {result}" if result else "finished"
    ate = "no ATE" if result.ate_rmse_m is None else f"ATE {result.ate_rmse_m:.3f} m"
    return f"{ate}, {result.lost_frames} lost"
