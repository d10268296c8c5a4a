"""Draws the trajectory seen from above, and the effect of loop closing on the trajectory."""

from __future__ import annotations

from collections.abc import Collection
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from vslam.evaluation.loops import LoopEvaluation
from vslam.evaluation.map_alignment import truth_alignment_of
from vslam.evaluation.trajectories import Evaluation
from vslam.report.drawing import (
    AMBER,
    BLUE,
    COMPARED,
    GREEN,
    GREY,
    INK,
    RED,
    SQUARE,
    STATE_COLORS,
    VIOLET,
    finish_map,
    new_figure,
)
from vslam.report.summary import evaluate_run
from vslam.run.outcome import RunOutcome
from vslam.types.geometry import inverses

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from vslam.run.gps import GpsTrack

Points = NDArray[np.float64]


def top_view(
    outcome: RunOutcome, evaluation: Evaluation | None, verdict: LoopEvaluation | None
) -> Figure:
    """Draw the trajectory and the ground truth, weak and lost frames, loops and missed revisits.

    The trajectories of the detectors of ``--compare`` are dashed. Each of these trajectories is
    aligned separately.
    """
    figure, axes = _new_map("Top view", outcome, evaluation)
    path = _aligned(outcome, evaluation, outcome.trajectory.T_wc[:, :3, 3])
    x, z = path[:, 0], path[:, 2]
    name = outcome.settings.detector if outcome.compared else "estimate"
    axes.plot(x, z, color=BLUE, label=name)
    for k, (other, color) in enumerate(zip(outcome.compared, cycle(COMPARED), strict=False)):
        its_own = None if evaluation is None else evaluate_run(other)[0]
        points = _aligned(other, its_own, other.trajectory.T_wc[:, :3, 3])
        # The dashes of each path are shifted, so that all paths stay visible where they coincide.
        dashes = (2.0 * k, (2.0, 2.0 * len(outcome.compared)))
        axes.plot(
            points[:, 0],
            points[:, 2],
            color=color,
            linestyle=dashes,
            label=other.settings.detector,
        )
    axes.plot(x[:1], z[:1], "o", color=INK, markersize=5, zorder=4, label="start")
    for state, color in STATE_COLORS.items():
        times = [track.timestamp for track in outcome.tracks if track.state == state]
        at = np.isin(outcome.trajectory.timestamps, times)
        if at.any():
            label = f"{state.lower()} ({at.sum()})"
            axes.plot(x[at], z[at], "o", color=color, markersize=3.5, label=label)
    if verdict is not None and verdict.n_missed:
        missed = verdict.loop_frame < 0
        stretches = [
            np.append(_at_frames(outcome, path, np.arange(first, last + 1)), [[np.nan] * 3], axis=0)
            for first, last in zip(
                verdict.revisits.first[missed], verdict.revisits.last[missed], strict=True
            )
        ]
        driven = np.concatenate(stretches)
        label = f"revisit missed ({missed.sum()})"
        axes.plot(driven[:, 0], driven[:, 2], color=VIOLET, linewidth=6, alpha=0.45, label=label)
    right = verdict.right if verdict else (None,) * len(outcome.loops)
    for wrong, color, name in ((False, GREEN, "loop"), (True, RED, "wrong loop")):
        chosen = [
            (edge.query, edge.match)
            for edge, is_right in zip(outcome.loops, right, strict=True)
            if edge.accepted
            and edge.query >= 0
            and (is_right is False) == wrong
            and outcome.keyframe_frames[edge.match] >= 0
        ]
        if chosen:
            frames = outcome.keyframe_frames[np.array(chosen)]
            lines = _lines(_at_frames(outcome, path, frames.ravel()).reshape(-1, 2, 3))
            label = f"{name} ({len(chosen)})"
            axes.plot(*lines, "o-", color=color, linewidth=1.2, markersize=4, label=label, zorder=5)
    finish_map(figure, axes)
    return figure


