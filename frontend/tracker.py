"""Where the camera is, given the frames before and a view of the map."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from vslam.features import Extracted, TrackingState, TrackResult
from vslam.frame_poses import FramePoses
from vslam.frontend.frame import Frame
from vslam.frontend.tracking import (
    TrackingContext,
    track_descriptors,
    track_local_map,
    track_motion,
)
from vslam.geometry import Matrix, inverse, orthonormalised, se3_exp, se3_log
from vslam.map_view import MapView
from vslam.states import TrackerState


class TrackerStatus(Enum):
    """What the tracker has to go on."""

    UNKNOWN = "unknown"
    """No frame was tracked in this map, and nothing tells where the camera is in it."""
    RESUMED = "resumed"
    """No frame was tracked yet, but a drive is continued: the camera is where that stopped."""
    TRACKING = "tracking"
    """The last frame was tracked, found again, or began a map."""
    LOST = "lost"
    """The last frame was not tracked; an earlier one may have been."""


@dataclass(frozen=True)
class Found:
    """The result of tracking or relocalising a frame; pose and matches are in the frame itself.

    Attributes:
        state: OK, WEAK or LOST.
        n_matches, n_inliers: of landmarks, before and after the last pose optimisation.
        visible: ``(N,)`` int32, the landmarks that the frame should see.
        keyframe: where it was found by searching the whole map; -1 if it was tracked.
        is_doubtful: whether it has so few inliers that its matches may be wrong.
    """

    state: TrackingState
    n_matches: int = 0
    n_inliers: int = 0
    visible: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    keyframe: int = -1
    is_doubtful: bool = False

    @classmethod
    def at_start(cls, frame: Frame, *, begun: bool) -> Found:
        """What is found before there is a map: all that a map begins with, if it has begun."""
        n_landmarks = int(np.count_nonzero(frame.landmark >= 0))
        state = TrackingState.OK if begun else TrackingState.LOST
        return cls(state, n_landmarks, n_landmarks)

    @property
    def is_lost(self) -> bool:
        """Whether the pose is not to be used."""
        return self.state == TrackingState.LOST

    @property
    def relocalised(self) -> bool:
        """Whether the frame was found by searching the whole map."""
        return self.keyframe >= 0


def judge(n_matches: int, n_inliers: int, context: TrackingContext) -> TrackingState:
    """What matches, and inliers of the pose optimisation, are worth."""
    config = context.config.tracking
    # In the wide windows of an RGB-D camera, a wrong pose too finds some inliers.
    share = config.depth_min_inlier_ratio if context.camera.depth else 0.0
    if n_inliers < config.min_inliers_lost or n_inliers < share * n_matches:
        return TrackingState.LOST
    return TrackingState.WEAK if n_inliers < config.min_inliers else TrackingState.OK


class Tracker:
    """Tracks one frame after the other. It never sees the map, only a view of it.

    Attributes:
        status: what there is to go on.
        last: the frame that was tracked last, None before the first.
        lost_frames: lost since then.
    """

    def __init__(self, context: TrackingContext) -> None:
        self.status = TrackerStatus.UNKNOWN
        self.last: Frame | None = None
        self.lost_frames = 0
        self._context = context
        self._config = context.config
        self._n_tracked = 0
        self._resumed_twist: Matrix | None = None

    @property
    def twist(self) -> Matrix | None:
        """``(6,)`` speed of the camera, per second, when it was tracked last; None if unknown."""
        return self._resumed_twist if self.last is None else self.last.twist

    def predict(self, timestamp: float, frames: FramePoses, view: MapView) -> Matrix:
        """Pose ``T_cw`` at a time, at constant velocity per second, so that dropped frames do not
        disturb it. In a map that was loaded, the camera is taken to be at the reference keyframe
        until it is found.

        Args:
            frames: all frames before, lost ones included.
        """
        if not len(frames):
            return view.T_reference
        T_last = frames.pose(-1)
        if self.twist is None:
            return T_last
        elapsed = timestamp - frames.timestamp(-1)
        return orthonormalised(se3_exp(self.twist * elapsed) @ T_last)

    def track(self, frame: Frame, T_cw: Matrix, view: MapView, frames: FramePoses) -> Found:
        """Track a frame that is expected at ``T_cw``: first by what the last frame or the reference
        keyframe saw, then by all landmarks around.

        Args:
            frames: all frames before.
        """
        n_inliers = self._track_previous_frame(frame, T_cw, view)
        if n_inliers < self._config.tracking.min_inliers_frame:
            return Found(TrackingState.LOST, n_matches=n_inliers)
        n_matches, n_inliers, visible = track_local_map(
            frame, view.local_landmarks, self._context, patches=view.patches
        )
        doubtful = self._is_doubtful(frame, n_inliers, view, frames)
        state = judge(n_matches, n_inliers, self._context)
        return Found(state, n_matches, n_inliers, visible, is_doubtful=doubtful)

    def accept(self, frame: Frame, found: Found, frames: FramePoses) -> None:
        """Go on from a frame that was found, and measure its twist: the motion since the last frame
        tracked. Where the camera was found again, the leap to there is no motion.

        Args:
            frames: all frames before.
        """
        if not found.relocalised:
            last = -1 if self.last is None else self.last.index
            step = se3_log(orthonormalised(frame.T_cw @ inverse(frames.pose(last))))
            frame.twist = step / (frame.timestamp - frames.timestamp(last))
        self._n_tracked = int(np.count_nonzero(frame.landmark >= 0))
        self.start_from(frame)

    def start_from(self, frame: Frame) -> None:
        """Go on from a frame with which a map or a sub-map began."""
        self.last, self.lost_frames, self.status = frame, 0, TrackerStatus.TRACKING

    def lose(self) -> None:
        """A frame was not tracked."""
        self.lost_frames += 1
        self.status = TrackerStatus.LOST

    def resume(self, twist: Matrix | None = None) -> None:
        """Continue a drive of which no frame is kept.

        Args:
            twist: ``(6,)`` the speed of the camera at its end, per second; None if unknown.
        """
        self.status, self._resumed_twist = TrackerStatus.RESUMED, twist

    def state(self) -> TrackerState | None:
        """What is remembered between two frames; None before the first frame is tracked."""
        last = self.last
        if last is None:
            return None
        return TrackerState(
            index=last.index,
            timestamp=last.timestamp,
            features=last.features,
            landmark=last.landmark.copy(),
            T_cw=last.T_cw.copy(),
            twist=None if last.twist is None else last.twist.copy(),
            lost_frames=self.lost_frames,
            n_tracked=self._n_tracked,
        )

    def restore(self, state: TrackerState, xyz: Matrix) -> Frame:
        """Remember what ``state`` gave, and return the last frame.

        Args:
            xyz: ``(N, 3)`` where the landmarks of the last frame are; NaN without one.
        """
        extracted = Extracted(state.features)
        last = Frame.of(extracted, self._context.camera, state.index, state.timestamp)
        last.T_cw, last.landmark, last.xyz = state.T_cw, state.landmark, xyz
        last.twist = state.twist
        self.start_from(last)
        self.lost_frames, self._n_tracked = state.lost_frames, state.n_tracked
        if self.lost_frames:
            self.status = TrackerStatus.LOST
        return last

    def _track_previous_frame(self, frame: Frame, T_cw: Matrix, view: MapView) -> int:
        """Track along the prediction; where there is none or it fails, against the reference
        keyframe. Returns inliers."""
        if self.last is None and self.status is not TrackerStatus.RESUMED:
            return 0
        if self.last is not None and self.last.twist is not None:
            n_matches, n_inliers = track_motion(frame, self.last, T_cw, self._context)
            if self._moves_as_predicted(n_matches, n_inliers):
                return n_inliers
        n_inliers = track_descriptors(frame, view.reference_landmarks, T_cw, self._context)
        if n_inliers >= self._config.tracking.min_inliers_frame or self.twist is None:
            return n_inliers
        return self._track_predicted(frame, T_cw, view)

    def _track_predicted(self, frame: Frame, T_cw: Matrix, view: MapView) -> int:
        """Match all landmarks around near the prediction: after a jump of the light, what older
        frames saw is found where the previous one saw other things. Returns inliers or 0."""
        frame.T_cw = T_cw
        frame.landmark[:], frame.xyz[:] = -1, np.nan
        window = self._config.tracking.predicted_window
        n_matches, n_inliers, _ = track_local_map(
            frame, view.local_landmarks, self._context, window, view.patches
        )
        if self._moves_as_predicted(n_matches, n_inliers):
            return n_inliers
        frame.landmark[:], frame.xyz[:] = -1, np.nan
        return 0

    def _moves_as_predicted(self, n_matches: int, n_inliers: int) -> bool:
        config = self._config.tracking
        return n_inliers >= max(config.min_inliers_motion, config.min_inlier_ratio * n_matches)

    def _is_doubtful(self, frame: Frame, n_inliers: int, view: MapView, frames: FramePoses) -> bool:
        """Whether a frame has so few inliers that its matches may be wrong, and a reason for it:
        a gap in time, no known motion to predict the pose with, or a sudden drop of the inliers, as
        where the camera was carried."""
        if self.last is None:
            return False
        config = self._config.relocalization
        usual = frames.timestamp(-1) - frames.timestamp(-2) if len(frames) > 1 else 0
        gap = frame.timestamp - self.last.timestamp > config.doubtful_gap * usual > 0.0
        old = view.n_keyframes > self._config.tracking.young_keyframes
        unpredicted = self.last.twist is None and old
        few = n_inliers < config.doubtful_share * view.n_reference
        sudden = n_inliers < config.doubtful_share * self._n_tracked and old
        return few and (gap or unpredicted or sudden)


def result_of(
    frame: Frame, found: Found, is_keyframe: bool, stage_ms: dict[str, float]
) -> TrackResult:
    """What a caller is told of a frame."""
    return TrackResult(
        index=frame.index,
        timestamp=frame.timestamp,
        T_wc=inverse(frame.T_cw),
        state=found.state,
        n_features=len(frame.features),
        n_stereo=frame.n_stereo,
        n_matches=found.n_matches,
        n_inliers=found.n_inliers,
        is_keyframe=is_keyframe,
        relocalised=found.relocalised,
        stage_ms=stage_ms,
    )
