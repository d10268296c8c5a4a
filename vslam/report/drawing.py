"""The common style of the figures in reports, and functions that save figures as PNG and SVG.

Every figure is drawn once, in the colours of a light theme. In the SVG, neutral colours are
replaced with CSS variables, so that a figure in the HTML page follows the reader's light or dark
theme.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib import style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from vslam.report import page
from vslam.types.features import TrackingState

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

BLUE, GREEN, AMBER, RED, GREY = "#3b82f6", "#10b981", "#f59e0b", "#ef4444", "#94a3b8"
VIOLET = "#8b5cf6"
COMPARED = ("#ec4899", "#f97316", "#06b6d4")  # colours of the detectors of --compare
STATE_COLORS = {
    TrackingState.WEAK: AMBER, TrackingState.INERTIAL: BLUE, TrackingState.LOST: RED,
    TrackingState.DROPPED: VIOLET, TrackingState.LATER: GREEN,
}  # fmt: skip

# Hex colour in the drawing -> CSS variable in the HTML report.
_THEME = {"#1f2430": "ink", "#5b6472": "muted", "#e3e7ed": "line"}
INK, MUTED, LINE = _THEME
STYLE = {
    "axes.axisbelow": True,
    "axes.edgecolor": LINE,
    "axes.grid": True,
    "axes.labelcolor": MUTED,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "figure.titlesize": 11.0,
    "figure.titleweight": "bold",
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "grid.color": LINE,
    "grid.linewidth": 0.8,
    "legend.borderaxespad": 0.2,
    "legend.fontsize": 9.0,
    "legend.frameon": False,
    "legend.handlelength": 1.4,
    "legend.labelcolor": INK,
    "lines.linewidth": 1.6,
    "svg.fonttype": "none",  # text stays text and takes the font of the page
    "text.parse_math": False,  # names may contain dollar signs
    "xtick.color": LINE,
    "xtick.labelcolor": MUTED,
    "ytick.color": LINE,
    "ytick.labelcolor": MUTED,
}
# Sizes in inches. Figures are small, so that their text stays readable on a phone, which shrinks
# figures to the width of its screen.
WIDTH, LOW, SQUARE = 4.6, 2.5, 5.4
DOTS_PER_INCH = 200
_LEGEND_CHARACTERS = 60  # number of characters that fit side by side
_HANDLE_CHARACTERS = 6  # width of the marker of an entry and of the gap to the next entry

Drawing = tuple[str, str, Figure]  # name, caption and figure


def new_figure(title: str, x_label: str, y_label: str, height: float) -> tuple[Figure, Axes]:
    """Create a figure with one plot. The title is at the upper left. ``height`` is in inches."""
    figure = empty_figure(title, height)
    axes = figure.add_subplot()
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.tick_params(length=3)
    return figure, axes


def empty_figure(title: str, height: float) -> Figure:
    """Create a figure without a plot. ``height`` is in inches."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, x=0.01, ha="left", color=INK)
    return figure


def add_legend(figure: Figure, axes: Axes) -> None:
    """Add a legend of all labelled artists below the axes, where it never covers data."""
    labels = axes.get_legend_handles_labels()[1]
    figure.legend(loc="outside lower center", ncols=_legend_columns(labels), columnspacing=1.2)


def _legend_columns(labels: Sequence[str]) -> int:
    """Return the largest number of columns for which the legend is not wider than the figure."""
    lengths = np.array([len(label) + _HANDLE_CHARACTERS for label in labels])
    columns = len(lengths)
    while columns > 1 and (
        sum(max(column) for column in np.array_split(lengths, columns)) > _LEGEND_CHARACTERS
    ):
        columns -= 1
    return columns


def finish_map(figure: Figure, axes: Axes) -> None:
    """Give both axes the same scale and add a margin and a legend."""
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    add_legend(figure, axes)


def plain_ticks(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers: 1, 2, 5, 10, ..."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter("{x:g}")


def draw(drawings: Iterable[Drawing]) -> list[page.Figure]:
    """Save figures in the style of reports. A figure has this style only if ``drawings`` is a
    generator that creates the figure while this function runs."""
    # after_reset ignores the user's matplotlibrc. Therefore, equal runs give equal figures.
    with style.context(STYLE, after_reset=True):
        return [save(*drawing) for drawing in drawings]


def save(name: str, caption: str, figure: Figure) -> page.Figure:
    """Save a figure as PNG and SVG. Equal figures give byte-identical files."""
    png, svg = io.BytesIO(), io.StringIO()
    figure.set_dpi(DOTS_PER_INCH)
    if (layout := figure.get_layout_engine()) is not None:
        layout.execute(figure)
        # With a layout engine, even one that does nothing, savefig would draw the figure twice.
        figure.set_layout_engine(None)
    figure.savefig(png, format="png")
    # The salt makes the ids of elements unique among the figures of a page. In equal runs, the ids
    # are equal.
    with mpl.rc_context({"svg.hashsalt": name}):
        figure.savefig(svg, format="svg", metadata={"Date": None}, transparent=True)
    text = svg.getvalue()
    text = text[text.index("<svg") :]
    for color, variable in _THEME.items():
        text = text.replace(color, f"var(--{variable})")
    return page.Figure(name, caption, png.getvalue(), text)
