"""The tracker in isolation, on hand-made views of a map, without a map, threads or ``Slam``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from parts import ALL, CAMERA, NOTHING, OneKeyframe, Points, ahead, frame_of

from vslam.config import Config
from vslam.frontend.images import GivenFeatures
from vslam.frontend.patch_tracking import NO_PATCHES_FOUND, PatchTrack
from vslam.frontend.prediction import Prediction
from vslam.frontend.tracker import Tracker, judge_patches
from vslam.frontend.tracking import judge, track_descriptors, track_motion, trusted_landmarks
from vslam.maps.checkpoint import CHECKPOINTS
from vslam.method.motion import Motion
from vslam.types.context import Context
from vslam.types.features import NO_PATCHES, Extracted, Features, TrackingState
from vslam.types.frame_poses import FramePoses
from vslam.types.geometry import se3_exp
from vslam.types.map_view import NO_LANDMARKS, MapView
from vslam.types.track import By, Track

CONTEXT = Context.create(CAMERA, Config())
POINTS = Points.create()
SEEN_LAST, SEEN_NOW = slice(0, 120), slice(120, 240)  # two halves of the points
FEW = slice(0, 60)
STEP = np.array([0.02, 0.0, -0.8, 0.0, -0.004, 0.0])  # motion of the camera between two frames
TWIST = STEP / 0.1  # at ten frames per second


def at(k: float) -> np.ndarray:
    """Return ``T_cw`` at frame k of a camera that moves at a constant speed."""
    return se3_exp(k * STEP)


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
        self.motion = Motion(CONTEXT, self.frames)
        self.last: Track | None = None

    @classmethod
    def of_two_frames(cls, among: slice = ALL) -> Drive:
        """Make a drive of two frames, so that the speed of the camera is known.

        The last frame saw some of the points.
        """
        drive = cls()
        drive.accept(0)
        drive.accept(1, among)
        return drive

    def accept(self, k: int, among: slice = ALL, *, by: By = By.FEATURES) -> Track:
        """Continue from a frame that was found at the true pose of frame k."""
        frame = POINTS.tracked_frame(len(self.frames), 0.1 * k, at(k), among)
        return self.follow(replace(frame, by=by))

    def follow(self, frame: Track) -> Track:
        """Continue from a frame, and return it with its velocity. The first frame has none."""
        predicted = self.expected(frame.timestamp)
        if self.last is not None:
            frame = self.motion.advance(frame, predicted, POINTS.view(n_keyframes=1))
        self.frames.append(frame.timestamp, frame.T_cw, tracked=not frame.is_lost)
        self.last = self.last if frame.is_lost else frame
        return frame

    def lose(self, k: int) -> None:
        """Continue from a frame that is not tracked, at its predicted pose."""
        self.follow(self.expected(0.1 * k).lost)

    def expected(self, timestamp: float, view: MapView | None = None) -> Prediction:
        return self.motion.predict(timestamp, self.last, view or POINTS.view())

    def predict(self, k: float) -> np.ndarray:
        return self.expected(0.1 * k).T_cw

    def next_frame(self, among: slice = ALL, *, seconds: float = 0.1) -> Track:
        """Return the frame after the last one, which sees some of the points."""
        last = self.frames.timestamp(-1)
        return POINTS.frame(len(self.frames), last + seconds, at(10.0 * (last + seconds)), among)

    def track(self, frame: Track, view: MapView, T_cw: np.ndarray | None = None) -> Track:
        """Track a frame from a predicted pose, which is by default its true pose."""
        T_cw = at(10.0 * frame.timestamp) if T_cw is None else T_cw
        predicted = replace(self.expected(frame.timestamp, view), T_cw=T_cw)
        images = GivenFeatures(frame.extracted)
        seen = self.tracker.extract(images, predicted, view)
        return self.tracker.track_features(seen, images, predicted, view)

    @property
    def stands_still(self) -> bool:
        return self.last is not None and self.last.still is not None

    def doubts(self, frame: Track, view: MapView) -> bool:
        """Track a frame at its true pose, and return whether the result is doubtful."""
        return self.track(frame, view).is_doubtful


# -- prediction -----------------------------------------------------------------------------------


def test_without_any_frame_the_camera_is_expected_at_the_reference_keyframe():
    view = replace(POINTS.view(), T_reference=ahead(3.0, 0.2))
    np.testing.assert_array_equal(Drive().expected(0.0, view).T_cw, ahead(3.0, 0.2))


def test_a_camera_whose_speed_is_unknown_is_expected_where_it_was():
    drive = Drive()
    drive.accept(0)
    np.testing.assert_allclose(drive.predict(5), at(0), atol=1e-12)


@pytest.mark.parametrize("k", [2, 4.5])
def test_the_speed_is_per_second_so_that_dropped_frames_do_not_disturb_it(k):
    drive = Drive.of_two_frames()
    np.testing.assert_allclose(drive.last.twist, TWIST, atol=1e-9)
    np.testing.assert_allclose(drive.predict(k), at(k), atol=1e-9)


def test_frames_that_were_stamped_on_arrival_are_taken_as_equally_spaced():
    """The frames arrive after 58, 58, 23 and 1 ms, although the camera moves evenly."""
    drive = Drive()
    stamps = np.cumsum([0, *[58, 58, 23, 1] * 3]) / 1000.0
    for k, stamp in enumerate(stamps[:-1]):
        if k > 8:
            np.testing.assert_allclose(drive.expected(stamp).T_cw, at(k), atol=0.1)
        drive.follow(POINTS.tracked_frame(k, stamp, at(k), FEW))


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
    assert drive.accept(30, by=By.PLACE).twist is None


# -- what is tracked ------------------------------------------------------------------------------


def test_a_tracker_that_has_nothing_to_go_on_does_not_track():
    drive = Drive()
    found = drive.track(POINTS.frame(0, 0.0, np.eye(4)), POINTS.view(), np.eye(4))
    assert found.is_lost
    assert (found.landmark == -1).all()


def test_a_drive_that_is_continued_is_tracked_from_the_reference_keyframe():
    drive = Drive()
    drive.motion.resume()
    found = drive.track(POINTS.frame(0, 0.0, ahead(0.7, 0.1)), POINTS.view(), np.eye(4))
    assert (found.state, found.n_inliers) == (TrackingState.OK, 240)
    np.testing.assert_array_equal(found.landmark, np.arange(240))
    np.testing.assert_allclose(found.T_cw, ahead(0.7, 0.1), atol=1e-4)


def test_a_continued_drive_has_the_speed_that_it_is_told():
    drive = Drive()
    drive.frames.append(0.0, at(0), tracked=True)
    drive.motion.resume(TWIST)
    np.testing.assert_allclose(drive.predict(3), at(3), atol=1e-12)
    # With the prediction, a frame is found that the reference keyframe does not show.
    frame, view = drive.next_frame(), POINTS.view(nearest=NOTHING)
    assert drive.track(frame, view).n_inliers == 240
    drive.motion.resume(None)
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
        np.testing.assert_allclose(found.T_cw, at(2), atol=1e-4)


def test_where_the_last_frame_shows_other_things_the_reference_keyframe_is_tried():
    """Only descriptors are compared, because the predicted pose is far from the true pose."""
    drive, frame_sees = Drive.of_two_frames(SEEN_LAST), SEEN_NOW
    T_predicted = ahead(0.0, 0.5) @ at(2)
    frame = drive.next_frame(frame_sees)
    found = drive.track(frame, POINTS.view(nearest=SEEN_NOW), T_predicted)
    assert found.n_inliers == 120
    np.testing.assert_array_equal(found.landmark, np.arange(120, 240))
    np.testing.assert_allclose(found.T_cw, at(2), atol=1e-4)
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
    assert (found.landmark >= 0).all() == found_again
    assert np.isfinite(found.xyz).all() == found_again
    if found_again:
        np.testing.assert_allclose(found.T_cw, at(2), atol=1e-4)


@pytest.mark.parametrize("last_saw", [SEEN_LAST, ALL], ids=["predicted", "motion"])
@pytest.mark.parametrize(("n_inliers", "found_again"), [(20, True), (19, False)])
def test_a_prediction_with_few_inliers_is_not_trusted(last_saw, n_inliers, found_again):
    drive, view = Drive.of_two_frames(last_saw), POINTS.view(nearest=NOTHING)
    frame = drive.next_frame(slice(240 - n_inliers, 240))
    found = drive.track(frame, view)
    assert found.is_lost != found_again
    assert (found.landmark >= 0).all() == found_again


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
    near = track_motion(drive.next_frame(), drive.last, T_predicted, NO_LANDMARKS, CONTEXT)
    assert near.n_inliers == 0
    found = drive.track(frame, view, T_predicted)
    assert found.is_lost != found_again
    if found_again:
        np.testing.assert_allclose(found.T_cw, at(2), atol=1e-4)


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
        np.testing.assert_allclose(found.T_cw, at(2), atol=1e-4)


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
    np.testing.assert_array_equal(found.landmark, np.arange(240))
    np.testing.assert_array_equal(found.visible, np.arange(240))
    assert (found.n_matches, found.n_inliers, found.by) == (240, 240, By.FEATURES)


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
    context = Context.create(replace(CAMERA, depth=True), Config())
    assert judge(200, n_inliers, context) == state


# -- moving objects -------------------------------------------------------------------------------

OBJECT = ahead(0.0, 60 / CAMERA.fx)  # motion of the camera relative to a moving object


def see_object(static: slice, moving: slice, T_static: np.ndarray, T_object: np.ndarray) -> Track:
    """Return frame 2, which sees points at rest from one pose, and an object from another pose."""
    at_rest, others = POINTS.see(T_static, static), POINTS.see(T_object, moving)
    names = ("xy", "octave", "angle", "descriptors", "u_right")
    joined = (np.concatenate([getattr(x, name) for x in (at_rest, others)]) for name in names)
    return frame_of(Features(*joined), 2, 0.2)


def test_descriptors_find_the_pose_of_most_landmarks_although_an_object_was_nearer():
    unknown = POINTS.landmarks()._replace(confirmed=np.zeros(240, np.bool_))
    frame = see_object(slice(0, 140), slice(140, 240), at(2), OBJECT @ at(2))
    found = track_descriptors(frame, unknown, OBJECT @ at(2), CONTEXT)
    assert found.n_inliers == 140
    np.testing.assert_allclose(found.T_cw, at(2), atol=1e-4)
    assert (found.landmark[140:] == -1).all()


@pytest.mark.parametrize(("n_close", "n_chosen"), [(30, 30), (29, 79)])
def test_close_confirmed_landmarks_are_trusted_unless_they_are_few(n_close, n_chosen):
    """Landmarks nearer than 20 m are close."""
    depth = np.repeat([19.0, 21.0, 5.0], [n_close, 50, 10])
    xyz = np.stack([np.zeros_like(depth), np.zeros_like(depth), depth + 2.0], axis=1)
    confirmed = np.arange(len(depth)) < n_close + 50
    chosen = trusted_landmarks(confirmed, xyz, ahead(2.0), CONTEXT)
    np.testing.assert_array_equal(chosen, np.arange(len(depth)) < n_chosen)


def patches(
    n: int = 300, expected: int = 0, trusted: int = 0, share: float = 1.0, **changes
) -> PatchTrack:
    """Return a frame in which n patches agree. ``expected`` trusted landmarks should be visible,
    and ``trusted`` of them agree."""
    return NO_PATCHES_FOUND._replace(
        ids=np.arange(n),
        n_matches=round(n / share),
        n_expected=expected,
        n_trusted=trusted,
        **changes,
    )


@pytest.mark.parametrize(("expected", "trusted", "support", "lacks"), [
    (29, 0, 300, False),  # hardly any trusted landmark is expected
    (30, 12, 12, False),
    (30, 11, 11, True),
    (100, 40, 40, False),
    (100, 39, 39, True),
])  # fmt: skip
def test_trusted_landmarks_support_a_pose_if_enough_are_expected(expected, trusted, support, lacks):
    track = patches(expected=expected, trusted=trusted)
    assert track.support == support
    assert track.lacks_support == lacks
    assert track.trusted_share == (trusted / expected if expected >= 30 else None)


@pytest.mark.parametrize(("track", "state"), [
    (patches(expected=30, trusted=30), TrackingState.OK),
    (patches(expected=30, trusted=29), TrackingState.LOST),
    (patches(expected=29, trusted=0), TrackingState.OK),
    (patches(share=0.6), TrackingState.WEAK),
    (patches(15, stands_still=True, expected=30), TrackingState.OK),
])  # fmt: skip
def test_patches_without_trusted_landmarks_are_not_believed(track, state):
    assert judge_patches(track, None, CONTEXT) == state


def test_a_standing_camera_is_not_tracked_by_a_small_share_of_patches():
    still = standing().last.still
    assert judge_patches(patches(share=0.6), still, CONTEXT) == TrackingState.LOST
    assert judge_patches(patches(), still, CONTEXT) == TrackingState.OK


class Hypotheses:
    """A tracker whose search for patches is replaced.

    Attributes:
        tried: the initial poses from which patches were searched for, by name. ``aligned`` and
            ``confirmed`` are found by image alignment of all landmarks, or of the confirmed ones.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, n_confirmed: int = 240, **tracks) -> None:
        self.tried: list[str] = []
        poses = {name: at(2).copy() for name in ("aligned", "predicted", "confirmed")}

        def align(tracker, frame, last, chosen, T_cw):
            return poses["aligned" if chosen.sum() == 240 else "confirmed"]

        def track(pyramid, T_cw, *_):
            (name,) = (name for name, T in poses.items() if T is T_cw)
            self.tried.append(name)
            return tracks[name]

        monkeypatch.setattr(Tracker, "_align", align)
        monkeypatch.setattr("vslam.frontend.tracker.track_patches", track)
        drive, images = Drive.of_two_frames(), GivenFeatures(Extracted.nothing(), pyramid=object())
        local = POINTS.landmarks()._replace(confirmed=np.arange(240) < n_confirmed)
        view = replace(
            POINTS.view(), local_landmarks=local, patches=NO_PATCHES._replace(ids=np.arange(1))
        )
        predicted = replace(drive.expected(0.2), T_cw=poses["predicted"])
        found = drive.tracker._find_patches(images, predicted, view, None)
        self.chosen = next((name for name, one in tracks.items() if one is found), None)
        self.found = found


