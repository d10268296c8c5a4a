"""The delay of the right image is measured from the rows of stereo matches, and corrected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ring import CAMERA as RING_CAMERA
from ring import LAP, Ring
from scipy.ndimage import gaussian_filter, shift

from vslam.camera import Camera
from vslam.config import Config
from vslam.context import Context
from vslam.features import Extracted, Features
from vslam.frontend.extraction import FrameImages
from vslam.frontend.side_delay import EVERY, DelayState, SideDelay
from vslam.geometry import inverse, se3_exp
from vslam.image_motion import columns_without_delay, rays, row_speeds
from vslam.run.rig import delay_warnings
from vslam.slam import Slam

CAMERA = Camera(300.0, 300.0, 200.0, 100.0, 0.5, 400, 200)
CONFIG = Config().stereo
SCALES = 1.2 ** np.arange(8)


def seen(
    twist: np.ndarray, delay: float, n: int = 200, seed: int = 0, noise: float = 0.1
) -> tuple[Extracted, np.ndarray]:
    """Return the exact projections of points into both images, of which the right one is late.

    Also return the columns in the right image without delay.
    """
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
    )
    return Extracted(features, row_offset=rows.astype(np.float32)), here[:, 0]


def add(found: SideDelay, extracted: Extracted, twist: np.ndarray | None) -> None:
    found.add(extracted.features, extracted.row_offset, twist, SCALES)


def drive(frames: int) -> list[np.ndarray]:
    """Return the poses of a car that moves ahead with varying speed, nods and turns."""
    t = 0.1 * np.arange(frames)
    zero = np.zeros(frames)
    return list(
        np.stack([zero, zero, -8 - 2 * np.sin(t), 0.05 * np.sin(3 * t), 0.2 * np.sin(t), zero], 1)
    )


def learned(delay: float, frames: int = 80, turned: float = 0.0, known: float = 0.0) -> SideDelay:
    found = SideDelay(replace(CAMERA, right_delay=known), CONFIG)
    for k, twist in enumerate(drive(frames)):
        extracted, _ = seen(twist, delay, seed=k)
        assert extracted.row_offset is not None
        extracted.row_offset[:] += turned * (0.3 + extracted.features.xy[:, 0] / 400)
        add(found, extracted, twist)
    return found


def test_speeds_are_the_derivatives_of_projections():
    for k in range(6):
        twist = np.eye(6)[k]
        late, _ = seen(twist, 1e-5, noise=0.0)
        xy = late.features.xy
        x, y = rays(xy, CAMERA)
        still, columns = seen(twist, 0.0, noise=0.0)
        inverse_depth = (xy[:, 0] - columns) / CAMERA.bf
        assert still.row_offset is not None
        assert late.row_offset is not None
        moved = (late.row_offset - still.row_offset) / 1e-5
        expected = CAMERA.fy * row_speeds(x, y, inverse_depth)[:, k]
        assert moved == pytest.approx(expected, abs=2.0)  # pixels per second; up to 400 occur


@pytest.mark.parametrize("delay", [-8e-3, 3e-3, 12e-3])
def test_a_delay_is_measured_and_reported_unless_the_calibration_gives_it(delay):
    found = learned(delay)
    assert found.seconds == pytest.approx(delay, abs=4 * found.sigma)
    assert 0.0 < found.sigma < 0.3e-3
    assert found.is_wrong
    assert not learned(delay, known=delay).is_wrong


@pytest.mark.slow
def test_a_known_delay_costs_a_drive_little():
    """The car passes a quarter of a ring road at 15 m/s. The right image is 5 ms late.

    The remaining error comes from the first frame, whose motion is not known.
    """
    frames = [float(k) for k in range(LAP // 4)]
    T_start = inverse(Ring.create().pose(0))
    truth = np.array([(T_start @ Ring.create().pose(k))[:3, 3] for k in frames])

    def error(seen_late: float, known: float) -> float:
        ring = replace(Ring.create(), right_delay=seen_late)
        slam = Slam(replace(RING_CAMERA, right_delay=known), detector="none", threads=1)
        for k in frames:
            slam.step_features(Extracted(ring.see(k, 1)), 0.1 * k)
        slam.finish()
        off = np.linalg.norm(slam.trajectory().T_wc[:, :3, 3] - truth, axis=1)
        return float(np.sqrt((off**2).mean()))

    sound, known, unknown = error(0.0, 0.0), error(0.005, 0.005), error(0.005, 0.0)
    assert known < 1.6 * sound  # measured: 0.077, 0.109 and 0.744 m
    assert unknown > 6.0 * sound


@pytest.mark.parametrize("turned", [0.0, 1.0])
def test_nothing_is_said_of_a_sound_rig_nor_of_one_whose_rows_do_not_correspond(turned):
    found = learned(0.0, turned=turned)
    assert abs(found.seconds) < 0.3e-3
    assert not found.is_wrong
    assert delay_warnings(found, CAMERA) == []


def test_a_few_frames_are_not_believed():
    assert not learned(8e-3, frames=20).is_wrong


def test_contradicting_frames_are_doubted():
    """A delay in only every other group of frames is not a property of the rig."""
    found = SideDelay(CAMERA, CONFIG)
    for k, twist in enumerate(drive(60)):
        add(found, seen(twist, 6e-3 * (k // 5 % 2), seed=k)[0], twist)
    assert found.seconds > CONFIG.least_delay
    assert not found.is_wrong


def test_what_was_learned_can_be_kept():
    one, other = learned(5e-3, frames=43), SideDelay(CAMERA, CONFIG)
    other.restore(DelayState.of_numbers(one.state().numbers()))
    assert (other.seconds, other.sigma) == (one.seconds, one.sigma)
    for k, twist in enumerate(drive(30)):
        for each in (one, other):
            add(each, seen(twist, 5e-3, seed=k)[0], twist)
    assert other.state().numbers() == one.state().numbers()
    assert (other.seconds, other.sigma) == (one.seconds, one.sigma)
    other.restore(DelayState.of_numbers(()))
    assert other.state().numbers() == SideDelay(CAMERA, CONFIG).state().numbers()
    assert (other.seconds, other.sigma) == (0.0, np.inf)
    with pytest.raises(ValueError, match="damaged"):
        DelayState.of_numbers((1.0, 5.0, 0.0, 2.0))


def test_many_frames_take_no_more_memory():
    assert len(learned(0.0, frames=400).state().numbers()) < 16 * 12 * 12 + 1000


def test_frames_between_keyframes_only_give_the_velocity():
    found = SideDelay(CAMERA, CONFIG)
    for k, twist in enumerate(drive(30)):
        # The velocity falls. At the keyframe, it is the mean of the velocities before and after it.
        add(found, seen(twist, 5e-3, seed=k)[0], 1.3 * twist)
        add(found, Extracted.nothing(), 0.7 * twist)
        add(found, Extracted.nothing(), twist)
    assert found.seconds == pytest.approx(5e-3, abs=4 * found.sigma)
    assert 0.0 < found.sigma < 0.3e-3


def test_frames_of_unknown_velocity_teach_nothing():
    found = SideDelay(CAMERA, CONFIG)
    for k, twist in enumerate(drive(60)):
        extracted, _ = seen(twist, 5e-3, seed=k)
        add(found, extracted, twist)
        add(found, extracted, None)
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
    context = Context.create(CAMERA, Config())
    images = FrameImages(left.astype(np.uint8), lambda: right.astype(np.uint8), context)
    extracted = images.extracted
    assert extracted.row_offset is not None
    measured = np.isfinite(extracted.row_offset)
    matched = np.isfinite(extracted.features.u_right[::EVERY])
    assert matched.sum() >= measured.sum() > 0.8 * matched.sum() > 10
    assert np.median(extracted.row_offset[measured]) == pytest.approx(rows, abs=0.05)


def test_the_warning_says_what_to_write_into_the_calibration():
    found = learned(12e-3)
    found.seconds = 4.68e-3
    (said,) = delay_warnings(found, CAMERA)
    assert "the right camera is 4.7 ms late. " in said
    assert "right_delay: 0.0047 (seconds) into the file that --calib names" in said
    found.seconds = -2e-3
    (said,) = delay_warnings(found, replace(CAMERA, right_delay=3e-3))
    assert "the left camera is 2.0 ms late instead of 3.0 ms (right_delay). " in said
    assert "right_delay: -0.0020" in said
