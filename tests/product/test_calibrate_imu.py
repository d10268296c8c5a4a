"""``vslam calibrate --imu`` on rendered drives whose IMU is turned and late."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import corridor_depth, corridor_mipmaps, render
from inertial import ADIS16448, EUROC, Flight
from scipy.spatial.transform import Rotation

from vslam.calibration.files import read_calibration
from vslam.calibration.models import Calibration, CameraModel
from vslam.calibration.rectification import rectify
from vslam.config import Config
from vslam.datasets.frames import Source, stored_frames
from vslam.datasets.imu import Imu
from vslam.datasets.imu_csv import HEADER
from vslam.doctor import imu_calibration
from vslam.doctor.imu_calibration import measure_imu
from vslam.run.imu_alignment import align
from vslam.types.camera import Camera
from vslam.types.geometry import se3_exp
from vslam.types.imu import GRAVITY

CAMERA = Camera(240.0, 240.0, 239.5, 79.5, 0.5, 480, 160)
R_IMU_CAMERA = Rotation.from_rotvec([0.5, -1.2, 0.9]).as_matrix()
LATE = 0.015
ABOUT_ALL_AXES = Flight(4, speed=0.15, turning=0.25, gravity=(0.0, GRAVITY, 0.0))


class Yaw(Flight):
    """Turns about the vertical axis only."""

    def _sines(self, t, order: int, which: int) -> np.ndarray:
        return super()._sines(t, order, which) * ((1, 1, 1) if which == 0 else (0, 1, 0))


def write_drive(folder: Path, motion: Flight, frames: int) -> None:
    """Write left, right and depth images at 20 Hz, and the samples of an IMU that is turned and
    whose clock is late."""
    mipmaps, times = corridor_mipmaps(), 20.0 + 0.05 * np.arange(frames)
    beside = np.eye(4)
    beside[0, 3] = CAMERA.baseline
    for name in ("left", "right", "depth"):
        (folder / name).mkdir(parents=True)
    for t in times:
        T, name = motion.pose(t), f"{round(t * 1e9)}.png"
        depth = np.rint(1000.0 * corridor_depth(CAMERA, T)).clip(0, 65535).astype(np.uint16)
        cv2.imwrite(str(folder / "left" / name), render(mipmaps, CAMERA, T))
        cv2.imwrite(str(folder / "right" / name), render(mipmaps, CAMERA, T @ beside))
        cv2.imwrite(str(folder / "depth" / name), depth)
    bias = np.array([0.01, -0.02, 0.015, 0.05, 0.1, -0.05])
    rows = motion.samples(np.arange(19.5, times[-1] + 0.5, 0.005), bias, ADIS16448)
    for at in (slice(1, 4), slice(4, 7)):
        rows[:, at] = rows[:, at] @ R_IMU_CAMERA.T
    rows[:, 0] += LATE
    np.savetxt(folder / "imu.csv", rows, "%.17g", ",", header=HEADER, comments="")


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    write_drive(folder, ABOUT_ALL_AXES, 100)
    return folder


def rig(sensor: str = "stereo", **more) -> Path:
    """Write a calibration into the current folder."""
    one = {"size": [480, 160], "focal": [240.0, 240.0], "centre": [239.5, 79.5]}
    pair = {"right": one, "baseline": CAMERA.baseline}
    extra = {"stereo": pair, "rgbd": {"depth_scale": 1000.0}, "mono": {}}[sensor]
    path = Path("rig.yaml")
    path.write_text(json.dumps({"left": one, **extra, **more}))
    return path


def words(drive: Path, sensor: str = "stereo") -> list[object]:
    second = {"stereo": ["--right", drive / "right"], "rgbd": ["--depth", drive / "depth"]}
    more = second.get(sensor, ["--sensor", "mono"])
    return ["calibrate", drive / "left", "--imu", "--calib", "rig.yaml", *more]


def turn(R: np.ndarray) -> float:
    return float(np.degrees(Rotation.from_matrix(R @ R_IMU_CAMERA.T).magnitude()))


@pytest.mark.parametrize(
    ("sensor", "degrees", "seconds"),
    [("stereo", 0.1, 5e-4), ("rgbd", 1.0, 3e-3), ("mono", 1.0, 3e-3)],
)
def test_rotation_and_offset_are_measured_and_written(call, drive, sensor, degrees, seconds):
    """The images are small, and a stereo pair is tracked with more points than the others."""
    path = rig(sensor)
    given, before = read_calibration([path]), path.read_text()
    code, out, err = call(*words(drive, sensor))
    assert code == 0, err
    found = read_calibration([path])
    assert found.imu is not None
    assert turn(found.imu.T_imu_camera[:3, :3]) < degrees
    assert found.imu.time_offset == pytest.approx(LATE, abs=seconds)
    assert (found.left, found.right) == (given.left, given.right)
    assert found.depth_scale == given.depth_scale
    np.testing.assert_array_equal(found.T_left_right, given.T_left_right)
    assert Path("rig-1.yaml").read_text() == before
    assert "rig.yaml: new T_imu_camera and time_offset." in out
    assert "The translation is 0" in out
    assert "old" not in out

    code, out, _ = call(*words(drive, sensor))
    assert code == 0
    assert "agrees with the measurement, so nothing is written" in out
    assert "new:" not in out
    assert not Path("rig-2.yaml").exists()


def test_the_rotation_is_that_of_the_left_camera_before_rectification(monkeypatch):
    one = CameraModel(240.0, 240.0, 239.5, 79.5, 480, 160)
    T_left_right = se3_exp(np.array([0.5, 0.0, 0.0, 0.08, 0.0, 0.0]))
    calibration = Calibration(one, one, T_left_right)
    rectification = rectify(calibration)
    R = rectification.R_left_rectified
    assert Rotation.from_matrix(R).magnitude() == pytest.approx(0.04)

    times, noise = 20.0 + 0.05 * np.arange(120), np.random.default_rng(0)
    rotations = np.array([ABOUT_ALL_AXES.rotation(t) for t in times]) @ R
    rotations = rotations @ Rotation.from_rotvec(noise.normal(0, 1e-4, (120, 3))).as_matrix()
    samples = ABOUT_ALL_AXES.samples(np.arange(19.5, 26.5, 0.005), None, ADIS16448)
    samples[:, 1:4] = samples[:, 1:4] @ R_IMU_CAMERA.T
    source = Source(
        dataset="test", name="drive", camera=rectification.camera,
        stored=stored_frames(times, lambda k, image_map: (np.zeros((160, 480), np.uint8), None)),
        imu=Imu("imu.csv", lambda: samples), calibration=calibration,
    )  # fmt: skip
    found = align(times, rotations, samples)
    monkeypatch.setattr(imu_calibration, "measure_alignment", lambda *_: found)
    imu = measure_imu(source, Config()).new.imu
    assert imu is not None
    assert turn(imu.T_imu_camera[:3, :3]) < 0.2
    assert found is not None
    assert turn(found.R_imu_camera) > 2.0


def test_what_contradicts_is_replaced_and_both_are_shown(call, drive):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R_IMU_CAMERA, (0.1, 0.0, -0.05)
    inverse = np.linalg.inv(T)
    path = rig(imu={"T_imu_camera": inverse.tolist(), "time_offset": LATE + 0.001})
    code, out, err = call(*words(drive))
    assert code == 0, err
    found = read_calibration([path]).imu
    assert found is not None
    np.testing.assert_allclose(found.T_imu_camera, T, atol=1e-12)
    assert found.time_offset == LATE + 0.001  # agrees, and may be more accurate than measured
    assert "rig.yaml: new T_imu_camera.\n" in out
    assert f"old: T_imu_camera {np.round(inverse, 5).tolist()}" in out
    assert f"new: T_imu_camera {np.round(T, 5).tolist()}" in out
    assert "translation" not in out

    T[:3, :3] = Rotation.from_rotvec([0.0, 0.2, 0.0]).as_matrix() @ T[:3, :3]
    path = rig(imu={"T_imu_camera": T.tolist(), "time_offset": 0.0})
    code, out, err = call(*words(drive), "--out", "new.yaml")
    assert code == 0, err
    found = read_calibration(["new.yaml"]).imu
    assert found is not None
    assert turn(found.T_imu_camera[:3, :3]) < 0.4
    np.testing.assert_array_equal(found.T_imu_camera[:3, 3], T[:3, 3])
    assert found.time_offset == pytest.approx(LATE, abs=1e-3)
    assert "old: time_offset +0.00 ms\n" in out


def test_the_doctor_finds_faults_of_the_imu_of_one_camera(call, drive):
    T = np.eye(4)
    T[:3, :3] = R_IMU_CAMERA.T
    rig("mono", imu={"T_imu_camera": T.tolist(), "time_offset": LATE})
    mono = ["doctor", drive / "left", "--sensor", "mono", "--calib", "rig.yaml"]
    code, out, _ = call(*mono)
    assert code == 1
    (fault,) = (line for line in out.splitlines() if line.startswith("fault") and "IMU" in line)
    assert fault.split()[1:3] == ["IMU", "rotation"]
    assert "use its inverse" in out
    rig("mono", imu={"T_imu_camera": T.T.tolist(), "time_offset": LATE})
    lines = call(*mono)[1].splitlines()
    assert [line for line in lines if line.startswith("fault") and "IMU" in line] == []
    assert any(line.split()[:3] == ["good", "IMU", "rotation"] for line in lines)


def refused(call, *words: object) -> str:
    code, _, err = call(*words)
    assert code == 2
    return " ".join(err.split())


def test_a_camera_that_turns_about_one_axis_is_refused(call, tmp_path):
    write_drive(tmp_path / "drive", Yaw(4, 0.15, 0.25, (0.0, GRAVITY, 0.0)), 60)
    path = rig()
    before = path.read_text()
    said = refused(call, *words(tmp_path / "drive"))
    assert "about one axis only" in said
    assert "turn it quickly about all axes" in said
    assert path.read_text() == before


def test_samples_and_options_that_cannot_be_used_are_refused(call, drive, tmp_path):
    rig()
    assert "an IMU is calibrated without a board" in refused(
        call, *words(drive), "--board", "checkerboard"
    )
    assert "--calib: only with --imu" in refused(
        call, "calibrate", drive / "left", "--board", "checkerboard", "--calib", "rig.yaml"
    )
    assert "--board is missing" in refused(call, "calibrate", drive / "left")
    assert "record a drive" in refused(call, "calibrate", "--imu", "--dataset", "realsense")
    other = tmp_path / "other"
    shutil.copytree(drive / "left", other)
    mono = ["calibrate", other, "--imu", "--sensor", "mono", "--calib", "rig.yaml"]
    assert "there is no IMU" in refused(call, *mono)
    rows = np.loadtxt(drive / "imu.csv", delimiter=",", skiprows=1)
    np.savetxt(other / "imu.csv", rows[::20], "%.17g", ",", header=HEADER, comments="")
    assert "10 samples per second; record at least 50" in refused(call, *mono)
    rows[:, 3] *= -1.0
    np.savetxt(other / "imu.csv", rows, "%.17g", ",", header=HEADER, comments="")
    assert "left-handed" in refused(call, *mono)


@pytest.mark.skipif(not EUROC.is_dir(), reason="EuRoC is not here")
def test_a_drone_that_stands_still_is_refused(call):
    said = refused(call, "calibrate", EUROC / "V1_01_start", "--imu")
    assert "turn" in said
    assert list(Path().iterdir()) == []
