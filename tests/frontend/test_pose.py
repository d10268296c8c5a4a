"""Motion-only optimisation is exact without noise, robust to outliers, and equal to GTSAM."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from stereo_noise import WHITENING, white_noise

from vslam.frontend.pose import optimise_pose
from vslam.types.camera import Camera
from vslam.types.geometry import inverse, se3_exp, se3_log, solve_positive, transform

CAMERA = Camera(400.0, 410.0, 320.0, 120.0, 0.5, 640, 240)
TRUTH = se3_exp(np.array([0.4, -0.2, 1.1, 0.05, -0.1, 0.02]))
START = se3_exp(np.array([0.1, -0.08, 0.2, 0.02, 0.03, -0.02])) @ TRUTH
KINDS = ["mono", "stereo", "mixed"]


def observations(kind: str, n: int = 120, noise: float = 0.0, seed: int = 0):
    """Make world points, their observations at TRUTH, and the inverse variances of these."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(3, 40, n)
    pixels = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (n, 2))
    in_camera = CAMERA.backproject(pixels, depth)
    uvr = CAMERA.project(in_camera)
    sigma = 1.2 ** rng.integers(0, 8, n)
    if kind != "stereo":
        uvr[:: 1 if kind == "mono" else 2, 2] = np.nan
    uvr += noise * sigma[:, None] * white_noise(rng, ~np.isnan(uvr[:, 2]))
    return transform(inverse(TRUTH), in_camera), uvr, sigma**-2.0


def pose_difference(A: np.ndarray, B: np.ndarray) -> float:
    return float(np.abs(se3_log(A @ np.linalg.inv(B))).max())


def chi2(T: np.ndarray, points, uvr, inverse_sigma2) -> np.ndarray:
    error = np.nan_to_num(uvr - CAMERA.project(transform(T, points)))
    stereo = ~np.isnan(uvr[:, 2])
    error[stereo] = error[stereo] @ WHITENING.T
    return (error**2).sum(axis=1) * inverse_sigma2


@pytest.mark.parametrize("kind", KINDS)
def test_recovers_the_pose_from_noise_free_observations(kind):
    points, uvr, weight = observations(kind)
    T, inlier = optimise_pose(START, points, uvr, weight, CAMERA.intrinsics)
    assert pose_difference(START, TRUTH) > 0.1
    assert pose_difference(T, TRUTH) < 1e-6
    assert inlier.all()


@pytest.mark.parametrize("kind", KINDS)
def test_flags_exactly_the_gross_outliers_when_they_are_two_in_five(kind):
    points, uvr, weight = observations(kind, n=200)
    rng = np.random.default_rng(1)
    wrong = rng.permutation(200) < 80
    uvr[wrong, :2] += rng.choice([-1, 1], (80, 2)) * rng.uniform(30, 80, (80, 2))
    T, inlier = optimise_pose(START, points, uvr, weight, CAMERA.intrinsics)
    np.testing.assert_array_equal(inlier, ~wrong)
    assert pose_difference(T, TRUTH) < 1e-6


def test_an_outlier_in_disparity_alone_is_flagged():
    points, uvr, weight = observations("stereo")
    uvr[::10, 2] -= 25.0
    _, inlier = optimise_pose(START, points, uvr, weight, CAMERA.intrinsics)
    assert np.flatnonzero(~inlier).tolist() == list(range(0, 120, 10))


@pytest.mark.parametrize("kind", KINDS)
def test_inliers_are_those_of_the_chi_square_test(kind):
    points, uvr, weight = observations(kind, n=300, noise=1.3)
    T, inlier = optimise_pose(START, points, uvr, weight, CAMERA.intrinsics)
    limit = np.where(np.isnan(uvr[:, 2]), 5.991, 7.815)
    np.testing.assert_array_equal(inlier, chi2(T, points, uvr, weight) <= limit)
    assert 0.5 < inlier.mean() < 0.95


