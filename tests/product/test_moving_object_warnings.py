"""Warnings of frames in which a large part of the image moved against the rest."""

from dataclasses import replace

import numpy as np
import pytest

from vslam.run.moving_objects import moving_object_warnings
from vslam.types.features import TrackingState, TrackResult


def tracks_with(support: list[float | None]) -> list[TrackResult]:
    one = TrackResult(0, 0.0, np.eye(4), TrackingState.OK, 0, 0, 100, 100, False)
    return [replace(one, index=k, support=share) for k, share in enumerate(support)]


@pytest.mark.parametrize(("frames", "said"), [(9, False), (10, True)])
def test_ten_frames_in_a_row_with_little_support_are_reported(frames, said):
    support = [0.9] * 3 + [0.3] * (frames - 1) + [0.25] + [0.9] * 3
    warnings = moving_object_warnings(tracks_with(support))
    assert bool(warnings) == said
    if said:
        assert f"In frames 3 to {2 + frames}, a large part" in warnings[0]
        assert "as little as 25 %" in warnings[0]


@pytest.mark.parametrize("between", [0.4, None])
def test_frames_between_separate_stretches(between):
    support = [0.1] * 9 + [between] + [0.1] * 9
    assert not moving_object_warnings(tracks_with(support))


def test_several_stretches_are_one_sentence():
    support = ([0.1] * 12 + [0.9]) * 3
    (warning,) = moving_object_warnings(tracks_with(support))
    assert "In frames 0 to 11 and 2 more times, a large part" in warning
