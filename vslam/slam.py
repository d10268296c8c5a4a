"""SLAM on a stereo stream: ``Slam.step`` is the method section.

Tracking and local mapping run side by side and still give the same bytes on every machine: the
mapping of a keyframe starts when the keyframe is inserted and is merged at a fixed point, a set
number of frames later or before the next keyframe, whichever comes first. Between the two,
tracking sees only its ``LocalMap``, the copy that the last merge left.
"""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.backend.local_mapping import map_keyframe, refresh_keyframe
from vslam.backend.triangulation import map_stereo_points
from vslam.camera import StereoCamera
from vslam.config import Config
from vslam.features import FeatureGrid, Features, TrackingState, TrackResult
from vslam.frontend.keyframes import KeyframeEvidence, needs_keyframe
from vslam.frontend.tracking import (
    Frame,
    Tracker,
    extract_features,
    feature_depth,
    track_descriptors,
    track_local_map,
    track_motion,
)
from vslam.geometry import orthonormalised, se3_exp, se3_log
from vslam.map import LocalMap, Map, count_seen_by, link_many, local_map, resolve
from vslam.trajectory import Trajectory

Matrix = NDArray[np.float64]


@dataclass
class _Placed:
    """Where a frame is: relative to a keyframe, so that it follows when that one moves."""

    timestamp: float
    reference: int
    T_c_reference: Matrix


