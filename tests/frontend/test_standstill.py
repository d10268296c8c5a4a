"""That a camera stands still is recognised by the landmarks that did not move in the image."""

from __future__ import annotations

import numpy as np
import pytest

from vslam.frontend.standstill import has_come_to_rest, is_small, still_stands
from vslam.types.track import Standstill


def first(n: int, of: int) -> np.ndarray:
    """Return ``(of,)`` bool with the first n values True."""
    return np.arange(of) < n


def test_motion_is_known_of_the_landmarks_that_were_seen_when_the_camera_came_to_rest():
    ids = np.array([3, 5, 8], np.int32)
    xy = np.array([[10.0, 20.0], [30.0, 40.0], [50.0, 60.0]], np.float32)
    still = Standstill(np.eye(4), ids, xy, 1)
    seen = np.array([9, 8, 1, 5, 4], np.int32)
    known, flow = still.flow(seen, np.full((5, 2), 45.0, np.float32))
    assert known.tolist() == [False, True, False, True, False]
    np.testing.assert_array_equal(flow[known], [[-5.0, -15.0], [15.0, 5.0]])


def test_nothing_is_known_if_no_landmark_was_seen():
    still = Standstill(np.eye(4), np.empty(0, np.int32), np.empty((0, 2), np.float32), 1)
    known, flow = still.flow(np.array([0, 7], np.int32), np.ones((2, 2), np.float32))
    assert known.tolist() == [False, False]
    assert flow.shape == (2, 2)


@pytest.mark.parametrize(("pixels", "scale", "small"), [
    (0.39, 1.0, True),
    (0.41, 1.0, False),
    (0.79, 2.0, True),
    (0.81, 2.0, False),
])  # fmt: skip
def test_a_small_motion_is_an_error_of_measurement_in_pixels_of_the_octave(pixels, scale, small):
    flow = pixels * np.array([[1.0, 0.0], [-0.6, 0.8]])
    assert is_small(flow, np.full(2, scale)).tolist() == [small, small]


@pytest.mark.parametrize(("n_stayed", "n", "rests"), [
    (40, 40, True),
    (39, 39, False),
    (80, 100, True),
    (79, 100, False),
    (0, 0, False),
])  # fmt: skip
def test_a_camera_comes_to_rest_where_nearly_everything_stays(n_stayed, n, rests):
    assert has_come_to_rest(first(n_stayed, n)) == rests


@pytest.mark.parametrize(("n_stayed", "n", "n_follow", "stands"), [
    # A vehicle passes: the landmarks that do not stay contradict each other.
    (60, 400, 60, True),
    (59, 400, 59, False),
    # The camera moves off: most landmarks move as one motion of the camera demands.
    (49, 100, 90, False),
    (49, 100, 89, True),
    (50, 100, 100, True),
    # Hardly anything is seen past the vehicle.
    (15, 15, 15, True),
    (14, 14, 14, False),
    (20, 40, 35, True),
    (19, 40, 35, False),
    (32, 40, 36, True),
    (31, 40, 36, False),
    (0, 0, 0, False),
])  # fmt: skip
def test_a_camera_still_stands_as_long_as_enough_stays(n_stayed, n, n_follow, stands):
    assert still_stands(first(n_stayed, n), first(n_follow, n), first(n, n)) == stands


@pytest.mark.parametrize(("n_close", "stands"), [(39, True), (40, False)])
def test_far_landmarks_that_stay_do_not_prove_that_the_camera_stands(n_close, stands):
    """The close landmarks move, which the far landmarks do only later."""
    close = first(n_close, 400)
    assert still_stands(~close, np.ones(400, np.bool_), close) == stands
