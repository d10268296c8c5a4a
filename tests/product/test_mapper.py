"""The mapper in isolation: when it publishes, what moves with the map, and failures."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import fields, replace

import numpy as np
import pytest
import ring
from parts import CAMERA, InstantWorkers, Points, ahead, frame_of

from vslam.config import Config
from vslam.frontend.orb import build_pyramid
from vslam.frontend.patches import patches_around
from vslam.frontend.rig import with_offset
from vslam.frontend.tracking import track_local_map
from vslam.loopclosure.detector import NoDetector
from vslam.method.closing import LoopSearch
from vslam.method.map_frames import add_revisit
from vslam.method.mapping import Mapper
from vslam.method.published_map import PublishedMap
from vslam.method.starter import TwoViewStart
from vslam.slam import Slam
from vslam.support.workers import Workers
from vslam.types.camera import Camera
from vslam.types.context import Context
from vslam.types.features import PATCH_PIXELS, Extracted, Features, KeyframePatches, TrackingState
from vslam.types.frame_poses import FrameTable
from vslam.types.geometry import inverse, se3_exp
from vslam.types.map import Map
from vslam.types.map_kernels import erase_landmark
from vslam.types.map_view import MapView
from vslam.types.revisits import MAX_REVISITS
from vslam.types.states import PublishedState
from vslam.types.track import Track

POINTS = Points.create()
RING = ring.Ring.create(zoom=True)
# A job runs either as late as possible (when its result is needed) or at once.
late_and_early = pytest.mark.parametrize(
    "workers", [lambda: Workers(1), InstantWorkers], ids=["late", "early"]
)

AT_THE_END = -1  # instead of the number of a keyframe


class Closing:
    """Loop closing that finds no loops.

    At the end of each mapping job and at the end of the drive, it changes the map as a test
    requires.
    """

    def __init__(self, job: Callable[[Map, int], None] | None = None) -> None:
        self.is_adjusting = False
        self.is_due = False
        self.finished = 0
        self.closed: list[object] = []
        self._job = job

    def process(self, map_: Map, keyframe: int, *_: object) -> None:
        if self._job is not None:
            self._job(map_, keyframe)

    def apply_adjustment_if_due(self, map_: Map, keyframe: int) -> None:
        self.process(map_, keyframe)

    def search(self, map_: Map, keyframe: int, features: Features, image) -> LoopSearch:
        return LoopSearch()

    def close(self, map_: Map, search: LoopSearch) -> None:
        assert search.loop is None

    def count_reused_keyframe(self, map_: Map, *, new: bool) -> bool:
        assert new
        return self.is_due

    def count_revisit(self, map_: Map) -> None:
        pass

    def adjust_after_revisits(self, map_: Map) -> None:
        pass

    def conclude(self, map_: Map) -> None:
        if self._job is not None:
            self._job(map_, AT_THE_END)

    def finish(self, map_: Map) -> None:
        self.finished += 1


def see_points(k: int) -> Features:
    return POINTS.see(at(k))


def at(k: int) -> np.ndarray:
    """Return ``T_cw`` of a camera that moves ahead by 0.2 m per frame."""
    return ahead(0.2 * k, 0.002 * k)


class Drive:
    """A mapper, and frames that are tracked in its view of the map.

    There are ten frames per second, which are 0.2 m apart.
    """

    def __init__(
        self,
        workers: Workers | None = None,
        closing: Closing | None = None,
        camera: Camera = CAMERA,
        see: Callable[[int], Features] = see_points,
        poses: Callable[[int], np.ndarray] = at,
        tracking: dict[str, int] | None = None,
        **keyframes: float,
    ) -> None:
        config = Config.model_validate({"keyframes": keyframes, "tracking": tracking or {}})
        self.context = Context.create(camera, config)
        self.closing = closing or Closing()
        self.continue_in(None, workers=workers)
        self.last: Track | None = None
        self._see, self._at = see, poses

    def continue_in(
        self,
        map_: Map | None,
        frames: FrameTable | None = None,
        state: PublishedState | None = None,
        workers: Workers | None = None,
    ) -> None:
        workers = workers or Workers(1)
        self.mapper = Mapper(self.context, self.closing, workers, map_, frames, state)
        self.published = self.mapper.published

    def next_frame(self) -> Track:
        """Return the next frame at its true pose, tracked in the mapper's view of the map."""
        k, view = len(self.published.frames), self.published.view
        extracted = with_offset(Extracted(self._see(k)), view.disparity_offset)
        frame = replace(frame_of(extracted, k, 0.1 * k, self._at(k)), state=TrackingState.OK)
        if view.n_keyframes:
            frame = track_local_map(frame, view.local_landmarks, self.context, window=8.0)
            self.published.count(frame)
        return frame

    def step(self, *, keyframe: bool = False) -> Track:
        """Track the next frame and record it. If requested, make it a keyframe."""
        self.published.publish(frame=len(self.published.frames))
        frame = self.next_frame()
        self.published.record(frame)
        self.last = self.mapper.insert(frame, None) if keyframe else frame
        return self.last

    def steps(self, keyframes: Iterable[int], n: int) -> None:
        """Track and record n frames. Some of them become keyframes."""
        for k in range(n):
            self.step(keyframe=k in keyframes)


