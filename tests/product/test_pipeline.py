"""A complete run, from images on the disk to trajectory, report, map and recording."""

from __future__ import annotations

import csv
import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from vslam.config import Config
from vslam.datasets import open_sequence
from vslam.datasets.perturbation import parse_perturbation, perturbed
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.maps.storage import load_map, save_map
from vslam.maps.stored_map import StoredMap
from vslam.run.options import RunOptions
from vslam.run.outcome import RunOutcome
from vslam.run.pipeline import _record_loops, run_sequence
from vslam.run.preparation import prepare_frame
from vslam.run.recorder import Recorder
from vslam.run.slam_run import begin, mistracked_warnings
from vslam.types.context import Context
from vslam.types.features import TrackingState
from vslam.types.loops import LoopEdge
from vslam.types.trajectory import Trajectory, read_kitti_poses

KITTI = Path(__file__).parents[3] / "shared" / "data" / "kitti"
needs_kitti = pytest.mark.skipif(not KITTI.is_dir(), reason="KITTI is not at ../shared/data")


def run(root: Path, sequence: str = "00", *, threads: int = 2, perturb: str = "none",
        seed: int = 0, max_frames: int | None = None, detector: str = "none",
        compare: tuple[str, ...] = (), **options: object) -> RunOutcome:  # fmt: skip
    frames = open_sequence("kitti", root, sequence, max_frames=max_frames)
    perturbation = parse_perturbation(perturb, seed)
    settings = RunOptions(detector=detector, threads=threads, compare=compare)
    return run_sequence(begin(frames, settings), perturbation, Recorder(), **options)


def vslam(*words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "vslam", *map(str, words)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)


def ground_truth(outcome: RunOutcome) -> Trajectory:
    poses = outcome.sequence.ground_truth
    assert poses is not None
    return Trajectory(outcome.sequence.timestamps, poses)


def test_a_run_warns_of_the_calibration_of_other_images(kitti_tree):
    frames = open_sequence("kitti", kitti_tree, "00", max_frames=3)
    c = frames.camera
    twice = replace(c, fx=2 * c.fx, fy=2 * c.fy, cx=2 * c.cx, cy=2 * c.cy)
    settings = RunOptions(detector="none", calib=(Path("a.yaml"),))
    source = replace(frames, camera=twice)
    outcome = run_sequence(begin(source, settings), parse_perturbation("none", 0), Recorder())
    (said,) = outcome.warnings
    assert said.startswith("a.yaml: the principal point")
    assert "images of twice this size" in said


@pytest.mark.slow
def test_same_bytes_with_any_number_of_threads(kitti_tree):
    runs = [run(kitti_tree, threads=threads, perturb="brightness:1") for threads in (1, 2, 4, 2)]
    assert len({outcome.trajectory.T_wc.tobytes() for outcome in runs}) == 1
    assert len({outcome.map.arrays.xyz.tobytes() for outcome in runs}) == 1
    assert all(track.state == TrackingState.OK for track in runs[0].tracks)


@pytest.mark.parametrize("monocular", [False, True])
def test_both_cameras_at_once_are_prepared_to_the_same_bytes(kitti_tree, monocular):
    sequence = open_sequence("kitti", kitti_tree, "00", monocular=monocular)
    law = parse_perturbation("brightness:1", 0)
    context = Context.create(sequence.camera, Config())
    met = threading.Barrier(1 if monocular else 2, timeout=60.0)

    def at_once(function, sides):
        return pool.map(lambda side: (met.wait(), function(side))[1], sides)

    with ThreadPoolExecutor(2) as pool:
        for frame in islice(perturbed(sequence.frames(), law), 3):
            one = prepare_frame(frame, context)
            other = prepare_frame(frame, context, at_once)
            assert one.images.image.tobytes() == other.images.image.tobytes()
            pixels = [prepared.images.extracted.pyramid.pixels for prepared in (one, other)]
            assert np.array_equal(*pixels)
            for name, value in vars(one.images.extracted.features).items():
                same = getattr(other.images.extracted.features, name)
                assert np.array_equal(value, same, equal_nan=True), name


