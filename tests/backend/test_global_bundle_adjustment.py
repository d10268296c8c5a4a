"""Global bundle adjustment is compared with dense optimisation and GTSAM."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from stereo_noise import white_noise
from test_bundle_adjustment import CAMERA, gtsam_graph, make_problem, pose_differences

from vslam.backend.bundle_adjustment import BundleProblem, adjust
from vslam.backend.global_bundle_adjustment import adjust_globally, coupled_cameras
from vslam.types.geometry import inverses, se3_exp, transform


def loop_problem(
    *, n: int = 36, noise: float = 0.5, mono: float = 0.3, seed: int = 0
) -> tuple[BundleProblem, np.ndarray]:
    """Make a problem of cameras on a circle that look outwards at a ring of points.

    Each camera is coupled to its neighbours, and the last camera to the first. Returns a start with
    drift, and the true ``T_cw`` with the fixed camera last.
    """
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(n) / n
    T_wc = np.array([se3_exp(np.array([0, 0, 0, 0, a, 0.0])) for a in angle])
    T_wc[:, :3, 3] = 4.0 * T_wc[:, :3, 2]
    around = rng.uniform(0, 2 * np.pi, 15 * n)
    ring = rng.uniform(12, 25, 15 * n)
    points = np.stack([ring * np.sin(around), rng.uniform(-2, 2, 15 * n), ring * np.cos(around)], 1)
    truth = inverses(T_wc)
    start = truth.copy()
    drift = np.eye(4)
    for k in range(1, n):
        drift = se3_exp(rng.normal(size=6) * [0.04, 0.04, 0.04, 0.006, 0.006, 0.006]) @ drift
        start[k] = drift @ truth[k]
    roll = np.roll(np.arange(n), -1)
    truth, start = truth[roll], start[roll]
    first, camera, uvr = [0], [], []
    for p in points:
        for k in range(n):
            q = transform(truth[k], p[None])
            seen = CAMERA.project(q)[0]
            if q[0, 2] > 1 and (np.abs(seen[:2] - [320, 120]) < [250, 120]).all():
                stereo = rng.random() >= mono
                seen += noise * white_noise(rng, np.array([stereo]))[0]
                if not stereo:
                    seen[2] = np.nan
                camera.append(k)
                uvr.append(seen)
        first.append(len(camera))
    problem = BundleProblem(
        T_cw=start,
        n_free=n - 1,
        points=points + 0.2 * rng.normal(size=points.shape),
        first=np.array(first),
        camera=np.array(camera),
        uvr=np.array(uvr),
        inverse_sigma2=np.ones(len(camera)),
        intrinsics=CAMERA.intrinsics,
    )
    return problem, truth


def test_the_ring_is_sparse_and_closed():
    problem, _ = loop_problem()
    pairs = coupled_cameras(problem.first, problem.camera, problem.n_free)
    n = problem.n_free
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert len(np.unique(pairs, axis=0)) == len(pairs) < 0.45 * n * (n - 1) / 2
    assert (pairs[:, 1] - pairs[:, 0] > n - 4).any()


@pytest.mark.parametrize("n_free", [0, 1, 5, 30])
def test_coupled_cameras_are_those_with_a_common_point(n_free):
    rng = np.random.default_rng(n_free)
    seen = [rng.permutation(n_free + 3)[: rng.integers(1, 5)] for _ in range(60)]
    first = np.concatenate([[0], np.cumsum([len(cameras) for cameras in seen])])
    camera = np.concatenate(seen).astype(np.int64)
    expected = set()
    for p in range(len(seen)):
        cameras = [int(camera[o]) for o in range(first[p], first[p + 1])]
        expected |= {(i, j) for i in cameras for j in cameras if i < j < n_free}
    pairs = coupled_cameras(first, camera, n_free)
    assert list(map(tuple, pairs.tolist())) == sorted(expected)


@pytest.mark.parametrize("seed", range(3))
def test_same_optimum_as_the_dense_one(seed):
    problem, truth = loop_problem(seed=seed)
    dense = adjust(problem, iterations=40, tolerance=1e-13)
    ours = adjust_globally(problem, iterations=40, tolerance=1e-13)
    assert ours.cost == pytest.approx(dense.cost, rel=1e-9)
    assert pose_differences(ours.T_cw, dense.T_cw).max() < 1e-6
    np.testing.assert_array_equal(ours.inlier, dense.inlier)
    # Half a standard deviation of noise gives errors of a few centimetres.
    before, after = pose_differences(problem.T_cw, truth), pose_differences(ours.T_cw, truth)
    assert after.max() < 0.06 < 0.3 * before.max()
    assert ours.T_cw[-1].tobytes() == problem.T_cw[-1].tobytes()


def test_each_step_is_the_dense_one():
    problem, _, _ = make_problem(noise=0.6, outliers=30)
    for iterations in (0, 1, 3):
        dense = adjust(problem, iterations=iterations, tolerance=0.0)
        ours = adjust_globally(problem, iterations=iterations, tolerance=0.0)
        assert ours.iterations == dense.iterations
        assert ours.cost == pytest.approx(dense.cost, rel=1e-9)
        assert np.abs(ours.T_cw - dense.T_cw).max() < 1e-7
        assert np.abs(ours.points - dense.points).max() < 1e-5
        np.testing.assert_array_equal(ours.inlier, dense.inlier)


def test_same_optimum_as_gtsam_round_the_loop():
    problem, _ = loop_problem(n=30)
    ours = adjust_globally(problem, iterations=100, tolerance=1e-13)
    graph, values = gtsam_graph(problem)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(100)
    parameters.setRelativeErrorTol(1e-13)
    parameters.setAbsoluteErrorTol(1e-13)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    theirs = inverses(np.array([result.atPose3(k).matrix() for k in range(30)]))
    assert ours.cost == pytest.approx(graph.error(result), rel=1e-6)
    assert ours.cost < 0.5 * graph.error(values)
    assert pose_differences(ours.T_cw, theirs).max() < 1e-5


def test_stops_when_told_with_what_it_has():
    problem, _ = loop_problem()
    answers = iter([False, False, True])
    solution = adjust_globally(problem, iterations=50, tolerance=0.0, stop=lambda: next(answers))
    assert solution.iterations == 2
    two = adjust_globally(problem, iterations=2, tolerance=0.0)
    assert solution.T_cw.tobytes() == two.T_cw.tobytes()
    assert solution.points.tobytes() == two.points.tobytes()


def test_nothing_to_do():
    problem, _ = loop_problem()
    empty = replace(
        problem,
        points=np.empty((0, 3)),
        first=np.zeros(1, np.int64),
        camera=np.empty(0, np.int64),
        uvr=np.empty((0, 3)),
        inverse_sigma2=np.empty(0),
    )
    solution = adjust_globally(empty, iterations=5)
    assert (solution.cost, len(solution.inlier)) == (0.0, 0)
    assert np.array_equal(solution.T_cw, problem.T_cw)


def test_all_cameras_held_moves_points_only():
    problem, truth = loop_problem(noise=0.0)
    held = replace(problem, T_cw=truth, n_free=0)
    solution = adjust_globally(held, iterations=30, tolerance=1e-14)
    assert solution.T_cw.tobytes() == truth.tobytes()
    assert solution.cost < 1e-10


def leaning(noise: float = 0.0, sigma: float = 0.004) -> tuple[BundleProblem, np.ndarray]:
    """Make a problem whose right images lean: disparities tell that the world is bent. Each camera
    also senses gravity."""
    problem, truth = loop_problem(noise=0.1, mono=0.0, seed=2)
    rng = np.random.default_rng(3)
    lean = 0.4 * (problem.uvr[:, 1] - 120) / 120 * (problem.camera % 36 < 18)
    gravity = truth[:, :3, :3] @ [0.0, 1.0, 0.0] + noise * rng.normal(size=(len(truth), 3))
    gravity /= np.linalg.norm(gravity, axis=1)[:, None]
    uvr = problem.uvr - np.stack([0 * lean, 0 * lean, lean], axis=1)
    known = np.where(np.arange(len(truth)) % 5, sigma, 0.0)  # not at every fifth camera
    return replace(problem, uvr=uvr, gravity=gravity, gravity_sigma=known), truth


def unevenness(T_cw: np.ndarray, truth: np.ndarray) -> float:
    """Return the RMS angle between the directions of gravity at the cameras, in the estimated
    world, and their mean, in degrees."""
    down = np.einsum("nji,nj->ni", T_cw[:, :3, :3], truth[:, :3, 1])
    mean = down.mean(axis=0) / np.linalg.norm(down.mean(axis=0))
    return float(np.degrees(np.sqrt(np.mean(np.arccos((down @ mean).clip(-1.0, 1.0)) ** 2))))


def test_gravity_keeps_the_map_level():
    problem, truth = leaning(noise=0.001, sigma=0.001)
    without = replace(problem, gravity=None, gravity_sigma=None)
    plain, level = (adjust_globally(one, iterations=40) for one in (without, problem))
    assert unevenness(level.T_cw, truth) < 0.5 * unevenness(plain.T_cw, truth)
    assert np.array_equal(level.T_cw[-1], problem.T_cw[-1])  # the world does not turn


def test_the_optimum_with_gravity_is_that_of_gtsam():
    problem, _ = leaning(noise=0.01)
    ours = adjust_globally(problem, iterations=100, tolerance=1e-13)
    known = np.flatnonzero(problem.gravity_sigma)
    weights, R_cw = problem.gravity_sigma[known] ** -2.0, ours.T_cw[known, :3, :3]
    down = np.einsum("n,nji,nj->i", weights, R_cw, problem.gravity[known])
    graph, start = gtsam_graph(replace(problem, T_cw=ours.T_cw, points=ours.points))
    for k in known.tolist():
        noise = gtsam.noiseModel.Isotropic.Sigma(2, problem.gravity_sigma[k])
        measured = gtsam.Unit3(problem.gravity[k])
        graph.add(gtsam.AttitudeFactorPose3(k, gtsam.Unit3(down), noise, measured))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-13)
    result = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()
    n = len(problem.T_cw)
    theirs = inverses(np.array([result.atPose3(k).matrix() for k in range(n)]))
    assert pose_differences(ours.T_cw, theirs).max() < 1e-4
    without = adjust_globally(replace(problem, gravity=None, gravity_sigma=None), iterations=100)
    assert pose_differences(ours.T_cw, without.T_cw).max() > 1e-3
