"""The two modes in isolation: one builds the map, the other does not change it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from parts import CAMERA, Points, ahead
from test_mapper import Drive, at, begin_with_two_views, bytes_of_map, see_points, see_without_depth

from vslam.camera import Camera
from vslam.features import TrackingState
from vslam.frontend.frame import Frame
from vslam.frontend.tracker import Found, Tracker
from vslam.map_frames import OldPlace
from vslam.modes import MapBuilding, Mode
from vslam.states import PolicyState, Standstill

POINTS = Points.create()
TWIST = np.array([0.0, 0.0, -2.0, 0.0, 0.0, 0.0])


class Building(Drive):
    """A mapper with the mode that builds its map, and the tracker that this mode uses."""

    def __init__(self, camera: Camera = CAMERA, **options) -> None:
        see = see_without_depth if camera.monocular else see_points
        super().__init__(camera=camera, see=see, **options)
        self.tracker = Tracker(self.context)
        self.mode = MapBuilding(self.context, self.mapper, self.tracker)

    @classmethod
    def with_a_map(cls, **options) -> Building:
        """Make a map with keyframes at the frames 0 and 3. Two more frames follow."""
        drive = cls(**options)
        drive.steps([0, 3], 6)
        drive.mapper.merge()
        return drive

    def placed_frame(self, *, tracked: bool = True) -> Frame:
        """Return the next frame after it is placed. If it is not tracked, it has no landmarks."""
        frame = self.next_frame()
        if not tracked:
            frame.landmark[:], frame.xyz[:] = -1, np.nan
        self.mapper.hold(frame)
        self.mapper.append_pose(frame, tracked=tracked)
        return frame

    def stand_still(self) -> None:
        ids, xy = np.arange(50, dtype=np.int32), np.zeros((50, 2), np.float32)
        self.tracker._standstill = Standstill(np.eye(4), ids, xy, self.mapper.n_keyframes)

    def lost_frame(self, n: int) -> Frame:
        """Return the last one of n lost frames."""
        for _ in range(n):
            self.tracker.lose()
        return self.placed_frame(tracked=False)


def found(frame: Frame) -> Found:
    """Return the result of a frame that tracks all landmarks that it should see."""
    landmarks = frame.landmark[frame.landmark >= 0]
    return Found(TrackingState.OK, len(landmarks), len(landmarks), landmarks)


# -- localising -----------------------------------------------------------------------------------


def test_localising_leaves_the_map_alone():
    """The map is byte-identical, including the counts of how often landmarks were seen."""
    drive = Building.with_a_map()
    mapper, mode = drive.mapper, Mode(drive.mapper)
    lost, tracked = drive.lost_frame(10), drive.placed_frame()
    before = bytes_of_map(mapper.complete())
    assert not mode.begin(lost)
    assert not mode.begin_after_loss(lost)
    assert not mode.map_far_points()
    assert not mode.update_map(tracked, found(tracked))
    mode.restore(PolicyState(1.0, True))
    mapper.finish()
    assert bytes_of_map(mapper.map) == before
    assert mapper.n_keyframes == 2
    assert mode.state() is None
    assert not mode.changes_map


def test_localising_tracks_by_the_keyframe_that_shares_the_most_with_a_frame():
    drive = Drive(see=lambda k: POINTS.see(at(k), slice(20 * k, 20 * k + 100)))
    drive.steps([0, 3], 6)
    drive.mapper.merge()
    frame = drive.next_frame()
    drive.mapper.refer_to(0)
    Mode(drive.mapper).update_map(frame, found(frame))
    assert drive.mapper.reference == 1


# -- the beginning of a map -----------------------------------------------------------------------


def test_a_stereo_frame_begins_a_map():
    drive = Building()
    frame = drive.placed_frame()
    assert drive.mode.begin(frame)
    assert drive.mapper.n_keyframes == 1
    assert np.count_nonzero(frame.landmark >= 0) > 50
    assert drive.tracker.last is frame
    assert drive.mode.state().gain_awaited
    assert drive.mode.changes_map


def test_a_frame_with_too_few_depths_begins_none():
    drive = Building()
    frame = drive.placed_frame()
    frame.features.u_right[99:] = np.nan
    before = drive.mode.state()
    assert not drive.mode.begin(frame)
    assert drive.mapper.n_keyframes == 0
    assert drive.tracker.last is None
    assert drive.mode.state() == before


def test_a_monocular_map_begins_with_the_second_view():
    drive = Building(CAMERA.left_camera())
    assert not drive.mode.begin(drive.placed_frame())
    assert drive.mode.state() is None  # the first view is not saved
    for _ in range(20):
        second = drive.placed_frame(tracked=False)
        if drive.mode.begin(second):
            break
    assert drive.mapper.n_keyframes == 2
    assert drive.mapper.map.frames.tolist() == [0, second.index]
    assert drive.tracker.last is second
    assert drive.mode.state() is not None
    assert drive.mode.state().gain_awaited is False


@pytest.mark.parametrize("twist", [TWIST, None])
def test_a_sub_map_is_placed_by_the_prediction_if_the_speed_is_known(twist):
    """The frame tracks no landmark of the previous map, but may have tracked some before."""
    drive = Building.with_a_map()
    drive.tracker.resume(twist)
    frame = drive.placed_frame()
    assert (frame.landmark >= 0).any()
    assert drive.mode.begin(frame)
    map_ = drive.mapper.complete()
    assert map_.restarts == [2]
    assert map_.unpredicted_restarts == ([] if twist is not None else [2])
    assert map_.parents[2] == 1


@pytest.mark.parametrize(("young_keyframes", "patience"), [(2, 1), (1, 3)])
def test_a_lost_stereo_camera_begins_a_sub_map_sooner_in_a_young_map(young_keyframes, patience):
    """A young map (two keyframes) waits for one lost frame, and an older map for three."""
    drive = Building.with_a_map(tracking={"young_keyframes": young_keyframes})
    for n in range(1, patience + 1):
        begun = drive.mode.begin_after_loss(drive.lost_frame(1))
        assert begun == (n == patience)
    assert drive.mapper.n_keyframes == 3
    assert drive.tracker.lost_frames == 0


def test_a_lost_monocular_camera_looks_for_a_first_view_after_four_frames():
    drive = Building(CAMERA.left_camera())
    begin_with_two_views(drive)
    for _ in range(3):
        assert not drive.mode.begin_after_loss(drive.lost_frame(1))
        assert drive.mode.state() is not None
    assert not drive.mode.begin_after_loss(drive.lost_frame(1))
    assert drive.mode.state() is None  # a view waits for the second one


@pytest.mark.parametrize(("seconds", "begun"), [(4.9, False), (5.1, True)])
def test_a_standing_camera_waits_until_what_covers_its_view_has_passed(seconds, begun):
    drive = Building.with_a_map()
    drive.tracker.start_from(drive.placed_frame())
    drive.stand_still()
    frame = drive.lost_frame(30)
    frame.timestamp = drive.tracker.last.timestamp + seconds
    assert drive.mode.begin_after_loss(frame) == begun


# -- more of a young map --------------------------------------------------------------------------


def test_a_frame_that_is_lost_right_after_a_map_began_may_see_more_of_it():
    drive = Building()
    assert not drive.mode.map_far_points()  # there is no keyframe
    first = drive.placed_frame()
    drive.mode.begin(first)
    shown = len(drive.mapper.view.local_landmarks.ids)
    first.twist = TWIST
    assert not drive.mode.map_far_points()  # a later frame was tracked
    assert len(drive.mapper.view.local_landmarks.ids) == shown
    first.twist = None
    assert drive.mode.map_far_points()
    assert len(drive.mapper.view.local_landmarks.ids) == 240 > shown
    assert not drive.mode.map_far_points()  # there are no more far points


def test_a_monocular_map_has_no_far_points_to_show():
    drive = Building(CAMERA.left_camera())
    begin_with_two_views(drive)
    drive.tracker.start_from(drive.last)
    drive.last.twist = None
    drive.mapper.map_far_points = lambda frame: pytest.fail("a map without depths was asked")
    assert not drive.mode.map_far_points()


# -- a tracked frame ------------------------------------------------------------------------------


def test_a_frame_that_shows_nothing_new_is_only_counted():
    drive = Building.with_a_map(min_tracked_close=0)
    frame = drive.placed_frame()
    before = drive.mapper.complete().copy().arrays
    lost = np.flatnonzero(frame.landmark >= 0)[:5]
    gone = frame.landmark[lost].copy()
    says = found(frame)
    frame.landmark[lost] = -1
    assert not drive.mode.update_map(frame, says)
    assert drive.mapper.n_keyframes == 2
    after = drive.mapper.complete().copy().arrays
    seen = np.zeros(len(before.visible), int)
    seen[says.visible] = 1
    np.testing.assert_array_equal(after.visible - before.visible, seen)
    seen[gone] = 0
    np.testing.assert_array_equal(after.found - before.found, seen)


def test_a_frame_becomes_a_keyframe_when_it_is_time():
    drive = Building.with_a_map(max_interval_s=0.5, min_tracked_close=0)
    made = []
    for _ in range(3):
        frame = drive.placed_frame()
        made.append(drive.mode.update_map(frame, found(frame)))
    assert made == [False, False, True]  # frames 6, 7 and 8; the previous keyframe is frame 3
    assert drive.mapper.last_frame == 8
    assert drive.mode.state().gain_awaited
    assert not drive.mapper.is_merged


@pytest.mark.parametrize("stands_still", [True, False])
def test_a_frame_of_a_standing_camera_becomes_no_keyframe(stands_still):
    drive = Building.with_a_map(max_interval_s=0.05)
    frame = drive.placed_frame()
    says = replace(found(frame), stands_still=stands_still)
    assert drive.mode.update_map(frame, says) != stands_still


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
    drive = Building.with_a_map(max_interval_s=0.05)
    frame = drive.placed_frame()
    frame.T_cw = ahead(metres, pixels / CAMERA.fx) @ drive.mapper.view.T_reference
    drive.stand_still()
    assert drive.mode.update_map(frame, found(frame)) != stays


@pytest.mark.parametrize(("idle", "made"), [(True, True), (False, False)])
def test_a_frame_that_is_not_urgent_waits_for_mapping(idle, made):
    """The frame tracks seven tenths of the landmarks that the reference keyframe sees."""
    drive = Building.with_a_map(min_tracked_close=0, merge_after_frames=50, max_interval_s=50.0)
    if not idle:
        drive.mapper.insert(drive.placed_frame())
    assert drive.mapper.is_merged == idle
    frame = drive.next_frame()
    frame.landmark[int(0.7 * drive.mapper.view.n_reference) :] = -1
    drive.mapper.append_pose(frame, tracked=True)
    assert drive.mode.update_map(frame, found(frame)) == made


@pytest.mark.parametrize(("known_after_s", "known"), [(0.5, True), (5.0, False)])
def test_at_an_old_place_no_keyframe_is_made(known_after_s, known):
    drive = Building.with_a_map(max_interval_s=0.05, known_after_s=known_after_s)
    frame = drive.placed_frame()
    drive.mode.restore(PolicyState(100.0, gain_awaited=False))
    assert drive.mode.update_map(frame, found(frame)) != known
    assert drive.mapper.n_keyframes == (2 if known else 3)
    assert drive.mapper.reference == (0 if known else 2)
    assert drive.mapper.last_timestamp == frame.timestamp
    assert drive.mode.state().gain_awaited  # the next frame is compared with this one


def test_a_place_is_known_by_the_features_of_a_frame_that_was_tracked_by_patches():
    """Few patches are left of an old place. A frame that returns there matches more features."""
    drive = Building.with_a_map(max_interval_s=0.05, known_after_s=0.5)
    frame = drive.placed_frame()
    features, landmark, xyz = frame.features, frame.landmark.copy(), frame.xyz.copy()
    few = np.flatnonzero(landmark >= 0)[:40]
    frame.landmark, frame.xyz = np.full_like(landmark, -1), np.full_like(xyz, np.nan)
    frame.landmark[few], frame.xyz[few] = landmark[few], xyz[few]
    frame.source = object()

    def match(frame: Frame) -> bool:
        frame.source, frame.features = None, features
        frame.landmark, frame.xyz = landmark, xyz
        return True

    drive.mode._match_features = match
    drive.mode.restore(PolicyState(100.0, gain_awaited=False, due=frame.index))
    assert not drive.mode.update_map(frame, found(frame))
    assert drive.mapper.n_keyframes == 2
    assert drive.mapper.reference == 0


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
    drive = Building.with_a_map(max_interval_s=0.05)
    frame = drive.placed_frame()
    frame.landmark[np.flatnonzero(frame.landmark >= 0)[n_tracked:]] = -1
    drive.mapper.find_old_place = lambda frame: OldPlace(0, n_shared, n_place)
    assert drive.mode.update_map(frame, found(frame)) != known


def test_a_frame_that_is_tracked_ends_the_wait_for_a_second_view():
    drive = Building(CAMERA.left_camera())
    begin_with_two_views(drive)
    drive.mode.begin_after_loss(drive.lost_frame(4))
    assert drive.mode.state() is None
    frame = drive.placed_frame()
    drive.mode.update_map(frame, found(frame))
    assert drive.mode.state() is not None


def test_a_mode_that_is_restored_remembers_what_the_other_did():
    drive, other = Building(), Building()
    drive.mode.begin(drive.placed_frame())
    other.mode.restore(drive.mode.state())
    assert other.mode.state() == drive.mode.state() == PolicyState(200.0, True)
