"""The starter in isolation: the frames with which a map or a sub-map begins."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from parts import ALL, CAMERA, Points, frame_of

from vslam.config import Config
from vslam.datasets.euroc import open_euroc
from vslam.frontend import initialization
from vslam.frontend.extraction import checked_images
from vslam.method import starter as starter_module
from vslam.method.starter import Starter, TwoViewStart
from vslam.types.context import Context
from vslam.types.geometry import se3_exp, se3_log, transform
from vslam.types.track import Track

POINTS = Points.create()
LIBRARY = Path(__file__).parents[3] / "shared/data/boofcv_library"
ASIDE = np.array([-1.0, 0.0, 0.1, 0.0, 0.01, 0.0])  # twist to a view from which points are mapped


def starter(**thresholds: float) -> Starter:
    config = Config.model_validate({"initialization": thresholds})
    return Starter(Context.create(CAMERA.left_camera(), config))


def frame(index: int, seconds: float, moved: float = 0.0, among: slice = ALL) -> Track:
    """Make a frame that is not tracked.

    It has ``moved`` times the lateral distance that two views should have.
    """
    features = POINTS.see(se3_exp(moved * ASIDE), among)
    features.u_right[:] = np.nan
    return frame_of(features, index, seconds)


def offered_twice(one: Starter, track: Track) -> TwoViewStart | None:
    """Offer a frame, and then the same view again as a later frame, which must confirm it."""
    assert one.offer(track, None) is None
    again = replace(track, index=track.index + 1, timestamp=track.timestamp + 1e-4)
    return one.offer(again, None)


# -- two views ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n_features", "enough"), [(200, True), (199, False)])
def test_a_frame_with_enough_features_waits_for_a_second_view(n_features, enough):
    one = starter()
    assert one.offer(frame(0, 0.0, among=slice(0, n_features)), None) is None
    assert (offered_twice(one, frame(1, 0.5, 1.0)) is not None) == enough


def test_two_views_from_different_places_begin_a_map():
    one, first, second = starter(), frame(0, 0.0), frame(1, 0.5, 1.0)
    assert one.offer(first, None) is None
    start = offered_twice(one, second)
    assert isinstance(start, TwoViewStart)
    assert start.first is first
    assert start.second.index == second.index + 1
    assert not start.predicted
    np.testing.assert_array_equal(start.features[0], start.features[1])  # the same points
    seen = POINTS.xyz[start.features[0]]
    assert len(seen) == 240
    unit = np.median(start.points[:, 2]) / np.median(seen[:, 2])
    assert np.median(start.points[:, 2]) == pytest.approx(15.0)
    np.testing.assert_allclose(start.points, unit * seen, rtol=1e-3, atol=1e-3)
    truth = se3_exp(ASIDE)
    truth[:3, 3] *= unit
    np.testing.assert_allclose(start.T_2_1, truth, atol=1e-3)
    np.testing.assert_allclose(start.twist, se3_log(start.T_2_1) / 0.5001)
    assert one.is_waiting  # until the map has begun
    one.reset()
    assert not one.is_waiting


def test_a_camera_that_stands_begins_no_map_and_the_first_view_keeps_waiting():
    one, first = starter(), frame(0, 0.0)
    assert one.offer(first, None) is None
    assert one.offer(frame(1, 0.1, 1e-4), None) is None
    start = offered_twice(one, frame(2, 0.2, 1.0))
    assert isinstance(start, TwoViewStart)
    assert start.first is first


@pytest.mark.parametrize(("seconds", "together"), [(1.499, True), (1.501, False)])
def test_a_view_that_has_waited_too_long_is_replaced(seconds, together):
    one, second = starter(), frame(1, seconds, 1.0)
    one.offer(frame(0, 0.0), None)
    if together:
        assert offered_twice(one, second) is not None
        return
    assert one.offer(second, None) is None
    start = offered_twice(one, frame(2, seconds + 0.1, 2.0))
    assert isinstance(start, TwoViewStart)
    assert start.first is second


@pytest.mark.parametrize(("n_common", "together"), [(100, True), (99, False)])
def test_a_view_that_shows_too_little_of_the_first_one_replaces_it(n_common, together, monkeypatch):
    """Each view shows at least 200 of 240 points.

    Its other points look unlike those in the first view.
    """
    monkeypatch.setattr(initialization, "_MIN_POINTS", 20)
    one, second = starter(min_landmarks=50), frame(1, 0.1, 1.0)
    strange = np.random.default_rng(1).integers(0, 256, (240 - n_common, 32), dtype=np.uint8)
    second.features.descriptors[:] = np.vstack([POINTS.descriptors[:n_common], strange])
    one.offer(frame(0, 0.0), None)
    if together:
        assert offered_twice(one, second) is not None
        return
    assert one.offer(second, None) is None
    third = frame(2, 0.2, 2.0)
    third.features.descriptors[:] = second.features.descriptors
    start = offered_twice(one, third)
    assert isinstance(start, TwoViewStart)
    assert start.first is second


def test_a_view_that_shows_too_little_of_the_first_one_and_too_little_at_all_is_not_kept():
    one = starter()
    one.offer(frame(0, 0.0), None)
    assert one.offer(frame(1, 0.1, 1.0, slice(0, 99)), None) is None
    assert not one.is_waiting


@pytest.mark.parametrize(("min_landmarks", "enough"), [(240, True), (241, False)])
def test_a_map_needs_enough_points_to_begin_with(min_landmarks, enough):
    one = starter(min_landmarks=min_landmarks)
    one.offer(frame(0, 0.0), None)
    assert (offered_twice(one, frame(1, 0.1, 1.0)) is not None) == enough
    assert one.is_waiting


def test_a_pair_that_no_later_pair_confirms_begins_no_map():
    """In the second view, far points seem to be near. The pair is consistent in itself."""
    one, wrong = starter(), frame(1, 0.1, 1.0)
    bent = POINTS.xyz * np.random.default_rng(3).uniform(0.1, 1.0, (240, 1))
    in_second = transform(se3_exp(ASIDE), bent)
    wrong.features.xy[:] = CAMERA.project(in_second)[:, :2]
    assert one.offer(frame(0, 0.0), None) is None
    assert one.offer(wrong, None) is None
    assert one.offer(frame(2, 0.2, 1.0), None) is None  # it contradicts the first pair
    start = one.offer(frame(3, 0.3, 1.1), None)
    assert isinstance(start, TwoViewStart)
    unit = np.median(start.points[:, 2]) / np.median(POINTS.xyz[start.features[0], 2])
    np.testing.assert_allclose(start.points, unit * POINTS.xyz[start.features[0]], rtol=1e-3)


def test_the_pair_of_the_second_and_a_third_view_confirms_a_start():
    """The third view shows little that the first view shows, as after fast motion."""
    one = starter(min_landmarks=50)
    first, second, third = frame(0, 0.0), frame(1, 0.1, 1.0), frame(2, 0.2, 2.0)
    strange = np.random.default_rng(1).integers(0, 256, (240, 32), dtype=np.uint8)
    first.features.descriptors[140:] = strange[140:]
    third.features.descriptors[:100] = strange[:100]
    assert one.offer(first, None) is None
    assert one.offer(second, None) is None
    start = one.offer(third, None)
    assert isinstance(start, TwoViewStart)
    assert (start.first, start.second) == (second, third)
    assert len(start.points) == 140


@pytest.mark.parametrize("seed", range(5))
def test_a_camera_that_only_turns_begins_no_map(seed):
    """Positions of features err by half a pixel."""
    one, rng = starter(), np.random.default_rng(seed)
    for k in range(8):
        turned = frame_of(
            POINTS.see(se3_exp(np.array([0, 0, 0, 0, 0.01 * k, 0.002 * k]))), k, 0.1 * k
        )
        turned.features.xy[:] += 0.5 * rng.standard_normal(turned.features.xy.shape)
        turned.features.u_right[:] = np.nan
        assert one.offer(turned, None) is None


def test_all_frames_since_the_image_was_dark_wait_for_the_map():
    one = starter()
    for k, n_features in enumerate([240, 0, 150, 240, 240]):
        assert one.offer(frame(k, 0.1 * k, 1e-5 * k, slice(0, n_features)), None) is None
    start = offered_twice(one, frame(5, 0.5, 1.0))
    assert isinstance(start, TwoViewStart)
    assert (start.first.index, start.second.index) == (3, 6)
    assert [waiting.index for waiting in start.waiting] == [2, 4, 5]
    assert all(waiting.extracted.pyramid is None for waiting in start.waiting)


def test_the_oldest_frames_no_longer_wait_if_there_are_many(monkeypatch):
    monkeypatch.setattr(starter_module, "_MAX_WAITING", 3)
    one = starter()
    for k in range(5):
        assert one.offer(frame(k, 0.1 * k, 1e-5 * k), None) is None
    start = offered_twice(one, frame(5, 0.5, 1.0))
    assert isinstance(start, TwoViewStart)
    assert [waiting.index for waiting in start.waiting] == [3, 4, 5]


@pytest.mark.skipif(not LIBRARY.is_dir(), reason="the recording is not at ../shared/data")
def test_a_turn_of_a_hand_is_not_taken_for_an_orbit():
    """The camera turns by four degrees a frame and moves slowly forwards. The images err by 0.3
    pixels, so an orbit around shelves at one distance fits better than the true motion."""
    source = open_euroc(LIBRARY)
    context = Context.create(source.camera.left_camera(), Config())
    one = Starter(context)
    for k in range(60, 72):
        extracted = checked_images(source.read(k)[0], None, None, context).extracted
        track = Track(k, float(source.timestamps[k]), np.eye(4)).with_features(extracted)
        start = one.offer(track, None)
        if start is not None:
            turn = np.degrees(np.linalg.norm(se3_log(start.T_2_1)[3:]))
            assert 2.0 < turn / (start.second.index - start.first.index) < 5.5  # as stereo says
            break


# -- the unit of a sub-map ------------------------------------------------------------------------


def two_views() -> TwoViewStart:
    T_2_1 = se3_exp(np.array([0.3, 0.0, 0.4, 0.0, 0.02, 0.0]))
    T_2_1[:3, 3] *= 0.5 / np.linalg.norm(T_2_1[:3, 3])
    features = np.arange(240), np.arange(240)
    return TwoViewStart(frame(4, 1.0), frame(6, 1.25), (None, None), T_2_1, features, POINTS.xyz)


def test_a_sub_map_takes_its_unit_from_the_speed_before():
    """At 6 units per second, the camera moves by 1.5 units in 0.25 s: three times the start."""
    start = two_views()
    rescaled = start.at_speed(np.array([0.0, 3.6, 4.8, 0.1, 0.0, 0.0]), 10.0)
    assert rescaled.predicted
    np.testing.assert_allclose(rescaled.points, 3.0 * POINTS.xyz)
    np.testing.assert_allclose(rescaled.T_2_1[:3, 3], 3.0 * start.T_2_1[:3, 3])
    np.testing.assert_array_equal(rescaled.T_2_1[:3, :3], start.T_2_1[:3, :3])
    in_second = transform(rescaled.T_2_1, rescaled.points)
    np.testing.assert_allclose(in_second, 3.0 * transform(start.T_2_1, POINTS.xyz))
    assert rescaled.first is start.first
    assert rescaled.second is start.second
    np.testing.assert_allclose(se3_exp(0.25 * rescaled.twist), rescaled.T_2_1, atol=1e-12)
    assert np.linalg.norm(start.T_2_1[:3, 3]) == pytest.approx(0.5)  # unchanged


@pytest.mark.parametrize(("speed", "believed"), [
    (19.9, True), (20.1, False), (0.201, True), (0.199, False), (0.0, False),
])  # fmt: skip
def test_a_speed_that_asks_for_too_much_rescaling_tells_nothing(speed, believed):
    """The limits are ten times the speed of the start (2 units per second) and a tenth of it."""
    start = two_views()
    rescaled = start.at_speed(np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0]), 10.0)
    assert rescaled.predicted == believed
    assert (rescaled is start) != believed


def test_without_a_speed_a_sub_map_keeps_its_own_unit():
    start = two_views()
    assert start.at_speed(None, 10.0) is start