def near(**options) -> PatchTrack:
    return patches(T_cw=at(2), **options)


def leap(metres: float = 0.11, **options) -> PatchTrack:
    """Return a pose that is far from the prediction. In 0.1 s, 0.1 m are plausible."""
    return patches(T_cw=ahead(metres) @ at(2), **options)


def test_an_aligned_pose_that_is_supported_is_the_only_one_that_is_tried(monkeypatch):
    found = Hypotheses(monkeypatch, aligned=near(expected=100, trusted=40))
    assert (found.chosen, found.tried) == ("aligned", ["aligned"])


@pytest.mark.parametrize("aligned", [
    near(n=400, expected=100, trusted=39),
    leap(n=400, expected=100, trusted=99),
    near(n=80, share=0.85),
], ids=["few trusted", "implausible", "small share"])  # fmt: skip
def test_the_prediction_is_tried_if_the_aligned_pose_is_doubtful(monkeypatch, aligned):
    predicted = near(n=200, expected=100, trusted=90)
    found = Hypotheses(monkeypatch, aligned=aligned, predicted=predicted)
    assert (found.chosen, found.tried) == ("predicted", ["aligned", "predicted"])


@pytest.mark.parametrize(("trusted", "chosen"), [(51, "predicted"), (50, "aligned")])
def test_an_implausible_acceleration_needs_twice_the_support(monkeypatch, trusted, chosen):
    found = Hypotheses(
        monkeypatch,
        aligned=leap(expected=100, trusted=100),
        predicted=near(expected=100, trusted=trusted),
    )
    assert found.chosen == chosen


