"""From a sequence or stream to an outcome: frames are prepared ahead, tracked in order, recorded.

Decoding, perturbing and extracting are pure functions of a frame, done by a small pool a few
frames ahead. Their order is kept, so that the result does not depend on the number of threads.
In real time frames are prepared when they come, both images at once, and those that come too soon
are dropped; then the result depends on the machine.
"""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import dropwhile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, DepthImage, Image, ImageMap, same_camera
from vslam.datasets.perturbation import Perturbation, perturbed
from vslam.datasets.sequence import Sequence
from vslam.datasets.stream import Stream, TimedFrame, is_live, timed_frames
from vslam.errors import (
    BrokenSourceError,
    DroppedFrameError,
    InputError,
    UnreadableImageError,
)
from vslam.features import Features, TrackResult
from vslam.frontend.sides import Sides, compare_sides
from vslam.frontend.tracking import TrackingContext, extract_features
from vslam.loopclosure.registry import create_detector, create_images, problem_of
from vslam.loops import LoopCorrection, LoopEdge
from vslam.machine import peak_memory_mb, process_age
from vslam.map import Map
from vslam.maps.storage import made_with
from vslam.run.autosave import NO_AUTOSAVE, Autosave, Progress, Unfinished, in_frames
from vslam.run.outcome import RunOutcome, RunSettings, ground_truth_of
from vslam.run.realtime import Played, play
from vslam.run.recorder import NullRecorder, Recorder
from vslam.run.rig import measure_rig, residual_warnings, rig_warnings
from vslam.slam import Slam

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PreparedFrame:
    """A frame ready to be tracked, or the reason why it cannot be read; ``dropped`` by a
    perturbation."""

    left: NDArray[np.uint8] | None
    features: Features | None
    stage_ms: dict[str, float]
    problem: str | None = None
    dropped: bool = False
    sides: Sides = field(default_factory=Sides)


def run_sequence(
    sequence: Sequence | Stream,
    perturbation: Perturbation,
    settings: RunSettings,
    recorder: Recorder,
    *,
    on_frame: Callable[[TrackResult], None] = lambda result: None,
    autosave: Autosave = NO_AUTOSAVE,
    resume: Unfinished | None = None,
) -> RunOutcome:
    """Run SLAM over a whole sequence, or over a stream until it ends.

    A frame that cannot be read is skipped: it gets a predicted pose, counts as lost and is listed
    in the outcome. One that is dropped in a real-time run gets an interpolated pose. Ctrl-C ends
    the run after the current frame, a source that breaks off after its last good one, a detector of
    another package where it fails; all done so far is kept.

    Args:
        autosave: saves what is done while the run goes on.
        resume: what such a run left; this one goes on at the next frame, and its outcome covers
            both.
    """
    cv2.setNumThreads(1)  # the pool uses the cores
    slam = begin(sequence.camera, settings, None if resume is None else resume.map)
    before = Progress() if resume is None else resume.progress
    tracks = list(before.tracks)
    skipped = list(before.skipped)
    sides: list[Sides] = []
    latency_ms = list(before.latency_ms)
    n_told = 0  # loops that the recorder knows of
    perturbation = perturbation.bound_to(sequence)
    recorder.begin(sequence.camera, ground_truth_of(sequence))
    startup = process_age()
    wall, cpu = time.perf_counter(), time.process_time()
    broken: list[str] = []

    def so_far() -> Progress:
        frames = _frames_of_this_run(slam.map)
        loops, corrections = in_frames(slam.loops, slam.corrections, frames)
        return Progress(
            tracks=tracks.copy(),
            skipped=skipped.copy(),
            latency_ms=latency_ms.copy(),
            wall_s=before.wall_s + time.perf_counter() - wall,
            cpu_s=before.cpu_s + time.process_time() - cpu,
            loops=before.loops + loops,
            corrections=before.corrections + corrections,
        )

    slam.on_merge = lambda: autosave.offer_amid(slam, so_far)
    with _stop_on_interrupt() as interrupted:
        frames = perturbed(_until_broken(timed_frames(sequence), broken), perturbation)
        if tracks:
            frames = dropwhile(partial(_not_later, tracks[-1].timestamp), frames)
        for played in _prepared(frames, slam.context, settings, live=is_live(sequence)):
            timestamp, frame = played.timestamp, played.made
            if frame is None or frame.dropped:
                tracks.append(slam.skip(timestamp, dropped=True))
                autosave.frame(tracks[-1])
                on_frame(tracks[-1])
                continue
            sides.append(frame.sides)
            if frame.features is None or frame.left is None:
                skipped.append(f"frame {len(tracks)}: {frame.problem}")
                _log.warning("frame %d skipped: %s", len(tracks), frame.problem)
                result = slam.skip(timestamp)
            else:
                result = slam.step_features(frame.features, timestamp, frame.left, frame.stage_ms)
                if settings.realtime:
                    latency_ms.append(1e3 * (time.perf_counter() - played.came))
            tracks.append(result)
            autosave.frame(result)
            recorder.frame(result, result.T_wc)
            if result.is_keyframe and slam.frame is not None and frame.left is not None:
                recorder.keyframe(result, frame.left, slam.frame.features, slam.frame.landmark >= 0)
            if not slam.is_mapping:
                recorder.map(slam.map)
                n_told = _tell_loops(recorder, slam, n_told)
            on_frame(result)
            autosave.offer(slam, so_far)
            if problem := problem_of(slam.detector):
                broken.append(problem)
                break
            if interrupted.is_set():
                if not is_live(sequence):  # a camera has no other end
                    broken.append("Ctrl-C")
                break
        slam.finish()
    if not broken and (problem := problem_of(slam.detector)):
        broken.append(problem)
    autosave.close(slam, so_far, whole=not broken)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    _tell_loops(recorder, slam, n_told)
    loops, corrections, keyframe_frames = _with_earlier(before, slam)
    trajectory = slam.trajectory()
    drive = f"{settings.dataset} {sequence.name}"
    recorder.finish(trajectory, slam.map)
    return RunOutcome(
        settings=settings,
        sequence=sequence,
        trajectory=trajectory,
        keyframes=slam.keyframe_trajectory(),
        tracks=tracks,
        skipped=skipped,
        warnings=[
            *rig_warnings(sides),
            *residual_warnings(measure_rig(slam.map, sequence.camera), sequence.camera),
        ],
        wall_s=before.wall_s + wall,
        cpu_s=before.cpu_s + cpu,
        startup_s=startup,
        peak_memory_mb=peak_memory_mb(),
        latency_ms=latency_ms,
        n_keyframes=len(slam.map.living_keyframes()),
        n_landmarks=len(slam.map.living_landmarks()),
        map=slam.map,
        stored=None if settings.localize else slam.stored_map(drive),
        world=slam.world,
        in_map=None if settings.map is None else slam.in_map(),
        loops=loops,
        corrections=corrections,
        keyframe_frames=keyframe_frames,
        n_submaps=len({0, *slam.map.restarts}) if slam.map.n_keyframes else 0,
        interrupted=broken[0] if broken else None,
    )