def test_corridor_is_tracked_to_centimetres(kitti_tree):
    outcome = run(kitti_tree)
    evaluation = evaluate_trajectory(outcome.trajectory, ground_truth(outcome))
    path = evaluation.distances_m[-1]
    assert path == pytest.approx(27 * 0.35, rel=1e-4)  # chords of the turn
    assert evaluation.ate_rmse_m < 0.03
    assert outcome.n_keyframes >= 3
    assert outcome.n_landmarks > 300


def test_keyframes_are_named_by_their_frames(kitti_tree):
    outcome = run(kitti_tree)
    keyframes = [track.index for track in outcome.tracks if track.is_keyframe]
    assert outcome.keyframe_frames.tolist() == keyframes
    assert outcome.n_submaps == 1


def test_recorder_is_told_of_each_loop_once():
    told: list[LoopEdge] = []
    recorder = SimpleNamespace(loops=lambda edges, map_: told.extend(edges))
    slam = SimpleNamespace(loops=[], map=None)
    edges = [LoopEdge(k + 10, k, 0.5, k == 1, "closed") for k in range(4)]
    n_recorded = 0
    for upto in (0, 2, 2, 3, 4):
        slam.loops = edges[:upto]
        n_recorded = _record_loops(recorder, slam, n_recorded)
    assert told == edges


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_compared_detectors_have_the_bytes_of_their_own_runs(kitti_tree, threads):
    conditions = {"perturb": "brightness:1,desync:5", "seed": 3, "threads": threads}
    read = []
    together = run(
        kitti_tree, detector="both", compare=("bow", "none"),
        on_frame=lambda result: read.append(result.index), **conditions,
    )  # fmt: skip
    assert read == list(range(28))
    assert [one.settings.detector for one in together.compared] == ["bow", "none"]
    for one in (together, *together.compared):
        alone = run(kitti_tree, detector=one.settings.detector, **conditions)
        assert one.trajectory.T_wc.tobytes() == alone.trajectory.T_wc.tobytes()
        assert one.keyframes.T_wc.tobytes() == alone.keyframes.T_wc.tobytes()
        for track, own in zip(one.tracks, alone.tracks, strict=True):
            assert track.T_wc.tobytes() == own.T_wc.tobytes()
            assert (track.state, track.n_inliers) == (own.state, own.n_inliers)
        assert 0.0 < one.step_s < together.wall_s
    assert together.map is not None
    assert [(one.map, one.stored) for one in together.compared] == [(None, None)] * 2


def test_ctrl_c_ends_compared_detectors_at_the_same_frame(kitti_tree):
    def interrupt(result):
        if result.index == 9:
            signal.raise_signal(signal.SIGINT)

    outcome = run(kitti_tree, compare=("bow",), on_frame=interrupt)
    for one in (outcome, *outcome.compared):
        assert (one.interrupted, len(one.trajectory)) == ("Ctrl-C", 10)


def test_unreadable_frames_are_told_once_and_counted_by_each_detector(kitti_tree, tmp_path, caplog):
    root = tmp_path / "kitti"
    shutil.copytree(kitti_tree, root)
    image = root / "sequences" / "00" / "image_0" / "000004.png"
    image.write_bytes(image.read_bytes()[:2000])
    outcome = run(root, compare=("bow",), max_frames=6)
    assert [len(one.skipped) for one in (outcome, *outcome.compared)] == [1, 1]
    assert len(caplog.records) == 1
    assert "frame 4 skipped" in caplog.text


def test_truncated_image_is_skipped_and_counted(kitti_tree, tmp_path):
    root = tmp_path / "kitti"
    shutil.copytree(kitti_tree, root)
    image = root / "sequences" / "00" / "image_0" / "000014.png"
    image.write_bytes(image.read_bytes()[:2000])
    outcome = run(root)
    assert len(outcome.trajectory) == 28
    assert [str(image) in message for message in outcome.skipped] == [True]
    assert [k for k, t in enumerate(outcome.tracks) if t.state == TrackingState.LOST] == [14]
    # The predicted pose of the frame without images is as good as constant velocity.
    error = outcome.trajectory.T_wc[14, :3, 3] - outcome.sequence.ground_truth[14, :3, 3]
    assert np.linalg.norm(error) < 0.1


