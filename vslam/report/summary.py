"""Computes the numbers in ``report.json`` from the outcome of a run."""

from __future__ import annotations

import platform
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.config import changed_thresholds
from vslam.evaluation.loops import LoopEvaluation, evaluate_loops
from vslam.evaluation.map_alignment import error_in_map
from vslam.evaluation.odometry import carried_errors
from vslam.evaluation.trajectories import (
    Evaluation,
    ate_rmse,
    evaluate_trajectory,
    evaluation_warnings,
)
from vslam.method.inertia import IMU_REFUSED
from vslam.method.version import METHOD_VERSION
from vslam.report.schema import (
    DetectorFigures,
    GapEntry,
    GpsFigures,
    ImuFigures,
    LoopEntry,
    Machine,
    MapFigures,
    ReportJson,
    RevisitEntry,
    StageTime,
)
from vslam.run.outcome import RunOutcome, causal_trajectory
from vslam.support.errors import InputError
from vslam.support.machine import available_cores, cpu_name, versions
from vslam.types.features import TrackingState, TrackResult
from vslam.types.geometry import inverses
from vslam.types.loops import LoopCorrection

_OPTIONS = (
    "perturb", "detector", "seed", "threads", "start", "every", "max_frames", "weights",
    "local_weights", "realtime", "calib", "mask", "gps", "localize", "compare",
)  # fmt: skip


def summarize(
    outcome: RunOutcome,
    evaluation: Evaluation | None,
    verdict: LoopEvaluation | None,
    evo_command: str | None,
    remark: str | None = None,
) -> ReportJson:
    """Compute the content of ``report.json``.

    Args:
        evaluation: errors of ``outcome.trajectory`` relative to the ground truth. None if they
            cannot be computed.
        verdict: comparison of ``outcome.loops`` with the ground truth. None if a frame has no
            ground truth.
        evo_command: command that repeats the evaluation. None if evo cannot evaluate the run.
        remark: the reason why there is no evaluation, or the number of frames that the evaluation
            covers.
    """
    frames = len(outcome.tracks)
    states = Counter(track.state for track in outcome.tracks)
    done = frames - states[TrackingState.DROPPED]
    settings, source = outcome.settings.model_dump(), outcome.sequence
    loops = _loops(outcome, verdict)
    return ReportJson(
        lost_before_map=_lost_before_map(outcome),
        longest_loss_s=_longest_loss_s(outcome.tracks),
        later_frames=states[TrackingState.LATER],
        weak_frames=states[TrackingState.WEAK],
        skipped_frames=len(outcome.skipped),
        skipped_messages=outcome.skipped,
        left_out_frames=outcome.n_left_out,
        dropped_frames=states[TrackingState.DROPPED],
        frames=frames,
        warnings=(
            *outcome.warnings,
            *outcome.gap_sentences,
            *evaluation_warnings(evaluation, source.camera.sensor),
        ),
        alignment=evaluation.alignment if evaluation else None,
        ate_mean_m=evaluation.ate_mean_m if evaluation else None,
        ate_max_m=evaluation.ate_max_m if evaluation else None,
        evo_command=evo_command,
        evaluation_remark=remark,
        fps=done / outcome.wall_s if outcome.wall_s > 0 else 0.0,
        cpu_ms_per_frame=1000.0 * outcome.cpu_s / done if done else 0.0,
        startup_s=outcome.startup_s,
        peak_memory_mb=outcome.peak_memory_mb,
        stage_ms=_stage_times(outcome.tracks),
        latency_ms=_stage_time(outcome.latency_ms) if outcome.latency_ms else None,
        keyframes=outcome.n_keyframes,
        landmarks=outcome.n_landmarks,
        submaps=outcome.n_submaps,
        gaps=tuple(GapEntry(**vars(gap)) for gap in outcome.gaps),
        gravity=None if outcome.gravity is None else tuple(outcome.gravity.tolist()),
        loops_rejected=sum(not loop.accepted for loop in loops),
        revisit_stretches=len(verdict.revisits) if verdict else None,
        revisits=_revisits(verdict) if verdict else [],
        loops=loops,
        detectors=_detectors(outcome, evaluation, verdict),
        in_map=_figures_in_map(outcome),
        gps_track=gps_figures(outcome),
        imu=_imu_figures(outcome),
        machine=this_machine(),
        versions=versions() | {"method": str(METHOD_VERSION)},
        created=datetime.now(UTC).replace(microsecond=0),
        **_measures(outcome, evaluation, verdict),
        dataset=source.dataset,
        sequence=source.name,
        sensor=source.camera.sensor,
        map=settings["map_file"],
        thresholds=changed_thresholds(settings["thresholds"]),
        **{name: settings[name] for name in _OPTIONS},
    )


