"""How SLAM continues in a map that was made before, and what of it a map file holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vslam.camera import same_camera
from vslam.closing import LoopClosing
from vslam.frame_poses import FrameTable
from vslam.frontend.rig import RigCalibration
from vslam.frontend.side_delay import DelayState
from vslam.frontend.tracker import Tracker
from vslam.frontend.tracking import TrackingContext
from vslam.geometry import inverse, orthonormalised, se3_log
from vslam.map import Map
from vslam.mapping import Mapper
from vslam.maps.stored_map import StoredMap, World
from vslam.modes import Mode
from vslam.states import Checkpoint


@dataclass(frozen=True)
class OpenedMap:
    """A map, new or stored, that a drive begins in.

    Attributes:
        map: None for a new one.
        frames: frames of the same drive that are placed already; None for a new drive.
        checkpoint: with which that drive continues to the byte, or None.
        drives: what the images of the drives before were, "kitti 06" for example.
        world: where the map lies in that of a ground truth; None if unknown.
    """

    map: Map | None = None
    frames: FrameTable | None = None
    checkpoint: Checkpoint | None = None
    drives: tuple[str, ...] = ()
    world: World | None = None


def open_map(
    stored: StoredMap | None,
    context: TrackingContext,
    closing: LoopClosing,
    *,
    localize: bool,
    resume: bool,
) -> OpenedMap:
    """Restore detector, images and closed loops from a stored map, and begin a new drive in it
    unless the last one is resumed or the map is only localised in. None begins a new map.

    Args:
        localize: the map is to stay as it is.
        resume: continue the map's last drive instead of starting a new one.

    Raises:
        ValueError: in a few words why the map cannot be continued.
    """
    if localize and (stored is None or not stored.map.n_keyframes):
        raise ValueError("there is no map to localise in")
    if stored is None:
        return OpenedMap()
    map_, images = stored.map, closing.verifier.images
    if not np.array_equal(map_.scales, context.scales):
        raise ValueError(
            f"made with another pyramid, of {len(map_.scales)} levels by "
            f"{map_.scales[1] / map_.scales[0]:g}"
        )
    if not same_camera(stored.camera, context.camera):
        raise ValueError("made with another camera")
    closing.detector.restore(stored.detector)
    if images is not None and stored.images is not None:
        images.restore(stored.images, context.camera.width)
    closing.closed = list(stored.loops)
    drives = stored.drives if map_.n_keyframes else ()
    if resume:
        return OpenedMap(map_, stored.frames, stored.checkpoint, drives[:-1], stored.world)
    if map_.n_keyframes and not localize:
        map_.begin_drive()
    return OpenedMap(map_, drives=drives, world=stored.world)


@dataclass(frozen=True)
class Session:
    """The parts of SLAM, as far as they remember anything, and the map that the drive began in."""

    context: TrackingContext
    closing: LoopClosing
    mapper: Mapper
    tracker: Tracker
    rig: RigCalibration
    mode: Mode
    opened: OpenedMap

    def stored_map(self, drive: str) -> StoredMap:
        """The map, with a checkpoint if there can be one now. Its arrays are those of the map.

        Args:
            drive: what the images since the start were.
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
            world=opened.world,
            checkpoint=self.state(),
        )

    def state(self) -> Checkpoint | None:
        """What all parts remember between two frames; None where that takes more than is kept:
        before the first frame is tracked, when only localising, while a keyframe is mapped, a
        monocular map begins or a global bundle adjustment is under way."""
        tracker, policy = self.tracker.state(), self.mode.state()
        if tracker is None or policy is None:
            return None
        if self.closing.is_adjusting or not self.mapper.is_merged:
            return None
        return Checkpoint(
            tracker,
            self.mapper.state(),
            policy,
            self.closing.state(),
            self.rig.state().numbers(),
        )

    def restore(self, state: Checkpoint) -> None:
        """Let all parts remember what ``state`` gave, in the map as it was then."""
        self.mapper.restore(state.mapper)
        self.mode.restore(state.policy)
        self.closing.restore(state.closing)
        self.rig.restore(DelayState.of_numbers(state.rig))
        landmark = state.tracker.landmark
        xyz = np.full((len(landmark), 3), np.nan)
        xyz[landmark >= 0] = self.mapper.map.arrays.xyz[landmark[landmark >= 0]]
        self.rig.mark_corrected(self.tracker.restore(state.tracker, xyz))

    def resume(self) -> None:
        """Expect the next frame after the last one of the drive that is continued, if one is: to
        the byte with a checkpoint, else as far as the poses of the last frames tell."""
        frames = self.opened.frames
        if frames is None:
            return
        if len(frames.timestamp):
            self.mapper.continue_drive()
            self.tracker.resume()
        if self.opened.checkpoint is not None:
            self.restore(self.opened.checkpoint)
        elif len(frames.tracked) > 1 and frames.tracked[-2:].all():
            self.mapper.refer_to(int(frames.reference[-1]))
            poses = self.mapper.frames
            step = se3_log(orthonormalised(poses.pose(-1) @ inverse(poses.pose(-2))))
            self.tracker.resume(step / (frames.timestamp[-1] - frames.timestamp[-2]))