def _not_later(timestamp: float, frame: TimedFrame) -> bool:
    return frame.timestamp <= timestamp


def _with_earlier(
    before: Progress, slam: Slam
) -> tuple[list[LoopEdge], list[LoopCorrection], NDArray[np.int64]]:
    """Loops and corrections of a whole run, and the frame of each keyframe that they name.

    Those of before name frames. These get numbers after those of the map's keyframes.
    """
    frames = _frames_of_this_run(slam.map)
    if not before.loops:
        return slam.loops, slam.corrections, frames
    named = {end for loop in before.loops for end in (loop.query, loop.match)}
    extra = np.array(sorted(named), np.int64)
    number = {frame: len(frames) + k for k, frame in enumerate(extra.tolist())}

    def renamed(loop: LoopEdge) -> LoopEdge:
        query = number[loop.query] if loop.query >= 0 else -1
        return replace(loop, query=query, match=number[loop.match])

    loops = [renamed(loop) for loop in before.loops]
    corrections = [replace(one, edge=renamed(one.edge)) for one in before.corrections]
    return loops + slam.loops, corrections + slam.corrections, np.concatenate([frames, extra])


def begin(camera: Camera, settings: RunSettings, saved: Path | None = None) -> Slam:
    """SLAM before its first frame, with the detector asked for, in a new map or in one of a file;
    with ``saved``, the map that an unfinished run left, before the next frame of that run.

    Raises:
        InputError: no such map, one of another camera, detector or pyramid, or weights that cannot
            be read.
    """
    config, threads = settings.config, settings.threads
    images = create_images(settings.detector, config)
    detector = create_detector(settings.detector, config, settings.weights, images)
    if saved is not None:
        return Slam.load(saved, config, detector, threads=threads, images=images, resume=True)
    if settings.map is None:
        return Slam(camera, config, detector, threads=threads, images=images)
    return Slam.load(
        settings.map, config, detector, threads=threads, images=images, localize=settings.localize
    )


def require_camera(map_file: Path, camera: Camera) -> None:
    """Refuse images of another camera than those that a map was made of.

    Raises:
        InputError: it is another one, or there is no such map.
    """
    of_map, _ = made_with(map_file)
    if not same_camera(of_map, camera):
        raise InputError(
            f"{map_file}: the map's camera is not that of the images ({of_map.sensor}, "
            f"{of_map.width}x{of_map.height}, fx {of_map.fx:.1f}); go on with images of the same "
            "camera, rectified alike."
        )


