"""One camera with an IMU: its map becomes metric, and the IMU carries it through the dark."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import corridor_mipmaps, render
from inertial import ADIS16448, EUROC, Walk, seen_by

from vslam.backend.metric_mapping import scale_of_map
from vslam.datasets.euroc import open_euroc
from vslam.datasets.imu import ImuFeed
from vslam.method.inertia import SCALE_LOST, SCALE_UNKNOWN, without_scale
from vslam.slam import Slam
from vslam.types.camera import Camera
from vslam.types.features import TrackingState
from vslam.types.geometry import inverse, se3_exp, se3_log, transform
from vslam.types.imu import ImuCalibration

CAMERA = Camera(240.0, 240.0, 239.5, 79.5, 0.0, 480, 160)
CALIBRATION = ImuCalibration(se3_exp(np.array([0.05, -0.02, 0.1, 0.2, 1.0, -1.5])), ADIS16448)
BIAS = np.array([0.01, -0.02, 0.05, 0.05, -0.1, 0.08])
FLIGHT = Walk(4, speed=0.8, turning=0.4, along=0.3)
TIMES = 0.05 * np.arange(164)
DARK = range(140, 160)  # 1 s
SAVED = 100  # the drive is saved at this frame or soon afterwards
TRUTH = np.array([inverse(FLIGHT.pose(0.0)) @ FLIGHT.pose(t) for t in TIMES])


def samples() -> np.ndarray:
    times = np.arange(-0.05, TIMES[-1] + 0.05, 0.005)
    rows = seen_by(FLIGHT.samples(times), CALIBRATION.T_imu_camera, FLIGHT)
    noise = np.repeat([ADIS16448.gyro, ADIS16448.accel], 3) / np.sqrt(0.005)
    rows[:, 1:] += BIAS + noise * np.random.default_rng(5).standard_normal((len(times), 6))
    return rows


def images() -> list[np.ndarray]:
    mipmaps = corridor_mipmaps()
    return [
        np.zeros((160, 480), np.uint8) if k in DARK else render(mipmaps, CAMERA, FLIGHT.pose(t))
        for k, t in enumerate(TIMES)
    ]


def scale_of(T_wc: np.ndarray, T_true: np.ndarray) -> float:
    """Return metres per unit of poses whose world frame is that of the truth (Umeyama, 1991)."""
    p, q = (T[:, :3, 3] - T[:, :3, 3].mean(axis=0) for T in (T_wc, T_true))
    return float(np.linalg.svd(q.T @ p)[1].sum() / np.sum(p**2))


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> SimpleNamespace:
    slam = Slam(CAMERA, imu=CALIBRATION, detector="none", threads=1)
    file = tmp_path_factory.mktemp("map") / "map.npz"
    found = SimpleNamespace(slam=slam, results=[], rows=samples(), images=images(), file=file)
    before = -1.0
    for k, t in enumerate(TIMES):
        new = found.rows[(found.rows[:, 0] > before) & (found.rows[:, 0] <= t)]
        before = t
        found.results.append(slam.step(found.images[k], None, t, imu=new))
        if slam.is_mapping:
            continue
        if slam.metric_since is not None and not hasattr(found, "at_start"):
            found.at_start = slam.trajectory().T_wc
        if k >= SAVED and not file.exists():
            slam.save(file, resumable=True)
            found.saved = k
    slam.finish()
    return found


def test_the_map_becomes_metric_when_the_motion_tells_its_scale(drive):
    results, since = drive.results, drive.slam.metric_since
    first = next(k for k, one in enumerate(results) if one.state == TrackingState.OK)
    assert since - TIMES[first] < 3.0
    assert all((one.gravity is not None) == (one.timestamp > since) for one in results)
    n = len(drive.at_start)
    assert scale_of(drive.at_start[first:], TRUTH[first:n]) == pytest.approx(1.0, abs=0.02)
    T_wc = drive.slam.trajectory().T_wc
    light = slice(first, DARK.start)
    assert scale_of(T_wc[light], TRUTH[light]) == pytest.approx(1.0, abs=0.01)
    assert SCALE_UNKNOWN not in drive.slam.problems


def test_features_are_matched_until_the_scale_is_known_and_patches_afterwards(drive):
    results, since = drive.results, drive.slam.metric_since
    before = [one for one in results if one.timestamp <= since and one.state == TrackingState.OK]
    after = [one for one in results[: DARK.start] if one.timestamp > since]
    assert len(before) > 10
    assert all(one.n_features for one in before)
    assert np.mean([one.n_features == 0 for one in after]) > 0.5


def test_the_scale_does_not_depend_on_the_guess_and_its_error_is_known(drive):
    session, map_ = drive.slam._session, drive.slam.map
    inertial = session._motion.inertial_window()
    R_wc = drive.results[-1].T_wc[:3, :3]
    found = [
        scale_of_map(map_, 0, drive.slam.context, inertial, R_wc, start) for start in (0.8, 1.2)
    ]
    assert all(one is not None and 5e-4 < one.sigma < 0.02 for one in found)
    assert found[0].scale == pytest.approx(found[1].scale, rel=1e-3)
    assert abs(np.log(found[0].scale)) < 3.0 * found[0].sigma


def test_poses_at_the_time_of_tracking_and_odometry_are_metric_too(drive):
    for poses in (
        np.array([one.T_wc for one in drive.results]),
        np.array([one.T_odom_camera for one in drive.results]),
    ):
        late = slice(80, DARK.start)
        assert scale_of(poses[late], TRUTH[late]) == pytest.approx(1.0, abs=0.02)


def test_landmarks_keyframes_and_observations_still_fit(drive):
    map_ = drive.slam.map
    arrays, errors = map_.arrays, []
    for keyframe in map_.living_keyframes().tolist():
        rows = map_.rows(keyframe)
        seen = arrays.landmark[rows] >= 0
        xyz = arrays.xyz[arrays.landmark[rows][seen]]
        uv = CAMERA.project(transform(map_.keyframe_pose(keyframe), xyz))[:, :2]
        errors.append(np.linalg.norm(uv - arrays.xy[rows][seen], axis=1))
    assert np.median(np.concatenate(errors)) < 1.0


def test_the_imu_carries_one_camera_through_a_second_of_darkness(drive):
    results = drive.results
    assert {results[k].state for k in DARK} == {TrackingState.INERTIAL}
    before, end = results[DARK.start - 1], results[DARK[-1]]
    true = inverse(TRUTH[before.index]) @ TRUTH[end.index]
    apart = se3_log(inverse(true) @ inverse(before.T_wc) @ end.T_wc)
    assert np.linalg.norm(apart[:3]) < 0.1
    assert np.degrees(np.linalg.norm(apart[3:])) < 0.2
    assert drive.slam.gaps() == []


def test_a_drive_that_is_continued_from_a_file_keeps_its_scale_to_the_byte(drive):
    slam = Slam.load(drive.file, resume=True, threads=1, imu=CALIBRATION)
    assert slam.metric_since is not None
    assert slam.map.scalars.metric
    rows = drive.rows
    for k in range(drive.saved + 1, drive.saved + 11):
        new = rows[(rows[:, 0] > TIMES[k - 1]) & (rows[:, 0] <= TIMES[k])]
        result = slam.step(drive.images[k], None, TIMES[k], imu=new)
        assert result.T_wc.tobytes() == drive.results[k].T_wc.tobytes()


def test_a_sub_map_whose_scale_is_unknown_is_said(drive):
    slam = Slam.load(drive.file, resume=True, threads=1, imu=CALIBRATION)
    assert slam.problems == []
    motion = slam._session._motion
    motion.state = replace(motion.state, inertia=without_scale(motion.state.inertia))
    assert slam.problems == [SCALE_LOST]


def test_an_unseen_scene_after_the_dark_is_metric_and_belongs_to_the_same_map(drive):
    slam = Slam.load(drive.file, resume=True, threads=1, imu=CALIBRATION)
    other, rows, dark, results = corridor_mipmaps(seed=8), drive.rows, range(112, 132), []
    for k in range(drive.saved + 1, len(TIMES)):
        image = drive.images[k] if k < dark.start else np.zeros((160, 480), np.uint8)
        if k >= dark.stop:
            image = render(other, CAMERA, FLIGHT.pose(TIMES[k]))
        new = rows[(rows[:, 0] > TIMES[k - 1]) & (rows[:, 0] <= TIMES[k])]
        results.append(slam.step(image, None, TIMES[k], imu=new))
    slam.finish()
    assert TrackingState.LOST not in {one.state for one in results}
    assert results[-1].state == TrackingState.OK
    assert len(slam.map.restarts) == 1
    assert slam.gaps() == []
    assert slam.metric_since == drive.slam.metric_since
    T_wc = slam.trajectory().T_wc
    apart = (
        inverse(inverse(TRUTH[dark.start - 1]) @ TRUTH[-1])
        @ inverse(T_wc[dark.start - 1])
        @ T_wc[-1]
    )
    assert np.linalg.norm(apart[:3, 3]) < 0.1
    assert scale_of(T_wc[dark.stop + 6 :], TRUTH[dark.stop + 6 :]) == pytest.approx(1.0, abs=0.03)


def test_an_even_motion_tells_no_scale_and_a_sentence_says_so():
    steady = Walk(1, speed=0.0, turning=0.0)
    mipmaps = corridor_mipmaps()
    rows = steady.samples(np.arange(-0.05, 2.5, 0.005), BIAS, ADIS16448)
    slam, before = Slam(CAMERA, imu=CALIBRATION, detector="none", threads=1), -1.0
    for t in 0.1 * np.arange(25):
        new = rows[(rows[:, 0] > before) & (rows[:, 0] <= t)]
        before = t
        slam.step(render(mipmaps, CAMERA, steady.pose(t)), None, t, imu=new)
    slam.finish()
    assert slam.map.n_keyframes > 3
    assert slam.metric_since is None
    assert slam.problems == [SCALE_UNKNOWN]


@pytest.mark.skipif(not EUROC.is_dir(), reason="EuRoC's data absent")
def test_the_left_camera_of_the_real_vehicle_at_rest_gets_no_scale():
    sequence = open_euroc(EUROC / "V1_01_start", "", max_frames=40)
    assert sequence.imu is not None
    feed, camera = ImuFeed(sequence.imu), sequence.camera.left_camera()
    slam = Slam(camera, detector="none", threads=1, imu=sequence.imu.calibration)
    for frame in sequence.frames():
        left, _ = frame.read(map)
        slam.step(left, None, frame.timestamp, imu=feed.until(frame.timestamp))
    slam.finish()
    assert slam.metric_since is None
