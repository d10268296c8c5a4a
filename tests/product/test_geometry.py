"""SE(3) algebra, compared with scipy over all angles. Rotations stay orthogonal."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from vslam.types.geometry import (
    compose,
    inverse,
    inverses,
    orthonormalised,
    se3_exp,
    se3_log,
    transform,
)

ANGLES = [0.0, 1e-12, 1e-8, 1e-6, 9e-6, 1.1e-5, 9e-5, 1.1e-4, 1e-2, 1.0, 2.5, 3.1]


def twists(angle: float, n: int = 20, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(n, 3))
    axis *= angle / np.linalg.norm(axis, axis=1, keepdims=True)
    return np.hstack([rng.uniform(-2, 2, (n, 3)), axis])


def hat(twist: np.ndarray) -> np.ndarray:
    v, w = twist[:3], twist[3:]
    return np.array(
        [[0, -w[2], w[1], v[0]], [w[2], 0, -w[0], v[1]], [-w[1], w[0], 0, v[2]], [0, 0, 0, 0]]
    )


def random_poses(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([se3_exp(rng.normal(size=6)) for _ in range(n)])


def rotation_error(T: np.ndarray) -> float:
    R = T[:3, :3]
    return float(np.abs(R @ R.T - np.eye(3)).max())


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(angle):
    for twist in twists(angle):
        np.testing.assert_allclose(se3_exp(twist), expm(hat(twist)), rtol=0, atol=5e-11)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp(angle):
    for twist in twists(angle):
        np.testing.assert_allclose(se3_log(se3_exp(twist)), twist, rtol=0, atol=5e-11)


@pytest.mark.parametrize("gap", [1e-2, 1e-4, 1e-6])
def test_log_undoes_exp_up_to_180_degrees(gap):
    for twist in twists(np.pi - gap):
        np.testing.assert_allclose(se3_log(se3_exp(twist)), twist, rtol=0, atol=1e-14 / gap + 1e-11)


def test_log_of_the_identity_is_zero():
    assert np.array_equal(se3_log(np.eye(4)), np.zeros(6))


def test_compose_is_the_matrix_product():
    for A, B in zip(random_poses(20, 1), random_poses(20, 2), strict=True):
        np.testing.assert_allclose(compose(A, B), A @ B, rtol=0, atol=1e-14)


def test_inverse_is_the_matrix_inverse():
    for T in random_poses(20):
        np.testing.assert_allclose(inverse(T), np.linalg.inv(T), rtol=0, atol=1e-13)


def test_inverses_are_the_matrix_inverses():
    poses = random_poses(20)
    np.testing.assert_allclose(inverses(poses), np.linalg.inv(poses), rtol=0, atol=1e-13)
    assert inverses(poses[:0]).shape == (0, 4, 4)


def test_transform_maps_points_between_frames():
    quarter_turn_about_y = np.array([[0.0, 0, 1, 10], [0, 1, 0, 20], [-1, 0, 0, 30], [0, 0, 0, 1]])
    moved = transform(quarter_turn_about_y, np.array([[1.0, 2, 3], [0, 0, 0]]))
    np.testing.assert_array_equal(moved, [[13, 22, 29], [10, 20, 30]])


def test_orthonormalised_keeps_100000_noisy_compositions_on_so3():
    rng = np.random.default_rng(0)
    steps = [se3_exp(x) for x in 0.05 * rng.normal(size=(100, 6))]
    noise = 1e-9 * rng.normal(size=(100, 4, 4))
    noise[:, 3] = 0
    kept, drifted = np.eye(4), np.eye(4)
    for k in range(100_000):
        step = steps[k % 100] + noise[(7 * k) % 100]
        kept = orthonormalised(compose(step, kept))
        drifted = compose(step, drifted)
    assert rotation_error(kept) < 1e-14
    assert np.linalg.det(kept[:3, :3]) == pytest.approx(1.0, abs=1e-14)
    assert rotation_error(drifted) > 1e-7  # the noise was strong enough to matter


def test_orthonormalised_moves_to_the_nearest_rotation():
    rng = np.random.default_rng(1)
    for T in random_poses(20):
        noisy = T.copy()
        noisy[:3, :3] += 1e-5 * rng.normal(size=(3, 3))
        U, _, Vt = np.linalg.svd(noisy[:3, :3])
        np.testing.assert_allclose(orthonormalised(noisy)[:3, :3], U @ Vt, rtol=0, atol=1e-8)
        np.testing.assert_array_equal(orthonormalised(noisy)[:3, 3], T[:3, 3])
