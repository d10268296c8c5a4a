"""The report of many runs as Markdown, HTML and CSV: the same rows in the same order."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

from vslam.overview.schema import MEASURES, OverviewJson, Row, RunEntry, Spread
from vslam.overview.summary import ALPHA, systems
from vslam.report.loop_tables import Table
from vslam.report.render import markdown_table, render_page

if TYPE_CHECKING:
    from vslam.report.drawing import ReportFigure

_ABOUT = (
    "Medians over runs, in brackets the least and the greatest. ATE after SE3 alignment, of every "
    "frame, lost ones included; RPE a frame. Loops by the ground truth."
)
_TESTED = (
    "Pairs are sequences, each with the median of its runs: runs of one sequence are not "
    f"independent. Two-sided, level {ALPHA:g}, not corrected for the number of tests."
)


def tables(report: OverviewJson) -> list[Table]:
    """Every table of the report."""
    return [table for table in (_results(report), _compared(report), _runs(report)) if table.rows]


def title(report: OverviewJson) -> str:
    """What the report is of, in one line."""
    names = ", ".join(systems(report.runs))
    places = len({(row.drive.dataset, row.drive.place) for row in report.rows})
    sequences = f"{places} sequence{'s' if places > 1 else ''}"
    return f"{names} on {sequences}, {len(report.runs)} runs"


def render_markdown(report: OverviewJson) -> str:
    """Markdown whose tables are aligned, to be read in a terminal."""
    lines = [f"# {title(report)}", ""]
    if report.comparisons:
        lines += ["## Who wins where", "", *(f"- {c.words}" for c in report.comparisons), ""]
    for table in tables(report):
        lines += [f"## {table.title}", "", *markdown_table(table.head, table.rows), ""]
        lines += [table.note, ""] if table.note else []
    if report.notes:
        lines += ["## Notes", "", *(f"- {note}" for note in report.notes), ""]
    lines += ["## Made", "", *markdown_table(("", ""), _made(report)), ""]
    return "\n".join(lines)


def render_html(report: OverviewJson, figures: Sequence[ReportFigure]) -> str:
    """One self-contained page: style, figures and numbers are inside, nothing is loaded."""
    return render_page(
        "overview.html.jinja",
        report=report,
        title=title(report),
        words=[c.words for c in report.comparisons],
        tables=tables(report),
        made=_made(report),
        figures=figures,
    )


def render_csv(report: OverviewJson) -> str:
    """A line for each row; of each measure the median, the least and the greatest."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = [name for name, *_ in MEASURES]
    head = ["dataset", "sequence", "excerpt", "perturb", "system", "runs", "frames"]
    writer.writerow([*head, *(f"{n}{end}" for n in names for end in ("", "_least", "_greatest"))])
    for row in report.rows:
        cells: list[object] = [*row.drive.model_dump().values(), row.system, row.runs, row.frames]
        for name in names:
            spread = row.measures[name]
            found = (spread.median, spread.least, spread.greatest) if spread else ("", "", "")
            cells += found
        writer.writerow(cells)
    return text.getvalue()


def _results(report: OverviewJson) -> Table:
    texts = ("sequence", "perturbation", "system")
    head = (
        *texts,
        "runs",
        *(f"{name} ({unit})" if unit else name for _, name, unit, *_ in MEASURES),
    )
    rows = [
        (
            row.drive.place,
            row.drive.perturb,
            row.system,
            str(row.runs),
            *(_cell(row, name, decimals) for name, _, _, decimals, _ in MEASURES),
        )
        for row in report.rows
    ]
    return Table("Results", head, rows, texts, _ABOUT)


def _compared(report: OverviewJson) -> Table:
    head = ("systems", "perturbation", "better", "worse", "same", "median (m)", "p")
    rows = [
        (
            f"{c.second} - {c.first}",
            c.perturb,
            str(c.second_better),
            str(c.first_better),
            str(c.ties),
            f"{c.median_difference:+.3f}",
            "too few" if c.p_value is None else f"{c.p_value:.3g}",
        )
        for c in report.comparisons
    ]
    return Table("Difference in ATE", head, rows, ("systems", "perturbation"), _TESTED)


def _runs(report: OverviewJson) -> Table:
    head = ("sequence", "perturbation", "system", "seed", "frames", "ATE (m)", "run")
    rows = [
        (
            run.drive.place,
            run.drive.perturb,
            run.system,
            "-" if run.seed is None else str(run.seed),
            str(run.frames),
            _figure(run, "ate_rmse_m", 3),
            run.source,
        )
        for run in report.runs
    ]
    texts = ("sequence", "perturbation", "system", "run")
    return Table("Runs", head, rows, texts, folded=True)


def _made(report: OverviewJson) -> list[tuple[str, str]]:
    machines = dict.fromkeys(run.machine for run in report.runs if run.machine)
    return [
        ("machines", "; ".join(machines)),
        ("vslam", report.versions.get("vslam", "")),
        ("created", f"{report.created:%Y-%m-%d %H:%M:%S %Z}"),
    ]


def _cell(row: Row, name: str, decimals: int) -> str:
    spread = row.measures[name]
    return "n/a" if spread is None else _spread(spread, decimals)


def _spread(spread: Spread, decimals: int) -> str:
    median, least, greatest = (
        f"{value:.{decimals}f}" for value in (spread.median, spread.least, spread.greatest)
    )
    if decimals == 0 and spread.median % 1:
        median = f"{spread.median:.1f}"
    return median if least == greatest else f"{median} ({least}-{greatest})"


def _figure(run: RunEntry, name: str, decimals: int) -> str:
    value = run.measures[name]
    return "n/a" if value is None else f"{value:.{decimals}f}"
