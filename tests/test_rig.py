"""The corrections of a stereo pair. Each of them is applied to a frame once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_side_delay import CAMERA, CONFIG, SCALES, drive, seen

from vslam.features import Extracted
from vslam.frontend.frame import Frame
from vslam.frontend.rig import RigCalibration

TWIST = drive(6)[5]


def rig(delay: float = 0.0, offset: float = 0.0) -> RigCalibration:
    found = RigCalibration(replace(CAMERA, right_delay=delay), CONFIG, SCALES)
    found.disparity_offset = offset
    return found


def prepared(extracted: Extracted, by: RigCalibration, twist: np.ndarray | None = TWIST) -> Frame:
    frame = Frame.of(extracted, CAMERA)
    by.prepare(frame, twist)
    return frame


@pytest.mark.parametrize("delay", [-8e-3, 3e-3, 12e-3])
def test_a_known_delay_is_removed_once(delay):
    extracted, columns = seen(TWIST, delay)
    before = np.abs(extracted.features.u_right - columns).mean()
    assert before > 0.15
    calibration = rig(delay)
    frame = prepared(extracted, calibration)
    assert np.abs(frame.features.u_right - columns).mean() < 0.15 * before
    once = frame.features
    calibration.prepare(frame, TWIST)
    assert frame.features is once


def test_the_delay_stays_until_the_motion_is_known():
    extracted, columns = seen(TWIST, 5e-3)
    calibration = rig(5e-3)
    frame = prepared(extracted, calibration, twist=None)
    assert frame.features is extracted.features
    calibration.prepare(frame, TWIST)
    assert np.abs(frame.features.u_right - columns).mean() < 0.03


def test_a_frame_that_was_saved_is_not_corrected_again():
    extracted, _ = seen(TWIST, 5e-3)
    calibration = rig(5e-3, offset=0.25)
    frame = Frame.of(extracted, CAMERA)
    calibration.mark_corrected(frame)
    calibration.prepare(frame, TWIST)
    assert frame.features is extracted.features


def test_the_offset_is_applied_once_and_again_when_it_changes():
    extracted, _ = seen(TWIST, 0.0)
    u_right = extracted.features.u_right.copy()
    calibration = rig(offset=0.25)
    frame = prepared(extracted, calibration)
    calibration.correct_offset(frame)
    assert_allclose(frame.features.u_right, u_right - 0.25, atol=1e-4)
    for offset in (0.75, 0.5):
        calibration.disparity_offset = offset
        calibration.correct_offset(frame)
        assert_allclose(frame.features.u_right, u_right - offset, atol=1e-4)
    assert_array_equal(extracted.features.u_right, u_right)


def test_both_corrections_add_up_and_nothing_else_changes():
    extracted, columns = seen(TWIST, 5e-3)
    calibration = rig(5e-3, offset=0.25)
    frame = prepared(extracted, calibration)
    assert np.abs(frame.features.u_right - (columns - 0.25)).mean() < 0.03
    for name in ("xy", "octave", "angle", "descriptors"):
        assert getattr(frame.features, name) is getattr(extracted.features, name)
    calibration.disparity_offset = 0.5
    calibration.correct_offset(frame)
    assert np.abs(frame.features.u_right - (columns - 0.5)).mean() < 0.03


def test_a_sound_rig_leaves_frames_as_they_are():
    extracted, _ = seen(TWIST, 0.0)
    assert prepared(extracted, rig()).features is extracted.features


def test_the_state_comes_back_equal_and_continues_alike():
    one, other = rig(), rig()
    frames = [(seen(twist, 5e-3, seed=k)[0], twist) for k, twist in enumerate(drive(60))]
    for extracted, twist in frames[:43]:
        one.observe(prepared(extracted, one, twist), twist)
    assert np.isfinite(one.delay.sigma)
    state = one.state()
    other.restore(state)
    assert other.state() == state != rig().state()
    kept = state.delay
    for extracted, twist in frames[43:]:
        for each in (one, other):
            each.observe(prepared(extracted, each, twist), twist)
    assert other.state() == one.state()
    assert (other.delay.seconds, other.delay.sigma) == (one.delay.seconds, one.delay.sigma)
    assert state.delay == kept  # a returned state does not change any more
