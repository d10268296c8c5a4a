"""Local mapping in parallel with tracking, with the same result on every machine.

``Mapper`` adds frames to the map. ``PublishedMap`` decides when tracking sees the results.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from vslam.backend.disparity_offset import refine_and_calibrate
from vslam.backend.keyframe_motions import record_motion
from vslam.backend.local_mapping import MIN_SHARED, extend_map, refresh_keyframe
from vslam.backend.metric_mapping import (
    MapScale,
    adjust_widely,
    is_wide,
    record_missing_motions,
    scale_of_map,
)
from vslam.backend.triangulation import map_stereo_points
from vslam.frontend.keyframe_alignment import align_observations
from vslam.frontend.patches import certainty_of
from vslam.method.closing import LoopClosing
from vslam.method.map_frames import (
    OldPlace,
    add_frame,
    add_revisit,
    add_two_views,
    find_old_place,
    has_more_points,
    newest_unit,
    observe_keyframe,
    sees_old_place,
)
from vslam.method.published_map import PublishedMap
from vslam.method.starter import TwoViewStart
from vslam.support.workers import Workers
from vslam.types.camera import Image
from vslam.types.context import Context
from vslam.types.features import KeyframePatches
from vslam.types.frame_poses import FrameTable
from vslam.types.imu import InertialWindow
from vslam.types.map import Map
from vslam.types.states import PublishedState
from vslam.types.track import Track


class Mapper:
    """Adds frames to the map. Only its methods, and the jobs that they start, change the map.

    Attributes:
        published: the map, and what tracking sees of it.
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
        """
        Args:
            workers, map_, frames, state: see ``PublishedMap``.
        """
        self.published = PublishedMap(context, closing, workers, map_, frames, state)
        self._context = context
        self._closing = closing

    def insert(self, track: Track, image: Image | None, *, predicted: bool = True) -> Track:
        """Make the newest frame a keyframe, map its stereo points and start its mapping job.

        A frame that shares no landmark with the map begins a sub-map.

        Args:
            image: the image for loop detectors. None if it is not available.
            predicted: if the frame begins a sub-map, whether its pose was predicted.

        Returns:
            The frame with all landmarks of its keyframe.
        """
        published, closing = self.published, self._closing
        (track,) = published.complete(track)
        with published.change() as map_:
            track = self._make_room(map_, track)
            certainty = certainty_of(track, self._context)
            keyframe = add_frame(map_, track, certainty, published.reference, predicted=predicted)
            map_stereo_points(map_, keyframe, self._context)
            refresh_keyframe(map_, keyframe)
            if sees_old_place(map_, keyframe, MIN_SHARED):
                closing.count_revisit(map_)
            else:
                closing.adjust_after_revisits(map_)
            published.refer_to_new(keyframe, track)
            track = observe_keyframe(track, map_, keyframe)
            if keyframe > 0:
                search = partial(
                    closing.search, keyframe=keyframe, features=track.features, image=image
                )
                patches = published.newest_patches() if self._context.camera.monocular else ()
                job = partial(self._map_keyframe, keyframe, track.inertial, patches)
                published.start(job, search)
            else:
                closing.process(map_, keyframe, track.features, image)
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
        published = self.published
        (track,) = published.complete(track)
        with published.change() as map_:
            keyframe = published.reference
            if not has_more_points(map_, keyframe, track):
                return None
            new = map_stereo_points(map_, keyframe, self._context, far=True)
            refresh_keyframe(map_, keyframe)
            published.refer_to(keyframe)
            return observe_keyframe(track, map_, keyframe) if len(new) else None

    def begin(self, start: TwoViewStart) -> tuple[Track, Track]:
        """Begin a monocular map or sub-map with two keyframes. The second is the newest frame.

        Returns:
            The two frames with their poses, the velocity between them, and all landmarks of their
            keyframes.
        """
        published = self.published
        published.complete()
        with published.change() as map_:
            second = self._make_room(map_, start.second)
            keyframes = add_two_views(map_, start, published.reference, self._context)
            if start.second.inertial is not None:
                for keyframe in keyframes:
                    record_motion(map_, keyframe, start.second.inertial)
            tracks = start.first, second
            for keyframe, track, image in zip(keyframes, tracks, start.images, strict=True):
                self._closing.process(map_, keyframe, track.features, image)
            published.frames.replace(start.first.index, keyframes[0])
            first = observe_keyframe(start.first, map_, keyframes[0])
            second = observe_keyframe(second, map_, keyframes[1])
            published.refer_to_new(keyframes[1], second)
        frames, twist = published.frames, start.twist
        return (
            replace(first, T_cw=frames.pose(first.index), twist=twist),
            replace(second, T_cw=frames.pose(second.index), twist=twist),
        )

    def find_scale(self, start: float, inertial: InertialWindow) -> MapScale | None:
        """Find the scale of the map, or of its newest sub-map if the map is metric, from the
        samples of an IMU (``scale_of_map``).

        Args:
            inertial: what is known from the IMU at the last frame, and all samples since the map
                began.
        """
        R_wc = self.published.frames.pose(-1)[:3, :3].T
        with self.published.change() as map_:
            first = newest_unit(map_)
            record_missing_motions(map_, first, inertial)
            return scale_of_map(map_, first, self._context, inertial, R_wc, start)

    def rescale(self, scale: float, inertial: InertialWindow, *tracks: Track) -> tuple[Track, ...]:
        """Make the metre the unit of the map, or of its newest sub-map if the map is metric. Return
        the moved tracks.

        Args:
            scale: metres per unit.
            inertial: what is known from the IMU at the last frame.
            tracks: as they are when everything is complete.
        """
        with self.published.change() as map_:
            self._closing.rescale(map_, newest_unit(map_), scale)
            map_.scalars = replace(map_.scalars, metric=True)
            self._adjust_widely(map_, inertial)
        return self.published.renew_view(*tracks)

    def find_old_place(self, track: Track) -> OldPlace | None:
        """Find a place that was mapped some time ago and to which a frame has returned."""
        known_after_s = self._context.config.keyframes.known_after_s
        return find_old_place(self.published.map, track, known_after_s)

    def use_existing_keyframe(self, place: OldPlace, track: Track) -> None:
        """Make an existing keyframe the reference keyframe instead of inserting a new keyframe."""
        published = self.published
        with published.change() as map_:
            certainty = certainty_of(track, self._context)
            new = add_revisit(map_, place.keyframe, track, certainty)
        published.refer_to_known(place.keyframe, track)
        if self._closing.count_reused_keyframe(map_, new=new):
            published.start(self._closing.finish)

    def finish(self, *tracks: Track, inertial: InertialWindow | None = None) -> tuple[Track, ...]:
        """Complete all running work at the end of a drive, including a global bundle adjustment.
        Return the moved tracks.

        Args:
            inertial: what is known from the IMU at the last frame, for a monocular map. None
                without an IMU.
        """
        tracks = self.published.complete(*tracks)
        with self.published.change() as map_:
            self._closing.conclude(map_)
            self._closing.finish(map_)
            if inertial is not None:
                self._adjust_widely(map_, inertial)
        if map_.n_keyframes:
            tracks = self.published.renew_view(*tracks)
            self.published.conclude()
        return tracks

    def _make_room(self, map_: Map, track: Track) -> Track:
        """Drop culled landmarks if there are many, unless a global bundle adjustment is running.

        Dropping changes the ids of the other landmarks, to which the adjustment refers.
        """
        if self._closing.is_adjusting or not map_.many_culled_landmarks:
            return track
        new_id, landmark = map_.drop_culled_landmarks(), track.landmark.copy()
        self.published.renumber(new_id)
        landmark[track.landmark >= 0] = new_id[track.tracked]
        return replace(track, landmark=landmark)

    def _adjust_widely(self, map_: Map, inertial: InertialWindow) -> None:
        """Adjust the newest keyframes with what is known from the IMU at the last frame."""
        record_missing_motions(map_, newest_unit(map_), inertial)
        keyframe, R_wc = int(map_.living_keyframes()[-1]), self.published.frames.pose(-1)[:3, :3].T
        adjust_widely(map_, keyframe, self._context, inertial, R_wc)

    def _map_keyframe(
        self,
        keyframe: int,
        inertial: InertialWindow | None,
        patches: tuple[KeyframePatches, ...],
        map_: Map,
    ) -> None:
        extend_map(map_, keyframe, self._context)
        found = align_observations(map_, keyframe, patches, self._context)
        map_.move_observations(*found, self._context.aligned_certainty)
        refine_and_calibrate(map_, keyframe, self._context, inertial)
        if self._context.camera.monocular and inertial is not None and is_wide(map_, keyframe):
            record_missing_motions(map_, newest_unit(map_), inertial)
            R_wc = map_.keyframe_pose(keyframe)[:3, :3].T
            adjust_widely(map_, keyframe, self._context, inertial, R_wc)
        self._closing.apply_adjustment_if_due(map_, keyframe)
