"""SLAM on a stereo, RGB-D or monocular stream: ``Slam.step`` is the method section."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, DepthImage, Image, check_images
from vslam.closing import LoopClosing
from vslam.config import Config
from vslam.errors import InputError
from vslam.features import Extracted, Side, TrackingState, TrackResult
from vslam.frontend.extraction import extract_features
from vslam.frontend.frame import Frame
from vslam.frontend.relocaliser import Relocaliser
from vslam.frontend.rig import RigCalibration
from vslam.frontend.tracker import Found, Tracker, result_of
from vslam.frontend.tracking import TrackingContext
from vslam.loopclosure.detector import LoopDetector
from vslam.loopclosure.learned_relocalization import LearnedRelocalisation
from vslam.loopclosure.registry import DEFAULT_DETECTOR, detector_with_images
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.loopclosure.verifier import verifier_for
from vslam.loops import LoopCorrection, LoopEdge
from vslam.machine import StageClock
from vslam.map import Map
from vslam.map_frames import in_first_part, keyframe_trajectory
from vslam.mapping import Mapper
from vslam.maps.storage import load_checkpoint, load_map, save_map
from vslam.maps.stored_map import StoredMap, World
from vslam.modes import Localising, MapBuilding
from vslam.session import Session, open_map
from vslam.shared_map import mapping_executor
from vslam.trajectory import Trajectory


class Slam:
    """Stereo or RGB-D SLAM; monocular SLAM, in a unit of its own, with a camera without a baseline.

    >>> slam = Slam(camera)
    >>> for left, right, timestamp in frames:
    ...     result = slam.step(left, right, timestamp)
    >>> slam.finish()
    >>> slam.trajectory().T_wc
    >>> slam.save(path)

    ``Slam.load(path)`` continues in that map: the camera is looked for in all of it, and what is
    new is added. Where it is not found, a new sub-map begins, until a loop joins it. With
    ``localize=True`` the map stays as it is, to the byte.

    Attributes:
        context: camera, thresholds and pyramid scales, as ``extract_features`` takes them.
        detector: finds loops and relocalises.
        rig: what is known of the stereo pair, the measured delay of its right side for example.
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
            threads: with 1, a keyframe is mapped where the result is needed instead of beside
                tracking. The result is the same.
            start: a map to begin in, of the same camera, detector and pyramid; it becomes this
                one's own. ``Slam.load`` reads one from a file.
            localize: only track in that map.
            resume: continue the map's last drive; otherwise a new drive begins, with a clock of its
                own.

        Raises:
            ValueError: in a few words why the map cannot be continued.
        """
        config = config or Config()
        if isinstance(detector, str):
            detector, images = detector_with_images(detector, config)
        self.context = context = TrackingContext.create(camera, config)
        self.detector = detector
        self.rig = rig = RigCalibration(camera, config.stereo, context.scales)
        verifier = verifier_for(config, camera, images)
        self._closing = closing = LoopClosing(detector, verifier, camera, config, threads=threads)
        opened = open_map(start, context, closing, localize=localize, resume=resume)
        executor = mapping_executor(threads)
        self._mapper = mapper = Mapper(context, closing, rig, executor, opened.map, opened.frames)
        self._tracker = tracker = Tracker(context)
        recognise = LearnedRelocalisation(images, camera, config)
        self._relocaliser = Relocaliser(context, detector.locate, recognise)
        self._mode = Localising(mapper) if localize else MapBuilding(context, mapper, tracker)
        self._session = Session(context, closing, mapper, tracker, rig, self._mode, opened)
        self._session.resume()

    @classmethod
    def load(
        cls,
        path: Path | str,
        config: Config | None = None,
        detector: LoopDetector | str | None = None,
        *,
        resume: bool = False,
        **options: Any,
    ) -> Slam:
        """Continue in a map that ``save`` or a run wrote.

        Args:
            detector: like the one that the map was made with, a name or an object; None for just
                that one, as it is shipped.
            config, resume, options: as for a new map: ``threads``, ``images``, ``localize``.

        Raises:
            InputError: no map, a damaged one, or one of another detector or pyramid.
        """
        stored = load_checkpoint(path) if resume else load_map(path)
        detector = stored.detector.name if detector is None else detector
        try:
            return cls(stored.camera, config, detector, start=stored, resume=resume, **options)
        except (ValueError, KeyError) as error:
            raise InputError(f"{path}: {error}; go on with the options of its run.") from error

    def save(self, path: Path | str, drive: str = "", *, resumable: bool = False) -> None:
        """Write the map to a file, in place of what is there: all that ``load`` needs.

        Args:
            drive: what the images since the start were, "kitti 06" for example.
            resumable: include what tracking remembers and what was culled. Loaded with
                ``resume=True``, such a file gives the poses of a run that was not stopped, to the
                byte.

        Raises:
            RuntimeError: mapping failed, so that the map is incomplete.
            OSError: the file cannot be written; one that was there is as it was.
        """
        save_map(path, self.stored_map(drive), resumable=resumable)

    def stored_map(self, drive: str = "") -> StoredMap:
        """What ``save`` writes. Its arrays are those of the map: call ``compact()``, which copies
        them, before the next step.

        Raises:
            RuntimeError: mapping failed, so that the map is incomplete.
        """
        return self._session.stored_map(drive)

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
            ValueError: images of another size or type, or a timestamp that goes back or is
                not finite.
            RuntimeError: mapping an earlier keyframe failed, so that the map is incomplete.
        """
        check_images(left, second, self.context.camera)
        clock = StageClock()
        extracted = extract_features(left, second, self.context)
        clock.lap("extract")
        image = np.array(second if extracted.side == Side.RIGHT else left, np.uint8)
        return self.step_features(extracted, timestamp, image, clock.ms)

    def step_features(
        self,
        extracted: Extracted,
        timestamp: float,
        image: Image | None = None,
        stage_ms: dict[str, float] | None = None,
    ) -> TrackResult:
        """``step`` for a pair whose features were extracted elsewhere (``extract_features``).

        Args:
            image: ``(H, W)`` uint8 that the features were extracted from, for loop detectors that
                look at it. It is kept as it is: do not write to it afterwards.
            stage_ms: wall time by stage so far, milliseconds, for the result.
        """
        clock = StageClock(dict(stage_ms or {}))
        frame = self._next_frame(extracted, timestamp, image)
        mapper, tracker = self._mapper, self._tracker
        mapper.hold(tracker.last, frame)
        mapper.merge_if_due(frame.index)
        self.rig.prepare(frame, tracker.twist)
        clock.lap("wait_for_mapping")
        if not mapper.n_keyframes:
            mapper.append_pose(frame, tracked=False)
            found = Found.at_start(frame, begun=self._mode.begin(frame))
            clock.lap("keyframe")
            return result_of(frame, found, not found.is_lost, clock.ms)

        T_predicted = tracker.predict(timestamp, mapper.frames, mapper.view)
        tracked = tracker.track(frame, T_predicted, mapper.view, mapper.frames)
        if tracked.is_lost and self._mode.map_far_points():
            T_predicted = tracker.predict(timestamp, mapper.frames, mapper.view)
            tracked = tracker.track(frame, T_predicted, mapper.view, mapper.frames)
        clock.lap("track")
        found = self._relocaliser.relocalise_if_needed(frame, tracked, mapper)
        if found is not tracked:
            clock.lap("relocalise")
        if found.is_lost:
            frame.T_cw = T_predicted
            mapper.append_pose(frame, tracked=False)
            tracker.lose()
            is_keyframe = self._mode.begin_after_loss(frame)
        else:
            tracker.accept(frame, found, mapper.frames)
            mapper.append_pose(frame, tracked=True, near=found.keyframe)
            self.rig.observe(frame, frame.twist)
            is_keyframe = self._mode.update_map(frame, found)
        clock.lap("keyframe")
        return result_of(frame, found, is_keyframe, clock.ms)

    def skip(self, timestamp: float, *, dropped: bool = False) -> TrackResult:
        """Account for a frame without images, at the predicted pose: it is LOST, or DROPPED if
        there was only no time for it."""
        frame = self._next_frame(Extracted.nothing(), timestamp, None)
        frame.T_cw = self._tracker.predict(timestamp, self._mapper.frames, self._mapper.view)
        self._mapper.append_pose(frame, tracked=False)
        if self._mapper.n_keyframes and not dropped:
            self._tracker.lose()
        found = Found(TrackingState.DROPPED if dropped else TrackingState.LOST)
        return result_of(frame, found, False, {})

    def finish(self) -> None:
        """Complete what is being mapped; map and trajectory are final until the next step."""
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
            RuntimeError: a keyframe is being mapped: look at ``is_mapping``, or call ``finish()``.
        """
        return self._mapper.map

    @property
    def frame(self) -> Frame | None:
        """The last frame that was tracked, for drawing; None before the first."""
        return self._tracker.last

    @property
    def world(self) -> World | None:
        """Where the map that was loaded lies in that of a ground truth, None if unknown."""
        return self._session.opened.world

    @property
    def is_mapping(self) -> bool:
        """Whether a keyframe is being mapped."""
        return self._mapper.is_mapping

    @property
    def is_adjusting(self) -> bool:
        """Whether a global bundle adjustment is yet to be merged."""
        return self._closing.is_adjusting

    @property
    def loops(self) -> list[LoopEdge]:
        """Every loop candidate so far and what became of it."""
        return self._closing.edges

    @property
    def problems(self) -> list[str]:
        """What failed so far without harm to the map, a sentence each: looking for loops, or a
        global bundle adjustment."""
        return self._closing.problems

    @property
    def corrections(self) -> list[LoopCorrection]:
        """What each closed loop did to the keyframes."""
        return self._closing.corrections

    def trajectory(self) -> Trajectory:
        """Pose of every frame as the map is now, lost frames included: where the camera was lost,
        its motion is interpolated between the frames tracked before and after."""
        return self._mapper.trajectory()

    def keyframe_trajectory(self) -> Trajectory:
        """Pose of every keyframe of this drive that was not culled."""
        return keyframe_trajectory(self.map)

    def in_map(self) -> NDArray[np.bool_]:
        """``(N,)`` frames tracked in the part of the map that holds its first keyframe, sub-maps
        joined to it by loops included."""
        return in_first_part(self.map, self._closing.closed, self._mapper.frames.table())
