"""The chi-square test and the residual, compared with NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from stereo_noise import WHITENING, white_noise

from vslam.support.kernels import kernel
from vslam.types.camera import Camera
from vslam.types.reprojection import (
    CHI2_MONO,
    CHI2_STEREO,
    chi_square,
    chi_square_ratio,
    residual,
    stack_uvr,
    unpacked,
)

CAMERA = Camera(700.0, 710.0, 320.0, 120.0, 0.5, 640, 240)


@kernel
def errors_of(points, uvr, inverse_sigma2, intrinsics):
    """Return the ratio, the residual, its chi-square and the limit for each observation."""
    n = len(points)
    ratio, r, chi2, limit = np.empty(n), np.empty((n, 3)), np.empty(n), np.empty(n)
    pinhole = unpacked(intrinsics)
    for i in range(n):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        u, v, u_right = uvr[i, 0], uvr[i, 1], uvr[i, 2]
        ratio[i] = chi_square_ratio(x, y, z, u, v, u_right, inverse_sigma2[i], pinhole)
        r[i, 0], r[i, 1], r[i, 2], stereo = residual(x, y, z, u, v, u_right, pinhole)
        chi2[i], limit[i] = chi_square(r[i, 0], r[i, 1], r[i, 2], stereo, inverse_sigma2[i])
    return ratio, r, chi2, limit


@pytest.mark.parametrize("mono", [False, True])
def test_residual_and_test_are_those_of_the_camera(mono):
    rng = np.random.default_rng(0)
    points = rng.uniform([-5, -2, 4], [5, 2, 30], (200, 3))
    noise = rng.normal(0, 2.0, (200, 3))
    uvr = CAMERA.project(points) + noise
    if mono:
        uvr[:, 2] = np.nan
        noise[:, 2] = 0.0
    weight = rng.uniform(0.2, 1.0, 200)
    ratio, r, chi2, limit = errors_of(points, uvr, weight, CAMERA.intrinsics)
    expected = noise.copy()
    if not mono:
        expected = noise @ WHITENING.T
    np.testing.assert_allclose(r, expected, atol=1e-9)
    np.testing.assert_allclose(chi2, weight * (expected**2).sum(axis=1), rtol=1e-9)
    assert set(limit) == {CHI2_MONO if mono else CHI2_STEREO}
    np.testing.assert_allclose(ratio, chi2 / limit, rtol=1e-9)
    assert 0.02 < np.mean(ratio <= 1.0) < 0.9


def test_the_limits_hold_19_of_20_true_observations():
    rng = np.random.default_rng(1)
    points = np.tile([1.0, 0.5, 10.0], (20000, 1))
    for columns in (3, 2):
        noise = white_noise(rng, np.full(len(points), columns == 3))
        uvr = CAMERA.project(points) + noise
        uvr[:, columns:] = np.nan
        ratio, *_ = errors_of(points, uvr, np.ones(20000), CAMERA.intrinsics)
        assert np.mean(ratio <= 1.0) == pytest.approx(0.95, abs=0.005)


def test_observations_are_rows_of_float64():
    xy = np.array([[1.5, 2.5]], np.float32)
    uvr = stack_uvr(xy, np.array([np.nan], np.float32))
    assert uvr.dtype == np.float64
    np.testing.assert_array_equal(uvr, [[1.5, 2.5, np.nan]])
