"""vslam as a library: paths may be strings, and impossible cameras and images are rejected."""

from __future__ import annotations

import json
import traceback
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from parts import CAMERA

from vslam.calibration.files import read_calibration
from vslam.calibration.models import Calibration, CameraModel
from vslam.calibration.rectification import rectify
from vslam.config import Config, load_config
from vslam.datasets import open_sequence
from vslam.datasets.image_folders import open_images
from vslam.datasets.kitti import list_kitti
from vslam.evaluation.trajectories import read_pair
from vslam.maps.formats import save_ply
from vslam.maps.storage import load_map, made_with, map_file_of
from vslam.report.finished_run import read_run
from vslam.slam import Slam
from vslam.support.errors import InputError
from vslam.types.camera import check_images
from vslam.types.trajectory import (
    Trajectory,
    read_kitti_poses,
    read_trajectory,
    trajectory_format,
    write_euroc,
    write_kitti,
    write_tum,
)


def test_a_map_is_saved_and_loaded_by_a_string(tmp_path):
    file = str(tmp_path / "map.npz")
    Slam(CAMERA, detector="none", threads=1).save(file)
    assert load_map(file).camera == made_with(file)[0] == CAMERA
    assert Slam.load(file, threads=1).context.camera == CAMERA
    assert map_file_of(str(tmp_path)) == Path(file)


def test_a_map_is_saved_into_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Slam(CAMERA, detector="none", threads=1).save("map.npz")
    assert load_map("map.npz").camera == CAMERA


def test_a_map_that_cannot_be_saved_is_named_by_its_own_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    slam = Slam(CAMERA, detector="none", threads=1)
    with pytest.raises(FileNotFoundError, match=r"there is no folder nodir: 'nodir/map\.npz'$"):
        slam.save("nodir/map.npz")
    (tmp_path / "taken").mkdir()
    with pytest.raises(IsADirectoryError, match=r"Is a directory: 'taken'$"):
        slam.save("taken")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_trajectories_are_written_and_read_by_strings(tmp_path):
    kitti, tum, euroc = (str(tmp_path / name) for name in ("kitti.txt", "tum.txt", "euroc.csv"))
    drive = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    write_kitti(kitti, drive.T_wc)
    write_tum(tum, drive)
    write_euroc(euroc, drive)
    assert (trajectory_format(kitti), trajectory_format(tum)) == ("kitti", "tum")
    assert len(read_kitti_poses(kitti)) == len(read_trajectory(tum)) == 3
    assert len(Path(euroc).read_text().splitlines()) == 4
    assert [len(one) for one in read_pair(kitti, kitti)] == [3, 3]


def test_data_and_settings_are_read_by_strings(tmp_path, kitti_tree):
    root = str(kitti_tree)
    name, n, _ = list_kitti(root)[0]
    assert len(open_sequence("kitti", root, name)) == n
    left, right = (str(kitti_tree / "sequences" / name / f"image_{k}") for k in (0, 1))
    assert len(open_images(left, right, fps=10.0).timestamps) == n
    config = tmp_path / "config.json"
    config.write_text("{}")
    assert load_config(str(config)) == Config()
    config.write_text('{"tracking.method": "patches", "tracking": {"min_inliers": 40}}')
    found = load_config(config).tracking
    assert (found.method, found.min_inliers) == ("patches", 40)
    calib = tmp_path / "one.yaml"
    calib.write_text("left: {lens: pinhole, size: [640, 240], focal: [9, 9], centre: [320, 120]}")
    assert read_calibration([str(calib)]).left.width == 640
    save_ply(str(tmp_path / "map.ply"), np.zeros((1, 3)))
    assert (tmp_path / "map.ply").stat().st_size


def test_a_map_is_continued_with_the_thresholds_that_it_was_made_with(tmp_path):
    file = tmp_path / "map.npz"
    Slam(CAMERA, {"orb.n_features": 900}, "none", threads=1).save(file)
    again = Slam.load(file, threads=1)
    assert again.context.config.orb.n_features == 900
    assert Slam.load(file, {}, threads=1).context.config == Config()
    again.save(file)
    assert made_with(file).thresholds == {"orb.n_features": 900}
    write_header(file, thresholds={"orb.retired": 3})
    with pytest.raises(InputError, match=r"map.npz: orb.retired: unknown key"):
        Slam.load(file)
    assert Slam.load(file, Config(), threads=1).context.config == Config()
    write_header(file, thresholds=5)
    with pytest.raises(InputError, match="the map is damaged"):
        Slam.load(file)


