"""The start of an IMU and its filter: exact motions, noise as modelled, and flights of EuRoC."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from inertial import ADIS16448, DOWN, EUROC, Flight, recording

from vslam.backend.inertial_filter import (
    MOTION,
    VIBRATION,
    anchored,
    camera_covariance,
    camera_pose,
    corrected_by_pose,
    corrected_by_rest,
    drifted,
    in_another_world,
    noise_in_motion,
    propagated,
)
from vslam.backend.inertial_start import GravityState, PoseStretch, find_gravity, find_gyro_bias
from vslam.backend.preintegration import so3_log
from vslam.types.geometry import inverse, se3_exp, se3_log
from vslam.types.imu import GRAVITY, ImuCalibration

T_IMU_CAMERA = se3_exp(np.array([0.05, -0.02, 0.1, 0.2, 1.0, -1.5]))
CALIBRATION = ImuCalibration(T_IMU_CAMERA, ADIS16448)
BIAS = np.array([0.01, -0.02, 0.05, 0.05, -0.1, 0.08])


def stretch_of(flight, start, seconds, sigma=(0.0, 0.0), seed=0, scale=1.0, step=0.05):
    """Return poses of the camera in a world frame that is not level."""
    rng, times = np.random.default_rng(seed), np.arange(start, start + seconds + 1e-9, step)
    poses = []
    for t in times:
        noise = np.r_[sigma[0] * rng.standard_normal(3), sigma[1] * rng.standard_normal(3)]
        poses.append(flight.pose(t) @ T_IMU_CAMERA @ se3_exp(noise))
    poses = np.array(poses)
    poses[:, :3, 3] /= scale
    return PoseStretch(times, poses, max(sigma[0], 1e-4) / scale, max(sigma[1], 1e-5))


def samples_of(flight, bias=BIAS, noise=None, seed=0) -> np.ndarray:
    return flight.samples(np.arange(-0.1, 6.0, 0.005), bias, noise, seed)


def degrees_between(a, b) -> float:
    cosine = a @ b / (np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


@pytest.mark.parametrize("seed", range(3))
def test_exact_poses_give_the_bias_of_the_gyroscope(seed):
    flight = Flight(seed)
    found = find_gyro_bias(stretch_of(flight, 0.2, 0.5), samples_of(flight), CALIBRATION)
    assert found is not None
    assert np.abs(found.bias - BIAS[:3]).max() < 1e-4
    assert found.misfit < 1.0


def test_the_covariance_of_the_bias_is_that_of_repeated_noise():
    flight, errors = Flight(1), []
    for seed in range(100):
        stretch = stretch_of(flight, 0.2, 0.5, (0.003, 0.001), seed)
        found = find_gyro_bias(stretch, samples_of(flight, noise=ADIS16448, seed=seed), CALIBRATION)
        errors.append(
            (found.bias - BIAS[:3]) @ np.linalg.solve(found.covariance, found.bias - BIAS[:3])
        )
    assert np.mean(errors) == pytest.approx(3.0, rel=0.35)


@pytest.mark.parametrize(
    "gravity", [DOWN, np.array([0.0, GRAVITY, 0.0]), np.array([6.0, 5.0, 5.9])]
)
def test_gravity_is_found_in_any_world_frame(gravity):
    """Also in vslam's: y points down at the first camera, which may be tilted."""
    gravity = gravity * (GRAVITY / np.linalg.norm(gravity))
    flight = Flight(2, gravity=tuple(gravity))
    bias = np.r_[BIAS[:3], np.zeros(3)]
    found = find_gravity(
        stretch_of(flight, 0.2, 1.0), samples_of(flight, bias), CALIBRATION, known_scale=True
    )
    assert found.doubt == ""
    assert found.scale == 1.0
    assert degrees_between(found.state.gravity, gravity) < 0.1
    assert np.linalg.norm(found.state.gravity) == pytest.approx(GRAVITY)
    t = found.state.timestamp
    assert np.linalg.norm(found.state.velocity - flight.velocity(t)) < 0.005
    assert np.abs(se3_log(inverse(flight.pose(t)) @ found.state.T_world_imu)).max() < 1e-3