def bytes_of_view(view: MapView) -> bytes:
    values = (getattr(view, field.name) for field in fields(view))
    arrays = (x for value in values for x in (value if isinstance(value, tuple) else (value,)))
    return b"".join(np.ascontiguousarray(x).tobytes() for x in arrays)


def bytes_of_map(map_: Map) -> bytes:
    columns = map_.copy().columns()
    return b"".join(array.tobytes() for array in columns.values()) + repr(map_.scalars).encode()


# -- the schedule ---------------------------------------------------------------------------------


def test_the_first_keyframe_is_mapped_at_once():
    drive = Drive()
    assert (drive.published.n_keyframes, drive.published.is_published) == (0, True)
    drive.step(keyframe=True)
    assert drive.published.n_keyframes == 1
    assert drive.published.is_published
    assert not drive.published.is_mapping
    assert len(drive.published.view.local_landmarks.ids) == drive.published.map.n_landmarks > 50


@late_and_early
@pytest.mark.parametrize("after", [1, 2, 4])
def test_a_keyframe_is_published_at_the_frame_that_is_due_and_no_other(workers, after):
    drive = Drive(workers(), publish_after_frames=after)
    drive.steps([0, 3], 4)
    published, shown = drive.published, drive.published.view
    assert (published.last_frame, shown.reference, shown.n_keyframes) == (3, 1, 2)
    for _ in range(after - 1):
        drive.step()
        assert (published.is_published, published.is_mapping) == (False, True)
        assert published.view is shown
    drive.step()
    assert (published.is_published, published.is_mapping) == (True, False)
    assert published.view is not shown
    assert len(published.view.local_landmarks.ids) > len(
        shown.local_landmarks.ids
    )  # with two keyframes, landmarks are triangulated
    now = published.view
    drive.step()
    assert published.view is now


@late_and_early
def test_whoever_changes_the_map_publishes_first(workers):
    for use in (
        lambda drive: drive.published.publish(),
        lambda drive: drive.mapper.finish(),
        lambda drive: drive.published.complete(drive.last),
        lambda drive: drive.mapper.map_far_points(drive.last),
        lambda drive: drive.mapper.insert(drive.last, None),
    ):
        drive = Drive(workers(), publish_after_frames=9)
        drive.steps([0, 3], 4)
        shown = drive.published.view
        use(drive)
        assert drive.published.is_published == (drive.published.n_keyframes == 2)
        assert len(drive.published.view.local_landmarks.ids) > len(shown.local_landmarks.ids)


def test_a_keyframe_publishes_the_one_before():
    processed = []
    drive = Drive(closing=Closing(lambda map_, keyframe: processed.append(keyframe)))
    drive.steps([0, 3, 4], 4)
    assert processed == [0]
    drive.step(keyframe=True)
    assert processed == [0, 1]
    assert not drive.published.is_published  # the new keyframe is not published