@pytest.mark.parametrize(("n_confirmed", "tried"), [(30, True), (29, False)])
def test_confirmed_landmarks_are_aligned_if_neither_pose_is_supported(
    monkeypatch, n_confirmed, tried
):
    few = {"expected": 100, "trusted": 39}
    found = Hypotheses(
        monkeypatch,
        n_confirmed,
        aligned=near(n=400, **few),
        predicted=near(n=300, **few),
        confirmed=near(expected=100, trusted=60),
    )
    assert (found.chosen == "confirmed") == tried
    assert ("confirmed" in found.tried) == tried


@pytest.mark.parametrize(("metres", "believed"), [(0.09, True), (0.11, False)])
def test_an_implausible_pose_without_support_is_not_believed(monkeypatch, metres, believed):
    track = leap(metres, expected=100, trusted=39)
    found = Hypotheses(monkeypatch, aligned=track, predicted=track, confirmed=track)
    assert (found.chosen is not None) == believed
    assert (found.found is NO_PATCHES_FOUND) != believed


# -- standstill -----------------------------------------------------------------------------------

STATIC, MOVING = slice(0, 192), slice(192, 240)  # the object moves by a pixel in the last frame


def frame_by_patches(k: int, moved: slice = NOTHING, pixels: float = 0.0) -> Track:
    """Return frame k of a camera at rest, in which some points have moved to the right."""
    frame = POINTS.tracked_frame(k, 0.1 * k, np.eye(4))
    frame.features.xy[moved, 0] += pixels
    return replace(frame, by=By.PATCHES)


