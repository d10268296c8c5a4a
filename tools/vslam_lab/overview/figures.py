"""Draws the figures of a report of many runs: errors, error curves and trajectories."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vslam.report import page
from vslam.report.drawing import (
    AMBER,
    BLUE,
    GREEN,
    GREY,
    INK,
    LOW,
    RED,
    SQUARE,
    VIOLET,
    Drawing,
    add_legend,
    draw,
    empty_figure,
    finish_map,
    new_figure,
    plain_ticks,
)
from vslam.support.errors import InputError
from vslam_lab.overview.collect import Found, read_aligned, without_settings
from vslam_lab.overview.schema import Drive, OverviewJson, Row, RunEntry
from vslam_lab.overview.summary import strengths, systems

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLORS = [AMBER, BLUE, GREEN, VIOLET, RED, "#06b6d4", "#ec4899", "#84cc16"]
_MIN_STRENGTHS = 2  # least number of strengths in a curve, not counting unperturbed images
_DASHES = ["-", (0, (5, 1.5)), (0, (2, 1)), (0, (5, 1, 1, 1))]  # overlapping lines stay visible

Looks = Mapping[str, tuple[str, Any]]  # colour and dashes of each system


def draw_overview(report: OverviewJson, found: Found) -> list[page.Figure]:
    """Draw the figures of a report of many runs. Figures without data are left out."""
    looks = {
        name: (_COLORS[k % len(_COLORS)], _DASHES[k % len(_DASHES)])
        for k, name in enumerate(systems(report.rows))
    }
    drawings = chain(
        _errors(report.rows, looks),
        _curves(report.rows, looks),
        _paths(report, found, looks),
    )
    return draw((_identifier(name), caption, figure) for name, caption, figure in drawings)


def _errors(rows: list[Row], looks: Looks) -> Iterator[Drawing]:
    for perturb in dict.fromkeys(row.drive.perturb for row in rows):
        known = [r for r in rows if r.drive.perturb == perturb and r.measures["ate_rmse_m"]]
        places = list(dict.fromkeys((row.drive.dataset, row.drive.place) for row in known))
        if not places:
            continue
        figure, axes = new_figure(f"ATE, {_light(perturb)}", "sequence", "ATE RMSE (m)", LOW)
        names = systems(known)
        for k, name in enumerate(names):
            mine = [row for row in known if row.system == name]
            at = np.array([places.index((r.drive.dataset, r.drive.place)) for r in mine], float)
            at += 0.6 * ((k + 0.5) / len(names) - 0.5)
            median, least, greatest = _spreads(mine, "ate_rmse_m")
            axes.vlines(at, least, greatest, color=looks[name][0], linewidth=2.2, alpha=0.5)
            axes.plot(at, median, "o", color=looks[name][0], markersize=5, label=name)
        _logarithmic(axes)
        axes.set_xticks(range(len(places)), [place for _, place in places])
        axes.set_xlim(-0.5, len(places) - 0.5)
        axes.grid(visible=False, axis="x")
        add_legend(figure, axes)
        yield (
            f"ate-{perturb}",
            "Medians over runs, with lines from the smallest to the largest value; logarithmic.",
            figure,
        )


def _curves(rows: list[Row], looks: Looks) -> Iterator[Drawing]:
    """Draw the ATE and the number of loops against the strength of a perturbation."""
    laws = {
        law.partition(":")[0]: None
        for row in rows
        for law in row.drive.perturb.split(",")
        if law != "none"
    }
    for law in laws:
        strength = strengths((row.drive for row in rows), law)
        places = {(d.dataset, d.sequence, d.excerpt): d for d, s in strength.items() if s > 0}
        for key, place in places.items():
            mine = [
                row
                for row in rows
                if row.drive in strength
                and (row.drive.dataset, row.drive.sequence, row.drive.excerpt) == key
            ]
            if len({strength[row.drive] for row in mine} - {0.0}) < _MIN_STRENGTHS:
                continue
            yield (
                f"strength-{law}-{place.dataset}-{place.place}",
                "Medians over runs, shaded from the smallest to the largest value. Strength 0 "
                "stands for the unperturbed images.",
                _curve(f"{place.place}: {law}", mine, strength, looks),
            )


def _curve(
    title: str,
    rows: list[Row],
    strength: dict[Drive, float],
    looks: Looks,
) -> Figure:
    figure = empty_figure(title, 1.7 * LOW)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
    for name in systems(rows):
        mine = sorted((r for r in rows if r.system == name), key=lambda r: strength[r.drive])
        color, dashes = looks[name]
        for axes, measure in ((upper, "ate_rmse_m"), (lower, "loops_found")):
            some = [row for row in mine if row.measures[measure]]
            if not some or (measure == "loops_found" and without_settings(name) == "none"):
                continue
            at = [strength[row.drive] for row in some]
            median, least, greatest = _spreads(some, measure)
            axes.fill_between(at, least, greatest, color=color, alpha=0.16, linewidth=0)
            label = name if axes is upper else "_again"  # one legend entry for both panels
            axes.plot(at, median, "o", linestyle=dashes, color=color, markersize=4, label=label)
    upper.set_ylabel("ATE RMSE (m)")
    lower.set(xlabel="strength", ylabel="loops found")
    lower.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    for axes in (upper, lower):
        axes.set_ylim(bottom=0)
        axes.tick_params(length=3)
    add_legend(figure, upper)
    return figure


def _paths(report: OverviewJson, found: Found, looks: Looks) -> Iterator[Drawing]:
    """Draw the trajectories of all systems on each drive, using the run with the median ATE."""
    for drive in dict.fromkeys(row.drive for row in report.rows):
        figure, axes = new_figure(
            f"{drive.place}, {_light(drive.perturb)}", "x (m)", "z (m)", SQUARE
        )
        rows = [row for row in report.rows if row.drive == drive]
        if not _draw_paths(axes, rows, found, looks):
            continue
        finish_map(figure, axes)
        yield (
            f"path-{drive.dataset}-{drive.place}-{drive.perturb}",
            "Seen from above, aligned to the ground truth. Each system is represented by its run "
            "with the median ATE.",
            figure,
        )


def _draw_paths(axes: Axes, rows: list[Row], found: Found, looks: Looks) -> int:
    drawn = 0
    for row in rows:
        runs = [r for r in found.runs if r.drive == row.drive and r.system == row.system]
        try:
            estimate, truth = read_aligned(found, _median_run(runs))
        except InputError as error:
            found.notes.append(f"{row.system} is not drawn on {row.drive.place}: {error}")
            continue
        if truth is not None and not drawn:
            x, z = truth.T_wc[:, 0, 3], truth.T_wc[:, 2, 3]
            axes.plot(x, z, color=GREY, linewidth=3.4, alpha=0.65, label="truth")
            axes.plot(x[:1], z[:1], "o", color=INK, markersize=5, zorder=4, label="start")
        color, dashes = looks[row.system]
        x, z = estimate.T_wc[:, 0, 3], estimate.T_wc[:, 2, 3]
        axes.plot(x, z, color=color, linestyle=dashes, label=row.system)
        drawn += 1
    return drawn


def _median_run(runs: list[RunEntry]) -> RunEntry:
    """Return the run with the median ATE of the runs whose ATE is known."""
    known = [run for run in runs if run.measures["ate_rmse_m"] is not None]
    ordered = sorted(known or runs, key=lambda run: run.measures["ate_rmse_m"] or 0.0)
    return ordered[(len(ordered) - 1) // 2]


def _spreads(rows: list[Row], measure: str) -> np.ndarray:
    spreads = [s for row in rows if (s := row.measures[measure]) is not None]
    return np.array([(s.median, s.least, s.greatest) for s in spreads]).T


def _logarithmic(axes: Axes) -> None:
    low, high = axes.dataLim.intervaly
    axes.set_yscale("log")
    axes.set_ylim(max(low, 1e-4) / 3.0, max(high, 1e-4) * 3.0)
    plain_ticks(axes.yaxis)


def _light(perturb: str) -> str:
    return "unperturbed images" if perturb == "none" else perturb


def _identifier(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-")
