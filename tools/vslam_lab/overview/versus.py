"""Shows comparisons of systems as tables (by sequence and perturbation) and as sentences."""

from __future__ import annotations

import re
from collections.abc import Iterator

from vslam.evaluation.loops import MIN_LENGTH_M
from vslam.report.page import Bullets, Section, Table
from vslam.support.errors import counted
from vslam_lab.overview.collect import without_settings
from vslam_lab.overview.schema import Comparison, Drive, OverviewJson, Row, Spread
from vslam_lab.overview.summary import ALPHA, COMPARED, ROTATION, least_pairs

_TEXTS = ("sequence", "perturbation")
_SHOWN = {**COMPARED, **ROTATION}
_MEASURES = ("lost_frames", *_SHOWN, "loops_found")
_WIDTH = 60  # characters for all columns of numbers, so that a table is at most 80 characters wide
_COLUMN = 6  # smallest width of a column of numbers, in characters
_NOTES = {
    "lost_frames": "Lost: number of lost frames.",
    "rpe_m": "RPE: error of the motion from one frame to the next.",
    "loops_found": (
        "Loops: revisits found of those in the ground truth; a dash if there are none."
    ),
}

Key = tuple[Drive, str]
Rows = dict[str, dict[Key, Row]]


def versus(report: OverviewJson) -> list[Section]:
    """Make the sections of the report that compare systems and name the winner.

    Two systems are in the same section if they have a drive and an alignment (se3 or sim3) in
    common. If no drive revisits a place, the first section explains why loop detectors cannot
    differ.
    """
    rows: Rows = {name: {} for name in report.systems}
    for row in report.rows:
        rows[row.system][row.drive, row.alignment] = row
    groups: list[list[str]] = []
    for name in report.systems:
        for group in groups:
            if any(rows[name].keys() & rows[other].keys() for other in group):
                group.append(name)
                break
        else:
            groups.append([name])
    sections = [_section(report, rows, group) for group in groups]
    first = Section("", [_without_revisits(report)])
    return [first, *sections] if first.parts[0] else sections


def median_text(spread: Spread | None, decimals: int) -> str:
    """Format a median. If a median of counts is not an integer, it gets one decimal."""
    if spread is None:
        return "n/a"
    return f"{spread.median:.{1 if decimals == 0 and spread.median % 1 else decimals}f}"


def _without_revisits(report: OverviewJson) -> str:
    """Explain why loop detectors hardly differ if no drive revisits a place.

    The text is empty if a drive revisits a place, or if there is no ground truth.
    """
    judged = [row for row in report.rows if row.measures["loops_found"] is not None]
    names = {row.system for row in judged if row.system == without_settings(row.system)}
    counts = [row.measures[name] for row in judged for name in ("loops_found", "loops_missed")]
    if len(names) < 2 or any(count.greatest for count in counts if count is not None):
        return ""
    no_loop = f"No drive revisits a stretch of {MIN_LENGTH_M:.0f} m or more"
    compared = [c for c in report.comparisons if {c.first, c.second} <= names]
    if all(_is_tie(one) for one in compared):
        return f"{no_loop}, so there is no loop to find and the loop detectors cannot differ."
    return (
        f"{no_loop}. Loop detectors can differ only in wrong loops and in loops on shorter "
        "stretches."
    )


def _is_tie(one: Comparison) -> bool:
    return one.ties == len(one.pairs)


def _section(report: OverviewJson, rows: Rows, names: list[str]) -> Section:
    order = {(row.drive, row.alignment): None for row in report.rows if row.system in names}
    words = [re.split(", | ", name) for name in names]  # headings break between these words
    width = sum(max(_COLUMN, *(1 + len(word) for word in parts)) for parts in words)
    per_table = max(1, _WIDTH // width)
    tables = []
    for k in range(0, len(_MEASURES), per_table):
        measures = _MEASURES[k : k + per_table]
        head = [*_TEXTS, *(f"{_title(one)}, {name}" for one in measures for name in names)]
        lines = [
            (
                key[0].place,
                key[0].perturb,
                *(_cell(rows[name].get(key), one) for one in measures for name in names),
            )
            for key in order
        ]
        notes = [_NOTES[one] for one in measures if one in _NOTES]
        note = " ".join(("Medians over runs.", *notes))
        tables.append(Table(tuple(head), lines, _TEXTS, note))
    title = f"Side by side: {' / '.join(names)}" if len(names) > 1 else names[0]
    return Section(title, (*tables, Bullets(tuple(_points(report, rows, names)))))


def _title(measure: str) -> str:
    if measure in _SHOWN:
        return f"{_SHOWN[measure].title} ({_SHOWN[measure].unit})"
    return {"lost_frames": "lost", "loops_found": "loops"}[measure]


def _cell(row: Row | None, measure: str) -> str:
    spread = None if row is None else row.measures[measure]
    if row is None or spread is None:
        return "n/a"
    if measure in _SHOWN:
        return _SHOWN[measure].text(spread.median)
    if measure == "lost_frames":
        return median_text(spread, 0)
    missed, wrong = row.measures["loops_missed"], row.measures["loops_wrong"]
    revisits = spread.median + (missed.median if missed else 0.0)
    text = f"{median_text(spread, 0)} of {revisits:g}" if revisits else "-"
    return f"{text}, {wrong.median:g} wrong" if wrong and wrong.median else text


def _points(report: OverviewJson, rows: Rows, names: list[str]) -> Iterator[str]:
    """Yield sentences that summarise the comparison of systems.

    Lost frames and loops are summed over the drives for which there are runs of all systems. Each
    system is then compared with the first system in the list that has a drive in common with it.
    """
    shared = set.intersection(*(set(rows[name]) for name in names))
    runs = {
        name: [
            run.measures
            for run in report.runs
            if run.system == name and (run.drive, run.alignment) in shared
        ]
        for name in names
    }

    def total(name: str, measure: str) -> float | None:
        known = [value for each in runs[name] if (value := each[measure]) is not None]
        return sum(known) if known else None

    lost = []
    loops = []
    for name in names if shared else ():
        frames, n = total(name, "lost_frames"), len(runs[name])
        count = "n/a" if frames is None else f"{frames:.0f}"
        lost.append(f"{name} {count} in {counted(n, 'run')}")
        found, missed, wrong = (
            total(name, measure) for measure in ("loops_found", "loops_missed", "loops_wrong")
        )
        if found is not None and missed is not None and wrong is not None:
            loops.append(f"{name} found {found:.0f} of {found + missed:.0f}, {wrong:.0f} wrong")
    if lost:
        yield f"Lost frames: {', '.join(lost)}."
    if loops:
        yield f"Revisits in these runs: {'; '.join(loops)}."
    shown = []
    for k, name in enumerate(names):
        sharing = (other for other in names[:k] if rows[other].keys() & rows[name].keys())
        baseline = next(sharing, None)
        for measure in COMPARED:
            comparisons = [
                one
                for one in report.comparisons
                if (one.first, one.second, one.measure) == (baseline, name, measure)
            ]
            # If there are several conditions, the last comparison is over all of them.
            shown += comparisons[-1:]
    yield from (one.words for one in shown)
    if any(one.p_value is None and one.first_better + one.second_better for one in shown):
        yield (
            f"Where fewer than {least_pairs()} sequences differ, Wilcoxon's test cannot reach "
            f"p < {ALPHA:g}: the result does not generalize to other sequences."
        )
