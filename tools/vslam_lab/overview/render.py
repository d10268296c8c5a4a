"""Writes the report of many runs, as a page and as a CSV table."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from pathlib import Path
from urllib.parse import quote

from vslam.report.page import Bullets, Figure, Page, Pairs, Section, Table, number
from vslam.report.render import csv_text, page_files, write_files
from vslam.support.errors import counted
from vslam_lab.overview.collect import Found, collect
from vslam_lab.overview.figures import draw_overview
from vslam_lab.overview.schema import DECIMALS, MEASURES, Measure, OverviewJson, RunEntry, Spread
from vslam_lab.overview.summary import ALPHA, summarize
from vslam_lab.overview.versus import median_text, versus

_MOTION = ("rpe_m", "rpe_deg", "t_rel_percent", "r_rel_deg_per_100m")
_OTHER = ("loops_found", "loops_missed", "loops_wrong", "fps")
_ABOUT_ERRORS = (
    "Medians over runs, with the smallest and the largest value in brackets. The ATE counts every "
    "frame, including lost frames, after the alignment in the table. SE3 keeps the scale. Sim3 "
    "also fits the scale, for monocular runs. The causal ATE is that of the poses as they were "
    "first estimated. Systems with different alignments are not compared."
)
_ABOUT_MOTION = (
    "RPE is the error of the motion from one frame to the next. t_rel and r_rel are the error "
    "metrics of KITTI, which measure the drift over 100 to 800 m."
)
_ABOUT_OTHERS = (
    "Loops are judged by the ground truth. fps is the number of frames per second without the "
    "start of the program. Runs that shared a machine are slower."
)
ALIGNMENTS = {"se3": "SE3", "sim3": "Sim3"}
_TESTED = (
    "The columns better, worse and same give the numbers of sequences on which the errors of the "
    "system named first are smaller, larger or equal. p is the p-value of the two-sided Wilcoxon "
    f"signed-rank test over sequences, at the level {ALPHA:g}. It is not corrected for the number "
    "of tests. Each sequence counts once, with the median of its runs, because its runs are not "
    "independent. Over all conditions, it counts with the mean of these medians. Comparisons in "
    "which all sequences tie are left out."
)


def write_overview(
    runs: Collection[Path],
    trajectories: Collection[str],
    out: Path,
    baseline: str | None = None,
) -> OverviewJson:
    """Collect finished runs, and write a report of them into the folder ``out``.

    The files are ``report.html``, ``report.md``, ``report.json`` and ``table.csv``.

    Args:
        runs: folders that contain runs at any depth.
        trajectories: trajectories of other systems, each as a text
            ``NAME[@SEQUENCE[@PERTURB]]=FILE``.
        out: output folder, which is created if it does not exist.
        baseline: name of the system with which the others are compared; None for the simplest
            system.

    Raises:
        InputError: there is no finished run, there is no run of the baseline, a trajectory cannot
            be read, or more than one sequence could belong to a trajectory.
        ResultsError: a file cannot be written.
    """
    found = collect(runs, trajectories)
    report = summarize(found, baseline)
    figures = draw_overview(report, found)
    notes = list(dict.fromkeys((*report.notes, *found.notes)))  # drawing can add notes
    report = report.model_copy(update={"notes": notes})
    files = {"report.json": report.to_json(), "table.csv": render_csv(report)}
    page = overview_page(report, figures, _pages(found, out))
    write_files(out, files | page_files(page, "report"))
    return report


def overview_page(
    report: OverviewJson, figures: Collection[Figure], pages: Mapping[str, str]
) -> Page:
    """Make the page of a report of many runs.

    Args:
        pages: address of the page of each run that has one, by ``RunEntry.source``.
    """
    return Page(
        title(report),
        (f"vslam {report.versions.get('vslam', '')}", f"{report.created:%Y-%m-%d %H:%M %Z}"),
        (
            *versus(report),
            _compared(report),
            *_results(report),
            Section("", [*figures], wide=False),
            Section("Notes", [Bullets(report.notes)]),
            _runs(report, pages),
            Section("Provenance", [Pairs(_provenance(report))]),
        ),
    )


def title(report: OverviewJson) -> str:
    """Return a title with the names of the systems and the number of runs."""
    places = len({(row.drive.dataset, row.drive.place) for row in report.rows})
    return (
        f"{', '.join(report.systems)}: {counted(len(report.runs), 'run')} on "
        f"{counted(places, 'sequence')}"
    )


def render_csv(report: OverviewJson) -> str:
    """Format the summary of many runs as CSV, with one row for each drive and system.

    Each row has the median, the smallest and the largest value of each measure.
    """
    names = [name for name, *_ in MEASURES]
    head = ["dataset", "sequence", "excerpt", "perturb", "system", "alignment", "runs", "frames"]
    lines: list[list[object]] = [
        [*head, *(f"{n}{end}" for n in names for end in ("", "_least", "_greatest"))]
    ]
    for row in report.rows:
        cells: list[object] = [*row.drive.model_dump().values(), row.system, row.alignment]
        cells += [row.runs, row.frames]
        for name in names:
            spread = row.measures[name]
            found = (spread.median, spread.least, spread.greatest) if spread else ("", "", "")
            cells += found
        lines.append(cells)
    return csv_text(lines)


def _results(report: OverviewJson) -> list[Section]:
    """Return the tables with the results. A single table would be too wide."""
    texts = ("sequence", "perturbation", "system")

    def table(name: str, measures: Collection[Measure], note: str, *, aligned: bool) -> Section:
        columns = ["alignment"] if aligned else []
        columns += [f"{title} ({unit})" if unit else title for _, title, unit, *_ in measures]
        rows: list[tuple[str, ...]] = [
            (
                row.drive.place,
                row.drive.perturb,
                row.system,
                str(row.runs),
                *([ALIGNMENTS[row.alignment]] if aligned else []),
                *(_cell(row.measures[measure], decimals) for measure, _, _, decimals in measures),
            )
            for row in report.rows
        ]
        return Section(name, [Table((*texts, "runs", *columns), rows, texts, note)])

    errors = [measure for measure in MEASURES if measure[0] not in (*_MOTION, *_OTHER)]
    motion = [measure for measure in MEASURES if measure[0] in _MOTION]
    others = [measure for measure in MEASURES if measure[0] in _OTHER]
    return [
        table("Errors", errors, _ABOUT_ERRORS, aligned=True),
        table("Motion and drift", motion, _ABOUT_MOTION, aligned=False),
        table("Loops and speed", others, _ABOUT_OTHERS, aligned=False),
    ]


def _compared(report: OverviewJson) -> Section:
    texts = ("systems", "perturbation", "error", "winner")
    head = ("systems", "perturbation", "error", "better", "worse", "same", "median (m)", "p")
    titles = {name: title for name, title, *_ in MEASURES}
    rows: list[tuple[str, ...]] = [
        (
            f"{c.second} - {c.first}",
            c.perturb,
            titles[c.measure],
            str(c.second_better),
            str(c.first_better),
            str(c.ties),
            f"{c.median_difference:+.{DECIMALS[c.measure]}f}",
            "too few" if c.p_value is None else f"{c.p_value:.3g}",
            c.winner or "-",
        )
        for c in report.comparisons
        if c.ties < len(c.pairs)
    ]
    return Section("Differences", [Table((*head, "winner"), rows, texts, _TESTED)])


def _pages(found: Found, out: Path) -> dict[str, str]:
    """Return the address of the page of each run that has one, relative to the folder ``out``."""
    pages = {}
    for run in found.runs:
        folder = found.estimate[run.source].parent.resolve()
        if run.seed is not None and (folder / "report.html").is_file():
            relative = Path(os.path.relpath(folder / "report.html", out.resolve()))
            pages[run.source] = quote(relative.as_posix())
    return pages


def _runs(report: OverviewJson, pages: Mapping[str, str]) -> Section:
    head = ("sequence", "perturbation", "system", "seed", "frames", "ATE (m)", "run")
    rows: list[tuple[str, ...]] = [
        (
            run.drive.place,
            run.drive.perturb,
            run.system,
            _seed(run),
            str(run.frames),
            number(run.measures["ate_rmse_m"], "{:.3f}"),
            run.source,
        )
        for run in report.runs
    ]
    texts = ("sequence", "perturbation", "system", "run")
    links = [pages.get(run.source, "") for run in report.runs]
    return Section("Runs", [Table(head, rows, texts, links=links)], folded=True)


def _provenance(report: OverviewJson) -> list[tuple[str, str]]:
    machines = dict.fromkeys(run.machine for run in report.runs if run.machine)
    return [
        ("machines", "; ".join(machines)),
        ("vslam", report.versions.get("vslam", "")),
        ("created", f"{report.created:%Y-%m-%d %H:%M:%S %Z}"),
    ]


def _cell(spread: Spread | None, decimals: int) -> str:
    if spread is None:
        return "n/a"
    least, greatest = f"{spread.least:.{decimals}f}", f"{spread.greatest:.{decimals}f}"
    median = median_text(spread, decimals)
    return median if least == greatest else f"{median} ({least}-{greatest})"


def _seed(run: RunEntry) -> str:
    if run.seed is None:
        return "-"
    return f"{run.seed}, town {run.town}" if run.town else str(run.seed)
