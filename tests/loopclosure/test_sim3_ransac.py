"""RANSAC on the landmarks of two cameras: exact fits, outliers, and degenerate sets."""

from __future__ import annotations

import numpy as np
import pytest
from stereo_noise import white_noise

from vslam.loopclosure.sim3_ransac import (
    ObservedPoints,
    align,
    fit_motion,
    is_degenerate,
    refine_motion,
)
from vslam.support.ransac import draw_three, draws_needed, random_index
from vslam.types.camera import Camera
from vslam.types.geometry import inverse, se3_exp, se3_log, symmetric_eigen, transform

CAMERA = Camera(718.0, 718.0, 607.0, 185.0, 0.54, 1241, 376)
NOISE = 0.7  # pixels
SETTINGS = {"min_inliers": 15, "max_draws": 600, "confidence": 0.99}


def scene(seed: int, n: int, outliers: float, scale: float = 1.0, noise: float = NOISE):
    """Make ``T_a_b``, observations of n landmarks from a and b, and a mask of the wrong matches.

    Along the line of sight, the uncertainty of a landmark corresponds to 0.1 px of disparity.
    """
    rng = np.random.default_rng(seed)
    T = se3_exp(np.r_[rng.normal(size=3) * [1.0, 0.2, 1.0], 0.15 * rng.normal(size=3)])
    xy = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (n, 2))
    in_a = CAMERA.backproject(xy, rng.uniform(7, 40, n))
    in_b = transform(inverse(T), in_a)
    views = []
    for p in (in_a, in_b):
        uvr = CAMERA.project(p) + noise * white_noise(rng, np.ones(n, bool))
        depth_error = 1 + p[:, 2:] / CAMERA.bf * (0.1 if noise else 0.0) * rng.normal(size=(n, 1))
        views.append((p * depth_error, uvr))
    wrong = rng.permutation(n)[: round(outliers * n)]
    other = np.roll(wrong, 1)
    (p_a, uvr_a), (p_b, uvr_b) = views
    p_b[wrong], uvr_b[wrong] = p_b[other], uvr_b[other]
    sigma = np.full(n, max(noise, 1e-3) ** -2)
    T[:3, 3] *= scale
    return T, ObservedPoints(p_a * scale, uvr_a, sigma), ObservedPoints(p_b, uvr_b, sigma), wrong


