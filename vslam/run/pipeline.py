"""Runs SLAM on a sequence or stream. Frames are prepared, tracked in order and recorded."""

from __future__ import annotations

import logging
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.datasets.frames import Source, TimedFrame
from vslam.datasets.imu import ImuFeed
from vslam.datasets.perturbation import Perturbation, perturbed
from vslam.datasets.times import jitter_warnings
from vslam.loopclosure.registry import detector_with_images, problem_of
from vslam.maps.storage import made_with
from vslam.run.autosave import NO_AUTOSAVE, Autosave, Unfinished
from vslam.run.imu import with_usable_imu
from vslam.run.moving_objects import moving_object_warnings
from vslam.run.options import RunOptions
from vslam.run.outcome import RunOutcome, causal_trajectory, ground_truth_of
from vslam.run.pair import PairCheck
from vslam.run.preparation import FramesAhead, Played, PreparedFrame
from vslam.run.progress import Progress, TrackLog, in_frames
from vslam.run.recorder import Recorder
from vslam.run.rig import (
    calibration_warnings,
    measure_offset,
    offset_warnings,
    rig_warnings,
)
from vslam.slam import Slam
from vslam.support.errors import BrokenSourceError, InputError
from vslam.support.machine import give_back_memory, peak_memory_mb, process_age
from vslam.support.plugins import reason
from vslam.types.camera import Camera, same_camera
from vslam.types.features import TrackingState, TrackResult
from vslam.types.geometry import Matrix
from vslam.types.imu import ImuCalibration
from vslam.types.loops import LoopCorrection, LoopEdge
from vslam.types.map import Map
from vslam.types.trajectory import Trajectory

_log = logging.getLogger(__name__)


def run_sequence(
    sequence: Source,
    perturbation: Perturbation,
    settings: RunOptions,
    recorder: Recorder,
    *,
    on_frame: Callable[[TrackResult], None] = lambda result: None,
    autosave: Autosave = NO_AUTOSAVE,
    resume: Unfinished | None = None,
    slam: Slam | None = None,
) -> RunOutcome:
    """Run SLAM over a whole sequence, or over a stream until it ends.

    A frame that cannot be read is skipped. This frame gets a predicted pose, counts as lost and is
    listed in the outcome. A frame that is dropped in a real-time run gets an interpolated pose.

    An IMU that would harm is not used, and a warning of the outcome says why (``usable_imu``).

    The run ends early after Ctrl-C, when the source ends unexpectedly, or when a component fails,
    for example the loop detector of a plug-in. All results obtained so far are kept. If mapping
    failed, the outcome contains no map, and the poses are those at the time of tracking.

    The loop detectors in ``settings.compare`` process the same frames. Each detector has its own
    map. If one detector fails, the other detectors continue. A resumed run continues without these
    detectors, because their maps were not saved.

    Args:
        resume: the saved state of an interrupted run, after which the run continues. The outcome
            covers the frames before and after the interruption.
        slam: the result of ``begin`` for the same settings and the IMU that ``imu_of`` returns.
            If it is None, this function calls ``begin``.

    Raises:
        InputError: the images cannot be read, the images are not those of the resumed run, or
            ``begin`` fails. Only errors before the first frame raise an exception. Later errors end
            the run early.
    """
    cv2.setNumThreads(1)  # the thread pool already uses all cores
    sequence, saved = with_usable_imu(sequence), None if resume is None else resume.map
    feed = None if sequence.imu is None else ImuFeed(sequence.imu)
    imu = None if sequence.imu is None else sequence.imu.calibration
    slam = slam or begin(sequence.camera, settings, saved, imu)
    perturbation = perturbation.bound_to(sequence)
    pair = PairCheck(sequence.camera, sequence.dataset, settings)
    others = [] if resume is not None else _compared(sequence.camera, settings, pair, imu)
    recorder.begin(sequence.camera, ground_truth_of(sequence))
    main = _Run(slam, settings, Progress() if resume is None else resume.progress, pair)
    n_recorded = 0  # loops passed to the recorder so far
    end_reasons: list[str] = []  # why the run ended early; the first reason counts
    with _stop_on_interrupt() as interrupted:
        frames = pair.watch(_until_broken(sequence.frames(), end_reasons))
        frames = perturbed(frames, perturbation)
        frames = _following(frames, main.before.tracks.timestamps)
        ahead = FramesAhead(
            frames,
            slam.context,
            slam.workers,
            realtime=settings.realtime,
            live=sequence.live,
            begin=len(main.tracks),
        )
        try:
            for played in ahead:
                samples = None if feed is None else feed.until(played.timestamp)
                result = main.step(played, samples)
                ahead.request(result.next_extraction)
                if (frame := played.prepared) is not None and frame.problem and not frame.dropped:
                    _log.warning("frame %d skipped: %s", result.index, frame.problem)
                autosave.frame(result)
                if result.state != TrackingState.DROPPED:
                    n_recorded = _record_frame(recorder, slam, result, played, n_recorded)
                on_frame(result)
                autosave.offer(slam, main.so_far)
                for other in others:
                    if other.problem is None:
                        with other.recording_failure(f"frame {result.index}"):
                            other.step(played, samples)
                if main.problem:
                    break
                if interrupted.is_set():
                    if not sequence.live:  # for a live source, Ctrl-C is the usual end
                        end_reasons.append("Ctrl-C")
                    break
        except Exception as error:  # keep the results obtained so far
            if isinstance(error, InputError) and not main.has_begun:
                raise
            main.fail(f"frame {len(main.tracks)}", error)
        for one in (main, *others):
            with one.recording_failure("completing the map"):
                one.finish()
        if not end_reasons and main.problem:
            end_reasons.append(main.problem)
        with main.recording_failure("saving the map"):
            autosave.close(slam, main.so_far, resumable=bool(end_reasons) and main.has_map)
    seconds = main.seconds()
    pair.end(sequence, perturbation, len(main.tracks))
    give_back_memory()  # the results are written from a copy of the map, which needs memory
    with main.recording_failure("the final trajectory"):
        if main.has_map:
            _record_loops(recorder, slam, n_recorded)
            recorder.finish(main.trajectory(), slam.map)
        else:
            recorder.finish(causal_trajectory(main.tracks), None)
    end_reason = end_reasons[0] if end_reasons else main.problem
    outcomes = [_outcome(sequence, other, seconds, other.problem or end_reason) for other in others]
    compared = tuple(replace(one, map=None, stored=None) for one in outcomes)  # maps are large
    return replace(_outcome(sequence, main, seconds, end_reason), compared=compared)


