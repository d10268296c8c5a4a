"""The pose of every frame of a run, relative to a keyframe: where that moves, it follows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from vslam.geometry import Matrix, inverse, orthonormalised
from vslam.trajectory import Trajectory, bridge_gaps


class KeyframePoses(Protocol):
    """What frames are placed by: the poses of keyframes as they are now.

    Attributes:
        n_keyframes: how many there are, culled ones included.
        reference: the keyframe that new frames are placed by.
    """

    @property
    def n_keyframes(self) -> int: ...
    @property
    def reference(self) -> int: ...

    def keyframe_pose(self, keyframe: int) -> Matrix:
        """``T_cw`` of a keyframe."""
        ...

    def unit_scale(self, keyframe: int) -> float:
        """Units of the map around a keyframe that were one when it was added: 1 in metric maps."""
        ...


@dataclass(frozen=True)
class FramePose:
    """One frame. ``unit_scale`` is that of the keyframe when ``T_c_reference`` was measured."""

    timestamp: float
    reference: int
    T_c_reference: Matrix
    tracked: bool
    unit_scale: float = 1.0


class FrameTable(NamedTuple):
    """The poses of N frames as arrays: the fields of ``FramePose``, ``T_c_reference``
    ``(N, 4, 4)``."""

    timestamp: NDArray[np.float64]
    reference: NDArray[np.int64]
    T_c_reference: NDArray[np.float64]
    tracked: NDArray[np.bool_]
    unit_scale: NDArray[np.float64]

    def until(self, frames: int) -> FrameTable:
        """The first ones."""
        return FrameTable._make(values[:frames] for values in self)


class FramePoses:
    """The poses of all frames, in order; those before the first keyframe are in the world."""

    def __init__(self, keyframes: KeyframePoses, before: FrameTable | None = None) -> None:
        """``before``: frames of the same drive that were placed already."""
        self._keyframes = keyframes
        self._frames: list[FramePose] = []
        if before is not None:
            self._frames = [
                FramePose(float(time), int(reference), T, bool(tracked), float(unit))
                for time, reference, T, tracked, unit in zip(*before, strict=True)
            ]

    def table(self) -> FrameTable:
        """All frames, for a file."""
        frames = self._frames
        return FrameTable(
            np.array([frame.timestamp for frame in frames], np.float64),
            np.array([frame.reference for frame in frames], np.int64),
            np.array([frame.T_c_reference for frame in frames], np.float64).reshape(-1, 4, 4),
            np.array([frame.tracked for frame in frames], np.bool_),
            np.array([frame.unit_scale for frame in frames], np.float64),
        )

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def unit(self) -> float:
        """``unit_scale`` of the reference keyframe, 1 before there is one."""
        keyframes = self._keyframes
        return keyframes.unit_scale(keyframes.reference) if keyframes.n_keyframes else 1.0

    def timestamp(self, index: int) -> float:
        """Seconds, of a frame; the last one is -1."""
        return self._frames[index].timestamp

    def append(self, timestamp: float, T_cw: Matrix, *, tracked: bool) -> None:
        """Place the next frame.

        Args:
            tracked: False for a pose that is only predicted.
        """
        self._frames.append(self._placed(timestamp, T_cw, tracked))

    def replace(self, index: int, keyframe: int) -> None:
        """A frame has become a keyframe: from now on it is where that is."""
        unit = self._keyframes.unit_scale(keyframe)
        timestamp = self._frames[index].timestamp
        self._frames[index] = FramePose(timestamp, keyframe, np.eye(4), True, unit)

    def follow_reference(self, index: int, T_cw: Matrix) -> None:
        """The reference keyframe is another one: from now on a frame at ``T_cw`` follows that."""
        frame = self._frames[index]
        self._frames[index] = self._placed(frame.timestamp, T_cw, frame.tracked)

    def _placed(self, timestamp: float, T_cw: Matrix, tracked: bool) -> FramePose:
        keyframes = self._keyframes
        reference = keyframes.reference
        T_rw = keyframes.keyframe_pose(reference) if keyframes.n_keyframes else np.eye(4)
        relative = orthonormalised(T_cw @ inverse(T_rw))
        return FramePose(timestamp, reference, relative, tracked, self.unit)

    def pose(self, index: int) -> Matrix:
        """``T_cw`` of a frame as its keyframe is placed now; the last one is -1."""
        frame = self._frames[index]
        T_c_reference = frame.T_c_reference
        if self._keyframes.n_keyframes == 0:
            return T_c_reference
        unit = self._keyframes.unit_scale(frame.reference)
        if unit != frame.unit_scale:
            T_c_reference = T_c_reference.copy()
            T_c_reference[:3, 3] *= unit / frame.unit_scale
        return T_c_reference @ self._keyframes.keyframe_pose(frame.reference)

    def trajectory(self) -> Trajectory:
        """Pose of every frame, those that were only predicted interpolated between the frames
        tracked before and after; those before the first one tracked stand where that is."""
        times = np.array([frame.timestamp for frame in self._frames], np.float64)
        poses = [inverse(self.pose(k)) for k in range(len(self._frames))]
        tracked = np.array([frame.tracked for frame in self._frames], np.bool_)
        T_wc = np.array(poses, np.float64).reshape(-1, 4, 4)
        if tracked.any():
            first = int(np.argmax(tracked))
            T_wc[:first] = T_wc[first]
        return bridge_gaps(Trajectory(times, T_wc), tracked)
