"""SLAM on a stereo, RGB-D or monocular stream: ``Slam.step`` is the method section.

One file because the step and the decisions that it calls are read together.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, DepthImage, Image, same_camera
from vslam.closing import LoopClosing
from vslam.config import Config
from vslam.errors import InputError
from vslam.features import Features, TrackingState, TrackResult
from vslam.frame_poses import FramePoses, FrameTable
from vslam.frontend.frame import Frame
from vslam.frontend.keyframes import (
    CloseGain,
    KeyframeEvidence,
    PlaceEvidence,
    is_known_place,
    needs_keyframe,
    needs_monocular_keyframe,
)
from vslam.frontend.relocalization import relocalise
from vslam.frontend.side_delay import SideDelay
from vslam.frontend.tracking import (
    TrackingContext,
    extract_features,
    feature_depth,
    track_descriptors,
    track_local_map,
    track_motion,
)
from vslam.geometry import Matrix, inverse, inverses, orthonormalised, se3_exp, se3_log
from vslam.hypotheses import joined_submaps
from vslam.loopclosure.detector import LoopDetector
from vslam.loopclosure.learned_verification import rated, recognise
from vslam.loopclosure.registry import DEFAULT_DETECTOR, detector_with_images
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.loopclosure.verifier import verifier_for
from vslam.loops import LoopCandidate, LoopCorrection, LoopEdge
from vslam.map import Map, local_map
from vslam.mapping import MappingThread
from vslam.maps.checkpoint import Checkpoint
from vslam.maps.storage import load_checkpoint, load_map, save_map
from vslam.maps.stored_map import StoredMap, World
from vslam.monocular import Initialiser
from vslam.trajectory import Trajectory


class Slam:
    """Stereo or RGB-D SLAM; monocular SLAM, in a unit of its own, with a camera without a baseline.

    >>> slam = Slam(camera)
    >>> for left, right, timestamp in frames:
    ...     result = slam.step(left, right, timestamp)
    >>> slam.finish()
    >>> slam.trajectory().T_wc
    >>> slam.save(path)

    ``Slam.load(path)`` goes on in that map: the camera is looked for in all of it, and what is new
    is added; where it is not found, a new sub-map begins, until a loop joins it. With
    ``localize=True`` the map stays as it is, to the byte.

    Attributes:
        frame: the last frame tracked, for drawing; None before the first.
        context: camera, thresholds and pyramid scales, as ``extract_features`` takes them.
        side_delay: by how much the right side of the pair is measured to be late.
        world: where the map that was loaded lies in that of a ground truth, None if unknown.
        on_merge: called where local mapping was merged, also in the middle of a step: the frame
            of that step may be placed, and the map can be read.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        detector: LoopDetector | str = DEFAULT_DETECTOR,
        *,
        threads: int = 2,
        images: KeyframeImages | None = None,
        start: StoredMap | None = None,
        localize: bool = False,
        resume: bool = False,
    ) -> None:
        """
        Args:
            camera: the rectified pair that the images come from, or ``camera.left_camera()``.
            config: thresholds; the defaults are those of the papers.
            detector: finds loops and relocalises: a name (``vslam.loopclosure.registry``; ``both``
                is the capsule network beside the bag of words, ``none`` is odometry only) or an
                object.
            images: for a detector that is an object: where the images of keyframes are kept for
                learned descriptors, which verify loops where ORB's fail; None for ORB alone.
            threads: with 1, mapping runs where it is merged instead of beside tracking. The
                result is the same.
            start: a map to begin in, of the same camera, detector and pyramid; it becomes this
                one's own. ``Slam.load`` reads one from a file.
            localize: only track in that map.
            resume: the frames to come are of the drive that the map's last ones are of; otherwise
                a new drive begins, with a clock of its own.

        Raises:
            ValueError: in a few words why the map cannot be gone on in.
        """
        if localize and (start is None or not start.map.n_keyframes):
            raise ValueError("there is no map to localise in")
        self.camera = camera
        self.config = config or Config()
        self.context = TrackingContext.create(camera, self.config)
        self.frame: Frame | None = None
        self.side_delay = SideDelay(camera, self.config.stereo)
        if isinstance(detector, str):
            detector, images = detector_with_images(detector, self.config)
        self._detector = detector
        self._localize = localize
        self._drives: tuple[str, ...] = ()
        self.world: World | None = None
        self.on_merge: Callable[[], None] = lambda: None
        verifier = verifier_for(self.config, camera, images)
        self._closing = LoopClosing(self._detector, verifier, camera, self.config, threads=threads)
        before = None if start is None else self._begin_in(start, resume=resume)
        self._mapping = MappingThread(
            self.context.scales,
            camera,
            self.config,
            self._closing,
            threads=threads,
            map_=None if start is None else start.map,
        )
        self._poses = FramePoses(self._mapping, before)
        self._resumed = before is not None and len(before.timestamp) > 0
        if self._resumed:
            self._mapping.resume()
        self._velocity: Matrix | None = None  # twist per second, None if unknown
        self._lost_frames = 0
        self._n_tracked = 0  # landmarks, in the last frame tracked
        self._close_gain = CloseGain(self.config.keyframes)
        self._initialiser = Initialiser(self.context)  # of monocular maps
        self._is_between = True  # frames: nothing of the next one is tracked yet
        if resume and start is not None and start.checkpoint is not None:
            self._return_to(start.checkpoint)
        elif before is not None and len(before.tracked) > 1 and before.tracked[-2:].all():
            self._move_on(before)

    @classmethod
    def load(
        cls,
        path: Path,
        config: Config | None = None,
        detector: LoopDetector | str | None = None,
        *,
        threads: int = 2,
        images: KeyframeImages | None = None,
        localize: bool = False,
        resume: bool = False,
    ) -> Slam:
        """Go on in a map that ``save`` or a run wrote.

        Args:
            detector: like the one that the map was made with, a name or an object; None for just
                that one, as it is shipped.
            config, threads, images, localize, resume: as for a new map.

        Raises:
            InputError: no map, a damaged one, or one of another detector or pyramid.
        """
        config = config or Config()
        stored = load_checkpoint(path) if resume else load_map(path)
        try:
            return cls(
                stored.camera,
                config,
                stored.detector.name if detector is None else detector,
                threads=threads,
                images=images,
                start=stored,
                localize=localize,
                resume=resume,
            )
        except (ValueError, KeyError) as error:
            raise InputError(f"{path}: {error}; go on with the options of its run.") from error

    def save(self, path: Path, drive: str = "", *, resumable: bool = False) -> None:
        """Write the map to a file, in place of what is there: all that ``load`` needs to go on.

        Args:
            drive: what the images since the start were, "kitti 06" for example.
            resumable: with what tracking remembers and what died in the map, too. Loaded with
                ``resume=True``, it then gives the poses of a run that was not stopped, to the byte.

        Raises:
            RuntimeError: a keyframe is being mapped: look at ``is_mapping``, or call ``finish()``.
            OSError: the file cannot be written; one that was there is as it was.
        """
        save_map(path, self.stored_map(drive), resumable=resumable)

    def stored_map(self, drive: str = "") -> StoredMap:
        """The map, with a checkpoint if there can be one now; ``save`` writes what lives of it. Its
        arrays are those of the map: ``compact()``, which copies them, before the next step.

        Raises:
            RuntimeError: a keyframe is being mapped.
        """
        map_, images = self.map, self._closing.verifier.images
        self._mapping.write_counts()
        return StoredMap(
            map=map_,
            camera=self.camera,
            loops=tuple(self._closing.closed),
            detector=self._detector.memory(),
            images=None if images is None else images.files(map_.n_keyframes),
            frames=self._poses.table(),
            drives=self._drives if self._localize else (*self._drives, drive),
            world=self.world,
            checkpoint=self._checkpoint(),
        )

    def _checkpoint(self) -> Checkpoint | None:
        """What goes on from here to the byte; None where that takes more than is kept: in the
        middle of a frame, before the first one is tracked, while a monocular map begins, and
        while a global bundle adjustment is under way."""
        frame = self.frame
        if not self._is_between or frame is None or self._localize:
            return None
        if self.is_adjusting or not self._initialiser.is_idle:
            return None
        return Checkpoint(
            index=frame.index,
            timestamp=frame.timestamp,
            features=frame.features,
            landmark=frame.landmark.copy(),
            T_cw=frame.T_cw.copy(),
            velocity=self._velocity,
            reference=self._mapping.reference,
            last_frame=self._mapping.last_frame,
            last_timestamp=self._mapping.last_timestamp,
            lost_frames=self._lost_frames,
            n_tracked=self._n_tracked,
            gained_close=self._close_gain.mean,
            gain_awaited=self._close_gain.awaited,
            closing=self._closing.state(),
            patches=self._mapping.recent.all(),
            side_delay=self.side_delay.memory(),
        )

    def _return_to(self, checkpoint: Checkpoint) -> None:
        self._mapping.return_to(checkpoint)
        self._closing.restore(checkpoint.closing)
        self.side_delay.restore(checkpoint.side_delay)
        self._velocity = checkpoint.velocity
        self._lost_frames, self._n_tracked = checkpoint.lost_frames, checkpoint.n_tracked
        gain = self._close_gain
        gain.mean, gain.awaited = checkpoint.gained_close, checkpoint.gain_awaited
        index, timestamp = checkpoint.index, checkpoint.timestamp
        frame = Frame.untracked(checkpoint.features, self.camera, index, timestamp)
        tracked = checkpoint.landmark >= 0
        frame.T_cw, frame.landmark = checkpoint.T_cw, checkpoint.landmark
        frame.disparity_offset = self._mapping.disparity_offset
        frame.xyz[tracked] = self.map.arrays.xyz[checkpoint.landmark[tracked]]
        self.frame = frame

    @property
    def map(self) -> Map:
        """Keyframes, landmarks and observations.

        Raises:
            RuntimeError: a keyframe is being mapped: look at ``is_mapping``, or call ``finish()``.
        """
        self._check_finished()
        return self._mapping.map

    @property
    def detector(self) -> LoopDetector:
        """What finds loops and relocalises."""
        return self._detector

    @property
    def is_mapping(self) -> bool:
        """Whether a keyframe is being mapped."""
        return self._mapping.busy

    @property
    def is_adjusting(self) -> bool:
        """Whether a global bundle adjustment is yet to be merged."""
        return self._closing.is_adjusting

    @property
    def loops(self) -> list[LoopEdge]:
        """Every loop candidate and what became of it. Call ``finish()`` first."""
        return self._closing.edges

    @property
    def corrections(self) -> list[LoopCorrection]:
        """What each closed loop did to the keyframes. Call ``finish()`` first."""
        return self._closing.corrections

    def step(self, left: Image, second: Image | DepthImage | None, timestamp: float) -> TrackResult:
        """Track one rectified stereo pair, an image with its depth, or a monocular image, and map
        it if it is new.

        The images are the caller's: what is kept of them is copied, so that a camera may write the
        next ones into the same arrays.

        Args:
            left: ``(H, W)`` uint8.
            second: the right image, uint8; with ``camera.depth`` the depth of the left image's
                pixels, ``(H, W)`` float32 metres, 0 where unknown; None for a monocular camera,
                and only then.
            timestamp: seconds, later than that of the last call.

        Raises:
            ValueError: images of another size or type, or a timestamp that goes back.
        """
        _check_images(left, second, self.camera)
        start = time.perf_counter()
        features = extract_features(left, second, self.context)
        stage_ms = {"extract": 1e3 * (time.perf_counter() - start)}
        image = np.array(second if features.from_right else left, np.uint8)
        return self.step_features(features, timestamp, image, stage_ms)

    def step_features(
        self,
        features: Features,
        timestamp: float,
        image: Image | None = None,
        stage_ms: dict[str, float] | None = None,
    ) -> TrackResult:
        """``step`` for a pair whose features were extracted elsewhere (``extract_features``).

        Args:
            image: ``(H, W)`` uint8 that the features were extracted from, for loop detectors that
                look at it. It is kept as it is: do not write to it afterwards.
        """
        clock = _Clock(dict(stage_ms or {}))
        frame = self._next_frame(features, timestamp, image)
        if self._mapping.is_due(frame.index):
            self._merge()
        frame.correct_disparities(self._mapping.disparity_offset)
        frame.take_out_right_delay(self._velocity, self.camera)
        clock.lap("wait_for_mapping")
        self._is_between = False
        result = (
            self._track(frame, clock) if self._mapping.n_keyframes else self._start(frame, clock)
        )
        self._is_between = True
        return result

    def _track(self, frame: Frame, clock: _Clock) -> TrackResult:
        """Where the camera is, and what is new there."""
        T_cw = self._predict(frame.timestamp)
        if frame.features.from_right:
            found = self._locate(frame, self.camera.T_right_left @ T_cw, clock)
            frame.T_cw = inverse(self.camera.T_right_left) @ frame.T_cw
        else:
            found = self._locate(frame, T_cw, clock)
        if found.state == TrackingState.LOST:
            frame.T_cw = T_cw
            restarted = self._lose(frame)
            return _result(frame, found, restarted, clock)

        self._update_motion(frame, found.relocalised)
        self.side_delay.add(frame.features, self._velocity, self.context.scales)
        is_keyframe = self._extend_map(frame, found.inliers, found.visible)
        clock.lap("keyframe")
        return _result(frame, found, is_keyframe, clock)

    def skip(self, timestamp: float, *, dropped: bool = False) -> TrackResult:
        """Account for a frame without images, at the predicted pose: it is LOST, or DROPPED if
        there was only no time for it."""
        frame = self._next_frame(Features.none(), timestamp, None)
        if len(self._poses) or self._mapping.n_keyframes:
            frame.T_cw = self._predict(timestamp)
        if self._mapping.n_keyframes and not dropped:
            self._lost_frames += 1
        self._poses.append(timestamp, frame.T_cw, tracked=False)
        state = TrackingState.DROPPED if dropped else TrackingState.LOST
        return _result(frame, _Found(state), False, _Clock())

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
        return self._poses.trajectory()

    def in_map(self) -> NDArray[np.bool_]:
        """``(N,)`` frames tracked in the part of the map that holds its first keyframe, sub-maps
        joined to it by loops included. Call ``finish()`` first."""
        frames = self._poses.table()
        if not self.map.n_keyframes:
            return frames.tracked
        part = joined_submaps(self.map, self._closing.closed)
        return frames.tracked & (part[frames.reference] == part[0])

    def keyframe_trajectory(self) -> Trajectory:
        """Final pose of every keyframe of this drive that was not culled. Call ``finish()``
        first."""
        map_ = self.map
        living = map_.living_keyframes()
        living = living[np.array(map_.sessions, np.int64)[living] == map_.session]
        times = np.array([map_.timestamps[k] for k in living], np.float64)
        return Trajectory(times, inverses(map_.arrays.T_cw[living]))

    def _begin_in(self, start: StoredMap, *, resume: bool) -> FrameTable | None:
        """Take over what belongs to a map; returns the frames that are placed already."""
        if not np.array_equal(start.map.scales, self.context.scales):
            raise ValueError(
                f"made with another pyramid, of {len(start.map.scales)} levels by "
                f"{start.map.scales[1] / start.map.scales[0]:g}"
            )
        if not same_camera(start.camera, self.camera):
            raise ValueError("made with another camera")
        self._detector.restore(start.detector)
        images = self._closing.verifier.images
        if images is not None and start.images is not None:
            images.restore(start.images, self.camera.width)
        self._closing.closed = list(start.loops)
        self._drives, self.world = start.drives, start.world
        if not start.map.n_keyframes:
            self._drives = ()
        if resume:
            self._drives = self._drives[:-1]
            return start.frames
        if not self._localize and start.map.n_keyframes:
            start.map.session += 1
        return None

    def _move_on(self, frames: FrameTable) -> None:
        """Expect the next frame after the last ones, as if they had just been tracked."""
        self._mapping.set_reference(int(frames.reference[-1]))
        step = se3_log(orthonormalised(self._poses.pose(-1) @ inverse(self._poses.pose(-2))))
        self._velocity = step / (frames.timestamp[-1] - frames.timestamp[-2])

    def _check_finished(self) -> None:
        if self._mapping.busy:
            raise RuntimeError("a keyframe is being mapped: call finish() first")

    # Tracking

    def _next_frame(self, features: Features, timestamp: float, image: Image | None) -> Frame:
        if len(self._poses) and not timestamp > (last := self._poses.timestamp(-1)):
            raise ValueError(f"timestamp {timestamp} s is not later than the last one, {last} s")
        return Frame.untracked(features, self.camera, len(self._poses), timestamp, image)

    def _predict(self, timestamp: float) -> Matrix:
        """Constant velocity, in seconds: dropped frames do not disturb it. In a map that was
        loaded, the camera is taken to be where that ends until it is found."""
        if not len(self._poses):
            return self._mapping.keyframe_pose(self._mapping.reference)
        T_last = self._poses.pose(-1)
        if self._velocity is None:
            return T_last
        elapsed = timestamp - self._poses.timestamp(-1)
        return orthonormalised(se3_exp(self._velocity * elapsed) @ T_last)

    def _locate(self, frame: Frame, T_cw: Matrix, clock: _Clock) -> _Found:
        """The pose of a frame, expected at ``T_cw``: by tracking or, where that fails or is
        doubtful, in the whole map."""
        matches, inliers, visible = self._track_around(frame, T_cw, clock)
        state = self._state_of(inliers, matches)
        if state == TrackingState.LOST and self._see_far():
            matches, inliers, visible = self._track_around(frame, T_cw, clock)
            state = self._state_of(inliers, matches)
        if state == TrackingState.LOST:
            elsewhere = self._relocalise(frame)
        elif self._is_doubtful(frame, inliers):
            elsewhere = self._find_better(frame, inliers)
        else:
            return _Found(state, matches, inliers, visible)
        if state == TrackingState.LOST or elsewhere:
            clock.lap("relocalise")
            state = self._state_of(elsewhere, elsewhere)
            relocalised = state != TrackingState.LOST
            return _Found(state, elsewhere, elsewhere, relocalised=relocalised)
        return _Found(state, matches, inliers, visible)

    def _track_previous_frame(self, frame: Frame, T_cw: Matrix) -> int:
        """Along the prediction; where there is none or it fails, against the reference keyframe. A
        map that was loaded has no frame to go on from, but a drive that is resumed has gone on."""
        if self.frame is None and (self._lost_frames or not self._resumed):
            return 0
        if self._velocity is not None and self.frame is not None:
            matches, inliers = track_motion(frame, self.frame, T_cw, self.context)
            if self._moves_as_predicted(inliers, matches):
                return inliers
        inliers = track_descriptors(frame, self._mapping.reference_view, T_cw, self.context)
        if inliers >= self.config.tracking.min_inliers_frame or self._velocity is None:
            return inliers
        return self._track_predicted(frame, T_cw)

    def _track_predicted(self, frame: Frame, T_cw: Matrix) -> int:
        """Match the local map around the prediction: after a jump of the light, what older frames
        saw is found where the previous one saw other things. Returns inliers or 0."""
        frame.T_cw = T_cw
        frame.landmark[:], frame.xyz[:] = -1, np.nan
        window = self.config.tracking.predicted_window
        matches, inliers, _ = track_local_map(
            frame, self._mapping.local, self.context, window, self._mapping.patches
        )
        if self._moves_as_predicted(inliers, matches):
            return inliers
        frame.landmark[:], frame.xyz[:] = -1, np.nan
        return 0

    def _moves_as_predicted(self, inliers: int, matches: int) -> bool:
        config = self.config.tracking
        return inliers >= max(config.min_inliers_motion, config.min_inlier_ratio * matches)

    def _track_around(
        self, frame: Frame, T_cw: Matrix, clock: _Clock
    ) -> tuple[int, int, NDArray[np.int32]]:
        """Track a frame by what was seen last and by the map around; see ``track_local_map``."""
        inliers = self._track_previous_frame(frame, T_cw)
        clock.lap("track_frame")
        found = self._track_local_map(frame, inliers)
        clock.lap("track_local_map")
        return found

    def _see_far(self) -> bool:
        """Map the far points of a keyframe that the camera has left too fast; returns whether."""
        if self._localize or self.frame is None or self.camera.monocular:
            return False
        if self._velocity is not None:
            return False
        self._merge()
        return self._mapping.map_far_points(self.frame)

    def _track_local_map(self, frame: Frame, inliers: int) -> tuple[int, int, NDArray[np.int32]]:
        if inliers < self.config.tracking.min_inliers_frame:
            return inliers, 0, np.empty(0, np.int32)
        return track_local_map(
            frame, self._mapping.local, self.context, patches=self._mapping.patches
        )

    def _relocalise(self, frame: Frame) -> int:
        """Look for a lost frame in the whole map; returns inliers, 0 if it was found nowhere."""
        if self._mapping.busy:
            return 0
        config = self.config.relocalization
        candidates = self._detector.locate(frame.image, frame.features, self.map)
        for candidate in candidates[: config.max_candidates]:
            place = local_map(self.map, candidate.match, 1)
            around = local_map(self.map, candidate.match, config.neighbours)
            inliers = relocalise(frame, place, around, self.context, seed=candidate.match)
            if inliers:
                self._mapping.set_reference(candidate.match)
                return inliers
        return self._relocalise_learned(frame, candidates)

    def _is_doubtful(self, frame: Frame, inliers: int) -> bool:
        """Whether a frame tracks so little that it may be matched with other things: one whose pose
        could hardly be predicted, after a gap or next to one found in the map, or that has lost
        most of what the frame before tracked, as where the camera was carried."""
        if self.frame is None:
            return False
        usual = self._poses.timestamp(-1) - self._poses.timestamp(-2) if len(self._poses) > 1 else 0
        config = self.config.relocalization
        gap = frame.timestamp - self.frame.timestamp > config.doubtful_gap * usual > 0.0
        old = self._mapping.n_keyframes > self.config.tracking.young_keyframes
        unpredicted = self._velocity is None and old
        few = inliers < config.doubtful_share * self._mapping.n_reference
        sudden = inliers < config.doubtful_share * self._n_tracked and old
        return few and (gap or unpredicted or sudden)

    def _find_better(self, frame: Frame, inliers: int) -> int:
        """Look for a frame in the whole map, and leave it as it is unless it tracks more there;
        returns inliers or 0. That is worth waiting for mapping: a doubtful frame asks for a
        keyframe."""
        self._merge_before(frame)
        T_cw, landmark, xyz = frame.T_cw, frame.landmark.copy(), frame.xyz.copy()
        shift = frame.shift
        reference = self._mapping.reference
        found = self._relocalise(frame)
        if found > self.config.relocalization.better * inliers:
            return found
        frame.T_cw, frame.landmark, frame.xyz, frame.shift = T_cw, landmark, xyz, shift
        if self._mapping.reference != reference:
            self._mapping.set_reference(reference)
        return 0

    def _relocalise_learned(self, frame: Frame, candidates: list[LoopCandidate]) -> int:
        """By local descriptors of the network: where the light has changed ORB's find nothing."""
        images, config = self._closing.verifier.images, self.config.learned
        image = frame.image
        if images is None or image is None:
            return 0
        candidates = rated(candidates, lambda: images.glance_at(image), images, config)
        alike = [one for one in candidates if one.alike is not None]
        alike.sort(key=lambda one: -(one.alike or 0.0))
        if not alike:
            return 0
        maps = images.network.describe(image)
        for candidate in alike[: config.max_candidates]:
            found = recognise(
                self.map, maps, frame.features, candidate.match, images, self.camera, self.config
            )
            if found is not None:
                frame.T_cw = found.T_cw
                frame.landmark[found.feature] = found.landmark
                frame.shift = None
                frame.xyz[found.feature] = self.map.arrays.xyz[found.landmark]
                self._mapping.set_reference(candidate.match)
                return len(found.feature)
        return 0

    def _state_of(self, inliers: int, matches: int) -> TrackingState:
        config = self.config.tracking
        # In the wide windows of an RGB-D camera, a wrong pose too finds some inliers.
        too_few = self.camera.depth and inliers < config.depth_min_inlier_ratio * matches
        if inliers < config.min_inliers_lost or too_few:
            return TrackingState.LOST
        if inliers < config.min_inliers:
            return TrackingState.WEAK
        return TrackingState.OK

    def _update_motion(self, frame: Frame, relocalised: bool) -> None:
        """Place the frame; the velocity is that since the last frame tracked."""
        self._velocity = None
        if not relocalised:  # a leap to where the camera was found again is no motion
            last = -1 if self.frame is None else self.frame.index
            step = se3_log(orthonormalised(frame.T_cw @ inverse(self._poses.pose(last))))
            self._velocity = step / (frame.timestamp - self._poses.timestamp(last))
        self._place(frame)

    def _place(self, frame: Frame) -> None:
        """Keep the pose of a frame that was tracked."""
        self._initialiser.reset()
        self._lost_frames = 0
        self._n_tracked = int(np.count_nonzero(frame.landmark >= 0))
        self._poses.append(frame.timestamp, frame.T_cw, tracked=True)
        self.frame = frame

    def _lose(self, frame: Frame) -> bool:
        """Keep the prediction as the pose; after a while, map anew from there: returns whether."""
        self._poses.append(frame.timestamp, frame.T_cw, tracked=False)
        self._lost_frames += 1
        if self._localize:
            return False
        config = self.config.tracking
        if self.camera.monocular:
            long = self._lost_frames >= config.monocular_lost_frames
            return long and self._start_monocular(frame)
        young = self._mapping.n_keyframes <= config.young_keyframes
        patience = 1 if young else config.lost_frames_before_restart
        if self._lost_frames < patience or not self._can_start(frame):
            return False
        frame.landmark[:] = -1
        self._insert_keyframe(frame, predicted=self._velocity is not None)
        self._velocity = None
        self._lost_frames = 0
        self.frame = frame
        return True

    # Mapping

    def _start(self, frame: Frame, clock: _Clock) -> TrackResult:
        """The first keyframe is the world, its stereo points the first landmarks; a monocular
        map begins with two keyframes."""
        self._poses.append(frame.timestamp, frame.T_cw, tracked=False)
        if self.camera.monocular:
            started = self._start_monocular(frame)
        elif started := self._can_start(frame):
            self._insert_keyframe(frame)
            self.frame = frame
        inliers = int(np.count_nonzero(frame.landmark >= 0))
        state = TrackingState.OK if started else TrackingState.LOST
        clock.lap("keyframe")
        return _result(frame, _Found(state, inliers, inliers), started, clock)

    def _start_monocular(self, frame: Frame) -> bool:
        """Begin a map, or a sub-map where tracking was lost, if an earlier frame forms a pair with
        this one, the frame placed last."""
        start = self._initialiser.offer(frame)
        if start is None:
            return False
        self._merge()
        start = start.at_speed(self._velocity, self.config.initialization.max_rescaling)
        keyframes = self._mapping.begin(start)
        for keyframe, each in zip(keyframes, (start.first, start.second), strict=True):
            self._poses.replace(each.index, keyframe)
        frame.T_cw = self._poses.pose(frame.index)
        self._velocity = start.velocity
        self._lost_frames = 0
        self._initialiser.reset()
        self.frame = frame
        return True

    def _can_start(self, frame: Frame) -> bool:
        return frame.n_stereo >= self.config.tracking.min_stereo_start

    def _extend_map(self, frame: Frame, inliers: int, visible: NDArray[np.int32]) -> bool:
        """Count what the frame saw, of what it should see, and make it a keyframe if it is new;
        when only localising, just look at the map from where it is. Returns whether it was."""
        if self._localize:
            self._look_around(frame)
            return False
        self._mapping.count(visible, frame.landmark[frame.landmark >= 0])
        # The map is made of left images.
        is_keyframe = (
            not frame.features.from_right
            and self._needs_keyframe(frame, inliers)
            and not self._follow_known(frame)
        )
        if is_keyframe:
            self._insert_keyframe(frame)
        return is_keyframe

    def _look_around(self, frame: Frame) -> None:
        """The keyframe that sees most of the landmarks of a frame becomes the reference (ORB-SLAM,
        V-D)."""
        shared = self._mapping.count_shared(frame)
        best = int(np.argmax(shared))
        if shared[best] and best != self._mapping.reference:
            self._mapping.set_reference(best)

    def _needs_keyframe(self, frame: Frame, inliers: int) -> bool:
        close = feature_depth(frame.features, self.camera) < self.context.close_depth
        tracked = frame.landmark >= 0
        tracked_close = int(np.count_nonzero(close & tracked))
        self._close_gain.add(tracked_close)
        evidence = KeyframeEvidence(
            seconds_since_keyframe=frame.timestamp - self._mapping.last_timestamp,
            n_inliers=inliers,
            n_reference=self._mapping.n_reference,
            tracked_close=tracked_close,
            untracked_close=int(np.count_nonzero(close & ~tracked)),
            mapping_idle=not self._mapping.busy,
            gained_close=self._close_gain.mean,
        )
        if self.camera.monocular:
            return needs_monocular_keyframe(evidence, self.config.keyframes)
        return needs_keyframe(evidence, self.config.keyframes, depth=self.camera.depth)

    def _follow_known(self, frame: Frame) -> bool:
        """Track on by an old keyframe if the place is known by it; returns whether."""
        self._merge(frame)
        keyframe, n_shared, n_place = self._mapping.old_keyframe(frame)
        if keyframe < 0:
            return False
        n_inliers = int(np.count_nonzero(frame.landmark >= 0))
        evidence = PlaceEvidence(n_inliers, n_shared, n_place)
        if not is_known_place(evidence, self.config.keyframes):
            return False
        self._mapping.follow(keyframe, frame)
        self._poses.follow_reference(frame.index, frame.T_cw)
        return True

    def _insert_keyframe(self, frame: Frame, *, predicted: bool = True) -> None:
        """Make a keyframe of the frame placed last (``MappingThread.insert``)."""
        self._merge(frame)
        self._mapping.insert(frame, predicted=predicted)
        self._close_gain.begin()
        self._poses.replace(frame.index, self._mapping.reference)

    def _merge(self, current: Frame | None = None, *, renumber: bool = True) -> None:
        """Show tracking what local mapping has done: poses, landmarks, merged identities.

        ``current`` is the frame placed last, if it is not ``self.frame`` yet. Landmarks may get
        other ids; not with ``renumber=False``, for a caller that holds some.
        """
        unit = self._poses.unit
        frames = {id(one): one for one in (self.frame, current) if one is not None}
        if not self._mapping.merge(frames.values() if renumber else None):
            return
        if self._velocity is not None:
            self._velocity[:3] *= self._poses.unit / unit
        self._follow_map(self.frame)
        if current is not self.frame:
            self._follow_map(current)
        self.on_merge()

    def _merge_before(self, frame: Frame) -> None:
        """Merge when a frame is tracked and not placed yet: it keeps its pose to the reference."""
        if not self._mapping.busy:
            return
        unit, reference = self._poses.unit, self._mapping.reference
        T_c_reference = frame.T_cw @ inverse(self._mapping.keyframe_pose(reference))
        self._merge(renumber=False)
        T_c_reference[:3, 3] *= self._poses.unit / unit
        frame.T_cw = orthonormalised(T_c_reference @ self._mapping.keyframe_pose(reference))
        self._mapping.update(frame)

    def _follow_map(self, frame: Frame | None) -> None:
        """Bring a frame to where the map has moved."""
        if frame is not None:
            self._mapping.update(frame)
            frame.T_cw = self._poses.pose(frame.index)


