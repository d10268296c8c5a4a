"""Local mapping in parallel with tracking, with the same result on every machine.

``Mapper`` owns the map. Each keyframe is mapped by a job in another thread. The *merge*, which
makes the job's result visible to tracking, happens at a fixed frame index, however long the job
takes. Between two merges tracking reads a ``MapView``, a copy that the last merge made. Every
method that needs the merged map performs the merge itself. A merge also updates the frames that
were passed to ``Mapper.hold``. After the merge, the other thread searches the map for loops at the
keyframe. A loop that it finds is closed before the next change of the map.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vslam.backend.disparity_offset import map_and_calibrate, offset_sigma
from vslam.backend.local_mapping import refresh_keyframe
from vslam.backend.triangulation import map_stereo_points
from vslam.closing import LoopClosing, LoopSearch
from vslam.frame_poses import FramePoses, FrameTable
from vslam.frontend.frame import Frame, PlacedFrame
from vslam.frontend.patches import RecentPatches, certainty_of
from vslam.frontend.rig import RigCalibration
from vslam.frontend.tracking import TrackingContext
from vslam.geometry import Matrix, inverse, orthonormalised
from vslam.map import Map
from vslam.map_frames import (
    LandmarkCounts,
    OldPlace,
    add_frame,
    add_two_views,
    count_shared_landmarks,
    drop_culled_landmarks,
    find_old_place,
    has_more_points,
    observe_keyframe,
    update_landmarks,
)
from vslam.map_view import MapView, local_map, view_of
from vslam.shared_map import SharedMap
from vslam.starter import TwoViewStart
from vslam.states import MapperState
from vslam.trajectory import Trajectory
from vslam.workers import Job, Workers

_CLOSE_AFTER_FRAMES = 10  # a found loop is closed this long after its keyframe, or at the next one


class Mapper:
    """The owner of the map: all changes are made by its methods or by the jobs that it starts.

    Attributes:
        view: the copy of the map that tracking reads.
        frames: the pose of every frame, relative to a keyframe.
        last_frame, last_timestamp: index and time (seconds) of the frame that became the last
            keyframe.
    """

    def __init__(
        self,
        context: TrackingContext,
        closing: LoopClosing,
        rig: RigCalibration,
        workers: Workers,
        map_: Map | None = None,
        frames: FrameTable | None = None,
    ) -> None:
        """
        Args:
            context: camera, thresholds and pyramid scales.
            closing: processes new keyframes for loop closing.
            rig: corrects frames, and receives the map's disparity offset.
            workers: run mapping jobs, one at a time, and searches for loops.
            map_: a map to continue in; None begins an empty one.
            frames: poses of earlier frames of the same drive.
        """
        self.view = MapView()
        self.last_frame = -1
        self.last_timestamp = -np.inf
        self._shared = SharedMap(map_ or Map(context.scales), workers)
        self._camera = context.camera
        self._config = context.config
        self._closing = closing
        self.rig = rig
        self._patches = RecentPatches(context.config.alignment.keyframes)
        self._is_merged = True
        self._next_search: Callable[[Map], LoopSearch] | None = None  # starts after the merge
        self._search: Job[LoopSearch] | None = None
        self._held: tuple[Frame, ...] = ()
        self._counts = LandmarkCounts()
        self.frames = FramePoses(self, frames)
        if self.map.n_keyframes:
            self.refer_to(int(self.map.living_keyframes()[-1]))

    # Properties that may be read at any time

    @property
    def n_keyframes(self) -> int:
        """Number of keyframes so far, culled ones included."""
        return self.view.n_keyframes

    @property
    def reference(self) -> int:
        """The keyframe that the poses of new frames are relative to."""
        return self.view.reference

    @property
    def is_merged(self) -> bool:
        """Whether tracking sees the results of all mapping jobs."""
        return self._is_merged

    @property
    def has_found_loop(self) -> bool:
        """Whether a loop was found that is not closed yet; waits for the search."""
        return self._search is not None and self._search.result().loop is not None

    @property
    def is_mapping(self) -> bool:
        """Whether a keyframe is being mapped, so that another thread may write the map."""
        return self._shared.is_busy

    @property
    def map(self) -> Map:
        """The map.

        Raises:
            RuntimeError: a keyframe is being mapped, or its mapping failed.
        """
        return self._shared.map

    def keyframe_pose(self, keyframe: int) -> Matrix:
        """``T_cw`` of a keyframe at the last merge; while a job runs, it is available only for the
        reference keyframe."""
        if not self._is_merged and keyframe == self.view.reference:
            return self.view.T_reference
        return self.map.keyframe_pose(keyframe)

    def unit_scale(self, keyframe: int) -> float:
        """``Map.unit_scale`` of a keyframe, under the same condition as ``keyframe_pose``."""
        if not self._is_merged and keyframe == self.view.reference:
            return self.view.unit_scale
        return float(self.map.unit_scale[keyframe])

    def trajectory(self) -> Trajectory:
        """The pose of every frame (``FramePoses.trajectory``).

        Raises:
            RuntimeError: as ``map``.
        """
        self.map  # noqa: B018 (raises if it cannot be read)
        return self.frames.trajectory()

    # The schedule

    def hold(self, *frames: Frame | None) -> None:
        """Choose the frames whose poses, landmarks and twists are updated when a merge changes the
        map; they replace the frames held before."""
        self._held = tuple(frame for frame in frames if frame is not None)

    def admit(self, frame: Frame, last: Frame | None, twist: Matrix | None) -> None:
        """Prepare the next frame for tracking: merge if a merge is due at its index, and correct
        its columns in the right image by the measured offset and delay of the rig.

        Until the next frame is admitted, merges update this frame and the last tracked one.

        Args:
            frame: the next frame, not tracked yet.
            last: the last tracked frame; None before the first.
            twist: ``(6,)`` twist of the points relative to the camera, per second; None if unknown.
        """
        self.hold(last, frame)
        self.merge_if_due(frame.index)
        self.rig.prepare(frame, twist)

    def append_pose(self, frame: Frame, *, tracked: bool, near: int = -1) -> PlacedFrame:
        """Record the pose of the next frame, and return it as a frame with a recorded pose.

        Args:
            tracked: False for a pose that is only predicted.
            near: the keyframe near which the frame was relocalised; it becomes the reference. -1 if
                the frame was not relocalised.
        """
        if near >= 0:
            self.refer_to(near)
        self.frames.append(frame.timestamp, frame.T_cw, tracked=tracked)
        return PlacedFrame(frame)

    def count(self, visible: NDArray[np.int32], found: NDArray[np.int32]) -> None:
        """Count the landmarks that a frame should have seen, ``(N,)`` ids, and those that it found,
        ``(M,)`` ids."""
        self._counts.add(visible, found)

    def merge_if_due(self, frame: int) -> None:
        """Merge if the last keyframe is at least ``merge_after_frames`` older than this frame. If
        it is at least ``_CLOSE_AFTER_FRAMES`` older, close a loop that was found at it."""
        age = frame - self.last_frame
        if age >= self._config.keyframes.merge_after_frames:
            self._merge_mapping()
        if age >= _CLOSE_AFTER_FRAMES:
            self._settle()

    def merge(self) -> Map:
        """Wait for the running mapping job and make its result visible to tracking; then wait for
        the search for loops and return the map.

        Raises:
            RuntimeError: mapping an earlier keyframe failed, so that the map is incomplete.
        """
        self._merge_mapping()
        return self.complete()

    def complete(self) -> Map:
        """Wait for the running mapping job and for the search for loops, and return the map. The
        result of mapping does not become visible to tracking, so calling this does not change any
        result.

        Raises:
            RuntimeError: as ``merge``.
        """
        map_ = self._wait_for_mapping()
        self._start_search()
        if self._search is not None and (search := self._search.result()).loop is None:
            self._closing.close(map_, search)
            self._search = None
        return map_

    def _wait_for_mapping(self) -> Map:
        map_ = self._shared.wait()
        self._counts.write(map_)
        return map_

    def _start_search(self) -> None:
        """Start the search for loops at the keyframe that was mapped last."""
        if self._next_search is not None:
            self._search = self._shared.start_reading(self._next_search)
            self._next_search = None

    def _merge_mapping(self) -> None:
        """Make the result of the last mapping job visible to tracking."""
        if not self._is_merged:
            self._wait_for_mapping()
            self._is_merged = True
            self._renew_view()
            self._start_search()

    def _settle(self) -> Map:
        """Merge, close the loop that was found, if any, and return the map."""
        map_ = self.merge()
        if self._search is not None:
            search, self._search = self._search.result(), None
            with self._shared.change():
                self._closing.close(map_, search)
            self._renew_view()
        return map_

    def finish(self) -> None:
        """Complete all running work, including global bundle adjustment."""
        with self._changing() as map_:
            self._closing.conclude(map_)
            self._closing.finish(map_)
        if self.n_keyframes:
            self._renew_view()

    # Changes of the map; each begins with a merge

    def insert(self, frame: PlacedFrame, *, predicted: bool = True) -> None:
        """Make the newest frame a keyframe, map its stereo points and start its mapping job.

        The frame then tracks all landmarks that its features observe, including new ones. A frame
        that shares no landmark with the map begins a sub-map.

        Args:
            predicted: whether the pose was predicted; matters only if the frame begins a sub-map.
        """
        with self._changing() as map_:
            self._make_room(map_, frame)
            certainty = certainty_of(frame, self._config.alignment)
            keyframe = add_frame(map_, frame, certainty, self.reference, predicted=predicted)
            map_stereo_points(map_, keyframe, self._camera, self._config)
            refresh_keyframe(map_, keyframe)
            self._set_newest(keyframe, frame)
            self.frames.replace(frame.index, keyframe)
            if keyframe > 0:
                self._start(partial(self._map_keyframe, keyframe))
                self._next_search = partial(
                    self._closing.search,
                    keyframe=keyframe,
                    features=frame.features,
                    image=frame.image,
                )
            else:
                self._closing.process(map_, keyframe, frame.features, frame.image)

    def map_far_points(self, frame: Frame) -> bool:
        """Map all stereo points of a frame that is the first keyframe of a map or sub-map, if no
        keyframe follows it yet. Returns whether points were added.

        ORB-SLAM2 (III-B) maps all of them from the start. The calibration error of the pair biases
        far points and thus the first poses, so they are added only when they are needed: at high
        speed, close points leave the view within a frame.
        """
        with self._changing() as map_:
            keyframe = self.reference
            if not has_more_points(map_, keyframe, frame):
                return False
            new = map_stereo_points(map_, keyframe, self._camera, self._config, far=True)
            refresh_keyframe(map_, keyframe)
            self.refer_to(keyframe)
            observe_keyframe(frame, map_, keyframe)
        return len(new) > 0

    def begin(self, start: TwoViewStart, twist: Callable[[], Matrix | None]) -> None:
        """Begin a monocular map or sub-map with two keyframes; the second is the newest frame.

        The newest frame gets the twist between the two views, and tracks all landmarks that it
        observes.

        Args:
            twist: called after the merge, returns the ``(6,)`` twist of the camera before it was
                lost, per second, or None if unknown. It determines the unit of a sub-map.
        """
        with self._changing() as map_:
            start = start.at_speed(twist(), self._config.initialization.max_rescaling)
            frames = start.first, start.second
            self._make_room(map_, start.second)
            keyframes = add_two_views(map_, start, self.reference)
            for keyframe, frame in zip(keyframes, frames, strict=True):
                self._closing.process(map_, keyframe, frame.features, frame.image)
            self._set_newest(keyframes[1], start.second)
            for keyframe, frame in zip(keyframes, frames, strict=True):
                self.frames.replace(frame.index, keyframe)
            start.second.T_cw = self.frames.pose(start.second.index)
            start.second.twist = start.twist

    def find_old_place(self, frame: Frame) -> OldPlace | None:
        """The old place that the frame has returned to; None if there is none
        (``map_frames.find_old_place``)."""
        return find_old_place(self._settle(), frame, self._config.keyframes.known_after_s)

    def use_existing_keyframe(self, place: OldPlace, frame: PlacedFrame) -> None:
        """Make an existing keyframe the reference instead of inserting the newest frame."""
        self._settle()
        self.last_timestamp = frame.timestamp
        self.refer_to(place.keyframe)
        self.frames.follow_reference(frame.index, frame.T_cw)
        if self._closing.count_reused_keyframe(self.n_keyframes - 1):
            self.last_frame = frame.index
            self._start(self._closing.finish)

    # The reference keyframe, which is not part of the map

    def refer_to(self, keyframe: int) -> None:
        """Make a keyframe the reference, so that tracking sees the landmarks around it."""
        map_, config = self.map, self._config.tracking
        local = local_map(map_, keyframe, config.local_keyframes)
        patches = self._patches.of(map_, local.ids)
        self.view = view_of(map_, keyframe, local, patches, monocular=self._camera.monocular)
        known = map_.scalars
        self.rig.disparity_offset = known.disparity_offset
        self.rig.offset_sigma = offset_sigma(known.offset_information, self._config.stereo)

    def refer_to_nearest(self, frame: Frame) -> None:
        """Make the keyframe that shares the most landmarks with a frame the reference (ORB-SLAM,
        V-D)."""
        shared = count_shared_landmarks(self.merge(), frame)
        best = int(np.argmax(shared))
        if shared[best] and best != self.reference:
            self.refer_to(best)

    # State for checkpoints

    def state(self) -> MapperState:
        """The state of the mapper without the map."""
        return MapperState(
            self.reference, self.last_frame, self.last_timestamp, self._patches.all()
        )

    def restore(self, state: MapperState) -> None:
        """Restore what ``state`` returned; the map must be the one that it was taken with."""
        self.last_frame, self.last_timestamp = state.last_frame, state.last_timestamp
        for patches in state.patches:
            self._patches.add(patches)
        self.refer_to(state.reference)

    def continue_drive(self) -> None:
        """Treat the reference keyframe as the last inserted one if it belongs to this drive."""
        map_, newest = self.map, self.reference
        if map_.n_keyframes and map_.sessions[newest] == map_.scalars.session:
            self.last_frame = int(map_.frames[newest])
            self.last_timestamp = float(map_.timestamps[newest])

    @contextmanager
    def _changing(self) -> Iterator[Map]:
        """Yield the merged map for changes. After an exception, the map cannot be used any more."""
        self._settle()
        with self._shared.change() as map_:
            yield map_

    def _make_room(self, map_: Map, frame: Frame) -> None:
        """Drop culled landmarks if there are many. The ids of the other landmarks then change, so
        nothing is dropped during a global bundle adjustment, which refers to landmarks by id."""
        if not self._closing.is_adjusting and map_.many_culled_landmarks:
            drop_culled_landmarks(map_, (*self._held, frame))

    def _set_newest(self, keyframe: int, frame: Frame) -> None:
        """Record that a frame became the newest keyframe, and make it the reference."""
        map_ = self.map
        self._patches.remember(frame, keyframe, map_.scales)
        self.last_frame, self.last_timestamp = frame.index, frame.timestamp
        self.refer_to(keyframe)
        observe_keyframe(frame, map_, keyframe)

    def _renew_view(self) -> None:
        before = self.view
        self.refer_to(before.reference)
        for frame in self._held:
            self._move(frame, before)

    def _move(self, frame: Frame, before: MapView) -> None:
        """Update a frame after the map moved. A frame whose pose is recorded moves with its
        keyframe, any other frame with the reference keyframe."""
        growth = self.view.unit_scale / before.unit_scale
        self.rig.correct_offset(frame)
        update_landmarks(frame, self.map)
        if frame.index < len(self.frames):
            frame.T_cw = self.frames.pose(frame.index)
        else:
            T_c_reference = frame.T_cw @ inverse(before.T_reference)
            T_c_reference[:3, 3] *= growth
            frame.T_cw = orthonormalised(T_c_reference @ self.view.T_reference)
        if frame.twist is not None:
            frame.twist[:3] *= growth

    def _map_keyframe(self, keyframe: int, map_: Map) -> None:
        map_and_calibrate(map_, keyframe, self._camera, self._config)
        self._closing.merge_adjustment_if_due(map_, keyframe)

    def _start(self, job: Callable[[Map], None]) -> None:
        """Start a mapping job; until the merge, tracking continues with the present view."""
        self._shared.start(job)
        self._is_merged = False
