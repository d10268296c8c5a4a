"""The corrections of a stereo pair, and what is recorded about it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from parts import frame_of
from ring import CAMERA as RING_CAMERA
from ring import LAP, Ring

from vslam.frontend.rig import RigMonitor, corrected, with_offset
from vslam.slam import Slam
from vslam.types.camera import Camera
from vslam.types.features import Extracted, Features, Sides
from vslam.types.geometry import inverse, se3_exp
from vslam.types.image_motion import columns_without_delay, rays

CAMERA = Camera(300.0, 300.0, 200.0, 100.0, 0.5, 400, 200)
# A car moves ahead, nods and turns.
TWIST = np.array([0.0, 0.0, -8.96, 0.05, 0.096, 0.0])


def seen(twist: np.ndarray, delay: float, n: int = 200) -> tuple[Extracted, np.ndarray]:
    """Return the exact projections of points into both images, of which the right one is late.

    Also return the columns in the right image without delay.
    """
    rng = np.random.default_rng(0)
    z = rng.uniform(4.0, 40.0, n)
    xy = np.stack([rng.uniform(0, 400, n), rng.uniform(0, 200, n)], axis=1).astype(np.float32)
    x, y = rays(xy, CAMERA)
    points = np.stack([x, y, np.ones(n)], axis=1) * z[:, None]

    def right(T: np.ndarray) -> np.ndarray:
        p = points @ T[:3, :3].T + T[:3, 3] - [CAMERA.baseline, 0.0, 0.0]
        return CAMERA.fx * p[:, :2] / p[:, 2:] + [CAMERA.cx, CAMERA.cy]

    here, later = right(np.eye(4)), right(se3_exp(twist * delay))
    features = Features(
        xy=xy,
        octave=np.zeros(n, np.uint8),
        angle=np.zeros(n, np.float32),
        descriptors=np.zeros((n, 32), np.uint8),
        u_right=later[:, 0].astype(np.float32),
    )
    return Extracted(features), here[:, 0]


def correct(
    extracted: Extracted, delay: float = 0.0, offset: float = 0.0, twist: np.ndarray | None = TWIST
) -> Extracted:
    return corrected(extracted, offset, twist, replace(CAMERA, right_delay=delay))


@pytest.mark.parametrize("delay", [-8e-3, 3e-3, 12e-3])
def test_a_known_delay_is_removed(delay):
    extracted, columns = seen(TWIST, delay)
    before = np.abs(extracted.features.u_right - columns).mean()
    assert before > 0.15
    after = np.abs(correct(extracted, delay).features.u_right - columns).mean()
    assert after < 0.15 * before


def test_the_delay_stays_if_the_motion_is_unknown():
    extracted, _ = seen(TWIST, 5e-3)
    assert correct(extracted, 5e-3, twist=None) is extracted


def test_another_offset_replaces_the_one_before():
    extracted, _ = seen(TWIST, 0.0)
    u_right, found = extracted.features.u_right.copy(), correct(extracted, offset=0.25)
    assert_allclose(found.features.u_right, u_right - 0.25, atol=1e-4)
    assert with_offset(found, 0.25) is found
    for offset in (0.75, 0.5):
        found = with_offset(found, offset)
        assert_allclose(found.features.u_right, u_right - offset, atol=1e-4)
    assert_array_equal(extracted.features.u_right, u_right)


def test_both_corrections_add_up_and_nothing_else_changes():
    extracted, columns = seen(TWIST, 5e-3)
    found = correct(extracted, 5e-3, 0.25)
    assert np.abs(found.features.u_right - (columns - 0.25)).mean() < 0.03
    for name in ("xy", "octave", "angle", "descriptors"):
        assert getattr(found.features, name) is getattr(extracted.features, name)
    assert np.abs(with_offset(found, 0.5).features.u_right - (columns - 0.5)).mean() < 0.03


def test_a_sound_rig_leaves_frames_as_they_are():
    extracted, _ = seen(TWIST, 0.0)
    assert correct(extracted) is extracted


def test_what_the_images_of_a_frame_show_is_recorded_even_if_it_is_lost():
    rig, lost = RigMonitor(), frame_of(Extracted.nothing(), 7)
    rig.observe(lost)
    assert (rig.sides.n, rig.problems) == (0, [])
    black = replace(lost.extracted, sides=Sides(black="left"), problem="it is gone.")
    rig.observe(replace(lost, extracted=black))
    assert (rig.sides.n, rig.sides.n_black_left) == (1, 1)
    assert rig.problems == ["Frame 7 has only its left image: it is gone."]


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


def test_columns_far_away_stay_in_front_of_the_camera():
    xy, u_right = np.array([[200.0, 50.0]], np.float32), np.array([199.9], np.float32)
    twist = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    for delay in (5e-3, -5e-3):
        assert columns_without_delay(xy, u_right, twist, delay, CAMERA)[0] < 200.0
    assert np.isnan(columns_without_delay(xy, u_right * np.nan, twist, 5e-3, CAMERA)[0])
