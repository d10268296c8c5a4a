"""SLAM on a stereo or monocular stream: ``Slam.step`` is the method section."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vslam.camera import StereoCamera
from vslam.closing import LoopClosing
from vslam.config import Config
from vslam.features import FeatureGrid, Features, TrackingState, TrackResult
from vslam.frontend.keyframes import (
    KeyframeEvidence,
    needs_keyframe,
    needs_monocular_keyframe,
)
from vslam.frontend.relocalization import relocalise
from vslam.frontend.tracking import (
    Frame,
    Tracker,
    extract_features,
    feature_depth,
    track_descriptors,
    track_local_map,
    track_motion,
)
from vslam.geometry import inverse, inverses, orthonormalised, se3_exp, se3_log
from vslam.loopclosure.detector import LoopDetector, NoDetector
from vslam.loops import Closure, LoopEdge
from vslam.map import Map, local_map
from vslam.mapping import DeferredMapping
from vslam.monocular import FirstView, Initialiser, Start
from vslam.trajectory import Trajectory, bridge_gaps

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class _Placed:
    """Where a frame is: relative to a keyframe, so that it follows when that one moves.

    ``rescaled`` is what ``Map.rescaled`` was for the keyframe: the unit of ``T_c_reference``.
    """

    timestamp: float
    reference: int
    T_c_reference: Matrix
    tracked: bool
    rescaled: float = 1.0


class Slam:
    """Stereo SLAM; monocular SLAM, in a unit of its own, with a camera without a baseline.

    >>> slam = Slam(camera)
    >>> for left, right, timestamp in frames:
    ...     result = slam.step(left, right, timestamp)
    >>> slam.finish()
    >>> slam.trajectory().T_wc

    Attributes:
        frame: the last frame tracked, for drawing; None before the first.
    """

    def __init__(
        self,
        camera: StereoCamera,
        config: Config | None = None,
        detector: LoopDetector | None = None,
        *,
        threads: int = 2,
    ) -> None:
        """
        Args:
            camera: the rectified pair that the images come from, or ``camera.left_eye()``.
            config: thresholds; the defaults are those of the papers.
            detector: finds loops and relocalises (``vslam.detectors``); without one there is
                odometry only.
            threads: with 1, mapping runs where it is merged instead of beside tracking. The
                result is the same.
        """
        self.camera = camera
        self.config = config or Config()
        self.tracker = Tracker.create(camera, self.config)
        self.frame: Frame | None = None
        self._detector = detector or NoDetector()
        self._closing = LoopClosing(self._detector, camera, self.config, threads=threads)
        self._mapping = DeferredMapping(
            self.tracker.scales, camera, self.config, self._closing, threads=threads
        )
        self._placed: list[_Placed] = []
        self._tracked = 0  # index of ``frame`` in _placed
        self._velocity: Matrix | None = None  # twist per second, None if unknown
        self._lost_frames = 0
        self._initialiser = Initialiser(self.tracker)  # of monocular maps
        self._image: NDArray[np.uint8] | None = None  # left image of the frame in work

    @property
    def map(self) -> Map:
        """Keyframes, landmarks and observations; read it only while ``is_mapping`` is False."""
        return self._mapping.map

    @property
    def is_mapping(self) -> bool:
        """Whether a keyframe is being mapped."""
        return self._mapping.busy

    @property
    def loops(self) -> list[LoopEdge]:
        """Every loop candidate and what became of it. Call ``finish()`` first."""
        return self._closing.edges

    @property
    def closures(self) -> list[Closure]:
        """What each closed loop did to the keyframes. Call ``finish()`` first."""
        return self._closing.closures

    def step(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8] | None, timestamp: float
    ) -> TrackResult:
        """Track one rectified stereo pair, or a monocular image, and map it if it is new.

        Args:
            left, right: ``(H, W)`` uint8; right is None for a monocular camera, and only then.
            timestamp: seconds, later than that of the last call.

        Raises:
            ValueError: images of another size than the camera's, not of bytes, or a timestamp that
                goes back.
        """
        if (right is None) != self.camera.monocular:
            raise ValueError("a right image belongs to a stereo camera, and to no monocular one")
        expected = (self.camera.height, self.camera.width)
        images = [left] if right is None else [left, right]
        if any(image.shape != expected for image in images):
            shapes = " and ".join(str(image.shape) for image in images)
            raise ValueError(f"images are {shapes}, the camera's {expected}")
        if any(image.dtype != np.uint8 for image in images):
            types = " and ".join(str(image.dtype) for image in images)
            raise ValueError(f"images are of {types}, not of uint8")
        start = time.perf_counter()
        features = extract_features(left, right, self.tracker)
        stage_ms = {"extract": 1e3 * (time.perf_counter() - start)}
        return self.step_features(features, timestamp, left, stage_ms)

    def step_features(
        self,
        features: Features,
        timestamp: float,
        image: NDArray[np.uint8] | None = None,
        stage_ms: dict[str, float] | None = None,
    ) -> TrackResult:
        """``step`` for a pair whose features were extracted elsewhere (``extract_features``).

        Args:
            image: the left image, for loop detectors that look at it.
        """
        self._check_time(timestamp)
        self._image = image
        clock = _Clock(dict(stage_ms or {}))
        frame = self._prepare(features)
        if self._mapping_is_due():
            self._merge()
        clock.lap("wait_for_mapping")
        if self.map.n_keyframes == 0:
            return self._start(frame, timestamp, clock)

        T_cw = self._predict(timestamp)
        inliers = self._track_previous_frame(frame, T_cw)
        clock.lap("track_frame")
        matches, inliers, visible = self._track_local_map(frame, inliers)
        clock.lap("track_local_map")
        state, relocalised = self._judge(inliers), False
        if state == TrackingState.LOST:
            matches = inliers = self._relocalise(frame)
            state = self._judge(inliers)
            relocalised = state != TrackingState.LOST
            clock.lap("relocalise")
        if state == TrackingState.LOST:
            return self._lose(frame, T_cw, timestamp, matches, inliers, clock)

        self._mapping.count(visible, frame.landmark[frame.landmark >= 0])
        self._update_motion(frame, timestamp, relocalised)
        is_keyframe = self._needs_keyframe(frame, timestamp, inliers)
        if is_keyframe:
            self._insert_keyframe(frame)
        clock.lap("keyframe")
        return self._result(frame, state, matches, inliers, is_keyframe, clock)

    def skip(self, timestamp: float, *, dropped: bool = False) -> TrackResult:
        """Account for a frame without images, at the predicted pose: it is LOST, or DROPPED if
        there was only no time for it."""
        self._check_time(timestamp)
        frame = self._prepare(Features.none())
        if self._placed:
            frame.T_cw = self._predict(timestamp)
        if self.map.n_keyframes and not dropped:
            self._lost_frames += 1
        self._place(timestamp, frame.T_cw, tracked=False)
        state = TrackingState.DROPPED if dropped else TrackingState.LOST
        return self._result(frame, state, 0, 0, False, _Clock())

    def finish(self) -> None:
        """Complete pending mapping. Call before reading the map or the final trajectory."""
        self._merge()
        self._mapping.finish()
        self._follow_map(self.frame)

    def trajectory(self) -> Trajectory:
        """Final pose of every frame, lost ones included. Call ``finish()`` first.

        Where the camera was lost, its motion is interpolated between the frames tracked before
        and after.
        """
        self._check_finished()
        times = np.array([placed.timestamp for placed in self._placed], np.float64)
        poses = [inverse(self._pose_of(placed)) for placed in self._placed]
        tracked = np.array([placed.tracked for placed in self._placed], np.bool_)
        T_wc = np.array(poses, np.float64).reshape(-1, 4, 4)
        return bridge_gaps(Trajectory(times, T_wc), tracked)

    def keyframe_trajectory(self) -> Trajectory:
        """Final pose of every keyframe that was not culled. Call ``finish()`` first."""
        self._check_finished()
        living = self.map.living_keyframes()
        times = np.array([self.map.timestamps[k] for k in living], np.float64)
        return Trajectory(times, inverses(self.map.arrays.T_cw[living]))

    # Tracking

    def _check_finished(self) -> None:
        if self._mapping.busy:
            raise RuntimeError("a keyframe is being mapped: call finish() first")

    def _check_time(self, timestamp: float) -> None:
        if self._placed and not timestamp > self._placed[-1].timestamp:
            last = self._placed[-1].timestamp
            raise ValueError(f"timestamp {timestamp} s is not later than the last one, {last} s")

    def _prepare(self, features: Features) -> Frame:
        camera = self.camera
        grid = FeatureGrid.of_positions(features.xy, camera.width, camera.height)
        return Frame.untracked(features, grid)

    def _predict(self, timestamp: float) -> Matrix:
        """Constant velocity, in seconds: dropped frames do not disturb it."""
        T_last = self._pose_of(self._placed[-1])
        if self._velocity is None:
            return T_last
        elapsed = timestamp - self._placed[-1].timestamp
        return orthonormalised(se3_exp(self._velocity * elapsed) @ T_last)

    def _track_previous_frame(self, frame: Frame, T_cw: Matrix) -> int:
        """Along the prediction; where there is none or it fails, against the reference keyframe."""
        if self._velocity is not None and self.frame is not None:
            matches, inliers = track_motion(frame, self.frame, T_cw, self.tracker)
            config = self.config.tracking
            if inliers >= max(config.min_inliers_motion, config.min_inlier_ratio * matches):
                return inliers
        return track_descriptors(frame, self._mapping.reference_view, T_cw, self.tracker)

    def _track_local_map(self, frame: Frame, inliers: int) -> tuple[int, int, NDArray[np.int32]]:
        if inliers < self.config.tracking.min_inliers_frame:
            return inliers, 0, np.empty(0, np.int32)
        return track_local_map(frame, self._mapping.local, self.tracker)

    def _relocalise(self, frame: Frame) -> int:
        """Look for a lost frame in the whole map; returns inliers, 0 if it was found nowhere."""
        if self._mapping.busy:
            return 0
        config = self.config.relocalization
        candidates = self._detector.locate(self._image, frame.features, self.map)
        for candidate in candidates[: config.max_candidates]:
            place = local_map(self.map, candidate.match, 1)
            around = local_map(self.map, candidate.match, config.neighbours)
            inliers = relocalise(frame, place, around, self.tracker, seed=candidate.match)
            if inliers:
                self._mapping.look_at(candidate.match)
                return inliers
        return 0

    def _judge(self, inliers: int) -> TrackingState:
        if inliers < self.config.tracking.min_inliers_lost:
            return TrackingState.LOST
        if inliers < self.config.tracking.min_inliers:
            return TrackingState.WEAK
        return TrackingState.OK

    def _update_motion(self, frame: Frame, timestamp: float, relocalised: bool) -> None:
        """Place the frame; the velocity is that since the last frame tracked."""
        before = self._placed[self._tracked]
        step = se3_log(orthonormalised(frame.T_cw @ inverse(self._pose_of(before))))
        self._initialiser.reset()
        # A leap to where the camera was found again is no motion.
        self._velocity = None if relocalised else step / (timestamp - before.timestamp)
        self._lost_frames = 0
        self._place(timestamp, frame.T_cw)
        self._keep(frame)

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
        self._place(timestamp, T_cw, tracked=False)
        self._lost_frames += 1
        restarted = self._restart(frame)
        return self._result(frame, TrackingState.LOST, matches, inliers, restarted, clock)

    def _restart(self, frame: Frame) -> bool:
        """Begin a sub-map at the frame placed last if the camera has been lost for long."""
        config = self.config.tracking
        if self.camera.monocular:
            long = self._lost_frames >= config.monocular_lost_frames
            return long and self._start_monocular(frame)
        young = self.map.n_keyframes <= config.young_keyframes
        patience = 1 if young else config.lost_frames_before_restart
        if self._lost_frames < patience or not self._can_start(frame):
            return False
        frame.landmark[:] = -1
        self._merge(frame)
        if self._velocity is None:
            self.map.guesses.append(self.map.n_keyframes)
        self._insert_keyframe(frame)
        self._velocity = None
        self._lost_frames = 0
        self._keep(frame)
        return True

    # Mapping

    def _start(self, frame: Frame, timestamp: float, clock: _Clock) -> TrackResult:
        """The first keyframe is the world, its stereo points the first landmarks; a monocular
        map begins with two keyframes."""
        self._place(timestamp, frame.T_cw, tracked=False)
        if self.camera.monocular:
            started = self._start_monocular(frame)
        elif started := self._can_start(frame):
            self._insert_keyframe(frame)
            self._keep(frame)
        inliers = int(np.count_nonzero(frame.landmark >= 0))
        state = TrackingState.OK if started else TrackingState.LOST
        clock.lap("keyframe")
        return self._result(frame, state, inliers, inliers, started, clock)

    def _start_monocular(self, frame: Frame) -> bool:
        """Begin a map, or a sub-map where tracking was lost, if an earlier frame forms a pair with
        this one, the frame placed last."""
        placed, index = self._placed[-1], len(self._placed) - 1
        second = FirstView(frame, placed.timestamp, index, self._image)
        start = self._initialiser.offer(second)
        if start is None:
            return False
        self._merge()
        scaled = self._with_speed(start, second.timestamp)
        if scaled is start:
            self.map.guesses.append(self.map.n_keyframes)
        start = scaled
        frame.T_cw = start.T_2_1 @ start.first.frame.T_cw
        frame.landmark, frame.xyz = self._mapping.begin(start, second)
        reference = self._mapping.reference
        for keyframe, view in ((reference - 1, start.first), (reference, second)):
            self._placed[view.index] = _Placed(
                view.timestamp, keyframe, np.eye(4), True, self._mapping.rescaled(keyframe)
            )
        frame.T_cw = self._pose_of(self._placed[-1])
        self._velocity = se3_log(start.T_2_1) / (second.timestamp - start.first.timestamp)
        self._lost_frames = 0
        self._initialiser.reset()
        self._keep(frame)
        return True

    def _with_speed(self, start: Start, timestamp: float) -> Start:
        """A sub-map's start in the unit of the map before it, as far as anything tells: the camera
        drives on as fast as it did."""
        if self._velocity is None:
            return start
        elapsed = timestamp - start.first.timestamp
        moved = np.linalg.norm(self._velocity[:3]) * elapsed
        factor = float(moved / np.linalg.norm(start.T_2_1[:3, 3]))
        limit = self.config.initialization.max_rescaling
        return start.scaled(factor) if 1.0 / limit < factor < limit else start

    def _can_start(self, frame: Frame) -> bool:
        n_stereo = int(np.count_nonzero(np.isfinite(frame.features.u_right)))
        return n_stereo >= self.config.tracking.min_stereo_start

    def _needs_keyframe(self, frame: Frame, timestamp: float, inliers: int) -> bool:
        close = feature_depth(frame.features, self.camera) < self.tracker.close_depth
        tracked = frame.landmark >= 0
        evidence = KeyframeEvidence(
            seconds_since_keyframe=timestamp - self.map.timestamps[-1],
            n_inliers=inliers,
            n_reference=self._mapping.n_reference,
            tracked_close=int(np.count_nonzero(close & tracked)),
            untracked_close=int(np.count_nonzero(close & ~tracked)),
            mapping_idle=not self._mapping.busy,
        )
        if self.camera.monocular:
            return needs_monocular_keyframe(evidence, self.config.keyframes)
        return needs_keyframe(evidence, self.config.keyframes)

    def _insert_keyframe(self, frame: Frame) -> None:
        """Make a keyframe of the frame placed last."""
        self._merge(frame)
        timestamp, index = self._placed[-1].timestamp, len(self._placed) - 1
        frame.landmark, frame.xyz = self._mapping.insert(
            frame.features, frame.landmark, frame.T_cw, timestamp, index, self._image
        )
        reference = self._mapping.reference
        self._placed[-1] = _Placed(
            timestamp, reference, np.eye(4), True, self._mapping.rescaled(reference)
        )

    def _mapping_is_due(self) -> bool:
        if not self._mapping.busy:
            return False
        waited = len(self._placed) - self.map.frames[-1]
        return waited >= self.config.keyframes.merge_after_frames

    def _merge(self, current: Frame | None = None) -> None:
        """Show tracking what local mapping has done: poses, landmarks, merged identities.

        ``current`` is the frame placed last, if it is not ``self.frame`` yet.
        """
        reference, unit = self._mapping.reference, self._mapping_unit()
        if not self._mapping.merge():
            return
        if self._velocity is not None and self._mapping.rescaled(reference) != unit:
            self._velocity[:3] *= self._mapping.rescaled(reference) / unit
        self._follow_map(self.frame)
        if current is not None and current is not self.frame:
            current.landmark, current.xyz = self._mapping.current(current.landmark)
            current.T_cw = self._pose_of(self._placed[-1])

    def _mapping_unit(self) -> float:
        return self._mapping.rescaled(self._mapping.reference) if self.map.n_keyframes else 1.0

    def _follow_map(self, frame: Frame | None) -> None:
        """Bring the frame tracked last to where the map has moved."""
        if frame is not None:
            frame.landmark, frame.xyz = self._mapping.current(frame.landmark)
            frame.T_cw = self._pose_of(self._placed[self._tracked])

    def _keep(self, frame: Frame) -> None:
        """The frame placed last is the one to track the next against."""
        self.frame, self._tracked = frame, len(self._placed) - 1

    def _place(self, timestamp: float, T_cw: Matrix, *, tracked: bool = True) -> None:
        reference = self._mapping.reference
        T_rw = self._mapping.keyframe_pose(reference) if self.map.n_keyframes else np.eye(4)
        relative = orthonormalised(T_cw @ inverse(T_rw))
        self._placed.append(_Placed(timestamp, reference, relative, tracked, self._mapping_unit()))

    def _pose_of(self, placed: _Placed) -> Matrix:
        """``T_cw`` of a placed frame."""
        if self.map.n_keyframes == 0:
            return placed.T_c_reference
        T_c_reference = placed.T_c_reference
        unit = self._mapping.rescaled(placed.reference)
        if unit != placed.rescaled:
            T_c_reference = T_c_reference.copy()
            T_c_reference[:3, 3] *= unit / placed.rescaled
        return T_c_reference @ self._mapping.keyframe_pose(placed.reference)

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
            T_wc=inverse(frame.T_cw),
            state=state,
            n_features=len(frame.features),
            n_stereo=int(np.count_nonzero(np.isfinite(frame.features.u_right))),
            n_matches=matches,
            n_inliers=inliers,
            is_keyframe=is_keyframe,
            stage_ms=clock.laps,
        )


@dataclass
class _Clock:
    """Wall time by stage, in milliseconds."""

    laps: dict[str, float] = field(default_factory=dict)
    last: float = field(default_factory=time.perf_counter)

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.laps[stage] = self.laps.get(stage, 0.0) + 1e3 * (now - self.last)
        self.last = now
