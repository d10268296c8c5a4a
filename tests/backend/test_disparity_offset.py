"""The common offset of all disparities is estimated from the motion of the camera."""

from __future__ import annotations

import numpy as np
import pytest
from stereo_noise import white_noise

from vslam.backend.bundle_adjustment import BundleProblem
from vslam.backend.disparity_offset import VARIANCE, offset_sigma, remaining_offset
from vslam.config import StereoConfig
from vslam.types.camera import Camera
from vslam.types.features import MIN_DISPARITY, shifted_columns

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


def test_the_error_of_the_estimate_shrinks_with_the_information() -> None:
    config = StereoConfig(offset_sigma=0.2)

    def sigma(information: float) -> float:
        return offset_sigma(information, config)

    assert sigma(0.0) == 0.0  # nothing has been estimated yet
    assert sigma(1e4) == pytest.approx(np.sqrt(VARIANCE) * 0.01, rel=0.01)
    assert sigma(4e4) == pytest.approx(0.5 * sigma(1e4), rel=0.01)
    free = StereoConfig(offset_sigma=0.0)  # for a loaded map, whose offset is kept
    assert offset_sigma(1e4, free) == pytest.approx(np.sqrt(VARIANCE) * 0.01)
