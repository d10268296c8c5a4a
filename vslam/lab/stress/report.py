"""The report of a stress test: ``stress.json``, ``boundaries.csv``, ``report.md``, ``report.html``,
``boundaries.png``."""

from __future__ import annotations

import base64
import csv
import io
import statistics
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from vslam.camera import Image
from vslam.datasets.frames import Source
from vslam.datasets.perturbation import law_kind, sheet_of_laws
from vslam.errors import InputError, ResultsError
from vslam.lab.stress.figures import draw_curves
from vslam.lab.stress.schema import BoundaryEntry, StressJson
from vslam.lab.stress.summary import mean_error
from vslam.report.page import Row, Table, markdown_table, render_page

_ABOUT = (
    "Weakest strength that fails by bisection, median over seeds, in brackets the least and the "
    "greatest; > where the strongest strength holds. Behind it the reason of one seed."
)
_NOT_MONOTONE = (
    "Bisection believes that what holds at one strength holds at all weaker ones. These failed "
    "although a stronger one held."
)


def write_report(out: Path, report: StressJson, sequences: Mapping[str, Source]) -> None:
    """Write all files of the report.

    Args:
        out: an existing folder.
        report: the numbers.
        sequences: by name, for images at the boundaries; those that are not there are left out.

    Raises:
        ResultsError: a file cannot be written.
    """
    sheet = _sheet(report, sequences)
    try:
        (out / "stress.json").write_text(report.model_dump_json(indent=2) + "\n", encoding="utf-8")
        if report.boundaries:
            (out / "boundaries.csv").write_text(render_csv(report), encoding="utf-8")
        (out / "report.md").write_text(render_markdown(report), encoding="utf-8")
        if sheet is not None:
            (out / "boundaries.png").write_bytes(_encoded(sheet, ".png"))
        (out / "report.html").write_text(render_html(report, sheet), encoding="utf-8")
    except OSError as error:
        raise ResultsError(
            f"{out}: the report cannot be written ({error.strerror}); free some space and give "
            "the same command again: finished runs are kept."
        ) from error


