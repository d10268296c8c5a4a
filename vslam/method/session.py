"""A drive: opens its map, tracks its frames, and collects the data that a map file stores."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from vslam.backend.inertial_filter import BIAS
from vslam.backend.inertial_start import MAX_SCALE_SIGMA
from vslam.config import changed_thresholds
from vslam.frontend.images import Images
from vslam.frontend.orb import level_shapes
from vslam.frontend.pose_alignment import is_coarse
from vslam.frontend.prediction import Prediction
from vslam.frontend.relocaliser import Relocaliser
from vslam.frontend.rig import RigMonitor
from vslam.frontend.tracker import Tracker
from vslam.loopclosure.detector import LoopDetector
from vslam.loopclosure.learned_verification import LearnedRelocalisation
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.loopclosure.verifier import Verifier
from vslam.maps.stored_map import StoredMap, TruthAlignment
from vslam.method.closing import LoopClosing
from vslam.method.inertia import Inertia
from vslam.method.map_frames import newest_unit
from vslam.method.mapping import Mapper
from vslam.method.modes import Building, Localising, Mode
from vslam.method.motion import Motion
from vslam.support.machine import StageClock
from vslam.support.workers import Workers
from vslam.types.camera import same_camera
from vslam.types.context import Context
from vslam.types.features import TrackingState, TrackResult
from vslam.types.frame_poses import FrameTable
from vslam.types.geometry import inverse, orthonormalised, se3_log
from vslam.types.imu import GRAVITY, ImuCalibration
from vslam.types.map import Map
from vslam.types.states import Checkpoint, ClosingState, MotionState
from vslam.types.track import By, Track

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class OpenedMap:
    """The new or stored map in which a drive begins.

    Attributes:
        map: the stored map. None for a new map.
        frames: poses of the earlier frames of the drive. None for a new drive.
        checkpoint: state from which the drive continues with the same results as an uninterrupted
            run. None for a new drive, or if the map was saved without a checkpoint.
        drives: source of the images of each earlier drive, such as "kitti 06".
        truth_alignment: the transformation from the map to the frame of a ground truth. None if it
            is unknown.
    """

    map: Map | None = None
    frames: FrameTable | None = None
    checkpoint: Checkpoint | None = None
    drives: tuple[str, ...] = ()
    truth_alignment: TruthAlignment | None = None


def open_map(
    stored: StoredMap | None,
    context: Context,
    closing: LoopClosing,
    *,
    localize: bool,
    resume: bool,
) -> OpenedMap:
    """Open the map in which a drive begins.

    The loop detector, the images and the closed loops are restored from the stored map. If
    ``stored`` is None, a new map begins.

    Args:
        localize: only localise in the map, without changing it.
        resume: continue the last drive of the map instead of starting a new drive.

    Raises:
        ValueError: the map cannot be continued. The message gives the reason in a few words.
    """
    if localize and (stored is None or not stored.map.n_keyframes):
        raise ValueError("there is no map to localise in")
    if stored is None:
        return OpenedMap()
    map_, images = stored.map, closing.verifier.images
    if not np.array_equal(map_.scales, context.scales):
        raise ValueError(
            f"made with another image pyramid ({len(map_.scales)} levels, scale factor "
            f"{map_.scales[1] / map_.scales[0]:g})"
        )
    if not same_camera(stored.camera, context.camera):
        raise ValueError("made with another camera")
    checkpoint = stored.checkpoint if resume else None
    if checkpoint is not None and (coarse := checkpoint.last.coarse) is not None:
        size = context.camera.height, context.camera.width
        if not is_coarse(coarse, level_shapes(size, context.config.orb), size):
            raise ValueError("the last frame is damaged")
    closing.detector.restore(stored.detector)
    if images is not None and stored.images is not None:
        images.restore(stored.images, context.camera.width)
    closing.closed.extend(stored.loops)
    drives = stored.drives if map_.n_keyframes else ()
    alignment = stored.truth_alignment
    if resume:
        return OpenedMap(map_, stored.frames, checkpoint, drives[:-1], alignment)
    if map_.n_keyframes and not localize:
        map_.begin_drive()
    return OpenedMap(map_, drives=drives, truth_alignment=alignment)


class Session:
    """One drive: tracks its frames one after the other, and builds the map or localises in it.

    Attributes:
        closing: finds and closes loops.
        published: the map, and what tracking sees of it.
        rig: what the images tell about the stereo rig.
        last: the last frame that was tracked. None before the first one.
        opened: the map in which the drive began.
    """

    def __init__(
        self,
        context: Context,
        detector: LoopDetector,
        images: KeyframeImages | None,
        workers: Workers,
        start: StoredMap | None,
        *,
        localize: bool,
        resume: bool,
        imu: ImuCalibration | None = None,
    ) -> None:
        """Begin a drive, or continue the last drive of a stored map after its last frame.

        With a checkpoint, the results of a continued drive are identical to those of an
        uninterrupted drive. Without a checkpoint, tracking continues from the last pose and speed.

        Args:
            detector, images, start, localize, resume, imu: see ``Slam``.
            workers: threads that run the mapping jobs.

        Raises:
            ValueError: the map cannot be continued. The message gives the reason in a few words.
        """
        state = start.checkpoint if start is not None and resume else None
        of_closing = state.closing if state else ClosingState()
        verifier = Verifier(context, images, of_closing.verifier)
        self.closing = closing = LoopClosing(
            detector, verifier, context, threads=workers.threads, state=of_closing
        )
        self.opened = opened = open_map(start, context, closing, localize=localize, resume=resume)
        self._mapper = mapper = Mapper(
            context, closing, workers, opened.map, opened.frames, state.published if state else None
        )
        self.published = published = mapper.published
        self.rig = RigMonitor(state.sides if state else None)
        self.last: Track | None = state.last if state else None
        self._context = context
        recognise = LearnedRelocalisation(images, context)
        self._relocaliser = Relocaliser(context, detector.locate, recognise)
        motion = MotionState(
            inertia=Inertia(scale_sigma=0.0 if published.map.scalars.metric else -1.0)
        )
        self._motion = Motion(context, published.frames, imu, state.motion if state else motion)
        self._tracker = tracker = Tracker(context)
        self._mode: Mode = Localising(published)
        if not localize:
            turn_between = None if imu is None else self._motion.turn_between
            policy = state.policy if state else None
            self._mode = Building(context, mapper, tracker, policy, turn_between)
        if state is None and opened.frames is not None and len(opened.frames.timestamp):
            self._continue_from_poses(opened.frames)

    def step(
        self,
        images: Images,
        timestamp: float,
        stage_ms: dict[str, float] | None,
        on_pose: Callable[[TrackResult], None],
    ) -> TrackResult:
        """Track the next frame, and update the map (``Slam.step_images``)."""
        self._check(timestamp)
        clock = StageClock(dict(stage_ms or {}))
        self._publish_due()
        clock.lap("wait_for_mapping")
        predicted = self._motion.predict(timestamp, self.last, self.published.view)
        if not self.published.n_keyframes:
            return self._begin(images, predicted, clock, on_pose)
        track, predicted = self._track(images, predicted, clock)
        track = self._record(track, predicted)
        on_pose(self._result(track, dict(clock.ms)))
        updated = self._mode.update_map(track, images, predicted)
        # If patches failed for this frame, they will probably fail for the next frames.
        soon = self._mode.due if track.by_patches else track.index + 2
        return self._end(updated, clock, soon)

    def add_imu(self, samples: ArrayLike) -> None:
        """Add samples of the IMU (``Slam.add_imu``)."""
        self._motion.add_samples(samples)

    @property
    def inertia(self) -> Inertia:
        """What is known from the IMU."""
        return self._motion.state.inertia

    @property
    def lacks_scale(self) -> bool:
        """Whether a monocular map is not metric although there is an IMU."""
        return (
            self.published.n_keyframes > 0 and self._motion.has_imu and not self._motion.is_metric
        )

    def skip(self, timestamp: float, *, dropped: bool) -> TrackResult:
        """Add a frame without images at the predicted pose. Its state is LOST or DROPPED."""
        self._check(timestamp)
        predicted = self._motion.predict(timestamp, self.last, self.published.view)
        state = TrackingState.DROPPED if dropped else TrackingState.LOST
        return self._result(self._record(replace(predicted.lost, state=state), predicted), {})

    def finish(self) -> None:
        """Complete all mapping. The scale of one camera is looked for once more."""
        if self._mode.changes_map:
            self._find_scale(at_once=True)
        inertial = self._motion.inertial_window() if self._mode.changes_map else None
        moved = self._mapper.finish(*self._held, inertial=inertial)
        self.last = moved[0] if moved else None

    def _check(self, timestamp: float) -> None:
        frames = self.published.frames
        if not math.isfinite(timestamp):
            raise ValueError(f"timestamp {timestamp} s must be a finite number")
        if len(frames) and not timestamp > (last := frames.timestamp(-1)):
            raise ValueError(f"timestamp {timestamp} s is not later than the last one, {last} s")

    @property
    def _held(self) -> tuple[Track, ...]:
        """The frame that moves with the map."""
        return () if self.last is None else (self.last,)

    def _publish_due(self) -> None:
        """Publish what is due at the next frame. The last frame moves with the map."""
        waited = not self.published.is_published
        moved = self.published.publish(*self._held, frame=len(self.published.frames))
        self.last = moved[0] if moved else None
        if waited and self.published.is_published and self._mode.changes_map:
            self._find_scale()

    def _find_scale(self, *, at_once: bool = False) -> None:
        """Make the map metric if the last frames and the IMU tell its scale.

        Args:
            at_once: whether it is tried even if it was tried shortly before.
        """
        published, motion = self.published, self._motion
        if self.last is None or not motion.seeks_scale:
            return
        moved = published.complete(self.last)
        self.last, first = moved[0], newest_unit(published.map)
        guess = motion.guess_scale(published.view, first, at_once=at_once)
        if guess is None:
            return
        start, inertial = guess
        found = self._mapper.find_scale(start, inertial)
        if found is None or not found.sigma <= MAX_SCALE_SIGMA:
            return
        moved = self._mapper.rescale(found.scale, inertial, *moved)
        self.last = replace(moved[0], still=None)
        motion.use_metres(published.view, first, found, whole=first == 0)
        if first == 0:
            self.opened = replace(self.opened, truth_alignment=None)
        _log.info(
            "the scale is known from the IMU at %.3f s, with a standard deviation of %.1f %%",
            published.frames.timestamp(-1), 100.0 * found.sigma,
        )  # fmt: skip

    def _begin(
        self,
        images: Images,
        predicted: Prediction,
        clock: StageClock,
        on_pose: Callable[[TrackResult], None],
    ) -> TrackResult:
        """Try to begin the map with a frame."""
        track = self._tracker.extract(images, predicted, self.published.view)
        clock.lap("extract")
        track = self._mode.begin(self._record(track, predicted), images.image)
        n = len(track.tracked)
        state = TrackingState.OK if track.is_keyframe else TrackingState.LOST
        track = replace(track, state=state, n_matches=n, n_inliers=n)
        on_pose(self._result(track, dict(clock.ms)))
        return self._end(track, clock)

    def _track(
        self, images: Images, predicted: Prediction, clock: StageClock
    ) -> tuple[Track, Prediction]:
        """Track a frame from its predicted pose, and relocalise it if this fails.

        Returns:
            The frame, and the prediction, which may have changed together with the map.
        """
        published, tracker = self.published, self._tracker
        track = tracker.track(images, predicted, published.view, clock)
        if track.is_lost and (last := self._mode.map_far_points(predicted.last)) is not None:
            predicted = self._motion.predict(predicted.timestamp, last, published.view)
            track = tracker.track(images, predicted, published.view, clock)
        seen = predicted.last_seen(published.view)
        if track.is_doubtful and predicted.last is not None:
            # It is worth waiting for the map: a doubtful frame soon becomes a keyframe.
            track, last = published.publish(track, predicted.last)
            predicted = replace(predicted, last=last)
        if track.is_doubtful or (track.is_lost and published.is_published):
            track = self._relocaliser.check(track, images, published.wait(), seen)
            clock.lap("relocalise")
        return track, predicted

    def _record(self, track: Track, predicted: Prediction) -> Track:
        """Record the pose of a frame. The next frame is tracked from it, unless it is lost.

        Returns:
            The frame with its velocity.
        """
        track = self._motion.advance(track, predicted, self.published.view)
        self.published.record(track)
        self.last = predicted.last if track.is_lost else track
        return track

    def _end(self, track: Track, clock: StageClock, next_extraction: int = -1) -> TrackResult:
        """End the step of a frame, which may have become a keyframe."""
        if track.is_keyframe:
            self._motion.keyframe(track)
        if track.is_keyframe or not track.is_lost:
            self.last = track
        self.rig.observe(track)
        clock.lap("keyframe")
        return replace(self._result(track, clock.ms), next_extraction=next_extraction)

    def _result(self, track: Track, stage_ms: dict[str, float]) -> TrackResult:
        odometry = self._motion.state.odometry
        inertial, bias, bias_sigma = self._motion.state.inertia.state, None, None
        if inertial is not None:
            bias, bias_sigma = inertial.bias, np.sqrt(np.diag(inertial.covariance)[BIAS])
        T_wc = self._context.camera.as_mounted(inverse(track.T_cw))
        return TrackResult(
            index=track.index,
            timestamp=track.timestamp,
            T_wc=T_wc,
            state=track.state,
            n_features=0 if track.by_patches else len(track.features),
            n_stereo=track.n_stereo,
            n_matches=track.n_matches,
            n_inliers=track.n_inliers,
            is_keyframe=track.is_keyframe,
            relocalised=track.by is By.PLACE,
            stage_ms=stage_ms,
            T_odom_camera=odometry.T_odom_camera,
            uncertainty=odometry.now,
            part=self.published.view.part,
            support=track.support,
            stands_still=track.by is By.STANDSTILL,
            gravity=None
            if track.gravity is None
            else GRAVITY * inverse(track.T_cw)[:3, :3] @ track.gravity.direction,
            imu_bias=bias,
            imu_bias_sigma=bias_sigma,
        )

    # The state of the drive

    def stored_map(self, drive: str) -> StoredMap:
        """Return the map in the form in which it is stored in a file.

        It contains a checkpoint if ``state`` can return one. The arrays of the map are not copied.

        Args:
            drive: source of the images of the current drive, such as "kitti 06".
        """
        map_, closing, opened = self.published.wait(), self.closing, self.opened
        images = closing.verifier.images
        return StoredMap(
            map=map_,
            camera=self._context.camera,
            loops=tuple(closing.closed),
            detector=closing.detector.memory(),
            images=None if images is None else images.files(map_.n_keyframes),
            frames=self.published.frames.table(),
            drives=(*opened.drives, drive) if self._mode.changes_map else opened.drives,
            thresholds=changed_thresholds(self._context.config.model_dump()),
            truth_alignment=opened.truth_alignment,
            checkpoint=self.state(),
        )

    def state(self) -> Checkpoint | None:
        """Return the state of all parts between two frames, or None if this is not possible now.

        It is not possible before the first frame is tracked, or if the run only localises. It is
        also not possible while a keyframe is being mapped, a monocular map begins, a verified loop
        is waiting to be closed, or a global bundle adjustment is running.
        """
        policy, published = self._mode.state(), self.published
        if self.last is None or policy is None:
            return None
        if self.closing.is_adjusting or not published.is_complete:
            return None
        return Checkpoint(
            self.last,
            self._motion.state,
            published.state(),
            policy,
            self.closing.state(),
            self.rig.sides,
        )

    def resume_odometry(self, last: TrackResult) -> None:
        """Continue the odometry of a resumed drive, unless a checkpoint has restored it."""
        if self.opened.checkpoint is None:
            self._motion.resume_odometry(last)

    def _continue_from_poses(self, frames: FrameTable) -> None:
        """Continue a drive from the poses of its frames, without a checkpoint."""
        self._motion.resume()
        if self.published.n_keyframes:
            _log.warning(
                "the map was saved without the state of tracking (resumable=True), so the poses of "
                "the continued drive will differ from those of an uninterrupted one"
            )
        if len(frames.tracked) > 1 and frames.tracked[-2:].all():
            self.published.refer_to(int(frames.reference[-1]))
            poses = self.published.frames
            step = se3_log(orthonormalised(poses.pose(-1) @ inverse(poses.pose(-2))))
            self._motion.resume(step / (frames.timestamp[-1] - frames.timestamp[-2]))
