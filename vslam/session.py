"""How SLAM is kept in a map file, and how it continues from one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vslam.camera import Camera, same_camera
from vslam.closing import LoopClosing
from vslam.frame_poses import FrameTable
from vslam.frontend.frame import Frame
from vslam.frontend.keyframes import CloseGainState
from vslam.frontend.side_delay import SideDelay
from vslam.frontend.tracker import Tracker, TrackerMemory
from vslam.frontend.tracking import TrackingContext
from vslam.geometry import inverse, orthonormalised, se3_log
from vslam.loopclosure.detector import LoopDetector
from vslam.mapping import Mapper, MapperState
from vslam.maps.checkpoint import Checkpoint
from vslam.maps.stored_map import StoredMap, World
from vslam.modes import Localising, MapBuilding


@dataclass
class Parts:
    """The parts of SLAM that remember something between two frames."""

    camera: Camera
    detector: LoopDetector
    closing: LoopClosing
    mapper: Mapper
    tracker: Tracker
    side_delay: SideDelay
    mode: Localising | MapBuilding


class Session:
    """The drives that a map was made on.

    Attributes:
        drives: what the images of each were, "kitti 06" for example.
        world: where the map lies in that of a ground truth; None if unknown.
    """

    def __init__(self) -> None:
        self.drives: tuple[str, ...] = ()
        self.world: World | None = None

    def open(
        self,
        start: StoredMap,
        context: TrackingContext,
        detector: LoopDetector,
        closing: LoopClosing,
        *,
        localize: bool,
        resume: bool,
    ) -> FrameTable | None:
        """Begin in a map: loop detector and loop closing remember what belongs to it.

        Args:
            localize: the map is to stay as it is.
            resume: continue the map's last drive instead of starting a new one.

        Returns:
            The frames of this drive that are placed already, None for a new drive.

        Raises:
            ValueError: in a few words why the map cannot be continued.
        """
        if not np.array_equal(start.map.scales, context.scales):
            raise ValueError(
                f"made with another pyramid, of {len(start.map.scales)} levels by "
                f"{start.map.scales[1] / start.map.scales[0]:g}"
            )
        if not same_camera(start.camera, context.camera):
            raise ValueError("made with another camera")
        detector.restore(start.detector)
        images = closing.verifier.images
        if images is not None and start.images is not None:
            images.restore(start.images, context.camera.width)
        closing.closed = list(start.loops)
        self.drives, self.world = start.drives, start.world
        if not start.map.n_keyframes:
            self.drives = ()
        if resume:
            self.drives = self.drives[:-1]
            return start.frames
        if not localize and start.map.n_keyframes:
            start.map.session += 1
        return None


def continue_drive(parts: Parts, frames: FrameTable, checkpoint: Checkpoint | None) -> None:
    """Expect the next frame after the last one of a drive: to the byte with a checkpoint, else as
    far as the poses of the last frames tell.

    Args:
        frames: of the drive, all of them placed.
    """
    if len(frames.timestamp):
        parts.mapper.continue_drive()
        parts.tracker.resume()
    if checkpoint is not None:
        restore(parts, checkpoint)
    elif len(frames.tracked) > 1 and frames.tracked[-2:].all():
        parts.mapper.refer_to(int(frames.reference[-1]))
        poses = parts.mapper.frames
        step = se3_log(orthonormalised(poses.pose(-1) @ inverse(poses.pose(-2))))
        parts.tracker.resume(step / (frames.timestamp[-1] - frames.timestamp[-2]))


def stored_map(parts: Parts, session: Session, drive: str) -> StoredMap:
    """The map, with a checkpoint if there can be one now. Its arrays are those of the map.

    Args:
        drive: what the images since the start were.
    """
    map_, images = parts.mapper.complete(), parts.closing.verifier.images
    localising = isinstance(parts.mode, Localising)
    return StoredMap(
        map=map_,
        camera=parts.camera,
        loops=tuple(parts.closing.closed),
        detector=parts.detector.memory(),
        images=None if images is None else images.files(map_.n_keyframes),
        frames=parts.mapper.frames.table(),
        drives=session.drives if localising else (*session.drives, drive),
        world=session.world,
        checkpoint=state_of(parts),
    )


def state_of(parts: Parts) -> Checkpoint | None:
    """What SLAM remembers between two frames; None where that takes more than is kept: before the
    first frame is tracked, while a keyframe is mapped or a monocular map begins, while a global
    bundle adjustment is under way, and when only localising."""
    mode, last = parts.mode, parts.tracker.memory()
    if last is None or isinstance(mode, Localising) or not mode.can_pause:
        return None
    if parts.closing.is_adjusting or not parts.mapper.is_merged:
        return None
    mapper, gain, frame = parts.mapper.state(), mode.state(), last.last
    return Checkpoint(
        index=frame.index,
        timestamp=frame.timestamp,
        features=frame.features,
        landmark=frame.landmark,
        T_cw=frame.T_cw,
        velocity=frame.twist,
        reference=mapper.reference,
        last_frame=mapper.last_frame,
        last_timestamp=mapper.last_timestamp,
        lost_frames=last.lost_frames,
        n_tracked=last.n_tracked,
        gained_close=gain.mean,
        gain_awaited=gain.awaited,
        closing=parts.closing.state(),
        patches=mapper.patches,
        side_delay=parts.side_delay.memory(),
    )


def restore(parts: Parts, checkpoint: Checkpoint) -> None:
    """Remember what ``state_of`` gave, in the map as it was then."""
    parts.mapper.restore(
        MapperState(
            checkpoint.reference,
            checkpoint.last_frame,
            checkpoint.last_timestamp,
            checkpoint.patches,
        )
    )
    parts.closing.restore(checkpoint.closing)
    parts.side_delay.restore(checkpoint.side_delay)
    if isinstance(parts.mode, MapBuilding):
        parts.mode.restore(CloseGainState(checkpoint.gained_close, checkpoint.gain_awaited))
    frame = Frame.untracked(
        checkpoint.features, parts.camera, checkpoint.index, checkpoint.timestamp
    )
    tracked = checkpoint.landmark >= 0
    frame.T_cw, frame.landmark = checkpoint.T_cw, checkpoint.landmark
    frame.twist = checkpoint.velocity
    frame.disparity_offset = parts.mapper.view.disparity_offset
    frame.xyz[tracked] = parts.mapper.map.arrays.xyz[checkpoint.landmark[tracked]]
    parts.tracker.restore(TrackerMemory(frame, checkpoint.lost_frames, checkpoint.n_tracked))