def standing(n: int = 240, moved: slice = MOVING, pixels: float = 1.0) -> Drive:
    """Make a drive of two frames at rest that tracked n points."""
    drive = Drive()
    for k in range(2):
        frame = frame_by_patches(k, *((moved, pixels) if k else ()))
        drive.follow(frame.without(slice(n, None)))
    return drive


@pytest.mark.parametrize(("drive", "stands"), [
    (standing(), True),
    (standing(moved=slice(0, 49)), False),  # 79 per cent did not move
    (standing(moved=ALL, pixels=0.39), True),
    (standing(moved=ALL, pixels=0.41), False),
    (standing(40, NOTHING), True),
    (standing(39, NOTHING), False),
    (Drive.of_two_frames(), False),
])  # fmt: skip
def test_a_camera_stands_still_if_landmarks_do_not_move_in_the_image(drive, stands):
    assert drive.stands_still == stands


@pytest.mark.parametrize("why", ["features", "lost", "weak"])
def test_only_two_consecutive_frames_that_were_tracked_by_patches_show_a_standstill(why):
    drive = Drive()
    drive.follow(frame_by_patches(0))
    k, by, state = 1, By.PATCHES, TrackingState.OK
    if why == "features":
        by = By.FEATURES
    if why == "lost":
        drive.lose(1)
        k = 2
    if why == "weak":
        state = TrackingState.WEAK
    drive.follow(replace(frame_by_patches(k), by=by, state=state))
    assert not drive.stands_still


