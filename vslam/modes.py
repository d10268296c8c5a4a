"""The two modes of SLAM: building a map, and localising in a map without changing it."""

from __future__ import annotations

import numpy as np

from vslam.context import Context
from vslam.frontend.frame import PlacedFrame
from vslam.frontend.keyframes import KeyframeEvidence, KeyframePolicy
from vslam.frontend.tracker import Found, Tracker
from vslam.geometry import inverse, orthonormalised, se3_log
from vslam.mapping import Mapper
from vslam.starter import OneViewStart, Starter
from vslam.states import PolicyState

# A standing camera is still at its reference keyframe if it has moved by less than this many
# baselines, and if its rotation moves the image by less than this many pixels.
STANDS_M, STANDS_PX = 0.1, 3.0
PATIENCE_S = 5.0  # s before a sub-map begins if a standing camera is lost


class Mode:
    """Decides how frames change the map.

    This base class only localises in the map and never changes it.

    Attributes:
        changes_map: whether a drive in this mode changes the map.
    """

    changes_map = False

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper

    @property
    def due(self) -> int:
        """Index of the frame that is planned to become a keyframe, or -1."""
        return -1

    def begin(self, frame: PlacedFrame) -> bool:
        """Try to begin a map or sub-map with an untracked frame. Return whether it was begun."""
        return False

    def begin_after_loss(self, frame: PlacedFrame) -> bool:
        """Do the same as ``begin``, but only if the camera has been lost for enough frames."""
        return False

    def map_far_points(self) -> bool:
        """Map the far stereo points of the last frame if this frame began a map or sub-map.

        Call this method if the new frame cannot be tracked.

        Returns:
            True if points were added, so that tracking can be tried again.
        """
        return False

    def update_map(self, frame: PlacedFrame, found: Found) -> bool:
        """Count the landmarks of a tracked frame. Insert it as a keyframe if it shows new points.

        Returns:
            Whether the frame was inserted as a keyframe.
        """
        self._mapper.refer_to_nearest(frame)
        return False

    def state(self) -> PolicyState | None:
        """Return the state for a checkpoint, or None if no checkpoint is possible now."""
        return None

    def restore(self, state: PolicyState) -> None:
        """Restore a state that the method ``state`` returned."""


class MapBuilding(Mode):
    """Builds a map. Frames that see something new are inserted as keyframes.

    Attributes:
        starter: finds the frames with which a map or a sub-map begins.
        policy: decides which frames become keyframes.
    """

    changes_map = True

    def __init__(self, context: Context, mapper: Mapper, tracker: Tracker) -> None:
        super().__init__(mapper)
        self.starter = Starter(context)
        self.policy = KeyframePolicy(context)
        self._camera = context.camera
        self._config = context.config.tracking
        self._tracker = tracker

    @property
    def due(self) -> int:
        return self.policy.due

    def begin(self, frame: PlacedFrame) -> bool:
        start = self.starter.offer(frame)
        if start is None:
            return False
        if isinstance(start, OneViewStart):
            frame.landmark[:] = -1
            self._mapper.insert(frame, predicted=self._tracker.twist is not None)
            self.policy.reference_renewed()
        else:
            self._mapper.begin(start, lambda: self._tracker.twist)
            self.starter.reset()
        self._tracker.start_from(frame)
        return True

    def begin_after_loss(self, frame: PlacedFrame) -> bool:
        config = self._config
        young = self._mapper.n_keyframes <= config.young_keyframes
        patience = 1 if young else config.lost_frames_before_restart
        if self._camera.monocular:
            patience = config.monocular_lost_frames
        last = self._tracker.last if self._tracker.stands_still else None
        if last is not None and frame.timestamp - last.timestamp < PATIENCE_S:
            return False  # something may be standing or passing in front of the camera
        return self._tracker.lost_frames >= patience and self.begin(frame)

    def map_far_points(self) -> bool:
        last = self._tracker.last
        if last is None or last.twist is not None or self._camera.monocular:
            return False
        return self._mapper.map_far_points(last)

    def update_map(self, frame: PlacedFrame, found: Found) -> bool:
        self.starter.reset()
        self._mapper.count(found.visible, frame.landmark[frame.landmark >= 0])
        evidence = self.policy.observe(
            frame,
            self._mapper.view,
            seconds_since_keyframe=frame.timestamp - self._mapper.last_timestamp,
            mapping_idle=self._mapper.is_merged,
        )
        if found.stands_still or self._stays_at_reference(frame):
            return False  # only a moving object could show something new
        if not self._is_keyframe(frame, evidence):
            return False
        self._mapper.settle()
        if not self._match_features(frame) or self._use_existing_keyframe(frame):
            return False
        self._mapper.insert(frame)
        self.policy.reference_renewed()
        return True

    def _stays_at_reference(self, frame: PlacedFrame) -> bool:
        """Return whether the camera has come to rest at its reference keyframe."""
        if not self._tracker.stands_still:
            return False
        moved = se3_log(orthonormalised(frame.T_cw @ inverse(self._mapper.view.T_reference)))
        camera = self._camera
        return bool(
            np.linalg.norm(moved[:3]) < STANDS_M * camera.baseline
            and np.linalg.norm(moved[3:]) * camera.fx < STANDS_PX
        )

    def _is_keyframe(self, frame: PlacedFrame, evidence: KeyframeEvidence) -> bool:
        if frame.source is None:
            return self.policy.wants_keyframe(evidence)
        return self.policy.is_due(frame.index, evidence)

    def _use_existing_keyframe(self, frame: PlacedFrame) -> bool:
        """If the place is known, make an existing keyframe the reference keyframe.

        Returns:
            Whether the place is known.
        """
        place = self._mapper.find_old_place(frame)
        n_inliers = int(np.count_nonzero(frame.landmark >= 0))
        if place is None or not self.policy.is_known(
            n_inliers=n_inliers, n_shared=place.n_shared, n_place=place.n_place
        ):
            return False
        self._mapper.use_existing_keyframe(place, frame)
        self.policy.reference_renewed()
        return True

    def _match_features(self, frame: PlacedFrame) -> bool:
        """Match the features of a frame that was tracked by patches.

        Returns:
            False if the features do not match the map. The frame is then left unchanged.
        """
        if frame.source is None:
            return True
        before = frame.snapshot()
        self._mapper.rig.extract(frame, frame.twist)
        if self._tracker.match_features(frame, before, self._mapper.view):
            return True
        frame.restore(before)
        return False

    def state(self) -> PolicyState | None:
        return None if self.starter.is_waiting else self.policy.state

    def restore(self, state: PolicyState) -> None:
        self.policy.state = state
