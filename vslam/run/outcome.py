"""What one finished run says: the type that reports are made from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.config import Config
from vslam.datasets.frames import Source
from vslam.features import TrackingState, TrackResult
from vslam.loops import LoopCorrection, LoopEdge
from vslam.map import Map
from vslam.maps.stored_map import StoredMap, World
from vslam.trajectory import Trajectory


def alignment_of(sensor: str) -> str:
    """``sim3`` for a monocular trajectory, whose scale is arbitrary, ``se3`` for all others."""
    return "sim3" if sensor == "mono" else "se3"


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
    weights: Path | None = None
    local_weights: Path | None = None
    realtime: bool = False
    calib: tuple[Path, ...] = ()
    map: Path | None = None
    localize: bool = False
    compare: tuple[str, ...] = ()

    @property
    def alignment(self) -> str:
        """What is fitted before a trajectory is compared with the ground truth."""
        return alignment_of(self.sensor)


@dataclass(frozen=True)
class RunOutcome:
    """All that the report needs.

    Attributes:
        trajectory: final pose of every frame done, lost ones included; as they were tracked where
            there is no map.
        keyframes: final keyframe poses, likewise.
        tracks: one result a frame.
        warnings: faults of the rig that the run has shown, in sentences.
        skipped: messages of the frames whose images could not be read.
        latency_ms: of each frame tracked in a real-time run, from its time to its pose.
        wall_s, cpu_s: seconds from the first frame read to the last one tracked and mapped, by
            all detectors where several are compared.
        step_s: wall seconds of this detector's own steps: tracking, waiting for its mapping, and
            completing the map at the end. Reading images and extracting features is not in it.
        startup_s: seconds from the start of the process to the first frame.
        peak_memory_mb: of the process.
        n_landmarks, n_keyframes: in the final map.
        map: the final map, None for a trajectory from elsewhere or after mapping failed.
        world: where the map that the run went on in lies, as far as that is known.
        in_map: ``(N,)`` bool, frames placed in the map that the run went on in, at the end; None
            for a run that began a map.
        stored: the map with all that is needed to go on in it; None where it was only localised in.
        loops: all that became of loop candidates, in the order of their decision.
        corrections: what the accepted ones did to the map, in order.
        keyframe_frames: ``(K,)`` int64, the frame of this run that each keyframe was, culled ones
            included: loops speak of keyframes, people of frames. -1 for those of earlier drives.
        n_submaps: how often mapping began, the first time included; 0 before the first keyframe.
        interrupted: why the run ended early ("Ctrl-C", a file cut off), or None.
        compared: the runs of the detectors of ``settings.compare`` on the same frames, without
            their maps; none in a run that was resumed.
    """

    settings: RunSettings
    sequence: Source
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
    warnings: list[str] = field(default_factory=list)
    latency_ms: list[float] = field(default_factory=list)
    map: Map | None = None
    stored: StoredMap | None = None
    world: World | None = None
    in_map: NDArray[np.bool_] | None = None
    loops: list[LoopEdge] = field(default_factory=list)
    corrections: list[LoopCorrection] = field(default_factory=list)
    keyframe_frames: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    n_submaps: int = 1
    interrupted: str | None = None
    step_s: float = 0.0
    compared: tuple[RunOutcome, ...] = ()

    @property
    def n_tracked(self) -> int:
        """The number of frames whose pose was found in their images."""
        found = (TrackingState.OK, TrackingState.WEAK)
        return sum(track.state in found for track in self.tracks)


def causal_trajectory(tracks: list[TrackResult]) -> Trajectory:
    """The pose of each frame as it was given at the time, in the map as it stood then: later
    corrections, by bundle adjustment or a loop, are not in it. A lost or dropped frame has its
    predicted pose."""
    times = np.array([track.timestamp for track in tracks], np.float64)
    poses = [track.T_wc for track in tracks]
    return Trajectory(times, np.array(poses, np.float64).reshape(-1, 4, 4))


def ground_truth_of(source: Source) -> Trajectory | None:
    """The ground truth of all frames that have one, None without any."""
    if source.ground_truth is None:
        return None
    known = np.flatnonzero(np.isfinite(source.ground_truth).all((1, 2)))
    return Trajectory(source.timestamps, source.ground_truth).select(known)


def matched_ground_truth(outcome: RunOutcome) -> Trajectory | None:
    """The ground truth of just the frames that ``outcome.trajectory`` has, None without any."""
    truth = ground_truth_of(outcome.sequence)
    if truth is None:
        return None
    done = np.isin(truth.timestamps, outcome.trajectory.timestamps)
    return truth.select(np.flatnonzero(done))
