"""The motion of the camera: the prediction of the next pose, the velocity, and the odometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vslam.frontend.motion_time import RECENT, motion_seconds
from vslam.frontend.standstill import has_come_to_rest, is_small
from vslam.frontend.track import By, Prediction, Track
from vslam.frontend.tracking import uncertainty_of
from vslam.types.context import Context
from vslam.types.features import TrackingState, TrackResult
from vslam.types.frame_poses import FramePoses
from vslam.types.geometry import (
    Matrix,
    adjoint,
    inverse,
    orthonormalised,
    se3_exp,
    se3_log,
)
from vslam.types.map_view import MapView
from vslam.types.odometry import Odometry, OdometryState
from vslam.types.states import Standstill


class Motion:
    """Predicts the pose of each frame, and follows the camera from frame to frame.

    Attributes:
        odometry: the pose that drifts but never jumps, and its uncertainty.
        lost_frames: number of frames that have been lost since the last one was tracked.
    """

    def __init__(self, context: Context, frames: FramePoses) -> None:
        """
        Args:
            frames: the recorded poses of all frames, including lost frames. They move with the map.
        """
        self.odometry = Odometry()
        self.lost_frames = 0
        self._context = context
        self._frames = frames
        self._is_resumed = False
        self._resumed_twist: Matrix | None = None

    def predict(self, timestamp: float, last: Track | None, view: MapView) -> Prediction:
        """Predict the pose of the next frame.

        The camera is assumed to keep its velocity. The velocity is measured per second, not per
        frame, so that dropped frames do not distort the prediction. Before the first frame of a
        drive, the camera is expected at the reference keyframe.

        Args:
            timestamp: of the next frame, in seconds.
            last: the last frame that was tracked; None if no frame has been tracked.
        """
        twist = self._resumed_twist if last is None else last.twist
        times = self._frames.recent_timestamps(RECENT)
        T_cw, seconds = view.T_reference, 0.0
        if len(times):
            T_cw, seconds = self._frames.pose(-1), motion_seconds(np.append(times, timestamp))
            if twist is not None:
                T_cw = orthonormalised(se3_exp(twist * seconds) @ T_cw)
        return Prediction(
            len(self._frames),
            timestamp,
            T_cw,
            twist,
            last,
            self.lost_frames,
            self._is_resumed,
            seconds,
            times,
        )

    def advance(self, track: Track, predicted: Prediction, view: MapView) -> Track:
        """Follow the camera to the next frame, before the pose of this frame is recorded.

        Returns:
            The frame with its velocity. A relocalised frame has none, because the jump to its pose
            is not a motion of the camera.
        """
        known = predicted.twist is not None
        if track.is_lost:
            self._follow(track, track.T_cw, known_velocity=known)
            self.lost_frames += track.state == TrackingState.LOST
            return track
        found_again = track.by is By.PLACE or not predicted.is_tracking
        track = self._with_velocity(track, predicted, view)
        covariance, of_offset = uncertainty_of(track, view.offset_sigma, self._context)
        T_moved = predicted.T_cw if found_again else track.T_cw
        self._follow(
            track, T_moved, covariance, of_offset, found_again=found_again, known_velocity=known
        )
        self.lost_frames = 0
        return track

    def keyframe(self) -> None:
        """Note that the last frame became a keyframe."""
        self.odometry.keyframe()
        self.lost_frames = 0

    def resume(self, twist: Matrix | None = None) -> None:
        """Continue a drive whose last frame is not available.

        Args:
            twist: ``(6,)`` velocity at the end of the drive, see ``Track.twist``; None if unknown.
        """
        self._is_resumed, self._resumed_twist = True, twist

    def resume_odometry(self, last: TrackResult) -> None:
        """Continue the odometry after the last frame of a drive, whose state was not saved."""
        if last.T_odom_camera is not None and last.uncertainty is not None:
            self.odometry = Odometry(OdometryState(last.T_odom_camera, last.uncertainty, 0.0))

    def restore(self, odometry: OdometryState, lost_frames: int) -> None:
        """Restore the state of a checkpoint."""
        self.odometry, self.lost_frames = Odometry(odometry), lost_frames

    def _with_velocity(self, track: Track, predicted: Prediction, view: MapView) -> Track:
        """Return a tracked frame with its velocity since the last tracked frame, and with the place
        where the camera came to rest."""
        frames, last, twist = self._frames, predicted.last, None
        if track.by is not By.PLACE:
            before = len(frames) - 1 if last is None else last.index
            step = se3_log(orthonormalised(track.T_cw @ inverse(frames.pose(before))))
            elapsed = track.timestamp - frames.timestamp(before)
            twist = step / (predicted.seconds if before == len(frames) - 1 else elapsed)
        still = predicted.standstill(view)
        if track.by is not By.STANDSTILL and track.state == TrackingState.OK:
            still = self._standstill(track, predicted, view)
        elif still is not None:
            twist = np.zeros(6)
        return replace(track, twist=twist, still=still)

    def _standstill(self, track: Track, predicted: Prediction, view: MapView) -> Standstill | None:
        """Return the standstill that begins with a frame, or None if the camera moves."""
        last = predicted.last
        if last is None or not track.by_patches or not predicted.is_tracking:
            return None
        before, now = np.flatnonzero(last.landmark >= 0), np.flatnonzero(track.landmark >= 0)
        ids, first = np.unique(last.landmark[before], return_index=True)
        seen = last.refined_features().xy[before[first]]
        known, flow = Standstill(last.T_cw, ids, seen, view.n_keyframes).flow(
            track.landmark[now], track.features.xy[now]
        )
        now, flow = now[known], flow[known]
        stayed = is_small(flow, self._context.scales[track.features.octave[now]])
        if not has_come_to_rest(stayed):
            return None
        now = now[stayed]
        now = now[np.argsort(track.landmark[now])]
        xy = track.features.xy[now]
        return Standstill(track.T_cw, track.landmark[now], xy, view.n_keyframes)

    def _follow(
        self,
        track: Track,
        T_cw: Matrix,
        covariance: Matrix | None = None,
        of_offset: Matrix | None = None,
        *,
        found_again: bool = False,
        known_velocity: bool,
    ) -> None:
        """Move the odometry.

        Args:
            T_cw: ``(4, 4)`` pose of the frame, computed from the continuous motion since the last
                frame. It differs from the pose of the frame in the map if the camera was
                relocalised.
            covariance, of_offset, found_again, known_velocity: see ``Odometry.move``.
        """
        frames, camera = self._frames, self._context.camera
        T_now_last, elapsed = np.eye(4), 0.0
        if len(frames):
            T_now_last = T_cw @ inverse(frames.pose(-1))
            elapsed = track.timestamp - frames.timestamp(-1)
        if camera.quarter_turns:  # the odometry is that of the camera as mounted
            T = camera.T_mounted_camera
            A, R = adjoint(T), T[:3, :3]
            T_now_last = T @ T_now_last @ T.T
            covariance = None if covariance is None else A @ covariance @ A.T
            of_offset = None if of_offset is None else A @ of_offset @ R.T
        self.odometry.move(
            T_now_last, elapsed, covariance, of_offset,
            found_again=found_again, known_velocity=known_velocity,
        )  # fmt: skip