def test_at_rest_gravity_is_found_without_any_motion():
    flight = Flight(3, speed=0.0, turning=0.0)
    found = find_gravity(
        stretch_of(flight, 0.2, 0.5, (0.002, 0.0005)),
        samples_of(flight, np.zeros(6), ADIS16448),
        CALIBRATION,
        known_scale=True,
    )
    assert found.doubt == ""
    assert np.linalg.norm(found.state.velocity) < 0.05
    assert degrees_between(found.state.gravity, DOWN) < 1.0


def test_one_camera_gets_its_scale_when_the_motion_tells_it():
    flight = Flight(4, speed=3.0)
    samples = samples_of(flight, noise=ADIS16448)
    stretch = stretch_of(flight, 0.2, 3.0, (0.002, 0.0003), scale=2.5)
    found = find_gravity(stretch, samples, CALIBRATION, known_scale=False)
    assert found.doubt == ""
    assert found.scale == pytest.approx(2.5, rel=0.04)
    assert np.linalg.norm(found.state.velocity - flight.velocity(3.2)) < 0.15


def test_the_noise_of_poses_does_not_make_the_scale_too_small():
    """In slow motion, noise of the poses is a large part of what least squares sees."""
    errors, squares = [], []
    for seed in range(40):
        flight = Flight(seed, speed=0.3, turning=0.3)
        stretch = stretch_of(flight, 0.2, 2.0, (0.004, 0.0005), seed, scale=2.5)
        samples = samples_of(flight, noise=ADIS16448, seed=seed)
        found = find_gravity(stretch, samples, CALIBRATION, known_scale=False)
        errors.append(np.log(found.scale / 2.5))
        squares.append((errors[-1] / found.scale_sigma) ** 2)
    assert abs(np.mean(errors)) < 0.015
    assert 0.4 < np.mean(squares) < 1.5


def test_without_motion_one_camera_has_no_scale_and_no_error():
    flight = Flight(3, speed=0.0, turning=0.0)
    found = find_gravity(
        stretch_of(flight, 0.2, 1.0, (0.002, 0.0005)), samples_of(flight), CALIBRATION,
        known_scale=False,
    )  # fmt: skip
    assert "scale" in found.doubt


def test_a_camera_that_is_mounted_the_other_way_round_is_refused():
    """The extrinsics are inverted, the most frequent mistake of users."""
    flight = Flight(5)
    inverted = replace(CALIBRATION, T_imu_camera=inverse(T_IMU_CAMERA))
    found = find_gravity(
        stretch_of(flight, 0.2, 1.0, (0.003, 0.001)), samples_of(flight), inverted, known_scale=True
    )
    assert "do not agree" in found.doubt


def test_a_gap_in_the_samples_is_refused():
    flight = Flight(6)
    samples = samples_of(flight)
    missing = (samples[:, 0] > 0.5) & (samples[:, 0] < 0.6)
    stretch = stretch_of(flight, 0.2, 1.0)
    assert find_gravity(stretch, samples[~missing], CALIBRATION, known_scale=True) is None
    assert find_gravity(stretch, samples[:0], CALIBRATION, known_scale=True) is None
    short = stretch_of(flight, 0.2, 0.1)
    assert find_gravity(short, samples, CALIBRATION, known_scale=True) is None


def started(flight, seed, seconds=0.6) -> tuple[GravityState, np.ndarray]:
    samples = samples_of(flight, noise=ADIS16448, seed=seed)
    stretch = stretch_of(flight, 0.2, seconds, (0.003, 0.001), seed)
    found = find_gravity(stretch, samples, CALIBRATION, known_scale=True)
    assert found.doubt == ""
    return found, samples


def error_of(state, flight) -> np.ndarray:
    """Return the ``(18,)`` error of a state, as its covariance describes it."""
    T = flight.pose(state.timestamp)
    return np.concatenate(
        [
            so3_log(np.ascontiguousarray(state.T_world_imu[:3, :3].T @ T[:3, :3])),
            T[:3, 3] - state.T_world_imu[:3, 3],
            flight.velocity(state.timestamp) - state.velocity,
            np.array(flight.gravity) - state.gravity,
            BIAS - state.bias,
        ]
    )


