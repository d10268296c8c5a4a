"""Writes the report of a stress test.

The report has the files ``stress.json``, ``boundaries.csv``, ``boundaries.jpg``, ``report.md`` and
``report.html``.
"""

from __future__ import annotations

import statistics
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from vslam.datasets.frames import Source
from vslam.datasets.perturbation import law_kind, sheet_of_laws
from vslam.report.page import Bullets, Figure, Page, Row, Section, Table, number
from vslam.report.render import csv_text, page_files, write_files
from vslam.support.errors import InputError, counted
from vslam_lab.stress.criterion import ABSOLUTE
from vslam_lab.stress.figures import draw_curves
from vslam_lab.stress.schema import BoundaryEntry, StressJson
from vslam_lab.stress.summary import mean_error

_ABOUT = (
    "The weakest strength at which a run fails, as found by bisection. The table gives the median "
    "over the seeds, the smallest and the largest value in brackets, and the reason for the "
    "failure with one of the seeds. > means that runs do not fail even at the greatest strength."
)
_NOT_MONOTONE = (
    "Bisection assumes that a system that does not fail at a strength does not fail at weaker "
    "strengths. These runs failed although a run at a greater strength did not fail."
)


def write_report(out: Path, report: StressJson, sequences: Mapping[str, Source]) -> None:
    """Write all files of the report of a stress test into the existing folder ``out``.

    Args:
        sequences: sequences by name, from which example images are taken. If the first sequence of
            the report is missing here, there are no example images.

    Raises:
        ResultsError: a file cannot be written.
    """
    sheet = _sheet(report, sequences)
    page = stress_page(report, draw_curves(report), sheet)
    write_files(
        out,
        {
            "stress.json": report.to_json(),
            **({"boundaries.csv": render_csv(report)} if report.boundaries else {}),
            **{figure.file: figure.image for figure in sheet},
            **page_files(page, "report"),
        },
        "free some space and repeat the command: finished runs are kept",
    )


def render_csv(report: StressJson) -> str:
    """Format the results as CSV, with one line for each search."""
    names = ("dataset", "sequence", "law", "unit", "system", "seed", "holds_to", "fails_at")
    lines: list[list[object]] = [[*names, "reason", "also_failed", "runs"]]
    for entry in report.boundaries:
        also = " ".join(f"{value:g}" for value in entry.also_failed)
        cells = [getattr(entry, name) for name in names]
        lines.append([*cells, entry.reason, also, len(entry.tested)])
    return csv_text(lines)


def title(report: StressJson) -> str:
    """Return a title with the names of the systems and of the sequences."""
    systems = list(dict.fromkeys(entry.system for entry in report.clean))
    places = list(dict.fromkeys(f"{entry.dataset} {entry.sequence}" for entry in report.clean))
    excerpt = f", {counted(report.max_frames, 'frame')}" if report.max_frames else ""
    does = "does" if len(systems) == 1 else "do"
    return f"Where {does} {', '.join(systems)} break? {', '.join(places)}{excerpt}"


def stress_page(
    report: StressJson, figures: Collection[Figure] = (), sheet: Collection[Figure] = ()
) -> Page:
    """Make the page of a stress test, with curves and with example images."""
    return Page(
        title(report),
        [report.criterion],
        (
            *boundary_sections(report),
            Section("Failures at weaker strengths", [_not_monotone(report)]),
            Section("Clean images", [_clean(report)]),
            Section("Images at the boundaries", [*sheet]),
            Section("", [*figures], wide=False),
            Section("Notes", [Bullets(report.notes)]),
            Section("Runs", [_runs(report)], folded=True),
        ),
    )


def boundary_sections(report: StressJson) -> list[Section]:
    """Return the sections of the report that are also printed on the command line."""
    return [*_boundaries(report), *_preset(report)]


def groups(report: StressJson) -> dict[tuple[str, str, str], list[BoundaryEntry]]:
    """Group the searches of a stress test by sequence, perturbation and system.

    The searches in a group differ in their seed.
    """
    found: dict[tuple[str, str, str], list[BoundaryEntry]] = {}
    for entry in report.boundaries:
        found.setdefault((entry.sequence, entry.law, entry.system), []).append(entry)
    return found


def cell(entries: Collection[BoundaryEntry]) -> str:
    """Format the strength at which runs fail, for example as ``60 (50-75), 12 % lost``.

    The value is the median over the seeds. The range is in parentheses.
    """
    if not entries:
        return ""
    law = law_kind(next(iter(entries)).law)
    values = [law.strongest if e.fails_at is None else e.fails_at for e in entries]
    holds = [entry.fails_at is None for entry in entries]
    middle, least, greatest = statistics.median(values), min(values), max(values)
    spread = "" if least == greatest else f" ({least:g}-{greatest:g})"
    sign = ">" if sum(holds) * 2 > len(holds) else ""
    reasons = [entry.reason for entry in entries if entry.reason]
    return f"{sign}{middle:g}{spread}" + (f", {reasons[0]}" if reasons and not sign else "")


