"""A walk with an IMU: through the dark, without samples, with late ones, and after a checkpoint."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from conftest import corridor_mipmaps, render
from inertial import ADIS16448, DOWN, Flight, Walk, seen_by
from typer.testing import CliRunner

from vslam.backend.inertial_start import PoseStretch, find_gravity
from vslam.cli.main import every_command
from vslam.maps.storage import load_map
from vslam.method.inertia import (
    IMU_REFUSED,
    KEPT_S,
    gravity_direction,
    is_refused,
    is_stuck,
    lost,
    moves,
    predicted_state,
    tracked,
    with_samples,
)
from vslam.slam import Slam
from vslam.types.camera import Camera
from vslam.types.features import TrackingState
from vslam.types.geometry import inverse, se3_exp, se3_log
from vslam.types.imu import GRAVITY, ImuCalibration, Inertia, InertialState

CAMERA = Camera(240.0, 240.0, 239.5, 79.5, 0.3, 480, 160)
T_IMU_CAMERA = se3_exp(np.array([0.05, -0.02, 0.1, 0.2, 1.0, -1.5]))
CALIBRATION = ImuCalibration(T_IMU_CAMERA, ADIS16448)
BIAS = np.array([0.01, -0.02, 0.05, 0.05, -0.1, 0.08])
WALK = Walk(1)
LAST = 60
TIMES = 0.05 * np.arange(LAST)
DARK = range(30, 50)  # 1 s
TRUTH = [inverse(WALK.pose(0.0)) @ WALK.pose(t) for t in TIMES]


@cache
def images() -> list[tuple[np.ndarray, np.ndarray]]:
    mipmaps, T_left_right = corridor_mipmaps(), np.eye(4)
    T_left_right[0, 3] = CAMERA.baseline
    poses = [WALK.pose(t) for t in TIMES]
    return [(render(mipmaps, CAMERA, T), render(mipmaps, CAMERA, T @ T_left_right)) for T in poses]


@cache
def samples() -> np.ndarray:
    times = np.arange(-0.05, TIMES[-1] + 0.05, 0.005)
    rows = seen_by(WALK.samples(times), T_IMU_CAMERA, WALK)
    rng = np.random.default_rng(5)
    noise = np.repeat([ADIS16448.gyro, ADIS16448.accel], 3) / np.sqrt(0.005)
    rows[:, 1:] += BIAS + noise * rng.standard_normal((len(times), 6))
    return rows


def walk(slam, imu, *, dark=(), first=0, last=LAST) -> list:
    """Track the walk. ``imu`` are the samples that are passed, or None."""
    results = []
    for k in range(first, last):
        left, right = images()[k]
        if k in dark:
            left, right = np.zeros_like(left), np.zeros_like(right)
        rows = None
        if imu is not None:
            after = TIMES[k - 1] if k > first else -1.0 if first == 0 else TIMES[first - 1]
            rows = imu[(imu[:, 0] > after) & (imu[:, 0] <= TIMES[k])]
        results.append(slam.step(left, right, TIMES[k], imu=rows))
    return results


def slam_with(calibration=CALIBRATION, **options) -> Slam:
    return Slam(CAMERA, imu=calibration, detector="none", threads=1, **options)


def error(result) -> tuple[float, float]:
    """Return the error of a pose at the time of tracking, in metres and degrees."""
    apart = se3_log(inverse(TRUTH[result.index]) @ result.T_wc)
    return float(np.linalg.norm(apart[:3])), float(np.degrees(np.linalg.norm(apart[3:])))


def test_the_imu_carries_the_camera_through_a_second_of_darkness():
    carried, alone = slam_with(), slam_with(None)
    results, without = walk(carried, samples(), dark=DARK), walk(alone, None, dark=DARK)
    states = [result.state for result in results]
    assert {states[k] for k in DARK} == {TrackingState.INERTIAL}
    assert {without[k].state for k in DARK} == {TrackingState.LOST}
    assert all(states[k] == TrackingState.OK for k in range(len(TIMES)) if k not in DARK)

    metres, degrees = error(results[DARK[-1]])
    metres_without, degrees_without = error(without[DARK[-1]])
    assert metres < 0.06
    assert degrees < 0.1
    assert metres < 0.5 * metres_without
    assert degrees < 0.1 * degrees_without

    for slam in (carried, alone):
        slam.finish()
    assert carried.gaps() == []
    there = carried.trajectory().T_wc[DARK]
    apart = np.linalg.norm(there[:, :3, 3] - [TRUTH[k][:3, 3] for k in DARK], axis=1)
    assert apart.max() < 0.06  # the trajectory keeps what the IMU measured


def test_in_turns_the_walk_after_the_dark_is_not_lost():
    """A hand that sways and turns: without an IMU, what comes after the dark is metres off."""
    turning = Walk(3, speed=0.15, turning=0.35)
    mipmaps, right_of_left = corridor_mipmaps(), np.eye(4)
    right_of_left[0, 3] = CAMERA.baseline
    rows = seen_by(turning.samples(np.arange(-0.05, 4.6, 0.005)), T_IMU_CAMERA, turning)
    rows[:, 1:] += BIAS
    start, ends = inverse(turning.pose(0.0)), {}
    carried, alone = slam_with(), slam_with(None)
    for k in range(88):
        t, dark = 0.05 * k, 40 <= k < 80
        T = turning.pose(t)
        left = np.zeros((160, 480), np.uint8) if dark else render(mipmaps, CAMERA, T)
        right = left if dark else render(mipmaps, CAMERA, T @ right_of_left)
        new = rows[(rows[:, 0] > t - 0.05) & (rows[:, 0] <= t)]
        for name, result in (
            ("carried", carried.step(left, right, t, imu=new)),
            ("alone", alone.step(left, right, t)),
        ):
            apart = se3_log(inverse(start @ T) @ result.T_wc)
            ends[name] = float(np.linalg.norm(apart[:3])), float(np.linalg.norm(apart[3:]))
            if name == "carried" and dark:
                assert result.state == TrackingState.INERTIAL
                assert ends[name][0] < 0.1
                assert ends[name][1] < np.radians(0.2)
    assert ends["carried"][0] < 0.05
    assert ends["alone"][0] > 0.5


def test_one_frame_in_the_light_corrects_what_the_dark_has_spoilt():
    """The samples of a second of darkness are wrong by 0.2 m/s^2. One frame then shows it."""
    rows = samples().copy()
    rows[(rows[:, 0] > TIMES[20]) & (rows[:, 0] < TIMES[40]), 4] += 0.2
    results = walk(slam_with(), rows, dark=[*range(20, 40), *range(41, LAST)])
    assert results[40].state == TrackingState.OK
    first, second = (
        inverse(inverse(TRUTH[a]) @ TRUTH[b]) @ inverse(results[a].T_wc) @ results[b].T_wc
        for a, b in ((19, 39), (40, 58))
    )
    assert np.linalg.norm(first[:3, 3]) > 0.08
    assert np.linalg.norm(second[:3, 3]) < 0.05  # 0.17 m if the velocity stays wrong


def test_a_slow_camera_gets_gravity_from_more_than_a_second():
    slam = slam_with()
    rows = samples()
    for k in range(0, LAST, 7):  # 2.9 frames a second
        new = rows[(rows[:, 0] > TIMES[k] - 0.35) & (rows[:, 0] <= TIMES[k])]
        result = slam.step(*images()[k], TIMES[k], imu=new)
    assert result.gravity is not None


@pytest.mark.parametrize("step", [0.4, 0.7])
def test_a_fast_and_slow_camera_agrees_with_its_imu(step):
    """A car that is seen every few metres: the errors of its poses grow with the distance."""
    car, rng = Walk(6, along=8.5), np.random.default_rng(2)
    rows = car.samples(np.arange(-0.05, 9 * step, 0.005), BIAS, ADIS16448)
    calibration = ImuCalibration(np.eye(4), ADIS16448)
    inertia, before, T = Inertia(), -1.0, np.eye(4)
    for k in range(9):
        t = k * step
        inertia = with_samples(inertia, rows[(rows[:, 0] > before) & (rows[:, 0] <= t + 1e-6)])
        if k:
            moved = inverse(car.pose(t - step)) @ car.pose(t)
            wrong = rng.normal(0.0, [0.005 * 8.5 * step] * 3 + [0.0007] * 3)
            wrong[0] += 0.2 * (k == 1)  # nothing predicted the second frame
            T = T @ moved @ se3_exp(wrong)
        predicted = predicted_state(inertia, t, calibration)
        covariance = np.diag([0.01**2] * 3 + [0.0005**2] * 3)
        inertia = tracked(inertia, predicted, t, T, covariance, calibration, stands_still=False)
        before = t + 1e-6
    assert inertia.disagreements == 0
    assert inertia.state is not None


def test_one_wrong_pose_of_a_slow_camera_does_not_refuse_the_imu():
    """At two frames a second, one wrong pose is part of several starts."""
    sound = Walk(6)
    rows = sound.samples(np.arange(-0.05, 9.0, 0.005), BIAS, ADIS16448)
    calibration = ImuCalibration(np.eye(4), ADIS16448)
    inertia = Inertia()
    for k in range(18):
        t = 0.5 * k
        new = (rows[:, 0] > t - 0.5) & (rows[:, 0] <= t)
        inertia = with_samples(inertia, rows[new])
        T = inverse(sound.pose(0.0)) @ sound.pose(t)
        T[0, 3] += 0.5 * (k == 3)
        predicted = predicted_state(inertia, t, calibration)
        covariance = np.diag([0.003**2] * 3 + [0.0005**2] * 3)
        inertia = tracked(inertia, predicted, t, T, covariance, calibration, stands_still=False)
    assert not is_refused(inertia)
    assert inertia.state is not None


def test_the_uncertainty_grows_in_the_dark_and_is_that_of_the_error():
    results = walk(slam_with(), samples(), dark=DARK)
    sizes = [np.trace(results[k].uncertainty.local[:3, :3]) for k in (DARK[0], DARK[-1])]
    assert sizes[1] > 10.0 * sizes[0]
    end = results[DARK[-1]]
    apart = se3_log(inverse(end.T_wc) @ TRUTH[end.index])  # exp(-xi) in the frame of the camera
    assert apart @ np.linalg.solve(end.uncertainty.local, apart) < 22.5  # 0.001 of 6 degrees


def test_gravity_is_known_after_half_a_second_and_the_world_is_not_turned():
    results = walk(slam_with(), samples())
    known = [result for result in results if result.gravity is not None]
    assert known[0].timestamp <= 0.8
    down = WALK.rotation(0.0).T @ np.array([0.0, GRAVITY, 0.0])
    for result in known:
        cosine = result.gravity @ down / GRAVITY**2
        assert np.degrees(np.arccos(min(cosine, 1.0))) < 1.5
    assert np.array_equal(results[0].T_wc, np.eye(4))
    assert max(error(result)[0] for result in results) < 0.02


def test_an_imu_is_never_worse_in_the_light():
    with_imu, without = slam_with(), slam_with(None)
    one, other = walk(with_imu, samples()), walk(without, None)
    assert error(one[-1])[0] < error(other[-1])[0] + 0.002


def test_poses_by_images_and_samples_shake_less_than_by_images():
    """After the start, the errors of the motion from frame to frame are compared."""

    def shaking(results) -> np.ndarray:
        pairs = [results[k - 1 : k + 1] for k in range(20, LAST)]
        apart = [
            se3_log(inverse(TRUTH[b.index]) @ TRUTH[a.index] @ inverse(a.T_wc) @ b.T_wc)
            for a, b in pairs
        ]
        return np.sqrt(np.mean(np.square(apart).reshape(-1, 2, 3).sum(axis=2), axis=0))

    with_imu, alone = shaking(walk(slam_with(), samples())), shaking(walk(slam_with(None), None))
    assert (with_imu < 0.9 * alone).all()


def test_samples_without_a_calibration_change_nothing():
    one, other = slam_with(None), slam_with(None)
    walk(one, samples(), last=20)
    walk(other, None, last=20)
    assert one.trajectory().T_wc.tobytes() == other.trajectory().T_wc.tobytes()


def test_late_and_repeated_samples_give_the_same_bytes_and_missing_ones_do_no_harm():
    rng, rows = np.random.default_rng(0), samples()
    sound, mixed, holed = slam_with(), slam_with(), slam_with()
    walk(sound, rows, dark=DARK)
    after = -1.0
    for k, t in enumerate(TIMES):
        left, right = images()[k]
        new = rows[(rows[:, 0] > after) & (rows[:, 0] <= t)]
        after = t
        mixed.add_imu(rng.permutation(np.concatenate([new, new[:3]])))
        light = np.uint8(k not in DARK)
        mixed.step(light * left, light * right, t)
    assert mixed.trajectory().T_wc.tobytes() == sound.trajectory().T_wc.tobytes()

    hole = (rows[:, 0] > 1.6) & (rows[:, 0] < 1.9)  # in the dark
    results = walk(holed, rows[~hole], dark=DARK)
    assert TrackingState.LOST in {results[k].state for k in DARK}
    assert results[-1].state == TrackingState.OK
    assert error(results[-1])[0] < 0.03


def test_a_mount_that_contradicts_the_images_is_refused_in_one_sentence():
    inverted = ImuCalibration(inverse(T_IMU_CAMERA), ADIS16448)
    slam = slam_with(inverted)
    results = walk(slam, samples())
    assert slam.problems == [IMU_REFUSED]
    assert results[-1].gravity is None
    assert max(error(result)[0] for result in results) < 0.02
    assert slam_with().problems == []


@pytest.mark.parametrize("least", [22, 36])  # in the light, and in the dark
def test_a_resumed_walk_gives_the_same_bytes(tmp_path, least):
    whole, first, at = slam_with(), slam_with(), least
    walk(whole, samples(), dark=DARK)
    walk(first, samples(), dark=DARK, last=at)
    while first.stored_map().checkpoint is None:  # a keyframe is being mapped
        walk(first, samples(), dark=DARK, first=at, last=at + 1)
        at += 1
    first.save(tmp_path / "map.npz", resumable=True)
    second = Slam.load(tmp_path / "map.npz", resume=True, threads=1, imu=CALIBRATION)
    walk(second, samples(), dark=DARK, first=at)
    for slam in (whole, second):
        slam.finish()
    assert second.trajectory().T_wc.tobytes() == whole.trajectory().T_wc.tobytes()


def test_the_map_keeps_gravity_and_exports_can_be_level(tmp_path):
    slam = slam_with()
    results = walk(slam, samples())
    slam.finish()
    down = TRUTH[0][:3, :3] @ WALK.pose(0.0)[:3, :3].T @ WALK.gravity
    assert np.linalg.norm(slam.gravity) == pytest.approx(GRAVITY)
    assert slam.gravity @ down / GRAVITY**2 > np.cos(np.radians(1.0))  # its bias is unknown
    assert np.array_equal(results[0].T_wc, np.eye(4))

    slam.save(tmp_path / "map.npz")
    stored = load_map(tmp_path / "map.npz")
    sigma = stored.map.keyframes.gravity_sigma
    assert (sigma[stored.map.timestamps > 1.0] > 0.0).all()
    assert (sigma[stored.map.timestamps < 0.5] == 0.0).all()
    command = ["export", "ply", str(tmp_path / "map.npz"), "--no-colours", "--out"]
    for name, words in (("map.ply", []), ("level.ply", ["--level"])):
        done = CliRunner().invoke(every_command(), [*command, str(tmp_path / name), *words])
        assert done.exit_code == 0, done.output
    before, level = (points_of(tmp_path / name) for name in ("map.ply", "level.ply"))
    np.testing.assert_allclose(level[:, 2], -before @ slam.gravity / GRAVITY, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(level, axis=1), np.linalg.norm(before, axis=1), 1e-4)


def points_of(path) -> np.ndarray:
    data = path.read_bytes()
    return np.frombuffer(data[data.index(b"end_header\n") + 11 :], "<f4").reshape(-1, 3)


def test_gravity_is_as_certain_as_it_says():
    """Over seeds, errors of the direction along an axis have the standard deviation given."""
    errors = []
    for seed in range(8):
        flight, rng = Flight(seed, speed=0.4, turning=0.4), np.random.default_rng(seed)
        times = np.arange(0.0, 1.01, 0.05)
        bias = np.concatenate([rng.normal(0.0, 0.02, 3), rng.normal(0.0, 0.1, 3)])
        rows = flight.samples(np.arange(-0.02, 1.05, 0.005), bias, ADIS16448, seed)
        poses = np.array([flight.pose(t) for t in times])
        noise = np.array([se3_exp(rng.normal(0.0, [0.002] * 3 + [0.0005] * 3)) for _ in times])
        stretch = PoseStretch(times, poses @ noise, 0.002, 0.0005)
        calibration = ImuCalibration(np.eye(4), ADIS16448)
        found = find_gravity(stretch, rows, calibration, known_scale=True)
        one = gravity_direction(found.state, calibration)
        true = poses[-1, :3, :3].T @ DOWN / GRAVITY
        errors.append(np.linalg.norm(np.cross(one.direction, true)) / one.sigma / np.sqrt(2.0))
        assert np.linalg.norm(one.direction) == pytest.approx(1.0)
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) < 2.0


def test_a_gyroscope_that_is_stuck_is_known():
    rows = samples()[:40].copy()
    assert not is_stuck(rows)
    rows[30:, 2] = 0.0  # one axis
    assert is_stuck(rows)
    assert not is_stuck(rows[:39])


def test_old_samples_are_forgotten():
    inertia = Inertia()
    for start in range(20):
        rows = np.zeros((200, 7))
        rows[:, 0] = start + 0.005 * np.arange(200)
        inertia = with_samples(inertia, rows)
    assert len(inertia.samples) < 200 * (KEPT_S + 0.25)
    assert inertia.samples[-1, 0] == pytest.approx(19.995)


@cache
def unseen() -> list[tuple[np.ndarray, np.ndarray]]:
    """The images after the dark, in a corridor with other textures."""
    mipmaps, T_left_right = corridor_mipmaps(8), np.eye(4)
    T_left_right[0, 3] = CAMERA.baseline
    poses = [WALK.pose(t) for t in TIMES[DARK.stop :]]
    return [(render(mipmaps, CAMERA, T), render(mipmaps, CAMERA, T @ T_left_right)) for T in poses]


@pytest.mark.parametrize("imu", [CALIBRATION, None])
def test_what_is_seen_first_after_the_dark_joins_the_map_only_with_an_imu(imu):
    slam = slam_with(imu)
    walk(slam, None if imu is None else samples(), dark=DARK, last=DARK.stop)
    results = []
    for k, (left, right) in enumerate(unseen(), DARK.stop):
        rows = samples()[(samples()[:, 0] > TIMES[k - 1]) & (samples()[:, 0] <= TIMES[k])]
        results.append(slam.step(left, right, TIMES[k], imu=None if imu is None else rows))
    slam.finish()
    assert results[-1].state == TrackingState.OK
    if imu is None:
        assert len(slam.gaps()) == 1
        assert not slam.in_map()[-1]
        return
    assert slam.gaps() == []
    assert slam.in_map()[-1]
    assert results[-1].part == 0
    assert error(results[-1])[0] < 0.1


@pytest.mark.parametrize("speed", [0.0, 0.2])
def test_a_slow_flight_is_known_to_move(speed):
    """0.2 m/s are 0.2 px a frame for a camera 20 m above the ground."""
    state = InertialState(
        0.0, np.eye(4), np.array([speed, 0.0, 0.0]), DOWN, np.zeros(6), 0.02**2 * np.eye(18)
    )
    assert moves(state) == (speed > 0.0)
    assert not moves(None)


@pytest.mark.parametrize("acceleration", [0.0, 0.5])
def test_a_camera_that_stood_is_held_in_the_dark_until_its_samples_move_it(acceleration):
    rest, calibration = Flight(3, speed=0.0, turning=0.0), ImuCalibration(np.eye(4), ADIS16448)
    rows = rest.samples(np.arange(-0.1, 3.0, 0.005), BIAS, ADIS16448)
    moving = rows[:, 0] > 1.0
    rows[moving, 4:] += rest.rotation(0.0).T @ [acceleration, 0.0, 0.0]
    times, pose = np.arange(0.0, 0.95, 0.05), rest.pose(0.0)
    stretch = PoseStretch(times, np.tile(pose, (len(times), 1, 1)), 0.002, 0.0005)
    found = find_gravity(stretch, rows, calibration, known_scale=True)
    inertia = Inertia(samples=rows, state=found.state)
    for t in np.arange(0.95, 2.01, 0.05):
        predicted = predicted_state(inertia, t, calibration)
        inertia = lost(inertia, predicted, 0.05, stood_still=True)
    moved = np.linalg.norm(inertia.state.T_world_imu[:3, 3] - pose[:3, 3])
    assert moved == pytest.approx(0.5 * acceleration, abs=0.03)
    assert (inertia.carried_s == 0.0) == (acceleration == 0.0)
