"""From the outcome of a run to the numbers of its report."""

from __future__ import annotations

import platform
from collections import Counter
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from vslam.evaluate import Evaluation
from vslam.features import TrackingState, TrackResult
from vslam.info import available_cores, versions
from vslam.report.schema import LoopEntry, Machine, ReportJson, StageTime
from vslam.run import RunOutcome


def summarize(
    outcome: RunOutcome, evaluation: Evaluation | None, evo_command: str | None
) -> ReportJson:
    """Reduce a run to what ``report.json`` holds; the errors are None without an evaluation."""
    frames = len(outcome.tracks)
    states = Counter(track.state for track in outcome.tracks)
    options = asdict(outcome.settings)
    del options["config"]
    return ReportJson(
        lost_frames=states[TrackingState.LOST],
        weak_frames=states[TrackingState.WEAK],
        skipped_frames=len(outcome.skipped),
        skipped_messages=outcome.skipped,
        frames=frames,
        interrupted=outcome.interrupted,
        alignment=evaluation.alignment if evaluation else None,
        ate_rmse_m=evaluation.ate_rmse_m if evaluation else None,
        rpe_m=evaluation.rpe_m if evaluation else None,
        rpe_deg=evaluation.rpe_deg if evaluation else None,
        t_rel_percent=evaluation.t_rel_percent if evaluation else None,
        r_rel_deg_per_100m=evaluation.r_rel_deg_per_100m if evaluation else None,
        evo_command=evo_command,
        fps=frames / outcome.wall_s if outcome.wall_s > 0 else 0.0,
        cpu_ms_per_frame=1000.0 * outcome.cpu_s / frames if frames else 0.0,
        startup_s=outcome.startup_s,
        peak_memory_mb=outcome.peak_memory_mb,
        stage_ms=_stage_times(outcome.tracks),
        keyframes=outcome.n_keyframes,
        landmarks=outcome.n_landmarks,
        loops=[LoopEntry(**asdict(row)) for row in outcome.loops],
        machine=_machine(),
        versions=versions(),
        created=datetime.now(UTC).replace(microsecond=0),
        **options,
    )


def stage_names(tracks: list[TrackResult]) -> list[str]:
    """Stages in the order in which the run first went through them."""
    return list(dict.fromkeys(name for track in tracks for name in track.stage_ms))


def _stage_times(tracks: list[TrackResult]) -> dict[str, StageTime]:
    times = {}
    for name in stage_names(tracks):
        ms = np.array([track.stage_ms[name] for track in tracks if name in track.stage_ms])
        times[name] = StageTime(
            mean=float(ms.mean()),
            median=float(np.median(ms)),
            p95=float(np.percentile(ms, 95)),
        )
    return times


def _machine() -> Machine:
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