@pytest.mark.parametrize(("stands_still", "speed"), [(True, 0.0), (False, 0.4)])
def test_a_standing_camera_has_no_speed(stands_still, speed):
    drive = standing()
    by = By.STANDSTILL if stands_still else By.PATCHES
    drive.follow(replace(frame_by_patches(2, ALL, 5.0), T_cw=ahead(0.04), by=by))
    assert np.linalg.norm(drive.last.twist) == pytest.approx(speed)
    assert drive.stands_still == stands_still


def unconfirmed(n_keyframes: int = 1) -> MapView:
    """Return a view of a map with a single keyframe, so that no landmark is confirmed."""
    nothing = POINTS.landmarks()._replace(confirmed=np.zeros(240, np.bool_))
    return replace(
        POINTS.view(), n_keyframes=n_keyframes, local_landmarks=nothing, reference_landmarks=nothing
    )


@pytest.mark.parametrize(("n_keyframes", "turn"), [(1, 0.0), (2, 4.0)])
def test_what_a_standing_camera_saw_at_rest_is_trusted_until_there_is_a_new_keyframe(
    n_keyframes, turn
):
    """The object has 48 landmarks, and 30 landmarks are at rest."""
    drive = standing()
    frame = see_object(slice(0, 30), MOVING, np.eye(4), ahead(0.0, 4.0 / CAMERA.fx))
    found = drive.track(frame, unconfirmed(n_keyframes), np.eye(4))
    assert found.state == TrackingState.OK
    np.testing.assert_allclose(found.T_cw, ahead(0.0, turn / CAMERA.fx), atol=1e-4)


