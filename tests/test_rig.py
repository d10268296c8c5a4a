"""The corrections of a stereo pair, and what is recorded about it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from parts import frame_of
from test_side_delay import CAMERA, drive, seen

from vslam.config import Config
from vslam.context import Context
from vslam.features import Extracted, TrackingState
from vslam.frontend.rig import RigMonitor, corrected, with_offset
from vslam.frontend.sides import Sides
from vslam.frontend.track import GivenFeatures

TWIST = drive(6)[5]
CONTEXT = Context.create(CAMERA, Config())


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
    rig, lost = RigMonitor(CONTEXT), frame_of(Extracted.nothing(), 7)
    rig.observe(lost, GivenFeatures(Extracted.nothing()))
    assert (rig.sides.n, rig.problems) == (0, [])
    black = GivenFeatures(Extracted.nothing(), sides=Sides(black="left"), problem="it is gone.")
    rig.observe(lost, black)
    assert (rig.sides.n, rig.sides.n_black_left) == (1, 1)
    assert rig.problems == ["Frame 7 has only its left image: it is gone."]


def test_the_state_comes_back_equal_and_continues_alike():
    one, other = RigMonitor(CONTEXT), RigMonitor(CONTEXT)
    frames = [(seen(twist, 5e-3, seed=k)[0], twist) for k, twist in enumerate(drive(60))]

    def observe(rig: RigMonitor, extracted: Extracted, twist: np.ndarray) -> None:
        track = replace(frame_of(extracted), state=TrackingState.OK, twist=twist)
        rig.observe(track, GivenFeatures(extracted))

    for extracted, twist in frames[:43]:
        observe(one, extracted, twist)
    assert np.isfinite(one.delay.sigma)
    state = one.state()
    other.restore(state)
    assert other.state() == state != RigMonitor(CONTEXT).state()
    kept = state.delay
    for extracted, twist in frames[43:]:
        for each in (one, other):
            observe(each, extracted, twist)
    assert other.state() == one.state()
    assert (other.delay.seconds, other.delay.sigma) == (one.delay.seconds, one.delay.sigma)
    assert state.delay == kept  # a returned state does not change any more
