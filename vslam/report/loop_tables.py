"""The tables of loops, which stay short even where hundreds of candidates were rejected."""

from __future__ import annotations

import re
from collections import defaultdict

from vslam.errors import counted
from vslam.report.page import Row, Section, Table, number
from vslam.report.schema import LoopEntry, ReportJson

_MAX_CLOSED = 60
_MAX_REJECTED = 12
_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def loop_sections(report: ReportJson) -> list[Section]:
    """Closed loops, revisits, reasons of rejections, and the candidates nearest to acceptance."""
    return [
        Section("Loops closed", [_closed(report)]),
        Section("Revisits", [_revisits(report)], wide=False),
        Section("Loops rejected", [_reasons(report)], wide=False),
        Section("Rejected with the most inliers", [_nearly(report)], folded=True),
    ]


def _revisits(report: ReportJson) -> Table:
    rows: list[Row] = [
        (
            f"{r.first_frame}-{r.last_frame}",
            f"{r.first_match_frame}-{r.last_match_frame}",
            f"{r.length_m:.0f} m",
            "missed" if r.loop_frame is None else f"found at {r.loop_frame}",
        )
        for r in report.revisits
    ]
    note = "According to the ground truth: frames where the camera drives an earlier stretch again."
    return Table(("frames", "again", "length", "loop"), rows, ("loop",), note)


def _closed(report: ReportJson) -> Table:
    closed = [loop for loop in report.loops if loop.accepted]
    closed.sort(key=lambda loop: loop.right is not False)  # wrong ones first, else as they came
    rows: list[Row] = [
        (
            *_evidence(loop),
            _right(loop),
            number(loop.moved_m, "{:.2f}" if report.sensor == "mono" else "{:.2f} m"),
            number(loop.correction_s, "{:.2f} s"),
        )
        for loop in closed[:_MAX_CLOSED]
    ]
    head = (*_EVIDENCE, "pose", "moved", "time")
    note = (
        "Proposed by: the detectors that found the place. Verified by: the descriptors whose "
        "matches give the relative pose, ORB's or those that the network learned. Pose: compared "
        "with the ground truth. Moved: the largest distance that the correction moved a keyframe."
    )
    if report.sensor == "mono":
        note = f"{note.rstrip('.')}, in the unit of the map."
    if len(closed) > _MAX_CLOSED:
        note += f" {len(closed) - _MAX_CLOSED} more are in report.json."
    return Table(head, rows, ("pose",), note)


def _reasons(report: ReportJson) -> Table:
    groups: dict[str, list[LoopEntry]] = defaultdict(list)
    for loop in report.loops:
        if not loop.accepted:
            groups[_NUMBER.sub("0", loop.reason)].append(loop)
    ordered = sorted(groups.items(), key=lambda group: -len(group[1]))
    rows: list[Row] = [
        (
            _common(loops),
            str(len(loops)),
            str(max(one.inliers for one in loops)),
            _right_of(loops),
        )
        for _, loops in ordered
    ]
    head = ("reason", "candidates", "most inliers", "pose right")
    note = f"{counted(report.loops_rejected, 'candidate')} in all; report.json lists each."
    return Table(head, rows, ("reason",), note)


def _nearly(report: ReportJson) -> Table:
    rejected = [loop for loop in report.loops if not loop.accepted]
    rejected.sort(key=lambda loop: (-loop.inliers, -loop.matches, -loop.score))
    rows: list[Row] = [
        (*_evidence(loop), _right(loop), loop.reason) for loop in rejected[:_MAX_REJECTED]
    ]
    head = (*_EVIDENCE, "pose", "reason")
    return Table(head, rows, ("pose", "reason"))


_EVIDENCE = ("frame", "earlier", "proposed by", "score", "verified by", "matches", "inliers")


def _evidence(loop: LoopEntry) -> Row:
    query = "lost" if loop.query_frame is None else str(loop.query_frame)
    match = "before this run" if loop.match_frame is None else str(loop.match_frame)
    return (
        query, match, loop.proposed_by.replace("+", " + "), f"{loop.score:.3f}", loop.matched_by,
        str(loop.matches), str(loop.inliers),
    )  # fmt: skip


def _common(loops: list[LoopEntry]) -> str:
    """The reason of loops whose reasons differ only in their numbers, with the ranges of these."""
    columns = zip(*(_NUMBER.findall(loop.reason) for loop in loops), strict=True)
    ends = [(min(column, key=float), max(column, key=float)) for column in columns]
    ranges = iter([least if least == most else f"{least}-{most}" for least, most in ends])
    return _NUMBER.sub(lambda _: next(ranges), loops[0].reason)


def _right(loop: LoopEntry) -> str:
    return {True: "right", False: "wrong", None: "n/a"}[loop.right]


def _right_of(loops: list[LoopEntry]) -> str:
    judged = [loop.right for loop in loops if loop.right is not None]
    return f"{sum(judged)} of {len(judged)}" if judged else "n/a"
