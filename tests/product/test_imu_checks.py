"""Faults that are planted in simulated inertial drives are named; sound drives are not blamed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from inertial import ADIS16448, EUROC, Flight, recording
from scipy.spatial.transform import Rotation

from vslam.run.imu_alignment import align
from vslam.run.imu_checks import Check, check_alignment, check_samples
from vslam.types.imu import ImuCalibration

DEGREE = np.pi / 180.0
CAMERA_NOISE = 5e-4  # radians a frame, of visual odometry


class Drive:
    """Ten seconds of a hand-held camera at 20 Hz with EuRoC's IMU at 200 Hz."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([7, seed])
        flight = Flight(seed, speed=0.7, turning=0.35)
        bias = np.concatenate([rng.normal(0, 0.02, 3), rng.normal(0, 0.1, 3)])
        stamps = np.arange(0.0, 10.0, 0.005)
        self.samples = flight.samples(stamps, bias, ADIS16448, seed)
        self.times = 0.5 + 0.05 * np.arange(180)
        self.R_imu_camera = Rotation.random(random_state=seed).as_matrix()
        noise = Rotation.from_rotvec(rng.normal(0, CAMERA_NOISE, (180, 3))).as_matrix()
        poses = np.array([flight.rotation(t) for t in self.times])
        self.rotations = poses @ self.R_imu_camera @ noise

    @property
    def calibration(self) -> ImuCalibration:
        T = np.eye(4)
        T[:3, :3] = self.R_imu_camera
        return ImuCalibration(T, ADIS16448)

    def checks(self) -> list[Check]:
        found = align(self.times, self.rotations, self.samples)
        return [*check_samples(self.samples, ADIS16448), *check_alignment(found, self.R_imu_camera)]


@pytest.fixture
def planted_faults(monkeypatch):
    """The script that counts planted faults on rendered drives."""
    folder = Path(__file__).parents[2] / "tools" / "experiments" / "inertial"
    monkeypatch.syspath_prepend(str(folder))
    import planted_faults

    return planted_faults


def test_planted_faults_are_named(planted_faults):
    missed = []
    for seed in range(5):
        drive = Drive(seed)
        for name, fault in planted_faults.FAULTS.items():
            rig = fault.plant(planted_faults.Rig(drive.samples, drive.calibration))
            checks = planted_faults.checks_of(rig, drive.times, drive.rotations)
            missed += [] if planted_faults.is_found(fault, checks) else [(seed, name)]
    assert len(planted_faults.FAULTS) == 10
    assert missed == []


def test_a_simulated_imu_agrees_with_its_calibration(planted_faults):
    rig = planted_faults.simulated("room+seed:3", 5)
    route = planted_faults.route_named(*planted_faults.parse_drive("room+seed:3"))
    times, rotations = route.timestamps[:120], route.T_wc[:120, :3, :3]
    checks = planted_faults.checks_of(rig, times, rotations)
    assert [check for check in checks if check.wrong] == []


def test_sound_drives_have_no_fault():
    blamed = {}
    for seed in range(100, 150):
        wrong = [check for check in Drive(seed).checks() if check.wrong]
        if wrong:
            blamed[seed] = wrong
    assert blamed == {}


def test_an_alignment_is_as_accurate_as_it_says():
    errors = []
    for seed in range(20):
        drive = Drive(seed)
        drive.samples[:, 0] += 0.02
        found = align(drive.times, drive.rotations, drive.samples)
        assert found is not None
        turn = Rotation.from_matrix(found.R_imu_camera @ drive.R_imu_camera.T).magnitude()
        errors.append([turn / DEGREE, 1e3 * abs(found.time_offset - 0.02)])
        assert found.scale == pytest.approx(1.0, abs=0.01)
    degrees, ms = np.median(errors, axis=0)
    assert degrees < 0.2
    assert ms < 0.5


@pytest.mark.parametrize("end", [0, 1])
def test_samples_may_begin_and_end_with_the_frames(end):
    drive = Drive(1)
    since = drive.samples[:, 0] - drive.times[-end]
    samples = drive.samples[since <= 0.0 if end else since >= 0.0]
    found = align(drive.times, drive.rotations, samples)
    assert found is not None
    assert found.time_offset == pytest.approx(0.0, abs=1e-3)


def test_nothing_is_said_about_a_camera_that_does_not_turn():
    drive = Drive(0)
    still = np.repeat(np.eye(3)[None], len(drive.times), axis=0)
    assert align(drive.times, still, drive.samples) is None
    lost = np.full_like(drive.rotations, np.nan)
    assert align(drive.times, lost, drive.samples) is None
    (check,) = check_alignment(None, drive.R_imu_camera)
    assert check.wrong is None


def test_frames_that_were_lost_or_mistracked_do_not_matter():
    drive = Drive(3)
    drive.rotations[40:50] = np.nan
    drive.rotations[90:] = Rotation.from_rotvec([0, 0.3, 0]).as_matrix() @ drive.rotations[90:]
    drive.rotations[120] = np.eye(3)
    assert [check for check in drive.checks() if check.wrong] == []


def test_noise_is_compared_at_rest():
    flight = Flight(1, speed=0.0, turning=0.0)
    rows = flight.samples(np.arange(0.0, 5.0, 0.005), None, ADIS16448)
    quiet = {check.name: check for check in check_samples(rows, ADIS16448)}
    assert quiet["IMU noise"].wrong is False
    assert quiet["gravity"].measured.startswith("9.8")
    stated = replace(ADIS16448, accel=ADIS16448.accel / 30)
    noisy = {check.name: check for check in check_samples(rows, stated)}
    assert noisy["IMU noise"].wrong
    assert noisy["IMU noise"].fix == "write accelerometer_noise_density: 0.0021"


@pytest.mark.skipif(not EUROC.is_dir(), reason="EuRoC is not here")
@pytest.mark.parametrize("name", ["V1_01", "V1_03"])
def test_real_drives_are_sound_and_their_inverse_is_found(name):
    """With the true rotations at 20 Hz, for a camera that is turned against the IMU."""
    drive = recording(name)
    assert [check for check in check_samples(drive.samples, ADIS16448) if check.wrong] == []
    times = 40.0 + 0.05 * np.arange(100)
    R_imu_camera = Rotation.from_rotvec([0.3, -1.0, 1.2]).as_matrix()
    rotations = np.array([drive.pose(t)[:3, :3] for t in times]) @ R_imu_camera
    found = align(times, rotations, drive.samples)
    assert found is not None
    assert [check for check in check_alignment(found, R_imu_camera) if check.wrong] == []
    wrong = [check for check in check_alignment(found, R_imu_camera.T) if check.wrong]
    assert [check.name for check in wrong] == ["IMU rotation"]
    assert "use its inverse" in wrong[0].fix
    truth = np.median(drive.bias[np.abs(drive.times - 42.5) < 2.5], axis=0)
    np.testing.assert_allclose(found.bias, truth[:3], atol=5e-3)