def _frames_of_this_run(map_: Map) -> NDArray[np.int64]:
    of_this = np.array(map_.sessions, np.int64) == map_.session
    return np.where(of_this, np.array(map_.frames, np.int64), -1)


def with_comparison(
    outcome: RunOutcome,
    perturbation: Perturbation,
    *,
    on_frame: Callable[[TrackResult], None] = lambda result: None,
) -> RunOutcome:
    """Run the sequence again with the detector ``none``, unrecorded, and keep both outcomes.

    Everything else is the same: images, perturbation, thresholds. Where Ctrl-C ends the second run
    there is nothing to compare, and the first one's outcome says so.
    """
    settings = replace(outcome.settings, detector="none", weights=None, map=None)
    without = run_sequence(
        outcome.sequence, perturbation, settings, NullRecorder(), on_frame=on_frame
    )
    if without.interrupted:
        return replace(outcome, interrupted=f"{without.interrupted}, in the run without loops")
    without = replace(without, map=None, stored=None)  # a map takes 100s of MB
    return replace(outcome, without_loops=without)


def _until_broken(frames: Iterator[TimedFrame], broken: list[str]) -> Iterator[TimedFrame]:
    """The frames of a source; where it breaks off, they end, and ``broken`` is told why."""
    try:
        yield from frames
    except BrokenSourceError as error:
        broken.append(str(error).rstrip("."))


def _prepared(
    frames: Iterator[TimedFrame], context: TrackingContext, settings: RunSettings, *, live: bool
) -> Iterator[Played[PreparedFrame]]:
    """Prepared frames and when they came: all of them at the start, or each in its time."""
    if settings.realtime:
        with ThreadPoolExecutor(2, "side") as pool:
            image_map = map if settings.threads == 1 else pool.map
            yield from play(
                frames,
                lambda frame: prepare_frame(frame, context, image_map),
                settings.threads,
                live=live,
            )
        return
    start = time.perf_counter()
    for timestamp, prepared in prepared_frames(frames, context, settings.threads):
        yield Played(timestamp, prepared, start)


def prepared_frames(
    frames: Iterator[TimedFrame], context: TrackingContext, threads: int
) -> Iterator[tuple[float, PreparedFrame]]:
    """Frames in order with their times; with more than one thread, prepared a few frames ahead."""
    if threads == 1:
        for frame in frames:
            yield frame.timestamp, prepare_frame(frame, context)
        return
    ahead: deque[tuple[float, Future[PreparedFrame]]] = deque()
    with ThreadPoolExecutor(threads, "extraction") as pool:
        try:
            for frame in frames:
                ahead.append((frame.timestamp, pool.submit(prepare_frame, frame, context)))
                if len(ahead) == 2 * threads:
                    timestamp, prepared = ahead.popleft()
                    yield timestamp, prepared.result()
            for timestamp, prepared in ahead:
                yield timestamp, prepared.result()
        finally:
            pool.shutdown(cancel_futures=True)


def prepare_frame(
    frame: TimedFrame, context: TrackingContext, image_map: ImageMap = map
) -> PreparedFrame:
    """Read one frame and extract its features."""
    start = time.perf_counter()
    try:
        left, second = frame.read(image_map)
    except UnreadableImageError as error:
        dropped = isinstance(error, DroppedFrameError)
        return PreparedFrame(None, None, {}, str(error), dropped)
    read = time.perf_counter()
    sides = _sides(left, second, context)
    features = extract_features(left, second, context, image_map, sides)
    done = time.perf_counter()
    stage_ms = {"read": 1e3 * (read - start), "extract": 1e3 * (done - read)}
    return PreparedFrame(left, features, stage_ms, sides=sides or Sides())


def _sides(
    left: Image, second: Image | DepthImage | None, context: TrackingContext
) -> Sides | None:
    if second is None or second.dtype != np.uint8:
        return None
    return compare_sides(left, np.asarray(second, np.uint8), context.config.stereo)


def _tell_loops(recorder: Recorder, slam: Slam, n_told: int) -> int:
    """Show the recorder the loops decided since it was told of ``n_told``; returns how many now."""
    if len(slam.loops) > n_told:
        recorder.loops(slam.loops[n_told:], slam.map)
    return len(slam.loops)


@contextmanager
def _stop_on_interrupt() -> Iterator[threading.Event]:
    """Turn the first Ctrl-C into a flag, so that no frame is left half done; a second one ends
    the program at once."""
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
