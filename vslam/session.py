"""Opens the map of a drive, resumes a drive, and collects the data that a map file stores."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from vslam.camera import same_camera
from vslam.closing import LoopClosing
from vslam.config import changed_thresholds
from vslam.context import Context
from vslam.features import Extracted
from vslam.frame_poses import FrameTable
from vslam.frontend.orb import level_shapes
from vslam.frontend.pose_alignment import coarse_pyramid, coarse_shapes
from vslam.frontend.rig import RigMonitor
from vslam.frontend.track import Track
from vslam.geometry import inverse, orthonormalised, se3_log
from vslam.map import Map
from vslam.mapping import Mapper
from vslam.maps.stored_map import StoredMap, TruthAlignment
from vslam.modes import Mode
from vslam.motion import Motion
from vslam.states import Checkpoint, TrackerState

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
    motion: Motion
    rig: RigMonitor
    mode: Mode
    opened: OpenedMap

    def stored_map(self, drive: str, last: Track | None) -> StoredMap:
        """Return the map in the form in which it is stored in a file.

        It contains a checkpoint if ``state`` can return one. The arrays of the map are not copied.

        Args:
            drive: source of the images of the current drive, such as "kitti 06".
            last: the last tracked frame.
        """
        map_, images, opened = self.mapper.wait(), self.closing.verifier.images, self.opened
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
            checkpoint=self.state(last),
        )

    def state(self, last: Track | None) -> Checkpoint | None:
        """Return the state of all parts between two frames, or None if this is not possible now.

        It is not possible before the first frame is tracked, or if the run only localises. It is
        also not possible while a keyframe is being mapped, a monocular map begins, a verified loop
        is waiting to be closed, or a global bundle adjustment is running.
        """
        policy, mapper = self.mode.state(), self.mapper
        if last is None or policy is None:
            return None
        if self.closing.is_adjusting or not mapper.is_published or mapper.has_found_loop:
            return None
        return Checkpoint(
            tracker_state(last, self.motion.lost_frames),
            mapper.state(),
            policy,
            self.closing.state(),
            self.rig.sides,
            self.motion.odometry.state,
        )

    def restore(self, state: Checkpoint) -> Track:
        """Restore the state of all parts, given the map that was stored together with it.

        Returns:
            The last tracked frame.
        """
        self.mapper.restore(state.mapper)
        self.mode.restore(state.policy)
        self.closing.restore(state.closing)
        self.rig.sides = state.sides
        self.motion.restore(state.odometry, state.tracker.lost_frames)
        last = restored_track(state.tracker, self.context)
        offset = self.mapper.view.disparity_offset  # it was corrected before it was saved
        extracted = replace(last.extracted, disparity_offset=offset)
        positions = self.mapper.map.arrays.xyz[last.landmark]
        xyz = np.where((last.landmark >= 0)[:, None], positions, np.nan)
        return replace(last, extracted=extracted, xyz=xyz)

    def resume(self) -> Track | None:
        """If ``resume=True`` was passed to ``open_map``, continue the drive after its last frame.

        With a checkpoint, the results are identical to those of an uninterrupted run. Without a
        checkpoint, tracking continues from the last pose and speed.

        Returns:
            The last tracked frame. None if it is unknown.
        """
        frames = self.opened.frames
        if frames is None:
            return None
        if len(frames.timestamp):
            self.mapper.continue_drive()
            self.motion.resume()
        if self.opened.checkpoint is not None:
            return self.restore(self.opened.checkpoint)
        if self.mapper.n_keyframes:
            _log.warning(
                "the map was saved without the state of tracking (resumable=True), so the poses of "
                "the continued drive will differ from those of an uninterrupted one"
            )
        if len(frames.tracked) > 1 and frames.tracked[-2:].all():
            self.mapper.refer_to(int(frames.reference[-1]))
            poses = self.mapper.frames
            step = se3_log(orthonormalised(poses.pose(-1) @ inverse(poses.pose(-2))))
            self.motion.resume(step / (frames.timestamp[-1] - frames.timestamp[-2]))
        return None


def tracker_state(last: Track, lost_frames: int) -> TrackerState:
    """Return the last tracked frame for a checkpoint."""
    return TrackerState(
        index=last.index,
        timestamp=last.timestamp,
        features=last.features,
        landmark=last.landmark,
        T_cw=last.T_cw,
        twist=last.twist,
        lost_frames=lost_frames,
        n_tracked=last.n_inliers,
        coarse=np.empty(0, np.uint8) if last.coarse is None else last.coarse.pixels,
        standstill=last.still,
    )


def restored_track(state: TrackerState, context: Context) -> Track:
    """Return the frame whose state ``tracker_state`` returned, without positions of landmarks."""
    coarse = None
    if len(state.coarse):
        size = context.camera.height, context.camera.width
        shapes = coarse_shapes(level_shapes(size, context.config.orb))
        coarse = coarse_pyramid(state.coarse, shapes, size)
    return Track(
        state.index,
        state.timestamp,
        state.T_cw,
        Extracted(state.features),
        state.landmark,
        n_inliers=state.n_tracked,
        twist=state.twist,
        still=state.standstill,
        coarse=coarse,
    )
