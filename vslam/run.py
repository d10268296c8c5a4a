"""What one finished run says: the type that reports are made from."""

from __future__ import annotations

from dataclasses import dataclass, field

from vslam.config import Config
from vslam.datasets.sequence import Sequence
from vslam.features import TrackResult
from vslam.map import Map
from vslam.trajectory import Trajectory


@dataclass(frozen=True)
class RunSettings:
    """The options of a run as the user gave them."""

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
    config: Config


@dataclass(frozen=True)
class LoopRow:
    """One loop candidate for the loop table: rejected ones are listed with their reason."""

    query: int
    match: int
    score: float
    inliers: int
    accepted: bool
    reason: str


@dataclass(frozen=True)
class RunOutcome:
    """All that the report needs.

    Attributes:
        trajectory: final pose of every frame done, lost ones included.
        keyframes: final keyframe poses.
        tracks: one result a frame.
        skipped: messages of the frames whose images could not be read.
        wall_s, cpu_s: seconds from the first frame read to the last one tracked and mapped.
        startup_s: seconds from the start of the process to the first frame.
        peak_memory_mb: of the process.
        n_landmarks, n_keyframes: in the final map.
        map: the final map, None for a trajectory from elsewhere.
        interrupted: why the run ended early ("Ctrl-C"), or None.
    """

    settings: RunSettings
    sequence: Sequence
    trajectory: Trajectory
    keyframes: Trajectory
    tracks: list[TrackResult]
    skipped: list[str]
    wall_s: float
    cpu_s: float
    startup_s: float
    peak_memory_mb: float
    n_keyframes: int
    n_landmarks: int
    map: Map | None = None
    loops: list[LoopRow] = field(default_factory=list)
    interrupted: str | None = None
