"""The doctor compares the IMU with rendered images; a run refuses a harmful IMU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import corridor_mipmaps, render
from inertial import ADIS16448, Flight
from scipy.spatial.transform import Rotation
from source_files import run_source

from vslam.config import Config
from vslam.datasets.frames import Source, selected, stored_frames
from vslam.datasets.imu import Imu
from vslam.doctor.imu import examine_imu, measure_alignment
from vslam.run.imu import usable_imu
from vslam.support.errors import InputError
from vslam.types.camera import Camera
from vslam.types.imu import GRAVITY, ImuCalibration

FRAMES, LATE = 50, 0.015
R_IMU_CAMERA = Rotation.from_rotvec([0.5, -1.2, 0.9]).as_matrix()
# The world of the corridor is that of its first camera: gravity points along y.
MOTION = Flight(4, speed=0.15, turning=0.08, gravity=(0.0, GRAVITY, 0.0))
FEW = Config(orb={"n_features": 700})  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def drive() -> Source:
    """A stereo camera that looks about in the corridor, and an IMU that is turned against it."""
    camera = Camera(240.0, 240.0, 239.5, 79.5, 0.5, 480, 160)
    mipmaps, times = corridor_mipmaps(), 20.0 + 0.1 * np.arange(FRAMES)
    beside = np.eye(4)
    beside[0, 3] = camera.baseline
    poses = [MOTION.pose(t) for t in times]
    images = [(render(mipmaps, camera, T), render(mipmaps, camera, T @ beside)) for T in poses]
    rows = MOTION.samples(np.arange(19.5, 25.5, 0.005), None, ADIS16448)
    for at in (slice(1, 4), slice(4, 7)):
        rows[:, at] = rows[:, at] @ R_IMU_CAMERA.T
    rows[:, 0] += LATE
    T = np.eye(4)
    T[:3, :3] = R_IMU_CAMERA
    calibration = ImuCalibration(T, ADIS16448, LATE)
    imu = Imu("imu.csv", lambda: rows, calibration, ADIS16448)
    return Source(
        dataset="test", name="corridor", camera=camera,
        stored=stored_frames(times, lambda k, image_map: images[k]), imu=imu,
    )  # fmt: skip


def with_imu(drive: Source, T=None, rows=None, offset: float = LATE, name: str = "imu.csv"):
    assert drive.imu is not None
    old = drive.imu
    calibration = replace(
        old.calibration,
        T_imu_camera=old.calibration.T_imu_camera if T is None else T,
        time_offset=offset,
    )
    read = old.read if rows is None else lambda: rows
    return replace(drive, imu=Imu(name, read, calibration, ADIS16448))


def faults(drive: Source) -> dict[str, str]:
    return {f.check: f.fix for f in examine_imu(drive, FEW) if f.verdict == "fault"}


def test_a_sound_rig_has_no_fault_in_rendered_images(drive):
    findings = {f.check: f for f in examine_imu(drive, FEW)}
    assert [f for f in findings.values() if f.verdict == "fault"] == []
    assert findings["IMU rotation"].verdict == "good"
    found = measure_alignment(drive, FEW)
    assert found is not None
    error = Rotation.from_matrix(found.R_imu_camera @ R_IMU_CAMERA.T).magnitude()
    assert np.degrees(error) < 1.0
    assert found.time_offset == pytest.approx(LATE, abs=0.003)


def test_inverted_extrinsics_and_a_wrong_offset_are_found_in_rendered_images(drive):
    inverse = np.linalg.inv(drive.imu.calibration.T_imu_camera)
    assert "use its inverse" in faults(with_imu(drive, T=inverse))["IMU rotation"]
    assert faults(with_imu(drive, offset=0.05))["IMU time"].startswith("write time_offset: 0.01")


def test_an_imu_of_unknown_place_is_measured_all_the_same(drive):
    unknown = replace(drive, imu=Imu("imu.csv", drive.imu.read))
    found = {f.check: f for f in examine_imu(unknown, FEW)}
    assert "T_imu_camera" in found["IMU calibration"].fix
    assert found["IMU rotation"].verdict == "unknown"
    assert "measured [[" in found["IMU rotation"].measured
    assert examine_imu(replace(drive, imu=None), FEW) == []


def test_a_run_takes_a_sound_imu(drive):
    assert usable_imu(drive) == (drive.imu, [])
    assert usable_imu(replace(drive, imu=None)) == (None, [])


def in_g(rows: np.ndarray) -> np.ndarray:
    rows[:, 4:] /= GRAVITY
    return rows


def doubled(rows: np.ndarray) -> np.ndarray:
    return np.repeat(rows, 2, axis=0)


def of_another_clock(rows: np.ndarray) -> np.ndarray:
    rows[:, 0] += 1e9
    return rows


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (in_g, "because of its gravity"),
        (lambda rows: rows[::20], "because of its rate"),
        (of_another_clock, "both need times of one clock"),
    ],
)
def test_a_run_refuses_a_harmful_imu_in_one_sentence(drive, change, said):
    rows = change(drive.imu.read().copy())
    imu, warnings = usable_imu(with_imu(drive, rows=rows))
    assert imu is None
    (warning,) = warnings
    assert "the IMU is not used" in warning
    assert said in warning
    assert warning.count(". ") == 0
    assert warning.endswith(".")


def test_a_run_from_python_refuses_a_harmful_imu_as_well(drive):
    outcome = run_source(
        selected(with_imu(drive, rows=in_g(drive.imu.read().copy())), max_frames=2)
    )
    assert outcome.sequence.imu is None
    assert [w for w in outcome.warnings if "because of its gravity" in w] != []
    assert len(outcome.warnings) == len(set(outcome.warnings))
    assert run_source(selected(drive, max_frames=2)).sequence.imu is drive.imu


def test_a_run_goes_on_without_an_imu_that_cannot_be_read_or_has_no_place(drive):
    def read() -> np.ndarray:
        raise InputError("imu.csv: the file is empty; restore it.")

    calibration = drive.imu.calibration
    assert usable_imu(replace(drive, imu=Imu("imu.csv", read, calibration))) == (
        None,
        ["The IMU is not used: imu.csv: the file is empty; restore it."],
    )
    imu, (warning,) = usable_imu(replace(drive, imu=Imu("imu.csv", drive.imu.read)))
    assert imu is None
    assert "add T_imu_camera" in warning


def test_repeated_samples_are_left_out_and_said(drive):
    imu, (warning,) = usable_imu(with_imu(drive, rows=doubled(drive.imu.read())))
    assert imu is not None
    assert "1200 inertial samples were at the time of another" in warning