def _compared(
    camera: Camera, settings: RunOptions, pair: PairCheck, imu: ImuCalibration | None
) -> list[_Run]:
    """Begin a run for each loop detector in ``settings.compare``, with its shipped weights."""
    common: dict[str, object] = {"weights": None, "compare": ()}
    each = [settings.model_copy(update={**common, "detector": name}) for name in settings.compare]
    return [_Run(begin(camera, one, None, imu), one, Progress(), pair) for one in each]


class _Run:
    """The SLAM system of one loop detector, and the results of its run.

    For a resumed run, the results include the part before the interruption.

    Attributes:
        pair: the check of the first stereo pairs, which all detectors share.
        step_s: wall seconds that this detector alone took (``RunOutcome.step_s``).
    """

    def __init__(self, slam: Slam, settings: RunOptions, before: Progress, pair: PairCheck) -> None:
        self.slam, self.settings, self.before, self.pair = slam, settings, before, pair
        self.tracks = before.tracks.results()
        if self.tracks:
            slam.resume_odometry(self.tracks[-1])
        self.skipped = list(before.skipped)
        self.latency_ms = list(before.latency_ms)
        self.startup_s = process_age()
        self.step_s = 0.0
        self._failure: str | None = None
        self._log = TrackLog(before.tracks)
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

    def trajectory(self) -> Trajectory:
        # A step that failed may have added a pose without a result.
        return self.slam.trajectory().select(np.arange(len(self.tracks)))

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
            self.skipped.append(f"frame {len(self.tracks)}: {frame.problem}")
        else:
            add_latency = partial(self._add_latency, played.arrived)
            result = self.slam.step_images(frame.images, timestamp, frame.stage_ms, add_latency)
        self.step_s += time.perf_counter() - start
        self.tracks.append(result)
        self._log.append(result)
        return result

    def _add_latency(self, arrived: float, _: TrackResult) -> None:
        """In a real-time run, record the time between the arrival and the pose of a frame."""
        if self.settings.realtime:
            self.latency_ms.append(1e3 * (time.perf_counter() - arrived))

    def finish(self) -> None:
        start = time.perf_counter()
        self.slam.finish()
        self.step_s += time.perf_counter() - start

    def seconds(self) -> tuple[float, float]:
        """Return the wall and CPU time of all frames, including those before an interruption."""
        wall, cpu = time.perf_counter() - self._wall, time.process_time() - self._cpu
        return self.before.wall_s + wall, self.before.cpu_s + cpu

    def so_far(self) -> Progress:
        """Return a copy of the results obtained so far, for an autosave."""
        slam, before = self.slam, self.before
        frames = _frames_of_this_run(slam.map)
        loops, corrections = in_frames(slam.loops, slam.corrections, frames)
        wall_s, cpu_s = self.seconds()
        return Progress(
            tracks=self._log.table(),
            skipped=self.skipped.copy(),
            latency_ms=self.latency_ms.copy(),
            wall_s=wall_s,
            cpu_s=cpu_s,
            loops=before.loops + loops,
            corrections=before.corrections + corrections,
        )