def gtsam_pose(points, uvr, inverse_sigma2) -> np.ndarray:
    """Compute the pose that minimises the squared error, using GTSAM with fixed points."""
    stereo = gtsam.Cal3_S2Stereo(CAMERA.fx, CAMERA.fy, 0.0, CAMERA.cx, CAMERA.cy, CAMERA.baseline)
    mono = gtsam.Cal3_S2(CAMERA.fx, CAMERA.fy, 0.0, CAMERA.cx, CAMERA.cy)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(0, gtsam.Pose3(np.linalg.inv(START)))
    for i, (p, (u, v, r), w) in enumerate(zip(points, uvr, inverse_sigma2, strict=True), 1):
        values.insert(i, p)
        graph.add(gtsam.PriorFactorPoint3(i, p, gtsam.noiseModel.Constrained.All(3)))
        sigma = w**-0.5
        if np.isnan(r):
            noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
            pixel = np.array([u, v])
            graph.add(gtsam.GenericProjectionFactorCal3_S2(pixel, noise, 0, i, mono))
        else:
            turned = WHITENING[:, [0, 2, 1]]  # GTSAM's order: u, u_right, v
            noise = gtsam.noiseModel.Gaussian.Information(sigma**-2.0 * turned.T @ turned)
            graph.add(gtsam.GenericStereoFactor3D(gtsam.StereoPoint2(u, r, v), noise, 0, i, stereo))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-14)
    parameters.setAbsoluteErrorTol(1e-14)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    return np.linalg.inv(result.atPose3(0).matrix())


@pytest.mark.parametrize("kind", KINDS)
def test_finds_gtsams_optimum_of_the_inliers(kind):
    points, uvr, weight = observations(kind, n=80, noise=0.7)
    uvr[::9, :2] += 60.0
    T, inlier = optimise_pose(START, points, uvr, weight, CAMERA.intrinsics)
    assert np.count_nonzero(inlier) > 50
    expected = gtsam_pose(points[inlier], uvr[inlier], weight[inlier])
    assert pose_difference(T, expected) < 1e-6
    assert pose_difference(T, TRUTH) > 1e-4  # because of the noise, both differ from the truth


def test_octaves_weigh_the_observations():
    """Half of the points are displaced by 1 px. The pose follows those with the smaller sigma."""
    points, uvr, _ = observations("stereo")
    uvr[::2, :2] += 1.0
    weight = np.ones(120)
    weight[::2] = 1e-4
    T, _ = optimise_pose(TRUTH, points, uvr, weight, CAMERA.intrinsics)
    assert pose_difference(T, TRUTH) < 1e-5
    even, _ = optimise_pose(TRUTH, points, uvr, np.full(120, 1e-2), CAMERA.intrinsics)
    assert pose_difference(even, TRUTH) > 5e-4


def test_points_behind_the_camera_are_outliers():
    points, uvr, weight = observations("stereo")
    in_camera = transform(TRUTH, points)
    points[:5] = transform(inverse(TRUTH), -in_camera[:5])
    T, inlier = optimise_pose(START, points, uvr, weight, CAMERA.intrinsics)
    assert np.flatnonzero(~inlier).tolist() == [0, 1, 2, 3, 4]
    assert pose_difference(T, TRUTH) < 1e-6


@pytest.mark.parametrize("n", [0, 1, 2])
def test_fewer_than_three_points_leave_the_pose_and_have_no_inliers(n):
    points, uvr, weight = observations("stereo", n=3)
    T, inlier = optimise_pose(START, points[:n], uvr[:n], weight[:n], CAMERA.intrinsics)
    assert np.array_equal(T, START)
    assert inlier.tolist() == [False] * n


def test_one_point_seen_many_times_leaves_the_pose_finite():
    points, uvr, weight = observations("mono", n=1)
    T, _ = optimise_pose(
        START, *(np.repeat(x, 10, axis=0) for x in (points, uvr, weight)), CAMERA.intrinsics
    )
    assert np.isfinite(T).all()


def test_start_is_not_written_to():
    points, uvr, weight = observations("mixed")
    start = START.copy()
    optimise_pose(start, points, uvr, weight, CAMERA.intrinsics)
    assert np.array_equal(start, START)


def test_solve_positive_solves_and_gives_zeros_where_it_cannot():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(10, 6))
    H, b = A.T @ A, rng.normal(size=6)
    np.testing.assert_allclose(solve_positive(H, b), np.linalg.solve(H, b), rtol=1e-10)
    assert np.array_equal(solve_positive(-H, b), np.zeros(6))


