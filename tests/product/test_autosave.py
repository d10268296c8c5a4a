"""The autosave of a killed run can be loaded, and the run resumes at the next frame."""

from __future__ import annotations

import errno
import json
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_pipeline import vslam

from vslam.config import Config
from vslam.datasets import open_sequence
from vslam.datasets.frames import Source, stored_frames
from vslam.datasets.perturbation import parse_perturbation
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.maps.storage import load_checkpoint, load_map
from vslam.report.folder import write_results
from vslam.run import autosave as saving
from vslam.run.autosave import (
    LOCK,
    MAP,
    ONLINE,
    PROGRESS,
    FolderAutosave,
    Unfinished,
    find_unfinished,
    lock_run,
    remove_autosave,
)
from vslam.run.options import RunOptions, read_options, write_options
from vslam.run.outcome import RunOutcome, ground_truth_of
from vslam.run.pipeline import run_sequence
from vslam.run.progress import Progress, TrackLog, TrackTable, read_progress, write_progress
from vslam.run.recorder import Recorder
from vslam.run.slam_run import _with_earlier, begin
from vslam.slam import Slam
from vslam.support.errors import InputError
from vslam.types.features import TrackingState, TrackResult
from vslam.types.loops import LoopCorrection, LoopEdge
from vslam.types.trajectory import read_trajectory

FRAMES = 28

KILLED = """
import os, signal, sys, time
from pathlib import Path
from test_autosave import drive

def on_frame(result):
    if result.index == int(sys.argv[3]):
        while not (Path(sys.argv[2]) / "autosave.npz").exists():  # the disk may be slow
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGKILL)

drive(Path(sys.argv[1]), Path(sys.argv[2]), on_frame=on_frame)
"""


def drive(
    root: Path,
    folder: Path | None,
    resume: Unfinished | None = None,
    config: Config = Config(),  # noqa: B008
    law: str = "none",
    change: Callable[[Source], Source] = lambda sequence: sequence,
    compare: tuple[str, ...] = (),
    **options: object,
) -> RunOutcome:
    """Run vslam on the corridor. If a folder is given, save whenever possible."""
    sequence = change(open_sequence("kitti", root, "00"))
    settings = RunOptions(detector="bow", threads=2, thresholds=config, compare=compare)
    autosave = {} if folder is None else {"autosave": FolderAutosave(folder, 1e-6, "kitti 00")}
    begun = begin(sequence, settings, resume)
    return run_sequence(begun, parse_perturbation(law, 0), Recorder(), **autosave, **options)


@pytest.fixture(scope="module")
def undisturbed(kitti_tree):
    return drive(kitti_tree, None)


def ate(outcome: RunOutcome) -> float:
    truth = ground_truth_of(outcome.sequence)
    assert truth is not None
    return evaluate_trajectory(outcome.trajectory, truth).ate_rmse_m