def trace_on_the_ring(
    workers, look: Callable[[PublishedMap], object] = lambda published: None
) -> list:
    """Return what tracking sees at each frame of the ring, and the final map.

    The features are noisy. ``look`` is called after each frame.
    """
    drive = Drive(
        workers,
        camera=ring.CAMERA,
        see=lambda k: RING.see(0.4 * k, 1),
        poses=lambda k: inverse(RING.pose(0.4 * k)) @ RING.pose(0),
    )
    seen = []
    for k in range(16):
        frame = drive.step(keyframe=k in (0, 2, 5, 6, 9, 13))
        published = drive.published
        assert np.count_nonzero(frame.landmark >= 0) > 200
        counts = (published.is_published, published.reference, published.n_keyframes)
        poses = [frame.T_cw, *(published.frames.pose(i) for i in (-1, published.last_frame))]
        seen.append((counts, bytes_of_view(published.view), np.array(poses).tobytes()))
        look(published)
    drive.mapper.finish()
    assert (
        len({view for _, view, _ in seen}) == 10
    )  # each keyframe and each publication changes the view
    trajectory = drive.published.trajectory().T_wc.tobytes()
    return [*seen, bytes_of_map(drive.published.map), trajectory]


def test_nothing_tells_whether_a_keyframe_is_mapped_early_or_late():
    assert trace_on_the_ring(InstantWorkers()) == trace_on_the_ring(Workers(1))


def test_completing_a_keyframe_early_changes_no_result():
    assert trace_on_the_ring(Workers(1), PublishedMap.wait) == trace_on_the_ring(Workers(1))


@late_and_early
def test_completing_shows_tracking_nothing(workers):
    drive = Drive(workers(), publish_after_frames=9)
    drive.steps([0, 3], 5)
    published, shown = drive.published, drive.published.view
    map_ = published.wait()
    assert len(np.unique(map_.arrays.first_keyframe[: map_.n_landmarks])) == 2
    assert (published.is_published, published.is_mapping) == (False, False)
    assert published.view is shown
    assert published.wait() is map_  # the second call returns the same map
    published.publish()
    assert published.view is not shown


@late_and_early
def test_the_map_is_not_to_be_had_while_a_keyframe_is_mapped(workers):
    drive = Drive(workers(), publish_after_frames=9)
    drive.steps([0, 3], 5)
    for use in (lambda: drive.published.map, drive.published.trajectory):
        with pytest.raises(RuntimeError, match="a keyframe is being mapped"):
            use()
    # Frames are placed by the reference keyframe. Other keyframes may be moving.
    np.testing.assert_array_equal(drive.published.keyframe(1)[0], drive.published.view.T_reference)
    with pytest.raises(RuntimeError, match="a keyframe is being mapped"):
        drive.published.keyframe(0)


def test_a_trajectory_is_not_to_be_had_even_if_all_frames_follow_the_reference_keyframe():
    """This is the state at the beginning of a new drive in an existing map."""
    drive = Drive()
    drive.steps([0, 3], 6)
    map_ = drive.published.wait()
    drive.continue_in(map_)
    drive.step(keyframe=True)
    with pytest.raises(RuntimeError, match="a keyframe is being mapped"):
        drive.published.trajectory()


@late_and_early
def test_the_map_counts_what_frames_saw_when_it_is_free(workers):
    drive = Drive(workers(), publish_after_frames=9)
    drive.steps([0, 3], 4)
    visible, found = np.array([3, 4, 5], np.int32), np.array([4], np.int32)
    for _ in range(2):
        drive.published.count(replace(drive.last, visible=visible, landmark=found))
    counters = [], []
    for one in (drive, Drive(workers(), publish_after_frames=9)):
        if one is not drive:
            one.steps([0, 3], 4)
        arrays = one.published.wait().arrays
        counters[0].append(arrays.visible[3:6].copy())
        counters[1].append(arrays.found[3:6].copy())
    np.testing.assert_array_equal(counters[0][0] - counters[0][1], [2, 2, 2])
    np.testing.assert_array_equal(counters[1][0] - counters[1][1], [0, 2, 0])
    before = arrays.visible[3]
    drive.published.wait()
    assert arrays.visible[3] == before  # each frame counts once


# -- what follows the map -------------------------------------------------------------------------

MOVES = [se3_exp(np.array(twist)) for twist in ([0.3, 0, 0, 0, 0.02, 0], [0, 0, -0.4, 0.03, 0, 0])]


