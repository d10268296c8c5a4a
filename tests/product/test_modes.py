"""The two modes in isolation: one builds the map, the other does not change it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from parts import CAMERA, Points, ahead
from test_mapper import Drive, at, begin_with_two_views, bytes_of_map, see_points, see_without_depth

from vslam.frontend.images import GivenFeatures
from vslam.frontend.prediction import Prediction
from vslam.frontend.tracker import Tracker
from vslam.method.map_frames import OldPlace
from vslam.method.modes import Building, Localising
from vslam.types.camera import Camera
from vslam.types.features import TrackingState
from vslam.types.states import PolicyState
from vslam.types.track import By, Standstill, Track

POINTS = Points.create()
TWIST = np.array([0.0, 0.0, -2.0, 0.0, 0.0, 0.0])


class Mapped(Drive):
    """A mapper with the mode that builds its map.

    ``last`` is the last frame that was tracked, and ``lost`` is the number of lost frames since.
    """

    def __init__(self, camera: Camera = CAMERA, **options) -> None:
        see = see_without_depth if camera.monocular else see_points
        super().__init__(camera=camera, **{"see": see} | options)
        self.mode = Building(self.context, self.mapper, Tracker(self.context))
        self.lost = 0

    @classmethod
    def with_a_map(cls, **options) -> Mapped:
        """Make a map with keyframes at the frames 0 and 3. Two more frames follow."""
        drive = cls(**options)
        drive.steps([0, 3], 6)
        drive.published.publish()
        return drive

    def recorded_frame(self, **changes) -> Track:
        """Return the next frame, which tracks all landmarks that it should see, as recorded."""
        frame = self.next_frame()
        frame = replace(frame, visible=frame.tracked, by=By.FEATURES, **changes)
        self.published.record(frame)
        return frame

    def lost_frame(self, n: int = 1) -> Track:
        """Return the last one of n lost frames."""
        self.lost += n
        return self.recorded_frame(state=TrackingState.LOST).without()

    def standing(self, frame: Track) -> Track:
        ids, xy = np.arange(50, dtype=np.int32), np.zeros((50, 2), np.float32)
        return replace(frame, still=Standstill(np.eye(4), ids, xy, self.published.n_keyframes))

    def update(self, frame: Track) -> Track:
        """Update the map with a recorded frame."""
        lost = self.lost - 1 if frame.is_lost else self.lost
        args = frame.index, frame.timestamp, frame.T_cw
        predicted = Prediction(*args, last=self.last, lost_frames=lost)
        return self.mode.update_map(frame, GivenFeatures(frame.extracted), predicted)


# -- localising -----------------------------------------------------------------------------------


def test_localising_leaves_the_map_alone():
    """The map is byte-identical, including the counts of how often landmarks were seen."""
    drive = Mapped.with_a_map()
    published, drive.mode = drive.published, Localising(drive.published)
    mode = drive.mode
    lost, tracked = drive.lost_frame(10), drive.recorded_frame()
    before = bytes_of_map(published.wait())
    assert mode.begin(lost, None) is lost
    assert mode.map_far_points(drive.last) is None
    assert drive.update(lost) is lost
    assert drive.update(tracked) is tracked
    drive.mapper.finish()
    assert bytes_of_map(published.map) == before
    assert published.n_keyframes == 2
    assert mode.state() is None
    assert not mode.changes_map


def test_localising_tracks_by_the_keyframe_that_shares_the_most_with_a_frame():
    drive = Mapped(see=lambda k: POINTS.see(at(k), slice(20 * k, 20 * k + 100)))
    drive.steps([0, 3], 6)
    drive.published.publish()
    frame = drive.recorded_frame()
    drive.published.refer_to(0)
    drive.mode = Localising(drive.published)
    drive.update(frame)
    assert drive.published.reference == 1


# -- the beginning of a map -----------------------------------------------------------------------


def test_a_stereo_frame_begins_a_map():
    drive = Mapped()
    frame = drive.mode.begin(drive.lost_frame(), None)
    assert frame.is_keyframe
    assert drive.published.n_keyframes == 1
    assert len(frame.tracked) > 50
    assert drive.mode.state().gain_awaited
    assert drive.mode.changes_map


@pytest.mark.parametrize(("n_stereo", "begins"), [(100, True), (99, False)])
@pytest.mark.parametrize("camera", [CAMERA, replace(CAMERA, depth=True)], ids=["stereo", "depth"])
def test_a_map_needs_a_frame_with_enough_depths(camera, n_stereo, begins):
    drive = Mapped(camera)
    frame = drive.lost_frame()
    frame.features.u_right[n_stereo:] = np.nan
    before = drive.mode.state()
    assert drive.mode.begin(frame, None).is_keyframe == begins
    assert drive.published.n_keyframes == begins
    assert (drive.mode.state() == before) != begins


def test_a_monocular_map_begins_with_the_second_view():
    drive = Mapped(CAMERA.left_camera())
    assert not drive.mode.begin(drive.lost_frame(), None).is_keyframe
    assert drive.mode.state() is None  # the first view is not saved
    for _ in range(20):
        second = drive.mode.begin(drive.lost_frame(), None)
        if second.is_keyframe:
            break
    assert drive.published.n_keyframes == 2
    assert drive.published.map.frames.tolist() == [0, second.index]
    assert drive.mode.state() is not None
    assert drive.mode.state().gain_awaited


@pytest.mark.parametrize("twist", [TWIST, None])
def test_a_sub_map_is_placed_by_the_prediction_if_the_speed_is_known(twist):
    """The frame tracks no landmark of the previous map, but may have tracked some before."""
    drive = Mapped.with_a_map()
    frame = drive.recorded_frame(twist=twist)
    assert (frame.landmark >= 0).any()
    begun = drive.mode.begin(frame, None)
    assert (begun.is_keyframe, begun.twist) == (True, None)
    map_ = drive.published.wait()
    assert map_.restarts == [2]
    assert map_.unpredicted_restarts == ([] if twist is not None else [2])
    assert map_.parents[2] == 1


@pytest.mark.parametrize(("young_keyframes", "patience"), [(2, 1), (1, 3)])
def test_a_lost_stereo_camera_begins_a_sub_map_sooner_in_a_young_map(young_keyframes, patience):
    """A young map (two keyframes) waits for one lost frame, and an older map for three."""
    drive = Mapped.with_a_map(tracking={"young_keyframes": young_keyframes})
    for n in range(1, patience + 1):
        assert drive.update(drive.lost_frame()).is_keyframe == (n == patience)
    assert drive.published.n_keyframes == 3


def test_a_lost_monocular_camera_looks_for_a_first_view_after_four_frames():
    drive = Mapped(CAMERA.left_camera())
    begin_with_two_views(drive)
    offered = []
    drive.mode.starter.offer = lambda track, image: offered.append(track.index)
    frames = []
    for _ in range(4):
        frames.append(drive.lost_frame())
        assert not drive.update(frames[-1]).is_keyframe
    assert offered == [frames[3].index]
    assert drive.mode.state() is None  # frames wait for a sub-map


@pytest.mark.parametrize(("seconds", "begun"), [(4.9, False), (5.1, True)])
def test_a_standing_camera_waits_until_what_covers_its_view_has_passed(seconds, begun):
    drive = Mapped.with_a_map()
    drive.last = drive.standing(drive.recorded_frame())
    frame = drive.lost_frame(30)
    frame = replace(frame, timestamp=drive.last.timestamp + seconds)
    assert drive.update(frame).is_keyframe == begun


# -- more of a young map --------------------------------------------------------------------------


def test_a_frame_that_is_lost_right_after_a_map_began_may_see_more_of_it():
    drive = Mapped()
    assert drive.mode.map_far_points(None) is None  # there is no keyframe
    first = drive.mode.begin(drive.lost_frame(), None)
    shown = len(drive.published.view.local_landmarks.ids)
    # A later frame was tracked.
    assert drive.mode.map_far_points(replace(first, twist=TWIST)) is None
    assert len(drive.published.view.local_landmarks.ids) == shown
    more = drive.mode.map_far_points(first)
    assert len(more.tracked) == len(drive.published.view.local_landmarks.ids) == 240 > shown
    assert drive.mode.map_far_points(more) is None  # there are no more far points


def test_a_monocular_map_has_no_far_points_to_show():
    drive = Mapped(CAMERA.left_camera())
    begin_with_two_views(drive)
    drive.mapper.map_far_points = lambda frame: pytest.fail("a map without depths was asked")
    assert drive.mode.map_far_points(replace(drive.last, twist=None)) is None


# -- a tracked frame ------------------------------------------------------------------------------


def test_a_frame_that_shows_nothing_new_is_only_counted():
    drive = Mapped.with_a_map(min_tracked_close=0)
    frame = drive.recorded_frame()
    before = drive.published.wait().copy().arrays
    lost = np.flatnonzero(frame.landmark >= 0)[:5]
    gone = frame.landmark[lost]
    assert not drive.update(frame.without(lost)).is_keyframe
    assert drive.published.n_keyframes == 2
    after = drive.published.wait().copy().arrays
    seen = np.zeros(len(before.visible), int)
    seen[frame.visible] = 1
    np.testing.assert_array_equal(after.visible - before.visible, seen)
    seen[gone] = 0
    np.testing.assert_array_equal(after.found - before.found, seen)


def test_a_frame_becomes_a_keyframe_when_it_is_time():
    drive = Mapped.with_a_map(max_interval_s=0.5, min_tracked_close=0)
    made = [drive.update(drive.recorded_frame()).is_keyframe for _ in range(3)]
    assert made == [False, False, True]  # frames 6, 7 and 8; the previous keyframe is frame 3
    assert drive.published.last_frame == 8
    assert drive.mode.state().gain_awaited
    assert not drive.published.is_published


@pytest.mark.parametrize("stands_still", [True, False])
def test_a_frame_of_a_standing_camera_becomes_no_keyframe(stands_still):
    drive = Mapped.with_a_map(max_interval_s=0.05)
    by = By.STANDSTILL if stands_still else By.FEATURES
    frame = replace(drive.recorded_frame(), by=by)
    assert drive.update(frame).is_keyframe != stands_still


@pytest.mark.parametrize(("metres", "pixels", "stays"), [
    (0.049, 0.0, True),
    (0.051, 0.0, False),
    (0.0, 2.9, True),
    (0.0, 3.1, False),
])  # fmt: skip
def test_a_camera_that_comes_to_rest_at_its_reference_keyframe_makes_no_other(
    metres, pixels, stays
):
    """Another keyframe is made if it has moved by a tenth of the baseline, or by three pixels."""
    drive = Mapped.with_a_map(max_interval_s=0.05)
    T_cw = ahead(metres, pixels / CAMERA.fx) @ drive.published.view.T_reference
    frame = drive.standing(replace(drive.recorded_frame(), T_cw=T_cw))
    assert drive.update(frame).is_keyframe != stays


@pytest.mark.parametrize(("idle", "made"), [(True, True), (False, False)])
def test_a_frame_that_is_not_urgent_waits_for_mapping(idle, made):
    """The frame tracks seven tenths of the landmarks that the reference keyframe sees."""
    drive = Mapped.with_a_map(min_tracked_close=0, publish_after_frames=50, max_interval_s=50.0)
    if not idle:
        drive.mapper.insert(drive.recorded_frame(), None)
    assert drive.published.is_published == idle
    rest = slice(int(0.7 * drive.published.view.n_reference), None)
    assert drive.update(drive.recorded_frame().without(rest)).is_keyframe == made


@pytest.mark.parametrize(("known_after_s", "known"), [(0.5, True), (5.0, False)])
def test_at_an_old_place_no_keyframe_is_made(known_after_s, known):
    drive = Mapped.with_a_map(max_interval_s=0.05, known_after_s=known_after_s)
    frame = drive.recorded_frame()
    drive.mode.policy.state = PolicyState(100.0, gain_awaited=False)
    assert drive.update(frame).is_keyframe != known
    assert drive.published.n_keyframes == (2 if known else 3)
    assert drive.published.reference == (0 if known else 2)
    assert drive.published.last_timestamp == frame.timestamp
    assert drive.mode.state().gain_awaited  # the next frame is compared with this one


def test_a_place_is_known_by_the_features_of_a_frame_that_was_tracked_by_patches():
    """Few patches are left of an old place. A frame that returns there matches more features."""
    drive = Mapped.with_a_map(max_interval_s=0.05, known_after_s=0.5)
    by_features = drive.recorded_frame()
    others = np.flatnonzero(by_features.landmark >= 0)[40:]
    frame = replace(by_features.without(others), by=By.PATCHES)
    drive.mode._tracker.match_features = lambda *_: by_features
    drive.mode.policy.state = PolicyState(100.0, gain_awaited=False, due=frame.index)
    assert drive.update(frame) is by_features
    assert drive.published.n_keyframes == 2
    assert drive.published.reference == 0


@pytest.mark.parametrize(("n_tracked", "n_shared", "n_place", "known"), [
    (150, 100, 200, True),
    (149, 100, 200, False),
    (150, 99, 200, False),
    (150, 100, 201, False),
    (49, 49, 10, False),
])  # fmt: skip
def test_an_old_place_must_be_tracked_as_well_as_its_keyframe_was(
    n_tracked, n_shared, n_place, known
):
    drive = Mapped.with_a_map(max_interval_s=0.05)
    frame = drive.recorded_frame()
    frame = frame.without(np.flatnonzero(frame.landmark >= 0)[n_tracked:])
    drive.mapper.find_old_place = lambda frame: OldPlace(0, n_shared, n_place)
    assert drive.update(frame).is_keyframe != known


def test_a_frame_that_is_tracked_ends_the_wait_for_a_second_view():
    drive = Mapped(CAMERA.left_camera())
    begin_with_two_views(drive)
    drive.update(drive.lost_frame(4))
    assert drive.mode.state() is None
    drive.update(drive.recorded_frame())
    assert drive.mode.state() is not None


def test_a_mode_that_is_restored_remembers_what_the_other_did():
    drive = Mapped()
    drive.mode.begin(drive.lost_frame(), None)
    other = Building(drive.context, drive.mapper, Tracker(drive.context), drive.mode.state())
    assert other.state() == drive.mode.state() == PolicyState(200.0, True)
