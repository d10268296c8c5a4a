"""The closed loops that a report shows in pictures."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

from vslam.report.page import Figure
from vslam.report.schema import LoopEntry, ReportJson

if TYPE_CHECKING:
    from vslam.run.loop_pictures import LoopPicture

_MOST = 6  # loops in pictures: about 0.5 MB of the page
_DESCRIPTORS = {"orb": "ORB descriptors", "learned": "learned descriptors"}


def seen_loops(report: ReportJson, pictures: Collection[LoopPicture]) -> list[Figure]:
    """Draw the closed loops that a reader should see: wrong ones first, then those that learned
    descriptors verified, otherwise in their order.

    Args:
        report: of the run.
        pictures: of those of its closed loops of which both images are kept.
    """
    closed = {(loop.query_frame, loop.match_frame): loop for loop in report.loops if loop.accepted}
    of_loop = [(closed.get((one.query_frame, one.match_frame)), one) for one in pictures]
    shown = [(loop, picture) for loop, picture in of_loop if loop is not None]
    if not shown:
        return []
    from vslam.run.loop_pictures import draw_picture

    shown.sort(key=lambda one: (one[0].right is not False, one[0].matched_by != "learned"))
    return [
        Figure(name, _caption(loop), draw_picture(picture), file=f"figures/{name}")
        for loop, picture in shown[:_MOST]
        if (name := f"loop-{picture.query_frame}-{picture.match_frame}.jpg")
    ]


def seen_note(report: ReportJson, seen: Collection[Figure]) -> str:
    """What the pictures show, and how many of the closed loops have one."""
    note = "Lines join what both images show; at most 60 matches are drawn."
    if len(seen) < report.loops_closed:
        note += f" {len(seen)} of the {report.loops_closed} closed loops are shown."
    return note


def _caption(loop: LoopEntry) -> str:
    wrong = loop.right is False
    shows = "was wrongly taken for" if wrong else "shows"
    return (
        f"Frame {loop.query_frame} (right) {shows} the place of frame {loop.match_frame} (left): "
        f"{loop.inliers} matches agree; proposed by {loop.proposed_by.replace('+', ' and ')}, "
        f"verified by {_DESCRIPTORS[loop.matched_by]}."
    )