@pytest.mark.slow
def test_command_line_end_to_end(kitti_tree, tmp_path):
    done = vslam("run", "--data", kitti_tree, "--ply", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert re.search("Lost frames +0 +of 28; 0 weak, 0 skipped", done.stdout)
    folder = tmp_path / "runs" / "latest"
    report = json.loads((folder / "report.json").read_text())
    assert report["frames"] == 28
    assert report["lost_frames"] == 0
    assert report["ate_rmse_m"] < 0.03
    assert report["peak_memory_mb"] < 500
    for name in ("trajectory.tum", "keyframes.tum", "report.html", "report.md", "config.json",
                 "recording.rrd", "map.npz", "map.ply", "figures"):  # fmt: skip
        assert (folder / name).exists(), name
    assert len(read_kitti_poses(folder / "trajectory_kitti.txt")) == 28
    # The command in the report gives the ATE in the report.
    words = report["evo_command"].split()
    words[0] = str(Path(sys.executable).with_name(words[0]))
    printed = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    rmse = next(line.split()[-1] for line in printed.splitlines() if "rmse" in line)
    assert float(rmse) == pytest.approx(report["ate_rmse_m"], abs=1e-6)


@pytest.mark.slow
def test_run_without_pages_is_enough_for_a_report_later(kitti_tree, tmp_path):
    done = vslam("run", "--data", kitti_tree, "--no-record", "--no-report", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "runs" / "latest"
    assert {path.name for path in folder.iterdir()} == {
        "config.json", "covariance.csv", "frames.csv", "ground_truth_kitti.txt", "keyframes.tum",
        "map.npz", "report.json", "run.json", "trajectory.tum", "trajectory_causal.tum",
        "trajectory_kitti.txt", "trajectory_odom.tum", "trajectory_online.tum",
    }  # fmt: skip
    page = (Path(__file__).parents[2] / "docs/tutorial/report.md").read_text()
    assert [path.name for path in folder.iterdir() if f"`{path.name}`" not in page] == []
    with (folder / "frames.csv").open(newline="") as file:
        frames = list(csv.DictReader(file))
    assert [int(frame["frame"]) for frame in frames] == list(range(28))
    assert {frame["state"] for frame in frames} == {"OK"}
    assert float(frames[0]["extract_ms"]) > 0.0
    assert frames[0]["track_ms"] == ""  # the first frame has nothing to be tracked against
    assert "report.html" not in done.stdout
    later = vslam("report", folder, "--out", "later", cwd=tmp_path)
    assert later.returncode == 0, later.stderr
    assert "1 run" in later.stdout
    assert (tmp_path / "later" / "report.html").exists()


@pytest.mark.slow
@pytest.mark.parametrize("ended_by", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_finishes_the_report_of_the_frames_done(kitti_tree, tmp_path, ended_by):
    root = tmp_path / "kitti"
    shutil.copytree(kitti_tree, root)
    # The corridor is repeated, so that the run has not ended when the signal arrives.
    folder = root / "sequences" / "00"
    order = [*range(28), *range(26, 0, -1)] * 12
    for side in ("image_0", "image_1"):
        for index, source in enumerate(order[28:], 28):
            os.link(folder / side / f"{source:06d}.png", folder / side / f"{index:06d}.png")
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.6e}\n" for k in range(len(order))))
    shutil.rmtree(root / "poses")
    command = [sys.executable, "-m", "vslam", "run", "--data", str(root), "--no-record"]
    # Otherwise, no progress bar is written to a pipe.
    environment = {**os.environ, "FORCE_COLOR": "1"}
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        env=environment,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        errors="replace",
    )
    assert process.stderr is not None
    drawn = ""
    while not re.search(r"\d\d/", drawn):  # ten frames done
        character = process.stderr.read(1)
        assert character, f"ended too soon: {drawn}"
        drawn += character
    process.send_signal(ended_by)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 1, err
    report = json.loads((tmp_path / "runs" / "latest" / "report.json").read_text())
    assert report["interrupted"] == "Ctrl-C"
    assert 0 < report["frames"] < len(order)
    poses = read_kitti_poses(tmp_path / "runs" / "latest" / "trajectory_kitti.txt")
    assert len(poses) == report["frames"]


@pytest.mark.slow
def test_full_disk_keeps_what_was_written(kitti_tree, tmp_path, monkeypatch, capsys):
    from vslam.cli import main as cli
    from vslam.report import folder as run_folder

    def full(path, *_):
        path.write_bytes(b"half a map")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(run_folder, "save_map", full)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        sys, "argv", ["vslam", "run", "--data", str(kitti_tree), "--max-frames", "5", "--no-record"]
    )
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 1
    message = capsys.readouterr().err
    assert "No space left on device" in message
    assert "map.npz" in message
    latest = tmp_path / "runs" / "latest"
    assert not (latest / "map.npz").exists()  # not even a part of it
    assert len(read_kitti_poses(latest / "trajectory_kitti.txt")) == 5
    assert json.loads((latest / "report.json").read_text())["frames"] == 5


