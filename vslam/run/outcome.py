"""The outcome of a finished run, from which its report is made."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.association import poses_at
from vslam.datasets.frames import Source
from vslam.maps.stored_map import StoredMap, TruthAlignment
from vslam.method.gaps import Gap, sentences
from vslam.run.options import RunOptions
from vslam.types.features import TrackingState, TrackResult
from vslam.types.loops import LoopCorrection, LoopEdge
from vslam.types.map import Map
from vslam.types.trajectory import Trajectory

if TYPE_CHECKING:
    from vslam.run.gps import GpsTrack


def alignment_of(sensor: str, *, metric: bool = False) -> str:
    """Return the kind of alignment with the ground truth: ``se3``, or ``sim3`` for a monocular
    camera, unless an IMU has made its map metric."""
    return "sim3" if sensor == "mono" and not metric else "se3"


@dataclass(frozen=True)
class RunOutcome:
    """All data that the report needs about a run.

    Attributes:
        settings: the options of the run, with the canonical name of the perturbation.
        trajectory: final pose of every processed frame, including lost frames. If there is no
            complete map, these are the poses at the time of tracking.
        keyframes: final poses of the keyframes.
        tracks: result of tracking each processed frame. The state of frames whose pose was found
            after a monocular map began is LATER.
        warnings: problems of the images and of the stereo rig that the run detected, as sentences.
        skipped: a message for each frame whose images could not be read.
        n_left_out: number of images that the reader left out, because they have no partner or
            because of their times. For a stream, only the images that were read are counted.
        latency_ms: milliseconds from the arrival of each tracked frame until its pose is known, in
            a real-time run.
        wall_s, cpu_s: wall and CPU seconds from reading the first frame until the last frame is
            tracked and mapped. Compared detectors are included.
        step_s: wall seconds that tracking and mapping with this detector took, without reading
            images and extracting features.
        startup_s: seconds from the start of the process to the first frame.
        peak_memory_mb: peak memory of the process, in MB.
        n_landmarks, n_keyframes: size of the final map.
        map: the final map. None for a trajectory from another system, or if mapping failed.
        truth_alignment: if the run continued a map, the transformation from the world frame of this
            map to the world frame of its ground truth. None if it is unknown.
        in_map: if the run continued a map, ``(N,)`` bool, True for frames that were tracked in this
            map, or in sub-maps that loops have joined to it. None for a new map.
        stored: the map with all data that a later run needs to continue this map. None if the run
            only localised in the map.
        loops: accepted and rejected loop candidates, in the order of the decisions.
        corrections: corrections of the map by the accepted loops, in order.
        keyframe_frames: ``(K,)`` int64, index of the frame of this run that became each keyframe.
            Culled keyframes are included. The index is -1 for keyframes of earlier drives.
        n_submaps: number of sub-maps, including the first map. 0 if the map has no keyframe.
        gaps: stretches whose final poses relative to the world frame were not measured.
        gravity: ``(3,)`` acceleration of free fall in the world frame, in m/s^2. None if no IMU has
            measured it.
        metric_since: time in seconds since when an IMU has made a monocular map metric. Poses at
            the time of tracking were in another unit before. None if the map is not metric, or if
            the camera measures depth.
        gps_track: the georeferenced drive. None if the run has no GPS.
        interrupted: the reason why the run ended early, such as "Ctrl-C" or a truncated file.
        compared: the outcome of each loop detector in ``settings.compare``, without its map. The
            tuple is empty for a resumed run.
    """

    settings: RunOptions
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
    n_left_out: int = 0
    warnings: list[str] = field(default_factory=list)
    latency_ms: list[float] = field(default_factory=list)
    map: Map | None = None
    stored: StoredMap | None = None
    truth_alignment: TruthAlignment | None = None
    in_map: NDArray[np.bool_] | None = None
    loops: list[LoopEdge] = field(default_factory=list)
    corrections: list[LoopCorrection] = field(default_factory=list)
    keyframe_frames: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    n_submaps: int = 1
    gaps: list[Gap] = field(default_factory=list)
    gravity: NDArray[np.float64] | None = None
    metric_since: float | None = None
    gps_track: GpsTrack | None = None
    interrupted: str | None = None
    step_s: float = 0.0
    compared: tuple[RunOutcome, ...] = ()

    @property
    def alignment(self) -> str:
        """The kind of transformation that aligns the trajectory with the ground truth."""
        return alignment_of(self.sequence.camera.sensor, metric=self.is_metric)

    @property
    def is_metric(self) -> bool:
        """Whether the final poses are in metres, not in the arbitrary unit of a monocular map."""
        return not self.sequence.camera.monocular or self.metric_since is not None

    @property
    def gap_sentences(self) -> list[str]:
        """Sentences about ``gaps``."""
        unit = "m" if self.is_metric else "map units"
        return sentences(self.gaps, len(self.tracks), unit)

    @property
    def n_tracked(self) -> int:
        """Number of frames whose pose was determined from their images."""
        found = (TrackingState.OK, TrackingState.WEAK, TrackingState.LATER)
        return sum(track.state in found for track in self.tracks)

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """The ground truth for the frames of the trajectory. None if there is no ground truth."""
        truth = ground_truth_of(self.sequence)
        if truth is None:
            return None
        done = np.isin(truth.timestamps, self.trajectory.timestamps)
        return truth.select(np.flatnonzero(done))


def causal_trajectory(tracks: list[TrackResult]) -> Trajectory:
    """Return the pose of each frame at the time of tracking, before corrections of the map.

    A lost or dropped frame has its predicted pose.
    """
    times = np.array([track.timestamp for track in tracks], np.float64)
    poses = [track.T_wc for track in tracks]
    return Trajectory(times, np.array(poses, np.float64).reshape(-1, 4, 4))


def odometry_trajectory(tracks: list[TrackResult]) -> Trajectory:
    """Return the pose of each frame from odometry (``TrackResult.T_odom_camera``)."""
    known = [track for track in tracks if track.T_odom_camera is not None]
    times = np.array([track.timestamp for track in known], np.float64)
    poses = [track.T_odom_camera for track in known]
    return Trajectory(times, np.array(poses, np.float64).reshape(-1, 4, 4))


def ground_truth_of(source: Source) -> Trajectory | None:
    """Return the true poses of the camera as mounted for all frames with ground truth. None if the
    source has no ground truth.

    A frame without a pose gets one if `poses_at` finds it between the poses of other frames.
    """
    if source.ground_truth is None:
        return None
    known = np.flatnonzero(np.isfinite(source.ground_truth).all((1, 2)))
    T_wc = source.camera.as_mounted(source.ground_truth)
    if 0 < len(known) < len(T_wc):
        T_wc, _ = poses_at(Trajectory(source.timestamps, T_wc).select(known), source.timestamps)
        known = np.flatnonzero(np.isfinite(T_wc).all((1, 2)))
    return Trajectory(source.timestamps, T_wc).select(known)
