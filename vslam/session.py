"""Opens the map of a drive, resumes a drive, and collects the data that a map file stores."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from vslam.camera import same_camera
from vslam.closing import LoopClosing
from vslam.config import changed_thresholds
from vslam.context import Context
from vslam.features import TrackResult
from vslam.frame_poses import FrameTable
from vslam.frontend.rig import RigCalibration
from vslam.frontend.tracker import Tracker
from vslam.geometry import inverse, orthonormalised, se3_log
from vslam.map import Map
from vslam.mapping import Mapper
from vslam.maps.stored_map import StoredMap, TruthAlignment
from vslam.modes import Mode
from vslam.odometry import Odometry, OdometryState
from vslam.states import Checkpoint

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
    closing.detector.restore(stored.detector)
    if images is not None and stored.images is not None:
        images.restore(stored.images, context.camera.width)
    closing.closed = list(stored.loops)
    drives = stored.drives if map_.n_keyframes else ()
    alignment = stored.truth_alignment
    if resume:
        return OpenedMap(map_, stored.frames, stored.checkpoint, drives[:-1], alignment)
    if map_.n_keyframes and not localize:
        map_.begin_drive()
    return OpenedMap(map_, drives=drives, truth_alignment=alignment)


@dataclass(frozen=True)
class Session:
    """The parts of SLAM that have a state between frames, and the map in which the drive began."""

    context: Context
    closing: LoopClosing
    mapper: Mapper
    tracker: Tracker
    rig: RigCalibration
    mode: Mode
    odometry: Odometry
    opened: OpenedMap

    def stored_map(self, drive: str) -> StoredMap:
        """Return the map in the form in which it is stored in a file.

        It contains a checkpoint if ``state`` can return one. The arrays of the map are not copied.

        Args:
            drive: source of the images of the current drive, such as "kitti 06".
        """
        map_, images, opened = self.mapper.complete(), self.closing.verifier.images, self.opened
        return StoredMap(
            map=map_,
            camera=self.context.camera,
            loops=tuple(self.closing.closed),
            detector=self.closing.detector.memory(),
            images=None if images is None else images.files(map_.n_keyframes),
            frames=self.mapper.frames.table(),
            drives=(*opened.drives, drive) if self.mode.changes_map else opened.drives,
            thresholds=changed_thresholds(self.context.config.model_dump()),
            truth_alignment=opened.truth_alignment,
            checkpoint=self.state(),
        )

    def state(self) -> Checkpoint | None:
        """Return the state of all parts between two frames, or None if this is not possible now.

        It is not possible before the first frame is tracked, or if the run only localises. It is
        also not possible while a keyframe is being mapped, a monocular map begins, a verified loop
        is waiting to be closed, or a global bundle adjustment is running.
        """
        tracker, policy = self.tracker.state(), self.mode.state()
        if tracker is None or policy is None:
            return None
        mapper = self.mapper
        if self.closing.is_adjusting or not mapper.is_merged or mapper.has_found_loop:
            return None
        return Checkpoint(
            tracker,
            self.mapper.state(),
            policy,
            self.closing.state(),
            self.rig.state(),
            self.odometry.state,
        )

    def restore(self, state: Checkpoint) -> None:
        """Restore the state of all parts, given the map that was stored together with it."""
        self.mapper.restore(state.mapper)
        self.mode.restore(state.policy)
        self.closing.restore(state.closing)
        self.rig.restore(state.rig)
        self.odometry.state = state.odometry
        landmark = state.tracker.landmark
        xyz = np.full((len(landmark), 3), np.nan)
        xyz[landmark >= 0] = self.mapper.map.arrays.xyz[landmark[landmark >= 0]]
        self.rig.mark_corrected(self.tracker.restore(state.tracker, xyz))

    def resume_odometry(self, last: TrackResult) -> None:
        """Continue the odometry of a resumed drive, unless a checkpoint has restored it."""
        T_odom_camera, uncertainty = last.T_odom_camera, last.uncertainty
        if T_odom_camera is None or uncertainty is None or self.opened.checkpoint is not None:
            return
        self.odometry.state = OdometryState(T_odom_camera, uncertainty, 0.0)

    def resume(self) -> None:
        """If ``resume=True`` was passed to ``open_map``, continue the drive after its last frame.

        With a checkpoint, the results are identical to those of an uninterrupted run. Without a
        checkpoint, tracking continues from the last pose and speed.
        """
        frames = self.opened.frames
        if frames is None:
            return
        if len(frames.timestamp):
            self.mapper.continue_drive()
            self.tracker.resume()
        if self.opened.checkpoint is not None:
            self.restore(self.opened.checkpoint)
            return
        if self.mapper.n_keyframes:
            _log.warning(
                "the map was saved without the state of tracking (resumable=True), so the poses of "
                "the continued drive will differ from those of an uninterrupted one"
            )
        if len(frames.tracked) > 1 and frames.tracked[-2:].all():
            self.mapper.refer_to(int(frames.reference[-1]))
            poses = self.mapper.frames
            step = se3_log(orthonormalised(poses.pose(-1) @ inverse(poses.pose(-2))))
            self.tracker.resume(step / (frames.timestamp[-1] - frames.timestamp[-2]))