@late_and_early
def test_frames_move_with_the_map(workers):
    """A frame that is not recorded follows the reference keyframe."""

    def move(map_: Map, keyframe: int) -> None:
        for k in range(keyframe + 1 if keyframe else 0):
            map_.arrays.T_cw[k] = map_.arrays.T_cw[k] @ MOVES[k]

    drive = Drive(workers(), Closing(move), publish_after_frames=9)
    drive.step(keyframe=True)
    placed = drive.step()
    T_0 = drive.published.view.T_reference
    drive.step(keyframe=True)
    T_1 = drive.published.view.T_reference
    unplaced = drive.next_frame()
    before = [frame.T_cw.copy() for frame in (placed, unplaced)]
    moved = drive.published.publish(placed, unplaced)
    after = drive.published.map.arrays.T_cw
    assert np.linalg.norm((after[0] @ inverse(T_0))[:3, 3]) > 0.1
    np.testing.assert_allclose(moved[0].T_cw, before[0] @ inverse(T_0) @ after[0], atol=1e-12)
    np.testing.assert_allclose(moved[1].T_cw, before[1] @ inverse(T_1) @ after[1], atol=1e-12)
    np.testing.assert_array_equal(placed.T_cw, before[0])  # what was passed is not changed
    np.testing.assert_array_equal(moved[0].T_cw, drive.published.frames.pose(placed.index))


@late_and_early
def test_moved_frames_track_what_became_of_their_landmarks(workers):
    gone = 7

    def change(map_: Map, keyframe: int) -> None:
        if keyframe == 1:
            erase_landmark(map_.arrays, gone)
            map_.arrays.xyz[: map_.n_landmarks] += 0.25
            map_.scalars = replace(map_.scalars, disparity_offset=0.125)

    drive = Drive(workers(), Closing(change), publish_after_frames=9)
    drive.steps([0, 3], 4)
    held = [drive.last, drive.next_frame()]
    moved = drive.published.publish(*held)
    arrays = drive.published.map.arrays
    for frame, before in zip(moved, held, strict=True):
        assert gone in before.landmark
        expected = np.where(before.landmark == gone, -1, before.landmark)
        np.testing.assert_array_equal(frame.landmark, expected)
        known = frame.landmark >= 0
        np.testing.assert_array_equal(frame.xyz[known], arrays.xyz[frame.landmark[known]])
        assert np.isnan(frame.xyz[~known]).all()
        u_right = before.features.u_right
        np.testing.assert_allclose(frame.features.u_right, u_right - 0.125, atol=1e-4)
    assert drive.published.view.disparity_offset == 0.125


def see_without_depth(k: int) -> Features:
    features = POINTS.see(at(k))
    features.u_right[:] = np.nan
    return features


def monocular_drive(workers, closing: Closing) -> Drive:
    """Make a monocular map of two keyframes that are 0.6 m apart."""
    camera = CAMERA.left_camera()
    drive = Drive(workers, closing, camera, see_without_depth, publish_after_frames=9)
    begin_with_two_views(drive)
    return drive


def begin_with_two_views(drive: Drive) -> None:
    frames = []
    for _ in range(4):
        lost = replace(drive.next_frame(), T_cw=np.eye(4), state=TrackingState.LOST)
        frames.append(lost)
        drive.published.record(lost)
    every = np.arange(len(POINTS.xyz))
    views, images = (frames[0], frames[3]), (None, None)
    start = TwoViewStart(*views, images, at(3), (every, every), POINTS.xyz)
    _, drive.last = drive.mapper.begin(start)


def test_a_monocular_map_begins_with_two_keyframes():
    processed = []
    drive = monocular_drive(None, Closing(lambda map_, k: processed.append(k)))
    map_, second = drive.published.map, drive.last
    assert processed == [0, 1]
    assert (drive.published.is_published, drive.published.last_frame) == (True, 3)
    assert drive.published.last_timestamp == second.timestamp
    assert (map_.frames.tolist(), map_.parents.tolist()) == ([0, 3], [-1, 0])
    assert map_.n_landmarks == 240
    scale = np.linalg.norm(map_.arrays.T_cw[1][:3, 3]) / np.linalg.norm(at(3)[:3, 3])
    np.testing.assert_array_equal(second.T_cw, map_.arrays.T_cw[1])
    np.testing.assert_array_equal(second.xyz, map_.arrays.xyz[second.landmark])
    np.testing.assert_allclose(second.twist[:3] * 0.3, scale * drive_twist(3)[:3], atol=1e-9)


def drive_twist(k: int) -> np.ndarray:
    return np.array([0.0, 0.0, -0.2 * k, 0.0, -0.002 * k, 0.0])


