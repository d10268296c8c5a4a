"""What the command line prints of a run and of an evaluation: rows of a name and a value."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vslam.evaluation.trajectories import Evaluation
    from vslam.report.schema import ReportJson

Rows = list[tuple[str, str]]
_LOOK_AT = (("report", "report.html"), ("recording", "recording.rrd"))


def error_rows(errors: Evaluation | ReportJson) -> Rows:
    """ATE, RPE and drift."""
    causal = getattr(errors, "causal_ate_rmse_m", None)
    rows = [
        ("ATE rmse", f"{errors.ate_rmse_m:.3f} m"),
        *([("causal ATE", f"{causal:.3f} m, poses as given at the time")] if causal else []),
        ("ATE mean, max", f"{errors.ate_mean_m:.3f} m, {errors.ate_max_m:.3f} m"),
        ("RPE per frame", f"{errors.rpe_m:.4f} m, {errors.rpe_deg:.4f} deg"),
    ]
    if errors.t_rel_percent is None:
        return [*rows, ("drift", "path shorter than 100 m")]
    return [
        *rows,
        ("t_rel", f"{errors.t_rel_percent:.3f} %"),
        ("r_rel", f"{errors.r_rel_deg_per_100m:.3f} deg/100 m"),
    ]


def print_summary(report: ReportJson, folder: Path) -> None:
    """Print what matters of a run that is over; ``folder`` holds its results."""
    from vslam.cli.tables import show_sections
    from vslam.loopclosure.registry import about
    from vslam.report.detector_table import detector_section
    from vslam.report.page import Pairs, Section
    from vslam.report.run_page import advice

    evaluated = report.alignment is not None
    submaps = f" in {report.submaps} sub-maps" if report.submaps > 1 else ""
    rows = [
        *([("interrupted", report.interrupted)] if report.interrupted else []),
        *_scale(report),
        (
            "frames",
            f"{report.frames} done, {report.lost_frames} lost, {report.skipped_frames} unreadable",
        ),
        *in_map_rows(report),
        *_latency(report),
        *([("evaluation", report.evaluation_remark)] if report.evaluation_remark else []),
        *(error_rows(report) if evaluated else []),
        ("detector", f"{report.detector}: {about(report.detector)}"),
        ("loops", _loops(report)),
        ("speed", _speed(report)),
        ("map", f"{report.keyframes} keyframes, {report.landmarks} landmarks{submaps}"),
        *(("warning", warning) for warning in report.warnings),
        *([("advice", advice(report))] if advice(report) else []),
        ("folder", str(folder)),
        *((name, str(folder / file)) for name, file in _LOOK_AT if (folder / file).exists()),
        *_how_to_compare(report),
    ]
    detectors = [detector_section(report)] if report.detectors else []
    show_sections([Section("", [Pairs(rows)]), *detectors])


def in_map_rows(report: ReportJson) -> Rows:
    """How a run found itself in the map that it went on in."""
    if (found := report.in_map) is None:
        return []
    fix = "never" if found.first_fix_s is None else f"after {found.first_fix_s:.2f} s"
    error = "" if found.error_m is None else f", {found.error_m:.3f} m off by its alignment"
    weak = f" ({found.weak_percent:.1f} % by few inliers)" if found.weak_percent else ""
    return [
        ("in the map", f"{found.in_map_percent:.1f} % of the frames{weak}{error}"),
        (
            "found in it",
            f"first {fix}; {found.found} of the {found.sought} times it was looked for",
        ),
    ]


def _latency(report: ReportJson) -> Rows:
    if (ms := report.latency_ms) is None:
        return []
    dropped = f"{report.dropped_frames} frames dropped"
    return [("real time", f"{dropped}, latency {ms.median:.0f} ms, p99 {ms.p99:.0f} ms")]


def _scale(report: ReportJson) -> Rows:
    if report.sensor != "mono":
        return []
    return [("scale", "arbitrary: one camera; errors are after Sim3 alignment")]


def _loops(report: ReportJson) -> str:
    with_truth = report.revisit_stretches is not None
    if report.detector == "none":
        return f"not looked for, {report.loops_missed} missed" if with_truth else "not looked for"
    counts = [f"{report.loops_closed} closed"]
    if with_truth:
        counts += [f"{report.loops_missed} missed", f"{report.loops_wrong} wrong"]
    return ", ".join([*counts, f"{report.loops_rejected} candidates rejected"])


def _speed(report: ReportJson) -> str:
    together = f", all {len(report.detectors)} detectors together" if report.detectors else ""
    return f"{report.fps:.1f} fps{together}"


def _how_to_compare(report: ReportJson) -> Rows:
    """What to type for a comparison where the ground truth could judge one, or why there is none
    though it was asked for."""
    from vslam.report.detector_table import left_out

    if reason := left_out(report):
        return [("compare", reason)]
    refused = report.realtime or report.map is not None  # as of the command line
    if report.detectors or report.alignment is None or refused:
        return []
    if report.detector in ("bow", "none"):
        return [("compare", "add --compare both to set the capsule network beside it")]
    return [("compare", "add --compare bow to set the bag of words beside it")]