def errors(T: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    twist = se3_log(T @ inverse(truth))
    return float(np.linalg.norm(twist[:3])), float(np.degrees(np.linalg.norm(twist[3:])))


def test_eigenvalues_agree_with_numpy():
    rng = np.random.default_rng(0)
    for n in (3, 4):
        for _ in range(50):
            A = rng.normal(size=(n, n))
            A = A + A.T
            values, vectors = symmetric_eigen(A)
            np.testing.assert_allclose(np.sort(values), np.linalg.eigvalsh(A), atol=1e-12)
            np.testing.assert_allclose(vectors @ np.diag(values) @ vectors.T, A, atol=1e-12)
            np.testing.assert_allclose(vectors.T @ vectors, np.eye(n), atol=1e-13)
    values, _ = symmetric_eigen(np.diag([2.0, 2.0, 5.0]))
    assert sorted(values) == [2.0, 2.0, 5.0]
    np.testing.assert_array_equal(symmetric_eigen(np.zeros((3, 3)))[0], np.zeros(3))


@pytest.mark.parametrize("scale", [1.0, 0.3, 4.0])
def test_the_fit_is_exact_without_noise(scale):
    rng = np.random.default_rng(1)
    for n in (3, 10):
        for _ in range(50):
            T = se3_exp(rng.normal(size=6) * 1.5)
            p_b = rng.normal(size=(n, 3)) * 5
            p_a = scale * p_b @ T[:3, :3].T + T[:3, 3]
            fitted, s = fit_motion(p_a, p_b, np.ones(n), False)
            np.testing.assert_allclose(fitted, T, atol=1e-9)
            assert s == pytest.approx(scale, rel=1e-9)
            if scale == 1.0:
                np.testing.assert_allclose(fit_motion(p_a, p_b, np.ones(n), True)[0], T, atol=1e-9)


def test_the_fit_of_a_mirrored_set_is_still_a_rotation():
    p = np.random.default_rng(2).normal(size=(8, 3))
    T, _ = fit_motion(p * [1, 1, -1], p, np.ones(8), True)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_points_of_weight_zero_do_not_count():
    p = np.random.default_rng(3).normal(size=(8, 3))
    moved = p + np.array([1.0, 2.0, 3.0])
    moved[5:] += 100.0
    weights = np.array([1.0] * 5 + [0.0] * 3)
    np.testing.assert_allclose(fit_motion(moved, p, weights, True)[0][:3, 3], [1, 2, 3])


def test_seventy_percent_of_outliers():
    # Of 100 matches, 30 are right. Noise of 0.7 px makes one in ten of them an outlier in each
    # camera, so that about 25 are left.
    metres, degrees = [], []
    for seed in range(100):
        T, a, b, wrong = scene(seed, 100, 0.7)
        found = align(a, b, CAMERA.intrinsics, seed=seed, **SETTINGS)
        assert found is not None, seed
        error = errors(found.T_a_b, T)
        metres.append(error[0])
        degrees.append(error[1])
        assert np.count_nonzero(found.inlier[wrong]) <= 2
        assert np.count_nonzero(found.inlier) >= 15
    assert np.median(metres) < 0.012
    assert max(metres) < 0.06
    assert np.median(degrees) < 0.04
    assert max(degrees) < 0.15


@pytest.mark.parametrize(("n", "outliers"), [(100, 0.5), (200, 0.7)])
def test_scale_is_found_from_monocular_maps(n, outliers):
    for seed in range(20):
        T, a, b, wrong = scene(seed, n, outliers, scale=2.5, noise=0.3)
        mono = [s._replace(uvr=np.column_stack([s.uvr[:, :2], np.full(n, np.nan)])) for s in (a, b)]
        found = align(*mono, CAMERA.intrinsics, seed=seed, fix_scale=False, **SETTINGS)
        assert found is not None, seed
        assert found.scale == pytest.approx(2.5, rel=0.025)
        assert np.count_nonzero(found.inlier[wrong]) == 0
        assert errors(found.T_a_b, T)[1] < 0.2
        assert align(a, b, CAMERA.intrinsics, seed=seed, **SETTINGS) is None  # not rigid


def test_a_refinement_does_not_change_the_initial_motion():
    _, a, b, _ = scene(0, 40, 0.0, scale=2.5)
    T, scale = fit_motion(a.points, b.points, np.ones(40), False)
    before = T.copy()
    _, refined = refine_motion(T, scale, a, b, np.arange(40), CAMERA.intrinsics, 5, False)
    assert refined != scale
    np.testing.assert_array_equal(T, before)


def test_chance_matches_have_no_consensus():
    for seed in range(20):
        _, a, b, _ = scene(seed, 80, 1.0)
        assert align(a, b, CAMERA.intrinsics, seed=seed, **SETTINGS) is None


def test_the_same_seed_gives_the_same_bits():
    _, a, b, _ = scene(5, 100, 0.6)
    first, again = (align(a, b, CAMERA.intrinsics, seed=9, **SETTINGS) for _ in range(2))
    assert first.T_a_b.tobytes() == again.T_a_b.tobytes()
    np.testing.assert_array_equal(first.inlier, again.inlier)


@pytest.mark.parametrize("kind", ["line", "point", "two", "none"])
def test_degenerate_sets_are_refused(kind):
    T, a, b, _ = scene(0, 30, 0.0, noise=0.0)
    points = a.points.copy()
    along = np.linspace(0, 1, 30)[:, None]
    if kind == "line":
        points = [0.0, 0.0, 10.0] + along * [3.0, 1.0, 4.0]
    elif kind == "point":
        points[:] = [1.0, 1.0, 12.0]
    few = slice(0, {"two": 2, "none": 0}.get(kind, 30))
    in_b = transform(inverse(T), points)
    a = ObservedPoints(points[few], CAMERA.project(points)[few], a.inverse_sigma2[few])
    b = ObservedPoints(in_b[few], CAMERA.project(in_b)[few], b.inverse_sigma2[few])
    assert align(a, b, CAMERA.intrinsics, seed=0, **SETTINGS) is None


def test_flat_triangles_are_degenerate():
    flat = np.array([[0.0, 0, 5], [4, 0, 5], [2, 0.1, 5]])
    good = np.array([[0.0, 0, 5], [4, 0, 5], [2, 1.0, 5]])
    assert is_degenerate(flat)
    assert not is_degenerate(good)
    assert is_degenerate(np.ones((3, 3)))


def test_draws_are_different_and_even():
    state = np.array([7], np.uint64)
    counts = np.zeros(5)
    for _ in range(3000):
        drawn = draw_three(state, 5)
        assert len(set(drawn)) == 3
        counts[list(drawn)] += 1
    np.testing.assert_allclose(counts / 9000, 0.2, atol=0.02)
    assert {draw_three(state, 3) for _ in range(200)} == {
        (i, j, k) for i in range(3) for j in range(3) for k in range(3) if len({i, j, k}) == 3
    }
    assert {random_index(state, 2) for _ in range(50)} == {0, 1}


def test_draws_needed_is_the_textbook_number():
    # log(1 - 0.99) / log(1 - 0.5^3) = 34.5
    assert draws_needed(0.5, 0.99, 1000) == 35
    assert draws_needed(1.0, 0.99, 1000) == 1
    assert draws_needed(0.0, 0.99, 1000) == 1000
    assert draws_needed(1e-9, 0.99, 1000) == 1000