def _lost_before_map(outcome: RunOutcome) -> int:
    if outcome.settings.map_file is not None or not outcome.n_tracked:
        return 0
    untracked = (TrackingState.LOST, TrackingState.DROPPED)
    before = takewhile(lambda track: track.state in untracked, outcome.tracks)
    return sum(track.state == TrackingState.LOST for track in before)


def _longest_loss_s(tracks: list[TrackResult]) -> float:
    longest, since = 0.0, None
    for track in tracks:
        if track.state == TrackingState.LOST and since is None:
            since = track.timestamp
        if since is not None:
            longest = max(longest, track.timestamp - since)
        if track.state not in (TrackingState.LOST, TrackingState.DROPPED):
            since = None
    return longest


def evaluate_run(outcome: RunOutcome) -> tuple[Evaluation | None, str | None]:
    """Compute the errors of the final trajectory of a run.

    Returns:
        The errors, or None if they cannot be computed, and a remark. The remark gives the reason
        why there are no errors, or the number of frames that the errors cover. It is None if they
        cover all frames.
    """
    ground_truth = outcome.ground_truth
    if ground_truth is None:
        return None, "no ground truth"
    if not outcome.tracks:
        return None, "no frames"
    try:
        found = evaluate_trajectory(outcome.trajectory, ground_truth, outcome.alignment)
    except InputError as error:  # it is too short to align; the other results are still useful
        return None, str(error)
    if found.frames == len(outcome.trajectory):
        return found, None
    return found, f"{found.frames} of {len(outcome.trajectory)} frames have a ground truth"


def causal_ate(outcome: RunOutcome) -> float | None:
    """Compute the ATE of the poses at the time of tracking, or None if that is impossible. Poses
    in the unit that a map had before it became metric do not count."""
    ground_truth, since = outcome.ground_truth, outcome.metric_since
    tracks = [one for one in outcome.tracks if since is None or one.timestamp > since]
    if ground_truth is None or not tracks:
        return None
    try:
        return ate_rmse(causal_trajectory(tracks), ground_truth, outcome.alignment)
    except InputError:
        return None


def _metric_since_s(outcome: RunOutcome) -> float | None:
    if outcome.metric_since is None or not outcome.tracks:
        return None
    return outcome.metric_since - outcome.tracks[0].timestamp


def _measures(
    outcome: RunOutcome, evaluation: Evaluation | None, verdict: LoopEvaluation | None
) -> dict[str, Any]:
    """Compute the fields of ``vslam.report.schema.Measures``."""
    errors = ("ate_rmse_m", "rpe_m", "rpe_deg", "t_rel_percent", "r_rel_deg_per_100m")
    return {
        "lost_frames": sum(track.state == TrackingState.LOST for track in outcome.tracks),
        "inertial_frames": sum(track.state == TrackingState.INERTIAL for track in outcome.tracks),
        "metric_since_s": _metric_since_s(outcome),
        "interrupted": outcome.interrupted,
        **{name: getattr(evaluation, name, None) for name in errors},
        "causal_ate_rmse_m": causal_ate(outcome),
        "loops_closed": sum(edge.accepted for edge in outcome.loops),
        "loops_found": verdict.n_found if verdict else None,
        "loops_missed": verdict.n_missed if verdict else None,
        "loops_wrong": verdict.n_wrong if verdict else None,
    }