def _record_frame(
    recorder: Recorder,
    slam: Slam,
    result: TrackResult,
    played: Played[PreparedFrame],
    n_recorded: int,
) -> int:
    """Record a frame, and the map unless a job changes it. Return the number of recorded loops."""
    recorder.frame(result)
    images = None if played.prepared is None else played.prepared.images
    if result.is_keyframe and slam.frame is not None and images is not None:
        recorder.keyframe(result, images.left, slam.frame.features.xy, slam.frame.landmark >= 0)
    if slam.is_mapping:
        return n_recorded
    recorder.map(slam.map)
    return _record_loops(recorder, slam, n_recorded)


def _following(frames: Iterator[TimedFrame], before: NDArray[np.float64]) -> Iterator[TimedFrame]:
    """Yield the frames after the first N frames, which were tracked before the run was resumed.

    Raises:
        InputError: the timestamps of the first N frames of the source differ from ``before``.
    """
    for index, timestamp in enumerate(before.tolist()):
        frame = next(frames, None)
        if frame is None or frame.timestamp != timestamp:
            now = "there is none" if frame is None else f"it has {frame.timestamp:.6f} s"
            raise InputError(
                f"--resume: frame {index} had the time {timestamp:.6f} s, now {now}: these are not "
                "the images of the interrupted run; restore them, or start a new run."
            )
    yield from frames


def _outcome(
    sequence: Source,
    run: _Run,
    seconds: tuple[float, float],
    interrupted: str | None,
) -> RunOutcome:
    """Create the outcome of a run. ``seconds`` are the wall and CPU times of all frames."""
    keyframes = [track for track in run.tracks if track.is_keyframe]
    outcome = RunOutcome(
        settings=run.settings,
        sequence=sequence,
        trajectory=causal_trajectory(run.tracks),
        keyframes=causal_trajectory(keyframes),
        tracks=run.tracks,
        skipped=run.skipped,
        n_left_out=_count_left_out(sequence),
        warnings=[
            *_source_warnings(sequence, run),
            "the run has no complete map; its poses are those of tracking",
        ],
        wall_s=seconds[0],
        cpu_s=seconds[1],
        step_s=run.step_s,
        startup_s=run.startup_s,
        peak_memory_mb=peak_memory_mb(),
        latency_ms=run.latency_ms,
        n_keyframes=len(keyframes),
        n_landmarks=0,
        truth_alignment=run.slam.truth_alignment,
        interrupted=interrupted,
    )
    if run.has_map:
        with run.recording_failure("collecting the results"):
            return _with_map(outcome, run)
    return replace(outcome, interrupted=interrupted or run.problem)


def _with_map(outcome: RunOutcome, run: _Run) -> RunOutcome:
    slam, settings, source = run.slam, run.settings, outcome.sequence
    loops, corrections, keyframe_frames = _with_earlier(run.before, slam)
    return replace(
        outcome,
        trajectory=run.trajectory(),
        keyframes=slam.keyframe_trajectory(),
        warnings=[
            *_source_warnings(source, run),
            *slam.problems,
            *rig_warnings(slam.rig.sides),
            *_map_warnings(slam, source.camera),
            *mistracked_warnings(loops, keyframe_frames),
        ],
        n_keyframes=len(slam.map.living_keyframes()),
        n_landmarks=len(slam.map.living_landmarks()),
        map=slam.map,
        stored=None if settings.localize else slam.stored_map(f"{source.dataset} {source.name}"),
        in_map=None if settings.map_file is None else slam.in_map()[: len(run.tracks)],
        loops=loops,
        corrections=corrections,
        keyframe_frames=keyframe_frames,
        n_submaps=len({0, *slam.map.restarts}) if slam.map.n_keyframes else 0,
        gaps=slam.gaps(),
    )


