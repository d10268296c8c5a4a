"""The state of each part of SLAM between two frames, apart from the map.

A run that continues from all these states and the map produces results that are byte-identical to
the results of an uninterrupted run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vslam.types.features import FramePatches, KeyframePatches
from vslam.types.geometry import Matrix
from vslam.types.imu import Inertia
from vslam.types.loops import LoopEdge, ResembledPlace
from vslam.types.odometry import OdometryState
from vslam.types.track import Track


@dataclass(frozen=True)
class MotionState:
    """State of the motion of the camera.

    Attributes:
        odometry: the pose that drifts but never jumps, and its uncertainty.
        lost_frames: number of frames that have been lost since the last one was tracked.
        inertia: what is known from the IMU.
    """

    odometry: OdometryState = field(default_factory=OdometryState)
    lost_frames: int = 0
    inertia: Inertia = field(default_factory=Inertia)


@dataclass(frozen=True)
class FrameObservations:
    """What a frame of a monocular camera observed, from which its pose is found again when the map
    has been adjusted.

    Attributes:
        index: index of the frame.
        n_keyframes: number of keyframes of the map when the frame was tracked.
        keyframe, T_c_keyframe, unit_scale: the pose as it was tracked (``RelativePose``).
        landmark: ``(N,)`` int32 ids of the landmarks; -1 if culled.
        xy: ``(N, 2)`` float32 positions where they were observed, in pixels.
        sigma: ``(N,)`` float32 standard deviations of these positions, in pixels.
    """

    index: int
    n_keyframes: int
    keyframe: int
    T_c_keyframe: Matrix
    unit_scale: float
    landmark: NDArray[np.int32]
    xy: NDArray[np.float32]
    sigma: NDArray[np.float32]

    def observing(self, landmark: NDArray[np.int32]) -> FrameObservations:
        """Return the observations with ``(N,)`` new ids of the landmarks."""
        return replace(self, landmark=landmark.astype(np.int32))


@dataclass(frozen=True)
class PublishedState:
    """State of the published map, apart from the map.

    Attributes:
        reference: the keyframe that frames are tracked against. The poses of frames are relative to
            it.
        last_frame, last_timestamp: index and time (seconds) of the frame that became the last
            keyframe.
        patches: image patches of the newest keyframes, oldest first.
        known_place: image patches of the last frame at which an existing keyframe was used instead
            of inserting a new one; None if a keyframe has been inserted since then.
        recent: what the newest frames of a monocular camera observed, in the order of time.
    """

    reference: int
    last_frame: int = -1
    last_timestamp: float = -math.inf
    patches: tuple[KeyframePatches, ...] = ()
    known_place: FramePatches | None = None
    recent: tuple[FrameObservations, ...] = ()


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
    """The states of all parts of SLAM between two frames.

    Attributes:
        last: the last frame that was tracked.
        motion, published, policy, closing: the state of each part.
        sides: a summary of the differences in exposure of the stereo pairs.
    """

    last: Track
    motion: MotionState
    published: PublishedState
    policy: PolicyState
    closing: ClosingState = field(default_factory=ClosingState)
    sides: ComparedSides = field(default_factory=ComparedSides)
