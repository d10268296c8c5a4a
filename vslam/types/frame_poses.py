"""The pose of every frame relative to a keyframe.

When the pose of a keyframe is corrected, the frames whose poses are relative to this keyframe move
with it.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from vslam.types.geometry import Matrix, inverse, orthonormalised
from vslam.types.trajectory import Trajectory, bridge_gaps


class KeyframePoses(Protocol):
    """The current poses of the keyframes, to which the poses of frames are relative.

    Attributes:
        n_keyframes: number of keyframes, including culled keyframes.
        reference: the keyframe that the poses of new frames are relative to.
    """

    @property
    def n_keyframes(self) -> int: ...
    @property
    def reference(self) -> int: ...

    def keyframe(self, keyframe: int) -> tuple[Matrix, float]:
        """Return the pose ``T_cw`` of a keyframe, and the factor by which loop closures have scaled
        lengths near it. The factor is 1 in metric maps."""
        ...


class FrameTable(NamedTuple):
    """The poses of N frames.

    Attributes:
        timestamp: ``(N,)`` float64 seconds.
        reference: ``(N,)`` int64, the keyframe that each pose is relative to.
        T_c_reference: ``(N, 4, 4)`` float64, maps points from the camera of the keyframe to the
            camera of the frame.
        tracked: ``(N,)`` bool, False where the pose is only predicted.
        unit_scale: ``(N,)`` float64, the factor of the keyframe (``KeyframePoses.keyframe``) at the
            time when ``T_c_reference`` was measured.
        carried: ``(N,)`` bool, True where the images gave no pose, and an IMU measured it.
    """

    timestamp: NDArray[np.float64]
    reference: NDArray[np.int64]
    T_c_reference: NDArray[np.float64]
    tracked: NDArray[np.bool_]
    unit_scale: NDArray[np.float64]
    carried: NDArray[np.bool_]

    @property
    def known(self) -> NDArray[np.bool_]:
        """``(N,)`` bool, True where the pose was measured by the images or by an IMU."""
        return self.tracked | self.carried

    def until(self, frames: int) -> FrameTable:
        """Return the poses of the first ``frames`` frames."""
        return FrameTable._make(values[:frames] for values in self)


class RelativePose(NamedTuple):
    """The pose of a frame relative to a keyframe.

    Attributes:
        keyframe: id of the keyframe.
        T_c_keyframe, unit_scale: see ``FrameTable``.
    """

    keyframe: int
    T_c_keyframe: Matrix
    unit_scale: float


class PoseRun(NamedTuple):
    """The poses of N frames that were tracked one after the other.

    Attributes:
        times: ``(N,)`` float64 seconds.
        T_wc: ``(N, 4, 4)`` float64.
    """

    times: NDArray[np.float64]
    T_wc: NDArray[np.float64]


def _room_for(frames: int) -> FrameTable:
    return FrameTable(
        np.zeros(frames),
        np.zeros(frames, np.int64),
        np.zeros((frames, 4, 4)),
        np.zeros(frames, np.bool_),
        np.ones(frames),
        np.zeros(frames, np.bool_),
    )


class FramePoses:
    """The poses of all frames, in order, relative to keyframes.

    While there is no keyframe, poses are relative to the world.
    """

    def __init__(self, keyframes: KeyframePoses, before: FrameTable | None = None) -> None:
        """Begin an empty list of poses.

        Args:
            before: poses of the earlier frames of the same drive, which come first in the list.
        """
        self._keyframes = keyframes
        self._n = 0 if before is None else len(before.timestamp)
        self._frames = _room_for(max(1024, self._n))
        if before is not None:
            self._copy(before)

    def _copy(self, frames: FrameTable) -> None:
        for mine, values in zip(self._frames, frames, strict=True):
            mine[: len(values)] = values

    def table(self) -> FrameTable:
        """Return a copy of the poses of all frames."""
        return FrameTable._make(values.copy() for values in self._frames.until(self._n))

    def __len__(self) -> int:
        return self._n

    def timestamp(self, index: int) -> float:
        """Return the timestamp of a frame in seconds. Index -1 is the last frame."""
        return float(self._frames.timestamp[self._number(index)])

    def recent_timestamps(self, n: int) -> NDArray[np.float64]:
        """Return the timestamps of the last ``n`` frames, or of all frames if there are fewer."""
        return self._frames.timestamp[max(0, self._n - n) : self._n].copy()

    def append(
        self, timestamp: float, T_cw: Matrix, *, tracked: bool, carried: bool = False
    ) -> None:
        """Append the pose of the next frame.

        Args:
            timestamp: seconds.
            tracked: False for a pose that is only predicted.
            carried: whether an IMU measured a pose that is not tracked.
        """
        if self._n == len(self._frames.timestamp):
            frames, self._frames = self._frames, _room_for(self._n + self._n // 2)
            self._copy(frames)
        self._n += 1
        self._frames.timestamp[self._n - 1] = timestamp
        self._frames.tracked[self._n - 1] = tracked
        self._frames.carried[self._n - 1] = carried
        self.follow(self._n - 1, self._keyframes.reference, T_cw)

    def replace(self, index: int, keyframe: int) -> None:
        """Set the pose of a frame that became a keyframe to the pose of that keyframe."""
        _, unit = self._keyframes.keyframe(keyframe)
        self._frames.tracked[self._number(index)] = True
        self._frames.carried[self._number(index)] = False
        self._set(index, keyframe, np.eye(4), unit)

    def find(self, index: int, T_cw: Matrix, *, beside: int) -> None:
        """Store the pose ``T_cw`` of an earlier frame that had not been tracked. It is relative to
        the keyframe of the frame ``beside``."""
        self._frames.tracked[self._number(index)] = True
        self._frames.carried[self._number(index)] = False
        self.follow(index, int(self._frames.reference[self._number(beside)]), T_cw)

    def follow(self, index: int, keyframe: int, T_cw: Matrix) -> None:
        """Store the pose ``T_cw`` of a frame relative to a keyframe."""
        T_kw, unit = np.eye(4), 1.0
        if self._keyframes.n_keyframes:
            T_kw, unit = self._keyframes.keyframe(keyframe)
        self._set(index, keyframe, orthonormalised(T_cw @ inverse(T_kw)), unit)

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
        """Return the pose ``T_cw`` of a frame, computed from the current pose of its keyframe.

        Index -1 is the last frame.
        """
        return self.in_map(*self.relative(index))

    def relative(self, index: int) -> RelativePose:
        """Return the pose of a frame relative to its keyframe."""
        index, frames = self._number(index), self._frames
        return RelativePose(
            int(frames.reference[index]),
            frames.T_c_reference[index].copy(),
            float(frames.unit_scale[index]),
        )

    def in_map(self, keyframe: int, T_c_keyframe: Matrix, unit_scale: float) -> Matrix:
        """Compute the pose ``T_cw`` of a frame from its ``RelativePose``."""
        if self._keyframes.n_keyframes == 0:
            return T_c_keyframe
        T_kw, unit = self._keyframes.keyframe(keyframe)
        if unit != unit_scale:
            T_c_keyframe = T_c_keyframe.copy()
            T_c_keyframe[:3, 3] *= unit / unit_scale
        return T_c_keyframe @ T_kw

    def last_run(self, seconds: float, keyframe: int) -> PoseRun:
        """Return the poses of the frames that were tracked last, up to the newest frame, without a
        lost frame between them.

        Args:
            seconds: duration of the run, at most.
            keyframe: the poses of the frames are relative to this keyframe or a later one.
        """
        frames, end = self._frames, self._n
        begin = int(np.searchsorted(frames.timestamp[:end], frames.timestamp[end - 1] - seconds))
        usable = frames.tracked[begin:end] & (frames.reference[begin:end] >= keyframe)
        others = np.flatnonzero(~usable)
        begin += int(others[-1]) + 1 if len(others) else 0
        T_wc = np.array([inverse(self.pose(k)) for k in range(begin, end)]).reshape(-1, 4, 4)
        return PoseRun(frames.timestamp[begin:end].copy(), T_wc)

    def trajectory(self) -> Trajectory:
        """Return the pose of every frame.

        A predicted pose is replaced by an interpolation between the frames before and after it that
        were tracked or carried by an IMU. Frames before the first tracked frame get the pose of the
        first tracked frame.
        """
        frames = self._frames.until(self._n)
        poses = [inverse(self.pose(k)) for k in range(self._n)]
        T_wc = np.array(poses, np.float64).reshape(-1, 4, 4)
        return bridge_gaps(Trajectory(frames.timestamp.copy(), T_wc), frames.known)
