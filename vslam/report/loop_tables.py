"""Creates the tables and pictures of loops in a report.

The size of the tables is limited, even if there are hundreds of rejected candidates.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection
from typing import TYPE_CHECKING

from vslam.report.page import Figure, Row, Section, Table, number
from vslam.report.schema import LoopEntry, ReportJson
from vslam.support.errors import counted

if TYPE_CHECKING:
    from vslam.run.loop_pictures import LoopPicture

_MAX_CLOSED = 60
_MAX_REJECTED = 12
_MAX_PICTURES = 6  # they take about 0.5 MB of the page
_DESCRIPTORS = {"orb": "ORB descriptors", "learned": "learned descriptors"}
_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def loop_sections(report: ReportJson) -> list[Section]:
    """Create the sections about closed loops, revisits and rejected loop candidates. Of the
    rejected candidates, only those with the most inliers are listed."""
    return [
        Section("Loops closed", [_closed(report)]),
        Section("Revisits", [_revisits(report)], wide=False),
        Section("Loops rejected", [_reasons(report)], wide=False),
        Section("Rejected with the most inliers", [_nearly_accepted(report)], folded=True),
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
    note = (
        "Frames in which, according to the ground truth, the camera drives along an earlier "
        "stretch again."
    )
    return Table(("frames", "earlier frames", "length", "loop"), rows, ("loop",), note)


def _closed(report: ReportJson) -> Table:
    closed = [loop for loop in report.loops if loop.accepted]
    closed.sort(key=lambda loop: loop.right is not False)  # stable; wrong loops come first
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
        "Proposed by: the detectors that found the place. Verified by: the descriptors (ORB or "
        "learned) whose matches give the relative pose. Pose: whether the relative pose agrees "
        "with the ground truth. Moved: the largest distance by which the correction moved a "
        "keyframe."
    )
    if report.sensor == "mono":
        note = f"{note.rstrip('.')}, in units of the map."
    if len(closed) > _MAX_CLOSED:
        note += f" report.json lists {len(closed) - _MAX_CLOSED} more."
    return Table(head, rows, ("pose",), note)


def _reasons(report: ReportJson) -> Table:
    groups: dict[str, list[LoopEntry]] = defaultdict(list)
    for loop in report.loops:
        if not loop.accepted:
            groups[_NUMBER.sub("0", loop.reason)].append(loop)
    ordered = sorted(groups.items(), key=lambda group: -len(group[1]))
    rows: list[Row] = [
        (
            _shared_reason(loops),
            str(len(loops)),
            str(max(one.inliers for one in loops)),
            _right_share(loops),
        )
        for _, loops in ordered
    ]
    head = ("reason", "candidates", "most inliers", "pose right")
    note = f"{counted(report.loops_rejected, 'candidate')} in total; report.json lists them."
    return Table(head, rows, ("reason",), note)


def _nearly_accepted(report: ReportJson) -> Table:
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


def _shared_reason(loops: list[LoopEntry]) -> str:
    """Combine several reasons that differ only in their numbers. The numbers are replaced with
    their ranges."""
    columns = zip(*(_NUMBER.findall(loop.reason) for loop in loops), strict=True)
    ends = [(min(column, key=float), max(column, key=float)) for column in columns]
    ranges = iter([low if low == high else f"{low}-{high}" for low, high in ends])
    return _NUMBER.sub(lambda _: next(ranges), loops[0].reason)


def _right(loop: LoopEntry) -> str:
    return {True: "right", False: "wrong", None: "n/a"}[loop.right]


def _right_share(loops: list[LoopEntry]) -> str:
    judged = [loop.right for loop in loops if loop.right is not None]
    return f"{sum(judged)} of {len(judged)}" if judged else "n/a"


def seen_loops(report: ReportJson, pictures: Collection[LoopPicture]) -> list[Figure]:
    """Draw pictures of a few closed loops. Wrong loops come first, followed by loops that were
    verified using learned descriptors.

    Args:
        report: the content of ``report.json``, which lists the loops of the run.
        pictures: pictures of closed loops. Only loops whose two images were kept have a picture.
    """
    closed = {(loop.query_frame, loop.match_frame): loop for loop in report.loops if loop.accepted}
    shown = [
        (loop, picture)
        for picture in pictures
        if (loop := closed.get((picture.query_frame, picture.match_frame))) is not None
    ]
    if not shown:
        return []
    from vslam.run.loop_pictures import draw_picture

    shown.sort(key=lambda one: (one[0].right is not False, one[0].matched_by != "learned"))
    return [
        Figure(name, _caption(loop), draw_picture(picture), file=f"figures/{name}")
        for loop, picture in shown[:_MAX_PICTURES]
        if (name := f"loop-{picture.query_frame}-{picture.match_frame}.jpg")
    ]


def seen_note(report: ReportJson, seen: Collection[Figure]) -> str:
    """Return a note that explains the pictures, and says how many of the closed loops they show."""
    note = "Lines connect matched points; at most 60 matches are drawn."
    if len(seen) < report.loops_closed:
        note += f" {len(seen)} of the {report.loops_closed} closed loops are shown."
    return note


def _caption(loop: LoopEntry) -> str:
    shows = "was wrongly matched to" if loop.right is False else "shows"
    return (
        f"Frame {loop.query_frame} (right) {shows} the place of frame {loop.match_frame} (left): "
        f"{loop.inliers} matches agree; proposed by {loop.proposed_by.replace('+', ' and ')}, "
        f"verified by {_DESCRIPTORS[loop.matched_by]}."
    )
