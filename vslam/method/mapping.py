"""Local mapping in parallel with tracking, with the same result on every machine.

``Mapper`` adds frames to the map. ``PublishedMap`` decides when tracking sees the results.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from vslam.backend.disparity_offset import map_and_calibrate
from vslam.backend.local_mapping import refresh_keyframe
from vslam.backend.triangulation import map_stereo_points
from vslam.frontend.patches import certainty_of, patches_of_frame
from vslam.frontend.track import Track
from vslam.method.map_frames import (
    OldPlace,
    add_frame,
    add_revisit,
    add_two_views,
    count_shared_landmarks,
    find_old_place,
    has_more_points,
    observe_keyframe,
    sees_old_place,
)
from vslam.method.published_map import PublishedMap
from vslam.method.starter import TwoViewStart
from vslam.types.camera import Image
from vslam.types.map import Map


class Mapper(PublishedMap):
    """The owner of the map. Only its methods, and the jobs that it starts, change the map."""

    def insert(self, track: Track, image: Image | None, *, predicted: bool = True) -> Track:
        """Make the newest frame a keyframe, map its stereo points and start its mapping job.

        A frame that shares no landmark with the map begins a sub-map.

        Args:
            image: the image for loop detectors. None if it is not available.
            predicted: if the frame begins a sub-map, whether its pose was predicted.

        Returns:
            The frame with all landmarks of its keyframe.
        """
        (track,) = self.settle(track)
        config = self._context.config
        with self._shared.change() as map_:
            track = self._make_room(map_, track)
            certainty = certainty_of(track, config.alignment)
            keyframe = add_frame(map_, track, certainty, self.reference, predicted=predicted)
            map_stereo_points(map_, keyframe, self._context.camera, config)
            refresh_keyframe(map_, keyframe)
            if sees_old_place(map_, keyframe, config.mapping.min_shared):
                self._closing.count_revisit(map_)
            else:
                self._closing.adjust_after_revisits(map_)
            track = self._set_newest(keyframe, track)
            self.frames.replace(track.index, keyframe)
            if keyframe > 0:
                search = partial(
                    self._closing.search, keyframe=keyframe, features=track.features, image=image
                )
                self._start(partial(self._map_keyframe, keyframe), search)
            else:
                self._closing.process(map_, keyframe, track.features, image)
        return track

    def map_far_points(self, track: Track) -> Track | None:
        """Map all stereo points of the first keyframe of a map or sub-map.

        ORB-SLAM2 (III-B) maps all points from the start. However, the calibration error of a stereo
        pair biases far points and therefore the first poses. Far points are needed only at high
        speed, when close points leave the view within a frame.

        Returns:
            The frame with the added landmarks. None if no points were added: the frame is not such
            a keyframe, or another keyframe follows it.
        """
        (track,) = self.settle(track)
        with self._shared.change() as map_:
            keyframe = self.reference
            if not has_more_points(map_, keyframe, track):
                return None
            new = map_stereo_points(
                map_, keyframe, self._context.camera, self._context.config, far=True
            )
            refresh_keyframe(map_, keyframe)
            self.refer_to(keyframe)
            return observe_keyframe(track, map_, keyframe) if len(new) else None

    def begin(self, start: TwoViewStart) -> Track:
        """Begin a monocular map or sub-map with two keyframes. The second is the newest frame.

        Returns:
            The second frame with its pose, its velocity and all landmarks of its keyframe.
        """
        self.settle()
        with self._shared.change() as map_:
            second = self._make_room(map_, start.second)
            keyframes = add_two_views(map_, start, self.reference)
            tracks = start.first, second
            for keyframe, track, image in zip(keyframes, tracks, start.images, strict=True):
                self._closing.process(map_, keyframe, track.features, image)
            second = self._set_newest(keyframes[1], second)
            for keyframe, track in zip(keyframes, tracks, strict=True):
                self.frames.replace(track.index, keyframe)
        return replace(second, T_cw=self.frames.pose(second.index), twist=start.twist)

    def find_old_place(self, track: Track) -> OldPlace | None:
        """Find a place that was mapped some time ago and to which a frame has returned."""
        return find_old_place(self.map, track, self._context.config.keyframes.known_after_s)

    def use_existing_keyframe(self, place: OldPlace, track: Track) -> None:
        """Make an existing keyframe the reference keyframe instead of inserting a new keyframe."""
        with self._shared.change() as map_:
            certainty = certainty_of(track, self._context.config.alignment)
            new = add_revisit(map_, place.keyframe, track, certainty)
        self.last_timestamp = track.timestamp
        self.frames.follow(track.index, place.keyframe, track.T_cw)
        self._known_place = patches_of_frame(track, map_.scales)
        self.refer_to(place.keyframe)
        if self._closing.count_reused_keyframe(map_, new=new):
            self.last_frame = track.index
            self._start(self._closing.finish)

    def refer_to_nearest(self, track: Track) -> None:
        """Refer to the keyframe that shares the most landmarks with a frame (ORB-SLAM, V-D)."""
        shared = count_shared_landmarks(self.map, track)
        best = int(np.argmax(shared))
        if shared[best] and best != self.reference:
            self.refer_to(best)

    def _make_room(self, map_: Map, track: Track) -> Track:
        """Drop culled landmarks if there are many, unless a global bundle adjustment is running.

        Dropping changes the ids of the other landmarks, to which the adjustment refers.
        """
        if self._closing.is_adjusting or not map_.many_culled_landmarks:
            return track
        new_id, landmark = map_.drop_culled_landmarks(), track.landmark.copy()
        landmark[track.landmark >= 0] = new_id[track.tracked]
        return replace(track, landmark=landmark)

    def _set_newest(self, keyframe: int, track: Track) -> Track:
        map_ = self.map
        self._patches.remember(track, keyframe, map_.scales)
        self._known_place = None
        self.last_frame, self.last_timestamp = track.index, track.timestamp
        self.refer_to(keyframe)
        return replace(observe_keyframe(track, map_, keyframe), is_keyframe=True)

    def _map_keyframe(self, keyframe: int, map_: Map) -> None:
        map_and_calibrate(map_, keyframe, self._context.camera, self._context.config)
        self._closing.merge_adjustment_if_due(map_, keyframe)