def test_thresholds_are_given_as_a_dictionary():
    config = {"orb": {"n_features": 900}, "tracking.method": "patches"}
    found = Slam(CAMERA, config, "none", threads=1).context.config
    assert (found.orb.n_features, found.tracking.method) == (900, "patches")


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({"orb": {"n_feature": 9}}, r"orb.n_feature: unknown key \(did you mean n_features\?\); "),
        ({"orb": {"n_features": 9}}, "orb.n_features: must be at least 100.$"),
        ({"orb.n_features": 900, "orb": 5}, "orb must map names to values"),
        ({1: 900}, "1: unknown key; correct or remove it."),
        ("config.json", "there is no preset 'config.json'; the presets are: fast."),
        (["orb"], "the configuration must map names to values"),
    ],
)
def test_wrong_thresholds_are_refused_in_one_sentence(config, words):
    with pytest.raises(InputError, match=f"^config: {words}") as refused:
        Slam(CAMERA, config, "none", threads=1)
    assert "pydantic" not in "".join(traceback.format_exception(refused.value))


@pytest.mark.parametrize("dataset", ["kitti", "euroc", "tum"])
def test_a_folder_without_data_is_refused_by_its_string(tmp_path, dataset):
    with pytest.raises(InputError, match=str(tmp_path)):
        open_sequence(dataset, str(tmp_path))


def test_a_folder_that_is_no_run_is_refused_by_its_string(tmp_path):
    with pytest.raises(InputError, match=str(tmp_path)):
        read_run(str(tmp_path))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"cx": 6000.0}, r"principal point \(6000.0, 120.0\) lies far outside the 640x240 image"),
        ({"cy": float("nan")}, "principal point"),
        ({"baseline": -0.5}, "baseline of -0.5 m must not be negative"),
        ({"fx": 0.0}, "focal lengths .* must be positive"),
        ({"fy": -400.0}, "focal lengths"),
        ({"width": 0}, "size 0x240 must be positive"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        replace(CAMERA, **wrong)


def test_a_principal_point_beside_the_image_is_a_camera():
    assert replace(CAMERA, cx=-10.0, cy=250.0).cx == -10.0


def test_a_calibration_of_a_camera_that_cannot_be_is_named():
    model = CameraModel(400.0, 400.0, 6000.0, 120.0, 640, 240)
    with pytest.raises(InputError, match=r"^mine.yaml: the principal point .* far outside"):
        rectify(Calibration(model, source="mine.yaml"))


def write_header(file: Path, **entries: object) -> None:
    """Replace entries in the header of a map file."""
    with np.load(file) as saved:
        arrays = dict(saved)
    header = json.loads(arrays["header"].tobytes()) | entries
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(file, **arrays)


def test_the_camera_of_a_map_file_is_checked(tmp_path):
    file = tmp_path / "map.npz"
    Slam(CAMERA, detector="none", threads=1).save(file)
    write_header(file, camera=asdict(CAMERA) | {"cx": 6000.0})
    with pytest.raises(InputError, match=r"map.npz: .*principal point \(6000.0, 120.0\)"):
        load_map(file)


def test_images_in_colour_are_refused_with_the_way_to_grey():
    colour = np.zeros((240, 640, 3), np.uint8)
    with pytest.raises(ValueError, match=r"colour.*cv2\.cvtColor\(image, cv2\.COLOR_BGR2GRAY\)"):
        check_images(colour, colour, CAMERA)
    with pytest.raises(ValueError, match="colour"):
        check_images(colour, None, CAMERA.left_camera())


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint16])
def test_images_of_another_type_are_refused_with_their_conversion(dtype):
    image = np.zeros((CAMERA.height, CAMERA.width), dtype)
    with pytest.raises(ValueError, match=r"instead of uint8; .*of 0 to 1 with \(255 \* image\)"):
        check_images(image, None, CAMERA.left_camera())


def test_images_that_are_missing_or_too_many_are_named():
    grey = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    with pytest.raises(ValueError, match="the left image is None; was its file read"):
        check_images(None, None, CAMERA)
    with pytest.raises(ValueError, match="the right image is None, but the camera is stereo"):
        check_images(grey, None, CAMERA)
    with pytest.raises(ValueError, match="the depth image is None, but the camera is rgbd"):
        check_images(grey, None, replace(CAMERA, depth=True))
    with pytest.raises(ValueError, match="the camera is monocular: pass None"):
        check_images(grey, grey, CAMERA.left_camera())
