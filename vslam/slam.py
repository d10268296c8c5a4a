"""SLAM on a stereo, RGB-D or monocular stream; ``Slam.step`` processes one frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, DepthImage, Image, check_images, check_mask
from vslam.closing import LoopClosing
from vslam.config import Config, as_config
from vslam.errors import InputError
from vslam.features import Extracted, TrackingState, TrackResult
from vslam.frontend.extraction import FrameImages
from vslam.frontend.frame import Frame, PlacedFrame
from vslam.frontend.masks import Mask
from vslam.frontend.relocaliser import Relocaliser
from vslam.frontend.rig import RigCalibration
from vslam.frontend.tracker import Found, Tracker, TrackerStatus, result_of
from vslam.frontend.tracking import TrackingContext, uncertainty_of
from vslam.geometry import Matrix, inverse
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
    """Do nothing with a result."""


class Slam:
    """Stereo, RGB-D or monocular SLAM; a monocular map has an arbitrary unit instead of metres.

    >>> slam = Slam(camera)
    >>> for left, right, timestamp in frames:
    ...     result = slam.step(left, right, timestamp)
    >>> slam.finish()
    >>> slam.trajectory().T_wc
    >>> slam.save(path)

    ``Slam.load(path)`` continues in that map: the camera is relocalised in it, and new places are
    added. If relocalisation fails, a new sub-map begins, which a loop may join to the map later.
    With ``localize=True`` the map is not changed.

    Attributes:
        context: camera, thresholds and pyramid scales, for ``FrameImages``.
        detector: proposes loop candidates and places for relocalisation.
        rig: measurements of the stereo pair, such as the delay of its right camera.
        workers: run the mapping jobs; they can also prepare frames in advance.
        next_extraction: index of a later frame whose features will probably be needed, so that its
            ``FrameImages.start_corners`` may be called in advance; -1 if none.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | Mapping[str, Any] | None = None,
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
            camera: the rectified camera that the images come from; ``camera.left_camera()`` for
                monocular SLAM.
            config: thresholds, also as a dictionary such as ``{"orb": {"n_features": 1000}}``;
                those left out keep their defaults.
            detector: proposes loop candidates and places for relocalisation; an object or a name
                (``vslam.loopclosure.registry``). ``both`` combines the capsule network with the bag
                of words; ``none`` closes no loops.
            threads: with 1, a keyframe is mapped when its result is needed instead of in parallel
                with tracking. The results are the same.
            images: only if ``detector`` is an object: store of the keyframe images for learned
                descriptors, which verify loops where ORB fails; None verifies with ORB only.
            start: a map to continue in, made with the same camera, detector and pyramid; it is
                changed in place. ``Slam.load`` reads one from a file.
            localize: only track in that map, without changing it.
            resume: continue the map's last drive; otherwise a new drive begins, whose timestamps
                are independent of those before. The poses equal those of an uninterrupted drive
                only if the map was saved with ``resumable=True``.

        Raises:
            ValueError: the map cannot be continued; the message gives the reason in a few words.
            InputError: a threshold is unknown or out of range.
        """
        config = as_config({} if config is None else config)
        if isinstance(detector, str):
            detector, images = detector_with_images(detector, config)
        self.context = context = TrackingContext.create(camera, config)
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
        config: Config | Mapping[str, Any] | None = None,
        detector: LoopDetector | str | None = None,
        *,
        resume: bool = False,
        **options: Any,
    ) -> Slam:
        """Continue in a map that ``save`` or a run wrote.

        Args:
            path: the map file, or the folder of a run.
            config: as for a new map; None uses the thresholds that the map was made with.
            detector: the detector that the map was made with, as a name or an object; None uses
                the detector that the file names.
            resume: as for a new map.
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
        """Write the map, and everything else that ``load`` needs, to a file; an existing file is
        replaced.

        Args:
            path: the file.
            drive: source of the images of this drive, such as "kitti 06".
            resumable: include the state of tracking and the culled parts of the map, so that a run
                that loads the file with ``resume=True`` gives the same poses, byte for byte, as an
                uninterrupted run.

        Raises:
            RuntimeError: mapping failed, so that the map is incomplete.
            OSError: the file cannot be written; an existing file is unchanged.
        """
        save_map(path, self.stored_map(drive), resumable=resumable)

    def stored_map(self, drive: str = "") -> StoredMap:
        """The map as ``save`` writes it. It shares the arrays of the map that is being built; call
        ``compact()``, which copies them, before the next step.

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
        """Track one rectified stereo pair, RGB-D image or monocular image, and insert it as a
        keyframe if it shows something new.

        Images that are kept are copied, so that a camera may write the next images into the same
        arrays.

        Args:
            left: ``(H, W)`` uint8.
            second: the right image, ``(H, W)`` uint8; with ``camera.depth`` the depth of the left
                image's pixels, ``(H, W)`` float32 metres, 0 where unknown; None for a monocular
                camera.
            timestamp: seconds, later than that of the last call.
            mask: ``(H, W)`` uint8 or bool, 0 where the left image must not be used, for example
                where it shows the hood of the car; None uses the whole image.
            on_pose: called with the result as soon as the pose is known, because inserting a
                keyframe takes much longer than tracking. Whether the frame becomes a keyframe
                (``is_keyframe``) may not be decided yet. Exceptions of ``on_pose`` are passed on.

        Raises:
            ValueError: the images have another size or type, or the timestamp is not finite or not
                later than the last one.
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
        """As ``step``, for images that were prepared before, for example in another thread.

        Args:
            images: the images, which are not copied: do not write to them afterwards.
            timestamp, stage_ms: as for ``step_features``.
            on_pose: as for ``step``.
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
        """As ``step``, for a frame whose features were extracted before
        (``FrameImages.extracted``).

        Args:
            extracted: the features.
            timestamp: as for ``step``.
            image: ``(H, W)`` uint8, the image of the features, for loop detectors that need it. It
                is not copied: do not write to it afterwards.
            stage_ms: wall time of the stages before this call, in milliseconds, to be included in
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
            found = self._relocaliser.relocalise_if_needed(frame, tracked, mapper)
            if found is not tracked:
                clock.lap("relocalise")
            placed = self._record_pose(frame, found, T_predicted)
            on_pose(result_of(frame, found, False, dict(clock.ms), self._odometry))
            is_keyframe = self._update_map(placed, found)
        else:
            found = self._begin_map(frame, clock)
            is_keyframe = not found.is_lost
            on_pose(result_of(frame, found, is_keyframe, dict(clock.ms), self._odometry))
        if is_keyframe:
            self._odometry.keyframe()
        clock.lap("keyframe")
        return result_of(frame, found, is_keyframe, clock.ms, self._odometry)

    def _begin_map(self, frame: Frame, clock: StageClock) -> Found:
        """Try to begin the map with a frame."""
        self.rig.extract(frame, self._tracker.twist)
        clock.lap("extract")
        self._follow(frame, frame.T_cw, None)
        begun = self._mode.begin(self._mapper.append_pose(frame, tracked=False))
        return Found.at_start(frame, begun=begun)

    def _track(self, frame: Frame, clock: StageClock) -> tuple[Found, Matrix]:
        """Track a frame by patches or, if that fails, by features. Returns also the ``(4, 4)`` pose
        ``T_cw`` that constant velocity predicted."""
        mapper, tracker = self._mapper, self._tracker
        T_predicted = tracker.predict(frame.timestamp, mapper.frames, mapper.view)
        tracked = tracker.track_patches(frame, T_predicted, mapper.view)
        if tracked.is_lost:
            clock.lap("track")
            self.rig.extract(frame, tracker.twist)
            clock.lap("extract")
            tracked = tracker.track(frame, T_predicted, mapper.view, mapper.frames)
        if tracked.is_lost and self._mode.map_far_points():
            T_predicted = tracker.predict(frame.timestamp, mapper.frames, mapper.view)
            tracked = tracker.track(frame, T_predicted, mapper.view, mapper.frames)
        clock.lap("track")
        return tracked, T_predicted

    def _record_pose(self, frame: Frame, found: Found, T_predicted: Matrix) -> PlacedFrame:
        """Record the pose of a frame and advance the odometry; a lost frame gets the predicted
        pose."""
        mapper, tracker = self._mapper, self._tracker
        if found.is_lost:
            frame.T_cw = T_predicted
            self._follow(frame, T_predicted, None)
            tracker.lose()
            return mapper.append_pose(frame, tracked=False)
        found_again = found.relocalised or tracker.status is not TrackerStatus.TRACKING
        T_moved = T_predicted if found_again else frame.T_cw
        tracker.accept(frame, found, mapper.frames)
        uncertainty = uncertainty_of(frame, self.rig.offset_sigma, self.context)
        self._follow(frame, T_moved, *uncertainty)
        return mapper.append_pose(frame, tracked=True, near=found.keyframe)

    def _update_map(self, frame: PlacedFrame, found: Found) -> bool:
        """Update the map with a frame, and choose the next frame whose features to extract in
        advance; returns whether the frame became a keyframe."""
        by_patches = frame.source is not None
        if found.is_lost:
            is_keyframe = self._mode.begin_after_loss(frame)
        else:
            is_keyframe = self._mode.update_map(frame, found)
            self.rig.observe(frame, frame.twist)
        # If patches failed for this frame, they will probably fail for the next ones.
        self.next_extraction = self._mode.due if by_patches else frame.index + 2
        return is_keyframe

    def skip(self, timestamp: float, *, dropped: bool = False) -> TrackResult:
        """Add a frame without images at the predicted pose. Its state is LOST, or DROPPED if there
        was no time to process it."""
        frame = self._next_frame(Extracted.nothing(), timestamp, None)
        frame.T_cw = self._tracker.predict(timestamp, self._mapper.frames, self._mapper.view)
        self._follow(frame, frame.T_cw, None)
        self._mapper.append_pose(frame, tracked=False)
        if self._mapper.n_keyframes and not dropped:
            self._tracker.lose()
        found = Found(TrackingState.DROPPED if dropped else TrackingState.LOST)
        return result_of(frame, found, False, {}, self._odometry)

    def _follow(
        self,
        frame: Frame,
        T_cw: Matrix,
        covariance: Matrix | None,
        of_offset: Matrix | None = None,
    ) -> None:
        """Advance the odometry to the next frame, before its pose is recorded.

        Args:
            T_cw: ``(4, 4)`` pose of the frame by continuous motion from the last one; it differs
                from the pose in the map if the camera was relocalised.
            covariance, of_offset: see ``Odometry.move``.
        """
        frames = self._mapper.frames
        T_now_last, elapsed = np.eye(4), 0.0
        if len(frames):
            T_now_last = T_cw @ inverse(frames.pose(-1))
            elapsed = frame.timestamp - frames.timestamp(-1)
        self._odometry.move(T_now_last, elapsed, covariance, of_offset)

    def resume_odometry(self, last: TrackResult) -> None:
        """Continue ``T_odom_camera`` and the uncertainty from the last result of a drive that was
        resumed from a map without the state of tracking. Without this call, the odometry starts at
        the identity, with no uncertainty."""
        self._session.resume_odometry(last)

    def finish(self) -> None:
        """Complete all mapping, so that map and trajectory do not change until the next step."""
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
        """Keyframes, landmarks and observations.

        Raises:
            RuntimeError: a keyframe is being mapped; check ``is_mapping`` or call ``finish()``.
        """
        return self._mapper.map

    @property
    def frame(self) -> Frame | None:
        """The last tracked frame, for visualisation; None before the first."""
        return self._tracker.last

    @property
    def truth_alignment(self) -> TruthAlignment | None:
        """The transformation of the loaded map into a ground truth's frame; None if unknown."""
        return self._session.opened.truth_alignment

    @property
    def is_mapping(self) -> bool:
        """Whether a keyframe is being mapped."""
        return self._mapper.is_mapping

    @property
    def is_adjusting(self) -> bool:
        """Whether the result of a global bundle adjustment is still to be merged."""
        return self._closing.is_adjusting

    @property
    def loops(self) -> list[LoopEdge]:
        """The outcome of every loop candidate so far."""
        return self._closing.edges

    @property
    def problems(self) -> list[str]:
        """One sentence for each failure that did not harm the map: a search for loops or a global
        bundle adjustment that failed, or a right image that could not be read."""
        return [*self._closing.problems, *self.rig.problems]

    @property
    def corrections(self) -> list[LoopCorrection]:
        """How each closed loop corrected the keyframes."""
        return self._closing.corrections

    def trajectory(self) -> Trajectory:
        """The pose of every frame according to the present map. The poses of lost frames are
        interpolated between the tracked frames before and after them."""
        return self._mapper.trajectory()

    def keyframe_trajectory(self) -> Trajectory:
        """The poses of the living keyframes of this drive."""
        return keyframe_trajectory(self.map)

    def in_map(self) -> NDArray[np.bool_]:
        """``(N,)`` bool: which frames were tracked in the part of the map with its first keyframe,
        including sub-maps that loops have joined to it."""
        return in_first_part(self.map, self._closing.closed, self._mapper.frames.table())
