"""What the command line prints of a run and of an evaluation: rows of a name and a value."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from vslam.evaluate import Evaluation
    from vslam.run import RunOutcome

_LOOK_AT = (("report", "report.html"), ("recording", "recording.rrd"))


def print_rows(rows: list[tuple[str, str]]) -> None:
    """Print names and values, the values one below the other."""
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        typer.echo(f"{name:<{width}}  {value}")


def evaluation_rows(evaluation: Evaluation) -> list[tuple[str, str]]:
    """ATE, RPE and drift."""
    rows = [
        ("ATE rmse", f"{evaluation.ate_rmse_m:.3f} m"),
        ("ATE mean, max", f"{evaluation.ate_mean_m:.3f} m, {evaluation.ate_max_m:.3f} m"),
        ("RPE per frame", f"{evaluation.rpe_m:.4f} m, {evaluation.rpe_deg:.4f} deg"),
    ]
    if evaluation.t_rel_percent is None:
        return [*rows, ("drift", "path shorter than 100 m")]
    return [
        *rows,
        ("t_rel", f"{evaluation.t_rel_percent:.3f} %"),
        ("r_rel", f"{evaluation.r_rel_deg_per_100m:.3f} deg/100 m"),
    ]


def print_summary(
    outcome: RunOutcome, evaluation: Evaluation | None, remark: str, folder: Path
) -> None:
    """Print what matters of a run that is over.

    Args:
        remark: why there is no evaluation.
        folder: where its results are.
    """
    from vslam.features import TrackingState

    tracks = outcome.tracks
    lost = sum(track.state is TrackingState.LOST for track in tracks)
    dropped = sum(track.state is TrackingState.DROPPED for track in tracks)
    submaps = f" in {outcome.n_submaps} sub-maps" if outcome.n_submaps > 1 else ""
    size = f"{outcome.n_keyframes} keyframes, {outcome.n_landmarks} landmarks{submaps}"
    rows = [
        *_scale(outcome),
        ("frames", f"{len(tracks)} done, {lost} lost, {len(outcome.skipped)} unreadable"),
        *_latency(outcome, dropped),
        *(evaluation_rows(evaluation) if evaluation else [("evaluation", remark)]),
        ("loops", _loops(outcome)),
        ("speed", f"{(len(tracks) - dropped) / outcome.wall_s:.1f} fps" if outcome.wall_s else "-"),
        ("map", size),
        ("folder", str(folder)),
        *((name, str(folder / file)) for name, file in _LOOK_AT if (folder / file).exists()),
    ]
    if outcome.interrupted:
        rows.insert(0, ("interrupted", outcome.interrupted))
    print_rows(rows)
    _print_comparison(outcome, evaluation)


def _latency(outcome: RunOutcome, dropped: int) -> list[tuple[str, str]]:
    if not outcome.latency_ms:
        return []
    import numpy as np

    median, p99 = np.percentile(outcome.latency_ms, [50, 99])
    return [("real time", f"{dropped} frames dropped, latency {median:.0f} ms, p99 {p99:.0f} ms")]


def _scale(outcome: RunOutcome) -> list[tuple[str, str]]:
    if outcome.settings.alignment != "sim3":
        return []
    return [("scale", "arbitrary: one camera; errors are after Sim3 alignment")]


def _loops(outcome: RunOutcome) -> str:
    from vslam.loop_evaluation import evaluate_loops

    closed = sum(edge.accepted for edge in outcome.loops)
    rejected = f"{len(outcome.loops) - closed} candidates rejected"
    verdict = evaluate_loops(outcome)
    if outcome.settings.detector == "none":
        return f"not looked for, {verdict.n_missed} missed" if verdict else "not looked for"
    if verdict is None:
        return f"{closed} closed, {rejected}"
    return f"{closed} closed, {verdict.n_missed} missed, {verdict.n_wrong} wrong, {rejected}"


def _print_comparison(outcome: RunOutcome, evaluation: Evaluation | None) -> None:
    from vslam.comparison import comparison_rows, figures_without_loops, loop_figures

    without = figures_without_loops(outcome)
    if without is None:
        return
    table = [("", "with loops", "without")]
    table += comparison_rows(loop_figures(outcome, evaluation), without)
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    typer.echo()
    for name, *values in table:
        cells = (f"{value:>{width}}" for value, width in zip(values, widths[1:], strict=True))
        typer.echo("  ".join([f"{name:<{widths[0]}}", *cells]))
