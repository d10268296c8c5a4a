"""Continuing in a stored map, and collecting everything that a map file stores."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from vslam.camera import same_camera
from vslam.closing import LoopClosing
from vslam.config import changed_thresholds
from vslam.features import TrackResult
from vslam.frame_poses import FrameTable
from vslam.frontend.rig import RigCalibration
from vslam.frontend.tracker import Tracker
from vslam.frontend.tracking import TrackingContext
from vslam.geometry import inverse, orthonormalised, se3_log
from vslam.map import Map
from vslam.mapping import Mapper
from vslam.maps.stored_map import StoredMap, TruthAlignment
from vslam.modes import Mode
from vslam.odometry import Odometry
from vslam.states import Checkpoint

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class OpenedMap:
    """The map, new or stored, in which a drive begins.

    Attributes:
        map: the stored map; None for a new one.
        frames: poses of the drive's earlier frames; None for a new drive.
        checkpoint: state from which the drive continues with identical results; None for a new
            drive, or if the map was saved without one.
        drives: sources of the images of the earlier drives, such as "kitti 06".
        truth_alignment: the transformation of the map into the frame of a ground truth; None if
            unknown.
    """

    map: Map | None = None
    frames: FrameTable | None = None
    checkpoint: Checkpoint | None = None
    drives: tuple[str, ...] = ()
    truth_alignment: TruthAlignment | None = None


def open_map(
    stored: StoredMap | None,
    context: TrackingContext,
    closing: LoopClosing,
    *,
    localize: bool,
    resume: bool,
) -> OpenedMap:
    """Restore detector, images and closed loops from a stored map, or begin a new map if ``stored``
    is None.

    Args:
        localize: only localise in the map, without changing it.
        resume: continue the map's last drive instead of starting a new one.

    Raises:
        ValueError: the map cannot be continued; the message gives the reason in a few words.
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
    """The parts of SLAM that have a state, and the map, new or stored, in which the drive began."""

    context: TrackingContext
    closing: LoopClosing
    mapper: Mapper
    tracker: Tracker
    rig: RigCalibration
    mode: Mode
    odometry: Odometry
    opened: OpenedMap

    def stored_map(self, drive: str) -> StoredMap:
        """The map, with a checkpoint if one is possible now. The map is not copied.

        Args:
            drive: source of the present drive's images, such as "kitti 06".
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
        """The state of all parts between two frames, or None if no checkpoint is possible now.

        It is None before the first frame is tracked, when only localising, while a keyframe is
        being mapped, while a monocular map begins, while a found loop is not closed yet, and during
        a global bundle adjustment.
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
            self.odometry.state(),
        )

    def restore(self, state: Checkpoint) -> None:
        """Restore the state of all parts; the map must be the one that ``state`` was taken with."""
        self.mapper.restore(state.mapper)
        self.mode.restore(state.policy)
        self.closing.restore(state.closing)
        self.rig.restore(state.rig)
        self.odometry.restore(state.odometry)
        landmark = state.tracker.landmark
        xyz = np.full((len(landmark), 3), np.nan)
        xyz[landmark >= 0] = self.mapper.map.arrays.xyz[landmark[landmark >= 0]]
        self.rig.mark_corrected(self.tracker.restore(state.tracker, xyz))

    def resume_odometry(self, last: TrackResult) -> None:
        """Continue the odometry of a resumed drive after its last frame, unless ``resume`` has
        restored it from a checkpoint."""
        T_odom_camera, uncertainty = last.T_odom_camera, last.uncertainty
        if T_odom_camera is None or uncertainty is None or self.opened.checkpoint is not None:
            return
        self.odometry.resume(T_odom_camera, uncertainty)

    def resume(self) -> None:
        """Continue after the last frame of a resumed drive, if there is one.

        With a checkpoint, the results are identical to those of an uninterrupted run. Without one,
        tracking continues from the last pose and speed.
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