def loop_closing(outcome: RunOutcome, evaluation: Evaluation | None) -> Figure:
    """Draw the positions of keyframes before the first loop closure and at the end of the run.

    Both sets of positions are transformed to the ground-truth frame by the alignment of the final
    trajectory. Therefore, all differences between them are caused by loop closing.
    """
    figure, axes = _new_map("Map before and after loop closing", outcome, evaluation)
    before = _aligned(outcome, evaluation, _centres(outcome.corrections[0].T_cw_before))
    after = _aligned(outcome, evaluation, outcome.keyframes.T_wc[:, :3, 3])
    for points, color, label in ((before, AMBER, "before"), (after, BLUE, "after")):
        axes.plot(
            points[:, 0],
            points[:, 2],
            ".-",
            color=color,
            linewidth=1.2,
            markersize=3.5,
            label=label,
        )
    ends = []
    for correction in outcome.corrections:
        at = [
            np.flatnonzero(correction.keyframes == k)
            for k in (correction.edge.query, correction.edge.match)
        ]
        if all(map(len, at)):
            ends.append(_centres(correction.T_cw_before[np.concatenate(at)]))
    if ends:
        lines = _lines(_aligned(outcome, evaluation, np.concatenate(ends)).reshape(-1, 2, 3))
        label = f"loop, before ({len(ends)})"
        axes.plot(*lines, "o--", color=GREEN, linewidth=1.2, markersize=4, label=label, zorder=5)
    finish_map(figure, axes)
    return figure


def gps_map(track: GpsTrack) -> Figure:
    """Draw the trajectory with GPS, the trajectory without GPS, and the fixes."""
    figure, axes = new_figure("With GPS", "east (m)", "north (m)", SQUARE)
    used = track.anchored.used
    fixes, refused = track.fixes[used], track.fixes[~used]
    axes.plot(*fixes.T[:2], ".", color=GREY, markersize=4, label=f"fixes ({len(fixes)})")
    if len(refused):
        axes.plot(*refused.T[:2], "x", color=RED, markersize=4, label=f"refused ({len(refused)})")
    axes.plot(*track.visual.T[:2], color=AMBER, linewidth=1.2, label="vision alone")
    axes.plot(*track.trajectory.T_wc[:, :2, 3].T, color=BLUE, linewidth=1.2, label="with GPS")
    finish_map(figure, axes)
    return figure


def _new_map(title: str, outcome: RunOutcome, evaluation: Evaluation | None) -> tuple[Figure, Axes]:
    unit = "m" if outcome.is_metric or evaluation is not None else "map units"
    figure, axes = new_figure(title, f"x ({unit})", f"z ({unit})", SQUARE)
    if evaluation is not None and outcome.ground_truth is not None:
        truth = outcome.ground_truth.T_wc[:, :3, 3]
        axes.plot(truth[:, 0], truth[:, 2], color=GREY, linewidth=3.4, alpha=0.65, label="truth")
    return figure, axes


def _centres(T_cw: NDArray[np.float64]) -> Points:
    return inverses(T_cw)[:, :3, 3]


def _lines(ends: Points) -> Collection[Points]:
    """Convert ``(M, 2, 3)`` line segments to the x and z of one polyline, in which the segments are
    separated by NaN."""
    gaps = np.full((len(ends), 1, 3), np.nan)
    points = np.concatenate([ends, gaps], axis=1).reshape(-1, 3)
    return points[:, 0], points[:, 2]


def _at_frames(outcome: RunOutcome, path: Points, frames: NDArray[np.int64]) -> Points:
    """Return the ``(F, 3)`` positions of some frames of the run. ``path`` contains the positions of
    all frames."""
    times = np.array([outcome.tracks[k].timestamp for k in frames])
    index = np.searchsorted(outcome.trajectory.timestamps, times)
    return path[np.minimum(index, len(path) - 1)]


def _aligned(outcome: RunOutcome, evaluation: Evaluation | None, points: Points) -> Points:
    """Transform ``(N, 3)`` points from the world frame of the run to the ground-truth frame."""
    if evaluation is None:
        return points
    S = truth_alignment_of(outcome, evaluation).S_truth_world
    return np.asarray(points @ S[:3, :3].T + S[:3, 3])
