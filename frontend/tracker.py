"""Tracks the camera from frame to frame against a ``MapView``, a copy of the map for tracking."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
from vslam.context import Context
from vslam.features import Extracted, TrackingState, TrackResult, nearest_features
from vslam.frame_poses import FramePoses
from vslam.frontend.frame import Frame
from vslam.frontend.motion_time import RECENT, motion_seconds
from vslam.frontend.orb import level_shapes
from vslam.frontend.patch_tracking import (
    NO_PATCHES_FOUND,
    PatchTrack,
    track_patches,
    track_standing,
)
from vslam.frontend.pose import MIN_TRUSTED
from vslam.frontend.pose_alignment import align_pose, coarse_pyramid, coarse_shapes
from vslam.frontend.standstill import has_come_to_rest, is_small
from vslam.frontend.tracking import (
    track_descriptors,
    track_local_map,
    track_motion,
    track_sudden_motion,
)
from vslam.geometry import Matrix, inverse, orthonormalised, se3_exp, se3_log, transform
from vslam.loops import LastSeen
from vslam.map_view import MapView
from vslam.odometry import Odometry
from vslam.states import Standstill, TrackerState

# The prediction of the motion is wrong by at most this acceleration, m/s^2, in ordinary drives. A
# pose that implies a larger one needs IMPLAUSIBLE^-1 times as many landmarks that agree with it.
ACCELERATION = 10.0
IMPLAUSIBLE = 0.5


class TrackerStatus(Enum):
    """The state of the tracker between two frames."""

    UNKNOWN = "unknown"
    """No frame has been tracked in this map. The camera may be anywhere in it."""
    RESUMED = "resumed"
    """No frame has been tracked yet. The camera continues from the end of an earlier drive."""
    TRACKING = "tracking"
    """The last frame was tracked, was relocalised, or started a map."""
    LOST = "lost"
    """The last frame was not tracked."""


@dataclass(frozen=True)
class Found:
    """The result of tracking or relocalising a frame. The pose and the matches are stored in the
    frame.

    Attributes:
        state: OK, WEAK or LOST.
        n_matches, n_inliers: number of matched landmarks before and after the last pose
            optimisation.
        visible: ``(N,)`` int32 ids of the landmarks that the frame should see.
        keyframe: id of the keyframe at which the frame was relocalised; -1 if it was not
            relocalised.
        is_doubtful: whether the frame has so few inliers that its matches with landmarks may be
            wrong.
        support, stands_still: see ``TrackResult``.
    """

    state: TrackingState
    n_matches: int = 0
    n_inliers: int = 0
    visible: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    keyframe: int = -1
    is_doubtful: bool = False
    support: float | None = None
    stands_still: bool = False

    @classmethod
    def at_start(cls, frame: Frame, *, begun: bool) -> Found:
        """Create the result for a frame before a map exists. The state is OK if the frame has
        started a map (``begun``), and LOST otherwise."""
        n_landmarks = int(np.count_nonzero(frame.landmark >= 0))
        state = TrackingState.OK if begun else TrackingState.LOST
        return cls(state, n_landmarks, n_landmarks)

    @property
    def is_lost(self) -> bool:
        """Whether the pose must not be used."""
        return self.state == TrackingState.LOST

    @property
    def relocalised(self) -> bool:
        """Whether the pose of the frame was found by relocalisation, which searches the whole
        map."""
        return self.keyframe >= 0


def judge(n_matches: int, n_inliers: int, context: Context) -> TrackingState:
    config = context.config.tracking
    # The search windows of an RGB-D camera are wide, so that even a wrong pose has some inliers.
    share = config.depth_min_inlier_ratio if context.camera.depth else 0.0
    if n_inliers < config.min_inliers_lost or n_inliers < share * n_matches:
        return TrackingState.LOST
    return TrackingState.WEAK if n_inliers < config.min_inliers else TrackingState.OK


class Tracker:
    """Tracks one frame after another. It reads only a ``MapView``, not the map itself.

    Attributes:
        status: whether the last frame was tracked or lost, or no frame has been tracked yet.
        last: the last frame that was tracked; None until a frame has been tracked.
        lost_frames: number of frames that have been lost since the frame ``last``.
    """

    def __init__(self, context: Context) -> None:
        self.status = TrackerStatus.UNKNOWN
        self.last: Frame | None = None
        self.lost_frames = 0
        self._context = context
        self._config = context.config
        self._n_tracked = 0
        self._resumed_twist: Matrix | None = None
        self._standstill: Standstill | None = None

    @property
    def stands_still(self) -> bool:
        """Whether the camera stood still when it was last tracked."""
        return self._standstill is not None

    @property
    def twist(self) -> Matrix | None:
        """``(6,)`` velocity of the camera when it was last tracked, see ``Frame.twist``; None if
        unknown."""
        return self._resumed_twist if self.last is None else self.last.twist

    def last_seen(self, timestamp: float, view: MapView) -> LastSeen | None:
        """Return where the camera was last tracked, and how long before a time (seconds) that was.
        None if it has not been tracked yet."""
        if self.last is None:
            return None
        return LastSeen(view.reference, timestamp - self.last.timestamp)

    def predict(self, timestamp: float, frames: FramePoses, view: MapView) -> Matrix:
        """Predict the ``(4, 4)`` pose of the camera (world to camera) at a given time.

        The camera is assumed to keep its velocity. The velocity is measured per second, not per
        frame, so that dropped frames do not distort the prediction. If no frame has been tracked
        since the map was loaded, the pose of the reference keyframe is returned.

        Args:
            timestamp: seconds.
            frames: poses of all earlier frames, including lost frames.
        """
        if not len(frames):
            return view.T_reference
        T_last = frames.pose(-1)
        if self.twist is None:
            return T_last
        elapsed = _motion_seconds(frames, timestamp)
        return orthonormalised(se3_exp(self.twist * elapsed) @ T_last)

    def track_patches(
        self, frame: Frame, T_cw: Matrix, view: MapView, frames: FramePoses
    ) -> PatchTrack:
        """Track a frame using the image patches of landmarks, without extracting features.

        The frame is not changed. The result has no landmarks if the frame cannot be tracked in this
        way, for example because the previous frame was not tracked.

        Args:
            T_cw: ``(4, 4)`` predicted pose (world to camera).
            frames: poses of all earlier frames, including lost frames.
        """
        view = self._trusting(view)
        last, config = self.last, self._config.tracking
        if frame.pyramid is None or frame.source is None or not len(view.patches.ids):
            return NO_PATCHES_FOUND
        standstill = self._standstill
        if last is not None and standstill is not None:
            track = track_standing(
                frame.pyramid, last.T_cw, standstill, view, self._context, frame.mask
            )
            if track.stands_still:
                return track
        if last is None or last.twist is None or self.status is not TrackerStatus.TRACKING:
            return NO_PATCHES_FOUND

        def track_from(T_start: Matrix) -> PatchTrack:
            assert frame.pyramid is not None
            return track_patches(frame.pyramid, T_start, view, self._context, frame.mask)

        def support(track: PatchTrack) -> float:
            return (1.0 if is_plausible(track) else IMPLAUSIBLE) * track.support

        def is_plausible(track: PatchTrack) -> bool:
            jump = np.linalg.norm((track.T_cw @ inverse(T_cw))[:3, 3])
            return bool(jump <= ACCELERATION * seconds**2)

        seconds = _motion_seconds(frames, frame.timestamp)
        T_aligned = self._align(frame, last, last.landmark >= 0, T_cw)
        track = track_from(T_aligned)
        doubtful = track.share < config.patch_retry_ratio or track.lacks_support
        if (doubtful or not is_plausible(track)) and T_aligned is not T_cw:
            # Image alignment may have followed moving objects.
            track = max(track, track_from(T_cw), key=support)
        if track.lacks_support:
            confirmed = view.local_landmarks.confirms(last.landmark)
            if np.count_nonzero(confirmed) >= MIN_TRUSTED:
                T_aligned = self._align(frame, last, confirmed, T_cw)
                track = max(track, track_from(T_aligned), key=support)
        if track.lacks_support and not is_plausible(track):
            return NO_PATCHES_FOUND
        return track

    def _align(self, frame: Frame, last: Frame, chosen: NDArray[np.bool_], T_cw: Matrix) -> Matrix:
        """Correct a predicted pose by sparse image alignment to the last frame.

        Args:
            chosen: ``(N,)`` bool, the features of the last frame whose landmarks are used.
        """
        if frame.coarse is None or last.coarse is None:
            return T_cw
        camera, xyz = self._context.camera, last.xyz[chosen]
        if frame.mask is not None:
            uv = camera.project(transform(T_cw, xyz))[:, :2]
            coarsest = np.full(len(xyz), self._config.orb.n_levels - 1)
            xyz = xyz[frame.mask.shows(uv, coarsest)]
        size = camera.height, camera.width
        return align_pose(frame.coarse, last.coarse, xyz, last.T_cw, T_cw, camera.intrinsics, size)

    def judge_patches(self, track: PatchTrack) -> TrackingState:
        """Decide whether a frame can be tracked by patches alone (OK), only if its features do not
        match either (WEAK), or not at all (LOST)."""
        config, n_inliers = self._config.tracking, len(track.ids)
        if track.stands_still:
            return TrackingState.OK
        if track.n_expected >= MIN_TRUSTED > track.n_trusted:
            return TrackingState.LOST
        trusted = config.patch_min_inlier_ratio * track.n_matches
        if n_inliers >= max(config.patch_min_inliers, trusted):
            return TrackingState.OK
        plausible = config.patch_fallback_ratio * track.n_matches
        if not self.stands_still and n_inliers >= max(config.min_inliers_lost, plausible):
            return TrackingState.WEAK
        return TrackingState.LOST

    def use_patches(self, frame: Frame, track: PatchTrack) -> Found:
        """Give the result of tracking by patches to the frame."""
        frame.T_cw, frame.features = track.T_cw, track.features
        frame.landmark, frame.xyz = track.ids, track.xyz
        return Found(
            self.judge_patches(track),
            track.n_matches,
            len(track.ids),
            track.visible,
            support=track.trusted_share,
            stands_still=track.stands_still,
        )

    def match_features(self, frame: Frame, by_patches: Frame, view: MapView) -> bool:
        """Match the landmarks of the local map to the features of a frame that was tracked by
        patches.

        If too few descriptors match, each landmark whose patch was found is first matched to the
        nearest feature. This happens, for example, when the fog suddenly becomes so dense that the
        contrast of the image is raised before features are extracted.

        Args:
            frame: the frame with its features.
            by_patches: the same frame, as it was tracked by patches.

        Returns:
            Whether enough features were matched.
        """
        if self._match_local_map(frame, view):
            return True
        frame.T_cw = by_patches.T_cw
        frame.drop_matches()
        found, features = np.flatnonzero(by_patches.landmark >= 0), frame.features
        feature, index = nearest_features(
            by_patches.features.xy[found],
            features.xy,
            features.octave,
            self._context.scales,
            self._config.tracking.patch_feature_reach,
        )
        found = found[index]
        frame.match(feature, by_patches.landmark[found], by_patches.xyz[found])
        return self._match_local_map(frame, view)

    def _match_local_map(self, frame: Frame, view: MapView) -> bool:
        n_matches, n_inliers, _ = track_local_map(
            frame, view.local_landmarks, self._context, patches=view.patches
        )
        return judge(n_matches, n_inliers, self._context) != TrackingState.LOST

    def track(self, frame: Frame, T_cw: Matrix, view: MapView, frames: FramePoses) -> Found:
        """Track a frame using its features, first against the last frame or the reference keyframe,
        and then against all landmarks of the local map.

        Args:
            T_cw: ``(4, 4)`` predicted pose (world to camera).
        """
        view = self._trusting(view)
        n_inliers = self._track_previous_frame(frame, T_cw, view)
        if n_inliers < self._config.tracking.min_inliers_frame:
            return Found(TrackingState.LOST, n_matches=n_inliers)
        n_matches, n_inliers, visible = track_local_map(
            frame, view.local_landmarks, self._context, patches=view.patches
        )
        doubtful = self._is_doubtful(frame, n_inliers, view, frames)
        state = judge(n_matches, n_inliers, self._context)
        n_trusted = np.count_nonzero(view.local_landmarks.confirms(frame.landmark))
        if self.stands_still and (state != TrackingState.OK or n_trusted < MIN_TRUSTED):
            # Something covers the image of a standing camera. The matches may be wrong, or belong
            # to a moving object.
            state = TrackingState.LOST
        return Found(state, n_matches, n_inliers, visible, is_doubtful=doubtful)

    def accept(self, frame: Frame, found: Found, frames: FramePoses, n_keyframes: int) -> None:
        """Accept the pose of a frame that was tracked or relocalised. The next frame is tracked
        from this frame.

        The twist of the frame is computed from the motion since the last tracked frame. A
        relocalised frame gets no twist, because the jump to its pose is not a motion of the camera.
        """
        if not found.relocalised:
            last = len(frames) - 1 if self.last is None else self.last.index
            step = se3_log(orthonormalised(frame.T_cw @ inverse(frames.pose(last))))
            elapsed = frame.timestamp - frames.timestamp(last)
            if last == len(frames) - 1:
                elapsed = _motion_seconds(frames, frame.timestamp)
            frame.twist = step / elapsed
        if not found.stands_still and found.state == TrackingState.OK:
            self._standstill = self._new_standstill(frame, n_keyframes)
        elif self._standstill is not None:
            frame.twist = np.zeros(6)
        self._n_tracked = int(np.count_nonzero(frame.landmark >= 0))
        self.start_from(frame)

    def _trusting(self, view: MapView) -> MapView:
        """Return the view, in which landmarks that a standing camera saw at rest are confirmed."""
        standstill = self._standstill
        if standstill is None:
            return view
        if standstill.n_keyframes != view.n_keyframes:
            self._standstill = None
            return view
        local, with_patches = (
            one._replace(confirmed=one.confirmed | np.isin(one.ids, standstill.ids))
            for one in (view.local_landmarks, view.with_patches)
        )
        return replace(view, local_landmarks=local, with_patches=with_patches)

    def _new_standstill(self, frame: Frame, n_keyframes: int) -> Standstill | None:
        """Return the standstill that begins with a frame, or None if the camera moves."""
        last = self.last
        if last is None or frame.source is None or self.lost_frames:
            return None
        before, now = np.flatnonzero(last.landmark >= 0), np.flatnonzero(frame.landmark >= 0)
        ids, first = np.unique(last.landmark[before], return_index=True)
        seen = last.refined_features().xy[before[first]]
        known, flow = Standstill(last.T_cw, ids, seen, n_keyframes).flow(
            frame.landmark[now], frame.features.xy[now]
        )
        now, flow = now[known], flow[known]
        stayed = is_small(flow, self._context.scales[frame.features.octave[now]])
        if not has_come_to_rest(stayed):
            return None
        now = now[stayed]
        now = now[np.argsort(frame.landmark[now])]
        return Standstill(frame.T_cw, frame.landmark[now], frame.features.xy[now], n_keyframes)

    def start_from(self, frame: Frame) -> None:
        """Track the next frames from a frame that started a map or a sub-map."""
        self.last, self.lost_frames, self.status = frame, 0, TrackerStatus.TRACKING

    def lose(self) -> None:
        self.lost_frames += 1
        self.status = TrackerStatus.LOST

    def resume(self, twist: Matrix | None = None) -> None:
        """Continue a drive whose last frame is not available.

        Args:
            twist: ``(6,)`` velocity at the end of the drive, see ``Frame.twist``; None if unknown.
        """
        self.status, self._resumed_twist = TrackerStatus.RESUMED, twist

    def state(self) -> TrackerState | None:
        """Return the state for a checkpoint, or None before the first frame is tracked."""
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
            coarse=np.empty(0, np.uint8) if last.coarse is None else last.coarse.pixels,
            standstill=self._standstill,
        )

    def restore(self, state: TrackerState, xyz: Matrix) -> Frame:
        """Restore the state of a checkpoint. Returns the last tracked frame.

        Args:
            xyz: ``(N, 3)`` positions of the landmarks that the last frame tracks, in the world
                frame; NaN for features without a landmark.
        """
        extracted = Extracted(state.features)
        last = Frame.of(extracted, self._context.camera, state.index, state.timestamp)
        last.T_cw, last.landmark, last.xyz = state.T_cw, state.landmark, xyz
        last.twist = state.twist
        if len(state.coarse):
            camera = self._context.camera
            size = camera.height, camera.width
            shapes = coarse_shapes(level_shapes(size, self._config.orb))
            last.coarse = coarse_pyramid(state.coarse, shapes, size)
        self.start_from(last)
        self.lost_frames, self._n_tracked = state.lost_frames, state.n_tracked
        if self.lost_frames:
            self.status = TrackerStatus.LOST
        self._standstill = state.standstill
        return last

    def _track_previous_frame(self, frame: Frame, T_cw: Matrix, view: MapView) -> int:
        """Find a first pose and first matches of a frame. Returns the number of inliers.

        Four methods are tried in turn: tracking against the last frame, tracking against the
        reference keyframe, ``_track_predicted``, and ``_track_sudden_motion``. Only the second
        method works if the motion is unknown.
        """
        if self.last is None and self.status is not TrackerStatus.RESUMED:
            return 0
        if self.last is not None and self.last.twist is not None:
            n_matches, n_inliers = track_motion(
                frame, self.last, T_cw, view.local_landmarks, self._context
            )
            if self._is_trusted(n_matches, n_inliers, self._config.tracking.min_inlier_ratio):
                return n_inliers
        n_inliers = track_descriptors(frame, view.reference_landmarks, T_cw, self._context)
        if n_inliers >= self._config.tracking.min_inliers_frame or self.twist is None:
            return n_inliers
        return self._track_predicted(frame, T_cw, view) or self._track_sudden_motion(
            frame, T_cw, view
        )

    def _track_predicted(self, frame: Frame, T_cw: Matrix, view: MapView) -> int:
        """Match all landmarks of the local map near their predicted image positions. Returns the
        number of inliers, or 0 if the prediction was wrong.

        This helps after a sudden change in brightness. Landmarks that older frames observed may
        still match when the landmarks of the previous frame do not.
        """
        frame.T_cw = T_cw
        frame.drop_matches()
        window = self._config.tracking.predicted_window
        n_matches, n_inliers, _ = track_local_map(
            frame, view.local_landmarks, self._context, window, view.patches
        )
        if self._is_trusted(n_matches, n_inliers, self._config.tracking.min_inlier_ratio):
            return n_inliers
        frame.drop_matches()
        return 0

    def _track_sudden_motion(self, frame: Frame, T_cw: Matrix, view: MapView) -> int:
        """Track a frame against the last frame if the motion has changed suddenly since then.
        Returns the number of inliers, or 0 if no trustworthy pose was found."""
        if self.last is None or self.status is not TrackerStatus.TRACKING:
            return 0
        n_matches, n_inliers = track_sudden_motion(
            frame, self.last, T_cw, view.local_landmarks, self._context
        )
        if self._is_trusted(n_matches, n_inliers, self._config.tracking.sudden_min_inlier_ratio):
            return n_inliers
        frame.drop_matches()
        return 0

    def _is_trusted(self, n_matches: int, n_inliers: int, min_ratio: float) -> bool:
        return n_inliers >= max(self._config.tracking.min_inliers_motion, min_ratio * n_matches)

    def _is_doubtful(self, frame: Frame, n_inliers: int, view: MapView, frames: FramePoses) -> bool:
        """Return whether a frame has few inliers and there is another reason why its matches may be
        wrong.

        There are three such reasons. The first is a gap in time. The second is an unknown motion,
        because the pose was then not predicted. The third is a sudden drop in the number of
        inliers, for example after the camera was carried away.
        """
        if self.last is None:
            return False
        config = self._config.relocalization
        times = frames.recent_timestamps(RECENT)
        interval = motion_seconds(times) if len(times) > 1 else 0.0
        gap = frame.timestamp - self.last.timestamp > config.doubtful_gap * interval > 0.0
        old = view.n_keyframes > self._config.tracking.young_keyframes
        unpredicted = self.last.twist is None and old
        few = n_inliers < config.doubtful_share * view.n_reference
        sudden = n_inliers < config.doubtful_share * self._n_tracked and old
        return few and (gap or unpredicted or sudden)


def _motion_seconds(frames: FramePoses, timestamp: float) -> float:
    """Return the seconds of motion between the last frame and a frame at ``timestamp``."""
    return motion_seconds(np.append(frames.recent_timestamps(RECENT - 1), timestamp))


def result_of(
    frame: Frame,
    found: Found,
    is_keyframe: bool,
    stage_ms: dict[str, float],
    odometry: Odometry,
    camera: Camera,
) -> TrackResult:
    return TrackResult(
        index=frame.index,
        timestamp=frame.timestamp,
        T_wc=camera.as_mounted(inverse(frame.T_cw)),
        state=found.state,
        n_features=len(frame.features) if frame.source is None else 0,
        n_stereo=frame.n_stereo,
        n_matches=found.n_matches,
        n_inliers=found.n_inliers,
        is_keyframe=is_keyframe,
        relocalised=found.relocalised,
        stage_ms=stage_ms,
        T_odom_camera=odometry.state.T_odom_camera,
        uncertainty=odometry.state.now,
        support=found.support,
        stands_still=found.stands_still,
    )
