"""From the outcome of a run to the numbers of its report."""

from __future__ import annotations

import platform
from collections import Counter
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from vslam.comparison import figures_without_loops
from vslam.evaluate import Evaluation
from vslam.features import TrackingState, TrackResult
from vslam.geometry import inverses
from vslam.info import available_cores, versions
from vslam.loop_evaluation import LoopEvaluation
from vslam.loops import Closure
from vslam.report.schema import (
    LoopEntry,
    Machine,
    ReportJson,
    RevisitEntry,
    StageTime,
    WithoutLoops,
)
from vslam.run import RunOutcome


def summarize(
    outcome: RunOutcome,
    evaluation: Evaluation | None,
    verdict: LoopEvaluation | None,
    evo_command: str | None,
) -> ReportJson:
    """Reduce a run to what ``report.json`` holds.

    The errors are None without an evaluation, the judgement of loops is without a verdict.
    """
    frames = len(outcome.tracks)
    states = Counter(track.state for track in outcome.tracks)
    done = frames - states[TrackingState.DROPPED]
    options = asdict(outcome.settings)
    del options["config"]
    loops = _loops(outcome, verdict)
    closed = sum(loop.accepted for loop in loops)
    without = figures_without_loops(outcome)
    return ReportJson(
        lost_frames=states[TrackingState.LOST],
        weak_frames=states[TrackingState.WEAK],
        skipped_frames=len(outcome.skipped),
        skipped_messages=outcome.skipped,
        dropped_frames=states[TrackingState.DROPPED],
        frames=frames,
        interrupted=outcome.interrupted,
        alignment=evaluation.alignment if evaluation else None,
        ate_rmse_m=evaluation.ate_rmse_m if evaluation else None,
        rpe_m=evaluation.rpe_m if evaluation else None,
        rpe_deg=evaluation.rpe_deg if evaluation else None,
        t_rel_percent=evaluation.t_rel_percent if evaluation else None,
        r_rel_deg_per_100m=evaluation.r_rel_deg_per_100m if evaluation else None,
        evo_command=evo_command,
        fps=done / outcome.wall_s if outcome.wall_s > 0 else 0.0,
        cpu_ms_per_frame=1000.0 * outcome.cpu_s / done if done else 0.0,
        startup_s=outcome.startup_s,
        peak_memory_mb=outcome.peak_memory_mb,
        stage_ms=_stage_times(outcome.tracks),
        latency_ms=_stage_time(outcome.latency_ms) if outcome.latency_ms else None,
        keyframes=outcome.n_keyframes,
        landmarks=outcome.n_landmarks,
        submaps=outcome.n_submaps,
        loops_closed=closed,
        loops_rejected=len(loops) - closed,
        loops_found=verdict.n_found if verdict else None,
        loops_missed=verdict.n_missed if verdict else None,
        loops_wrong=verdict.n_wrong if verdict else None,
        revisit_stretches=len(verdict.revisits) if verdict else None,
        revisits=_revisits(verdict) if verdict else [],
        loops=loops,
        without_loops=WithoutLoops(**asdict(without)) if without else None,
        machine=this_machine(),
        versions=versions(),
        created=datetime.now(UTC).replace(microsecond=0),
        **options,
    )


def stage_names(tracks: list[TrackResult]) -> list[str]:
    """Stages in the order in which the run first went through them."""
    return list(dict.fromkeys(name for track in tracks for name in track.stage_ms))


def _loops(outcome: RunOutcome, verdict: LoopEvaluation | None) -> list[LoopEntry]:
    frames = outcome.keyframe_frames
    closures = {(c.edge.query, c.edge.match): c for c in outcome.closures}
    right = verdict.right if verdict else (None,) * len(outcome.loops)
    entries = []
    for edge, is_right in zip(outcome.loops, right, strict=True):
        closure = closures.get((edge.query, edge.match)) if edge.accepted else None
        entries.append(
            LoopEntry(
                query_frame=int(frames[edge.query]) if edge.query >= 0 else None,
                match_frame=int(frames[edge.match]),
                score=edge.score,
                matches=edge.n_matches,
                inliers=edge.n_inliers,
                accepted=edge.accepted,
                right=is_right,
                reason=edge.reason,
                moved_m=_moved(closure) if closure else None,
                correction_s=closure.seconds if closure else None,
            )
        )
    return entries


def _moved(closure: Closure) -> float:
    before, after = inverses(closure.T_cw_before), inverses(closure.T_cw_after)
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
    """Where this process runs."""
    return Machine(
        cpu=_cpu_name(),
        cores=available_cores(),
        python=platform.python_version(),
        platform=platform.platform(),
    )


def _cpu_name() -> str:
    # platform.processor() is empty or just "x86_64" on Linux.
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    for line in lines:
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
