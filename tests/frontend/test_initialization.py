"""The choice of homography or fundamental matrix, and the resulting motion."""

from __future__ import annotations

import numpy as np
import pytest

from vslam.config import InitializationConfig
from vslam.frontend.initialization import (
    fit_models,
    motions_of_essential,
    motions_of_homography,
    reconstruct,
    refined_motion,
    sampson_errors,
)
from vslam.types.camera import Camera
from vslam.types.geometry import inverse, se3_exp, transform

CAMERA = Camera(500.0, 500.0, 320.0, 240.0, 0.0, 640, 480)
CONFIG = InitializationConfig()
ASIDE = se3_exp(np.array([-0.8, 0.05, 0.1, 0.01, -0.05, 0.02]))
AHEAD = se3_exp(np.array([0.05, 0.0, -1.5, 0.01, 0.04, -0.01]))


def scene(kind: str, n: int = 300, seed: int = 0) -> np.ndarray:
    """Return ``(n, 3)`` points in a volume, on a slanted wall, or on the floor."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform([-4.0, -3.0], [4.0, 3.0], (n, 2))
    if kind == "wall":
        return np.column_stack([xy, 9.0 + 0.3 * xy[:, 0] - 0.2 * xy[:, 1]])
    z = rng.uniform(6.0, 14.0, n)
    if kind == "floor":
        return np.column_stack([xy[:, 0], np.full(n, 1.5), rng.uniform(3.0, 12.0, n)])
    return np.column_stack([xy * (z / 9.0)[:, None], z])


def views(points, T_2_1, *, noise=0.5, outliers=0.0, seed=0):
    """Return the ``(N, 2)`` pixels of the points in both views. In the second, some are random."""
    rng = np.random.default_rng(seed)
    seen = [CAMERA.project(p)[:, :2] for p in (points, transform(T_2_1, points))]
    xy_1, xy_2 = (xy + rng.normal(0, noise, xy.shape) for xy in seen)
    wrong = rng.random(len(points)) < outliers
    xy_2[wrong] = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (wrong.sum(), 2))
    return xy_1, xy_2, ~wrong


def angle_deg(a, b):
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def turn_deg(R_a, R_b):
    return np.degrees(np.arccos(np.clip((np.trace(R_a.T @ R_b) - 1) / 2, -1, 1)))


@pytest.mark.parametrize("outliers", [0.0, 0.4])
@pytest.mark.parametrize("motion", [ASIDE, AHEAD])
@pytest.mark.parametrize(("kind", "model"), [("wall", 0), ("volume", 1)])
def test_a_model_explains_the_scene(kind, model, motion, outliers):
    """A homography explains a wall, and a fundamental matrix a volume."""
    xy_1, xy_2, right = views(scene(kind), motion, outliers=outliers)
    found = fit_models(xy_1, xy_2, np.ones(len(xy_1)), seed=1)[model]
    assert found.kind == ("homography", "fundamental")[model]
    assert np.count_nonzero(found.inlier & right) > 0.85 * np.count_nonzero(right)
    if outliers:
        assert np.count_nonzero(found.inlier & ~right) < 0.2 * np.count_nonzero(~right)


def test_a_camera_that_only_turns_makes_a_homography_and_no_map():
    turn = se3_exp(np.array([0.0, 0.0, 0.0, 0.02, 0.1, 0.01]))
    xy_1, xy_2, _ = views(scene("volume"), turn)
    assert reconstruct(xy_1, xy_2, np.ones(len(xy_1)), CAMERA, CONFIG, seed=1) is None


@pytest.mark.parametrize("T", [ASIDE, AHEAD])
def test_an_essential_matrix_gives_its_motion_back(T):
    t = T[:3, 3] / np.linalg.norm(T[:3, 3])
    E = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ T[:3, :3]
    found = motions_of_essential(-3.0 * E)
    assert len(found) == 4
    assert all(abs(np.linalg.det(M[:3, :3]) - 1) < 1e-9 for M in found)
    errors = [max(turn_deg(M[:3, :3], T[:3, :3]), angle_deg(M[:3, 3], t)) for M in found]
    assert sorted(errors)[0] < 1e-5
    assert sorted(errors)[1] > 1.0  # the three other solutions are wrong


@pytest.mark.parametrize("T", [ASIDE, AHEAD])
def test_a_homography_gives_its_motion_back(T):
    normal, distance = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0]), 8.0
    A = T[:3, :3] + np.outer(T[:3, 3], normal) / distance
    found = motions_of_homography(2.0 * A)
    assert len(found) == 8
    assert all(abs(np.linalg.det(M[:3, :3]) - 1) < 1e-9 for M in found)
    errors = [max(turn_deg(M[:3, :3], T[:3, :3]), angle_deg(M[:3, 3], T[:3, 3])) for M in found]
    assert min(errors) < 1e-5
    assert motions_of_homography(T[:3, :3]) == []


@pytest.mark.parametrize("motion", [ASIDE, AHEAD])
def test_motion_and_points_of_a_volume_with_wrong_matches(motion):
    points = scene("volume", 400)
    xy_1, xy_2, right = views(points, motion, outliers=0.3)
    found = reconstruct(xy_1, xy_2, np.ones(len(xy_1)), CAMERA, CONFIG, seed=1)
    assert found is not None
    assert turn_deg(found.T_2_1[:3, :3], motion[:3, :3]) < 0.5
    assert angle_deg(found.T_2_1[:3, 3], motion[:3, 3]) < 3.0
    assert np.linalg.norm(found.T_2_1[:3, 3]) == pytest.approx(1.0)
    assert len(found.match) > 0.6 * np.count_nonzero(right)
    scale = np.linalg.norm(motion[:3, 3])
    true = np.isin(found.match, np.flatnonzero(right))
    error = np.abs(scale * found.points[true, 2] / points[found.match[true], 2] - 1)
    assert np.median(error) < 0.06


def test_a_wall_leaves_two_motions_and_none_is_taken():
    far_aside = se3_exp(np.array([-2.5, 0.1, 0.5, 0.01, -0.2, 0.02]))
    xy_1, xy_2, _ = views(scene("wall", 400), far_aside, noise=0.2, outliers=0.2)
    assert reconstruct(xy_1, xy_2, np.ones(400), CAMERA, CONFIG, seed=1) is None


def test_motion_along_a_floor():
    """A plane allows a second motion, which would put half of the floor behind the camera."""
    aside = se3_exp(np.array([-1.0, 0.0, 0.1, 0.0, 0.1, 0.0]))
    points = scene("floor", 400)
    xy_1, xy_2, right = views(points, aside, noise=0.2, outliers=0.2)
    found = reconstruct(xy_1, xy_2, np.ones(400), CAMERA, CONFIG, seed=1)
    assert found is not None
    assert turn_deg(found.T_2_1[:3, :3], aside[:3, :3]) < 0.2
    assert angle_deg(found.T_2_1[:3, 3], aside[:3, 3]) < 1.0
    assert len(found.match) > 0.95 * np.count_nonzero(right)


def test_too_little_parallax_is_no_start():
    still = se3_exp(np.array([-0.02, 0.0, 0.0, 0.0, 0.01, 0.0]))
    xy_1, xy_2, _ = views(scene("volume"), still, noise=0.3)
    assert reconstruct(xy_1, xy_2, np.ones(len(xy_1)), CAMERA, CONFIG, seed=1) is None


def test_noise_alone_is_no_start():
    rng = np.random.default_rng(3)
    xy_1, xy_2 = rng.uniform([0, 0], [640, 480], (2, 300, 2))
    assert reconstruct(xy_1, xy_2, np.ones(300), CAMERA, CONFIG, seed=1) is None


def test_seven_matches_are_no_start():
    xy_1, xy_2, _ = views(scene("volume", 7), ASIDE)
    assert reconstruct(xy_1, xy_2, np.ones(7), CAMERA, CONFIG, seed=1) is None


def test_the_same_seed_gives_the_same_bytes():
    xy_1, xy_2, _ = views(scene("volume"), ASIDE, outliers=0.4)
    one, two = (
        reconstruct(xy_1, xy_2, np.ones(len(xy_1)), CAMERA, CONFIG, seed=5) for _ in range(2)
    )
    assert one is not None
    assert one.points.tobytes() == two.points.tobytes()
    assert inverse(one.T_2_1).tobytes() == inverse(two.T_2_1).tobytes()


# -- refinement -----------------------------------------------------------------------------------


@pytest.mark.parametrize("motion", [ASIDE, AHEAD])
def test_a_motion_is_refined_on_the_sampson_error(motion):
    xy_1, xy_2, _ = views(scene("volume", 400), motion, noise=0.05)
    xy_2[:20] += 8.0
    start = se3_exp(np.array([0.0, 0.0, 0.0, 0.004, -0.005, 0.004])) @ motion
    start[:3, 3] += 0.1 * np.linalg.norm(start[:3, 3])
    found = refined_motion(start, xy_1, xy_2, np.ones(400), CAMERA)
    assert turn_deg(found[:3, :3], motion[:3, :3]) < 0.04
    assert angle_deg(found[:3, 3], motion[:3, 3]) < 0.1
    assert np.linalg.norm(found[:3, 3]) == pytest.approx(1.0)


def test_sampson_errors_are_distances_in_pixels():
    """A point that is moved across its epipolar line errs by this distance, shared between views
    of the same scale."""
    xy_1, xy_2, _ = views(scene("volume"), ASIDE, noise=0.0)
    np.testing.assert_allclose(sampson_errors(ASIDE, xy_1, xy_2, CAMERA), 0.0, atol=1e-9)
    errors = sampson_errors(ASIDE, xy_1, xy_2 + np.array([0.0, 1.0]), CAMERA)
    np.testing.assert_allclose(np.abs(errors), np.sqrt(0.5), rtol=0.05)


def test_aligned_matches_tell_the_two_motions_of_a_wall_apart():
    """Positions err by half a pixel, and by 0.02 pixels after alignment."""
    aside = se3_exp(np.array([-1.5, 0.1, 0.5, 0.01, -0.15, 0.02]))
    points = scene("wall", 400) + np.random.default_rng(5).normal(0, 0.02, (400, 3))
    exact_1, exact_2, _ = views(points, aside, noise=0.0)
    rng = np.random.default_rng(1)
    xy_2 = exact_2 + rng.normal(0, 0.5, exact_2.shape)
    aligned = exact_2 + rng.normal(0, 0.02, exact_2.shape) - xy_2
    ones = np.ones(400)
    assert reconstruct(exact_1, xy_2, ones, CAMERA, CONFIG, seed=1) is None
    found = reconstruct(
        exact_1, xy_2, ones, CAMERA, CONFIG, seed=1, align=lambda T, match, points: aligned[match]
    )
    assert found is not None
    assert turn_deg(found.T_2_1[:3, :3], aside[:3, :3]) < 0.1
    np.testing.assert_allclose(found.shift, aligned[found.match])