@pytest.mark.parametrize(("n_static", "state"), [(30, TrackingState.OK), (29, TrackingState.LOST)])
def test_features_of_a_moving_object_do_not_take_a_standing_camera_along(n_static, state):
    drive = standing()
    frame = see_object(slice(0, n_static), MOVING, np.eye(4), ahead(0.0, 4.0 / CAMERA.fx))
    assert drive.track(frame, unconfirmed(), np.eye(4)).state == state


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
    drive.accept(3, FEW, by=By.PLACE)
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
    drive.motion.resume()
    frame = POINTS.frame(0, 0.0, np.eye(4), FEW)
    assert not drive.doubts(frame, POINTS.view(n_reference=240, n_keyframes=OLD))


# -- state ----------------------------------------------------------------------------------------


def test_lost_frames_are_counted_until_one_is_found_or_begins_a_map():
    drive = Drive.of_two_frames()
    last = drive.last
    drive.lose(2)
    drive.lose(3)
    predicted = drive.expected(0.4)
    assert (predicted.lost_frames, predicted.is_tracking, predicted.last) == (2, False, last)
    drive.accept(4)
    assert drive.expected(0.5).is_tracking
    drive.lose(5)
    drive.motion.keyframe(last)
    assert drive.expected(0.6).is_tracking


@pytest.mark.parametrize("make", [lambda: Drive.of_two_frames(slice(0, 121)), standing])
@pytest.mark.parametrize("lost", [0, 2])
def test_a_drive_that_is_restored_goes_on_as_the_one_that_was_not(make, lost):
    """The last frame tracked 121 or 240 landmarks. The next frame tracks 60 landmarks."""
    drive = make()
    for k in range(lost):
        drive.lose(2 + k)
    entry, arrays = CHECKPOINTS.encode(drive.last, "last")
    last = CHECKPOINTS.decode(Track, entry, arrays)
    motion = Motion(CONTEXT, drive.frames, state=drive.motion.state)
    view, outcomes = POINTS.view(nearest=NOTHING, n_reference=240, n_keyframes=OLD), []
    frame = drive.next_frame(FEW)
    for one in ((drive.last, drive.motion), (last, motion)):
        drive.last, drive.motion = one
        predicted = drive.expected(frame.timestamp, view)
        found = drive.track(frame, view, predicted.T_cw)
        found = drive.motion.advance(found, predicted, view)
        twist = found.twist
        outcomes.append((found.n_inliers, found.is_doubtful, found.T_cw.tobytes(), str(twist)))
    assert outcomes[1] == outcomes[0]
