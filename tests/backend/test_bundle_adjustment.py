"""Bundle adjustment is compared with GTSAM on the same problem, and tested in difficult cases."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from stereo_noise import WHITENING, white_noise

from vslam.backend.bundle_adjustment import BundleProblem, adjust, cholesky_solve
from vslam.types.camera import Camera
from vslam.types.geometry import se3_exp, se3_log, transform
from vslam.types.reprojection import CHI2_MONO, CHI2_STEREO

CAMERA = Camera(400.0, 410.0, 320.0, 120.0, 0.5, 640, 240)
N_FREE, N_FIXED = 4, 2


def make_problem(
    *, noise: float = 0.0, outliers: int = 0, n_points: int = 150, seed: int = 0
) -> tuple[BundleProblem, np.ndarray, np.ndarray]:
    """Make a perturbed problem with monocular and stereo observations, and its solution."""
    rng = np.random.default_rng(seed)
    n_cameras = N_FREE + N_FIXED
    truth = np.array(
        [
            se3_exp(np.array([0.3 * k, 0.02 * k, -0.7 * k, 0.01 * k, -0.02 * k, 0.005 * k]))
            for k in range(n_cameras)
        ]
    )
    points = rng.uniform([-8, -3, 6], [8, 2, 30], (n_points, 3))
    first, camera, uvr = [0], [], []
    for p in points:
        for k in rng.permutation(n_cameras):
            seen = CAMERA.project(transform(truth[k], p[None]))[0]
            if 0 <= seen[0] < CAMERA.width and 0 <= seen[1] < CAMERA.height:
                if rng.random() < 0.4:
                    seen[2] = np.nan
                camera.append(k)
                uvr.append(seen)
        first.append(len(camera))
    uvr = np.array(uvr)
    sigma = 1.2 ** rng.integers(0, 8, len(uvr))
    uvr += noise * sigma[:, None] * white_noise(rng, ~np.isnan(uvr[:, 2]))
    wrong = rng.permutation(len(uvr))[:outliers]
    uvr[wrong, :2] += rng.choice([-1, 1], (outliers, 2)) * rng.uniform(20, 60, (outliers, 2))
    start = truth.copy()
    for k in range(N_FREE):
        start[k] = se3_exp(0.02 * rng.normal(size=6)) @ start[k]
    problem = BundleProblem(
        T_cw=start,
        n_free=N_FREE,
        points=points + 0.1 * rng.normal(size=points.shape),
        first=np.array(first),
        camera=np.array(camera),
        uvr=uvr,
        inverse_sigma2=sigma**-2.0,
        intrinsics=CAMERA.intrinsics,
    )
    return problem, truth, points


def landmark_of_observation(problem: BundleProblem) -> np.ndarray:
    return np.repeat(np.arange(len(problem.points)), np.diff(problem.first))


def robust_cost(problem: BundleProblem, T_cw: np.ndarray, points: np.ndarray) -> float:
    p = landmark_of_observation(problem)
    T = T_cw[problem.camera]
    in_camera = np.einsum("oij,oj->oi", T[:, :3, :3], points[p]) + T[:, :3, 3]
    error = np.nan_to_num(problem.uvr - CAMERA.project(in_camera))
    stereo = ~np.isnan(problem.uvr[:, 2])
    error[stereo] = error[stereo] @ WHITENING.T
    norm = np.sqrt((error**2).sum(axis=1) * problem.inverse_sigma2)
    k = np.sqrt(np.where(np.isnan(problem.uvr[:, 2]), CHI2_MONO, CHI2_STEREO))
    return float(np.where(norm <= k, 0.5 * norm**2, k * norm - 0.5 * k**2).sum())


def gtsam_graph(problem: BundleProblem):
    """Make the same problem as a factor graph of GTSAM, with the K cameras before the points."""
    mono = gtsam.Cal3_S2(CAMERA.fx, CAMERA.fy, 0.0, CAMERA.cx, CAMERA.cy)
    stereo = gtsam.Cal3_S2Stereo(CAMERA.fx, CAMERA.fy, 0.0, CAMERA.cx, CAMERA.cy, CAMERA.baseline)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    n_cameras = len(problem.T_cw)
    for k, T in enumerate(problem.T_cw):
        pose = gtsam.Pose3(np.linalg.inv(T))
        values.insert(k, pose)
        if k >= problem.n_free:
            graph.add(gtsam.PriorFactorPose3(k, pose, gtsam.noiseModel.Constrained.All(6)))
    for i, p in enumerate(problem.points):
        values.insert(n_cameras + i, p)

    def robust(dimensions: int, limit: float, weight: float):
        huber = gtsam.noiseModel.mEstimator.Huber.Create(np.sqrt(limit))
        if dimensions == 2:
            plain = gtsam.noiseModel.Isotropic.Sigma(dimensions, weight**-0.5)
        else:
            turned = WHITENING[:, [0, 2, 1]]  # GTSAM's order: u, u_right, v
            plain = gtsam.noiseModel.Gaussian.Information(weight * turned.T @ turned)
        return gtsam.noiseModel.Robust.Create(huber, plain)

    owner = landmark_of_observation(problem) + n_cameras
    for (u, v, r), k, p, w in zip(
        problem.uvr, problem.camera, owner, problem.inverse_sigma2, strict=True
    ):
        if np.isnan(r):
            factor = gtsam.GenericProjectionFactorCal3_S2(
                np.array([u, v]), robust(2, CHI2_MONO, w), int(k), int(p), mono
            )
        else:
            factor = gtsam.GenericStereoFactor3D(
                gtsam.StereoPoint2(u, r, v), robust(3, CHI2_STEREO, w), int(k), int(p), stereo
            )
        graph.add(factor)
    return graph, values


def pose_differences(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    return np.array(
        [np.abs(se3_log(a @ np.linalg.inv(b))).max() for a, b in zip(A, B, strict=True)]
    )


def test_cost_is_gtsams_at_the_start():
    problem, _, _ = make_problem(noise=0.6, outliers=30)
    graph, values = gtsam_graph(problem)
    cost = adjust(problem, iterations=0).cost
    assert cost == pytest.approx(robust_cost(problem, problem.T_cw, problem.points), rel=1e-12)
    assert cost == pytest.approx(graph.error(values), rel=1e-9)


def test_same_optimum_as_gtsam_with_outliers():
    problem, truth, true_points = make_problem(noise=0.6, outliers=30)
    ours = adjust(problem, iterations=100, tolerance=1e-12)
    graph, values = gtsam_graph(problem)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(200)
    parameters.setRelativeErrorTol(1e-13)
    parameters.setAbsoluteErrorTol(1e-13)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    n = len(problem.T_cw)
    theirs = np.linalg.inv([result.atPose3(k).matrix() for k in range(n)])
    points = np.array([result.atPoint3(n + i) for i in range(len(problem.points))])
    assert ours.cost == pytest.approx(graph.error(result), rel=1e-6)
    # Even at the true values, nearly all of the cost comes from the outliers.
    assert ours.cost < robust_cost(problem, truth, true_points) < 0.6 * graph.error(values)
    assert pose_differences(ours.T_cw, theirs).max() < 1e-5
    assert np.median(np.linalg.norm(ours.points - points, axis=1)) < 1e-4
    assert pose_differences(ours.T_cw[:N_FREE], truth[:N_FREE]).max() < 0.04


def test_recovers_the_truth_without_noise():
    problem, truth, points = make_problem()
    solution = adjust(problem, iterations=50, tolerance=1e-14)
    assert solution.cost < 1e-10
    assert pose_differences(problem.T_cw[:N_FREE], truth[:N_FREE]).min() > 0.01
    assert pose_differences(solution.T_cw, truth).max() < 1e-6
    views = np.diff(problem.first)
    assert np.abs(solution.points - points)[views >= 3].max() < 1e-4
    assert solution.inlier.all()


def test_fixed_cameras_are_untouched_bit_for_bit_and_free_ones_move():
    problem, _, _ = make_problem(noise=0.6, outliers=20)
    before = problem.T_cw.copy()
    solution = adjust(problem, iterations=10)
    assert solution.T_cw[N_FREE:].tobytes() == before[N_FREE:].tobytes()
    assert pose_differences(solution.T_cw[:N_FREE], before[:N_FREE]).min() > 1e-3
    assert problem.T_cw.tobytes() == before.tobytes()


def test_inliers_are_those_of_the_chi_square_test_at_the_solution():
    problem, _, _ = make_problem(noise=0.6, outliers=30)
    solution = adjust(problem, iterations=50)
    p = landmark_of_observation(problem)
    T = solution.T_cw[problem.camera]
    in_camera = np.einsum("oij,oj->oi", T[:, :3, :3], solution.points[p]) + T[:, :3, 3]
    error = np.nan_to_num(problem.uvr - CAMERA.project(in_camera))
    stereo = ~np.isnan(problem.uvr[:, 2])
    error[stereo] = error[stereo] @ WHITENING.T
    chi2 = (error**2).sum(axis=1) * problem.inverse_sigma2
    limit = np.where(np.isnan(problem.uvr[:, 2]), CHI2_MONO, CHI2_STEREO)
    np.testing.assert_array_equal(solution.inlier, chi2 <= limit)
    assert 10 < np.count_nonzero(~solution.inlier) < 120
    assert solution.cost == pytest.approx(
        robust_cost(problem, solution.T_cw, solution.points), rel=1e-12
    )


def test_observations_out_of_use_have_no_influence():
    problem, truth, _ = make_problem()
    use = np.random.default_rng(0).random(len(problem.camera)) > 0.1
    uvr = problem.uvr.copy()
    uvr[~use, :2] += 300.0
    solution = adjust(replace(problem, uvr=uvr), iterations=50, use=use, tolerance=1e-14)
    assert solution.cost < 1e-10
    assert pose_differences(solution.T_cw, truth).max() < 1e-6
    np.testing.assert_array_equal(solution.inlier, use)


def test_cost_never_rises_with_more_iterations():
    problem, _, _ = make_problem(noise=0.6, outliers=20)
    costs = [adjust(problem, iterations=n, tolerance=0.0).cost for n in range(8)]
    assert (np.diff(costs) <= 0).all()
    assert costs[-1] < 0.5 * costs[0]


def test_stops_when_the_cost_settles():
    problem, _, _ = make_problem(noise=0.6)
    solution = adjust(problem, iterations=100, tolerance=1e-3)
    assert solution.iterations < 10


def test_rotations_stay_rotations():
    problem, _, _ = make_problem(noise=0.6, outliers=30)
    R = adjust(problem, iterations=30).T_cw[:, :3, :3]
    assert np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() < 1e-13


def test_a_point_seen_once_in_mono_does_not_spoil_the_rest():
    problem, truth, _ = make_problem()
    lonely = np.array([[1.0, 0.5, 12.0], [-2.0, -1.0, 9.0]])
    uvr = CAMERA.project(transform(truth[0], lonely))
    uvr[:, 2] = np.nan
    uvr[:, 0] += 3.0
    n = len(problem.camera)
    singular = replace(
        problem,
        points=np.concatenate([problem.points, lonely]),
        first=np.concatenate([problem.first, [n + 1, n + 2]]),
        camera=np.concatenate([problem.camera, [0, N_FREE]]),  # a free and a fixed camera
        uvr=np.concatenate([problem.uvr, uvr]),
        inverse_sigma2=np.concatenate([problem.inverse_sigma2, [1.0, 1.0]]),
    )
    solution = adjust(singular, iterations=50, tolerance=1e-14)
    assert np.isfinite(solution.T_cw).all()
    assert np.isfinite(solution.points).all()
    assert pose_differences(solution.T_cw, truth).max() < 1e-5
    assert solution.cost < 1e-8


def test_without_fixed_cameras_the_free_ones_settle_near_the_start():
    problem, _, _ = make_problem()
    camera = problem.camera
    keep = camera < N_FREE
    counts = np.add.reduceat(keep, problem.first[:-1]) * (np.diff(problem.first) > 0)
    floating = replace(
        problem,
        T_cw=problem.T_cw[:N_FREE],
        first=np.concatenate([[0], np.cumsum(counts)]),
        camera=camera[keep],
        uvr=problem.uvr[keep],
        inverse_sigma2=problem.inverse_sigma2[keep],
    )
    solution = adjust(floating, iterations=50, tolerance=1e-12)
    assert solution.cost < 1e-6
    assert pose_differences(solution.T_cw, floating.T_cw).max() < 0.5


def test_nothing_to_do():
    problem, _, _ = make_problem()
    empty = replace(
        problem,
        points=np.empty((0, 3)),
        first=np.zeros(1, np.int64),
        camera=np.empty(0, np.int64),
        uvr=np.empty((0, 3)),
        inverse_sigma2=np.empty(0),
    )
    solution = adjust(empty, iterations=5)
    assert solution.cost == 0.0
    assert np.array_equal(solution.T_cw, problem.T_cw)


@pytest.mark.parametrize("n", [1, 6, 7, 48, 130])
def test_cholesky_solve_agrees_with_numpy(n):
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n + 5, n))
    S, b = A.T @ A + np.eye(n), rng.normal(size=n)
    expected = np.linalg.solve(S, b)
    upper, x = np.triu(S), b.copy()  # the lower triangle is not read
    assert cholesky_solve(upper, x)
    np.testing.assert_allclose(x, expected, rtol=1e-9, atol=1e-12)


def test_cholesky_solve_of_a_banded_system():
    """The solver tests for blocks of zeros, and skips them."""
    rng = np.random.default_rng(0)
    S = np.zeros((60, 60))
    for k in range(0, 54, 6):
        A = rng.normal(size=(20, 12))
        S[k : k + 12, k : k + 12] += A.T @ A
    b = rng.normal(size=60)
    x = b.copy()
    assert cholesky_solve(S.copy(), x)
    np.testing.assert_allclose(x, np.linalg.solve(S, b), rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("bad", [-1.0, 0.0, np.nan])
def test_cholesky_solve_refuses_what_is_not_positive_definite(bad):
    S = np.diag([1.0, 2.0, bad, 3.0])
    assert not cholesky_solve(S, np.ones(4))