def _boundaries(report: StressJson) -> list[Section]:
    systems = list(dict.fromkeys(entry.system for entry in report.boundaries))
    by = groups(report)
    found = []
    for sequence in dict.fromkeys(entry.sequence for entry in report.boundaries):
        rows: list[Row] = []
        for law in dict.fromkeys(entry.law for entry in report.boundaries):
            cells = [cell(by.get((sequence, law, system), ())) for system in systems]
            unit = "" if law_kind(law).unit == "x" else law_kind(law).unit
            if any(cells):
                rows.append((law, unit, f"{law_kind(law).strongest:g}", *cells))
        head = ("law", "unit", "strongest", *systems)
        table = Table(head, rows, ("law", "unit"), _ABOUT)
        found.append(Section(f"Boundaries, {sequence}", [table]))
    return found


def _preset(report: StressJson) -> list[Section]:
    if not report.corruptions:
        return []
    systems = list(report.corruptions[0].ate_sum_m)
    rows: list[Row] = []
    for entry in report.corruptions:
        cells = []
        for system in systems:
            error, lost = entry.error_percent.get(system), entry.lost_percent.get(system)
            cells.append("" if error is None or lost is None else f"{error:.0f} % ({lost:.0f} %)")
        rows.append((entry.sequence, entry.corruption, *cells, entry.note))
    means = [mean_error(report.corruptions, system) for system in systems]
    rows.append(("", "mean", *("" if m is None else f"{m:.0f} %" for m in means), ""))
    table = Table(
        ("sequence", "corruption", *systems, "law"),
        rows,
        ("sequence", "corruption", "law"),
        "The ATE summed over the five severities, in percent of the sum of the baseline. The mean "
        "share of lost frames is in brackets. The mean in the last row is over the corruptions for "
        "which every system has an ATE.",
    )
    title = f"Corruption error against {report.baseline}, preset {report.preset}"
    return [Section(title, [table])]


def _not_monotone(report: StressJson) -> Table:
    rows: list[Row] = [
        (
            entry.sequence, entry.law, entry.system, str(entry.seed),
            ", ".join(f"{value:g}" for value in entry.also_failed),
            f"{entry.holds_to:g}" if entry.holds_to is not None else "",
        )
        for entry in report.boundaries
        if entry.also_failed
    ]  # fmt: skip
    head = ("sequence", "law", "system", "seed", "also failed at", "no failure at")
    return Table(head, rows, head[:3], _NOT_MONOTONE)


def _clean(report: StressJson) -> Table:
    rows: list[Row] = [
        (
            entry.sequence,
            entry.system,
            f"{entry.lost_frames} of {entry.frames}",
            number(entry.ate_rmse_m, "{:.3f}"),
            number(entry.causal_ate_rmse_m, "{:.3f}"),
            number(entry.ate_limit_m, "{:.3f}"),
            "" if entry.loops_found is None else str(entry.loops_found),
        )
        for entry in report.clean
    ]
    head = ("sequence", "system", "lost", "ATE (m)", "causal (m)", "limit (m)", "revisits found")
    return Table(head, rows, head[:2])


def _runs(report: StressJson) -> Table:
    rows: list[Row] = [
        (
            entry.sequence,
            entry.law,
            entry.system,
            str(entry.seed),
            f"{test.strength:g}",
            "" if test.lost_percent is None else f"{test.lost_percent:.1f}",
            number(test.ate_rmse_m, "{:.3f}"),
            number(test.causal_ate_rmse_m, "{:.3f}"),
            test.verdict or "held",
            test.absolute,
        )
        for entry in report.boundaries
        for test in entry.tested
    ]
    head = (
        "sequence", "law", "system", "seed", "strength", "lost (%)", "ATE (m)", "causal (m)",
        "verdict", "absolute",
    )  # fmt: skip
    return Table(head, rows, (*head[:3], *head[-2:]), ABSOLUTE)


def _sheet(report: StressJson, sequences: Mapping[str, Source]) -> list[Figure]:
    """Draw one frame of the first sequence under each perturbation.

    The strength is the one at which the first system failed, or else the greatest strength.
    """
    specs: dict[str, str] = {}
    first = next(iter(sequences), None)
    for entry in report.boundaries:
        if entry.sequence == first and entry.law not in specs:
            strength = law_kind(entry.law).strongest if entry.fails_at is None else entry.fails_at
            specs[entry.law] = f"{entry.law}:{strength:g}"
    if first is None or not specs:
        return []
    try:
        image = sheet_of_laws(sequences[first], list(specs.values()), len(sequences[first]) // 2, 0)
    except InputError:  # the images were removed; the report is written without this picture
        return []
    import cv2

    data = bytes(np.asarray(cv2.imencode(".jpg", image)[1]).tobytes())
    caption = "For each law, the clean image and both perturbed images at the boundary."
    return [Figure("boundaries", caption, data, file="boundaries.jpg")]