@late_and_early
def test_where_the_unit_of_a_monocular_map_changes_speeds_and_poses_change_with_it(workers):
    def double(map_: Map, keyframe: int) -> None:
        if keyframe == 2:
            map_.arrays.xyz[: map_.n_landmarks] *= 2.0
            map_.arrays.T_cw[:3, :3, 3] *= 2.0
            map_.unit_scale[:] = [2.0] * 3

    drive = monocular_drive(workers(), Closing(double))
    placed = drive.step()
    drive.step(keyframe=True)
    unplaced = drive.next_frame()
    held = [replace(frame, twist=np.arange(1.0, 7.0)) for frame in (placed, unplaced)]
    moved = drive.published.publish(*held)
    for frame, before in zip(moved, held, strict=True):
        np.testing.assert_allclose(frame.twist, [2, 4, 6, 4, 5, 6])
        # All positions are measured from the first keyframe, which is the origin.
        np.testing.assert_allclose(frame.T_cw[:3, 3], 2.0 * before.T_cw[:3, 3], atol=2e-3)
        np.testing.assert_allclose(frame.T_cw[:3, :3], before.T_cw[:3, :3], atol=1e-4)
    moved = drive.mapper.finish(*moved)  # finish has changed nothing
    np.testing.assert_allclose(moved[0].twist, [2, 4, 6, 4, 5, 6])


@pytest.mark.parametrize("adjusting", [False, True])
def test_where_culled_landmarks_are_dropped_frames_track_the_same_points(adjusting, monkeypatch):
    """Global bundle adjustment refers to landmarks by their numbers.

    Therefore, culled landmarks are not dropped while it runs.
    """

    def kill(map_: Map, keyframe: int) -> None:
        if keyframe == 1:
            for landmark in range(0, 60, 3):
                erase_landmark(map_.arrays, landmark)

    drive = Drive(None, Closing(kill), publish_after_frames=9)
    drive.steps([0, 3], 4)
    drive.published.publish()
    drive.closing.is_adjusting = adjusting
    monkeypatch.setattr(Map, "many_culled_landmarks", True)
    drive.step()
    new = drive.next_frame()
    drive.published.record(new)
    keyframe = drive.mapper.insert(new, None)
    map_ = drive.published.wait()
    assert map_.arrays.landmark_alive[: map_.n_landmarks].all() != adjusting
    known = new.landmark >= 0
    assert np.array_equal(keyframe.landmark[known], new.landmark[known]) == adjusting
    assert (keyframe.landmark[known] >= 0).all()
    now = map_.arrays.xyz[keyframe.landmark[known]]
    np.testing.assert_allclose(now, new.xyz[known], atol=0.05)


# -- the reference keyframe -----------------------------------------------------------------------


def test_a_frame_may_be_placed_by_the_keyframe_near_which_it_was_found():
    drive = Drive()
    drive.steps([0, 3], 6)
    assert drive.published.reference == 1
    frame = replace(drive.next_frame(), near=0)
    drive.published.record(frame)
    assert drive.published.reference == 0
    assert drive.published.frames.table().reference[-1] == 0
    np.testing.assert_allclose(drive.published.frames.pose(-1), frame.T_cw, atol=1e-12)


def test_the_reference_can_be_the_keyframe_that_shares_the_most_with_a_frame():
    drive = Drive(see=lambda k: POINTS.see(at(k), slice(20 * k, 20 * k + 100)))
    drive.steps([0, 3], 6)
    published, frame = drive.published, drive.next_frame()
    published.refer_to(0)
    published.refer_to_nearest(frame)
    assert published.reference == 1
    others = frame.without(np.isin(frame.landmark, published.map.landmarks_of(1)))
    published.refer_to_nearest(others)
    assert published.reference == 1  # the frame shares no landmark with any keyframe
    old = np.setdiff1d(published.map.landmarks_of(0), published.map.landmarks_of(1))[:20]
    published.refer_to_nearest(replace(frame, landmark=old))
    assert published.reference == 0


