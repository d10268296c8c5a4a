"""The two modes of SLAM: building a map, and localising in a map without changing it."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from vslam.frontend.images import Images
from vslam.frontend.keyframes import KeyframeEvidence, KeyframePolicy
from vslam.frontend.prediction import Prediction
from vslam.frontend.tracker import Tracker
from vslam.method.mapping import Mapper
from vslam.method.published_map import PublishedMap
from vslam.method.starter import Starter, TurnBetween, track_waiting
from vslam.types.camera import Image
from vslam.types.context import Context
from vslam.types.geometry import inverse, orthonormalised, se3_log
from vslam.types.states import PolicyState
from vslam.types.track import By, Track

# A sub-map is rescaled so that the camera keeps the speed that it had before it was lost. It is
# not rescaled if the factor would be larger than this number or smaller than its inverse. [own]
_MAX_RESCALING = 10.0

# A standing camera is still at its reference keyframe if it has moved by less than this many
# baselines, and if its rotation moves the image by less than this many pixels.
STANDS_M, STANDS_PX = 0.1, 3.0
PATIENCE_S = 5.0  # s before a sub-map begins if a standing camera is lost


class Mode(Protocol):
    """Decides how frames change the map.

    Attributes:
        changes_map: whether a drive in this mode changes the map.
        due: index of the frame that is planned to become a keyframe, or -1.
    """

    @property
    def changes_map(self) -> bool: ...
    @property
    def due(self) -> int: ...

    def begin(self, track: Track, image: Image | None) -> Track:
        """Try to begin a map or sub-map with a recorded frame that was not tracked.

        Returns:
            The frame. It is a keyframe if it has begun a map.
        """
        ...

    def map_far_points(self, last: Track | None) -> Track | None:
        """Map the far stereo points of the last frame if this frame began a map or sub-map.

        Call this method if the new frame cannot be tracked.

        Returns:
            The last frame with the added points, so that tracking can be tried again. None if no
            points were added.
        """
        ...

    def update_map(self, track: Track, images: Images, predicted: Prediction) -> Track:
        """Change the map after a frame was recorded.

        Returns:
            The frame in the changed map. It may have become a keyframe.
        """
        ...

    def state(self) -> PolicyState | None:
        """Return the state for a checkpoint, or None if no checkpoint is possible now."""
        ...


class Localising:
    """Localises in the map and never changes it (``Mode``)."""

    changes_map = False
    due = -1

    def __init__(self, published: PublishedMap) -> None:
        self._published = published

    def begin(self, track: Track, image: Image | None) -> Track:
        return track

    def map_far_points(self, last: Track | None) -> Track | None:
        return None

    def update_map(self, track: Track, images: Images, predicted: Prediction) -> Track:
        if not track.is_lost:
            self._published.refer_to_nearest(track)
        return track

    def state(self) -> PolicyState | None:
        return None


class Building:
    """Builds a map (``Mode``). Frames that see something new are inserted as keyframes.

    Attributes:
        starter: finds the frames with which a monocular map or sub-map begins.
        policy: decides which frames become keyframes.
    """

    changes_map = True

    def __init__(
        self,
        context: Context,
        mapper: Mapper,
        tracker: Tracker,
        state: PolicyState | None = None,
        turn_between: TurnBetween | None = None,
    ) -> None:
        """
        Args:
            state: the state of the keyframe policy in a checkpoint; None at the start of a drive.
            turn_between: see ``Starter``.
        """
        self.starter = Starter(context, turn_between)
        self.policy = KeyframePolicy(context, state)
        self._camera = context.camera
        self._config = context.config
        self._mapper = mapper
        self._published = mapper.published
        self._tracker = tracker

    @property
    def due(self) -> int:
        return self.policy.due

    def begin(self, track: Track, image: Image | None) -> Track:
        if self._camera.monocular:
            return self._begin_with_two_views(track, image)
        if track.n_stereo < self._config.tracking.min_stereo_start:
            return track
        predicted, fresh = track.twist is not None, replace(track.without(), twist=None)
        track = self._mapper.insert(fresh, image, predicted=predicted)
        self.policy.reference_renewed()
        return track

    def _begin_with_two_views(self, track: Track, image: Image | None) -> Track:
        start = self.starter.offer(track, image)
        if start is None:
            return track
        (moved,) = self._published.complete(track)
        carried = start.is_carried
        start = start.as_carried() if carried else start.at_speed(moved.twist, _MAX_RESCALING)
        if start is None:
            return track
        first, second = self._mapper.begin(start)
        for found in track_waiting(start, first, second, self._published.view, self._tracker):
            self._published.find(found, beside=first.index)
        self.starter.reset()
        self.policy.reference_renewed()
        return second

    def map_far_points(self, last: Track | None) -> Track | None:
        if last is None or last.twist is not None or self._camera.monocular:
            return None
        return self._mapper.map_far_points(last)

    def update_map(self, track: Track, images: Images, predicted: Prediction) -> Track:
        if track.is_lost:
            if self._is_lost_for_long(track, predicted):
                return self.begin(track, images.image)
            if self._camera.monocular:
                self.starter.wait(track)
            return track
        self.starter.reset()
        self._published.count(track)
        self._published.keep(track)
        evidence = self.policy.observe(
            track,
            self._published.view,
            seconds_since_keyframe=track.timestamp - self._published.last_timestamp,
            mapping_idle=self._published.is_published,
        )
        if track.by is By.STANDSTILL or self._stays_at_reference(track):
            return track  # only a moving object could show something new
        if not self._is_keyframe(track, evidence):
            return track
        (track,) = self._published.complete(track)
        seen: Track | None = track
        if track.by_patches:
            seen = self._tracker.match_features(track, images, self._published.view)
        if seen is None or self._use_existing_keyframe(seen):
            return seen or track
        self.policy.reference_renewed()
        return self._mapper.insert(seen, images.image)

    def _is_lost_for_long(self, track: Track, predicted: Prediction) -> bool:
        """Return whether a lost frame may begin a sub-map."""
        config, last = self._config.tracking, predicted.last
        young = self._published.n_keyframes <= config.young_keyframes
        patience = 1 if young else config.lost_frames_before_restart
        if self._camera.monocular:
            patience = config.monocular_lost_frames
        stood = last is not None and predicted.standstill(self._published.view) is not None
        if last is not None and stood and track.timestamp - last.timestamp < PATIENCE_S:
            return False  # something may be standing or passing in front of the camera
        return predicted.lost_frames + 1 >= patience

    def _stays_at_reference(self, track: Track) -> bool:
        """Return whether the camera has come to rest at its reference keyframe."""
        if track.still is None:
            return False
        moved = se3_log(orthonormalised(track.T_cw @ inverse(self._published.view.T_reference)))
        camera = self._camera
        return bool(
            np.linalg.norm(moved[:3]) < STANDS_M * camera.baseline
            and np.linalg.norm(moved[3:]) * camera.fx < STANDS_PX
        )

    def _is_keyframe(self, track: Track, evidence: KeyframeEvidence) -> bool:
        if track.by_patches:
            return self.policy.is_due(track.index, evidence)
        return self.policy.wants_keyframe(evidence)

    def _use_existing_keyframe(self, track: Track) -> bool:
        """If the place is known, make an existing keyframe the reference keyframe.

        Returns:
            Whether the place is known.
        """
        place, n_inliers = self._mapper.find_old_place(track), len(track.tracked)
        if place is None or not self.policy.is_known(
            n_inliers=n_inliers, n_shared=place.n_shared, n_place=place.n_place
        ):
            return False
        self._mapper.use_existing_keyframe(place, track)
        self.policy.reference_renewed()
        return True

    def state(self) -> PolicyState | None:
        return None if self.starter.is_waiting else self.policy.state
