"""Local mapping beside tracking, with the same result on every machine.

``Mapper`` owns the map. Each keyframe is mapped by a job in another thread. Tracking sees the job's
result from a fixed frame number on, however long the job took; this is called the merge. Between
two merges tracking reads a ``MapView``, a copy that the last merge left. Every method that needs
the merged map merges by itself, and frames that are held follow the map when a merge moves it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vslam.backend.disparity_offset import map_and_calibrate
from vslam.backend.local_mapping import refresh_keyframe
from vslam.backend.triangulation import map_stereo_points
from vslam.closing import LoopClosing
from vslam.features import Features
from vslam.frame_poses import FramePoses, FrameTable
from vslam.frontend.aligner import Aligner
from vslam.frontend.frame import Frame
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
    drop_dead_landmarks,
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


class Mapper:
    """The owner of the map: all changes are made by its methods or by the jobs that it starts.

    Attributes:
        view: what tracking may see of the map.
        frames: the pose of every frame, relative to a keyframe.
        last_frame, last_timestamp: index and seconds of the frame that became the last keyframe.
    """

    def __init__(
        self,
        context: TrackingContext,
        closing: LoopClosing,
        rig: RigCalibration,
        executor: Executor | None,
        map_: Map | None = None,
        frames: FrameTable | None = None,
    ) -> None:
        """
        Args:
            rig: corrects frames; it is told the map's disparity offset.
            executor: runs mapping jobs, one at a time; None runs each where its result is needed.
            map_: a map to continue in; None begins an empty one.
            frames: frames of the same drive that are placed already.
        """
        self.view = MapView()
        self.last_frame = -1
        self.last_timestamp = -np.inf
        self._shared = SharedMap(map_ or Map(context.scales), executor)
        self._camera = context.camera
        self._config = context.config
        self._closing = closing
        self._rig = rig
        self._aligner = Aligner(context.config.alignment)
        self._is_merged = True
        self._held: tuple[Frame, ...] = ()
        self._counts = LandmarkCounts()
        self.frames = FramePoses(self, frames)
        if self.map.n_keyframes:
            self.refer_to(int(self.map.living_keyframes()[-1]))

    # What may be seen at any time

    @property
    def n_keyframes(self) -> int:
        """Keyframes made so far, culled ones included."""
        return self.view.n_keyframes

    @property
    def reference(self) -> int:
        """The keyframe that new frames are placed by."""
        return self.view.reference

    @property
    def is_merged(self) -> bool:
        """Whether tracking sees all that was mapped."""
        return self._is_merged

    @property
    def is_mapping(self) -> bool:
        """Whether a keyframe is being mapped, so that another thread may be writing the map."""
        return self._shared.is_busy

    @property
    def map(self) -> Map:
        """The map.

        Raises:
            RuntimeError: a keyframe is being mapped, or its mapping failed.
        """
        return self._shared.map

    def keyframe_pose(self, keyframe: int) -> Matrix:
        """``T_cw`` as of the last merge; before the next one, of the reference keyframe only."""
        if not self._is_merged and keyframe == self.view.reference:
            return self.view.T_reference
        return self.map.keyframe_pose(keyframe)

    def unit_scale(self, keyframe: int) -> float:
        """``Map.unit_scale``, of the keyframes that ``keyframe_pose`` knows."""
        if not self._is_merged and keyframe == self.view.reference:
            return self.view.unit_scale
        return float(self.map.unit_scale[keyframe])

    def trajectory(self) -> Trajectory:
        """Pose of every frame (``FramePoses.trajectory``).

        Raises:
            RuntimeError: as ``map``.
        """
        self.map  # noqa: B018
        return self.frames.trajectory()

    # The schedule

    def hold(self, *frames: Frame | None) -> None:
        """Choose the frames whose poses, landmarks and twists are updated whenever a merge changes
        the map; they replace those held before."""
        self._held = tuple(frame for frame in frames if frame is not None)

    def append_pose(self, frame: Frame, *, tracked: bool, near: int = -1) -> None:
        """Record the pose of the next frame.

        Args:
            tracked: False for a pose that is only predicted.
            near: the keyframe near which the frame was found, which becomes the reference; -1 if
                the frame was not looked for.
        """
        if near >= 0:
            self.refer_to(near)
        self.frames.append(frame.timestamp, frame.T_cw, tracked=tracked)

    def count(self, visible: NDArray[np.int32], found: NDArray[np.int32]) -> None:
        """Let the map count that a frame should have seen some landmarks and did see others."""
        self._counts.add(visible, found)

    def merge_if_due(self, frame: int) -> None:
        """Merge if the last keyframe was made so many frames ago that this is the frame for it."""
        if frame - self.last_frame >= self._config.keyframes.merge_after_frames:
            self.merge()

    def merge(self) -> Map:
        """Wait for the keyframe that is being mapped, show the result to tracking, and return the
        map.

        Raises:
            RuntimeError: an earlier keyframe's mapping failed, so that the map is incomplete.
        """
        map_ = self.complete()
        if not self._is_merged:
            self._is_merged = True
            self._renew_view()
        return map_

    def complete(self) -> Map:
        """Wait for the keyframe that is being mapped without showing the result to tracking, and
        return the map. Whether and when this is called changes no result.

        Raises:
            RuntimeError: as ``merge``.
        """
        map_ = self._shared.wait()
        self._counts.write(map_)
        return map_

    def finish(self) -> None:
        """Complete all that is under way, global bundle adjustment included."""
        with self._changing() as map_:
            self._closing.conclude(map_)
            self._closing.finish(map_)
        if self.n_keyframes:
            self._renew_view()

    # Changes of the map, each of which begins with a merge

    def insert(self, frame: Frame, *, predicted: bool = True) -> None:
        """Make the frame placed last a keyframe, map its stereo points and start its mapping job.

        The frame then tracks all landmarks that its features observe, new ones included. A frame
        that shares none with the map begins a sub-map.

        Args:
            predicted: whether the pose of such a frame is at least a prediction.
        """
        with self._changing() as map_:
            self._make_room(map_, frame)
            certainty = self._aligner.certainty(frame)
            keyframe = add_frame(map_, frame, certainty, self.reference, predicted=predicted)
            map_stereo_points(map_, keyframe, self._camera, self._config)
            refresh_keyframe(map_, keyframe)
            self._set_newest(keyframe, frame)
            self.frames.replace(frame.index, keyframe)
            if keyframe > 0:
                self._start(partial(self._map_keyframe, keyframe, frame.features, frame.image))
            else:
                self._closing.process(map_, keyframe, frame.features, frame.image)

    def map_far_points(self, frame: Frame) -> bool:
        """Map all stereo points of a frame that is the first keyframe of a map or sub-map, if no
        keyframe follows it yet. Returns whether any were new.

        ORB-SLAM2 (III-B) begins with all of them. Far points bend the first poses by the error of
        the pair's calibration; but at speed close points leave the view within a frame.
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
        """Begin a monocular map or sub-map with two keyframes; the second is the frame placed last.

        Its twist becomes that of the two views, and it tracks all landmarks that it observes.

        Args:
            twist: asked after the merge: the speed of the camera before, None if unknown. A
                sub-map takes its unit from it.
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
        """The place that the frame has come back to, if it was mapped long enough ago."""
        return find_old_place(self.merge(), frame, self._config.keyframes.known_after_s)

    def use_existing_keyframe(self, place: OldPlace, frame: Frame) -> None:
        """Make an existing keyframe the reference instead of inserting the frame placed last as a
        new one."""
        self.merge()
        self.last_timestamp = frame.timestamp
        self.refer_to(place.keyframe)
        self.frames.follow_reference(frame.index, frame.T_cw)
        if self._closing.count_reused_keyframe(self.n_keyframes - 1):
            self.last_frame = frame.index
            self._start(self._closing.finish)

    # The reference keyframe, which is no part of the map

    def refer_to(self, keyframe: int) -> None:
        """Make a keyframe the reference, so that tracking sees what is around it."""
        map_, config = self.map, self._config.tracking
        local = local_map(map_, keyframe, config.local_keyframes)
        patches = self._aligner.patches_of(map_, local.ids)
        self.view = view_of(map_, keyframe, local, patches, monocular=self._camera.monocular)
        self._rig.disparity_offset = map_.scalars.disparity_offset

    def refer_to_nearest(self, frame: Frame) -> None:
        """Make the keyframe that shares the most landmarks with a frame the reference (ORB-SLAM,
        V-D)."""
        shared = count_shared_landmarks(self.merge(), frame)
        best = int(np.argmax(shared))
        if shared[best] and best != self.reference:
            self.refer_to(best)

    # What is kept in a file

    def state(self) -> MapperState:
        """What is remembered besides the map."""
        patches = self._aligner.state()
        return MapperState(self.reference, self.last_frame, self.last_timestamp, patches)

    def restore(self, state: MapperState) -> None:
        """Remember what ``state`` gave, in the map as it was then."""
        self.last_frame, self.last_timestamp = state.last_frame, state.last_timestamp
        self._aligner.restore(state.patches)
        self.refer_to(state.reference)

    def continue_drive(self) -> None:
        """Take the newest keyframe for the last one made, unless an earlier drive made it."""
        map_, newest = self.map, self.reference
        if map_.n_keyframes and map_.sessions[newest] == map_.scalars.session:
            self.last_frame = int(map_.frames[newest])
            self.last_timestamp = float(map_.timestamps[newest])

    @contextmanager
    def _changing(self) -> Iterator[Map]:
        """The merged map, to be changed; after an exception it cannot be used any more."""
        self.merge()
        with self._shared.change() as map_:
            yield map_

    def _make_room(self, map_: Map, frame: Frame) -> None:
        """Drop dead landmarks where they are many. The others get new ids, so that it has to wait
        while a global bundle adjustment is under way, which knows its landmarks by their ids."""
        if not self._closing.is_adjusting and map_.many_dead_landmarks:
            drop_dead_landmarks(map_, (*self._held, frame))

    def _set_newest(self, keyframe: int, frame: Frame) -> None:
        """The frame has become the newest keyframe: later ones are tracked against it."""
        map_ = self.map
        self._aligner.remember(frame, keyframe, map_.scales)
        self.last_frame, self.last_timestamp = frame.index, frame.timestamp
        self.refer_to(keyframe)
        observe_keyframe(frame, map_, keyframe)

    def _renew_view(self) -> None:
        before = self.view
        self.refer_to(before.reference)
        for frame in self._held:
            self._move(frame, before)

    def _move(self, frame: Frame, before: MapView) -> None:
        """Bring a frame to where the map is now. One that is placed moves with its keyframe, one
        that is not yet with the reference keyframe."""
        grown = self.view.unit_scale / before.unit_scale
        self._rig.correct_offset(frame)
        update_landmarks(frame, self.map)
        if frame.index < len(self.frames):
            frame.T_cw = self.frames.pose(frame.index)
        else:
            T_c_reference = frame.T_cw @ inverse(before.T_reference)
            T_c_reference[:3, 3] *= grown
            frame.T_cw = orthonormalised(T_c_reference @ self.view.T_reference)
        if frame.twist is not None:
            frame.twist[:3] *= grown

    def _map_keyframe(
        self, keyframe: int, features: Features, image: NDArray[np.uint8] | None, map_: Map
    ) -> None:
        map_and_calibrate(map_, keyframe, self._camera, self._config)
        self._closing.process(map_, keyframe, features, image)

    def _start(self, job: Callable[[Map], None]) -> None:
        """Start a job that maps; tracking goes on with the view as it is."""
        self._shared.start(job)
        self._is_merged = False
