"""Each system beside the baseline: a row for each sequence and perturbation, and who wins."""

from __future__ import annotations

from collections.abc import Iterator

from vslam.lab.overview.schema import Drive, OverviewJson, Row, Spread
from vslam.lab.overview.summary import COMPARED, is_tie
from vslam.report.page import Bullets, Section, Table

_TEXTS = ("sequence", "perturbation")
_LOOPS = ("loops_found", "loops_missed", "loops_wrong")
_NOTE = "Medians over runs. Lost: number of lost frames. Loops: found / missed / wrong."

Key = tuple[Drive, str]


def versus(report: OverviewJson) -> list[Section]:
    """A table for each system with its baseline, and sentences on which of them wins over all.

    The baseline of a system is the first one that has run on the same drive and was aligned in the
    same way. A system without such a partner stands alone.
    """
    rows: dict[str, dict[Key, Row]] = {name: {} for name in report.systems}
    for row in report.rows:
        rows[row.system][row.drive, row.alignment] = row
    opponents = dict(_pairs(report.systems, rows))
    paired = {*opponents, *opponents.values()}
    found = []
    for name in report.systems:
        if name in opponents:
            found.append(_section(report, rows, (opponents[name], name)))
        elif name not in paired:
            found.append(_section(report, rows, (name,)))
    return found


def median_text(spread: Spread | None, decimals: int) -> str:
    """The median in so many decimals; that of an even number of counts may need one more."""
    if spread is None:
        return "n/a"
    return f"{spread.median:.{1 if decimals == 0 and spread.median % 1 else decimals}f}"


def _pairs(names: list[str], rows: dict[str, dict[Key, Row]]) -> Iterator[tuple[str, str]]:
    """Each system that has a baseline, and that."""
    for k, name in enumerate(names):
        for baseline in names[:k]:
            if rows[baseline].keys() & rows[name].keys():
                yield name, baseline
                break


def _section(
    report: OverviewJson, rows: dict[str, dict[Key, Row]], names: tuple[str, ...]
) -> Section:
    pair = len(names) == 2
    head = [*_TEXTS, *(f"lost, {name}" for name in names)]
    for shown in COMPARED.values():
        title = f"{shown.title} ({shown.unit})"
        head += [*(f"{title}, {name}" for name in names), *(["diff."] if pair else [])]
    head += [f"loops, {name}" for name in names]
    order = {(row.drive, row.alignment): None for row in report.rows if row.system in names}
    lines = [_line(key, [rows[name].get(key) for name in names]) for key in order]
    note = f"{_NOTE} Differences: {names[1]} minus {names[0]}." if pair else _NOTE
    points = Bullets(tuple(_points(report, rows, names)))
    title = f"{names[1]} against {names[0]}" if pair else names[0]
    return Section(title, (Table(tuple(head), lines, _TEXTS, note), points))


def _line(key: Key, rows: list[Row | None]) -> tuple[str, ...]:
    drive, _ = key
    spreads = [row.measures if row else {} for row in rows]
    cells = [drive.place, drive.perturb]
    cells += [median_text(each.get("lost_frames"), 0) for each in spreads]
    for measure, shown in COMPARED.items():
        found = [each.get(measure) for each in spreads]
        cells += ["n/a" if spread is None else shown.text(spread.median) for spread in found]
        if len(rows) == 2:
            cells.append(_difference(found[0], found[1], measure))
    for each in spreads:
        loops = [median_text(each.get(name), 0) for name in _LOOPS]
        cells.append("n/a" if "n/a" in loops else "/".join(loops))
    return tuple(cells)


def _difference(first: Spread | None, second: Spread | None, measure: str) -> str:
    if first is None or second is None:
        return "n/a"
    difference = second.median - first.median
    return "tie" if is_tie(difference, measure) else COMPARED[measure].text(difference, "+")


def _points(
    report: OverviewJson, rows: dict[str, dict[Key, Row]], names: tuple[str, ...]
) -> Iterator[str]:
    """Totals over the runs on the drives that all of ``names`` share, lost frames first, then the
    comparisons of two systems."""
    shared = set.intersection(*(set(rows[name]) for name in names))
    runs = {
        name: [
            run.measures
            for run in report.runs
            if run.system == name and (run.drive, run.alignment) in shared
        ]
        for name in names
    }

    def total(name: str, measure: str) -> str:
        known = [value for each in runs[name] if (value := each[measure]) is not None]
        return f"{sum(known):.0f}" if known else "n/a"

    lost = (
        f"{name} {total(name, 'lost_frames')} in {len(runs[name])} run"
        + ("s" if len(runs[name]) != 1 else "")
        for name in names
    )
    yield f"Lost frames: {', '.join(lost)}."
    loops = (f"{name} {' / '.join(total(name, loop) for loop in _LOOPS)}" for name in names)
    yield f"Loops found / missed / wrong in these runs: {', '.join(loops)}."
    for measure in COMPARED:
        found = [
            one
            for one in report.comparisons
            if (one.first, one.second, one.measure) == (*names, measure)
        ]
        if found:
            yield found[-1].words  # over all conditions where there are several