def test_map_round_trip(kitti_tree, tmp_path, check_map):
    outcome = run(kitti_tree)
    before, camera = outcome.map, outcome.sequence.camera
    check_map(before)
    save_map(tmp_path / "map.npz", StoredMap(before, camera))
    stored = load_map(tmp_path / "map.npz")
    after, same_camera = stored.map, stored.camera
    check_map(after)
    assert same_camera == camera
    living = before.living_keyframes()
    assert np.array_equal(after.arrays.T_cw[: after.n_keyframes], before.arrays.T_cw[living])
    landmarks = before.living_landmarks()
    assert np.array_equal(after.arrays.xyz[: after.n_landmarks], before.arrays.xyz[landmarks])
    shared = [before.covisible(int(k))[1].tolist() for k in living]
    assert [after.covisible(k)[1].tolist() for k in range(after.n_keyframes)] == shared


@pytest.mark.slow
@needs_kitti
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_kitti_06_is_tracked_through_changing_light(seed):
    outcome = run(KITTI, "06", perturb="brightness:1", seed=seed, max_frames=51)
    assert not [t.index for t in outcome.tracks if t.state == TrackingState.LOST]
    assert evaluate_trajectory(outcome.trajectory, ground_truth(outcome)).ate_rmse_m <= 0.08


@pytest.mark.slow
@needs_kitti
def test_kitti_06_is_as_good_as_orb_slam3():
    outcome = run(KITTI, "06", max_frames=51)
    evaluation = evaluate_trajectory(outcome.trajectory, ground_truth(outcome))
    assert evaluation.ate_rmse_m <= 0.07
    assert evaluation.rpe_m <= 0.015


@pytest.mark.slow
@needs_kitti
def test_kitti_00_is_as_good_as_orb_slam3():
    outcome = run(KITTI, "00", max_frames=216)
    assert not [t.index for t in outcome.tracks if t.state == TrackingState.LOST]
    evaluation = evaluate_trajectory(outcome.trajectory, ground_truth(outcome))
    assert evaluation.ate_rmse_m <= 0.40
    assert evaluation.t_rel_percent is not None
    assert evaluation.t_rel_percent <= 1.5
    alone = run(KITTI, "00", max_frames=216, threads=1)
    assert alone.trajectory.T_wc.tobytes() == outcome.trajectory.T_wc.tobytes()


def test_a_loop_closed_against_the_odometry_warns_of_the_frames_between_its_ends():
    sound, against = (
        LoopEdge(9, 2, 0.9, True, "closed", against_odometry=x) for x in (False, True)
    )
    frames = np.arange(10) * 7
    assert mistracked_warnings([sound], frames) == []
    (warning,) = mistracked_warnings([sound, against], frames)
    assert warning.startswith("Tracking went wrong between frames 14 and 63")
