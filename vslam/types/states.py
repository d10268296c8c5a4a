"""The state of each part of SLAM between two frames, apart from the map.

A run that continues from all these states and the map produces results that are byte-identical to
the results of an uninterrupted run.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vslam.types.features import Features, FramePatches, KeyframePatches
from vslam.types.geometry import Matrix
from vslam.types.imu import Inertia
from vslam.types.loops import LoopEdge, ResembledPlace
from vslam.types.odometry import OdometryState


@dataclass(frozen=True)
class Standstill:
    """Where N landmarks were in the image when the camera came to rest.

    Attributes:
        T_cw: ``(4, 4)`` pose of the camera (world to camera).
        ids: ``(N,)`` int32 ids of the landmarks, sorted.
        xy: ``(N, 2)`` float32 positions in pixels.
        n_keyframes: number of keyframes of the map at that time. A new keyframe may change the ids.
    """

    T_cw: Matrix
    ids: NDArray[np.int32]
    xy: NDArray[np.float32]
    n_keyframes: int

    def flow(
        self, ids: NDArray[np.int32], xy: NDArray[np.float32]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        """Compute how far landmarks have moved in the image.

        Args:
            ids, xy: ``(M,)`` landmarks, and ``(M, 2)`` positions in pixels where they are seen now.

        Returns:
            ``(M,)`` bool, whether a landmark was seen when the camera came to rest, and ``(M, 2)``
            pixels. The motion of a landmark that was not seen then has no meaning.
        """
        if not len(self.ids):
            return np.zeros(len(ids), np.bool_), np.zeros((len(ids), 2), np.float32)
        at = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return self.ids[at] == ids, xy - self.xy[at]


@dataclass(frozen=True)
class TrackerState:
    """State of the tracker.

    Attributes:
        index, timestamp: index and time (seconds) of the last tracked frame.
        features: the N features of this frame.
        landmark: ``(N,)`` int32, the landmark that each feature observes, or -1.
        T_cw: ``(4, 4)`` pose of this frame.
        twist: ``(6,)`` twist of the camera per second at this frame. None if it is unknown.
        lost_frames: number of lost frames since this frame.
        n_tracked: number of landmarks that the frame tracked.
        coarse: ``(Q,)`` uint8 pixels of the small images of the frame (``coarse_levels``). The
            array is empty if the frame has no such images.
        standstill: what the camera saw when it came to rest. None if the camera moves.
    """

    index: int
    timestamp: float
    features: Features
    landmark: NDArray[np.int32]
    T_cw: Matrix
    twist: Matrix | None
    lost_frames: int
    n_tracked: int
    coarse: NDArray[np.uint8] = field(default_factory=lambda: np.empty(0, np.uint8))
    standstill: Standstill | None = None


@dataclass(frozen=True)
class MapperState:
    """State of the mapper.

    Attributes:
        reference: the keyframe that frames are tracked against. The poses of frames are relative to
            it.
        last_frame, last_timestamp: index and time (seconds) of the frame that became the last
            keyframe.
        patches: image patches of the newest keyframes, oldest first.
        known_place: image patches of the last frame at which an existing keyframe was used instead
            of inserting a new one; None if a keyframe has been inserted since then.
    """

    reference: int
    last_frame: int
    last_timestamp: float
    patches: tuple[KeyframePatches, ...]
    known_place: FramePatches | None = None


@dataclass(frozen=True)
class PolicyState:
    """State of the keyframe policy.

    Attributes:
        gained_close: number of close points that the first frame after a keyframe tracks, as a
            running mean over keyframes.
        gain_awaited: whether the next frame is the first frame after a keyframe.
        first_close: number of close points that the first frame after the last keyframe tracked.
        first_frame: index of the first frame after the last keyframe. It is -1 before the first
            keyframe.
        due: index of the frame that is planned to become a keyframe. It is -1 if no keyframe is
            planned.
    """

    gained_close: float
    gain_awaited: bool
    first_close: int = 0
    first_frame: int = -1
    due: int = -1


@dataclass(frozen=True)
class ConsistencyState:
    """State of the consistency test of loop candidates.

    Attributes:
        places: places in the map that recent keyframes resembled.
        verified: verified loops that are waiting to be confirmed by another keyframe. Each loop is
            stored with the value of ``turn`` at its keyframe.
        turn: number of keyframes that have been tested so far.
    """

    places: tuple[ResembledPlace, ...] = ()
    verified: tuple[tuple[int, LoopEdge], ...] = ()
    turn: int = 0


@dataclass(frozen=True)
class VerifierState:
    """State of the verifier of loop candidates.

    The state describes the last failed verification using learned descriptors.

    Attributes:
        resting_until: before this keyframe, learned descriptors are tried only for candidates that
            are clearly more similar than the failed one.
        failed_similarity: similarity of the two images for which this verification failed.
    """

    resting_until: int = 0
    failed_similarity: float = 0.0


@dataclass(frozen=True)
class ClosingState:
    """State of loop closing.

    Attributes:
        consistency, verifier: the states of the consistency test and of the verifier.
        followed: how many times an old keyframe was reused instead of inserting a new keyframe.
        new_revisits: number of revisits since the last global bundle adjustment began.
    """

    consistency: ConsistencyState = field(default_factory=ConsistencyState)
    verifier: VerifierState = field(default_factory=VerifierState)
    followed: int = 0
    new_revisits: int = 0


@dataclass(frozen=True)
class ComparedSides:
    """A summary of the differences in exposure of all stereo pairs of a drive.

    Attributes:
        n: number of stereo pairs.
        n_black_left, n_black_right: number of stereo pairs whose left or right image was black.
        darker_stops: all values of ``Sides.darker_stops`` that are not 0.
    """

    n: int = 0
    n_black_left: int = 0
    n_black_right: int = 0
    darker_stops: tuple[float, ...] = ()


@dataclass(frozen=True)
class Checkpoint:
    """The states of all parts of SLAM between two frames."""

    tracker: TrackerState
    mapper: MapperState
    policy: PolicyState
    closing: ClosingState
    sides: ComparedSides = field(default_factory=ComparedSides)
    odometry: OdometryState = field(default_factory=OdometryState)
    inertia: Inertia = field(default_factory=Inertia)