def test_the_covariance_is_that_of_the_errors_in_the_light_and_in_the_dark():
    """Motion with poses for 2 s, then 1 s without: the errors are as large as the filter says."""
    light, dark = [], []
    covariance = np.diag(np.repeat([0.003, 0.001], 3) ** 2)
    for seed in range(40):
        flight = Flight(seed)
        found, samples = started(flight, seed)
        state, rng = found.state, np.random.default_rng(seed + 1000)
        for t in np.arange(0.85, 2.81, 0.05):
            state = propagated(state, samples, t, ADIS16448)
            noise = np.r_[0.003 * rng.standard_normal(3), 0.001 * rng.standard_normal(3)]
            T_wc = flight.pose(t) @ T_IMU_CAMERA @ se3_exp(noise)
            state = corrected_by_pose(state, T_wc, covariance, T_IMU_CAMERA).state
        for kept in (light, dark):
            if kept is dark:
                state = propagated(state, samples, 3.8, ADIS16448)
            moving, P = error_of(state, flight)[:9], state.covariance[:9, :9]
            kept.append(moving @ np.linalg.solve(P, moving))
    assert 5.0 < np.mean(light) < 13.0  # 9 are expected
    assert 5.0 < np.mean(dark) < 13.0


def test_at_rest_the_noise_is_that_of_the_data_sheet():
    rest = Flight(2, speed=0.0, turning=0.0)
    noise = noise_in_motion(ADIS16448, samples_of(rest, np.zeros(6), ADIS16448))
    assert noise.gyro == pytest.approx(ADIS16448.gyro, rel=0.1)
    assert noise.accel == pytest.approx(ADIS16448.accel, rel=0.1)
    assert noise.accel_walk == ADIS16448.accel_walk


def test_shares_of_motion_and_vibration_count_as_noise_also_if_samples_are_missing():
    samples = np.zeros((400, 7))
    samples[:, 0] = np.arange(400) * 0.005
    samples[:, 1:] = (0.5, 0.0, 0.0, 0.0, 0.0, GRAVITY)
    samples[:, 4:] += 0.5 * np.random.default_rng(0).standard_normal((len(samples), 3))
    shares = np.array([VIBRATION * 0.5 * np.sqrt(0.005), MOTION * 0.5 * np.sqrt(3.0)])
    accel = np.linalg.norm([ADIS16448.accel, *shares])
    for rows in (samples, np.delete(samples, slice(-100, -60), axis=0)):
        noise = noise_in_motion(ADIS16448, rows)
        assert noise.accel == pytest.approx(accel, rel=0.2)
        assert noise.gyro == pytest.approx(np.hypot(ADIS16448.gyro, MOTION * 0.5), rel=0.05)
    assert noise_in_motion(ADIS16448, samples[:3]) == ADIS16448


def test_samples_at_alternating_intervals_tell_no_vibration():
    rows = np.zeros((12, 7))
    rows[1:, 0] = np.cumsum(np.resize([0.010, 0.016], 11))
    rows[:, 4:] = np.random.default_rng(0).standard_normal((12, 3))
    share = MOTION * np.sqrt(np.sum(np.var(rows[:, 4:], axis=0)))
    noise = noise_in_motion(ADIS16448, rows)
    assert noise.accel == pytest.approx(np.hypot(ADIS16448.accel, share), rel=1e-6)


def test_a_drift_of_the_world_changes_nothing_in_the_frame_of_the_imu():
    """Gravity and velocity, seen from the IMU, stay as uncertain as they were."""
    found, _ = started(Flight(1), 1)
    A = np.random.default_rng(0).standard_normal((6, 6))
    before, given = found.state, A @ A.T * 1e-4
    after = drifted(before, given, T_IMU_CAMERA)
    added = camera_covariance(after, T_IMU_CAMERA) - camera_covariance(before, T_IMU_CAMERA)
    assert np.allclose(added, given, atol=1e-12)
    at = before.T_world_imu
    seen = [anchored(state, at).covariance[6:, 6:] for state in (before, after)]
    assert np.allclose(*seen, atol=1e-12)


