"""Runs SLAM on a sequence or stream. Frames are prepared, tracked in order and recorded."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.datasets.frames import TimedFrame
from vslam.datasets.imu import ImuFeed
from vslam.datasets.perturbation import Perturbation, perturbed
from vslam.maps.storage import made_with
from vslam.run.autosave import NO_AUTOSAVE, Autosave
from vslam.run.outcome import RunOutcome, causal_trajectory, ground_truth_of
from vslam.run.pair import PairCheck
from vslam.run.preparation import FramesAhead, Played, PreparedFrame
from vslam.run.recorder import Recorder
from vslam.run.slam_run import SlamRun
from vslam.slam import Slam
from vslam.support.errors import BrokenSourceError, InputError
from vslam.support.machine import give_back_memory
from vslam.support.plugins import reason
from vslam.types.camera import Camera, same_camera
from vslam.types.features import TrackingState, TrackResult

_log = logging.getLogger(__name__)


def run_sequence(
    run: SlamRun,
    perturbation: Perturbation,
    recorder: Recorder,
    *,
    on_frame: Callable[[TrackResult], None] = lambda result: None,
    autosave: Autosave = NO_AUTOSAVE,
) -> RunOutcome:
    """Run SLAM over a whole sequence, or over a stream until it ends.

    A frame that cannot be read is skipped. This frame gets a predicted pose, counts as lost and is
    listed in the outcome. A frame that is dropped in a real-time run gets an interpolated pose.

    The run ends early after Ctrl-C, when the source ends unexpectedly, or when a component fails,
    for example the loop detector of a plug-in. All results obtained so far are kept. If mapping
    failed, the outcome contains no map, and the poses are those at the time of tracking.

    Args:
        run: the result of ``begin`` for a source and the options of the run.

    Raises:
        InputError: the images cannot be read, or are not those of the resumed run. Only errors
            before the first frame raise an exception. Later errors end the run early.
    """
    cv2.setNumThreads(1)  # the thread pool already uses all cores
    source, slam = run.source, run.slam
    feed = None if source.imu is None else ImuFeed(source.imu)
    perturbation = perturbation.bound_to(source)
    pair = PairCheck(source.camera, source.dataset, run.settings)
    recorder.begin(source.camera, ground_truth_of(source))
    run.start()
    n_recorded = 0  # loops passed to the recorder so far
    end_reasons: list[str] = []  # why the run ended early; the first reason counts
    with _stop_on_interrupt() as interrupted:
        frames = pair.watch(_until_broken(source.frames(), end_reasons))
        frames = perturbed(frames, perturbation)
        frames = _following(frames, run.before.tracks.timestamps)
        ahead = FramesAhead(
            frames,
            slam.context,
            slam.workers,
            realtime=run.settings.realtime,
            live=source.live,
            begin=len(run.tracks),
        )
        try:
            for played in ahead:
                samples = None if feed is None else feed.until(played.timestamp)
                result = run.step(played, samples)
                ahead.request(result.next_extraction)
                if (frame := played.prepared) is not None and frame.problem and not frame.dropped:
                    _log.warning("frame %d skipped: %s", result.index, frame.problem)
                autosave.frame(result)
                if result.state != TrackingState.DROPPED:
                    n_recorded = _record_frame(recorder, slam, result, played, n_recorded)
                on_frame(result)
                autosave.offer(slam, run.so_far)
                if run.problem:
                    break
                if interrupted.is_set():
                    if not source.live:  # for a live source, Ctrl-C is the usual end
                        end_reasons.append("Ctrl-C")
                    break
        except Exception as error:  # keep the results obtained so far
            if isinstance(error, InputError) and not run.has_begun:
                raise
            run.fail(f"frame {len(run.tracks)}", error)
        run.finish()
        if not end_reasons and run.problem:
            end_reasons.append(run.problem)
        with run.recording_failure("saving the map"):
            autosave.close(slam, run.so_far, resumable=bool(end_reasons) and run.has_map)
    seconds = run.seconds()
    is_own = run.has_map and not run.settings.localize
    pair.end(source, perturbation, len(run.tracks), slam.map if is_own else None)
    give_back_memory()  # the results are written from a copy of the map, which needs memory
    with run.recording_failure("the final trajectory"):
        if run.has_map:
            _record_loops(recorder, slam, n_recorded)
            recorder.finish(run.trajectory(), slam.map)
        else:
            recorder.finish(causal_trajectory(run.tracks), None)
    return run.outcome(seconds, pair.warnings(), end_reasons[0] if end_reasons else run.problem)


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