@pytest.mark.parametrize(("known_after_s", "known"), [(0.5, True), (0.51, False)])
def test_a_place_is_old_when_its_keyframe_is(known_after_s, known):
    drive = Drive(known_after_s=known_after_s)
    drive.steps([0, 3], 5)
    frame = drive.step()
    assert frame.timestamp == 0.5
    place = drive.mapper.find_old_place(frame)
    assert (place is not None) == known
    if place is not None:
        map_ = drive.published.map
        shared = np.intersect1d(frame.landmark, map_.landmarks_of(0))
        assert (place.keyframe, place.n_shared) == (0, len(shared))
        assert place.n_place == 0  # only two keyframes see anything


def test_what_is_seen_at_a_known_place_is_kept_a_few_times():
    drive = Drive(known_after_s=0.3)
    drive.steps([0, 3], 6)
    mapper, published, frame = drive.mapper, drive.published, drive.last
    mapper.use_existing_keyframe(mapper.find_old_place(frame), frame)
    revisits = published.map.revisits
    assert revisits.keyframe.tolist() == [0]
    np.testing.assert_array_equal(revisits.landmark, frame.tracked)
    T_cw = revisits.T_c_keyframe[0] @ published.map.keyframe_pose(0)
    np.testing.assert_allclose(T_cw, frame.T_cw, atol=1e-12)
    kept = [add_revisit(published.map, 0, frame, 1) for _ in range(2 * MAX_REVISITS)]
    assert kept == [True] * (MAX_REVISITS - 1) + [False] * (MAX_REVISITS + 1)
    assert len(published.map.revisits) == MAX_REVISITS


@pytest.mark.parametrize("is_due", [False, True])
def test_an_old_keyframe_can_serve_in_place_of_a_new_one(is_due):
    """It also counts for a global bundle adjustment whose result is due."""
    drive = Drive(known_after_s=0.3)
    drive.steps([0, 3], 6)
    mapper, published, frame = drive.mapper, drive.published, drive.last
    drive.closing.is_due = is_due
    mapper.use_existing_keyframe(mapper.find_old_place(frame), frame)
    assert (published.reference, published.n_keyframes) == (0, 2)
    assert published.last_timestamp == frame.timestamp
    assert published.frames.table().reference[-1] == 0
    np.testing.assert_allclose(published.frames.pose(-1), frame.T_cw, atol=1e-12)
    assert published.last_frame == (frame.index if is_due else 3)
    assert (published.is_mapping, published.is_published) == (is_due, not is_due)
    drive.step()
    assert drive.closing.finished == 0
    drive.step()  # two frames later
    assert drive.closing.finished == is_due
    assert published.is_published


def with_an_image(frame):
    """Give a frame the pyramid of an image of noise, from which patches can be taken."""
    image = np.random.default_rng(0).integers(0, 256, (CAMERA.height, CAMERA.width), np.uint8)
    pyramid = build_pyramid(image, Config().orb)
    return replace(frame, extracted=replace(frame.extracted, pyramid=pyramid))


def test_at_a_known_place_the_patches_are_those_of_the_frame_until_the_next_keyframe():
    drive = Drive(known_after_s=0.3)
    drive.steps([0, 3], 6)
    mapper, published, frame = drive.mapper, drive.published, with_an_image(drive.last)
    mapper.use_existing_keyframe(mapper.find_old_place(frame), frame)
    shown = published.view.patches
    tracked = np.flatnonzero(np.isin(frame.landmark, published.view.local_landmarks.ids))
    of_frame = dict(zip(frame.landmark[tracked].tolist(), tracked.tolist(), strict=True))
    assert shown.ids.tolist() == sorted(of_frame)
    feature = np.array([of_frame[k] for k in shown.ids.tolist()])
    np.testing.assert_array_equal(
        shown.pixels[shown.where],
        patches_around(
            frame.extracted.pyramid, frame.features.xy[feature], frame.features.octave[feature]
        ),
    )
    np.testing.assert_array_equal(shown.angle, frame.features.angle[feature])
    np.testing.assert_allclose(shown.T_cw[shown.view[0]], frame.T_cw, atol=1e-12)

    again = Drive()
    again.continue_in(published.map.copy(), published.frames.table(), published.state())
    assert bytes_of_view(again.published.view) == bytes_of_view(published.view)

    drive.step(keyframe=True)
    assert published.state().known_place is None
    assert not len(published.view.patches.ids)  # the keyframes of this drive have no images


