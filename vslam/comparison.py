"""What loop closing changed: the same sequence with and without it (``--compare-loops``)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from vslam.errors import InputError
from vslam.evaluate import Evaluation, evaluate
from vslam.features import TrackingState, TrackResult
from vslam.perturb import Perturbation
from vslam.run import RunOutcome
from vslam.runfolder import matched_ground_truth


@dataclass(frozen=True)
class LoopFigures:
    """The figures of one run that loop closing can change; None where they cannot be given."""

    ate_rmse_m: float | None
    rpe_m: float | None
    t_rel_percent: float | None
    lost_frames: int
    loops_closed: int


def with_comparison(
    outcome: RunOutcome,
    perturbation: Perturbation,
    *,
    on_frame: Callable[[TrackResult], None] = lambda result: None,
) -> RunOutcome:
    """Run the sequence again with the detector ``none``, unrecorded, and keep both outcomes.

    Everything else is the same: images, perturbation, thresholds. Where Ctrl-C ends the second run
    there is nothing to compare, and the first one's outcome says so.
    """
    from vslam.pipeline import run_sequence
    from vslam.recorder import NullRecorder

    settings = replace(outcome.settings, detector="none", weights=None)
    without = run_sequence(
        outcome.sequence, perturbation, settings, NullRecorder(), on_frame=on_frame
    )
    if without.interrupted:
        return replace(outcome, interrupted=f"{without.interrupted}, in the run without loops")
    return replace(outcome, without_loops=replace(without, map=None))  # a map takes 100s of MB


def loop_figures(outcome: RunOutcome, evaluation: Evaluation | None) -> LoopFigures:
    """Reduce a run to its part of the comparison."""
    return LoopFigures(
        ate_rmse_m=evaluation.ate_rmse_m if evaluation else None,
        rpe_m=evaluation.rpe_m if evaluation else None,
        t_rel_percent=evaluation.t_rel_percent if evaluation else None,
        lost_frames=sum(track.state is TrackingState.LOST for track in outcome.tracks),
        loops_closed=sum(edge.accepted for edge in outcome.loops),
    )


def figures_without_loops(outcome: RunOutcome) -> LoopFigures | None:
    """Those of ``outcome.without_loops``, None if no such run was made."""
    without = outcome.without_loops
    if without is None:
        return None
    ground_truth = matched_ground_truth(without)
    evaluation = None
    if ground_truth is not None:
        try:
            evaluation = evaluate(without.trajectory, ground_truth, without.settings.alignment)
        except InputError:  # too short to align, as the run with loops
            evaluation = None
    return loop_figures(without, evaluation)


def comparison_rows(with_: LoopFigures, without: LoopFigures) -> list[tuple[str, str, str]]:
    """Measure, value with loop closing, value without: one row each."""
    measures = (
        ("ATE rmse", "ate_rmse_m", "{:.3f} m"),
        ("RPE per frame", "rpe_m", "{:.4f} m"),
        ("t_rel", "t_rel_percent", "{:.3f} %"),
        ("lost frames", "lost_frames", "{}"),
        ("loops closed", "loops_closed", "{}"),
    )

    def cell(figures: LoopFigures, name: str, form: str) -> str:
        value = getattr(figures, name)
        return "n/a" if value is None else form.format(value)

    return [
        (title, cell(with_, name, form), cell(without, name, form))
        for title, name, form in measures
    ]
