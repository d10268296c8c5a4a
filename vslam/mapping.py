"""Local mapping in parallel with tracking, with the same result on every machine.

``Mapper`` owns the map. A job in another thread maps each keyframe. A *merge* then makes the result
of this job visible to tracking. The merge happens at a fixed frame index, regardless of how long
the job takes. Between two merges, tracking reads a ``MapView``, which is a copy of parts of the map
made at the last merge. A method that needs the merged map first performs the merge.

After the merge, the other thread searches for a loop at the keyframe. If a loop is found, it is
closed before the map is changed again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vslam.backend.disparity_offset import map_and_calibrate, offset_sigma
from vslam.backend.local_mapping import refresh_keyframe
from vslam.backend.triangulation import map_stereo_points
from vslam.closing import LoopClosing, LoopSearch
from vslam.context import Context
from vslam.features import FramePatches
from vslam.frame_poses import FramePoses, FrameTable
from vslam.frontend.frame import Frame, PlacedFrame
from vslam.frontend.patches import (
    RecentPatches,
    certainty_of,
    patches_of_frame,
    patches_of_landmarks,
)
from vslam.frontend.rig import RigCalibration
from vslam.geometry import Matrix, inverse, orthonormalised
from vslam.hypotheses import part_of
from vslam.map import Map
from vslam.map_frames import (
    LandmarkCounts,
    OldPlace,
    add_frame,
    add_revisit,
    add_two_views,
    count_shared_landmarks,
    drop_culled_landmarks,
    find_old_place,
    has_more_points,
    observe_keyframe,
    sees_old_place,
    update_landmarks,
)
from vslam.map_view import MapView, local_map, view_of
from vslam.shared_map import SharedMap
from vslam.starter import TwoViewStart
from vslam.states import MapperState
from vslam.trajectory import Trajectory
from vslam.workers import Job, Workers

# A loop that was found is closed this many frames after its keyframe, or at the next keyframe.
_CLOSE_AFTER_FRAMES = 10


class Mapper:
    """The owner of the map. Only its methods, and the jobs that it starts, change the map.

    Attributes:
        view: the copy of parts of the map that tracking reads.
        frames: the pose of every frame, relative to a keyframe.
        last_frame, last_timestamp: index and time (seconds) of the frame that became the last
            keyframe.
    """

    def __init__(
        self,
        context: Context,
        closing: LoopClosing,
        rig: RigCalibration,
        workers: Workers,
        map_: Map | None = None,
        frames: FrameTable | None = None,
    ) -> None:
        """Create the mapper of a new or continued map.

        Args:
            rig: corrects frames, and receives the disparity offset of the map.
            workers: threads that run mapping jobs, one at a time, and searches for loops.
            map_: map to continue in. None begins an empty map.
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
        self._known_place: FramePatches | None = None
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
        """Number of keyframes so far, including culled keyframes."""
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
        """Wait for the search for loops. Return whether it found a loop that is not closed yet."""
        return self._search is not None and self._search.result().loop is not None

    @property
    def is_mapping(self) -> bool:
        """Whether a keyframe is being mapped, so that another thread may be writing the map."""
        return self._shared.is_busy

    @property
    def map(self) -> Map:
        """The map. Raises a RuntimeError if a keyframe is being mapped, or its mapping failed."""
        return self._shared.map

    def keyframe_pose(self, keyframe: int) -> Matrix:
        """Return the pose ``T_cw`` of a keyframe.

        While a mapping job runs, only the pose of the reference keyframe is available.
        """
        if not self._is_merged and keyframe == self.view.reference:
            return self.view.T_reference
        return self.map.keyframe_pose(keyframe)

    def unit_scale(self, keyframe: int) -> float:
        """Return the factor by which loop closures have scaled lengths near a keyframe.

        While a mapping job runs, only the factor of the reference keyframe is available.
        """
        if not self._is_merged and keyframe == self.view.reference:
            return self.view.unit_scale
        return float(self.map.unit_scale[keyframe])

    def trajectory(self) -> Trajectory:
        """Return the pose of every frame (``FramePoses.trajectory``)."""
        self.map  # noqa: B018 (raises if it cannot be read)
        return self.frames.trajectory()

    # The schedule

    def hold(self, *frames: Frame | None) -> None:
        """Choose the frames whose pose, landmarks and twist each merge updates.

        They replace the frames of an earlier call.
        """
        self._held = tuple(frame for frame in frames if frame is not None)

    def admit(self, frame: Frame, last: Frame | None, twist: Matrix | None) -> None:
        """Prepare the next frame for tracking.

        If a merge is due at the index of the frame, the merge is performed. The columns of the
        frame in the right image are corrected by the measured offset and delay of the rig. Until
        the next call, merges update ``frame`` and ``last``.

        Args:
            last: the last tracked frame. None if no frame has been tracked.
            twist: ``(6,)`` twist of the points relative to the camera, per second. None if it is
                unknown.
        """
        self.hold(last, frame)
        self.merge_if_due(frame.index)
        self.rig.prepare(frame, twist)

    def append_pose(self, frame: Frame, *, tracked: bool, near: int = -1) -> PlacedFrame:
        """Record the pose of the next frame, and return the frame with its recorded pose.

        Args:
            tracked: False for a pose that is only predicted.
            near: the keyframe near which the frame was relocalised. It becomes the reference
                keyframe. -1 if the frame was not relocalised.
        """
        if near >= 0:
            self.refer_to(near)
        self.frames.append(frame.timestamp, frame.T_cw, tracked=tracked)
        return PlacedFrame(frame)

    def count(self, visible: NDArray[np.int32], found: NDArray[np.int32]) -> None:
        """Count ``(N,)`` landmarks that a frame should have seen, and ``(M,)`` that it found."""
        self._counts.add(visible, found)

    def merge_if_due(self, frame: int) -> None:
        """Make the result of the mapping job visible to tracking, if this is due at a frame.

        It is due ``merge_after_frames`` frames after the last keyframe. Ten frames after this
        keyframe, a loop that was found at it is closed.

        Args:
            frame: index of the frame.
        """
        age = frame - self.last_frame
        if age >= self._config.keyframes.merge_after_frames:
            self._merge_mapping()
        if age >= _CLOSE_AFTER_FRAMES:
            self.settle()

    def merge(self) -> Map:
        """Make the result of the mapping job visible to tracking, and return the map.

        This method waits for the mapping job and for the search for loops.
        """
        self._merge_mapping()
        return self.complete()

    def complete(self) -> Map:
        """Wait for the mapping job and for the search for loops, and return the map.

        The result of the mapping job does not become visible to tracking. Therefore, this method
        does not change the trajectory.
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
        if self._next_search is not None:
            self._search = self._shared.start_reading(self._next_search)
            self._next_search = None

    def _merge_mapping(self) -> None:
        if not self._is_merged:
            self._wait_for_mapping()
            self._is_merged = True
            self._renew_view()
            self._start_search()

    def settle(self) -> Map:
        """Merge the mapping job, close the loop if one was found, and return the map."""
        map_ = self.merge()
        if self._search is not None:
            search, self._search = self._search.result(), None
            with self._shared.change():
                self._closing.close(map_, search)
            self._renew_view()
        return map_

    def finish(self) -> None:
        """Complete all running work, including a global bundle adjustment."""
        with self._changing() as map_:
            self._closing.conclude(map_)
            self._closing.finish(map_)
        if self.n_keyframes:
            self._renew_view()

    # Changes of the map; each begins with a merge

    def insert(self, frame: PlacedFrame, *, predicted: bool = True) -> None:
        """Make the newest frame a keyframe, map its stereo points and start its mapping job.

        A frame that shares no landmark with the map begins a sub-map.

        Args:
            predicted: if the frame begins a sub-map, whether its pose was predicted.
        """
        with self._changing() as map_:
            self._make_room(map_, frame)
            certainty = certainty_of(frame, self._config.alignment)
            keyframe = add_frame(map_, frame, certainty, self.reference, predicted=predicted)
            map_stereo_points(map_, keyframe, self._camera, self._config)
            refresh_keyframe(map_, keyframe)
            if sees_old_place(map_, keyframe, self._config.mapping.min_shared):
                self._closing.count_revisit(map_)
            else:
                self._closing.adjust_after_revisits(map_)
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
        """Map all stereo points of the first keyframe of a map or sub-map.

        Nothing is done if ``frame`` is not such a keyframe, or if another keyframe follows it.

        ORB-SLAM2 (III-B) maps all points from the start. However, the calibration error of a stereo
        pair biases far points and therefore the first poses. Far points are needed only at high
        speed, when close points leave the view within a frame.

        Returns:
            Whether points were added.
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
        """Begin a monocular map or sub-map with two keyframes. The second is the newest frame.

        Args:
            twist: function that is called after the merge. It returns the ``(6,)`` twist per second
                before the camera was lost, or None if this twist is unknown. The twist determines
                the unit of a sub-map.
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
        """Find a place that was mapped some time ago and to which the frame has returned."""
        return find_old_place(self.settle(), frame, self._config.keyframes.known_after_s)

    def use_existing_keyframe(self, place: OldPlace, frame: PlacedFrame) -> None:
        """Make an existing keyframe the reference keyframe instead of inserting a new keyframe."""
        with self._changing() as map_:
            certainty = certainty_of(frame, self._config.alignment)
            new = add_revisit(map_, place.keyframe, frame, certainty)
        self.last_timestamp = frame.timestamp
        self.frames.follow(frame.index, place.keyframe, frame.T_cw)
        self._known_place = patches_of_frame(frame, map_.scales)
        self.refer_to(place.keyframe)
        if self._closing.count_reused_keyframe(map_, new=new):
            self.last_frame = frame.index
            self._start(self._closing.finish)

    # The reference keyframe, which is not part of the map

    def refer_to(self, keyframe: int) -> None:
        """Make a keyframe the reference keyframe, so that tracking sees the landmarks around it."""
        map_, config = self.map, self._config.tracking
        local = local_map(map_, keyframe, config.local_keyframes)
        if (place := self._known_place) is None:
            patches = self._patches.of(map_, local.ids)
        else:
            T_cw = self.frames.pose(place.frame)
            patches = patches_of_landmarks(place, local.ids, T_cw, map_.scales)
        view = view_of(map_, keyframe, local, patches, monocular=self._camera.monocular)
        self.view = replace(view, part=part_of(map_, self._closing.closed, keyframe))
        known = map_.scalars
        self.rig.disparity_offset = known.disparity_offset
        self.rig.offset_sigma = offset_sigma(known.offset_information, self._config.stereo)

    def refer_to_nearest(self, frame: Frame) -> None:
        """Refer to the keyframe that shares the most landmarks with a frame (ORB-SLAM, V-D)."""
        shared = count_shared_landmarks(self.merge(), frame)
        best = int(np.argmax(shared))
        if shared[best] and best != self.reference:
            self.refer_to(best)

    # State for checkpoints

    def state(self) -> MapperState:
        """Return the state of the mapper for a checkpoint, without the map."""
        return MapperState(
            self.reference,
            self.last_frame,
            self.last_timestamp,
            self._patches.all(),
            self._known_place,
        )

    def restore(self, state: MapperState) -> None:
        """Restore a state, given the map that was saved together with it."""
        self.last_frame, self.last_timestamp = state.last_frame, state.last_timestamp
        for patches in state.patches:
            self._patches.add(patches)
        self._known_place = state.known_place
        self.refer_to(state.reference)

    def continue_drive(self) -> None:
        """If the reference keyframe belongs to this drive, treat it as the last inserted one."""
        map_, newest = self.map, self.reference
        if map_.n_keyframes and map_.sessions[newest] == map_.scalars.session:
            self.last_frame = int(map_.frames[newest])
            self.last_timestamp = float(map_.timestamps[newest])

    @contextmanager
    def _changing(self) -> Iterator[Map]:
        """Yield the merged map for changes. An exception in the block makes the map unusable."""
        self.settle()
        with self._shared.change() as map_:
            yield map_

    def _make_room(self, map_: Map, frame: Frame) -> None:
        """Drop culled landmarks if there are many, unless a global bundle adjustment is running.

        Dropping changes the ids of the other landmarks, to which the adjustment refers.
        """
        if not self._closing.is_adjusting and map_.many_culled_landmarks:
            drop_culled_landmarks(map_, (*self._held, frame))

    def _set_newest(self, keyframe: int, frame: Frame) -> None:
        map_ = self.map
        self._patches.remember(frame, keyframe, map_.scales)
        self._known_place = None
        self.last_frame, self.last_timestamp = frame.index, frame.timestamp
        self.refer_to(keyframe)
        observe_keyframe(frame, map_, keyframe)

    def _renew_view(self) -> None:
        before = self.view
        self.refer_to(before.reference)
        for frame in self._held:
            self._move(frame, before)

    def _move(self, frame: Frame, before: MapView) -> None:
        """Update a frame after a merge has changed the map.

        A frame whose pose has been recorded moves with its own reference keyframe. Any other frame
        moves with the current reference keyframe.
        """
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
        self._shared.start(job)
        self._is_merged = False