@pytest.mark.slow
def test_saving_changes_no_byte(kitti_tree, tmp_path, undisturbed):
    saved = drive(kitti_tree, tmp_path)
    assert saved.trajectory.T_wc.tobytes() == undisturbed.trajectory.T_wc.tobytes()
    assert (tmp_path / MAP).is_file()
    online = read_trajectory(tmp_path / ONLINE)
    as_tracked = np.array([track.T_wc for track in saved.tracks])
    np.testing.assert_allclose(online.T_wc, as_tracked, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("frame", [9, 17, 26])
def test_a_killed_run_goes_on_at_the_next_frame(kitti_tree, tmp_path, undisturbed, frame):
    words = [sys.executable, "-c", KILLED, str(kitti_tree), str(tmp_path), str(frame)]
    here = Path(__file__).parent
    searched = os.environ | {"PYTHONPATH": str(here.parent)}
    done = subprocess.run(words, cwd=here, env=searched, timeout=300)
    assert done.returncode == -signal.SIGKILL
    assert len(read_trajectory(tmp_path / ONLINE)) == frame + 1
    unfinished = find_unfinished(tmp_path)
    n_saved = len(unfinished.progress.tracks)
    assert 1 <= n_saved <= frame + 1
    whole = drive(kitti_tree, tmp_path, unfinished)
    assert [track.index for track in whole.tracks] == list(range(FRAMES))
    assert all(track.state == TrackingState.OK for track in whole.tracks)
    assert len(whole.trajectory) == FRAMES
    assert len(read_trajectory(tmp_path / ONLINE)) == FRAMES
    before = whole.tracks[n_saved - 1].T_wc
    assert np.array_equal(before, undisturbed.tracks[n_saved - 1].T_wc)
    assert load_checkpoint(unfinished.map).checkpoint is not None
    assert whole.trajectory.T_wc.tobytes() == undisturbed.trajectory.T_wc.tobytes()


def test_an_interrupted_run_is_saved_at_its_end(kitti_tree, tmp_path):
    def interrupt(result: TrackResult) -> None:
        if result.index == 12:
            signal.raise_signal(signal.SIGINT)

    drive(kitti_tree, tmp_path, on_frame=interrupt)
    assert len(find_unfinished(tmp_path).progress.tracks) == 13


def test_ctrl_c_ends_a_run_and_a_save_is_offered_while_frames_are_dropped(kitti_tree, tmp_path):
    def interrupt(result: TrackResult) -> None:
        if result.state == TrackingState.DROPPED and result.index > 8:
            ended.append(result.index)
            signal.raise_signal(signal.SIGINT)

    ended: list[int] = []
    outcome = drive(kitti_tree, tmp_path, law="drop:60", on_frame=interrupt)
    assert outcome.interrupted == "Ctrl-C"
    assert outcome.tracks[-1].index == ended[0]
    assert len(ended) == 1
    assert len(find_unfinished(tmp_path).progress.tracks) == ended[0] + 1


def with_times(source: Source, times: np.ndarray) -> Source:
    timed = zip(source.stored[: len(times)], times.tolist(), strict=True)
    stored = tuple(replace(frame, timestamp=time) for frame, time in timed)
    return replace(source, stored=stored, ground_truth=None)


def black_until(source: Source, index: int) -> Source:
    """Return a source whose right images are black before the frame ``index``."""

    def read(k, image_map):
        left, right = source.read(k, image_map)
        return left, right * (k >= index)

    return replace(source, stored=stored_frames(source.timestamps, read))


@pytest.mark.parametrize(("moved_s", "frames", "named"), [(1e-4, FRAMES, 7), (0.0, 9, 9)])
def test_other_images_do_not_resume_a_run(kitti_tree, tmp_path, moved_s, frames, named):
    drive_until(kitti_tree, tmp_path, 12)
    times = open_sequence("kitti", kitti_tree, "00").timestamps[:frames].copy()
    times[7] += moved_s
    unfinished = find_unfinished(tmp_path)
    with pytest.raises(InputError, match=rf"frame {named} had the time .* restore them"):
        drive(kitti_tree, tmp_path, unfinished, change=lambda source: with_times(source, times))
    assert len(find_unfinished(tmp_path).progress.tracks) == 13


def test_warnings_of_the_rig_cover_both_parts(kitti_tree, tmp_path):
    def interrupt(result: TrackResult) -> None:
        if result.index == 12:
            signal.raise_signal(signal.SIGINT)

    def change(sequence):
        return black_until(sequence, 5)

    drive(kitti_tree, tmp_path, on_frame=interrupt, change=change)
    whole = drive(kitti_tree, tmp_path, find_unfinished(tmp_path), change=change)
    uninterrupted = drive(kitti_tree, None, change=change)
    (told,) = (line for line in whole.warnings if "black" in line)
    assert told in uninterrupted.warnings
    assert "The right image was black in 5 of " in told


@pytest.mark.slow
def test_a_map_is_saved_where_every_frame_becomes_a_keyframe(kitti_tree, tmp_path):
    config = Config.model_validate({"keyframes": {"max_interval_s": 0.01}})
    saved: list[int] = []

    def look(result: TrackResult) -> None:
        if (tmp_path / MAP).exists():
            # The writer may be between two files. The map must not be newer than the other file.
            frames = load_map(tmp_path / MAP).frames
            assert frames is not None
            saved.append(len(frames.timestamp))
            assert saved[-1] <= len(read_progress(tmp_path / PROGRESS).tracks)

    outcome = drive(kitti_tree, tmp_path, config=config, on_frame=look)
    assert sum(track.is_keyframe for track in outcome.tracks) > FRAMES - 3
    assert len(set(saved)) > 2
    assert saved[-1] > FRAMES - 12
    undisturbed = drive(kitti_tree, None, config=config)
    assert outcome.trajectory.T_wc.tobytes() == undisturbed.trajectory.T_wc.tobytes()


@pytest.mark.slow
def test_a_resumed_run_goes_on_without_the_detectors_compared(kitti_tree, tmp_path):
    def interrupt(result: TrackResult) -> None:
        if result.index == 12:
            signal.raise_signal(signal.SIGINT)

    drive(kitti_tree, tmp_path, compare=("none",), on_frame=interrupt)
    whole = drive(kitti_tree, tmp_path, find_unfinished(tmp_path), compare=("none",))
    assert whole.compared == ()
    assert len(whole.trajectory) == FRAMES
    report = write_results(tmp_path, whole)
    assert (report.compare, report.detectors) == (("none",), ())
    for name in ("report.md", "report.html"):
        text = (tmp_path / name).read_text()
        assert "comparison with none was left out: the run was resumed" in text


def test_half_written_files_of_killed_runs_go_with_the_rest(tmp_path):
    for name in (MAP, PROGRESS, f".{MAP}.123.part", f".{PROGRESS}.7.part", "map.npz"):
        (tmp_path / name).write_bytes(b"")
    remove_autosave(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["map.npz"]


@pytest.mark.slow
def test_images_of_another_camera_do_not_resume_a_run(kitti_tree, tmp_path):
    drive_until(kitti_tree, tmp_path, 5)
    write_options(tmp_path, RunOptions(data=str(kitti_tree), seq="00", sensor="mono"))
    done = vslam("run", "--resume", tmp_path, "--no-record", "--no-report", "--quiet", cwd=tmp_path)
    assert done.returncode == 2
    assert "camera is not that of the images" in done.stderr


def test_a_full_disk_is_told_once_and_the_run_goes_on(
    kitti_tree, tmp_path, monkeypatch, caplog, undisturbed
):
    def full(path, progress):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(saving, "write_progress", full)
    with caplog.at_level(logging.WARNING):
        outcome = drive(kitti_tree, tmp_path)
    assert outcome.trajectory.T_wc.tobytes() == undisturbed.trajectory.T_wc.tobytes()
    told = [record.message for record in caplog.records]
    reason = "cannot be written (No space left on device); the run continues without it."
    assert told == [f"{tmp_path / MAP}: {reason}"]


def some_progress() -> Progress:
    T = np.eye(4)
    T[:3, 3] = 0.1, 0.2, 0.3
    tracks = [
        TrackResult(0, 1.5, np.eye(4), TrackingState.OK, 9, 8, 7, 6, True, False, {"extract": 2.5}),
        TrackResult(1, 1.6, T, TrackingState.LOST, 5, 4, 3, 2, False, True, {"relocalise": 1.25}),
        TrackResult(
            2,
            1.7,
            T,
            TrackingState.OK,
            0,
            0,
            0,
            0,
            False,
            gravity=np.array([0.1, 9.8, 0.2]),
            imu_bias=np.arange(6.0),
            imu_bias_sigma=np.arange(6.0) / 10.0,
        ),
        TrackResult(3, 1.8, T, TrackingState.DROPPED, 0, 0, 0, 0, False),
    ]
    log = TrackLog(TrackTable())
    for track in tracks:
        log.append(track)
    early = LoopEdge(1, 0, 0.5, True, "closed", 40, 30, T)
    late = LoopEdge(2, -1, 0.25, False, "too few matches")
    correction = LoopCorrection(early, np.array([0, 1]), np.stack([T, T]), np.stack([T, T]), 0.125)
    skipped = ["frame 1: a.png: damaged", "frame 2: b.png: damaged"]
    return Progress(log.table(), skipped, [3.0], 60.5, 42.25, [early, late], [correction])


def test_progress_is_read_as_it_was_written(tmp_path):
    progress = some_progress()
    write_progress(tmp_path / PROGRESS, progress)
    read = read_progress(tmp_path / PROGRESS)
    tracks = read.tracks.results()
    for was, now in zip(progress.tracks.results(), tracks, strict=True):
        arrays = {"T_wc": now.T_wc}
        arrays |= {name: getattr(now, name) for name in ("gravity", "imu_bias", "imu_bias_sigma")}
        for name, array in arrays.items():
            assert np.array_equal(getattr(was, name), array)
        assert replace(was, **arrays) == now
    assert [track.stage_ms for track in tracks] == [{"extract": 2.5}, {"relocalise": 1.25}, {}, {}]
    assert [track.state for track in tracks] == ["OK", "LOST", "OK", "DROPPED"]
    assert (read.skipped, read.latency_ms) == (progress.skipped, progress.latency_ms)
    assert (read.wall_s, read.cpu_s) == (60.5, 42.25)
    assert [vars(loop).keys() for loop in read.loops]
    assert read.loops[1] == progress.loops[1]
    assert np.array_equal(read.loops[0].T_query_match, progress.loops[0].T_query_match)
    assert read.corrections[0].seconds == 0.125
    assert read.corrections[0].keyframes.tolist() == [0, 1]


def test_progress_until_a_frame_knows_nothing_later():
    two = some_progress().until(2)
    assert [track.index for track in two.tracks.results()] == [0, 1]
    assert [loop.query for loop in two.loops] == [1]
    assert len(two.corrections) == 1
    assert two.skipped == ["frame 1: a.png: damaged"]


def test_earlier_loops_get_keyframes_of_their_own():
    progress = some_progress()
    loops, corrections, frames = _with_earlier(progress, Slam(open_camera(), threads=1))
    assert [(frames[loop.query], frames[loop.match]) for loop in loops] == [(1, 0), (2, -1)]
    assert frames[corrections[0].edge.query] == 1
    assert frames[corrections[0].keyframes].tolist() == [0, 1]


def open_camera():
    from ring import CAMERA

    return CAMERA


@pytest.mark.parametrize("kept", [0.3, 0.9, 0.0])
def test_a_damaged_file_gets_a_sentence(tmp_path, kept):
    path = tmp_path / PROGRESS
    write_progress(path, some_progress())
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(InputError, match=r"there is nothing to resume\.$"):
        read_progress(path)


def test_options_come_back_with_absolute_paths(tmp_path, monkeypatch):
    (tmp_path / "images").mkdir()
    (tmp_path / "camera.yaml").write_text("")
    monkeypatch.chdir(tmp_path)
    options = RunOptions(data="images", calib=(Path("camera.yaml"),), seed=3, autosave=5.0)
    write_options(tmp_path, options)
    read = read_options(tmp_path)
    assert read.data == str(tmp_path / "images")
    assert read.calib == (tmp_path / "camera.yaml",)
    assert read.model_copy(update={"data": "images", "calib": options.calib}) == options


def test_where_no_lock_can_be_made_a_run_goes_on(tmp_path):
    with lock_run(tmp_path / "gone"):
        assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_command_line_resumes_what_was_interrupted(kitti_tree, tmp_path):
    brief = ("--no-record", "--no-report", "--quiet")
    words = ("--data", kitti_tree, "--max-frames", 12, "--detector", "bow")
    done = vslam("run", *words, *brief, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    folder = (tmp_path / "runs" / "latest").resolve()
    assert not (folder / MAP).exists()  # the run is complete
    refused = vslam("run", "--resume", folder, "--seed", 2, *brief, cwd=tmp_path)
    assert refused.returncode == 2
    assert refused.stderr == (
        "error: --seed: a resumed run continues with its own options; leave it out.\n"
    )
    nothing = vslam("run", "--resume", folder, *brief, cwd=tmp_path)
    assert nothing.returncode == 2
    assert "has no autosave.npz" in nothing.stderr
    # This simulates a run that was interrupted after these frames.
    drive_until(kitti_tree, folder, 11)
    write_options(folder, read_options(folder).model_copy(update={"max_frames": None}))
    with lock_run(folder):
        busy = vslam("run", "--resume", folder, *brief, cwd=tmp_path)
    assert busy.returncode == 2
    assert busy.stderr == (
        f"error: {folder}: another process is still running here; wait until it is done.\n"
    )
    (folder / LOCK).touch()  # killed
    options = read_options(folder)
    write_options(folder, options.model_copy(update={"detector": "uninstalled"}))
    unknown = vslam("run", "--resume", folder, *brief, cwd=tmp_path)
    assert unknown.returncode == 2
    assert f"--resume {folder}: detector uninstalled: unknown; choose one of none" in unknown.stderr
    write_options(folder, options)
    elsewhere = tmp_path / "elsewhere.txt"
    elsewhere.write_text("kept")
    (folder / "report.md").symlink_to(elsewhere)
    linked = vslam("run", "--resume", folder, *brief, cwd=tmp_path)
    assert linked.returncode == 2
    assert f"{folder / 'report.md'}: this is a symbolic link" in linked.stderr
    (folder / "report.md").unlink()
    shown = ("--no-record", "--no-report", "--save-map", "town.npz")
    resumed = vslam("run", "--resume", Path("runs/latest"), *shown, cwd=tmp_path)
    assert resumed.returncode == 0, resumed.stderr
    assert "continuing at frame 12 ..." in resumed.stderr
    assert f"runs/{folder.name}" in resumed.stdout
    assert "runs/latest" not in resumed.stdout  # after the next run, this is a different run
    assert elsewhere.read_text() == "kept"
    assert (tmp_path / "town.npz").read_bytes() == (folder / "map.npz").read_bytes()
    assert not (folder / LOCK).exists()
    assert len(read_trajectory(folder / "trajectory.tum")) == FRAMES
    frames = load_map(folder / "map.npz").frames
    assert frames is not None
    assert len(frames.timestamp) == FRAMES
    assert not (folder / MAP).exists()


def test_a_resumed_run_writes_to_no_place_that_its_folder_names(kitti_tree, tmp_path):
    options = {"data": str(kitti_tree), "save_map": str(tmp_path / "elsewhere.npz")}
    (tmp_path / "run.json").write_text(json.dumps(options))
    with pytest.raises(
        InputError, match=r"run\.json: damaged or from another version; start a new run"
    ):
        read_options(tmp_path)


def test_a_run_that_cannot_begin_leaves_no_folder(kitti_tree, tmp_path):
    weights = tmp_path / "weights.safetensors"
    weights.write_bytes(b"damaged")
    words = ("--detector", "capsule-pruned", "--weights", weights, "--quiet")
    done = vslam("run", "--data", kitti_tree, *words, cwd=tmp_path)
    assert done.returncode == 2
    assert str(weights) in done.stderr
    assert not (tmp_path / "runs").exists()


def drive_until(root: Path, folder: Path, frame: int) -> None:
    def interrupt(result: TrackResult) -> None:
        if result.index == frame:
            signal.raise_signal(signal.SIGINT)

    drive(root, folder, on_frame=interrupt)
