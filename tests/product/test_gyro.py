"""The gyroscope turns the predicted camera before gravity is known."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from conftest import corridor_mipmaps, render
from inertial import ADIS16448, Flight, SuddenTurn, Walk, seen_by

from vslam.method.gyro import turn_by_gyro, with_turn
from vslam.slam import Slam
from vslam.types.camera import Camera
from vslam.types.features import TrackingState
from vslam.types.geometry import inverse, se3_exp
from vslam.types.imu import ImuCalibration, Inertia

CAMERA = Camera(240.0, 240.0, 239.5, 79.5, 0.0, 480, 160)
T_IMU_CAMERA = se3_exp(np.array([0.05, -0.02, 0.1, 0.2, 1.0, -1.5]))
CALIBRATION = ImuCalibration(T_IMU_CAMERA, ADIS16448)
INVERTED = ImuCalibration(inverse(T_IMU_CAMERA), ADIS16448)
BIAS = np.array([0.01, -0.02, 0.05, 0.05, -0.1, 0.08])
WALK = SuddenTurn(1)
TIMES = 0.05 * np.arange(42)
DARK = range(26, 36)  # the camera turns by 60 degrees
NO_TURN = np.eye(3)


@cache
def images() -> list[np.ndarray]:
    mipmaps = corridor_mipmaps()
    return [
        np.zeros((160, 480), np.uint8) if k in DARK else render(mipmaps, CAMERA, WALK.pose(t))
        for k, t in enumerate(TIMES)
    ]


@cache
def samples() -> np.ndarray:
    times = np.arange(-0.05, TIMES[-1] + 0.05, 0.005)
    noise = np.repeat([ADIS16448.gyro, ADIS16448.accel], 3) / np.sqrt(0.005)
    rows = seen_by(WALK.samples(times), T_IMU_CAMERA, WALK)
    rows[:, 1:] += BIAS + noise * np.random.default_rng(5).standard_normal((len(times), 6))
    return rows


@cache
def errors_of(name: str) -> tuple[float, float]:
    """Return the error of the rotation at the end of the dark and of the walk, in degrees."""
    imu = {"none": None, "sound": CALIBRATION, "inverted": INVERTED}[name]
    slam, before, errors = Slam(CAMERA, imu=imu, detector="none", threads=1), -1.0, []
    rows = samples()
    for k, t in enumerate(TIMES):
        new = rows[(rows[:, 0] > before) & (rows[:, 0] <= t)]
        before = t
        result = slam.step(images()[k], None, t, imu=None if imu is None else new)
        assert result.gravity is None  # the scale is unknown
        assert k < 10 or (result.state == TrackingState.LOST) == (k in DARK)
        true = WALK.rotation(0.0).T @ WALK.rotation(t)
        errors.append(degrees(true.T @ result.T_wc[:3, :3]))
    slam.finish()
    return errors[DARK[-1]], errors[-1]


def degrees(R: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1.0) / 2.0, -1.0, 1.0))))


def test_a_turn_in_the_dark_is_predicted_before_gravity_is_known():
    assert errors_of("sound")[0] < 1.0
    assert errors_of("none")[0] > 20.0


@pytest.mark.parametrize("name", ["sound", "inverted"])
def test_the_gyroscope_makes_nothing_worse(name):
    alone, with_imu = errors_of("none"), errors_of(name)
    assert with_imu[0] < alone[0] + 0.5
    assert with_imu[1] < alone[1] + 0.5


@cache
def started(name: str) -> tuple[int, float]:
    """Return the frame at which a map began that shows mostly a plane, and the error of the
    direction of its first motion, in degrees."""
    flight, mipmaps = Walk(3, speed=0.15, turning=0.35), corridor_mipmaps()
    imu = {"none": None, "sound": CALIBRATION, "inverted": INVERTED}[name]
    rows = seen_by(flight.samples(np.arange(-0.05, 3.0, 0.005)), T_IMU_CAMERA, flight)
    rows[:, 1:] += BIAS
    slam = Slam(CAMERA, imu=imu, detector="none", threads=1)
    for k in range(50):
        new = rows[(rows[:, 0] > 0.05 * (k - 1)) & (rows[:, 0] <= 0.05 * k)]
        result = slam.step(render(mipmaps, CAMERA, flight.pose(0.05 * k)), None, 0.05 * k, imu=new)
        if result.state == TrackingState.OK:
            break
    slam.finish()
    first, second = (0.05 * slam.map.frames[i] for i in range(2))
    moved = inverse(flight.pose(first)) @ flight.pose(second)
    T = slam.map.keyframe_pose(0) @ inverse(slam.map.keyframe_pose(1))
    cosine = T[:3, 3] @ moved[:3, 3] / np.linalg.norm(T[:3, 3]) / np.linalg.norm(moved[:3, 3])
    return k, float(np.degrees(np.arccos(cosine)))


@pytest.mark.parametrize("name", ["none", "sound"])
def test_a_map_begins_with_the_motion_from_which_a_plane_was_seen(name):
    frame, error = started(name)
    assert frame < 10
    assert error < 20.0  # the other motion is 90 degrees off


def test_a_wrong_gyroscope_begins_no_wrong_map():
    assert started("inverted")[1] < 20.0


def learned(flight, calibration, n=10) -> Inertia:
    rows = seen_by(flight.samples(np.arange(-0.1, 2.0, 0.005)), T_IMU_CAMERA, flight)
    rows[:, 1:] += BIAS
    inertia = Inertia(samples=rows)
    for k in range(n):
        turn = flight.rotation(0.05 * (k + 1)).T @ flight.rotation(0.05 * k)
        inertia = with_turn(inertia, 0.05 * k, 0.05 * (k + 1), turn, calibration)
    return inertia


@pytest.mark.parametrize("seed", range(4))
def test_ten_frames_give_the_bias_and_then_the_rotation(seed):
    flight = Flight(seed)
    inertia = learned(flight, CALIBRATION)
    assert np.linalg.norm(inertia.gyro_bias - BIAS[:3]) < 3.0 * inertia.gyro_sigma
    turn = turn_by_gyro(inertia, 0.5, 0.55, CALIBRATION)
    assert degrees(turn @ flight.rotation(0.5).T @ flight.rotation(0.55)) < 0.1


def test_it_is_not_used_before_it_is_certain_or_where_samples_are_missing():
    flight = Flight(0)
    assert turn_by_gyro(learned(flight, CALIBRATION, 1), 0.1, 0.15, CALIBRATION) is None
    inertia = learned(flight, CALIBRATION)
    assert turn_by_gyro(inertia, 0.5, 2.0, CALIBRATION) is None  # too long for this bias
    assert turn_by_gyro(inertia, 2.1, 2.15, CALIBRATION) is None


def test_turns_that_contradict_the_samples_make_it_unknown():
    assert learned(Flight(0, turning=2.0), INVERTED).gyro_sigma == -1.0


def test_before_there_are_samples_nothing_is_known():
    assert with_turn(Inertia(), 0.0, 0.1, NO_TURN, CALIBRATION).gyro_sigma == -1.0
