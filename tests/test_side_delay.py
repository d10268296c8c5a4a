"""A right side that is late is told by the rows of stereo matches, and taken out of their
columns."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from vslam.camera import Camera
from vslam.config import Config
from vslam.features import Features
from vslam.frontend.side_delay import EVERY, SideDelay
from vslam.frontend.tracking import TrackingContext, extract_features
from vslam.geometry import se3_exp
from vslam.image_motion import columns_without_delay, rays, row_speeds
from vslam.run.rig import residual_warnings

CAMERA = Camera(300.0, 300.0, 200.0, 100.0, 0.5, 400, 200)
CONFIG = Config().stereo
SCALES = 1.2 ** np.arange(8)


def seen(
    twist: np.ndarray, delay: float, n: int = 200, seed: int = 0, noise: float = 0.1
) -> tuple[Features, np.ndarray]:
    """Points in both images by their exact projections, the right one so much later; and the
    columns there without delay."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(4.0, 40.0, n)
    xy = np.stack([rng.uniform(0, 400, n), rng.uniform(0, 200, n)], axis=1).astype(np.float32)
    x, y = rays(xy, CAMERA)
    points = np.stack([x, y, np.ones(n)], axis=1) * z[:, None]

    def right(T: np.ndarray) -> np.ndarray:
        p = points @ T[:3, :3].T + T[:3, 3] - [CAMERA.baseline, 0.0, 0.0]
        return CAMERA.fx * p[:, :2] / p[:, 2:] + [CAMERA.cx, CAMERA.cy]

    here, later = right(np.eye(4)), right(se3_exp(twist * delay))
    rows = later[:, 1] - xy[:, 1] + noise * rng.normal(size=n)
    features = Features(
        xy=xy,
        octave=np.zeros(n, np.uint8),
        angle=np.zeros(n, np.float32),
        descriptors=np.zeros((n, 32), np.uint8),
        u_right=later[:, 0].astype(np.float32),
        row_offset=rows.astype(np.float32),
    )
    return features, here[:, 0]


def drive(frames: int) -> list[np.ndarray]:
    """Ahead with changing speed, nodding and turning."""
    t = 0.1 * np.arange(frames)
    zero = np.zeros(frames)
    return list(
        np.stack([zero, zero, -8 - 2 * np.sin(t), 0.05 * np.sin(3 * t), 0.2 * np.sin(t), zero], 1)
    )


def learned(delay: float, frames: int = 80, turned: float = 0.0) -> SideDelay:
    found = SideDelay(CAMERA, CONFIG)
    for k, twist in enumerate(drive(frames)):
        features, _ = seen(twist, delay, seed=k)
        assert features.row_offset is not None
        features.row_offset[:] += turned * (0.3 + features.xy[:, 0] / 400)
        found.add(features, twist, SCALES)
    return found


def test_speeds_are_the_derivatives_of_projections():
    for k in range(6):
        twist = np.eye(6)[k]
        features, _ = seen(twist, 1e-5, noise=0.0)
        x, y = rays(features.xy, CAMERA)
        still, columns = seen(twist, 0.0, noise=0.0)
        inverse_depth = (features.xy[:, 0] - columns) / CAMERA.bf
        assert still.row_offset is not None
        assert features.row_offset is not None
        moved = (features.row_offset - still.row_offset) / 1e-5
        expected = CAMERA.fy * row_speeds(x, y, inverse_depth)[:, k]
        assert moved == pytest.approx(expected, abs=2.0)  # pixels a second, of up to 400


@pytest.mark.parametrize("delay", [-8e-3, 3e-3, 12e-3])
def test_a_delay_is_measured_and_its_columns_are_corrected(delay):
    found = learned(delay)
    assert found.seconds == pytest.approx(delay, abs=4 * found.sigma)
    assert 0.0 < found.sigma < 0.3e-3
    assert found.adopt() == found.seconds
    assert found.adopt() == 0.0  # no news
    twist = drive(6)[5]
    features, columns = seen(twist, delay)
    before = np.abs(features.u_right - columns).mean()
    after = np.abs(found.corrected(features, twist).u_right - columns).mean()
    assert before > 0.15
    assert after < 0.15 * before


