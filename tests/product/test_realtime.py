"""A sequence in real time: no frame comes too early, and a slow consumer misses frames."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import threading
import time
import weakref

import numpy as np
import pytest

from vslam.config import Config, OrbConfig
from vslam.datasets import open_sequence
from vslam.datasets.frames import TimedFrame
from vslam.datasets.perturbation import Perturbation
from vslam.run.options import RunOptions
from vslam.run.pipeline import run_sequence
from vslam.run.preparation import play
from vslam.run.recorder import Recorder
from vslam.run.slam_run import begin
from vslam.slam import Slam
from vslam.types.features import TrackingState


def cameras() -> list[str]:
    return [
        thread.name for thread in threading.enumerate() if thread.name in ("camera", "preparation")
    ]


def frames_at(times):
    return (TimedFrame(t, lambda image_map: pytest.fail("never decoded")) for t in times.tolist())


@pytest.mark.parametrize("threads", [1, 2])
def test_no_frame_comes_before_its_time_and_the_last_one_always_comes(threads):
    times = 100.0 + 0.02 * np.arange(20)
    begin, seen = time.perf_counter(), []
    for played in play(frames_at(times), lambda n, f: (f.timestamp, time.perf_counter()), threads):
        seen.append(played)
        if played.prepared is not None:
            index = round((played.timestamp - 100.0) / 0.02)
            assert played.prepared[0] == played.timestamp
            assert played.prepared[1] >= played.arrived >= begin + 0.02 * index
    assert [played.timestamp for played in seen] == times.tolist()  # including dropped frames
    assert seen[0].prepared is not None
    assert seen[-1].prepared is not None


@pytest.mark.parametrize("threads", [1, 2])
def test_who_is_late_gets_the_newest_frame(threads):
    """The camera sends nine frames while the first frame is processed."""
    sent = threading.Event()

    def film():
        yield from frames_at(np.arange(10.0))
        sent.set()

    seen = []
    for played in play(film(), lambda n, frame: frame, threads, live=True):
        seen.append(played)
        assert played.prepared is None or sent.wait(60)
    assert [played.timestamp for played in seen] == [*range(10)]
    used = [played.timestamp for played in seen if played.prepared is not None]
    assert (used[0], used[-1]) == (0.0, 9.0)
    # With two threads, a second frame is prepared while the first one is used.
    assert len(used) <= 1 + threads


def test_with_one_thread_a_frame_is_prepared_after_the_last_one_was_used():
    used, order = [], []

    def prepare(number: int, frame: TimedFrame) -> TimedFrame:
        order.append(len(used))
        return frame

    for played in play(frames_at(0.005 * np.arange(10)), prepare, 1):
        if played.prepared is not None:
            time.sleep(0.002)
            used.append(played)
    assert order == list(range(len(order)))


def test_who_stops_listening_stops_the_camera():
    frames = play(frames_at(10.0 * np.arange(5)), lambda n, frame: frame, 2)
    next(frames)
    assert cameras()
    frames.close()
    assert not cameras()


def test_an_error_of_the_preparation_is_the_listeners():
    def fail(number: int, frame: TimedFrame) -> None:
        raise OSError("no such image")

    with pytest.raises(OSError, match="no such image"):
        list(play(frames_at(np.arange(3.0)), fail, 2))
    assert not cameras()


def test_an_error_of_the_camera_comes_after_its_frames():
    def unplugged():
        yield from frames_at(0.05 * np.arange(3))
        raise OSError("unplugged")

    frames = play(unplugged(), lambda n, frame: frame, 2)
    assert [next(frames).timestamp for _ in range(3)] == [0.0, 0.05, 0.1]
    with pytest.raises(OSError, match="unplugged"):
        next(frames)
    assert not cameras()


def test_a_live_camera_sets_the_pace_and_dropped_frames_are_let_go():
    """The timestamps of a live camera do not matter.

    Only frames that wait or are being processed are kept in memory.
    """
    alive, most = set(), []

    def film():
        for k in range(40):
            frame = TimedFrame(1000.0 * k, lambda image_map: pytest.fail("never decoded"))
            alive.add(k)
            weakref.finalize(frame, alive.discard, k)
            yield frame
            most.append(len(alive))
            del frame
            time.sleep(0.005)

    seen = []
    for played in play(film(), lambda n, frame: True, 2, live=True):
        seen.append(played.timestamp)
        time.sleep(0.02)
    assert seen == [1000.0 * k for k in range(40)]
    assert max(most) <= 8


def test_frames_that_were_dropped_are_not_lost(corridor, check_map):
    """Four of seven frames are dropped. Their poses lie on the path."""
    slam = Slam(corridor.camera, Config(orb=OrbConfig(n_features=800)), "none", threads=1)
    states = []
    for k in range(len(corridor.left)):
        if k % 7 in (2, 3, 5, 6):
            states.append(slam.skip(corridor.timestamps[k], dropped=True).state)
        else:
            result = slam.step(corridor.left[k], corridor.right[k], corridor.timestamps[k])
            states.append(result.state)
    slam.finish()
    assert set(states) == {TrackingState.OK, TrackingState.DROPPED}
    assert not slam.map.restarts
    steps = np.diff(slam.trajectory().T_wc[:, :3, 3], axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 0.35, atol=0.08)
    check_map(slam.map)


@pytest.mark.parametrize("threads", [1, 2])
def test_one_camera_in_real_time(kitti_tree, threads):
    sequence = open_sequence("kitti", kitti_tree, "00", max_frames=6, monocular=True)
    settings = RunOptions(detector="none", threads=threads, realtime=True)
    outcome = run_sequence(begin(sequence, settings), Perturbation("none"), Recorder())
    assert len(outcome.tracks) == 6
    seen = [track for track in outcome.tracks if track.stage_ms]  # the others were dropped
    assert len(outcome.latency_ms) == len(seen) > 0


@pytest.mark.parametrize("threads", [1, 2])
def test_an_unreadable_image_in_real_time(kitti_tree, threads, tmp_path):
    """It belongs to the last frame, which is never dropped. The run still ends normally."""
    root = tmp_path / "kitti"
    shutil.copytree(kitti_tree, root)
    image = root / "sequences" / "00" / "image_0" / "000005.png"
    image.write_bytes(image.read_bytes()[:2000])
    sequence = open_sequence("kitti", root, "00", max_frames=6)
    settings = RunOptions(detector="none", threads=threads, realtime=True)
    outcome = run_sequence(begin(sequence, settings), Perturbation("none"), Recorder())
    assert len(outcome.trajectory) == len(outcome.tracks) == 6
    assert outcome.tracks[5].state == TrackingState.LOST
    assert [str(image) in message for message in outcome.skipped] == [True]


def test_a_compared_detector_drops_the_frames_that_the_main_one_drops(kitti_tree):
    """With a live camera, this must be the case, because each frame arrives only once."""
    sequence = open_sequence("kitti", kitti_tree, "00", max_frames=8)
    settings = RunOptions(detector="bow", threads=2, realtime=True, compare=("none",))
    outcome = run_sequence(begin(sequence, settings), Perturbation("none"), Recorder())
    (other,) = outcome.compared
    assert len(outcome.tracks) == len(other.tracks) == 8
    for own, compared in zip(outcome.tracks, other.tracks, strict=True):
        assert (own.timestamp, own.n_features) == (compared.timestamp, compared.n_features)


@pytest.mark.slow
def test_command_line_in_real_time(kitti_tree, tmp_path):
    command = [sys.executable, "-m", "vslam", "run", "--data", str(kitti_tree), "--realtime"]
    done = subprocess.run(
        [*command, "--no-record", "--detector", "none"],
        cwd=tmp_path, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert re.search("Latency +.* dropped", done.stdout)
    folder = tmp_path / "runs" / "latest"
    report = json.loads((folder / "report.json").read_text())
    assert report["realtime"] is True
    assert report["frames"] == 28
    assert len((folder / "trajectory_kitti.txt").read_text().splitlines()) == 28
    latency = report["latency_ms"]
    assert 0.0 < latency["median"] <= latency["p95"] <= latency["p99"]
    assert "| Latency" in (folder / "report.md").read_text()
    refused = subprocess.run(
        [*command, "--detector", "none", "--compare", "bow"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert refused.returncode == 2
    assert "leave out --realtime" in refused.stderr