# -- landmarks that are known to be at rest -------------------------------------------------------

OBJECT = se3_exp(np.array([0.5, 0.0, 0.2, 0.0, 0.0, 0.0])) @ TRUTH  # the pose relative to an object


def seen_from(*groups: tuple[np.ndarray, float, int]):
    """Make observations of groups of points. Each group has its own pose of the camera, its
    greatest depth in metres, and its number of points."""
    rng, points, seen = np.random.default_rng(5), [], []
    for T_cw, depth, n in groups:
        pixels = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (n, 2))
        in_camera = CAMERA.backproject(pixels, rng.uniform(0.5 * depth, depth, n))
        points.append(transform(inverse(T_cw), in_camera))
        seen.append(CAMERA.project(in_camera))
    return np.vstack(points), np.vstack(seen)


def follow(points, uvr, trusted) -> tuple[np.ndarray, np.ndarray]:
    weight = np.ones(len(points))
    return optimise_pose(OBJECT, points, uvr, weight, CAMERA.intrinsics, trusted=trusted)


def test_landmarks_at_rest_decide_against_a_moving_object_with_more_landmarks():
    points, uvr = seen_from((TRUTH, 20.0, 60), (OBJECT, 20.0, 200))
    at_rest = np.arange(260) < 60
    for unknown in (None, np.zeros(260, np.bool_)):
        T, inlier = follow(points, uvr, unknown)
        assert pose_difference(T, OBJECT) < 1e-6
        np.testing.assert_array_equal(inlier, ~at_rest)
    # Every landmark that agrees is used, whether it is trusted or not.
    trusted = np.arange(260) < 40
    trusted[250:] = True
    T, inlier = follow(points, uvr, trusted)
    assert pose_difference(T, TRUTH) < 1e-6
    np.testing.assert_array_equal(inlier, at_rest)


@pytest.mark.parametrize(("n_trusted", "expected"), [(30, TRUTH), (29, OBJECT)])
def test_few_trusted_landmarks_do_not_decide(n_trusted, expected):
    points, uvr = seen_from((TRUTH, 20.0, 60), (OBJECT, 20.0, 200))
    T, _ = follow(points, uvr, np.arange(260) < n_trusted)
    assert pose_difference(T, expected) < 1e-6


@pytest.mark.parametrize(("n_agree", "expected"), [(30, TRUTH), (29, OBJECT)])
def test_trusted_landmarks_that_contradict_each_other_do_not_decide(n_agree, expected):
    points, uvr = seen_from((TRUTH, 20.0, 40), (OBJECT, 20.0, 200))
    away = np.random.default_rng(2).choice([-40.0, 40.0], (40 - n_agree, 1))
    uvr[n_agree:40] += away * [0.5, 1.0, 0.5]
    T, _ = follow(points, uvr, np.arange(240) < 40)
    assert pose_difference(T, expected) < 1e-6


def test_trusted_landmarks_do_not_decide_against_more_confirmed_ones():
    """The landmarks nearby agree with another pose than those farther away, which are more."""
    points, uvr = seen_from((TRUTH, 20.0, 300), (OBJECT, 20.0, 40))
    trusted = np.arange(340) >= 300
    T, _ = follow(points, uvr, trusted)
    assert pose_difference(T, OBJECT) < 1e-6
    weight, confirmed = np.ones(340), np.ones(340, np.bool_)
    T, inlier = optimise_pose(
        TRUTH, points, uvr, weight, CAMERA.intrinsics, trusted=trusted, confirmed=confirmed
    )
    assert pose_difference(T, TRUTH) < 1e-6
    np.testing.assert_array_equal(inlier, ~trusted)


@pytest.mark.parametrize(("n_far", "expected"), [(70, OBJECT), (69, TRUTH)])
def test_a_pose_with_which_most_trusted_landmarks_agree_is_kept(n_far, expected):
    """Landmarks that are 4 km away agree with both poses."""
    points, uvr = seen_from((TRUTH, 4000.0, n_far), (TRUTH, 20.0, 100 - n_far), (OBJECT, 20.0, 200))
    T, _ = follow(points, uvr, np.arange(300) < 100)
    assert pose_difference(T, expected) < 0.02