def _detectors(
    outcome: RunOutcome, evaluation: Evaluation | None, verdict: LoopEvaluation | None
) -> list[DetectorFigures]:
    if not outcome.compared:
        return []
    judged = [(outcome, evaluation, verdict)]
    judged += [(other, evaluate_run(other)[0], evaluate_loops(other)) for other in outcome.compared]
    return [
        DetectorFigures(detector=one[0].settings.detector, seconds=one[0].step_s, **_measures(*one))
        for one in judged
    ]


def _figures_in_map(outcome: RunOutcome) -> MapFigures | None:
    inside, tracks = outcome.in_map, outcome.tracks
    if inside is None:
        return None
    # Relocalisation of a lost frame is attempted only while no keyframe is being mapped.
    lost = [track for track in tracks if track.state == TrackingState.LOST]
    found = [track for track in tracks if track.relocalised]
    sought = sum("relocalise" in track.stage_ms for track in lost) + len(found)
    weak = [track.state == TrackingState.WEAK for track in tracks]
    fix = found[0].timestamp - tracks[0].timestamp if found else None
    return MapFigures(
        in_map_percent=100.0 * float(inside.mean()) if len(inside) else 0.0,
        weak_percent=100.0 * float((inside & weak).mean()) if len(inside) else 0.0,
        first_fix_s=fix,
        sought=sought,
        found=len(found),
        error_m=error_in_map(outcome),
    )


def gps_figures(outcome: RunOutcome) -> GpsFigures | None:
    """Compute the numbers about the georeferenced trajectory, or None for a run without GPS."""
    if (track := outcome.gps_track) is None:
        return None
    ate, ground_truth = None, outcome.ground_truth
    if ground_truth is not None:
        with suppress(InputError):
            ate = ate_rmse(track.trajectory, ground_truth, "se3")
    latitude, longitude, altitude = track.datum.tolist()
    right, down, ahead = track.antenna.tolist()
    return GpsFigures(
        datum=(latitude, longitude, altitude),
        antenna=(right, down, ahead),
        fixes=len(track.fixes),
        refused=int(np.count_nonzero(~track.anchored.used)),
        residual_m=track.anchored.residual_m,
        metres_per_unit=float(track.anchored.scale.mean()),
        ate_rmse_m=ate,
        level=track.anchored.level,
    )


def _imu_figures(outcome: RunOutcome) -> ImuFigures | None:
    source, tracks = outcome.sequence, outcome.tracks
    refused = IMU_REFUSED if IMU_REFUSED in outcome.warnings else source.imu_refused
    if source.imu is None and not refused:
        return None
    calibration = None if source.imu is None else source.imu.calibration
    known = [track for track in tracks if track.gravity is not None]
    carried = carried_seconds(tracks)
    figures = ImuFigures(
        refused=refused,
        gravity_since_s=known[0].timestamp - tracks[0].timestamp if known else None,
        gravity_sigma_deg=_gravity_sigma_deg(outcome),
        time_offset_s=0.0 if calibration is None else calibration.time_offset,
        carried_s=sum(carried),
        longest_s=max(carried, default=0.0),
    )
    if known and known[-1].imu_bias is not None and known[-1].imu_bias_sigma is not None:
        bias, sigma = known[-1].imu_bias.tolist(), known[-1].imu_bias_sigma.tolist()
        found = {"gyro_bias": tuple(bias[:3]), "gyro_bias_sigma": tuple(sigma[:3])}
        found |= {"accel_bias": tuple(bias[3:]), "accel_bias_sigma": tuple(sigma[3:])}
        figures = figures.model_copy(update=found)
    if outcome.ground_truth is None:
        return figures
    errors = carried_errors(tracks, outcome.ground_truth)
    if not len(errors.first):
        return figures
    of_carried = {
        "carried_error_m": float(errors.distance.max()),
        "carried_error_deg": float(np.degrees(np.linalg.norm(errors.xi[:, 3:], axis=1).max())),
        "carried_nees": float(errors.nees.mean()),
    }
    return figures.model_copy(update=of_carried)