class Slam:
    """Stereo SLAM.

    >>> slam = Slam(camera)
    >>> for left, right, timestamp in frames:
    ...     result = slam.step(left, right, timestamp)
    >>> slam.finish()
    >>> slam.trajectory().T_wc

    Attributes:
        map: keyframes, landmarks and observations; read it after ``finish()``.
        frame: the last frame tracked, for drawing.
    """

    def __init__(
        self, camera: StereoCamera, config: Config | None = None, *, threads: int = 2
    ) -> None:
        """
        Args:
            camera: the rectified pair that the images come from.
            config: thresholds; the defaults are those of the papers.
            threads: with 1, mapping runs where it is merged instead of beside tracking. The
                result is the same.
        """
        self.config = config or Config()
        self.tracker = Tracker.create(camera, self.config)
        self.camera = camera
        self.map = Map(self.tracker.scales)
        self.frame: Frame | None = None
        self._executor = ThreadPoolExecutor(1, "mapping") if threads > 1 else None
        self._mapping: Future[None] | None = None
        self._mapping_since = 0
        self._local: LocalMap | None = None
        self._reference = 0
        self._n_reference = 0
        self._reference_view: LocalMap | None = None
        self._velocity: Matrix | None = None  # twist per second
        self._placed: list[_Placed] = []
        self._lost_frames = 0
        self._visible: list[NDArray[np.int32]] = []
        self._found: list[NDArray[np.int32]] = []

    def step(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8], timestamp: float
    ) -> TrackResult:
        """Track one rectified stereo pair, ``(H, W)`` uint8 each, and map it if it is new.

        Args:
            timestamp: seconds, later than that of the last call.
        """
        start = time.perf_counter()
        features = extract_features(left, right, self.tracker)
        return self.step_features(
            features, timestamp, {"extract": 1e3 * (time.perf_counter() - start)}
        )

    def step_features(
        self, features: Features, timestamp: float, stage_ms: dict[str, float] | None = None
    ) -> TrackResult:
        """``step`` for a pair whose features were extracted elsewhere (``extract_features``)."""
        clock = _Clock(stage_ms)
        index = len(self._placed)
        frame = self._prepare(features)
        if index - self._mapping_since >= self.config.keyframes.merge_after_frames:
            self._merge()
            clock.lap("wait_for_mapping")

        if self.map.n_keyframes == 0:
            return self._start(frame, timestamp, clock)

        T_cw = self._predict(timestamp)
        inliers = self._track_frame(frame, T_cw)
        clock.lap("track_frame")
        matches, inliers, visible = self._track_map(frame, inliers)
        clock.lap("track_local_map")
        state = self._judge(inliers)
        if state == TrackingState.LOST:
            return self._lose(frame, T_cw, timestamp, matches, inliers, clock)

        self._count(frame, visible)
        self._move(frame, timestamp)
        is_keyframe = self._is_new(frame, timestamp, inliers)
        if is_keyframe:
            self._insert_keyframe(frame, timestamp)
        clock.lap("keyframe")
        return self._result(frame, state, matches, inliers, is_keyframe, clock)

    def skip(self, timestamp: float) -> TrackResult:
        """Account for a frame without images: it is LOST at the predicted pose."""
        clock = _Clock(None)
        empty = Features(
            np.empty((0, 2), np.float32),
            np.empty(0, np.uint8),
            np.empty(0, np.float32),
            np.empty((0, 32), np.uint8),
            np.empty(0, np.float32),
        )
        frame = self._prepare(empty)
        frame.T_cw = self._predict(timestamp) if self._placed else np.eye(4)
        self._place(timestamp, frame.T_cw)
        return self._result(frame, TrackingState.LOST, 0, 0, False, clock)

    def finish(self) -> None:
        """Complete pending mapping. Call before reading the map or the final trajectory."""
        self._merge()
        if self._executor:
            self._executor.shutdown()
            self._executor = None

    @property
    def is_mapping(self) -> bool:
        """Whether a keyframe is being mapped; only between times may others read ``map``."""
        return self._mapping is not None

    def trajectory(self) -> Trajectory:
        """Final pose of every frame, lost ones included."""
        times = np.array([p.timestamp for p in self._placed])
        poses = [
            np.linalg.inv(p.T_c_reference @ self._keyframe_pose(p.reference)) for p in self._placed
        ]
        return Trajectory(times, np.array(poses).reshape(-1, 4, 4))

    def keyframe_trajectory(self) -> Trajectory:
        """Final pose of every keyframe that was not culled."""
        living = self.map.living_keyframes()
        times = np.array([self.map.timestamps[k] for k in living])
        return Trajectory(times, np.linalg.inv(self.map.arrays.T_cw[living]))

    # -- tracking ---------------------------------------------------------------------------

    def _prepare(self, features: Features) -> Frame:
        camera = self.camera
        grid = FeatureGrid.of_positions(features.xy, camera.width, camera.height)
        return Frame.untracked(features, grid)

    def _predict(self, timestamp: float) -> Matrix:
        """Constant velocity, in seconds: dropped frames do not disturb it."""
        last = self._placed[-1]
        elapsed = timestamp - last.timestamp
        T_last = last.T_c_reference @ self._keyframe_pose(last.reference)
        if self._velocity is None:
            return T_last
        return orthonormalised(se3_exp(self._velocity * elapsed) @ T_last)

    def _track_frame(self, frame: Frame, T_cw: Matrix) -> int:
        """Frame to frame along the prediction, else against the reference keyframe."""
        assert self.frame is not None
        if self._velocity is not None:
            matches, inliers = track_motion(frame, self.frame, T_cw, self.tracker)
            config = self.config.tracking
            if inliers >= max(config.min_inliers_motion, config.min_inlier_ratio * matches):
                return inliers
        assert self._reference_view is not None
        return track_descriptors(frame, self._reference_view, T_cw, self.tracker)

    def _track_map(self, frame: Frame, inliers: int) -> tuple[int, int, NDArray[np.int32]]:
        assert self._local is not None
        if inliers < min(10, self.config.tracking.min_inliers_lost):
            return inliers, 0, np.empty(0, np.int32)
        return track_local_map(frame, self._local, self.tracker)

    def _judge(self, inliers: int) -> TrackingState:
        if inliers < self.config.tracking.min_inliers_lost:
            return TrackingState.LOST
        if inliers < self.config.tracking.min_inliers:
            return TrackingState.WEAK
        return TrackingState.OK

    def _move(self, frame: Frame, timestamp: float) -> None:
        """Place the frame and update the velocity."""
        last = self._placed[-1]
        T_last = last.T_c_reference @ self._keyframe_pose(last.reference)
        if self._lost_frames == 0:
            step = se3_log(orthonormalised(frame.T_cw @ np.linalg.inv(T_last)))
            self._velocity = step / (timestamp - last.timestamp)
        self._lost_frames = 0
        self._place(timestamp, frame.T_cw)
        self.frame = frame

    def _place(self, timestamp: float, T_cw: Matrix) -> None:
        T_reference = self._keyframe_pose(self._reference) if self.map.n_keyframes else np.eye(4)
        relative = orthonormalised(T_cw @ np.linalg.inv(T_reference))
        self._placed.append(_Placed(timestamp, self._reference, relative))

    def _count(self, frame: Frame, visible: NDArray[np.int32]) -> None:
        """Remember what should be and what was seen; written to the map at the next merge."""
        self._visible.append(visible)
        self._found.append(frame.landmark[frame.landmark >= 0])

    def _lose(
        self,
        frame: Frame,
        T_cw: Matrix,
        timestamp: float,
        matches: int,
        inliers: int,
        clock: _Clock,
    ) -> TrackResult:
        """Keep the prediction as the pose; after a while, map anew from there."""
        frame.T_cw = T_cw
        self._lost_frames += 1
        self._place(timestamp, T_cw)
        restart = self._lost_frames >= self.config.tracking.lost_frames_before_restart
        if restart and self._can_start(frame):
            frame.landmark[:] = -1
            self._insert_keyframe(frame, timestamp)
            self.frame = frame
            self._lost_frames = 0
            self._velocity = None
        return self._result(frame, TrackingState.LOST, matches, inliers, restart, clock)

    # -- mapping ----------------------------------------------------------------------------

    def _start(self, frame: Frame, timestamp: float, clock: _Clock) -> TrackResult:
        """The first keyframe is the world, its stereo points the first landmarks."""
        started = self._can_start(frame)
        frame.T_cw = np.eye(4)
        self._place(timestamp, frame.T_cw)
        if started:
            self._insert_keyframe(frame, timestamp)
            self.frame = frame
        state = TrackingState.OK if started else TrackingState.LOST
        inliers = int(np.count_nonzero(frame.landmark >= 0))
        clock.lap("keyframe")
        return self._result(frame, state, inliers, inliers, started, clock)

    def _can_start(self, frame: Frame) -> bool:
        n_stereo = int(np.count_nonzero(np.isfinite(frame.features.u_right)))
        return n_stereo >= self.config.tracking.min_stereo_start

    def _is_new(self, frame: Frame, timestamp: float, inliers: int) -> bool:
        close = feature_depth(frame.features, self.camera) < self.tracker.close_depth
        tracked = frame.landmark >= 0
        evidence = KeyframeEvidence(
            seconds_since_keyframe=timestamp - self.map.timestamps[-1],
            n_inliers=inliers,
            n_reference=self._n_reference,
            tracked_close=int(np.count_nonzero(close & tracked)),
            untracked_close=int(np.count_nonzero(close & ~tracked)),
            mapping_idle=self._mapping is None,
        )
        return needs_keyframe(evidence, self.config.keyframes)

    def _insert_keyframe(self, frame: Frame, timestamp: float) -> None:
        """Add the frame to the map, with landmarks from stereo, and start its local mapping."""
        index = len(self._placed) - 1
        placed = self._placed[-1]
        if self._merge(keep=frame):
            T_reference = self._keyframe_pose(placed.reference)
            frame.T_cw = orthonormalised(placed.T_c_reference @ T_reference)
        keyframe = self.map.add_keyframe(frame.features, frame.T_cw, timestamp, index)
        tracked = np.flatnonzero(frame.landmark >= 0)
        rows = self.map.rows(keyframe).start + tracked
        link_many(self.map.arrays, rows, frame.landmark[tracked])
        neighbours, _ = self.map.covisible(keyframe)
        if keyframe > 0:
            self.map.parents[keyframe] = int(neighbours[0]) if len(neighbours) else keyframe - 1
        map_stereo_points(self.map, keyframe, self.camera, self.config)
        refresh_keyframe(self.map, keyframe)
        self._reference = keyframe
        self._placed[-1] = _Placed(timestamp, keyframe, np.eye(4))
        observed = self.map.arrays.landmark[self.map.rows(keyframe)]
        frame.landmark[:] = observed
        frame.xyz[observed >= 0] = self.map.arrays.xyz[observed[observed >= 0]]
        self._copy_local_map()
        self._mapping_since = index
        if keyframe == 0:
            return
        job = (map_keyframe, self.map, keyframe, self.camera, self.config)
        if self._executor:
            self._mapping = self._executor.submit(*job)
        else:
            self._mapping = _Lazy(*job)

    def _merge(self, keep: Frame | None = None) -> bool:
        """Wait for the pending mapping and move tracking onto its result.

        Returns whether there was one. ``keep`` is a frame besides the last one whose landmarks
        are brought up to date.
        """
        if self._mapping is None:
            return False
        self._mapping.result()
        self._mapping = None
        a = self.map.arrays
        for landmarks, counter in ((self._visible, a.visible), (self._found, a.found)):
            for ids in landmarks:
                np.add.at(counter, ids, 1)
            landmarks.clear()
        last = self._placed[-1]
        for frame in {id(f): f for f in (self.frame, keep) if f is not None}.values():
            frame.landmark[:] = resolve(a, frame.landmark)
            known = frame.landmark >= 0
            frame.xyz[known] = a.xyz[frame.landmark[known]]
            frame.xyz[~known] = np.nan
        if self.frame is not None:
            self.frame.T_cw = last.T_c_reference @ self._keyframe_pose(last.reference)
        self._copy_local_map()
        return True

    def _copy_local_map(self) -> None:
        limit = self.config.tracking.local_keyframes
        self._local = local_map(self.map, self._reference, limit)
        self._reference_view = local_map(self.map, self._reference, 1)
        # In a young map, landmarks cannot have been seen by three keyframes.
        needed = min(3, len(self.map.living_keyframes()))
        self._n_reference = count_seen_by(self.map.arrays, self._reference, needed)
        self._poses = {
            k: self.map.keyframe_pose(k) for k in {self._reference, self._placed[-1].reference}
        }

    def _keyframe_pose(self, keyframe: int) -> Matrix:
        """Pose as of the last merge while mapping runs, else of the map."""
        if self._mapping is not None:
            return self._poses[keyframe]
        return self.map.keyframe_pose(keyframe)

    def _result(
        self,
        frame: Frame,
        state: TrackingState,
        matches: int,
        inliers: int,
        is_keyframe: bool,
        clock: _Clock,
    ) -> TrackResult:
        return TrackResult(
            index=len(self._placed) - 1,
            timestamp=self._placed[-1].timestamp,
            T_wc=np.linalg.inv(frame.T_cw),
            state=state,
            n_features=len(frame.features),
            n_stereo=int(np.count_nonzero(np.isfinite(frame.features.u_right))),
            n_matches=matches,
            n_inliers=inliers,
            is_keyframe=is_keyframe,
            stage_ms=clock.laps,
        )


class _Clock:
    """Wall time by stage, in milliseconds."""

    def __init__(self, laps: dict[str, float] | None) -> None:
        self.laps = dict(laps or {})
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.laps[stage] = self.laps.get(stage, 0.0) + 1e3 * (now - self._last)
        self._last = now


class _Lazy(Future):  # type: ignore[type-arg]
    """A call that runs when its result is asked for."""

    def __init__(self, function, *arguments) -> None:  # type: ignore[no-untyped-def]
        super().__init__()
        self._call = (function, arguments)

    def result(self, timeout: float | None = None) -> None:
        function, arguments = self._call
        function(*arguments)
