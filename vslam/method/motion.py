"""The motion of the camera: the prediction of the next pose, the velocity, and the odometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from vslam.backend.inertial_filter import camera_pose
from vslam.backend.metric_mapping import MapScale
from vslam.frontend.initialization import KnownTurn
from vslam.frontend.motion_time import RECENT, motion_seconds
from vslam.frontend.prediction import Prediction
from vslam.frontend.standstill import has_come_to_rest, is_small
from vslam.frontend.tracking import uncertainty_of
from vslam.method.gyro import turn_by_gyro, turn_of_start, with_turn
from vslam.method.inertia import (
    BUNDLE_PRIOR,
    BUNDLES,
    CARRIED_S,
    KEPT_S,
    KEPT_WITHOUT_SCALE_S,
    LONGEST_GAP,
    SCALE_STRETCHES,
    SIGMA_PX,
    gravity_direction,
    guessed_scale,
    in_metres,
    is_refused,
    is_stuck,
    lost,
    moves,
    noise_for_bundles,
    predicted_covariance,
    predicted_motion,
    predicted_state,
    tracked,
    with_samples,
    without_scale,
)
from vslam.method.inertia import at_keyframe as drifted_at_keyframe
from vslam.method.inertia import found_again as anew
from vslam.types.context import Context
from vslam.types.features import TrackingState, TrackResult
from vslam.types.frame_poses import FramePoses, PoseRun
from vslam.types.geometry import (
    Matrix,
    adjoint,
    inverse,
    orthonormalised,
    se3_exp,
    se3_log,
    transform,
)
from vslam.types.imu import ImuCalibration, Inertia, InertialState, InertialWindow
from vslam.types.map_view import MapView
from vslam.types.odometry import OdometryState, at_keyframe, moved
from vslam.types.states import MotionState
from vslam.types.track import By, Standstill, Track

# A pose that turned by so much more or less than the gyroscope is wrong, in rad. [own]
WRONG_TURN = 0.01


class Motion:
    """Predicts the pose of each frame, and follows the camera from frame to frame.

    Attributes:
        state: the odometry, the number of lost frames, and what is known from the IMU.
    """

    def __init__(
        self,
        context: Context,
        frames: FramePoses,
        imu: ImuCalibration | None = None,
        state: MotionState | None = None,
    ) -> None:
        """
        Args:
            frames: the recorded poses of all frames, including lost frames. They move with the map.
            imu: where the IMU is on the left camera as it is mounted, and its noise; None if there
                is no IMU.
            state: the state of a checkpoint; None at the start of a drive.
        """
        self.state = MotionState() if state is None else state
        self._imu = imu
        self._context = context
        self._frames = frames
        self._is_resumed = False
        self._resumed_twist: Matrix | None = None

    def predict(self, timestamp: float, last: Track | None, view: MapView) -> Prediction:
        """Predict the pose of the next frame.

        If the state of the IMU is known, its samples give the motion since the last frame.
        Otherwise, the camera is assumed to keep its velocity, and turns as its gyroscope says. The
        velocity is measured per second, not per frame, so that dropped frames do not distort the
        prediction. Before the first frame of a drive, the camera is expected at the reference
        keyframe.

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
        inertial = None
        if self._imu is not None:
            inertial = predicted_state(self.state.inertia, timestamp, self._imu)
        if inertial is not None and self._imu is not None:
            T_odom_camera = self.state.odometry.T_odom_camera
            T_now_last = self._as_tracked(predicted_motion(inertial, T_odom_camera, self._imu))
            T_cw = orthonormalised(T_now_last @ self._frames.pose(-1))
        elif self._imu is not None and last is not None:
            T_cw = self._turned(T_cw, timestamp)
        return Prediction(
            len(self._frames),
            timestamp,
            T_cw,
            twist,
            last,
            self.state.lost_frames,
            self._is_resumed,
            seconds,
            times,
            inertial,
        )

    def advance(self, track: Track, predicted: Prediction, view: MapView) -> Track:
        """Follow the camera to the next frame, before the pose of this frame is recorded.

        Returns:
            The frame with its velocity and with gravity, if they are known. The velocity of a
            relocalised frame is unknown, because the jump to its pose is not a motion of the
            camera.
        """
        if track.is_lost:
            inertia = self._carried(track, predicted)
            if _is_carried(track, predicted, inertia):
                track = replace(track, state=TrackingState.INERTIAL, by=By.INERTIA)
            odometry = self._followed(track, track.T_cw, predicted)
            n_lost = self.state.lost_frames + (track.state != TrackingState.DROPPED)
            self.state = MotionState(odometry, n_lost, inertia)
            return self._with_gravity(track)
        found_again = track.by is By.PLACE or not predicted.is_tracking
        track = self._with_velocity(track, predicted, view)
        covariance, of_offset = uncertainty_of(track, view.offset_sigma, self._context)
        T_moved = predicted.T_cw if found_again else track.T_cw
        odometry = self._followed(
            track, T_moved, predicted, covariance, of_offset, found_again=found_again
        )
        inertia = self._learned(track, predicted, odometry, found_again=found_again)
        if not found_again and track.by is not By.STANDSTILL:
            track, odometry = self._fused(track, predicted, odometry, inertia)
        self.state = MotionState(odometry, 0, inertia)
        return self._with_gravity(track)

    def add_samples(self, samples: ArrayLike) -> None:
        """Add samples of the IMU, see ``Slam.add_imu``."""
        kept_s = KEPT_WITHOUT_SCALE_S if self.seeks_scale else KEPT_S
        inertia = with_samples(self.state.inertia, samples, kept_s)
        self.state = replace(self.state, inertia=inertia)

    @property
    def has_imu(self) -> bool:
        """Whether an IMU with known calibration has sent samples."""
        return self._imu is not None and len(self.state.inertia.samples) > 0

    @property
    def is_metric(self) -> bool:
        """Whether lengths are in metres."""
        return not self._context.camera.monocular or self.state.inertia.scale_sigma >= 0.0

    @property
    def seeks_scale(self) -> bool:
        """Whether the IMU is to tell the scale of a monocular map."""
        return self._imu is not None and not self.is_metric

    def guess_scale(
        self, view: MapView, keyframe: int, *, at_once: bool = False
    ) -> tuple[float, InertialWindow] | None:
        """Guess the scale of a monocular map from the last frames and the samples.

        Args:
            keyframe: the first keyframe whose unit of length is that of the newest keyframe.
            at_once: whether it is never too early to try again.

        Returns:
            Metres per unit of the map, and the samples with the state of the IMU in the frame of
            the map. None if no guess is useful, or if it is too early to try again.
        """
        run, sigma = self._last_run(view, keyframe)
        if self._imu is None or not sigma > 0.0:
            return None
        inertia, found = guessed_scale(self.state.inertia, run, sigma, self._imu, at_once=at_once)
        self.state = replace(self.state, inertia=inertia)
        if found is None:
            return None
        window = self._window(found.state, self._imu)
        return found.scale, replace(window, R_odom_camera=self._frames.pose(-1)[:3, :3].T)

    def use_metres(self, view: MapView, keyframe: int, found: MapScale, *, whole: bool) -> None:
        """Follow the camera in metres, after the map was scaled.

        Args:
            view: of the scaled map.
            keyframe: the first one that was scaled.
            whole: whether the whole map was scaled, not only its newest sub-map.
        """
        assert self._imu is not None
        odometry = self.state.odometry
        if whole:
            odometry = odometry.scaled(found.scale)
        run, sigma = self._last_run(view, keyframe)
        T_odom_map = odometry.T_odom_camera @ inverse(run.T_wc[-1])
        inertia = in_metres(self.state.inertia, run, found.sigma, sigma, T_odom_map, self._imu)
        self.state = replace(self.state, odometry=odometry, inertia=inertia)

    def _last_run(self, view: MapView, keyframe: int) -> tuple[PoseRun, float]:
        """Return the poses of the frames that were tracked last, as the camera is mounted, and
        their standard deviation along each axis, in units of the map; 0 if it is unknown.

        Args:
            keyframe: the first keyframe whose unit of length is that of the newest keyframe.
        """
        local, camera = view.local_landmarks, self._context.camera
        run = self._frames.last_run(SCALE_STRETCHES[0], keyframe)
        mounted, sigma = PoseRun(run.times, camera.as_mounted(run.T_wc)), 0.0
        if len(local.ids):
            depth = float(np.median(transform(view.T_reference, local.xyz)[:, 2]))
            sigma = SIGMA_PX / camera.fx * depth
        return mounted, sigma

    def inertial_window(self) -> InertialWindow | None:
        """Return what bundle adjustment of a monocular map needs to know from the IMU at the last
        frame; None if it is unknown."""
        state = self.state.inertia.state
        if self._imu is None or state is None or not self._context.camera.monocular:
            return None
        return self._window(state, self._imu)

    def _carried(self, track: Track, predicted: Prediction) -> Inertia:
        """Return what is known from the IMU after a frame that was not tracked."""
        inertia = self.state.inertia
        if self._imu is None or not len(self._frames):
            return inertia
        elapsed = track.timestamp - self._frames.timestamp(-1)
        stood_still = predicted.last is not None and predicted.last.still is not None
        return lost(inertia, predicted.inertial, elapsed, stood_still=stood_still)

    def _learned(
        self, track: Track, predicted: Prediction, odometry: OdometryState, *, found_again: bool
    ) -> Inertia:
        """Return what is known from the IMU after a tracked frame, to which the odometry moved."""
        inertia, inertial = self.state.inertia, predicted.inertial
        if self._imu is None:
            return inertia
        if inertia.state is None and not found_again:
            before, T_odom_last = self._frames.timestamp(-1), self.state.odometry.T_odom_camera
            R_now_last = odometry.T_odom_camera[:3, :3].T @ T_odom_last[:3, :3]
            inertia = with_turn(inertia, before, track.timestamp, R_now_last, self._imu)
        if not self.is_metric:
            return inertia
        T_odom_camera, local = odometry.T_odom_camera, odometry.now.local
        if found_again:
            T_odom_seen = None
            if track.by is not By.PLACE:
                T_odom_seen = self._followed(track, track.T_cw, predicted).T_odom_camera
            return anew(inertia, inertial, T_odom_camera, local, self._imu, T_odom_seen=T_odom_seen)
        return tracked(
            inertia, inertial, track.timestamp, T_odom_camera, local, self._imu,
            stands_still=track.by is By.STANDSTILL,
        )  # fmt: skip

    def _fused(
        self, track: Track, predicted: Prediction, odometry: OdometryState, inertia: Inertia
    ) -> tuple[Track, OdometryState]:
        """Return a tracked frame and the odometry at the pose that images and samples give
        together, weighed by their covariances.

        If the filter has refused the pose of the images, it is used nevertheless, because the state
        may be wrong, unless the camera turned in another way: a gyroscope errs little in so short a
        time. The pose that the samples predict is then used, unless the gyroscope is stuck.
        """
        state = inertia.state
        if self._imu is None or predicted.inertial is None or state is None:
            return track, odometry
        T_odom_fused = camera_pose(state, self._imu.T_imu_camera)
        if inertia.refused:
            turned = T_odom_fused[:3, :3].T @ odometry.T_odom_camera[:3, :3]
            agree = not np.trace(turned) < 1.0 + 2.0 * np.cos(WRONG_TURN)
            if agree or is_stuck(self.state.inertia.samples):
                return track, odometry
        T_fused_seen = self._as_tracked(inverse(T_odom_fused) @ odometry.T_odom_camera)
        track = replace(track, T_cw=orthonormalised(T_fused_seen @ track.T_cw))
        return track, replace(odometry, T_odom_camera=T_odom_fused)

    def _with_gravity(self, track: Track) -> Track:
        """Return a frame, to which the state of the IMU has moved, with the direction of gravity in
        the camera that is tracked."""
        state = self.state.inertia.state
        if state is None or self._imu is None:
            return track
        found = gravity_direction(state, self._imu)
        if self._context.camera.quarter_turns:
            R = self._context.camera.T_mounted_camera[:3, :3]
            found = replace(found, direction=R.T @ found.direction)
        return replace(track, gravity=found, inertial=self._window(state, self._imu))

    def _window(self, state: InertialState, imu: ImuCalibration) -> InertialWindow:
        """Return what local bundle adjustment needs to know from the IMU at this frame."""
        camera, R_odom_camera = self._context.camera, self.state.odometry.T_odom_camera[:3, :3]
        T_imu_camera = imu.T_imu_camera
        if camera.quarter_turns:
            T = camera.T_mounted_camera
            R_odom_camera, T_imu_camera = R_odom_camera @ T[:3, :3], T_imu_camera @ T
        samples, noise = self.state.inertia.samples, noise_for_bundles(self.state.inertia, imu)
        state = replace(state, covariance=BUNDLE_PRIOR * state.covariance)
        return InertialWindow(
            samples, state, R_odom_camera, T_imu_camera, noise, LONGEST_GAP, BUNDLES
        )

    def turn_between(self, start: float, end: float) -> KnownTurn | None:
        """Return the rotation of the camera between two times, in seconds, as the gyroscope
        measured it; None if it is unknown."""
        inertia = self.state.inertia
        if self._imu is None or is_refused(inertia):
            return None
        turn = turn_of_start(inertia, start, end, self._imu)
        if turn is None or not self._context.camera.quarter_turns:
            return turn
        R = self._context.camera.T_mounted_camera[:3, :3]
        return replace(turn, R_2_1=R.T @ turn.R_2_1 @ R)

    def _turned(self, T_cw: Matrix, timestamp: float) -> Matrix:
        """Return the predicted pose of the next frame with the rotation of the gyroscope. The
        camera moves to the same position."""
        inertia, before = self.state.inertia, self._frames.timestamp(-1)
        if self._imu is None or is_refused(inertia):
            return T_cw
        turn = turn_by_gyro(inertia, before, timestamp, self._imu)
        if turn is None:
            return T_cw
        T_now_last = np.eye(4)
        T_now_last[:3, :3] = turn
        T = self._as_tracked(T_now_last) @ self._frames.pose(-1)
        T[:3, 3] = T[:3, :3] @ inverse(T_cw)[:3, 3] * -1.0
        return orthonormalised(T)

    def _as_tracked(self, T_now_last: Matrix) -> Matrix:
        """Return a motion of the camera as it is mounted as a motion of the camera that is tracked,
        whose images may be turned."""
        if not self._context.camera.quarter_turns:
            return T_now_last
        T = self._context.camera.T_mounted_camera
        turned: Matrix = T.T @ T_now_last @ T
        return turned

    def keyframe(self, track: Track) -> None:
        """Note that the last frame became a keyframe."""
        inertia, carried = self.state.inertia, track.state == TrackingState.INERTIAL
        if self._context.camera.monocular and self.state.lost_frames and not carried:
            inertia = without_scale(inertia)
        if self._imu is not None:
            local = self.state.odometry.now.local
            inertia = drifted_at_keyframe(inertia, local, self._imu)
        self.state = MotionState(at_keyframe(self.state.odometry), 0, inertia)

    def resume(self, twist: Matrix | None = None) -> None:
        """Continue a drive whose last frame is not available.

        Args:
            twist: ``(6,)`` velocity at the end of the drive, see ``Track.twist``; None if unknown.
        """
        self._is_resumed, self._resumed_twist = True, twist

    def resume_odometry(self, last: TrackResult) -> None:
        """Continue the odometry after the last frame of a drive, whose state was not saved."""
        if last.T_odom_camera is not None and last.uncertainty is not None:
            odometry = OdometryState(last.T_odom_camera, last.uncertainty, 0.0)
            self.state = replace(self.state, odometry=odometry)

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
        if moves(predicted.inertial):
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

    def _followed(
        self,
        track: Track,
        T_cw: Matrix,
        predicted: Prediction,
        covariance: Matrix | None = None,
        of_offset: Matrix | None = None,
        *,
        found_again: bool = False,
    ) -> OdometryState:
        """Return the odometry at a frame.

        Args:
            T_cw: ``(4, 4)`` pose of the frame, computed from the continuous motion since the last
                frame. It differs from the pose of the frame in the map if the camera was
                relocalised.
            covariance, of_offset, found_again: see ``vslam.types.odometry.moved``.
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
        carried, is_predicted = None, covariance is None or found_again
        if is_predicted and predicted.inertial is not None and self._imu is not None:
            carried = predicted_covariance(predicted.inertial, self._imu)
        return moved(
            self.state.odometry,
            T_now_last,
            elapsed,
            covariance,
            of_offset,
            found_again=found_again,
            known_velocity=predicted.twist is not None,
            carried=carried,
        )


def _is_carried(track: Track, predicted: Prediction, inertia: Inertia) -> bool:
    """Return whether the IMU measured the pose of a frame that was not tracked."""
    measured = predicted.inertial is not None and inertia.carried_s <= CARRIED_S
    return measured and track.state == TrackingState.LOST
