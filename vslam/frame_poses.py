"""The pose of every frame of a run, relative to a keyframe: where that moves, it follows."""

from __future__ import annotations

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


class FrameTable(NamedTuple):
    """The poses of N frames. ``unit_scale`` (N,) f8 is that of the keyframe ``reference`` (N,) i8
    when ``T_c_reference`` (N, 4, 4) f8 was measured; ``timestamp`` (N,) f8 seconds; ``tracked``
    (N,) bool: not only predicted."""

    timestamp: NDArray[np.float64]
    reference: NDArray[np.int64]
    T_c_reference: NDArray[np.float64]
    tracked: NDArray[np.bool_]
    unit_scale: NDArray[np.float64]

    def until(self, frames: int) -> FrameTable:
        """The first ones."""
        return FrameTable._make(values[:frames] for values in self)


def _room_for(frames: int) -> FrameTable:
    return FrameTable(
        np.zeros(frames),
        np.zeros(frames, np.int64),
        np.zeros((frames, 4, 4)),
        np.zeros(frames, np.bool_),
        np.ones(frames),
    )


class FramePoses:
    """The poses of all frames, in order; those before the first keyframe are in the world."""

    def __init__(self, keyframes: KeyframePoses, before: FrameTable | None = None) -> None:
        """``before``: frames of the same drive that were placed already."""
        self._keyframes = keyframes
        self._n = 0 if before is None else len(before.timestamp)
        self._frames = _room_for(max(1024, self._n))
        if before is not None:
            self._copy(before)

    def _copy(self, frames: FrameTable) -> None:
        for mine, values in zip(self._frames, frames, strict=True):
            mine[: len(values)] = values

    def table(self) -> FrameTable:
        """A copy of all frames."""
        return FrameTable._make(values.copy() for values in self._frames.until(self._n))

    def __len__(self) -> int:
        return self._n

    @property
    def unit(self) -> float:
        """``unit_scale`` of the reference keyframe, 1 before there is one."""
        keyframes = self._keyframes
        return keyframes.unit_scale(keyframes.reference) if keyframes.n_keyframes else 1.0

    def timestamp(self, index: int) -> float:
        """Seconds, of a frame; the last one is -1."""
        return float(self._frames.timestamp[self._number(index)])

    def append(self, timestamp: float, T_cw: Matrix, *, tracked: bool) -> None:
        """Place the next frame.

        Args:
            tracked: False for a pose that is only predicted.
        """
        if self._n == len(self._frames.timestamp):
            frames, self._frames = self._frames, _room_for(self._n + self._n // 2)
            self._copy(frames)
        self._n += 1
        self._frames.timestamp[self._n - 1] = timestamp
        self._frames.tracked[self._n - 1] = tracked
        self.follow_reference(self._n - 1, T_cw)

    def replace(self, index: int, keyframe: int) -> None:
        """A frame has become a keyframe: from now on it is where that is."""
        unit = self._keyframes.unit_scale(keyframe)
        self._frames.tracked[self._number(index)] = True
        self._set(index, keyframe, np.eye(4), unit)

    def follow_reference(self, index: int, T_cw: Matrix) -> None:
        """The reference keyframe is another one: from now on a frame at ``T_cw`` follows that."""
        keyframes = self._keyframes
        reference = keyframes.reference
        T_rw = keyframes.keyframe_pose(reference) if keyframes.n_keyframes else np.eye(4)
        self._set(index, reference, orthonormalised(T_cw @ inverse(T_rw)), self.unit)

    def _set(self, index: int, reference: int, T_c_reference: Matrix, unit: float) -> None:
        index = self._number(index)
        self._frames.reference[index] = reference
        self._frames.T_c_reference[index] = T_c_reference
        self._frames.unit_scale[index] = unit

    def _number(self, index: int) -> int:
        if not -self._n <= index < self._n:
            raise IndexError(f"frame {index} of {self._n}")
        return index % self._n

    def pose(self, index: int) -> Matrix:
        """``T_cw`` of a frame as its keyframe is placed now; the last one is -1."""
        index = self._number(index)
        T_c_reference = self._frames.T_c_reference[index].copy()
        if self._keyframes.n_keyframes == 0:
            return T_c_reference
        reference = int(self._frames.reference[index])
        unit, measured = self._keyframes.unit_scale(reference), self._frames.unit_scale[index]
        if unit != measured:
            T_c_reference[:3, 3] *= unit / measured
        return T_c_reference @ self._keyframes.keyframe_pose(reference)

    def trajectory(self) -> Trajectory:
        """Pose of every frame, those that were only predicted interpolated between the frames
        tracked before and after; those before the first one tracked stand where that is."""
        frames = self._frames.until(self._n)
        poses = [inverse(self.pose(k)) for k in range(self._n)]
        T_wc = np.array(poses, np.float64).reshape(-1, 4, 4)
        if frames.tracked.any():
            first = int(np.argmax(frames.tracked))
            T_wc[:first] = T_wc[first]
        return bridge_gaps(Trajectory(frames.timestamp.copy(), T_wc), frames.tracked.copy())