@dataclass
class _Clock:
    """Wall time by stage, in milliseconds."""

    laps: dict[str, float] = field(default_factory=dict)
    last: float = field(default_factory=time.perf_counter)

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.laps[stage] = self.laps.get(stage, 0.0) + 1e3 * (now - self.last)
        self.last = now


@dataclass(frozen=True)
class _Found:
    """Where a frame was found: ``visible`` are the landmarks that it should see."""

    state: TrackingState
    matches: int = 0
    inliers: int = 0
    visible: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    relocalised: bool = False


def _result(frame: Frame, found: _Found, is_keyframe: bool, clock: _Clock) -> TrackResult:
    return TrackResult(
        index=frame.index,
        timestamp=frame.timestamp,
        T_wc=inverse(frame.T_cw),
        state=found.state,
        n_features=len(frame.features),
        n_stereo=frame.n_stereo,
        n_matches=found.matches,
        n_inliers=found.inliers,
        is_keyframe=is_keyframe,
        relocalised=found.relocalised,
        stage_ms=clock.laps,
    )


def _check_images(left: Image, second: Image | DepthImage | None, camera: Camera) -> None:
    if (second is None) != camera.monocular:
        what = "depth" if camera.depth else "right"
        raise ValueError(f"a {what} image belongs to a camera of {camera.sensor}")
    expected = (camera.height, camera.width)
    images = [left] if second is None else [left, second]
    if any(image.shape != expected for image in images):
        shapes = " and ".join(str(image.shape) for image in images)
        raise ValueError(f"images are {shapes}, the camera's {expected}")
    wanted = [np.uint8, np.float32 if camera.depth else np.uint8]
    if any(image.dtype != dtype for image, dtype in zip(images, wanted, strict=False)):
        types = " and ".join(str(image.dtype) for image in images)
        expected_types = "uint8 and float32" if camera.depth else "uint8"
        raise ValueError(f"images are of {types}, not of {expected_types}")
