"""From a sequence to an outcome: frames are prepared ahead, tracked in order, recorded.

Reading, perturbing and extracting are pure functions of a frame, done by a small pool a few
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
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.camera import ImageMap
from vslam.datasets.perturbation import Perturbation
from vslam.datasets.sequence import Sequence
from vslam.errors import UnreadableImageError
from vslam.features import Features, TrackResult
from vslam.frontend.tracking import TrackingContext, extract_features
from vslam.loopclosure.registry import create_detector, create_images
from vslam.machine import peak_memory_mb, process_age
from vslam.run.outcome import RunOutcome, RunSettings
from vslam.run.realtime import play
from vslam.run.recorder import NullRecorder, Recorder
from vslam.slam import Slam
from vslam.trajectory import Trajectory

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PreparedFrame:
    """A frame ready to be tracked, or the reason why it cannot be read."""

    left: NDArray[np.uint8] | None
    features: Features | None
    stage_ms: dict[str, float]
    problem: str | None = None


def run_sequence(
    sequence: Sequence,
    perturbation: Perturbation,
    settings: RunSettings,
    recorder: Recorder,
    *,
    on_frame: Callable[[TrackResult], None] = lambda result: None,
) -> RunOutcome:
    """Run SLAM over a whole sequence.

    A frame that cannot be read is skipped: it gets a predicted pose, counts as lost and is listed
    in the outcome. One that is dropped in a real-time run gets an interpolated pose. Ctrl-C ends
    the run after the current frame; all done so far is kept.
    """
    cv2.setNumThreads(1)  # the pool uses the cores
    images = create_images(settings.detector, settings.config)
    detector = create_detector(settings.detector, settings.config, settings.weights, images)
    slam = Slam(sequence.camera, settings.config, detector, threads=settings.threads, images=images)
    tracks: list[TrackResult] = []
    skipped: list[str] = []
    latency_ms: list[float] = []
    n_told = 0  # loops that the recorder knows of
    recorder.begin(sequence.camera, _ground_truth(sequence))
    startup = process_age()
    wall, cpu = time.perf_counter(), time.process_time()
    with _stop_on_interrupt() as interrupted:
        for index, frame, came in _frames(sequence, perturbation, slam.context, settings):
            for missed in sequence.timestamps[len(tracks) : index].tolist():
                tracks.append(slam.skip(missed, dropped=True))
                on_frame(tracks[-1])
            timestamp = float(sequence.timestamps[index])
            if frame.features is None or frame.left is None:
                skipped.append(f"frame {index}: {frame.problem}")
                _log.warning("frame %d skipped: %s", index, frame.problem)
                result = slam.skip(timestamp)
            else:
                result = slam.step_features(frame.features, timestamp, frame.left, frame.stage_ms)
                if settings.realtime:
                    latency_ms.append(1e3 * (time.perf_counter() - came))
            tracks.append(result)
            recorder.frame(result, result.T_wc)
            if result.is_keyframe and slam.frame is not None and frame.left is not None:
                recorder.keyframe(result, frame.left, slam.frame.features, slam.frame.landmark >= 0)
            if not slam.is_mapping:
                recorder.map(slam.map)
                n_told = _tell_loops(recorder, slam, n_told)
            on_frame(result)
            if interrupted.is_set():
                break
        slam.finish()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    _tell_loops(recorder, slam, n_told)
    trajectory = slam.trajectory()
    recorder.finish(trajectory, slam.map)
    return RunOutcome(
        settings=settings,
        sequence=sequence,
        trajectory=trajectory,
        keyframes=slam.keyframe_trajectory(),
        tracks=tracks,
        skipped=skipped,
        wall_s=wall,
        cpu_s=cpu,
        startup_s=startup,
        peak_memory_mb=peak_memory_mb(),
        latency_ms=latency_ms,
        n_keyframes=len(slam.map.living_keyframes()),
        n_landmarks=len(slam.map.living_landmarks()),
        map=slam.map,
        loops=slam.loops,
        corrections=slam.corrections,
        keyframe_frames=np.array(slam.map.frames, np.int64),
        n_submaps=len({0, *slam.map.restarts}) if slam.map.n_keyframes else 0,
        interrupted="Ctrl-C" if interrupted.is_set() else None,
    )


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
    settings = replace(outcome.settings, detector="none", weights=None)
    without = run_sequence(
        outcome.sequence, perturbation, settings, NullRecorder(), on_frame=on_frame
    )
    if without.interrupted:
        return replace(outcome, interrupted=f"{without.interrupted}, in the run without loops")
    return replace(outcome, without_loops=replace(without, map=None))  # a map takes 100s of MB


def _frames(
    sequence: Sequence, perturbation: Perturbation, context: TrackingContext, settings: RunSettings
) -> Iterator[tuple[int, PreparedFrame, float]]:
    """Frames with their numbers and when they came: all of them now, or each in its time."""
    if settings.realtime:
        with ThreadPoolExecutor(2, "side") as pool:
            image_map = map if settings.threads == 1 else pool.map
            yield from play(
                sequence.timestamps,
                lambda index: prepare_frame(sequence, index, perturbation, context, image_map),
                settings.threads,
            )
        return
    frames = prepared_frames(sequence, perturbation, context, settings.threads)
    now = time.perf_counter()
    for index, frame in enumerate(frames):
        yield index, frame, now


def prepared_frames(
    sequence: Sequence, perturbation: Perturbation, context: TrackingContext, threads: int
) -> Iterator[PreparedFrame]:
    """Frames in order; with more than one thread, prepared a few frames ahead."""
    if threads == 1:
        for index in range(len(sequence)):
            yield prepare_frame(sequence, index, perturbation, context)
        return
    ahead: deque[Future[PreparedFrame]] = deque()
    following = 0
    with ThreadPoolExecutor(threads, "extraction") as pool:
        try:
            while following < len(sequence) or ahead:
                while following < len(sequence) and len(ahead) < 2 * threads:
                    arguments = (sequence, following, perturbation, context)
                    ahead.append(pool.submit(prepare_frame, *arguments))
                    following += 1
                yield ahead.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)


def prepare_frame(
    sequence: Sequence,
    index: int,
    perturbation: Perturbation,
    context: TrackingContext,
    image_map: ImageMap = map,
) -> PreparedFrame:
    """Read, perturb and extract one frame."""
    start = time.perf_counter()
    try:
        left, second = sequence.read(index, image_map)
    except UnreadableImageError as error:
        return PreparedFrame(None, None, {}, str(error))
    if context.camera.depth:
        left, _ = perturbation.apply(index, left, None)  # light and dirt leave the depth as it is
    else:
        left, second = perturbation.apply(index, left, second)
    read = time.perf_counter()
    features = extract_features(left, second, context, image_map)
    done = time.perf_counter()
    stage_ms = {"read": 1e3 * (read - start), "extract": 1e3 * (done - read)}
    return PreparedFrame(left, features, stage_ms)


def _tell_loops(recorder: Recorder, slam: Slam, n_told: int) -> int:
    """Show the recorder the loops decided since it was told of ``n_told``; returns how many now."""
    if len(slam.loops) > n_told:
        recorder.loops(slam.loops[n_told:], slam.map)
    return len(slam.loops)


def _ground_truth(sequence: Sequence) -> Trajectory | None:
    poses = sequence.ground_truth
    return None if poses is None else Trajectory(sequence.timestamps, poses)


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
