from __future__ import annotations

import errno
import re
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from test_report import CAMERA, make_outcome

from vslam.maps.storage import load_map
from vslam.maps.stored_map import StoredMap
from vslam.report import explorer, figures, folder, render
from vslam.report.folder import Results, create_run_folder, write_results, write_trajectories
from vslam.support.errors import InputError, ResultsError
from vslam.types.camera import Camera
from vslam.types.map import Map
from vslam.types.trajectory import Trajectory, read_kitti_poses, read_trajectory


def test_name_and_latest(tmp_path):
    folder = create_run_folder(
        tmp_path / "a/runs", "kitti", "00", "brightness:1.5,blur:0.5", "none"
    )
    assert re.fullmatch(r"\d{8}-\d{6}-kitti-00-brightness1\.5\+blur0\.5-none", folder.name)
    assert folder.is_dir()
    assert (tmp_path / "a/runs/latest").resolve() == folder


def test_two_runs_in_one_second_have_two_folders(tmp_path):
    folders = {create_run_folder(tmp_path, "kitti", "00", "none", "none") for _ in range(3)}
    assert len(folders) == 3


def test_names_stay_inside_the_folder(tmp_path):
    folder = create_run_folder(tmp_path, "kitti", "../../x y", "none", "none")
    assert folder.parent == tmp_path
    assert folder.name.endswith("-kitti-.._.._x_y-none-none")


def test_a_real_folder_called_latest_is_left_alone(tmp_path):
    (tmp_path / "latest").mkdir()
    assert create_run_folder(tmp_path, "kitti", "00", "none", "none").is_dir()
    assert not (tmp_path / "latest").is_symlink()


def test_unwritable_place(tmp_path):
    (tmp_path / "runs").write_text("a file, not a folder")
    with pytest.raises(InputError, match=r"cannot create a run folder .* --out"):
        create_run_folder(tmp_path / "runs", "kitti", "00", "none", "none")


@dataclass
class _Sequence:
    timestamps: np.ndarray = field(default_factory=lambda: 0.1 * np.arange(5))
    ground_truth: np.ndarray | None = None
    camera: Camera = CAMERA
    world: str = ""


def test_ground_truth_of_just_the_frames_done(tmp_path):
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = np.arange(5)
    sequence = _Sequence(ground_truth=poses)
    done = np.array([0, 1, 3])  # frame 2 was unreadable, the run ended before frame 4
    trajectory = Trajectory(sequence.timestamps[done], poses[done])
    outcome = replace(make_outcome(5), sequence=sequence, trajectory=trajectory)
    matched = outcome.ground_truth
    np.testing.assert_array_equal(matched.timestamps, outcome.trajectory.timestamps)
    write_trajectories(Results(tmp_path), outcome)
    for name in ("trajectory_kitti.txt", "ground_truth_kitti.txt"):
        np.testing.assert_array_equal(read_kitti_poses(tmp_path / name)[:, 2, 3], done)
    np.testing.assert_allclose(
        read_trajectory(tmp_path / "trajectory.tum").timestamps, [0, 0.1, 0.3]
    )


def test_ground_truth_of_some_frames_keeps_their_times(tmp_path):
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = np.arange(5)
    known = poses.copy()
    known[[0, 3]] = np.nan
    sequence = _Sequence(ground_truth=known)
    trajectory = Trajectory(sequence.timestamps, poses)
    outcome = replace(make_outcome(5), sequence=sequence, trajectory=trajectory)
    write_trajectories(Results(tmp_path), outcome)
    assert not (tmp_path / "ground_truth_kitti.txt").exists()
    truth = read_trajectory(tmp_path / "ground_truth.tum")
    np.testing.assert_allclose(truth.timestamps, [0.1, 0.2, 0.4])
    np.testing.assert_allclose(truth.T_wc[:, 2, 3], [1.0, 2.0, 4.0])


def test_no_ground_truth(tmp_path):
    sequence = _Sequence()
    trajectory = Trajectory(sequence.timestamps, np.tile(np.eye(4), (5, 1, 1)))
    outcome = replace(make_outcome(5), sequence=sequence, trajectory=trajectory)
    assert outcome.ground_truth is None
    write_trajectories(Results(tmp_path), outcome)
    assert not (tmp_path / "ground_truth_kitti.txt").exists()


@pytest.mark.parametrize("saved", [False, True])
def test_on_a_full_disk_all_is_tried_and_nothing_is_incomplete(tmp_path, monkeypatch, saved):
    def half_written(path, T_wc):
        path.write_text("1 0 0")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(folder, "write_kitti", half_written)
    for name in ("autosave.npz", "run.json") if saved else ():
        (tmp_path / name).touch()
    names = r"trajectory_kitti\.txt, ground_truth_kitti\.txt could not be written \(No space left"
    remedy = f"then vslam run --resume {tmp_path}" if saved else "give another folder with --out"
    with pytest.raises(ResultsError, match=f"{names}.*{remedy}"):
        write_results(tmp_path, make_outcome(20), pages=False)
    there = {path.name for path in tmp_path.iterdir()}
    assert there >= {"trajectory.tum", "keyframes.tum", "frames.csv", "config.json", "report.json"}
    assert not there & {"trajectory_kitti.txt", "ground_truth_kitti.txt"}


PARTS = {  # what fails: where it is looked up, the name of the result that it costs
    "write_kitti": (folder, "trajectory_kitti.txt, ground_truth_kitti.txt"),
    "causal_trajectory": (folder, "trajectory_causal.tum"),
    "evaluate_run": (folder, "the evaluation"),
    "save_map": (folder, "map.npz"),
    "write_frames": (folder, "frames.csv"),
    "summarize": (folder, "report.json"),
    "draw_figures": (figures, "figures"),
    "markdown": (render, "report.md"),
    "explorer_data": (explorer, "report.html"),
}
ALL = {
    "trajectory_kitti.txt", "trajectory.tum", "ground_truth_kitti.txt", "trajectory_causal.tum",
    "keyframes.tum", "trajectory_odom.tum", "covariance.csv", "map.npz", "frames.csv",
    "config.json", "report.json", "figures", "report.md", "report.html",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", PARTS)
def test_a_result_that_fails_costs_itself_alone(tmp_path, monkeypatch, name):
    """An error in the figures once prevented the map from being saved."""

    def fails(*args):
        raise KeyError("a fault\nof vslam")

    module, cost = PARTS[name]
    monkeypatch.setattr(module, name, fails)
    outcome = make_outcome(20)
    stored = StoredMap(Map(1.2 ** np.arange(8)), outcome.sequence.camera)
    outcome = replace(outcome, stored=stored)
    with pytest.raises(ResultsError) as error:
        write_results(tmp_path, outcome)
    says = str(error.value)
    assert says.startswith(f"{tmp_path}: {cost} failed (KeyError: 'a fault")
    assert says.endswith(
        "all other results were written; this is a fault of vslam, please report it."
    )
    assert "\n" not in says
    lost = {"report.md", "report.html", "figures"} if name == "summarize" else set()
    assert {path.name for path in tmp_path.iterdir()} == ALL - set(cost.split(", ")) - lost
    if "map.npz" in cost:
        return
    assert load_map(tmp_path / "map.npz").map.n_keyframes == 0
