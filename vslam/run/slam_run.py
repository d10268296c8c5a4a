"""One SLAM system in a run: what it made of the frames that it was given."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.frames import Source
from vslam.datasets.times import jitter_warnings
from vslam.loopclosure.registry import detector_with_images, problem_of
from vslam.run.autosave import Unfinished
from vslam.run.imu import with_usable_imu
from vslam.run.moving_objects import moving_object_warnings
from vslam.run.options import RunOptions
from vslam.run.outcome import RunOutcome, causal_trajectory
from vslam.run.preparation import Played, PreparedFrame
from vslam.run.progress import Progress, TrackLog, in_frames
from vslam.run.rig import calibration_warnings, measure_offset, offset_warnings, rig_warnings
from vslam.slam import Slam
from vslam.support.errors import InputError
from vslam.support.machine import peak_memory_mb, process_age
from vslam.support.plugins import reason
from vslam.types.camera import Camera
from vslam.types.features import TrackingState, TrackResult
from vslam.types.geometry import Matrix, inverses
from vslam.types.loops import LoopCorrection, LoopEdge
from vslam.types.map import Map
from vslam.types.map_kernels import gather_observations
from vslam.types.trajectory import Trajectory

_log = logging.getLogger(__name__)

# The start of a monocular map is doubtful if the parallax of its first scene stays below this
# angle, in degrees, with which a map begins. [own]
_DOUBTFUL_PARALLAX_DEG = 1.0
_LARGE_CHANGE = 1.5  # factor by which loops change the scale of a monocular map [own]


class SlamRun:
    """A SLAM system that takes the frames of a source in order, and its results.

    If it fails, it takes no more frames, but all results obtained so far are kept. For a resumed
    run, the results include the part before the interruption.

    Attributes:
        tracks: the result of tracking each frame.
    """

    def __init__(
        self, slam: Slam, source: Source, settings: RunOptions, before: Progress | None = None
    ) -> None:
        """
        Args:
            before: the results before an interruption, after which the run is resumed.
        """
        self.slam, self.source, self.settings = slam, source, settings
        self.before = before = before or Progress()
        self.tracks = before.tracks.results()
        if self.tracks:
            slam.resume_odometry(self.tracks[-1])
        self._skipped = list(before.skipped)
        self._latency_ms = list(before.latency_ms)
        self._step_s = 0.0
        self._failure: str | None = None
        self._log = TrackLog(before.tracks)
        self.start()

    def start(self) -> None:
        """Start the clocks. Call this before the first frame is read."""
        self._startup_s = process_age()
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    @property
    def problem(self) -> str | None:
        """A short description of the failure that ends the run. None if nothing failed."""
        return self._failure or problem_of(self.slam.detector)

    @property
    def has_begun(self) -> bool:
        """Whether a frame was processed since the run began or was resumed."""
        return len(self.tracks) > len(self.before.tracks)

    @property
    def has_map(self) -> bool:
        """Whether the finished run has a complete map."""
        try:
            self.slam.map  # noqa: B018
        except RuntimeError:
            return False
        return True

    def fail(self, what: str, error: Exception) -> None:
        """Record a failure that ends the run. Only the first failure is kept."""
        if self._failure is not None:
            return
        if sys.flags.dev_mode:
            _log.warning("the run ends here", exc_info=error)
        why = str(error).rstrip(".") if isinstance(error, InputError) else reason(error)
        self._failure = f"{what} failed, {why}"

    @contextmanager
    def recording_failure(self, what: str) -> Iterator[None]:
        """If the block raises an exception, record it as the failure of this run."""
        try:
            yield
        except Exception as error:
            self.fail(what, error)

    def step(self, played: Played[PreparedFrame], samples: Matrix | None) -> TrackResult:
        """Track a prepared frame. A frame that was dropped or cannot be read is skipped.

        Args:
            samples: ``(N, 7)`` samples of the IMU since the frame before; None without an IMU.
        """
        start = time.perf_counter()
        if samples is not None:
            self.slam.add_imu(samples)
        timestamp, frame = played.timestamp, played.prepared
        if frame is None or frame.dropped:
            result = self.slam.skip(timestamp, dropped=True)
        elif frame.images is None:
            result = self.slam.skip(timestamp)
            self._skipped.append(f"frame {len(self.tracks)}: {frame.problem}")
        else:
            add_latency = partial(self._add_latency, played.arrived)
            result = self.slam.step_images(frame.images, timestamp, frame.stage_ms, add_latency)
        self._step_s += time.perf_counter() - start
        self.tracks.append(result)
        self._log.append(result)
        return result

    def _add_latency(self, arrived: float, _: TrackResult) -> None:
        """In a real-time run, record the time between the arrival and the pose of a frame."""
        if self.settings.realtime:
            self._latency_ms.append(1e3 * (time.perf_counter() - arrived))

    def finish(self) -> None:
        """Complete the map after the last frame. A failure to do so is recorded."""
        start = time.perf_counter()
        with self.recording_failure("completing the map"):
            self.slam.finish()
        self._step_s += time.perf_counter() - start

    def seconds(self) -> tuple[float, float]:
        """Return the wall and CPU time of all frames, including those before an interruption."""
        wall, cpu = time.perf_counter() - self._wall, time.process_time() - self._cpu
        return self.before.wall_s + wall, self.before.cpu_s + cpu

    def trajectory(self) -> Trajectory:
        """Return the final poses of all frames that have a result."""
        # A step that failed may have added a pose without a result.
        return self.slam.trajectory().select(np.arange(len(self.tracks)))

    def so_far(self) -> Progress:
        """Return a copy of the results obtained so far, for an autosave."""
        slam, before = self.slam, self.before
        frames = _frames_of_this_run(slam.map)
        loops, corrections = in_frames(slam.loops, slam.corrections, frames)
        wall_s, cpu_s = self.seconds()
        return Progress(
            tracks=self._log.table(),
            skipped=self._skipped.copy(),
            latency_ms=self._latency_ms.copy(),
            wall_s=wall_s,
            cpu_s=cpu_s,
            loops=before.loops + loops,
            corrections=before.corrections + corrections,
        )

    def outcome(
        self, seconds: tuple[float, float], pair_warnings: list[str], end_reason: str | None
    ) -> RunOutcome:
        """Return the results of the finished run.

        Args:
            seconds: the wall and CPU time of all frames.
            pair_warnings: sentences about the stereo pairs.
            end_reason: why the run ended early; None if it did not.
        """
        keyframes = [track for track in self.tracks if track.is_keyframe]
        outcome = RunOutcome(
            settings=self.settings,
            sequence=self.source,
            trajectory=causal_trajectory(self.tracks),
            keyframes=causal_trajectory(keyframes),
            tracks=self.tracks,
            skipped=self._skipped,
            n_left_out=_count_left_out(self.source),
            warnings=[
                *self._source_warnings(pair_warnings),
                "the run has no complete map; its poses are those of tracking",
            ],
            wall_s=seconds[0],
            cpu_s=seconds[1],
            step_s=self._step_s,
            startup_s=self._startup_s,
            peak_memory_mb=peak_memory_mb(),
            latency_ms=self._latency_ms,
            n_keyframes=len(keyframes),
            n_landmarks=0,
            truth_alignment=self.slam.truth_alignment,
            interrupted=end_reason,
        )
        if self.has_map:
            with self.recording_failure("collecting the results"):
                return self._with_map(outcome, pair_warnings)
        return replace(outcome, interrupted=end_reason or self.problem)

    def _with_map(self, outcome: RunOutcome, pair_warnings: list[str]) -> RunOutcome:
        slam, settings, source = self.slam, self.settings, self.source
        loops, corrections, keyframe_frames = _with_earlier(self.before, slam)
        return replace(
            outcome,
            trajectory=self.trajectory(),
            keyframes=slam.keyframe_trajectory(),
            tracks=_with_found_later(self.tracks, slam.tracked()),
            warnings=[
                *self._source_warnings(pair_warnings),
                *slam.problems,
                *rig_warnings(slam.rig.sides),
                *_map_warnings(slam, source.camera),
                *_scale_warnings(slam, source.camera),
                *mistracked_warnings(loops, keyframe_frames),
            ],
            n_keyframes=len(slam.map.living_keyframes()),
            n_landmarks=len(slam.map.living_landmarks()),
            map=slam.map,
            stored=None
            if settings.localize
            else slam.stored_map(f"{source.dataset} {source.name}"),
            in_map=None if settings.map_file is None else slam.in_map()[: len(self.tracks)],
            loops=loops,
            corrections=corrections,
            keyframe_frames=keyframe_frames,
            n_submaps=len({0, *slam.map.restarts}) if slam.map.n_keyframes else 0,
            gaps=slam.gaps(),
            gravity=slam.gravity,
            metric_since=slam.metric_since,
        )

    def _source_warnings(self, pair_warnings: list[str]) -> list[str]:
        source = self.source
        times = np.array([track.timestamp for track in self.tracks])
        return [
            *source.warnings,
            *(source.pairing.warnings() if source.pairing is not None else []),
            *(source.timing.warnings() if source.timing is not None else []),
            *jitter_warnings(times, source.name),
            *calibration_warnings(source.camera, self.settings.calib, source.name),
            *pair_warnings,
            *moving_object_warnings(self.tracks),
        ]


class ComparedRuns(SlamRun):
    """A run whose frames are given to further SLAM systems, each with its own map (``--compare``).

    If one of the others fails, the rest go on.
    """

    def __init__(
        self, slam: Slam, source: Source, settings: RunOptions, others: list[SlamRun]
    ) -> None:
        super().__init__(slam, source, settings)
        self._others = others

    def step(self, played: Played[PreparedFrame], samples: Matrix | None) -> TrackResult:
        result = super().step(played, samples)
        for other in self._others:
            if other.problem is None:
                with other.recording_failure(f"frame {result.index}"):
                    other.step(played, samples)
        return result

    def finish(self) -> None:
        super().finish()
        for other in self._others:
            other.finish()

    def outcome(
        self, seconds: tuple[float, float], pair_warnings: list[str], end_reason: str | None
    ) -> RunOutcome:
        outcomes = [
            other.outcome(seconds, pair_warnings, other.problem or end_reason)
            for other in self._others
        ]
        compared = tuple(replace(one, map=None, stored=None) for one in outcomes)  # maps are large
        return replace(super().outcome(seconds, pair_warnings, end_reason), compared=compared)


def begin(source: Source, settings: RunOptions, resume: Unfinished | None = None) -> SlamRun:
    """Create the SLAM system of a run, and those of the detectors in ``settings.compare``.

    The compared detectors have their shipped weights. A resumed run goes on without them, because
    their maps were not saved. An IMU that would harm is not used, and a warning of the outcome says
    why (``usable_imu``).

    Args:
        resume: the saved state of an interrupted run, after which the run continues.

    Raises:
        InputError: the map does not exist, the map was made with a different camera, detector or
            image pyramid, or the weights cannot be read.
    """
    source = with_usable_imu(source)
    if resume is not None:
        slam = _create(source, settings, resume.map)
        return SlamRun(slam, source, settings, resume.progress)
    slam = _create(source, settings)
    if not settings.compare:
        return SlamRun(slam, source, settings)
    common: dict[str, object] = {"weights": None, "compare": ()}
    each = [settings.model_copy(update={**common, "detector": name}) for name in settings.compare]
    others = [SlamRun(_create(source, one), source, one) for one in each]
    return ComparedRuns(slam, source, settings, others)


def _create(source: Source, settings: RunOptions, saved: Path | None = None) -> Slam:
    """Create a ``Slam`` with a new map, the map in ``settings.map_file``, or that of an interrupted
    run."""
    config, threads = settings.thresholds, settings.threads
    imu = None if source.imu is None else source.imu.calibration
    on_demand = not settings.realtime  # in real time, no frame may wait for a network
    detector, images = detector_with_images(
        settings.detector, config, settings.weights,
        local_weights=settings.local_weights, on_demand=on_demand,
    )  # fmt: skip
    if saved is not None:
        return Slam.load(
            saved, config, detector, threads=threads, images=images, resume=True, imu=imu
        )
    map_file, localize = settings.map_file, settings.localize
    if map_file is None:
        return Slam(source.camera, config, detector, threads=threads, images=images, imu=imu)
    return Slam.load(
        map_file, config, detector, threads=threads, images=images, localize=localize, imu=imu
    )


def _count_left_out(source: Source) -> int:
    return sum(len(part.left_out) for part in (source.pairing, source.timing) if part is not None)


def _map_warnings(slam: Slam, camera: Camera) -> list[str]:
    try:
        return offset_warnings(measure_offset(slam.map, camera), camera)
    except Exception as error:  # a failed check must not end the run
        return [f"The rig could not be checked ({reason(error)})."]


def _scale_warnings(slam: Slam, camera: Camera) -> list[str]:
    if not camera.monocular or slam.metric_since is not None or not slam.map.n_keyframes:
        return []
    return scale_warnings(slam.map)


def scale_warnings(map_: Map) -> list[str]:
    """Warn if the start or the scale of a monocular map is doubtful.

    The start is doubtful if the landmarks that its first keyframe sees were never seen from
    another direction, and the scale if loops have changed it much along the path.
    """
    said = []
    parallax = _largest_parallax(map_)
    if parallax < _DOUBTFUL_PARALLAX_DEG:
        said.append(
            f"The start of the monocular map is doubtful: what its first keyframe sees was never "
            f"seen from a direction that differs by more than {parallax:.1f} degrees. The depths "
            "may be wrong, and the scale of the first poses with them."
        )
    units = map_.unit_scale[map_.living_keyframes()]
    change = float(units.max() / units.min())
    if change > _LARGE_CHANGE:
        said.append(
            f"The scale of the monocular map drifted: loops have corrected it by a factor of up to "
            f"{change:.1f} between parts of the path. Lengths between the loops are less certain."
        )
    return said


def _largest_parallax(map_: Map) -> float:
    """Return the median angle, in degrees, between the rays from the first keyframe and from the
    keyframe of the most different direction, over the landmarks that the first keyframe sees."""
    ids = map_.landmarks_of(0)
    first, rows = gather_observations(map_.arrays, ids, np.arange(map_.n_keyframes))
    centres = inverses(map_.arrays.T_cw[: map_.n_keyframes])[:, :3, 3]
    xyz, seen_by = map_.arrays.xyz[ids], map_.arrays.keyframe[rows]
    point = np.repeat(np.arange(len(ids)), np.diff(first))
    rays, ray_0 = xyz[point] - centres[seen_by], xyz - centres[0]
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    ray_0 /= np.linalg.norm(ray_0, axis=1)[:, None]
    cosine = np.ones(len(ids))
    np.minimum.at(cosine, point, np.einsum("ni,ni->n", rays, ray_0[point]))
    return float(np.degrees(np.arccos(np.clip(np.median(cosine), -1.0, 1.0)))) if len(ids) else 0.0


def mistracked_warnings(loops: list[LoopEdge], frames: NDArray[np.int64]) -> list[str]:
    """Warn of the frames between the ends of each loop that was closed against the odometry.

    Args:
        frames: index of the frame of each keyframe.
    """
    return [
        f"Tracking went wrong between frames {frames[loop.match]} and {frames[loop.query]}: they "
        "certainly show the same place, but the tracked motion between them does not lead there. "
        "The poses of the frames between them were corrected, but should not be trusted."
        for loop in loops
        if loop.against_odometry
    ]


def _with_earlier(
    before: Progress, slam: Slam
) -> tuple[list[LoopEdge], list[LoopCorrection], NDArray[np.int64]]:
    """Return the loops and corrections of a whole run, including the part before it was resumed.

    The loops and corrections of this part refer to frames instead of keyframes. Therefore, each of
    these frames is given a new keyframe number, after the keyframes of the map.

    Returns:
        The loops, the corrections, and the index of the frame that belongs to each keyframe number.
    """
    frames = _frames_of_this_run(slam.map)
    if not before.loops:
        return slam.loops, slam.corrections, frames
    named = {end for loop in before.loops for end in (loop.query, loop.match)}
    named.update(*(one.keyframes.tolist() for one in before.corrections))
    extra = np.array(sorted(named), np.int64)
    number = {frame: len(frames) + k for k, frame in enumerate(extra.tolist())}

    def renamed(loop: LoopEdge) -> LoopEdge:
        query = number[loop.query] if loop.query >= 0 else -1
        return replace(loop, query=query, match=number[loop.match])

    loops = [renamed(loop) for loop in before.loops]
    corrections = [
        replace(
            one,
            edge=renamed(one.edge),
            keyframes=np.array([number[frame] for frame in one.keyframes.tolist()], np.int64),
        )
        for one in before.corrections
    ]
    return loops + slam.loops, corrections + slam.corrections, np.concatenate([frames, extra])


def _with_found_later(tracks: list[TrackResult], found: NDArray[np.bool_]) -> list[TrackResult]:
    return [
        replace(track, state=TrackingState.LATER)
        if track.state == TrackingState.LOST and late
        else track
        for track, late in zip(tracks, found[: len(tracks)].tolist(), strict=True)
    ]


def _frames_of_this_run(map_: Map) -> NDArray[np.int64]:
    return np.where(map_.sessions == map_.scalars.session, map_.frames, -1)
