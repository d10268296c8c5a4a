"""SLAM on a stereo, RGB-D or monocular stream. ``Slam.step`` processes one frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, DepthImage, Image, check_images, check_mask
from vslam.closing import LoopClosing
from vslam.config import Config, as_config
from vslam.context import Context
from vslam.errors import InputError
from vslam.features import Extracted, TrackingState, TrackResult
from vslam.frontend.extraction import FrameImages
from vslam.frontend.frame import Frame, PlacedFrame
from vslam.frontend.masks import Mask
from vslam.frontend.relocaliser import Relocaliser
from vslam.frontend.rig import RigCalibration
from vslam.frontend.tracker import Found, Tracker, TrackerStatus, result_of
from vslam.frontend.tracking import uncertainty_of
from vslam.gaps import Gap, find_gaps
from vslam.geometry import Matrix, adjoint, inverse
from vslam.loopclosure.detector import LoopDetector
from vslam.loopclosure.learned_verification import LearnedRelocalisation
from vslam.loopclosure.registry import DEFAULT_DETECTOR, detector_with_images
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.loopclosure.verifier import verifier_for
from vslam.loops import LoopCorrection, LoopEdge
from vslam.machine import StageClock
from vslam.map import Map
from vslam.map_frames import in_first_part, keyframe_trajectory
from vslam.mapping import Mapper
from vslam.maps.storage import load_checkpoint, load_map, save_map
from vslam.maps.stored_map import StoredMap, TruthAlignment
from vslam.modes import MapBuilding, Mode
from vslam.odometry import Odometry
from vslam.session import Session, open_map
from vslam.trajectory import Trajectory
from vslam.workers import Workers


def _ignore(result: TrackResult) -> None:
    """The default of ``on_pose``."""


class Slam:
    """Stereo, RGB-D or monocular SLAM. A monocular map has an arbitrary unit instead of metres.

    >>> slam = Slam(camera)
    >>> for left, right, timestamp in frames:
    ...     result = slam.step(left, right, timestamp)
    >>> slam.finish()
    >>> slam.trajectory().T_wc
    >>> slam.save(path)

    ``Slam.load(path)`` continues in the saved map. The camera is relocalised in this map, and new
    places are added. If relocalisation fails, a new sub-map begins, which a loop may join to the
    map later. With ``localize=True``, the map is not changed.

    Attributes:
        context: camera, thresholds and pyramid scales, for ``FrameImages``.
        detector: proposes loop candidates, and places for relocalisation.
        rig: measurements of the stereo pair, such as the delay of the right camera.
        workers: threads that run the mapping jobs. They can also prepare frames in advance.
        next_extraction: index of a later frame whose features will probably be needed.
            ``FrameImages.start_corners`` may be called in advance for this frame. -1 if there is no
            such frame.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | Mapping[str, Any] | str | None = None,
        detector: LoopDetector | str = DEFAULT_DETECTOR,
        *,
        threads: int = 2,
        images: KeyframeImages | None = None,
        start: StoredMap | None = None,
        localize: bool = False,
        resume: bool = False,
    ) -> None:
        """Begin SLAM with a new map, or continue in a stored map.

        Args:
            camera: the rectified camera that the images come from. Use ``camera.left_camera()`` for
                monocular SLAM.
            config: thresholds, as a ``Config``, as a dictionary such as ``{"orb": {"n_features":
                1000}}``, or as the name of a preset, such as ``"fast"``. Thresholds that are left
                out keep their defaults.
            detector: proposes loop candidates, and places for relocalisation. It is an object or a
                name (``vslam.loopclosure.registry``). ``both`` combines the capsule network with
                the bag of words. ``none`` closes no loops.
            threads: number of threads. The results do not depend on this number.
            images: store of the keyframe images, from which learned descriptors are computed. These
                descriptors verify loops where ORB fails. None verifies loops with ORB only. This
                argument is used only if ``detector`` is an object.
            start: a map to continue in, which is changed in place. It must have been made with the
                same camera, detector and pyramid. ``Slam.load`` reads such a map from a file.
            localize: only track in the map ``start``, without changing it.
            resume: continue the last drive of the map ``start`` instead of beginning a new drive.
                The poses equal those of an uninterrupted drive only if the map was saved with
                ``resumable=True``.

        Raises:
            ValueError: the map cannot be continued. The message gives the reason in a few words.
            InputError: a preset or threshold is unknown, or a value is out of range.
        """
        config = as_config({} if config is None else config)
        if isinstance(detector, str):
            detector, images = detector_with_images(detector, config)
        self.context = context = Context.create(camera, config)
        self.detector = detector
        self.rig = rig = RigCalibration(camera, config.stereo, context.scales)
        verifier = verifier_for(config, camera, images)
        self._closing = closing = LoopClosing(detector, verifier, camera, config, threads=threads)
        opened = open_map(start, context, closing, localize=localize, resume=resume)
        self.workers = workers = Workers(threads)
        self._mapper = mapper = Mapper(context, closing, rig, workers, opened.map, opened.frames)
        self._tracker = tracker = Tracker(context)
        recognise = LearnedRelocalisation(images, camera, config)
        self._relocaliser = Relocaliser(context, detector.locate, recognise)
        self._mode = Mode(mapper) if localize else MapBuilding(context, mapper, tracker)
        self._odometry = Odometry()
        self._session = Session(
            context, closing, mapper, tracker, rig, self._mode, self._odometry, opened
        )
        self._session.resume()
        self.next_extraction = -1

    @classmethod
    def load(
        cls,
        path: Path | str,
        config: Config | Mapping[str, Any] | str | None = None,
        detector: LoopDetector | str | None = None,
        *,
        resume: bool = False,
        **options: Any,
    ) -> Slam:
        """Continue in a map that ``save`` or a run wrote.

        Args:
            path: the map file, or the folder of a run.
            config: thresholds, as for a new map. None uses the thresholds with which the map was
                made.
            detector: the detector with which the map was made, as a name or an object. None uses
                the detector that is named in the file.
            resume: continue the last drive of the map instead of beginning a new drive.
            options: ``threads``, ``images`` and ``localize``, as for a new map.

        Raises:
            InputError: the file is not a map or is damaged, the map was made with another detector
                or pyramid, or it has no drive to resume.
        """
        stored = load_checkpoint(path) if resume else load_map(path)
        if resume and stored.frames is None:
            raise InputError(f"{path}: the map has no drive to continue; load it without resume.")
        detector = stored.detector.name if detector is None else detector
        config = as_config(stored.thresholds, str(path)) if config is None else config
        try:
            return cls(stored.camera, config, detector, start=stored, resume=resume, **options)
        except (ValueError, KeyError) as error:
            raise InputError(f"{path}: {error}; use the options of that run.") from error

    def save(self, path: Path | str, drive: str = "", *, resumable: bool = False) -> None:
        """Write the map, and everything else that ``load`` needs, to a file.

        An existing file is replaced.

        Args:
            path: the file.
            drive: source of the images of this drive, such as "kitti 06".
            resumable: also write the state of tracking and the culled parts of the map. A run that
                loads the file with ``resume=True`` then gives poses that are byte-identical to the
                poses of an uninterrupted run.

        Raises:
            RuntimeError: mapping failed, so that the map is incomplete.
            OSError: the file cannot be written. In this case, an existing file is unchanged.
        """
        save_map(path, self.stored_map(drive), resumable=resumable)

    def stored_map(self, drive: str = "") -> StoredMap:
        """Return the map in the form that ``save`` writes to a file.

        The result shares its arrays with the map that is being built. Before the next step, call
        ``compact()`` on it to get a copy.

        Raises:
            RuntimeError: mapping failed, so that the map is incomplete.
        """
        return self._session.stored_map(drive)

    def step(
        self,
        left: Image,
        second: Image | DepthImage | None,
        timestamp: float,
        *,
        mask: NDArray[np.uint8] | NDArray[np.bool_] | None = None,
        on_pose: Callable[[TrackResult], None] = _ignore,
    ) -> TrackResult:
        """Track one rectified stereo pair, RGB-D image or monocular image.

        A frame that shows something new is inserted as a keyframe.

        Images that are kept are copied. Therefore, a camera may write its next images into the same
        arrays.

        Args:
            left: ``(H, W)`` uint8 left image.
            second: for a stereo camera, the ``(H, W)`` uint8 right image. For an RGB-D camera, the
                ``(H, W)`` float32 depth of the pixels of the left image in metres, and 0 where the
                depth is unknown. None for a monocular camera.
            timestamp: seconds. It must be later than the timestamp of the last call.
            mask: ``(H, W)`` uint8 or bool. It is 0 where the left image must not be used, for
                example where it shows the hood of the car. None uses the whole image.
            on_pose: function that is called with the result as soon as the pose is known, before a
                keyframe is inserted. ``is_keyframe`` may not be decided yet. Exceptions of this
                function are passed on.

        Raises:
            ValueError: the images have the wrong size or type, or the timestamp is not finite or
                not later than the last timestamp.
            RuntimeError: mapping an earlier keyframe failed, so that the map is incomplete.
        """
        check_images(left, second, self.context.camera)
        of_left = None
        if mask is not None:
            check_mask(mask, self.context.camera)
            of_left = Mask.of(mask, self.context.config.orb)
        images = FrameImages(np.array(left), lambda: second, self.context, mask=of_left)
        return self.step_images(images, timestamp, on_pose=on_pose)

    def step_images(
        self,
        images: FrameImages,
        timestamp: float,
        stage_ms: dict[str, float] | None = None,
        on_pose: Callable[[TrackResult], None] = _ignore,
    ) -> TrackResult:
        """Do the same as ``step`` with images that were prepared in advance.

        Args:
            images: the images, which are not copied. Do not write to them afterwards.
            timestamp: seconds. It must be later than the timestamp of the last call.
            stage_ms: wall time of the stages before this call, in milliseconds. It is included in
                the result.
            on_pose: as in ``step``.
        """
        frame = self._next_frame(Extracted.nothing(), timestamp, None)
        frame.source, frame.pyramid, frame.coarse = images, images.pyramid, images.coarse
        frame.mask = images.mask
        return self._step(frame, StageClock(dict(stage_ms or {})), on_pose)

    def step_features(
        self,
        extracted: Extracted,
        timestamp: float,
        image: Image | None = None,
        stage_ms: dict[str, float] | None = None,
    ) -> TrackResult:
        """Do the same as ``step`` with features that were extracted in advance.

        Args:
            extracted: the features (``FrameImages.extracted``).
            timestamp: seconds. It must be later than the timestamp of the last call.
            image: ``(H, W)`` uint8, the image of the features, for loop detectors that need it. It
                is not copied. Do not write to it afterwards.
            stage_ms: wall time of the stages before this call, in milliseconds. It is included in
                the result.
        """
        frame = self._next_frame(extracted, timestamp, image)
        return self._step(frame, StageClock(dict(stage_ms or {})))

    def _step(
        self,
        frame: Frame,
        clock: StageClock,
        on_pose: Callable[[TrackResult], None] = _ignore,
    ) -> TrackResult:
        mapper, tracker = self._mapper, self._tracker
        mapper.admit(frame, tracker.last, tracker.twist)
        clock.lap("wait_for_mapping")
        if mapper.n_keyframes:
            tracked, T_predicted = self._track(frame, clock)
            last = tracker.last_seen(frame.timestamp, mapper.view)
            found = self._relocaliser.relocalise_if_needed(frame, tracked, mapper, last)
            if found is not tracked:
                clock.lap("relocalise")
            placed = self._record_pose(frame, found, T_predicted)
            on_pose(self._result(frame, found, False, dict(clock.ms)))
            is_keyframe = self._update_map(placed, found)
        else:
            found = self._begin_map(frame, clock)
            is_keyframe = not found.is_lost
            on_pose(self._result(frame, found, is_keyframe, dict(clock.ms)))
        if is_keyframe:
            self._odometry.keyframe()
        clock.lap("keyframe")
        return self._result(frame, found, is_keyframe, clock.ms)

    def _result(
        self, frame: Frame, found: Found, is_keyframe: bool, stage_ms: dict[str, float]
    ) -> TrackResult:
        camera, odometry = self.context.camera, self._odometry
        result = result_of(frame, found, is_keyframe, stage_ms, odometry, camera)
        return replace(result, part=self._mapper.view.part)

    def _begin_map(self, frame: Frame, clock: StageClock) -> Found:
        self.rig.extract(frame, self._tracker.twist)
        clock.lap("extract")
        self._follow(frame, frame.T_cw, None)
        begun = self._mode.begin(self._mapper.append_pose(frame, tracked=False))
        return Found.at_start(frame, begun=begun)

    def _track(self, frame: Frame, clock: StageClock) -> tuple[Found, Matrix]:
        """Track a frame by patches or, if this fails, by features.

        Returns:
            The result, and the ``(4, 4)`` pose ``T_cw`` that was predicted with constant velocity.
        """
        mapper, tracker = self._mapper, self._tracker
        T_predicted = tracker.predict(frame.timestamp, mapper.frames, mapper.view)
        by_patches = tracker.track_patches(frame, T_predicted, mapper.view, mapper.frames)
        state = tracker.judge_patches(by_patches)
        clock.lap("track")
        if state == TrackingState.OK:
            return tracker.use_patches(frame, by_patches), T_predicted
        before = frame.snapshot()
        self.rig.extract(frame, tracker.twist)
        clock.lap("extract")
        tracked = tracker.track(frame, T_predicted, mapper.view, mapper.frames)
        if tracked.is_lost and self._mode.map_far_points():
            T_predicted = tracker.predict(frame.timestamp, mapper.frames, mapper.view)
            tracked = tracker.track(frame, T_predicted, mapper.view, mapper.frames)
        if tracked.is_lost and state == TrackingState.WEAK:
            frame.restore(before)
            tracked = tracker.use_patches(frame, by_patches)
        clock.lap("track")
        return tracked, T_predicted

    def _record_pose(self, frame: Frame, found: Found, T_predicted: Matrix) -> PlacedFrame:
        """Record the pose of a frame, or the predicted pose if it is lost. Advance the odometry."""
        mapper, tracker = self._mapper, self._tracker
        known = tracker.twist is not None
        if found.is_lost:
            frame.T_cw = T_predicted
            self._follow(frame, T_predicted, None, known_velocity=known)
            tracker.lose()
            return mapper.append_pose(frame, tracked=False)
        found_again = found.relocalised or tracker.status is not TrackerStatus.TRACKING
        T_moved = T_predicted if found_again else frame.T_cw
        tracker.accept(frame, found, mapper.frames, mapper.n_keyframes)
        uncertainty = uncertainty_of(frame, self.rig.offset_sigma, self.context)
        self._follow(frame, T_moved, *uncertainty, found_again=found_again, known_velocity=known)
        return mapper.append_pose(frame, tracked=True, near=found.keyframe)

    def _update_map(self, frame: PlacedFrame, found: Found) -> bool:
        """Update the map and ``next_extraction``. Return whether the frame became a keyframe."""
        by_patches = frame.source is not None
        if found.is_lost:
            is_keyframe = self._mode.begin_after_loss(frame)
        else:
            is_keyframe = self._mode.update_map(frame, found)
            self.rig.observe(frame, frame.twist)
        # If patches failed for this frame, they will probably fail for the next frames.
        self.next_extraction = self._mode.due if by_patches else frame.index + 2
        return is_keyframe

    def skip(self, timestamp: float, *, dropped: bool = False) -> TrackResult:
        """Add a frame without images at the predicted pose. Its state is LOST or DROPPED."""
        frame = self._next_frame(Extracted.nothing(), timestamp, None)
        frame.T_cw = self._tracker.predict(timestamp, self._mapper.frames, self._mapper.view)
        known = self._tracker.twist is not None
        self._follow(frame, frame.T_cw, None, known_velocity=known)
        self._mapper.append_pose(frame, tracked=False)
        if self._mapper.n_keyframes and not dropped:
            self._tracker.lose()
        found = Found(TrackingState.DROPPED if dropped else TrackingState.LOST)
        return self._result(frame, found, False, {})

    def _follow(
        self,
        frame: Frame,
        T_cw: Matrix,
        covariance: Matrix | None,
        of_offset: Matrix | None = None,
        *,
        found_again: bool = False,
        known_velocity: bool = True,
    ) -> None:
        """Advance the odometry to the next frame, before the pose of this frame is recorded.

        Args:
            T_cw: ``(4, 4)`` pose of the frame, computed from the continuous motion since the last
                frame. It differs from the pose of the frame in the map if the camera was
                relocalised.
            covariance, of_offset, found_again, known_velocity: see ``Odometry.move``.
        """
        frames = self._mapper.frames
        T_now_last, elapsed = np.eye(4), 0.0
        if len(frames):
            T_now_last = T_cw @ inverse(frames.pose(-1))
            elapsed = frame.timestamp - frames.timestamp(-1)
        camera = self.context.camera
        if camera.quarter_turns:  # the odometry is that of the camera as mounted
            T = camera.T_mounted_camera
            A, R = adjoint(T), T[:3, :3]
            T_now_last = T @ T_now_last @ T.T
            covariance = None if covariance is None else A @ covariance @ A.T
            of_offset = None if of_offset is None else A @ of_offset @ R.T
        self._odometry.move(
            T_now_last, elapsed, covariance, of_offset,
            found_again=found_again, known_velocity=known_velocity,
        )  # fmt: skip

    def resume_odometry(self, last: TrackResult) -> None:
        """Continue ``T_odom_camera`` and its uncertainty after a drive was resumed.

        This is needed only if the map was saved without the state of tracking. Without this call,
        the odometry then starts at the identity, with no uncertainty.

        Args:
            last: the last result of the drive before it was resumed.
        """
        self._session.resume_odometry(last)

    def finish(self) -> None:
        """Complete all mapping. The map and trajectory then do not change until the next step."""
        self._mapper.finish()

    def _next_frame(self, extracted: Extracted, timestamp: float, image: Image | None) -> Frame:
        frames = self._mapper.frames
        if not math.isfinite(timestamp):
            raise ValueError(f"timestamp {timestamp} s must be a finite number")
        if len(frames) and not timestamp > (last := frames.timestamp(-1)):
            raise ValueError(f"timestamp {timestamp} s is not later than the last one, {last} s")
        return Frame.of(extracted, self.context.camera, len(frames), timestamp, image)

    @property
    def map(self) -> Map:
        """The map with its keyframes, landmarks and observations.

        Raises:
            RuntimeError: a keyframe is being mapped. Check ``is_mapping``, or call ``finish()``.
        """
        return self._mapper.map

    @property
    def frame(self) -> Frame | None:
        """The last tracked frame, for visualisation. None before the first tracked frame."""
        return self._tracker.last

    @property
    def truth_alignment(self) -> TruthAlignment | None:
        """The transformation from the loaded map to the frame of a ground truth, if known."""
        return self._session.opened.truth_alignment

    @property
    def is_mapping(self) -> bool:
        """Whether a keyframe is being mapped."""
        return self._mapper.is_mapping

    @property
    def is_adjusting(self) -> bool:
        """Whether a global bundle adjustment is running, or its result has not been merged yet."""
        return self._closing.is_adjusting

    @property
    def loops(self) -> list[LoopEdge]:
        """The outcomes of all loop candidates so far."""
        return self._closing.edges

    @property
    def problems(self) -> list[str]:
        """One sentence for each failure that did not harm the map.

        Such failures are a failed search for loops, a failed global bundle adjustment, and a right
        image that could not be read.
        """
        return [*self._closing.problems, *self.rig.problems]

    @property
    def corrections(self) -> list[LoopCorrection]:
        """The correction of the keyframes by each closed loop."""
        return self._closing.corrections

    def trajectory(self) -> Trajectory:
        """Return the pose of every frame. The poses of lost frames are interpolated."""
        return self._as_mounted(self._mapper.trajectory())

    def keyframe_trajectory(self) -> Trajectory:
        """Return the poses of the keyframes of this drive, without culled keyframes."""
        return self._as_mounted(keyframe_trajectory(self.map))

    def _as_mounted(self, trajectory: Trajectory) -> Trajectory:
        T_wc = self.context.camera.as_mounted(trajectory.T_wc)
        return replace(trajectory, T_wc=T_wc)

    def in_map(self) -> NDArray[np.bool_]:
        """Return an ``(N,)`` bool array, True for frames that were tracked in the first sub-map.

        Sub-maps that closed loops have joined to the first sub-map count as part of it.
        """
        return in_first_part(self.map, self._closing.closed, self._mapper.frames.table())

    def gaps(self) -> list[Gap]:
        """Return the stretches of this drive whose poses relative to the world were not measured.

        The camera was lost before each stretch, and no closed loop has joined the stretch to the
        map since. The list also contains lost frames at the start and at the end of the drive.

        Raises:
            RuntimeError: a keyframe is being mapped. Check ``is_mapping``, or call ``finish()``.
        """
        config, monocular = self.context.config.pose_graph, self.context.camera.monocular
        scale = math.exp(config.gap_scale) if monocular else 1.0
        return find_gaps(self.map, self._closing.closed, self._mapper.frames, scale)
