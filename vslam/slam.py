"""SLAM on a stereo, RGB-D or monocular stream: ``Slam.step`` is the method section."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, DepthImage, Image, check_images
from vslam.closing import LoopClosing
from vslam.config import Config
from vslam.errors import InputError
from vslam.features import Features, TrackingState, TrackResult
from vslam.frontend.frame import Frame
from vslam.frontend.relocaliser import Relocaliser
from vslam.frontend.side_delay import SideDelay
from vslam.frontend.tracker import Found, Tracker
from vslam.frontend.tracking import TrackingContext, extract_features
from vslam.geometry import Matrix, inverse, inverses
from vslam.hypotheses import joined_submaps
from vslam.loopclosure.detector import LoopDetector
from vslam.loopclosure.learned_relocalization import LearnedRelocalisation
from vslam.loopclosure.registry import DEFAULT_DETECTOR, detector_with_images
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.loopclosure.verifier import verifier_for
from vslam.loops import LoopCorrection, LoopEdge
from vslam.map import Map
from vslam.mapping import Mapper, mapping_executor
from vslam.maps.storage import load_checkpoint, load_map, save_map
from vslam.maps.stored_map import StoredMap, World
from vslam.modes import Localising, MapBuilding
from vslam.session import Parts, Session, continue_drive, stored_map
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
        camera, config: as given.
        context: camera, thresholds and pyramid scales, as ``extract_features`` takes them.
        detector: finds loops and relocalises.
        side_delay: by how much the right side of the pair is measured to be late.
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
        if localize and (start is None or not start.map.n_keyframes):
            raise ValueError("there is no map to localise in")
        config = config or Config()
        if isinstance(detector, str):
            detector, images = detector_with_images(detector, config)
        self.camera, self.config, self.detector = camera, config, detector
        self.context = TrackingContext.create(camera, config)
        self.side_delay = SideDelay(camera, config.stereo)
        verifier = verifier_for(config, camera, images)
        self._closing = LoopClosing(detector, verifier, camera, config, threads=threads)
        self._session = Session()
        frames = None
        if start is not None:
            frames = self._session.open(
                start, self.context, detector, self._closing, localize=localize, resume=resume
            )
        self._mapper = Mapper(
            self.context.scales,
            camera,
            config,
            self._closing,
            executor=mapping_executor(threads),
            map_=None if start is None else start.map,
            frames=frames,
        )
        self._tracker = Tracker(self.context)
        recognise = LearnedRelocalisation(images, camera, config)
        self._relocaliser = Relocaliser(self.context, detector.locate, recognise)
        self._mode = (
            Localising(self._mapper)
            if localize
            else MapBuilding(self.context, self._mapper, self._tracker)
        )
        if frames is not None and start is not None:
            continue_drive(self._parts(), frames, start.checkpoint)

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
        """Continue in a map that ``save`` or a run wrote.

        Args:
            detector: like the one that the map was made with, a name or an object; None for just
                that one, as it is shipped.
            config, threads, images, localize, resume: as for a new map.

        Raises:
            InputError: no map, a damaged one, or one of another detector or pyramid.
        """
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
        """The map, with a checkpoint if there can be one now; ``save`` writes what lives of it. Its
        arrays are those of the map: call ``compact()``, which copies them, before the next step.

        Raises:
            RuntimeError: mapping failed, so that the map is incomplete.
        """
        return stored_map(self._parts(), self._session, drive)

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
            RuntimeError: mapping an earlier keyframe failed, so that the map is incomplete.
        """
        check_images(left, second, self.camera)
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
            stage_ms: wall time of the extraction by stage, for the result.
        """
        clock = _Clock(dict(stage_ms or {}))
        frame = self._next_frame(features, timestamp, image)
        self._mapper.hold(self._tracker.last, frame)
        self._mapper.merge_if_due(frame.index)
        frame.correct_disparities(self._mapper.view.disparity_offset)
        frame.take_out_right_delay(self._tracker.twist, self.camera)
        clock.lap("wait_for_mapping")
        if not self._mapper.n_keyframes:
            return self._start(frame, clock)

        T_predicted = self._tracker.predict(timestamp, self._mapper.frames, self._mapper.view)
        found = self._locate(frame, T_predicted, clock)
        if found.is_lost:
            frame.T_cw = T_predicted
            self._mapper.place(frame, tracked=False)
            self._tracker.lose()
            return _result(frame, found, self._mode.begin_after_loss(frame), clock)

        self._tracker.accept(frame, found, self._mapper.frames)
        self._mapper.place(frame, tracked=True)
        self.side_delay.add(frame.features, frame.twist, self.context.scales)
        is_keyframe = self._mode.extend(frame, found)
        clock.lap("keyframe")
        return _result(frame, found, is_keyframe, clock)

    def skip(self, timestamp: float, *, dropped: bool = False) -> TrackResult:
        """Account for a frame without images, at the predicted pose: it is LOST, or DROPPED if
        there was only no time for it."""
        frame = self._next_frame(Features.none(), timestamp, None)
        frame.T_cw = self._tracker.predict(timestamp, self._mapper.frames, self._mapper.view)
        self._mapper.place(frame, tracked=False)
        if self._mapper.n_keyframes and not dropped:
            self._tracker.lose()
        state = TrackingState.DROPPED if dropped else TrackingState.LOST
        return _result(frame, Found(state), False, _Clock())

    def finish(self) -> None:
        """Complete what is being mapped. What the map and the trajectory say then is final."""
        self._mapper.finish()

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
        return self._session.world

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
    def corrections(self) -> list[LoopCorrection]:
        """What each closed loop did to the keyframes."""
        return self._closing.corrections

    def trajectory(self) -> Trajectory:
        """Pose of every frame as the map is now, lost frames included.

        Where the camera was lost, its motion is interpolated between the frames tracked before
        and after.

        Raises:
            RuntimeError: as ``map``.
        """
        self._mapper.map  # noqa: B018
        return self._mapper.frames.trajectory()

    def in_map(self) -> NDArray[np.bool_]:
        """``(N,)`` frames tracked in the part of the map that holds its first keyframe, sub-maps
        joined to it by loops included.

        Raises:
            RuntimeError: as ``map``.
        """
        frames = self._mapper.frames.table()
        if not self.map.n_keyframes:
            return frames.tracked
        part = joined_submaps(self.map, self._closing.closed)
        return frames.tracked & (part[frames.reference] == part[0])

    def keyframe_trajectory(self) -> Trajectory:
        """Pose of every keyframe of this drive that was not culled.

        Raises:
            RuntimeError: as ``map``.
        """
        map_ = self.map
        living = map_.living_keyframes()
        living = living[np.array(map_.sessions, np.int64)[living] == map_.session]
        times = np.array([map_.timestamps[k] for k in living], np.float64)
        return Trajectory(times, inverses(map_.arrays.T_cw[living]))

    def _parts(self) -> Parts:
        return Parts(
            self.camera,
            self.detector,
            self._closing,
            self._mapper,
            self._tracker,
            self.side_delay,
            self._mode,
        )

    def _next_frame(self, features: Features, timestamp: float, image: Image | None) -> Frame:
        frames = self._mapper.frames
        if len(frames) and not timestamp > (last := frames.timestamp(-1)):
            raise ValueError(f"timestamp {timestamp} s is not later than the last one, {last} s")
        return Frame.untracked(features, self.camera, len(frames), timestamp, image)

    def _start(self, frame: Frame, clock: _Clock) -> TrackResult:
        """The first keyframe is the world; its stereo points, or those of two monocular keyframes,
        are the first landmarks."""
        self._mapper.place(frame, tracked=False)
        started = self._mode.begin(frame)
        n_landmarks = int(np.count_nonzero(frame.landmark >= 0))
        state = TrackingState.OK if started else TrackingState.LOST
        clock.lap("keyframe")
        return _result(frame, Found(state, n_landmarks, n_landmarks), started, clock)

    def _locate(self, frame: Frame, T_cw: Matrix, clock: _Clock) -> Found:
        """The pose of a frame, expected at ``T_cw``: by tracking or, where that fails or is
        doubtful, in the whole map."""
        view, frames = self._mapper.view, self._mapper.frames
        if frame.features.from_right:
            T_cw = self.camera.T_right_left @ T_cw
        found = self._tracker.track(frame, T_cw, view)
        if found.is_lost and self._mode.see_farther():
            found = self._tracker.track(frame, T_cw, self._mapper.view)
        clock.lap("track")
        if found.is_lost and self._mapper.is_merged:
            inliers, keyframe = self._relocaliser.find(frame, self.map)
            found = self._tracker.judged(inliers, inliers, keyframe=keyframe)
            clock.lap("relocalise")
        elif not found.is_lost and self._tracker.is_doubtful(frame, found, frames, view):
            # Worth waiting for mapping: a doubtful frame asks for a keyframe.
            map_ = self._mapper.merged()
            inliers, keyframe = self._relocaliser.find_better(frame, map_, found.n_inliers)
            if keyframe >= 0:
                found = self._tracker.judged(inliers, inliers, keyframe=keyframe)
                clock.lap("relocalise")
        if found.relocalised:
            self._mapper.refer_to(found.keyframe)
        if frame.features.from_right:
            frame.T_cw = inverse(self.camera.T_right_left) @ frame.T_cw
        return found


@dataclass
class _Clock:
    """Wall time by stage, in milliseconds."""

    laps: dict[str, float] = field(default_factory=dict)
    last: float = field(default_factory=time.perf_counter)

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.laps[stage] = self.laps.get(stage, 0.0) + 1e3 * (now - self.last)
        self.last = now


def _result(frame: Frame, found: Found, is_keyframe: bool, clock: _Clock) -> TrackResult:
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
        stage_ms=clock.laps,
    )
