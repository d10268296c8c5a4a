"""The schema of ``report.json``: what scripts may rely on."""

from __future__ import annotations

from datetime import datetime

from pydantic import BaseModel, ConfigDict


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class StageTime(_Model):
    """Milliseconds of one stage over the frames that went through it."""

    mean: float
    median: float
    p95: float


class LoopEntry(_Model):
    """One loop candidate; a rejected one has the reason."""

    query: int
    match: int
    score: float
    inliers: int
    accepted: bool
    reason: str


class Machine(_Model):
    """Where the times were measured; ``cores`` counts those that the process may use."""

    cpu: str
    cores: int
    python: str
    platform: str


class ReportJson(_Model):
    """One run in numbers.

    Errors are None without ground truth, and KITTI's drift also on paths shorter than 100 m.
    ``frames`` counts the frames done; ``skipped_frames`` those with an unreadable image.
    """

    schema_version: int = 1

    lost_frames: int
    weak_frames: int
    skipped_frames: int
    skipped_messages: list[str]
    frames: int
    interrupted: str | None

    alignment: str | None
    ate_rmse_m: float | None
    rpe_m: float | None
    rpe_deg: float | None
    t_rel_percent: float | None
    r_rel_deg_per_100m: float | None
    evo_command: str | None

    fps: float
    cpu_ms_per_frame: float
    startup_s: float
    peak_memory_mb: float
    stage_ms: dict[str, StageTime]

    keyframes: int
    landmarks: int
    loops: list[LoopEntry]

    dataset: str
    sequence: str
    perturb: str
    detector: str
    sensor: str
    seed: int
    threads: int
    start: int
    every: int
    max_frames: int | None

    machine: Machine
    versions: dict[str, str]
    created: datetime
