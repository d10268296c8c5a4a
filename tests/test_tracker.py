"""The tracker in isolation, on hand-made views of a map, without a map, threads or ``Slam``."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from parts import ALL, CAMERA, NOTHING, OneKeyframe, Points, ahead, frame_of

from vslam.config import Config
from vslam.features import Features, TrackingState
from vslam.frame_poses import FramePoses
from vslam.frontend.frame import Frame
from vslam.frontend.tracker import Found, Tracker, TrackerStatus, judge
from vslam.frontend.tracking import TrackingContext, track_motion
from vslam.geometry import se3_exp
from vslam.map_view import NO_LANDMARKS, MapView

CONTEXT = TrackingContext.create(CAMERA, Config())
POINTS = Points.create()
SEEN_LAST, SEEN_NOW = slice(0, 120), slice(120, 240)  # two halves of the points
FEW = slice(0, 60)
STEP = np.array([0.02, 0.0, -0.8, 0.0, -0.004, 0.0])  # motion of the camera between two frames
TWIST = STEP / 0.1  # at ten frames per second


def at(k: float) -> np.ndarray:
    """Return ``T_cw`` at frame k of a camera that moves at a constant speed."""
    return se3_exp(k * STEP)


def restored(tracker: Tracker) -> Tracker:
    """Return a new tracker in the same map with the memory of the given tracker."""
    state, other = tracker.state(), Tracker(CONTEXT)
    other.restore(state, np.where((state.landmark >= 0)[:, None], POINTS.xyz, np.nan))
    return other


def select(features: Features, n: int) -> Features:
    names = ("xy", "octave", "angle", "descriptors", "u_right")
    return Features(*(getattr(features, name)[:n] for name in names))


class Drive:
    """A tracker, and the poses of the frames that it was given.

    Frames come ten times a second. Frame k is at ``at(k)`` unless another pose is given.
    """

    def __init__(self) -> None:
        self.tracker = Tracker(CONTEXT)
        self.frames = FramePoses(OneKeyframe())

    @classmethod
    def of_two_frames(cls, among: slice = ALL) -> Drive:
        """Make a drive of two frames, so that the speed of the camera is known.

        The last frame saw some of the points.
        """
        drive = cls()
        drive.accept(0)
        drive.accept(1, among)
        return drive

    def accept(self, k: int, among: slice = ALL, *, keyframe: int = -1) -> Frame:
        """Continue from a frame that was found, with a ``keyframe`` if by relocalisation."""
        frame = POINTS.tracked_frame(len(self.frames), 0.1 * k, at(k), among)
        found = Found(TrackingState.OK, keyframe=keyframe)
        if k == 0:
            self.tracker.start_from(frame)
        else:
            self.tracker.accept(frame, found, self.frames, 1)
        self.frames.append(frame.timestamp, frame.T_cw, tracked=True)
        return frame

    def lose(self, k: int) -> None:
        """Continue from a frame that is not tracked, at its predicted pose."""
        T_cw = self.predict(k)
        self.frames.append(0.1 * k, T_cw, tracked=False)
        self.tracker.lose()

    def predict(self, k: float) -> np.ndarray:
        return self.tracker.predict(0.1 * k, self.frames, POINTS.view())

    def next_frame(self, among: slice = ALL, *, seconds: float = 0.1) -> Frame:
        """Return the frame after the last one, which sees some of the points."""
        last = self.frames.timestamp(-1)
        return POINTS.frame(len(self.frames), last + seconds, at(10.0 * (last + seconds)), among)

    def track(self, frame: Frame, view: MapView, T_cw: np.ndarray | None = None) -> Found:
        """Track a frame from a predicted pose, which is by default its true pose."""
        T_cw = at(10.0 * frame.timestamp) if T_cw is None else T_cw
        return self.tracker.track(frame, T_cw, view, self.frames)

    def doubts(self, frame: Frame, view: MapView) -> bool:
        """Track a frame at its true pose, and return whether the result is doubtful."""
        return self.track(frame, view).is_doubtful


# -- prediction -----------------------------------------------------------------------------------


def test_without_any_frame_the_camera_is_expected_at_the_reference_keyframe():
    view = replace(POINTS.view(), T_reference=ahead(3.0, 0.2))
    T_cw = Tracker(CONTEXT).predict(0.0, FramePoses(OneKeyframe()), view)
    np.testing.assert_array_equal(T_cw, ahead(3.0, 0.2))


def test_a_camera_whose_speed_is_unknown_is_expected_where_it_was():
    drive = Drive()
    drive.accept(0)
    np.testing.assert_allclose(drive.predict(5), at(0), atol=1e-12)


@pytest.mark.parametrize("k", [2, 4.5])
def test_the_speed_is_per_second_so_that_dropped_frames_do_not_disturb_it(k):
    drive = Drive.of_two_frames()
    np.testing.assert_allclose(drive.tracker.twist, TWIST, atol=1e-9)
    np.testing.assert_allclose(drive.predict(k), at(k), atol=1e-9)


def test_the_camera_moves_on_while_it_is_lost():
    drive = Drive.of_two_frames()
    drive.lose(2)
    drive.lose(3)
    np.testing.assert_allclose(drive.predict(5), at(5), atol=1e-9)


def test_the_speed_is_measured_from_the_last_frame_that_was_tracked():
    """The predicted poses, which are not used, are those of a camera that stands still."""
    drive = Drive()
    drive.accept(0)
    drive.lose(1)
    drive.lose(2)
    frame = drive.accept(3)
    np.testing.assert_allclose(frame.twist, TWIST, atol=1e-9)


def test_the_leap_to_where_a_frame_was_found_in_the_map_is_no_motion():
    drive = Drive.of_two_frames()
    drive.lose(2)
    frame = drive.accept(30, keyframe=4)
    assert frame.twist is None
    assert drive.tracker.twist is None


# -- what is tracked ------------------------------------------------------------------------------


def test_a_tracker_that_has_nothing_to_go_on_does_not_track():
    drive = Drive()
    assert drive.tracker.status is TrackerStatus.UNKNOWN
    frame = POINTS.frame(0, 0.0, np.eye(4))
    found = drive.track(frame, POINTS.view(), np.eye(4))
    assert found.is_lost
    assert (frame.landmark == -1).all()


def test_a_drive_that_is_continued_is_tracked_from_the_reference_keyframe():
    drive = Drive()
    drive.tracker.resume()
    assert drive.tracker.status is TrackerStatus.RESUMED
    frame = POINTS.frame(0, 0.0, ahead(0.7, 0.1))
    found = drive.track(frame, POINTS.view(), np.eye(4))
    assert (found.state, found.n_inliers) == (TrackingState.OK, 240)
    np.testing.assert_array_equal(frame.landmark, np.arange(240))
    np.testing.assert_allclose(frame.T_cw, ahead(0.7, 0.1), atol=1e-4)


def test_a_continued_drive_has_the_speed_that_it_is_told():
    drive = Drive()
    drive.frames.append(0.0, at(0), tracked=True)
    drive.tracker.resume(TWIST)
    np.testing.assert_allclose(drive.predict(3), at(3), atol=1e-12)
    # With the prediction, a frame is found that the reference keyframe does not show.
    frame, view = drive.next_frame(), POINTS.view(nearest=NOTHING)
    assert drive.track(frame, view).n_inliers == 240
    drive.tracker.resume(None)
    assert drive.track(drive.next_frame(), view).is_lost


@pytest.mark.parametrize(("pixels", "found_again"), [(12, True), (200, False)])
def test_what_the_last_frame_saw_is_looked_for_near_the_prediction(pixels, found_again):
    """12 pixels are too far for the window around landmarks of the map.

    The reference keyframe has no matches here.
    """
    drive, view = Drive.of_two_frames(), POINTS.view(nearest=NOTHING)
    frame = drive.next_frame()
    found = drive.track(frame, view, ahead(0.0, pixels / CAMERA.fx) @ at(2))
    assert found.is_lost != found_again
    if found_again:
        assert found.n_inliers == 240
        np.testing.assert_allclose(frame.T_cw, at(2), atol=1e-4)


def test_where_the_last_frame_shows_other_things_the_reference_keyframe_is_tried():
    """Only descriptors are compared, because the predicted pose is far from the true pose."""
    drive, frame_sees = Drive.of_two_frames(SEEN_LAST), SEEN_NOW
    T_predicted = ahead(0.0, 0.5) @ at(2)
    frame = drive.next_frame(frame_sees)
    found = drive.track(frame, POINTS.view(nearest=SEEN_NOW), T_predicted)
    assert found.n_inliers == 120
    np.testing.assert_array_equal(frame.landmark, np.arange(120, 240))
    np.testing.assert_allclose(frame.T_cw, at(2), atol=1e-4)
    assert drive.track(
        drive.next_frame(frame_sees), POINTS.view(nearest=SEEN_LAST), T_predicted
    ).is_lost


@pytest.mark.parametrize(("pixels", "found_again"), [(5, True), (14, False)])
def test_where_neither_is_recognised_all_around_is_looked_for_near_the_prediction(
    pixels, found_again
):
    """The window has 7 pixels, or 11 if a landmark is seen from the side, instead of 2.5 or 4."""
    drive, view = Drive.of_two_frames(SEEN_LAST), POINTS.view(nearest=SEEN_LAST)
    frame = drive.next_frame(SEEN_NOW)
    found = drive.track(frame, view, ahead(0.0, pixels / CAMERA.fx) @ at(2))
    assert found.n_inliers == (120 if found_again else 0)
    assert (frame.landmark >= 0).all() == found_again
    assert np.isfinite(frame.xyz).all() == found_again
    if found_again:
        np.testing.assert_allclose(frame.T_cw, at(2), atol=1e-4)


@pytest.mark.parametrize("last_saw", [SEEN_LAST, ALL], ids=["predicted", "motion"])
@pytest.mark.parametrize(("n_inliers", "found_again"), [(20, True), (19, False)])
def test_a_prediction_with_few_inliers_is_not_trusted(last_saw, n_inliers, found_again):
    drive, view = Drive.of_two_frames(last_saw), POINTS.view(nearest=NOTHING)
    frame = drive.next_frame(slice(240 - n_inliers, 240))
    assert drive.track(frame, view).is_lost != found_again
    assert (frame.landmark >= 0).all() == found_again


@pytest.mark.parametrize("last_saw", [SEEN_LAST, ALL], ids=["predicted", "motion"])
@pytest.mark.parametrize(("n_wrong", "found_again"), [(70, True), (71, False)])
def test_a_prediction_with_a_small_share_of_inliers_is_not_trusted(last_saw, n_wrong, found_again):
    """30 points are at their predicted positions. 70 or 71 points are six pixels away."""
    drive, view = Drive.of_two_frames(last_saw), POINTS.view(nearest=NOTHING)
    features = POINTS.see(at(2), slice(139, 240))
    features.xy[30 : 30 + n_wrong, 1] += np.where(np.arange(n_wrong) % 2, 6.0, -6.0)
    features = select(features, 30 + n_wrong)
    assert drive.track(frame_of(features, 2, 0.2), view).is_lost != found_again


@pytest.mark.parametrize(("pixels", "found_again"), [(90, True), (110, False)])
def test_a_frame_after_a_sudden_turn_is_tracked_from_the_last_frame(pixels, found_again):
    """Optimisation that starts at the predicted pose fails, because the turn is too large."""
    drive, view = Drive.of_two_frames(), POINTS.view(nearest=NOTHING)
    frame, T_predicted = drive.next_frame(), ahead(0.0, pixels / CAMERA.fx) @ at(2)
    assert (
        track_motion(drive.next_frame(), drive.tracker.last, T_predicted, NO_LANDMARKS, CONTEXT)[1]
        == 0
    )
    found = drive.track(frame, view, T_predicted)
    assert found.is_lost != found_again
    if found_again:
        np.testing.assert_allclose(frame.T_cw, at(2), atol=1e-4)


@pytest.mark.parametrize(("n_wrong", "found_again"), [(140, True), (150, False)])
def test_a_sudden_turn_needs_a_large_share_of_inliers(n_wrong, found_again):
    """The wrong matches are scattered, so that no pose agrees with many of them."""
    drive, view = Drive.of_two_frames(), POINTS.view(nearest=NOTHING)
    features = POINTS.see(at(2))
    away = np.random.default_rng(0).uniform(-30.0, 30.0, (n_wrong, 2)).astype(np.float32)
    features.xy[:n_wrong] += away
    features.u_right[:n_wrong] += away[:, 0]
    frame = frame_of(features, 2, 0.2)
    found = drive.track(frame, view, ahead(0.0, 60 / CAMERA.fx) @ at(2))
    assert found.is_lost != found_again
    if found_again:
        np.testing.assert_allclose(frame.T_cw, at(2), atol=1e-4)


def test_after_a_lost_frame_no_sudden_turn_is_expected():
    drive, view = Drive.of_two_frames(), POINTS.view(nearest=NOTHING)
    T_predicted = ahead(0.0, 60 / CAMERA.fx) @ at(3)
    drive.lose(2)
    assert drive.track(drive.next_frame(), view, T_predicted).is_lost


def test_without_a_speed_there_is_no_prediction_to_look_near():
    drive = Drive()
    drive.accept(0, SEEN_LAST)
    frame = drive.next_frame(SEEN_NOW)
    assert drive.track(frame, POINTS.view(nearest=SEEN_LAST)).is_lost


def test_a_found_frame_tracks_all_landmarks_around_and_says_which_it_should_see():
    """The last frame saw few of these landmarks. The newest landmark is behind the camera."""
    points = Points(np.vstack([POINTS.xyz, [[0.0, 0.0, -20.0]]]),
                    np.vstack([POINTS.descriptors, POINTS.descriptors[:1] ^ 255]))  # fmt: skip
    drive = Drive.of_two_frames(FEW)
    frame = drive.next_frame()
    found = drive.track(frame, points.view())
    np.testing.assert_array_equal(frame.landmark, np.arange(240))
    np.testing.assert_array_equal(found.visible, np.arange(240))
    assert (found.n_matches, found.n_inliers) == (240, 240)
    assert not found.relocalised


@pytest.mark.parametrize(("n_matches", "n_inliers", "state"), [
    (40, 30, TrackingState.OK),
    (40, 29, TrackingState.WEAK),
    (40, 15, TrackingState.WEAK),
    (40, 14, TrackingState.LOST),
    (1000, 30, TrackingState.OK),
])  # fmt: skip
def test_few_inliers_make_a_frame_weak_or_lost(n_matches, n_inliers, state):
    assert judge(n_matches, n_inliers, CONTEXT) == state


@pytest.mark.parametrize(("n_inliers", "state"), [
    (40, TrackingState.OK), (39, TrackingState.LOST),
])  # fmt: skip
def test_a_small_share_of_inliers_makes_a_frame_of_a_depth_camera_lost(n_inliers, state):
    context = TrackingContext.create(replace(CAMERA, depth=True), Config())
    assert judge(200, n_inliers, context) == state


# -- doubt ----------------------------------------------------------------------------------------

OLD, YOUNG = 6, 5  # numbers of keyframes; a map with five is young


def test_a_frame_after_a_gap_with_few_inliers_is_doubtful():
    """Frames arrive every tenth of a second. A gap is longer than 1.5 times this interval."""
    drive = Drive.of_two_frames()
    view = POINTS.view(n_reference=121, n_keyframes=YOUNG)
    assert drive.doubts(drive.next_frame(FEW, seconds=0.16), view)
    assert not drive.doubts(drive.next_frame(FEW, seconds=0.14), view)


def test_the_first_frames_come_after_no_gap():
    drive = Drive()
    drive.accept(0)
    view = POINTS.view(n_reference=121, n_keyframes=YOUNG)
    assert not drive.doubts(drive.next_frame(FEW, seconds=5.0), view)


@pytest.mark.parametrize(("n_reference", "few"), [(121, True), (120, False)])
def test_less_than_half_of_the_reference_keyframe_is_few(n_reference, few):
    drive = Drive.of_two_frames()
    frame = drive.next_frame(FEW, seconds=0.3)
    assert drive.doubts(frame, POINTS.view(n_reference=n_reference)) == few


def test_a_frame_with_few_inliers_next_to_one_found_in_the_map_is_doubtful():
    """The motion of the camera between the two frames is unknown."""
    drive = Drive.of_two_frames(FEW)
    drive.lose(2)
    drive.accept(3, FEW, keyframe=4)
    frame = drive.next_frame(FEW)
    assert drive.doubts(frame, POINTS.view(n_reference=121, n_keyframes=OLD))
    assert not drive.doubts(frame, POINTS.view(n_reference=120, n_keyframes=OLD))
    assert not drive.doubts(frame, POINTS.view(n_reference=121, n_keyframes=YOUNG))
    drive.accept(4, FEW)  # now the motion is known
    assert not drive.doubts(drive.next_frame(FEW), POINTS.view(n_reference=121, n_keyframes=OLD))


@pytest.mark.parametrize(("n_before", "sudden"), [(121, True), (120, False)])
def test_a_frame_that_lost_most_of_what_the_last_one_tracked_is_doubtful(n_before, sudden):
    drive = Drive.of_two_frames(slice(0, n_before))
    frame = drive.next_frame(FEW)
    assert drive.doubts(frame, POINTS.view(n_reference=240, n_keyframes=OLD)) == sudden
    assert not drive.doubts(frame, POINTS.view(n_reference=240, n_keyframes=YOUNG))
    assert not drive.doubts(frame, POINTS.view(n_reference=120, n_keyframes=OLD))


def test_where_no_frame_was_tracked_before_nothing_is_doubtful():
    drive = Drive()
    drive.tracker.resume()
    frame = POINTS.frame(0, 0.0, np.eye(4), FEW)
    assert not drive.doubts(frame, POINTS.view(n_reference=240, n_keyframes=OLD))


# -- state ----------------------------------------------------------------------------------------


def test_lost_frames_are_counted_until_one_is_found_or_begins_a_map():
    drive = Drive.of_two_frames()
    tracker = drive.tracker
    assert (tracker.status, tracker.lost_frames) == (TrackerStatus.TRACKING, 0)
    last = tracker.last
    drive.lose(2)
    drive.lose(3)
    assert (tracker.status, tracker.lost_frames) == (TrackerStatus.LOST, 2)
    assert tracker.last is last
    frame = drive.accept(4)
    assert (tracker.status, tracker.lost_frames) == (TrackerStatus.TRACKING, 0)
    assert tracker.last is frame
    drive.lose(5)
    start = POINTS.tracked_frame(6, 0.6, at(6))
    tracker.start_from(start)
    assert (tracker.status, tracker.lost_frames) == (TrackerStatus.TRACKING, 0)
    assert tracker.last is start


def test_before_the_first_frame_there_is_nothing_to_remember():
    tracker = Tracker(CONTEXT)
    assert tracker.state() is None
    tracker.resume(TWIST)
    assert tracker.state() is None


@pytest.mark.parametrize("lost", [0, 2])
def test_a_tracker_that_is_restored_goes_on_as_the_one_that_was_not(lost):
    """The last frame tracked 121 landmarks. The next frame tracks 60 landmarks."""
    drive = Drive()
    drive.accept(0)
    last = POINTS.tracked_frame(1, 0.1, at(1))
    last.landmark[121:], last.xyz[121:] = -1, np.nan
    drive.tracker.accept(last, Found(TrackingState.OK), drive.frames, 1)
    drive.frames.append(0.1, last.T_cw, tracked=True)
    for k in range(lost):
        drive.lose(2 + k)
    other = restored(drive.tracker)
    assert other.status is drive.tracker.status
    assert other.lost_frames == lost
    for field in fields(drive.tracker.state()):
        mine, theirs = (getattr(one.state(), field.name) for one in (other, drive.tracker))
        np.testing.assert_equal(mine, theirs, field.name)
    view, outcomes = POINTS.view(nearest=NOTHING, n_reference=240, n_keyframes=OLD), []
    for tracker in (drive.tracker, other):
        frame = drive.next_frame(FEW)
        T_cw = tracker.predict(frame.timestamp, drive.frames, view)
        found = tracker.track(frame, T_cw, view, drive.frames)
        assert (found.n_inliers, found.is_doubtful) == (60, True)
        tracker.accept(frame, found, drive.frames, 1)
        outcomes.append((T_cw.tobytes(), frame.T_cw.tobytes(), tracker.twist.tobytes()))
    assert outcomes[1] == outcomes[0]


def test_what_is_remembered_does_not_change_with_the_frame():
    drive = Drive.of_two_frames()
    state, last = drive.tracker.state(), drive.tracker.last
    last.landmark[:] = -1
    last.twist[:] = 0.0
    last.T_cw[:] = 0.0
    assert state.landmark.tolist() == list(range(240))
    np.testing.assert_allclose(state.twist, TWIST, atol=1e-9)
    np.testing.assert_array_equal(state.T_cw, at(1))
