"""Odometry beside the map: its poses never jump, and its covariances are consistent."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest
from ring import Oracle
from test_closing import DRIFTING, EXACT, ROUND, run
from test_pose import CAMERA, TRUTH, observations

from vslam.datasets import open_sequence
from vslam.datasets.perturbation import Perturbation
from vslam.evaluation.odometry import motion_errors
from vslam.frontend.pose import offset_effect, optimise_pose, pose_covariance
from vslam.report.figures import draw_figures
from vslam.report.frame_table import write_covariances, write_frames
from vslam.run.options import RunOptions
from vslam.run.pipeline import run_sequence
from vslam.run.recorder import Recorder
from vslam.run.slam_run import begin
from vslam.slam import Slam
from vslam.types.features import Extracted, TrackingState, TrackResult
from vslam.types.geometry import adjoint, inverse, se3_exp, se3_log
from vslam.types.odometry import (
    CORRELATION,
    DRIFT,
    OdometryState,
    PoseUncertainty,
    at_keyframe,
    moved,
    predicted_covariance,
    relative_covariance,
)
from vslam.types.trajectory import Trajectory
from vslam_lab.towns import built_in_route

MOTION = se3_exp(np.array([0.1, -0.05, -1.0, 0.01, 0.05, -0.02]))


def some_covariance(scale: float = 1.0, seed: int = 0) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(6, 6))
    return scale * (root @ root.T + np.eye(6))


def covariance(T: np.ndarray, points: np.ndarray, uvr: np.ndarray, weight: np.ndarray):
    disparity_weight = np.full(len(points), CAMERA.intrinsics[5])
    return pose_covariance(T, points, uvr, weight, CAMERA.intrinsics, disparity_weight)


def test_the_adjoint_carries_a_small_motion_to_the_other_side_of_a_pose():
    xi = np.array([0.02, -0.01, 0.03, 0.01, -0.02, 0.015])
    np.testing.assert_allclose(
        se3_exp(adjoint(MOTION) @ xi) @ MOTION, MOTION @ se3_exp(xi), atol=1e-12
    )


@pytest.mark.parametrize("kind", ["mono", "mixed", "stereo"])
@pytest.mark.parametrize("believed", [0.7, 1.0])
def test_errors_of_a_pose_are_those_that_its_covariance_predicts(kind, believed):
    """The covariance is also right if observations are more accurate than their weights assume.

    If they are as accurate as assumed, one observation in twenty fails the test for inliers. This
    reduces the residuals of the others. The variance of a gradient that is estimated from few cells
    is itself uncertain. This increases the mean.
    """
    squared = []
    for seed in range(200):
        points, uvr, weight = observations(kind, n=500, noise=believed, seed=seed)
        T, inlier = optimise_pose(TRUTH, points, uvr, weight, CAMERA.intrinsics)
        C = covariance(T, points[inlier], uvr[inlier], weight[inlier])
        xi = se3_log(TRUTH @ inverse(T))
        squared.append(xi @ np.linalg.inv(C) @ xi / 6.0)
    assert 0.8 < np.mean(squared) < (1.25 if believed < 1.0 else 1.5)


def test_the_covariance_holds_where_errors_are_unequal_and_neighbours_share_them():
    """Near points have errors that are three times as large. Every corner is observed four times.

    A covariance that is computed from the weights alone would be several times too small.
    """
    squared = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        points, uvr, _ = observations("mono", n=250, seed=seed)
        near = points @ TRUTH[2, :3] + TRUTH[2, 3] < 12.0
        uvr[:, :2] += rng.normal(0.0, np.where(near, 0.6, 0.2)[:, None], (250, 2))
        points, uvr = np.tile(points, (4, 1)), np.tile(uvr, (4, 1))
        uvr[:, :2] += rng.normal(0.0, 0.05, (1000, 2))
        T, inlier = optimise_pose(TRUTH, points, uvr, np.ones(1000), CAMERA.intrinsics)
        seen = T, points[inlier], uvr[inlier], np.ones(int(inlier.sum()))
        xi = se3_log(TRUTH @ inverse(T))
        squared.append(xi @ np.linalg.inv(covariance(*seen)) @ xi / 6.0)
    assert 0.8 < np.mean(squared) < 1.5


def test_a_wrong_offset_makes_the_motion_too_long_or_too_short():
    """Landmarks are computed from disparities that are 0.05 px too large.

    The next frame is tracked using its left image.
    """
    points, _, weight = observations("mono", n=500)
    in_camera = points @ TRUTH[:3, :3].T + TRUTH[:3, 3]
    offset = 0.05
    wrong = in_camera * (1.0 / (1.0 + offset * in_camera[:, 2:] / CAMERA.bf))
    ahead = in_camera[:, 2] > 6.0
    T_true = se3_exp(np.array([0.05, -0.02, -1.0, 0.002, 0.01, -0.003]))
    moved = in_camera @ T_true[:3, :3].T + T_true[:3, 3]
    uvr, wrong, weight = CAMERA.project(moved)[ahead], wrong[ahead], weight[ahead]
    uvr[:, 2] = np.nan
    T, inlier = optimise_pose(np.eye(4), wrong, uvr, weight, CAMERA.intrinsics)
    assert inlier.all()
    effect = offset_effect(T, wrong, uvr, weight, CAMERA.intrinsics)
    expected = offset * effect @ T[:3, 3]
    error = se3_log(T_true @ inverse(T))
    assert abs(error[2]) > 1e-4
    np.testing.assert_allclose(error, expected, atol=0.1 * np.abs(error).max())


def test_the_error_of_the_offset_adds_up_along_a_drive():
    """The error in the offset is constant.

    Its part of the covariance grows with the square of the distance, and cancels if the camera
    returns.
    """
    effect = np.zeros((6, 3))
    effect[:3] = 0.001 * np.eye(3)
    model, states = OdometryState(), []
    ahead = se3_exp(np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0]))
    for k in range(20):
        states.append(model.now)
        model = moved(model, ahead if k < 10 else inverse(ahead), 0.1, 1e-12 * np.eye(6), effect)
    share = [state.covariance[2, 2] for state in (states[5], states[10])]
    np.testing.assert_allclose(share, np.square([5e-3, 10e-3]), rtol=1e-3)
    between = relative_covariance(states[3], states[8], np.linalg.matrix_power(ahead, 5))
    assert between[2, 2] == pytest.approx(5e-3**2, rel=1e-3)
    assert model.now.covariance[2, 2] < 1e-10


def test_too_few_observations_have_no_covariance():
    points, uvr, weight = observations("mixed")
    few = covariance(TRUTH, points[:2], uvr[:2], weight[:2])
    assert np.isnan(few).all()


def test_the_drift_grows_as_the_sum_of_correlated_steps_does():
    rng = np.random.default_rng(2)
    n = 12
    steps = np.empty((20_000, n))
    steps[:, 0] = rng.normal(size=len(steps))
    for k in range(1, n):
        noise = np.sqrt(1.0 - CORRELATION**2) * rng.normal(size=len(steps))
        steps[:, k] = CORRELATION * steps[:, k - 1] + noise
    still = PoseUncertainty(np.zeros((6, 6)), np.zeros((6, 6)), 0)
    later = PoseUncertainty(np.zeros((6, 6)), n * np.eye(6), n)
    predicted = relative_covariance(still, later, np.eye(4))[0, 0]
    assert DRIFT * steps.sum(axis=1).var() == pytest.approx(predicted, rel=0.05)


def test_the_drift_before_both_frames_does_not_count():
    model = OdometryState()
    model = moved(model, np.eye(4), 0.0, some_covariance())
    model = at_keyframe(model)
    first = model.now
    model = moved(model, MOTION, 0.1, some_covariance(2.0, 1))
    A = adjoint(MOTION)
    expected = some_covariance(2.0, 1) + A @ some_covariance() @ A.T
    np.testing.assert_allclose(relative_covariance(first, model.now, MOTION), expected, atol=1e-9)
    model = at_keyframe(model)
    grown = relative_covariance(first, model.now, MOTION) - expected
    np.testing.assert_allclose(grown, DRIFT * some_covariance(2.0, 1), atol=1e-9)
    assert (np.linalg.eigvalsh(model.now.covariance - first.local) > 0).all()


def test_a_pose_that_is_predicted_gets_less_sure_with_the_square_of_the_time():
    model = OdometryState()
    model = moved(model, np.eye(4), 0.0, some_covariance(1e-10))
    deviations = []
    for covariance in (None, None, np.full((6, 6), np.nan), None):
        model = moved(model, np.eye(4), 0.15, covariance)
        deviations.append(np.sqrt(np.diag(model.now.local)))
    ratio = np.array(deviations)[1:] / deviations[0]
    np.testing.assert_allclose(ratio, np.array([4.0, 9.0, 16.0])[:, None] * np.ones(6), rtol=1e-3)
    model = moved(model, np.eye(4), 0.15, some_covariance(1e-6))
    assert np.diag(model.now.local).max() < 1e-4


def turned(seconds: float) -> np.ndarray:
    """Return the motion of a vehicle that drives at 8 m/s and turns by 0.2 rad/s."""
    return se3_exp(seconds * np.array([0.0, 0.0, -8.0, 0.0, -0.2, 0.0]))


@pytest.mark.parametrize("begins_submap", [False, True])
def test_the_error_of_a_prediction_stays_in_the_poses_after_it(begins_submap):
    """The camera is found again in the map, or begins a sub-map. The odometry does not catch up."""
    model, still = OdometryState(), 1e-10 * np.eye(6)
    model = moved(model, np.eye(4), 0.0, still)
    model = at_keyframe(model)
    known = model.now
    for _ in range(19):
        model = moved(model, turned(0.1), 0.1, None)
    if begins_submap:
        model = moved(model, turned(0.1), 0.1, None)
        model = at_keyframe(model)
    else:
        model = moved(model, turned(0.1), 0.1, still, found_again=True)
    expected = predicted_covariance(turned(2.0), 2.0)
    np.testing.assert_allclose(model.now.covariance, expected, rtol=0.1, atol=1e-3)
    np.testing.assert_allclose(relative_covariance(known, model.now, turned(2.0)),
                               model.now.covariance, atol=1e-6)  # fmt: skip
    assert np.diag(model.now.local).max() < 1e-9
    after = model.now
    for _ in range(20):
        model = moved(model, turned(0.1), 0.1, still)
        model = at_keyframe(model)
    assert np.diag(relative_covariance(after, model.now, turned(2.0))).max() < 1e-6
    assert np.linalg.det(model.now.covariance) > 0.9 * np.linalg.det(expected)


def test_the_motion_before_the_first_tracked_frame_is_not_part_of_the_uncertainty():
    model = OdometryState()
    for _ in range(10):
        model = moved(model, np.eye(4), 0.1, None)
    assert not at_keyframe(model).now.covariance.any()
    found = moved(model, np.eye(4), 0.1, some_covariance(1e-6), found_again=True)
    np.testing.assert_allclose(found.now.covariance, some_covariance(1e-6))


def test_a_prediction_without_a_velocity_is_much_less_sure():
    deviations = []
    for known in (True, False):
        model = OdometryState()
        model = moved(model, np.eye(4), 0.0, some_covariance(1e-6))
        for _ in range(10):
            model = moved(model, np.eye(4), 0.1, None, known_velocity=known)
        deviations.append(np.sqrt(model.now.covariance[2, 2]))
    assert deviations[0] == pytest.approx(0.5, rel=0.05)
    assert 5.0 < deviations[1] < 20.0


def test_the_deviation_of_a_prediction_matches_the_errors_along_a_route():
    """Two seconds are predicted with constant velocity, everywhere along a route with turns."""
    route = built_in_route("00")
    T_wc, errors = route.T_wc, []
    for k in range(1, len(T_wc) - 20, 7):
        step = inverse(T_wc[k]) @ T_wc[k - 1]
        predicted = np.linalg.matrix_power(step, 20)
        xi = se3_log(inverse(T_wc[k + 20]) @ T_wc[k] @ inverse(predicted))
        variances = np.diag(predicted_covariance(predicted, 2.0))
        errors.append([(xi[:3] @ xi[:3]) / variances[:3].sum(),
                       (xi[3:] @ xi[3:]) / variances[3:].sum()])  # fmt: skip
    root = np.sqrt(np.array(errors))
    assert (np.sqrt(np.mean(errors, axis=0)) > 0.2).all()
    assert (np.percentile(root, 98, axis=0) > 0.5).all()
    assert (root < 1.5).all()


def test_a_drive_gets_less_sure_where_it_is_lost_and_with_every_keyframe(corridor):
    slam = Slam(corridor.camera, detector="none", threads=1)
    noise = np.random.default_rng(0).integers(0, 256, corridor.left[0].shape, dtype=np.uint8)
    results = []
    for k, left in enumerate(corridor.left):
        image = noise if k == 15 else left
        results.append(slam.step(image, corridor.right[k], corridor.timestamps[k]))
    deviation = [np.sqrt(np.diag(result.uncertainty.local)[:3].sum()) for result in results]
    assert results[15].state == TrackingState.LOST
    usual = np.array(deviation[2:15] + deviation[17:])
    assert deviation[15] > 1.4 * usual.max()
    assert 1e-4 < np.median(usual) < 0.05
    drift = [
        np.trace(result.uncertainty.covariance - result.uncertainty.local) for result in results
    ]
    made = np.array([result.is_keyframe for result in results])
    assert (np.diff(drift)[made[1:]] > 0).all()
    assert results[-1].uncertainty.n_keyframes == made.sum()
    gaps = [np.trace(result.uncertainty.gaps) for result in results]
    assert max(gaps[:16]) == 0.0 < min(gaps[16:])  # frame 16 was tracked, but did not catch up
    assert [result.measured for result in results] == [k != 15 for k in range(len(results))]


@pytest.mark.parametrize("promised", [1.0, 0.25])
def test_the_nees_finds_covariances_that_promise_too_much(promised):
    """The errors of the frames are drawn with the estimated variance, or with four times it."""
    rng = np.random.default_rng(0)
    C = np.diag([1e-4, 1e-4, 4e-4, 1e-6, 1e-6, 1e-6])
    truth, results = [], []
    for k in range(600):
        T_wc = se3_exp(np.array([0.0, 0.0, 0.8 * k, 0.0, 0.0, 0.0]))
        error = se3_exp(rng.multivariate_normal(np.zeros(6), C))
        sure = PoseUncertainty(promised * C, np.zeros((6, 6)), 0)
        tracked = TrackResult(k, 0.1 * k, T_wc, TrackingState.OK, 0, 0, 0, 0, False)
        truth.append(T_wc)
        results.append(replace(tracked, T_odom_camera=T_wc @ error, uncertainty=sure))
    times = np.array([result.timestamp for result in results])
    nees = motion_errors(results, Trajectory(times, np.array(truth)), 1.0).nees[20::7]
    assert nees.mean() == pytest.approx(1.0 / promised, rel=0.2)


def steps(poses: list[np.ndarray]) -> np.ndarray:
    return np.linalg.norm(np.diff([pose[:3, 3] for pose in poses], axis=0), axis=1)


@pytest.mark.slow
def test_a_loop_moves_the_map_and_not_the_odometry():
    slam, results = run(DRIFTING, ROUND, Oracle(DRIFTING, ROUND))
    assert slam.corrections
    odom = steps([result.T_odom_camera for result in results])
    assert odom.max() < 1.05 * np.median(odom)
    corrections = steps([result.T_map_odom for result in results])
    assert corrections.max() > 10.0 * np.median(corrections)
    last = results[-1]
    np.testing.assert_allclose(last.T_map_odom @ last.T_odom_camera, last.T_wc, atol=1e-9)


def test_the_odometry_of_a_resumed_drive_continues_without_the_state_of_tracking(tmp_path):
    slam, results = run(EXACT, [*range(30)])
    slam.save(tmp_path / "map.npz")
    again = Slam.load(tmp_path / "map.npz", detector="none", resume=True)
    again.resume_odometry(results[-1])
    image = np.zeros((1, 2), np.uint8)
    last = again.step_features(Extracted(EXACT.see(30, 1)), 3.0, image)
    assert last.state == TrackingState.OK
    moved = np.linalg.norm(last.T_odom_camera[:3, 3] - results[-1].T_odom_camera[:3, 3])
    assert moved == pytest.approx(steps([r.T_odom_camera for r in results])[-1], rel=0.1)
    assert last.uncertainty.n_keyframes >= results[-1].uncertainty.n_keyframes


def test_the_odometry_does_not_jump_where_the_camera_is_found_again():
    lost = range(30, 36)
    _, results = run(EXACT, [*range(50)], dark=lost)
    assert all(results[k].state == TrackingState.LOST for k in lost)
    odom = steps([result.T_odom_camera for result in results])
    assert odom.max() < 1.2 * np.median(odom)
    assert results[0].T_odom_camera is not None
    np.testing.assert_array_equal(results[0].T_odom_camera, np.eye(4))


def test_the_tables_hold_deviations_and_both_covariances(tmp_path):
    sure = PoseUncertainty(some_covariance(1e-4), some_covariance(1e-3, 1), 3)
    known = TrackResult(
        0, 1.5, np.eye(4), TrackingState.OK, 9, 8, 7, 6, True, False, {}, uncertainty=sure
    )
    tracks = [known, replace(known, index=1, timestamp=1.6, uncertainty=None)]
    write_frames(tmp_path / "frames.csv", tracks)
    write_covariances(tmp_path / "covariance.csv", tracks)
    with (tmp_path / "frames.csv").open(newline="") as file:
        first, second = csv.DictReader(file)
    assert float(first["sigma_m"]) == pytest.approx(np.sqrt(np.trace(sure.local[:3, :3])), abs=1e-6)
    assert float(first["drift_deg"]) == pytest.approx(
        np.degrees(np.sqrt(np.trace(sure.covariance[3:, 3:]))), abs=1e-6
    )
    assert second["sigma_m"] == second["drift_m"] == ""
    with (tmp_path / "covariance.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert float(row["local_y_rz"]) == pytest.approx(sure.local[1, 5], rel=1e-5)
    assert float(row["drive_x_x"]) == pytest.approx(sure.covariance[0, 0], rel=1e-5)


def test_numbers_come_back_as_the_same_uncertainty():
    sure = PoseUncertainty(
        some_covariance(), some_covariance(seed=1), 3, np.arange(1.0, 7.0), some_covariance(seed=2)
    )
    again = PoseUncertainty.of_numbers(sure.numbers())
    np.testing.assert_array_equal(again.numbers(), sure.numbers())
    np.testing.assert_allclose(again.drift, sure.drift, atol=1e-12)
    np.testing.assert_allclose(again.gaps, sure.gaps, atol=1e-12)
    np.testing.assert_array_equal(again.offset, sure.offset)
    assert again.n_keyframes == 3


def test_the_report_draws_the_error_of_odometry_beside_two_sigma(kitti_tree):
    sequence = open_sequence("kitti", kitti_tree, "00")
    outcome = run_sequence(
        begin(sequence, RunOptions(detector="none")), Perturbation("none"), Recorder()
    )
    errors = motion_errors(outcome.tracks, outcome.ground_truth, 1.0)
    assert len(errors.first) == 18  # of 28 frames in 2.7 s
    assert errors.distance.max() < 0.05
    drawn = [figure.name for figure in draw_figures(outcome, None, None)]
    assert "odometry_error" in drawn
    left = replace(sequence, camera=sequence.camera.left_camera())
    alone = replace(outcome, sequence=left)
    assert "odometry_error" not in [f.name for f in draw_figures(alone, None, None)]
