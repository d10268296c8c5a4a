"""P3P, compared with known poses, and RANSAC with outliers."""

from __future__ import annotations

import numpy as np
import pytest
from stereo_noise import white_noise

from vslam.frontend.pnp import ransac_pose, solve_p3p
from vslam.types.camera import Camera
from vslam.types.geometry import inverse, se3_exp, se3_log, transform

CAMERA = Camera(718.0, 718.0, 607.0, 185.0, 0.54, 1241, 376)


def unit(rays: np.ndarray) -> np.ndarray:
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


@pytest.mark.slow
def test_p3p_finds_the_pose_and_only_poses():
    rng = np.random.default_rng(0)
    poses = np.empty((4, 4, 4))
    worst = 0.0
    for _ in range(3000):
        T = se3_exp(np.r_[5 * rng.normal(size=3), rng.normal(size=3)])
        in_camera = np.c_[rng.uniform(-1, 1, (3, 2)), np.ones(3)] * rng.uniform(2, 40, (3, 1))
        points, rays = transform(inverse(T), in_camera), unit(in_camera)
        n = solve_p3p(points, rays, poses)
        assert 1 <= n <= 4
        worst = max(worst, min(np.abs(pose - T).max() for pose in poses[:n]))
        for pose in poses[:n]:
            np.testing.assert_allclose(unit(transform(pose, points)), rays, atol=1e-6)
            np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert worst < 1e-6


@pytest.mark.parametrize(
    "points", [np.ones((3, 3)), np.outer([1.0, 2.0, 4.0], [1.0, 0.0, 0.0]) + np.array([0, 0, 9])]
)
def test_p3p_refuses_points_on_a_line_and_on_each_other(points):
    assert solve_p3p(points, unit(points + np.array([0, 0.1, 1])), np.empty((4, 4, 4))) == 0


def scene(seed: int, *, n: int = 100, outliers: float = 0.7, mono: bool = False):
    rng = np.random.default_rng(seed)
    T = se3_exp(np.r_[3 * rng.normal(size=3), rng.normal(size=3)])
    xy = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (n, 2))
    in_camera = CAMERA.backproject(xy, rng.uniform(5, 40, n))
    uvr = CAMERA.project(in_camera) + 0.7 * white_noise(rng, np.full(n, not mono))
    if mono:
        uvr[:, 2] = np.nan
    points = transform(inverse(T), in_camera)
    wrong = rng.permutation(n)[: round(outliers * n)]
    points[wrong] = points[np.roll(wrong, 1)]
    return T, points, uvr, np.full(n, 0.7**-2), wrong


@pytest.mark.parametrize(
    ("mono", "median_m", "worst_m", "worst_degrees"),
    [(False, 0.05, 0.4, 0.6), (True, 0.08, 0.6, 0.8)],
)
def test_ransac_finds_the_pose_among_seventy_percent_of_outliers(
    mono, median_m, worst_m, worst_degrees
):
    # The best sample of three points, before refinement.
    metres, degrees = [], []
    for seed in range(100):
        T, points, uvr, weight, wrong = scene(seed, mono=mono)
        found, inlier = ransac_pose(
            points, uvr, weight, CAMERA.intrinsics, np.uint64(seed), 10, 600, 0.99
        )
        twist = se3_log(found @ inverse(T))
        metres.append(np.linalg.norm(twist[:3]))
        degrees.append(np.degrees(np.linalg.norm(twist[3:])))
        assert np.count_nonzero(inlier) >= 15, seed
        assert np.count_nonzero(inlier[wrong]) <= 2, seed
    assert np.median(metres) < median_m
    assert max(metres) < worst_m
    assert max(degrees) < worst_degrees


def test_ransac_gives_few_inliers_where_nothing_fits_and_repeats_itself():
    for seed in range(20):
        _, points, uvr, weight, _ = scene(seed, outliers=1.0)
        runs = [
            ransac_pose(points, uvr, weight, CAMERA.intrinsics, np.uint64(seed), 10, 600, 0.99)
            for _ in range(2)
        ]
        assert np.count_nonzero(runs[0][1]) < 10
        assert runs[0][0].tobytes() == runs[1][0].tobytes()


def test_ransac_of_too_few_points():
    _, points, uvr, weight, _ = scene(0, n=2, outliers=0.0)
    _, inlier = ransac_pose(points, uvr, weight, CAMERA.intrinsics, np.uint64(0), 10, 600, 0.99)
    assert not inlier.any()
