"""Draws precision-recall curves of loop detectors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from matplotlib.figure import Figure

from vslam.report import page
from vslam.report.drawing import (
    AMBER,
    BLUE,
    GREEN,
    GREY,
    INK,
    RED,
    VIOLET,
    Drawing,
    add_legend,
    draw,
    empty_figure,
)
from vslam_lab.loopbench.schema import Curve, DecisionCurve, LoopsJson

_COLORS = [GREY, BLUE, VIOLET, AMBER, GREEN, RED]
_DASHES = ["-", "--", ":"]  # for the first six detectors, the next six, and all other detectors
_VERIFIED = {"nothing": "-", "both": ":"}

# Panel, curve, label in the legend (it may be empty), colour and dashes.
Line = tuple[str, Curve | DecisionCurve, str, str, str]


def draw_curves(report: LoopsJson) -> list[page.Figure]:
    """Draw precision-recall curves: two figures for each set of images, and one for all drives.

    The first figure for a set of images shows the curves over all pairs, and the second one shows
    those over the most similar images of each query. There is one panel per condition (change of
    the query images).
    """
    return draw(_drawings(report))


def _drawings(report: LoopsJson) -> Iterator[Drawing]:
    if online := report.online:
        drives, names = _in_order(s.data for s in online), _in_order(s.detector for s in online)
        caption = (
            "Precision and recall over images at varying decision thresholds, with a panel for "
            "each drive. Dotted: decisions verified by ORB or learned descriptors."
        )
        lines: Iterable[Line] = (
            (score.data, score.curve, score.detector if score.verified_by == "nothing" else "",
             _COLORS[names.index(score.detector) % len(_COLORS)], _VERIFIED[score.verified_by])
            for score in online
            if score.verified_by in _VERIFIED
        )  # fmt: skip
        yield "online", caption, _panels("", drives, lines)
    names = _in_order(score.detector for score in report.cells)
    for number, data in enumerate(_in_order(score.data for score in report.cells)):
        scores = [score for score in report.cells if score.data == data]
        conditions = _in_order(score.condition for score in scores)
        usual, over_top = [], []
        for score in scores:
            dash, color = divmod(names.index(score.detector), len(_COLORS))
            look = score.detector, _COLORS[color], _DASHES[dash % len(_DASHES)]
            usual.append((score.condition, score.curve, *look))
            if score.top_curve:
                over_top.append((score.condition, score.top_curve, *look))
        caption = f"Precision against recall on {data} without verification, "
        panel = "with a panel for each condition."
        yield f"precision_recall_{number}", caption + panel, _panels(data, conditions, usual)
        if over_top:
            top = max(len(score.top_average_precision) for score in scores)
            caption += f"over the {top} most similar images of each query, "
            figure = _panels(data, conditions, over_top)
            yield f"precision_recall_top_{number}", caption + panel, figure


def _panels(title: str, names: list[str], lines: Iterable[Line]) -> Figure:
    columns = min(2, len(names))
    rows = -(-len(names) // columns)
    figure = empty_figure(title, 0.7 + 1.8 * rows)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes in grid.flat[len(names) :]:
        axes.set_axis_off()
    panels = dict(zip(names, grid.flat, strict=False))
    for name, axes in panels.items():
        axes.set_title(name, fontsize=9, color=INK)
        axes.set(xlim=(0, 1), ylim=(0, 1.02))
    named: set[str] = set()  # the legend lists the lines of all panels
    for name, curve, label, color, dashes in lines:
        shown = "" if label in named else label
        panels[name].plot(curve.recall, curve.precision, dashes, color=color, label=shown)
        named.add(label)
    add_legend(figure, grid[0, 0])
    for axes in grid[-1, : (len(names) - 1) % columns + 1]:
        axes.set_xlabel("recall", fontsize=9.5)
    figure.supylabel("precision", fontsize=9.5)
    return figure


def _in_order(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))