def render_csv(report: StressJson) -> str:
    """A line for each search."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = ("dataset", "sequence", "law", "unit", "system", "seed", "holds_to", "fails_at")
    writer.writerow([*names, "reason", "also_failed", "runs"])
    for entry in report.boundaries:
        cells = [getattr(entry, name) for name in names]
        also = " ".join(f"{value:g}" for value in entry.also_failed)
        writer.writerow(
            ["" if cell is None else cell for cell in cells]
            + [entry.reason, also, len(entry.tested)]
        )
    return text.getvalue()


def tables(report: StressJson) -> list[Table]:
    """Every table of the report."""
    found = [*_boundaries(report), _preset(report), _not_monotone(report), _clean(report)]
    return [table for table in (*found, _runs(report)) if table.rows]


def title(report: StressJson) -> str:
    """What the report is of, in one line."""
    systems = list(dict.fromkeys(entry.system for entry in report.clean))
    places = list(dict.fromkeys(f"{entry.dataset} {entry.sequence}" for entry in report.clean))
    excerpt = f", {report.max_frames} frames" if report.max_frames else ""
    does = "does" if len(systems) == 1 else "do"
    return f"Where {does} {', '.join(systems)} break? {', '.join(places)}{excerpt}"


def render_markdown(report: StressJson) -> str:
    """Markdown whose tables are aligned, to be read in a terminal."""
    lines = [f"# {title(report)}", "", report.criterion, ""]
    for table in tables(report):
        lines += [f"## {table.title}", "", *markdown_table(table.head, table.rows), ""]
        lines += [table.note, ""] if table.note else []
    if report.notes:
        lines += ["## Notes", "", *(f"- {note}" for note in report.notes), ""]
    return "\n".join(lines)


def render_boundaries(report: StressJson) -> str:
    """What the command line prints."""
    found = [*_boundaries(report), _preset(report)]
    return "\n".join(
        "\n".join([table.title, "", *markdown_table(table.head, table.rows), ""])
        for table in found
        if table.rows
    )


def render_html(report: StressJson, sheet: Image | None) -> str:
    """One self-contained page."""
    picture = None if sheet is None else base64.b64encode(_encoded(sheet, ".jpg")).decode()
    return render_page(
        "stress.html.jinja",
        report=report,
        title=title(report),
        tables=tables(report),
        figures=draw_curves(report),
        sheet=picture,
    )


def groups(report: StressJson) -> dict[tuple[str, str, str], list[BoundaryEntry]]:
    """Searches that differ in their seed alone, by sequence, law and system."""
    found: dict[tuple[str, str, str], list[BoundaryEntry]] = {}
    for entry in report.boundaries:
        found.setdefault((entry.sequence, entry.law, entry.system), []).append(entry)
    return found


def cell(entries: Collection[BoundaryEntry]) -> str:
    """``60 (50-75), 12 % lost``: where the seeds fail."""
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


def _boundaries(report: StressJson) -> list[Table]:
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
        found.append(Table(f"Boundaries, {sequence}", head, rows, ("law", "unit"), _ABOUT))
    return found


def _preset(report: StressJson) -> Table:
    if not report.corruptions:
        return Table("", (), [])
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
    return Table(
        f"Corruption error against {report.baseline}, preset {report.preset}",
        ("sequence", "corruption", *systems, "law"),
        rows,
        ("sequence", "corruption", "law"),
        "ATE summed over the five severities, in percent of the baseline's; in brackets the mean "
        "share of lost frames. The mean is over corruptions that have a law and an ATE of each.",
    )


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
    head = ("sequence", "law", "system", "seed", "also failed at", "held at")
    return Table("Weaker and failed", head, rows, head[:3], _NOT_MONOTONE)


def _clean(report: StressJson) -> Table:
    rows: list[Row] = [
        (
            entry.sequence,
            entry.system,
            f"{entry.lost_frames} of {entry.frames}",
            _number(entry.ate_rmse_m),
            _number(entry.causal_ate_rmse_m),
            _number(entry.ate_limit_m),
            "" if entry.loops_found is None else str(entry.loops_found),
        )
        for entry in report.clean
    ]
    head = ("sequence", "system", "lost", "ATE (m)", "causal (m)", "limit (m)", "revisits found")
    return Table("Images as they are", head, rows, head[:2])


def _runs(report: StressJson) -> Table:
    rows: list[Row] = [
        (
            entry.sequence,
            entry.law,
            entry.system,
            str(entry.seed),
            f"{test.strength:g}",
            "" if test.lost_percent is None else f"{test.lost_percent:.1f}",
            _number(test.ate_rmse_m),
            _number(test.causal_ate_rmse_m),
            test.verdict or "held",
        )
        for entry in report.boundaries
        for test in entry.tested
    ]
    head = (
        "sequence", "law", "system", "seed", "strength", "lost (%)", "ATE (m)", "causal (m)",
        "verdict",
    )  # fmt: skip
    return Table("Runs", head, rows, (*head[:3], "verdict"), folded=True)


def _number(value: float | None) -> str:
    return "n/a" if value is None else f"{value:.3f}"


def _sheet(report: StressJson, sequences: Mapping[str, Source]) -> Image | None:
    """A frame in the middle of the first sequence under each law, at the weakest strength at which
    the first system failed, or at the strongest of all."""
    specs: dict[str, str] = {}
    first = next(iter(sequences), None)
    for entry in report.boundaries:
        if entry.sequence == first and entry.law not in specs:
            strength = law_kind(entry.law).strongest if entry.fails_at is None else entry.fails_at
            specs[entry.law] = f"{entry.law}:{strength:g}"
    if first is None or not specs:
        return None
    try:
        return sheet_of_laws(sequences[first], list(specs.values()), len(sequences[first]) // 2, 0)
    except InputError:  # the images went away while it ran: the numbers are worth more
        return None


def _encoded(image: Image, suffix: str) -> bytes:
    import cv2

    return bytes(np.asarray(cv2.imencode(suffix, image)[1]).tobytes())
