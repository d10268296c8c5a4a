"""The map, and what tracking sees of it.

A job in another thread maps each keyframe. Its result is *published*: it becomes visible to
tracking. This happens at a fixed frame index, regardless of how long the job takes. In between,
tracking reads a ``MapView``, which is a copy of parts of the map. Frames that tracking holds move
with the map: a method that publishes takes them, and returns them as they are in the changed map.

After publishing, the other thread searches for a loop at the keyframe. If a loop is found, it is
closed before the map is changed again.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vslam.frontend.patch_tracking import stride_of
from vslam.frontend.patches import RecentPatches, patches_of_frame, patches_of_landmarks
from vslam.method.closing import LoopClosing, LoopSearch
from vslam.method.hypotheses import part_of
from vslam.method.map_frames import LandmarkCounts, MapChange, count_shared_landmarks
from vslam.method.recent_frames import RecentFrames
from vslam.method.shared_map import SharedMap
from vslam.support.workers import Job, Workers
from vslam.types.context import Context
from vslam.types.features import FramePatches, KeyframePatches, TrackingState
from vslam.types.frame_poses import FramePoses, FrameTable
from vslam.types.geometry import Matrix, inverse
from vslam.types.map import Map
from vslam.types.map_view import MapView, local_map, view_of
from vslam.types.states import PublishedState
from vslam.types.track import Track
from vslam.types.trajectory import Trajectory

# A loop that was found is closed this many frames after its keyframe, or at the next keyframe.
_CLOSE_AFTER_FRAMES = 10


class PublishedMap:
    """A map that jobs change, and the view of it that tracking reads.

    Attributes:
        view: the copy of parts of the map that tracking reads.
        frames: the pose of every frame, relative to a keyframe.
        last_frame: index of the frame at which the last mapping job started.
        last_timestamp: time (seconds) of the last frame that became a keyframe or returned to a
            known place.
        is_published: whether tracking sees the results of all mapping jobs.
    """

    def __init__(
        self,
        context: Context,
        closing: LoopClosing,
        workers: Workers,
        map_: Map | None = None,
        frames: FrameTable | None = None,
        state: PublishedState | None = None,
    ) -> None:
        """Begin a new map, or continue a map.

        Args:
            workers: threads that run mapping jobs, one at a time, and searches for loops.
            map_: map to continue in. None begins an empty map.
            frames: poses of earlier frames of the same drive.
            state: the state that was saved together with the map; None without a checkpoint.
        """
        self.view = MapView(T_reference=inverse(context.camera.T_mounted_camera))
        self.last_frame = -1
        self.last_timestamp = -np.inf
        self.is_published = True
        self._shared = SharedMap(map_ or Map(context.scales), workers)
        self._context = context
        self._closing = closing
        self._patches = RecentPatches(context.config.alignment.keyframes)
        self._known_place: FramePatches | None = None
        self._next_search: Callable[[Map], LoopSearch] | None = None  # starts after publishing
        self._search: Job[LoopSearch] | None = None
        self._counts = LandmarkCounts()
        self.frames = FramePoses(self, frames)
        self._recent = RecentFrames(context, self.frames)
        if state is None and self.map.n_keyframes:
            state = _state_at(int(self.map.living_keyframes()[-1]), self.map, self.frames)
        if state is not None:
            self.last_frame, self.last_timestamp = state.last_frame, state.last_timestamp
            for patches in state.patches:
                self._patches.add(patches)
            self._known_place = state.known_place
            self._recent = RecentFrames(context, self.frames, state.recent)
            self.refer_to(state.reference)

    # What may be read at any time

    @property
    def n_keyframes(self) -> int:
        """Number of keyframes so far, including culled keyframes."""
        return self.view.n_keyframes

    @property
    def reference(self) -> int:
        """The keyframe that the poses of new frames are relative to."""
        return self.view.reference

    @property
    def is_complete(self) -> bool:
        """Whether ``complete`` would change nothing. Waits for the search for a loop."""
        found = self._search is not None and self._search.result().loop is not None
        return self.is_published and not found

    @property
    def is_mapping(self) -> bool:
        """Whether a keyframe is being mapped, so that another thread may be writing the map."""
        return self._shared.is_busy

    @property
    def map(self) -> Map:
        """The map. Raises a RuntimeError if a keyframe is being mapped, or its mapping failed."""
        return self._shared.map

    def keyframe(self, keyframe: int) -> tuple[Matrix, float]:
        """Return the pose ``T_cw`` of a keyframe and its unit of length (``KeyframePoses``).

        While a mapping job runs, only those of the reference keyframe are available.
        """
        if not self.is_published and keyframe == self.view.reference:
            return self.view.T_reference, self.view.unit_scale
        return self.map.keyframe_pose(keyframe), float(self.map.unit_scale[keyframe])

    def trajectory(self) -> Trajectory:
        """Return the pose of every frame (``FramePoses.trajectory``)."""
        self.map  # noqa: B018 (raises if it cannot be read)
        return self.frames.trajectory()

    # The schedule

    def publish(self, *tracks: Track, frame: int | None = None) -> tuple[Track, ...]:
        """Make the result of the mapping job visible to tracking, and return the moved tracks.

        Args:
            frame: index of the next frame. Only what is due at this frame is published: the result
                of the mapping job ``publish_after_frames`` frames after the last keyframe, and a
                loop that was found there after ten frames. If it is None, the result of the mapping
                job is due, and no loop.
        """
        if frame is not None:
            age = frame - self.last_frame
            if age >= _CLOSE_AFTER_FRAMES:
                return self.complete(*tracks)
            if age < self._context.config.keyframes.publish_after_frames:
                return tracks
        if self.is_published:
            return tracks
        self._wait_for_mapping()
        self.is_published = True
        tracks = self.renew_view(*tracks)
        self._recent.settle(self.map)
        self._start_search()
        return tracks

    def complete(self, *tracks: Track) -> tuple[Track, ...]:
        """Publish the result of the mapping job, close the loop if one was found, and return the
        moved tracks. Every change of the map begins with this."""
        tracks = self.publish(*tracks)
        self.wait()
        if self._search is None:
            return tracks
        search, self._search = self._search.result(), None
        with self.change() as map_:
            self._closing.close(map_, search)
        return self.renew_view(*tracks)

    def wait(self) -> Map:
        """Wait for the mapping job and for the search for loops, and return the map.

        Nothing is published. Therefore, this method does not change the trajectory.
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

    # Changes

    def change(self) -> AbstractContextManager[Map]:
        """Return the map for changes, which begin when everything is complete."""
        return self._shared.change()

    def start(
        self, job: Callable[[Map], None], search: Callable[[Map], LoopSearch] | None = None
    ) -> None:
        """Start a job that changes the map, and then a search for a loop."""
        self._shared.start(job)
        self.last_frame = len(self.frames) - 1
        self._next_search = search
        self.is_published = False

    def renew_view(self, *tracks: Track) -> tuple[Track, ...]:
        """Show tracking the map as it is now, and return the moved tracks."""
        before = self.view
        self.refer_to(before.reference)
        change = MapChange(before, self.view, self.map, self.frames)
        return tuple(change.applied_to(track) for track in tracks)

    # Frames

    def record(self, track: Track) -> None:
        """Record the pose of the next frame. Only a recorded frame can become a keyframe.

        If the frame was relocalised, the keyframe near it becomes the reference keyframe.
        """
        if track.near >= 0:
            self.refer_to(track.near)
        carried = track.state == TrackingState.INERTIAL
        self.frames.append(track.timestamp, track.T_cw, tracked=not track.is_lost, carried=carried)

    def count(self, track: Track) -> None:
        """Count the landmarks that a frame should have seen, and those that it found."""
        self._counts.add(track.visible, track.tracked)

    def keep(self, track: Track) -> None:
        """Keep what a recorded frame of a monocular camera observed, so that its pose is found
        again when the map has been adjusted."""
        if self._context.camera.monocular:
            self._recent.add(track, self.n_keyframes)

    def find(self, track: Track, *, beside: int) -> None:
        """Record the pose of an earlier frame, which was tracked only now (``FramePoses.find``)."""
        self.frames.find(track.index, track.T_cw, beside=beside)
        self.keep(track)

    def renumber(self, new_id: NDArray[np.int32]) -> None:
        """Replace the ids of landmarks after ``Map.drop_culled_landmarks``."""
        self._recent.renumber(new_id)

    def conclude(self) -> None:
        """Find the final poses of the frames at the end of a drive."""
        self._recent.conclude(self.map)

    # The reference keyframe, which is not part of the map

    def refer_to(self, keyframe: int) -> None:
        """Make a keyframe the reference keyframe, so that tracking sees the landmarks around it."""
        map_, config = self.map, self._context.config
        local = local_map(map_, keyframe, config.tracking.local_keyframes)
        if (place := self._known_place) is None:
            patches = self._patches.of(map_, local.ids)
        else:
            T_cw = self.frames.pose(place.frame)
            patches = patches_of_landmarks(place, local.ids, T_cw, map_.scales)
        monocular = self._context.camera.monocular
        stride = stride_of(patches, local, map_.keyframe_pose(keyframe), self._context)
        self.view = replace(
            view_of(map_, keyframe, local, patches, stride, monocular=monocular),
            part=part_of(map_, self._closing.closed, keyframe),
        )

    def refer_to_new(self, keyframe: int, track: Track) -> None:
        """Make a new keyframe the reference keyframe. Its frame has been recorded."""
        self._patches.remember(track, keyframe, self._context.scales)
        self._known_place = None
        self.last_frame, self.last_timestamp = track.index, track.timestamp
        self.refer_to(keyframe)
        self.frames.replace(track.index, keyframe)
        self._recent.forget(track.index)

    def newest_patches(self) -> tuple[KeyframePatches, ...]:
        """Return copies of the image patches of the newest keyframes, oldest keyframe first."""
        return self._patches.all()

    def refer_to_known(self, keyframe: int, track: Track) -> None:
        """Make the old keyframe of a known place the reference keyframe of a frame."""
        self.frames.follow(track.index, keyframe, track.T_cw)
        self._known_place = patches_of_frame(track, self._context.scales)
        self.last_timestamp = track.timestamp
        self.refer_to(keyframe)

    def refer_to_nearest(self, track: Track) -> None:
        """Refer to the keyframe that shares the most landmarks with a frame (ORB-SLAM, V-D)."""
        shared = count_shared_landmarks(self.map, track)
        best = int(np.argmax(shared))
        if shared[best] and best != self.reference:
            self.refer_to(best)

    def state(self) -> PublishedState:
        """Return the state for a checkpoint, without the map."""
        return PublishedState(
            self.reference,
            self.last_frame,
            self.last_timestamp,
            self._patches.all(),
            self._known_place,
            self._recent.all(),
        )


def _state_at(keyframe: int, map_: Map, frames: FramePoses) -> PublishedState:
    """Return the state with which a map is continued at a keyframe.

    If the drive itself continues, the keyframe counts as the last that was inserted.
    """
    if not len(frames) or map_.sessions[keyframe] != map_.scalars.session:
        return PublishedState(keyframe)
    return PublishedState(keyframe, int(map_.frames[keyframe]), float(map_.timestamps[keyframe]))
