"""What the report says of the protocol online."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from vslam.lab.loopbench.schema import OnlineScore
from vslam.report.drawing import INK, ReportFigure, save
from vslam.report.page import Table

_VERIFIED = ("nothing", "orb", "learned", "both")
_DRAWN = {"nothing": "-", "both": ":"}  # line styles
_ABOUT = (
    "One decision an image against the images before the window. Recall: right decisions of the "
    "images with a true match there. In brackets: without counting as wrong the matches that lie "
    "near the place and are not marked."
)
_ABOUT_COUNTS = (
    "Decisions at the lowest threshold whose match is marked / lies near / is another place."
)


def online_words(scores: Sequence[OnlineScore]) -> list[str]:
    """For each drive and verification, which detector recalls most without a wrong match."""
    sentences = []
    for data in _in_order(s.data for s in scores):
        for by in ("nothing", "both"):
            of = [s for s in scores if (s.data, s.verified_by) == (data, by)]
            best = max(s.recall_at_100_precision for s in of)
            names = [s.detector for s in of if s.recall_at_100_precision == best]
            how = "unverified" if by == "nothing" else "verified by ORB or learned descriptors"
            sentences.append(
                f"{data}, {of[0].answerable} of {of[0].images} images with a true match, {how}: "
                f"highest recall at 100 % precision {best:.3f} ({', '.join(names)})."
            )
    return sentences


def online_tables(scores: Sequence[OnlineScore]) -> list[Table]:
    """Recall at 100 % precision, largest F1 and counts."""
    return [
        _table(scores, "Recall at 100 % precision",
               lambda s: f"{s.recall_at_100_precision:.3f} ({s.recall_at_100_precision_far:.3f})",
               _ABOUT),
        _table(scores, "Largest F1", lambda s: f"{s.max_f1:.3f} ({s.max_f1_far:.3f})", ""),
        _table(scores, "Decisions right / near / far",
               lambda s: f"{s.right} / {s.near} / {s.far}", _ABOUT_COUNTS),
    ]  # fmt: skip


def _table(
    scores: Sequence[OnlineScore], title: str, shown: Callable[[OnlineScore], str], note: str
) -> Table:
    names = _in_order(s.detector for s in scores)
    cells: dict[tuple[str, str, str], OnlineScore] = {
        (s.data, s.verified_by, s.detector): s for s in scores
    }
    rows = []
    for data in _in_order(s.data for s in scores):
        first = cells[data, "nothing", names[0]]
        about = (data, str(first.images), str(first.answerable), first.window)
        rows += [
            (*about, by, *(shown(cells[data, by, name]) for name in names)) for by in _VERIFIED
        ]
    head = ("drive", "images", "with a match", "window", "verified by", *names)
    return Table(title, head, rows, ("drive", "window", "verified by"), note)


def draw_online(scores: Sequence[OnlineScore], colors: Sequence[str]) -> ReportFigure:
    """Precision against recall over the decision threshold, a panel for each drive."""
    drives, names = (_in_order(getattr(s, key) for s in scores) for key in ("data", "detector"))
    columns = min(2, len(drives))
    rows = -(-len(drives) // columns)
    figure = Figure(figsize=(6.8, 0.7 + 2.3 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes in grid.flat[len(drives) :]:
        axes.set_axis_off()
    for axes, data in zip(grid.flat, drives, strict=False):
        axes.set_title(data, fontsize=9, color=INK)
        for score in (s for s in scores if s.data == data and s.verified_by in _DRAWN):
            axes.plot(
                score.curve.recall, score.curve.precision, _DRAWN[score.verified_by],
                color=colors[names.index(score.detector) % len(colors)],
                label=score.detector if score.verified_by == "nothing" else "",
            )  # fmt: skip
        axes.set(xlim=(0, 1), ylim=(0, 1.02))
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    for axes in grid[-1, : (len(drives) - 1) % columns + 1]:
        axes.set_xlabel("recall", fontsize=9.5)
    figure.supylabel("precision", fontsize=9.5)
    caption = (
        "Precision and recall over images, along the decision threshold, a panel for each drive; "
        "dotted: decisions verified by ORB or learned descriptors."
    )
    return save("online", caption, figure)


def _in_order(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))