def _gravity_sigma_deg(outcome: RunOutcome) -> float | None:
    if outcome.map is None:
        return None
    sigma = outcome.map.keyframes.gravity_sigma[outcome.map.living_keyframes()]
    known = np.flatnonzero(sigma > 0.0)
    return float(np.degrees(sigma[known[-1]])) if len(known) else None


def carried_seconds(tracks: Sequence[TrackResult]) -> list[float]:
    """Return the duration of each stretch through which the IMU alone carried the camera, from the
    last frame before it to its last frame."""
    carried = np.array([track.state == TrackingState.INERTIAL for track in tracks])
    times = np.array([track.timestamp for track in tracks])
    return [float(times[last] - times[max(first - 1, 0)]) for first, last in intervals(carried)]


def intervals(at: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the ``(M, 2)`` first and last indices of the intervals in which an ``(N,)`` bool array
    is True."""
    steps = np.diff(np.concatenate([[False], at, [False]]).astype(np.int8))
    return np.stack([np.flatnonzero(steps == 1), np.flatnonzero(steps == -1) - 1], axis=1)


def stage_names(tracks: list[TrackResult]) -> list[str]:
    """Return the names of the stages, in the order in which the run first went through them."""
    return list(dict.fromkeys(name for track in tracks for name in track.stage_ms))


def _loops(outcome: RunOutcome, verdict: LoopEvaluation | None) -> list[LoopEntry]:
    frames = outcome.keyframe_frames
    corrections = {(c.edge.query, c.edge.match): c for c in outcome.corrections}
    right = verdict.right if verdict else (None,) * len(outcome.loops)
    entries = []
    for edge, is_right in zip(outcome.loops, right, strict=True):
        correction = corrections.get((edge.query, edge.match)) if edge.accepted else None
        entries.append(
            LoopEntry(
                query_frame=_frame(frames, edge.query),
                match_frame=_frame(frames, edge.match),
                score=edge.score,
                matches=edge.n_matches,
                inliers=edge.n_inliers,
                matched_by=edge.matched_by,
                proposed_by=edge.proposed_by,
                accepted=edge.accepted,
                right=is_right,
                reason=edge.reason,
                moved_m=_moved(correction) if correction else None,
                correction_s=correction.seconds if correction else None,
            )
        )
    return entries


def _frame(frames: NDArray[np.int64], keyframe: int) -> int | None:
    """Return the frame of this run that became a keyframe, or None if the keyframe is -1 or belongs
    to an earlier drive."""
    return int(frames[keyframe]) if keyframe >= 0 and frames[keyframe] >= 0 else None


def _moved(correction: LoopCorrection) -> float:
    before, after = inverses(correction.T_cw_before), inverses(correction.T_cw_after)
    return float(np.linalg.norm((after - before)[:, :3, 3], axis=1).max())


def _revisits(verdict: LoopEvaluation) -> list[RevisitEntry]:
    found = verdict.revisits
    return [
        RevisitEntry(
            first_frame=int(found.first[k]),
            last_frame=int(found.last[k]),
            first_match_frame=int(found.first_match[k]),
            last_match_frame=int(found.last_match[k]),
            length_m=float(found.length_m[k]),
            loop_frame=int(verdict.loop_frame[k]) if verdict.loop_frame[k] >= 0 else None,
        )
        for k in range(len(found))
    ]


def _stage_times(tracks: list[TrackResult]) -> dict[str, StageTime]:
    return {
        name: _stage_time([track.stage_ms[name] for track in tracks if name in track.stage_ms])
        for name in stage_names(tracks)
    }


def _stage_time(ms: list[float]) -> StageTime:
    median, p95, p99 = np.percentile(ms, [50, 95, 99]).tolist()
    return StageTime(mean=float(np.mean(ms)), median=median, p95=p95, p99=p99)


def this_machine() -> Machine:
    return Machine(
        cpu=cpu_name(),
        cores=available_cores(),
        python=platform.python_version(),
        platform=platform.platform(),
    )