def test_in_the_dark_the_state_follows_the_samples():
    flight = Flight(7)
    found, samples = started(flight, 7)
    dark = propagated(found.state, samples, found.state.timestamp + 0.5, ADIS16448)
    T = flight.pose(dark.timestamp) @ T_IMU_CAMERA
    assert np.linalg.norm((inverse(T) @ camera_pose(dark, T_IMU_CAMERA))[:3, 3]) < 0.1
    before, after = (camera_covariance(s, T_IMU_CAMERA) for s in (found.state, dark))
    assert np.all(np.diag(after) > np.diag(before))


def test_standing_still_stops_the_drift():
    flight = Flight(3, speed=0.0, turning=0.0)
    found, samples = started(flight, 3)
    free = resting = found.state
    for t in np.arange(0.85, 4.8, 0.05):
        free = propagated(free, samples, t, ADIS16448)
        resting = propagated(resting, samples, t, ADIS16448)
        resting = corrected_by_rest(resting, 0.01).state
    drift, rest = (np.linalg.norm(error_of(state, flight)[3:6]) for state in (free, resting))
    assert rest < 0.02
    assert rest < 0.2 * drift


def test_a_pose_with_another_convention_of_error_would_be_seen():
    """The covariance of the corrected pose is the given one if nothing else was known."""
    flight = Flight(1)
    found, _ = started(flight, 1)
    vague = replace(found.state, covariance=1e6 * np.eye(18))
    A = np.random.default_rng(0).standard_normal((6, 6))
    given = A @ A.T * 1e-4
    T_wc = camera_pose(vague, T_IMU_CAMERA)
    after = corrected_by_pose(vague, T_wc, given, T_IMU_CAMERA).state
    assert np.allclose(camera_covariance(after, T_IMU_CAMERA), given, atol=1e-8)


def test_another_world_frame_changes_nothing_but_the_frame():
    flight = Flight(1)
    found, samples = started(flight, 1)
    T = se3_exp(np.array([3.0, -2.0, 1.0, 0.5, -1.0, 0.7]))
    one = in_another_world(propagated(found.state, samples, 1.5, ADIS16448), T)
    other = propagated(in_another_world(found.state, T), samples, 1.5, ADIS16448)
    assert np.allclose(one.T_world_imu, other.T_world_imu, atol=1e-12)
    assert np.allclose(one.velocity, other.velocity, atol=1e-12)
    assert np.allclose(one.covariance, other.covariance, atol=1e-12)


@pytest.mark.skipif(not EUROC.is_dir(), reason="EuRoC's inertial data absent")
@pytest.mark.parametrize("name", ["V1_01", "V1_03"])
def test_a_second_of_a_real_flight_carries_the_camera_through_the_dark(name):
    """Poses are true ones with noise of 3 mm and 0.03 degrees; the samples are real."""
    flight, errors = recording(name), []
    for k, start in enumerate(np.linspace(flight.times[0] + 12.0, flight.times[-1] - 7.0, 30)):
        stretch = stretch_of(flight, start, 1.0, (0.003, 0.0005), k)
        until = flight.samples[flight.samples[:, 0] <= stretch.times[-1]]
        noise = noise_in_motion(ADIS16448, until)
        calibration = ImuCalibration(T_IMU_CAMERA, noise)
        found = find_gravity(stretch, flight.samples, calibration, known_scale=True)
        assert found.doubt == ""
        row = [degrees_between(found.state.gravity, DOWN)]
        for seconds in (0.5, 1.0):
            end = found.state.timestamp + seconds
            dark = propagated(found.state, flight.samples, end, noise)
            apart = inverse(flight.pose(end)) @ dark.T_world_imu
            row += [np.linalg.norm(apart[:3, 3]), np.degrees(np.linalg.norm(se3_log(apart)[3:]))]
        errors.append(row)
    tilt, metres_half, degrees_half, metres, degrees = np.median(errors, axis=0)
    assert tilt < 2.0
    assert metres_half < 0.03
    assert metres < 0.09
    assert max(degrees_half, degrees) < 0.25
