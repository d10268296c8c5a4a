"""The common offset of all disparities is estimated from the motion of the camera."""

from __future__ import annotations

import numpy as np
import pytest
from stereo_noise import white_noise

from vslam.backend.bundle_adjustment import BundleProblem
from vslam.backend.disparity_offset import VARIANCE, found_offset, remaining_offset, trimmed
from vslam.config import StereoConfig
from vslam.types.camera import Camera
from vslam.types.features import MIN_DISPARITY, shifted_columns
from vslam.types.map import Scalars

CAMERA = Camera(700.0, 700.0, 600.0, 180.0, 0.54, 1200, 370)
N_CAMERAS = 8


def drive(offset: float, speed: float = 1.1, noise: float = 0.0, seed: int = 0) -> BundleProblem:
    """Simulate a car that moves ahead along a street.

    All disparities of its stereo pair are ``offset`` px too small. The depths of the map come from
    the wrong disparities of one frame.
    """
    rng = np.random.default_rng(seed)
    points = np.column_stack(
        [rng.uniform(-12, 12, 400), rng.uniform(-4, 1.6, 400), rng.uniform(16, 70, 400)]
    )
    T_cw = np.tile(np.eye(4), (N_CAMERAS, 1, 1))
    T_cw[:, 2, 3] = -speed * np.arange(N_CAMERAS)
    in_camera = points[:, None] + T_cw[None, :, :3, 3]
    uvr = CAMERA.project(in_camera.reshape(-1, 3))
    uvr[:, 2] += offset
    uvr += noise * white_noise(rng, np.ones(len(uvr), bool))
    seen = uvr[::N_CAMERAS].copy()
    first = CAMERA.backproject(seen[:, :2], CAMERA.bf / np.maximum(seen[:, 0] - seen[:, 2], 0.5))
    order = np.r_[1:N_CAMERAS, 0]  # the first camera is fixed, so that it comes last
    return BundleProblem(
        T_cw=T_cw[order],
        n_free=N_CAMERAS - 1,
        points=first,
        first=np.arange(0, len(uvr) + 1, N_CAMERAS, dtype=np.int64),
        camera=np.tile(np.argsort(order), len(points)).astype(np.int64),
        uvr=uvr,
        inverse_sigma2=np.ones(len(uvr)),
        intrinsics=CAMERA.intrinsics,
    )


@pytest.mark.parametrize("offset", [-0.3, -0.05, 0.0, 0.12, 0.4])
def test_a_drive_tells_what_the_pair_sees_too_little(offset: float) -> None:
    problem = drive(offset)
    found, information = remaining_offset(problem)
    assert information > 100.0
    # The remaining error grows with the square of the offset. The next window corrects it.
    assert found == pytest.approx(offset, rel=0.03, abs=0.001)
    problem.uvr[:, 2] -= found
    assert found + remaining_offset(problem)[0] == pytest.approx(offset, abs=0.002)


def test_with_noise_the_error_is_of_the_size_that_the_information_says() -> None:
    errors = []
    for seed in range(12):
        found, information = remaining_offset(drive(0.15, noise=1.0, seed=seed))
        errors.append((found - 0.15) * np.sqrt(information))
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.5


def test_a_standing_camera_tells_nearly_nothing() -> None:
    _, information = remaining_offset(drive(0.2, speed=0.0))
    assert information < 1.0


def test_columns_move_left_but_no_point_gets_behind_the_camera() -> None:
    u = np.array([100.0, 100.0, 100.0], np.float32)
    u_right = np.array([90.0, 99.9, np.nan], np.float32)
    moved = shifted_columns(u_right, u, -0.5)
    np.testing.assert_allclose(moved, [90.5, 100.0 - MIN_DISPARITY, np.nan], atol=1e-5)
    np.testing.assert_allclose(shifted_columns(u_right, u, 0.5), [89.5, 99.4, np.nan], atol=1e-5)


def known_after(found: list[float], information: float) -> Scalars:
    known = Scalars()
    for offset in found:
        known = found_offset(known, offset, information, StereoConfig(offset_sigma=0.2))
    return known


def test_an_offset_within_its_noise_is_not_believed() -> None:
    sigma = np.sqrt(VARIANCE / 5000.0)
    known = known_after([1.5 * sigma], 5000.0)
    assert known.offset_mean == pytest.approx(1.5 * sigma)
    assert 0.0 < known.disparity_offset < 0.6 * known.offset_mean


def test_an_offset_far_above_its_noise_is_added_whole() -> None:
    known = known_after([0.1, 0.12, 0.11], 5000.0)
    assert known.offset_windows == 3
    assert known.disparity_offset == pytest.approx(0.11, rel=0.02)
    assert known.offset_sigma == pytest.approx(np.sqrt(VARIANCE / 15000.0), rel=0.05)


def test_windows_that_contradict_each_other_are_believed_less() -> None:
    together = known_after([0.06, 0.06, 0.06, 0.06], 5000.0)
    apart = known_after([-0.14, 0.26, -0.14, 0.26], 5000.0)
    assert apart.offset_mean == pytest.approx(together.offset_mean)
    assert apart.disparity_offset < 0.5 * together.disparity_offset
    assert apart.offset_sigma > 2.0 * together.offset_sigma


def test_the_mean_and_the_scatter_are_those_of_all_windows() -> None:
    found = [0.02, 0.11, -0.03, 0.07]
    known = Scalars()
    weights = np.array([1000.0, 3000.0, 500.0, 2000.0])
    for offset, information in zip(found, weights, strict=True):
        known = found_offset(known, offset, float(information), StereoConfig())
    mean = np.average(found, weights=weights)
    assert known.offset_mean == pytest.approx(mean)
    assert known.offset_scatter == pytest.approx(np.sum(weights * (found - mean) ** 2))


def test_disparities_of_a_nearer_object_do_not_move_the_offset() -> None:
    problem = drive(0.0, noise=0.3, seed=3)
    rng = np.random.default_rng(1)
    skewed = rng.uniform(size=len(problem.uvr)) < 0.25
    problem.uvr[skewed, 2] -= rng.uniform(0.3, 1.0, skewed.sum())  # too large a disparity
    found, _ = remaining_offset(problem)
    kept = np.isfinite(trimmed(problem).uvr[:, 2])
    assert kept[~skewed].mean() > kept[skewed].mean() + 0.2
    assert abs(found) < 0.05
