"""Draws curves of a stress test: lost frames, ATE and loops against perturbation strength."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib.ticker import MaxNLocator

from vslam.datasets.perturbation import law_kind
from vslam.report import page
from vslam.report.drawing import (
    AMBER,
    BLUE,
    GREEN,
    LOW,
    RED,
    VIOLET,
    add_legend,
    draw,
    empty_figure,
    plain_ticks,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vslam_lab.stress.schema import BoundaryEntry, StressJson

_COLORS = (BLUE, AMBER, GREEN, VIOLET, RED)
# For each panel: the value, the title, and the smallest upper end of the axis. Without a smallest
# upper end, a curve of zeros would not be drawn at the bottom of the panel.
_PANELS = (
    ("lost_percent", "lost (%)", 5.0),
    ("ate_rmse_m", "ATE (m)", 0.1),
    ("loops_closed", "loops", 1.2),
)


def draw_curves(report: StressJson) -> list[page.Figure]:
    """Draw lost frames, ATE and loops against strength, for each sequence and perturbation."""
    systems = list(dict.fromkeys(entry.system for entry in report.boundaries))
    colors = {name: _COLORS[k % len(_COLORS)] for k, name in enumerate(systems)}
    groups: dict[tuple[str, str], list[BoundaryEntry]] = {}
    for entry in report.boundaries:
        groups.setdefault((entry.sequence, entry.law), []).append(entry)
    caption = "One line per seed; crosses mark failed runs. The strength increases to the right."
    return draw(
        (f"{sequence}-{law}", caption, _curves(sequence, law, entries, colors))
        for (sequence, law), entries in groups.items()
    )


def _curves(
    sequence: str, law: str, entries: list[BoundaryEntry], colors: dict[str, str]
) -> Figure:
    figure = empty_figure(f"{sequence}: {law}", 1.9 * LOW)
    panels = figure.subplots(len(_PANELS), 1, sharex=True, height_ratios=[3, 3, 2])
    named: set[str] = set()
    for entry in entries:
        color = colors[entry.system]
        for panel, (name, *_) in zip(panels, _PANELS, strict=True):
            some = [test for test in entry.tested if getattr(test, name) is not None]
            at = [test.strength for test in some]
            values = [getattr(test, name) for test in some]
            label = "_again" if entry.system in named or panel is not panels[0] else entry.system
            panel.plot(at, values, "-", color=color, linewidth=1.2, alpha=0.7, label=label)
            for marker, failed in (("o", False), ("x", True)):
                points = [k for k, test in enumerate(some) if bool(test.verdict) is failed]
                panel.plot(
                    [at[k] for k in points], [values[k] for k in points], marker, color=color,
                    markersize=4,
                )  # fmt: skip
        named.add(entry.system)
    kind = law_kind(law)
    for panel, (_, title, least) in zip(panels, _PANELS, strict=True):
        panel.set_ylabel(title)
        panel.set_ylim(0, max(least, 1.05 * panel.get_ylim()[1]))
        panel.tick_params(length=3)
    panels[2].yaxis.set_major_locator(MaxNLocator(3, integer=True))
    panels[2].set_xlabel("strength" if kind.unit == "x" else kind.unit)
    if kind.logarithmic:
        panels[2].set_xscale("log")
        plain_ticks(panels[2].xaxis)
    if kind.strongest < kind.weakest:
        panels[2].invert_xaxis()
    add_legend(figure, panels[0])
    return figure