def test_far_points_are_mapped_of_the_first_keyframe_while_it_is_the_only_one():
    drive = Drive()
    frame = drive.step(keyframe=True)
    near, n = drive.published.view, np.count_nonzero(frame.landmark >= 0)
    # Another frame is not the frame of the keyframe.
    assert drive.mapper.map_far_points(drive.next_frame()) is None
    frame = drive.mapper.map_far_points(frame)
    assert n < len(frame.tracked) == 240
    assert len(drive.published.view.local_landmarks.ids) == 240 > len(near.local_landmarks.ids)
    assert np.isfinite(frame.xyz).all()
    assert drive.mapper.map_far_points(frame) is None  # there are no more far points
    drive = Drive()
    first = drive.step(keyframe=True)
    second = drive.step(keyframe=True)
    assert drive.mapper.map_far_points(second) is None
    drive.published.refer_to(0)
    assert drive.mapper.map_far_points(first) is None


# -- failures -------------------------------------------------------------------------------------

INCOMPLETE = r"^mapping [^.]*failed [^.]*incomplete; continue from a map that was saved before$"


class BrokenError(Exception):
    """The error of a mapping job."""


def fail(map_: Map, keyframe: int) -> None:
    if keyframe == 1:
        raise BrokenError


@late_and_early
@pytest.mark.parametrize(
    "first",
    [
        lambda drive: drive.published.publish(),
        lambda drive: drive.published.wait(),
        lambda drive: drive.mapper.finish(),
        lambda drive: drive.mapper.insert(drive.last, None),
        lambda drive: drive.steps([], 6),
    ],
    ids=["publish", "wait", "finish", "insert", "drive"],
)
def test_a_job_that_fails_says_so_once_and_the_map_says_so_from_then_on(workers, first):
    drive = Drive(workers(), Closing(fail), publish_after_frames=3)
    drive.steps([0, 3], 5)
    mapper, published, frame = drive.mapper, drive.published, drive.last
    view, pose = published.view, published.frames.pose(-1).tobytes()
    with pytest.raises(BrokenError):
        first(drive)
    two, none = np.arange(2), (None, None)
    start = TwoViewStart(frame, frame, none, at(1), (two, two), POINTS.xyz[:2])
    for use in (
        lambda: published.map,
        published.publish,
        published.complete,
        published.wait,
        mapper.finish,
        published.trajectory,
        lambda: published.publish(frame=99),
        lambda: mapper.insert(frame, None),
        lambda: mapper.map_far_points(frame),
        lambda: mapper.begin(start),
        lambda: mapper.find_old_place(frame),
        lambda: published.refer_to(0),
        lambda: published.refer_to_nearest(frame),
        lambda: published.keyframe(0),
    ):
        with pytest.raises(RuntimeError, match=INCOMPLETE):
            use()
    assert published.view is view
    assert published.frames.pose(4).tobytes() == pose


@pytest.mark.parametrize(
    ("failing", "change"),
    [
        (0, lambda drive: drive.step(keyframe=True)),
        (0, begin_with_two_views),
        (1, begin_with_two_views),
        (AT_THE_END, lambda drive: drive.mapper.finish()),
    ],
    ids=["first keyframe", "first view", "second view", "end"],
)
def test_a_change_that_fails_where_no_job_runs_leaves_no_other_map(failing, change):
    def fail(map_: Map, keyframe: int) -> None:
        if keyframe == failing:
            raise BrokenError

    drive = Drive(closing=Closing(fail), see=see_without_depth)
    with pytest.raises(BrokenError):
        change(drive)
    for use in (lambda: drive.published.map, drive.published.wait, drive.mapper.finish):
        with pytest.raises(RuntimeError, match=INCOMPLETE):
            use()


@pytest.mark.parametrize("failing", [0, 2])
@pytest.mark.parametrize("threads", [1, 2])
def test_a_map_that_is_incomplete_is_not_saved(failing, threads, tmp_path, monkeypatch):
    def fail(map_, keyframe, *_):
        if keyframe == failing:
            raise BrokenError

    # The first keyframe is mapped at once, the others by a job.
    function = "refine_and_calibrate" if failing else "map_stereo_points"
    monkeypatch.setattr(f"vslam.method.mapping.{function}", fail)
    path = tmp_path / "map.npz"
    path.write_bytes(b"an older map")
    slam = Slam(CAMERA, detector="none", threads=threads)
    results = []

    def drive() -> None:
        for k in range(40):
            results.append(slam.step_features(Extracted(POINTS.see(at(k))), 0.1 * k))

    with pytest.raises(BrokenError):
        drive()
    assert sum(result.is_keyframe for result in results) == (failing + 1 if failing else 0)
    for use in (
        lambda: slam.save(path),
        slam.stored_map,
        lambda: slam.map,
        slam.trajectory,
        slam.finish,
        lambda: slam.step_features(Extracted(POINTS.see(at(41))), 4.1),
    ):
        with pytest.raises(RuntimeError, match=INCOMPLETE):
            use()
    assert path.read_bytes() == b"an older map"
    assert [file.name for file in tmp_path.iterdir()] == ["map.npz"]