@pytest.mark.parametrize("turned", [0.0, 1.0])
def test_a_sound_rig_and_one_whose_rows_do_not_correspond_stay_as_they_are(turned):
    found = learned(0.0, turned=turned)
    assert abs(found.seconds) < 0.3e-3
    assert found.adopt() == 0.0
    features, _ = seen(drive(1)[0], 0.0)
    assert found.corrected(features, drive(1)[0]) is features


def test_a_few_frames_are_not_believed():
    assert learned(8e-3, frames=20).adopt() == 0.0


def test_contradicting_frames_are_doubted():
    """A delay in every other group of frames is none of the rig."""
    found = SideDelay(CAMERA, CONFIG)
    for k, twist in enumerate(drive(60)):
        found.add(seen(twist, 6e-3 * (k // 5 % 2), seed=k)[0], twist, SCALES)
    assert found.seconds > CONFIG.least_delay
    assert found.adopt() == 0.0


def test_what_was_learned_can_be_kept():
    one, other = learned(5e-3, frames=43), SideDelay(CAMERA, CONFIG)
    one.adopt()
    other.restore(one.memory())
    assert other.applied == one.applied == one.seconds
    for k, twist in enumerate(drive(30)):
        for each in (one, other):
            each.add(seen(twist, 5e-3, seed=k)[0], twist, SCALES)
    assert other.memory() == one.memory()
    assert (other.seconds, other.sigma) == (one.seconds, one.sigma)
    fresh = SideDelay(CAMERA, CONFIG)
    fresh.restore(())
    assert fresh.memory() == SideDelay(CAMERA, CONFIG).memory()
    with pytest.raises(ValueError, match="damaged"):
        fresh.restore((1.0, 5.0, 0.0, 2.0))


def test_many_frames_take_no_more_memory():
    assert len(learned(0.0, frames=400).memory()) < 16 * 12 * 12 + 1000


def test_matches_without_a_row_offset_teach_nothing():
    found = SideDelay(CAMERA, CONFIG)
    for k, twist in enumerate(drive(60)):
        features, _ = seen(twist, 5e-3, seed=k)
        found.add(features if k % 2 else Features.none(), twist, SCALES)
        found.add(features, None, SCALES)
    assert found.sigma == np.inf


def test_columns_far_away_stay_in_front_of_the_camera():
    xy, u_right = np.array([[200.0, 50.0]], np.float32), np.array([199.9], np.float32)
    twist = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    for delay in (5e-3, -5e-3):
        assert columns_without_delay(xy, u_right, twist, delay, CAMERA)[0] < 200.0
    assert np.isnan(columns_without_delay(xy, u_right * np.nan, twist, 5e-3, CAMERA)[0])


@pytest.mark.parametrize("rows", [-1.3, 0.0, 0.4, 1.6])
def test_rows_are_measured_to_a_fraction_of_a_pixel(rows):
    rough = gaussian_filter(np.random.default_rng(0).normal(size=(200, 420)), 1.5)
    grey = np.clip(110 + 35 * rough / rough.std(), 0, 255)
    left, right = grey[:, :400], shift(grey, (rows, -7.3), order=3, mode="nearest")[:, :400]
    features = extract_features(
        left.astype(np.uint8), right.astype(np.uint8), TrackingContext.create(CAMERA, Config())
    )
    assert features.row_offset is not None
    measured = np.isfinite(features.row_offset)
    matched = np.isfinite(features.u_right[::EVERY])
    assert matched.sum() >= measured.sum() > 0.8 * matched.sum() > 10
    assert np.median(features.row_offset[measured]) == pytest.approx(rows, abs=0.05)


def test_a_measured_delay_is_said():
    (said,) = residual_warnings(None, CAMERA, 4.68e-3)
    assert "the right one is 4.7 ms late" in said
    (said,) = residual_warnings(None, CAMERA, -2e-3)
    assert "the left one is 2.0 ms late" in said
