"""Draws the figures of a report: maps, errors, tracking and times."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from vslam.evaluation.loops import LoopEvaluation
from vslam.evaluation.odometry import MotionErrors, motion_errors
from vslam.evaluation.trajectories import Evaluation
from vslam.report import page
from vslam.report.drawing import (
    AMBER,
    BLUE,
    GREEN,
    GREY,
    INK,
    LOW,
    MUTED,
    RED,
    STATE_COLORS,
    VIOLET,
    Drawing,
    add_legend,
    draw,
    new_figure,
)
from vslam.report.summary import intervals, stage_names
from vslam.report.trajectory_figures import gps_map, loop_closing, top_view
from vslam.run.outcome import RunOutcome
from vslam.types.features import TrackingState, TrackResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STAGE_COLORS = [BLUE, AMBER, GREEN, VIOLET, "#ec4899", "#06b6d4", "#84cc16", "#f97316", GREY]
_AXIS_COLORS = (BLUE, AMBER, GREEN)
_BIASES = (
    ("gyro_bias", "gyroscope", "rad/s", slice(0, 3)),
    ("accel_bias", "accelerometer", "m/s²", slice(3, 6)),
)
_MOTION_S = 1.0  # duration of the motions whose errors are drawn
_MAX_BINS = 240  # in the plot of stacked times; a bin is then one or two pixels wide


def draw_figures(
    outcome: RunOutcome, evaluation: Evaluation | None, verdict: LoopEvaluation | None
) -> list[page.Figure]:
    """Draw all figures of the report for which the run has data.

    Args:
        evaluation: errors of ``outcome.trajectory`` relative to the ground truth. None if they
            cannot be computed.
        verdict: comparison of ``outcome.loops`` with the ground truth. None if a frame has no
            ground truth.
    """
    return draw(_drawings(outcome, evaluation, verdict))


def _drawings(
    outcome: RunOutcome, evaluation: Evaluation | None, verdict: LoopEvaluation | None
) -> Iterator[Drawing]:
    if len(outcome.trajectory) and (outcome.n_tracked or not outcome.tracks):
        caption = "Seen from above, at equal scale; z points ahead of the first camera."
        if evaluation is not None and evaluation.alignment != "none":
            caption += f" The estimate is shown after {evaluation.alignment.upper()} alignment."
        if outcome.compared:
            caption += " Dashed lines: the detectors of --compare, each after its own alignment."
        yield "top_view", caption, top_view(outcome, evaluation, verdict)
    if (track := outcome.gps_track) is not None:
        caption = (
            "Trajectories seen from above, in metres from the first fix: with GPS, and from "
            "vision alone after alignment with the fixes."
        )
        yield "gps_map", caption, gps_map(track)
    if outcome.corrections:
        caption = (
            "Keyframes before the first loop was closed, and at the end. A dashed line joins "
            "the two keyframes of a loop as they were before its correction. The length of the "
            "line is the drift that the correction removed."
        )
        yield "loop_closing", caption, loop_closing(outcome, evaluation)
    if evaluation is not None:
        yield (
            "error_along_path",
            "Distance of each position from the ground truth.",
            _error_along_path(outcome, evaluation),
        )
        yield "error_histogram", "Number of frames by error.", _error_histogram(evaluation)
    if outcome.ground_truth is not None and not outcome.sequence.camera.monocular:
        errors = motion_errors(outcome.tracks, outcome.ground_truth, _MOTION_S)
        if len(errors.first) > 1:
            yield (
                "odometry_error",
                "Error of the motion over one second from odometry alone (trajectory_odom.tum), "
                "and twice its standard deviation according to the estimated covariance. About one "
                "error in twenty should be larger than that, if the ground truth is accurate "
                "enough over one second. KITTI's ground truth is not.",
                _odometry_error(errors),
            )
    if outcome.tracks:
        yield (
            "tracked_points",
            f"Number of {_usable_features(outcome)[0]}, of matches with landmarks, and of inlier "
            "matches.",
            _tracked_points(outcome),
        )
    if any(track.imu_bias is not None for track in outcome.tracks):
        for name, instrument, unit, part in _BIASES:
            yield (
                name,
                f"Estimated bias of the {instrument} along its axes, and twice its standard "
                "deviation. Shaded frames are carried by the IMU alone.",
                _bias(outcome.tracks, f"Bias of the {instrument}", unit, part),
            )
    if stage_names(outcome.tracks):
        yield (
            "stage_times",
            "Wall time of each stage, stacked. In long runs, it is averaged over a few frames.",
            _stage_times(outcome),
        )
        yield (
            "stage_distribution",
            "Boxes contain 50 % of the frames that went through a stage, and whiskers 90 %.",
            _stage_distribution(outcome),
        )


def _error_along_path(outcome: RunOutcome, evaluation: Evaluation) -> Figure:
    figure, axes = new_figure("Error along the path", "distance travelled (m)", "error (m)", LOW)
    distances, errors = evaluation.distances_m, evaluation.errors_m
    lost = [track.timestamp for track in outcome.tracks if track.state == TrackingState.LOST]
    at = np.isin(evaluation.timestamps, lost)
    axes.fill_between(distances, errors, color=BLUE, alpha=0.14, linewidth=0)
    axes.plot(distances, errors, color=BLUE)
    axes.axhline(
        evaluation.ate_rmse_m,
        color=INK,
        linewidth=1.0,
        linestyle=(0, (4, 3)),
        label=f"RMSE {evaluation.ate_rmse_m:.3g} m",
    )
    if at.any():
        axes.plot(
            distances[at], errors[at], "o", color=RED, markersize=3.5, label=f"lost ({at.sum()})"
        )
    add_legend(figure, axes)
    axes.set_ylim(0.0, 1.12 * max(float(errors.max()), 1e-9))
    axes.margins(x=0.0)
    return figure


def _error_histogram(evaluation: Evaluation) -> Figure:
    figure, axes = new_figure("Error histogram", "error (m)", "frames", LOW)
    errors = evaluation.errors_m
    bins = np.linspace(0.0, max(float(errors.max()), 1e-9), 41).tolist()
    axes.hist(errors, bins=bins, color=BLUE, alpha=0.85, rwidth=0.88)
    marks = [("median", float(np.median(errors)), GREEN), ("RMSE", evaluation.ate_rmse_m, INK)]
    for label, value, color in marks:
        axes.axvline(value, color=color, linewidth=1.4, label=f"{label} {value:.3g} m")
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.grid(visible=False, axis="x")
    add_legend(figure, axes)
    return figure


def _odometry_error(errors: MotionErrors) -> Figure:
    figure, axes = new_figure("Odometry over one second", "frame", "m", LOW)
    axes.plot(errors.first, 2.0 * errors.sigma, color=AMBER, linewidth=1.1, label="two sigma")
    axes.plot(errors.first, errors.distance, color=BLUE, linewidth=1.1, label="error")
    axes.set_ylim(bottom=0)
    _frame_axis(axes, errors.first)
    add_legend(figure, axes)
    return figure


def _tracked_points(outcome: RunOutcome) -> Figure:
    figure, axes = new_figure("Tracked points", "frame", "points", LOW)
    tracks = outcome.tracks
    frame = np.array([track.index for track in tracks])
    extracted = np.array([track.n_features > 0 for track in tracks])
    every = np.ones(len(tracks), np.bool_)
    series = [
        (*_usable_features(outcome), extracted, GREY, 1.1),
        ("matches", [track.n_matches for track in tracks], every, AMBER, 1.1),
        ("inliers", [track.n_inliers for track in tracks], every, BLUE, 1.6),
    ]
    for label, values, shown, color, width in series:
        marker = "o" if np.count_nonzero(shown) == 1 else ""
        y = np.array(values)[shown]
        axes.plot(frame[shown], y, color=color, linewidth=width, marker=marker, label=label)
    for state, color in STATE_COLORS.items():
        _shade(axes, tracks, state, color)
    axes.set_ylim(bottom=0)
    _frame_axis(axes, frame)
    add_legend(figure, axes)
    return figure


def _bias(tracks: Sequence[TrackResult], title: str, unit: str, part: slice) -> Figure:
    figure, axes = new_figure(title, "frame", unit, LOW)
    known = [track for track in tracks if track.imu_bias is not None]
    frame = np.array([track.index for track in known])
    bias = np.array([track.imu_bias for track in known])[:, part]
    sigma = np.array([track.imu_bias_sigma for track in known])[:, part]
    for values, deviation, axis, color in zip(bias.T, sigma.T, "xyz", _AXIS_COLORS, strict=True):
        low, high = values - 2.0 * deviation, values + 2.0 * deviation
        axes.fill_between(frame, low, high, color=color, alpha=0.12, linewidth=0)
        axes.plot(frame, values, color=color, linewidth=1.1, label=axis)
    _shade(axes, tracks, TrackingState.INERTIAL, STATE_COLORS[TrackingState.INERTIAL])
    _frame_axis(axes, np.array([track.index for track in tracks]))
    add_legend(figure, axes)
    return figure


def _shade(axes: Axes, tracks: Sequence[TrackResult], state: TrackingState, color: str) -> None:
    """Shade the frames with a tracking state."""
    at = np.array([track.state == state for track in tracks])
    frame = np.array([track.index for track in tracks])
    for first, last in intervals(at):
        # Legends skip labels that begin with "_", so each state has one entry.
        name = state.lower() if first == np.flatnonzero(at)[0] else "_again"
        axes.axvspan(
            frame[first] - 0.5, frame[last] + 0.5, color=color, alpha=0.3, lw=0, label=name
        )


def _usable_features(outcome: RunOutcome) -> tuple[str, list[int]]:
    """Return a name for the features that can become landmarks, and their number in each frame. For
    a monocular camera, these are all features. For other cameras, these are the features with a
    known depth."""
    sensor = outcome.sequence.camera.sensor
    if sensor == "mono":
        return "features", [track.n_features for track in outcome.tracks]
    name = "features with depth" if sensor == "rgbd" else "stereo features"
    return name, [track.n_stereo for track in outcome.tracks]


def _stage_times(outcome: RunOutcome) -> Figure:
    figure, axes = new_figure("Time per frame", "frame", "ms", LOW)
    tracks, names = outcome.tracks, stage_names(outcome.tracks)
    frame = np.array([track.index for track in tracks])
    ms = np.array([[track.stage_ms.get(name, 0.0) for name in names] for track in tracks])
    first = np.unique(np.linspace(0, len(tracks), _MAX_BINS, endpoint=False).astype(int))
    mean = np.add.reduceat(ms, first) / np.diff(first, append=len(tracks))[:, None]
    edges = np.append(frame[first], frame[-1] + 1) - 0.5
    axes.stackplot(
        np.repeat(edges, 2)[1:-1],
        np.repeat(mean, 2, axis=0).T,
        labels=names,
        colors=_stage_colors(names),
        antialiased=False,  # antialiasing would leave thin lines between the bands
        linewidth=0,
    )
    axes.set_ylim(bottom=0)
    _frame_axis(axes, frame)
    add_legend(figure, axes)
    return figure


def _stage_distribution(outcome: RunOutcome) -> Figure:
    names = stage_names(outcome.tracks)
    figure, axes = new_figure("Time per stage", "ms", "", max(LOW, 0.9 + 0.3 * len(names)))
    ms = [[t.stage_ms[name] for t in outcome.tracks if name in t.stage_ms] for name in names]
    low, q1, median, q3, high = np.array(
        [np.percentile(times, (5, 25, 50, 75, 95)) for times in ms]
    ).T
    rows = np.arange(len(names))
    axes.hlines(rows, low, high, color=MUTED, linewidth=1.2)
    axes.barh(rows, q3 - q1, left=q1, height=0.56, color=_stage_colors(names))
    axes.vlines(median, rows - 0.28, rows + 0.28, color=INK, linewidth=2.0)
    axes.set_yticks(rows, names)
    axes.invert_yaxis()
    axes.set_xlim(left=0)
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)
    return figure


def _frame_axis(axes: Axes, frame: NDArray[np.int64]) -> None:
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.set_xlim(frame[0] - 0.5, frame[-1] + 0.5)


def _stage_colors(names: list[str]) -> list[str]:
    return [_STAGE_COLORS[i % len(_STAGE_COLORS)] for i in range(len(names))]