def test_a_detector_that_fails_costs_its_loops_alone(tmp_path, caplog):
    class Detector(NoDetector):
        def add(self, keyframe, image, features):
            raise BrokenError

    slam = Slam(CAMERA, detector=Detector(), threads=2)
    without = Slam(CAMERA, detector="none", threads=2)
    for k in range(40):
        for one in (slam, without):
            one.step_features(Extracted(POINTS.see(at(k))), 0.1 * k)
    slam.finish()
    without.finish()
    assert slam.trajectory().T_wc.tobytes() == without.trajectory().T_wc.tobytes()
    assert slam.problems == ["Looking for loops failed (BrokenError); the map stays as it was."]
    assert [record.getMessage() for record in caplog.records] == slam.problems  # once
    slam.save(tmp_path / "map.npz")
    assert Slam.load(tmp_path / "map.npz", detector=NoDetector()).map.n_keyframes > 2


# -- state ----------------------------------------------------------------------------------------


def test_a_mapper_that_is_restored_goes_on_as_the_one_that_was_not():
    """The reference keyframe is not the newest one, as after relocalisation."""
    one = Drive()
    one.steps([0, 3], 6)
    one.published.record(replace(one.next_frame(), near=0))
    state, map_ = one.published.state(), one.published.wait()
    other = Drive()
    other.continue_in(map_.copy(), one.published.frames.table())
    assert other.published.reference == 1  # the newest keyframe, where nothing else is known
    other.continue_in(map_.copy(), one.published.frames.table(), state)
    assert other.published.state() == state == PublishedState(0, 3, pytest.approx(0.3), ())
    assert bytes_of_view(other.published.view) == bytes_of_view(one.published.view)
    for drive in (one, other):
        drive.last = None
        drive.step(keyframe=True)
        drive.step()
        drive.mapper.finish()
    assert bytes_of_map(other.published.map) == bytes_of_map(one.published.map)
    tables = [drive.published.frames.table() for drive in (one, other)]
    for mine, theirs in zip(*tables, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_the_patches_of_keyframes_are_part_of_the_state():
    drive = Drive()
    drive.steps([0, 3], 6)
    rng = np.random.default_rng(0)
    patches = tuple(
        KeyframePatches(
            keyframe,
            rng.integers(0, 256, (240, PATCH_PIXELS), dtype=np.uint8),
            rng.normal(size=(240, 2)).astype(np.float32),
            rng.normal(size=(240, 2)).astype(np.float32),
        )
        for keyframe in (0, 1)
    )
    map_, frames = drive.published.map.copy(), drive.published.frames.table()
    drive.continue_in(map_, frames, PublishedState(1, 3, 0.3, patches))
    again = drive.published.state().patches
    assert len(again) == 2
    for mine, theirs in zip(again, patches, strict=True):
        assert mine.keyframe == theirs.keyframe
        np.testing.assert_array_equal(mine.pixels, theirs.pixels)
        np.testing.assert_array_equal(mine.shift, theirs.shift)
        np.testing.assert_array_equal(mine.xy, theirs.xy)
    shown = drive.published.view.patches
    assert set(shown.ids) == set(drive.published.map.landmarks_of(1))


@pytest.mark.parametrize("same_drive", [True, False])
def test_only_the_same_drive_counts_frames_from_its_newest_keyframe(same_drive):
    drive = Drive()
    drive.steps([0, 3], 6)
    map_ = drive.published.map.copy()
    if not same_drive:
        map_.begin_drive()
    drive.continue_in(map_, drive.published.frames.table())
    assert drive.published.last_frame == (3 if same_drive else -1)
    assert drive.published.last_timestamp == (map_.timestamps[1] if same_drive else -np.inf)