def _source_warnings(source: Source, run: _Run) -> list[str]:
    times = np.array([track.timestamp for track in run.tracks])
    return [
        *source.warnings,
        *(source.pairing.warnings() if source.pairing is not None else []),
        *(source.timing.warnings() if source.timing is not None else []),
        *jitter_warnings(times, source.name),
        *calibration_warnings(source.camera, run.settings.calib, source.name),
        *run.pair.warnings(),
        *moving_object_warnings(run.tracks),
    ]


def _count_left_out(source: Source) -> int:
    return sum(len(part.left_out) for part in (source.pairing, source.timing) if part is not None)


def _map_warnings(slam: Slam, camera: Camera) -> list[str]:
    try:
        return offset_warnings(measure_offset(slam.map, camera), camera)
    except Exception as error:  # a failed check must not end the run
        return [f"The rig could not be checked ({reason(error)})."]


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


def begin(
    camera: Camera,
    settings: RunOptions,
    saved: Path | None = None,
    imu: ImuCalibration | None = None,
) -> Slam:
    """Create the ``Slam`` of a run with a new map or with the map in ``settings.map_file``.

    Args:
        saved: the map file of an interrupted run, which is continued instead.
        imu: the IMU on the left camera; None if there is none.

    Raises:
        InputError: the map does not exist, the map was made with a different camera, detector or
            image pyramid, or the weights cannot be read.
    """
    config, threads = settings.thresholds, settings.threads
    late = not settings.realtime  # in real time, no network may be loaded during the drive
    detector, images = detector_with_images(
        settings.detector, config, settings.weights,
        local_weights=settings.local_weights, late=late,
    )  # fmt: skip
    if saved is not None:
        return Slam.load(
            saved, config, detector, threads=threads, images=images, resume=True, imu=imu
        )
    map_file, localize = settings.map_file, settings.localize
    if map_file is None:
        return Slam(camera, config, detector, threads=threads, images=images, imu=imu)
    return Slam.load(
        map_file, config, detector, threads=threads, images=images, localize=localize, imu=imu
    )


def require_camera(map_file: Path, camera: Camera) -> None:
    """Check that a map was made with the given camera.

    Raises:
        InputError: the map was made with a different camera, or there is no such map.
    """
    of_map = made_with(map_file).camera
    if not same_camera(of_map, camera):
        raise InputError(
            f"{map_file}: the map's camera is not that of the images ({of_map.sensor}, "
            f"{of_map.width}x{of_map.height}, fx {of_map.fx:.1f}); continue with images of the "
            "same camera, rectified in the same way."
        )


def _frames_of_this_run(map_: Map) -> NDArray[np.int64]:
    return np.where(map_.sessions == map_.scalars.session, map_.frames, -1)


def _until_broken(frames: Iterator[TimedFrame], end_reasons: list[str]) -> Iterator[TimedFrame]:
    """Yield the frames until reading fails. Append the reason for this to ``end_reasons``."""
    try:
        yield from frames
    except BrokenSourceError as error:
        end_reasons.append(str(error).rstrip("."))
    except InputError:
        raise
    except Exception as error:  # the frames that were already read must still be tracked
        end_reasons.append(f"reading the images failed, {reason(error)}")


def _record_loops(recorder: Recorder, slam: Slam, n_recorded: int) -> int:
    """Record the loops after the first ``n_recorded``. Return the number of recorded loops."""
    if len(slam.loops) > n_recorded:
        recorder.loops(slam.loops[n_recorded:], slam.map)
    return len(slam.loops)


@contextmanager
def _stop_on_interrupt() -> Iterator[threading.Event]:
    """Set an event at the first Ctrl-C. A second Ctrl-C ends the program at once."""
    interrupted = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield interrupted
        return

    def note(signal_number: int, stack: object) -> None:
        interrupted.set()
        signal.signal(signal.SIGINT, previous)

    previous = signal.signal(signal.SIGINT, note)
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, previous)
