"""What each part of SLAM remembers between two frames besides the map.

Every part gives its state by ``state()`` and takes it back by ``restore(state)``. With all of them
and the map as it was, a run continues to the byte as if it had not stopped.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vslam.features import Features, KeyframePatches
from vslam.geometry import Matrix
from vslam.loops import LoopEdge, ResembledPlace


@dataclass(frozen=True)
class TrackerState:
    """Of the tracker.

    Attributes:
        index, timestamp: of the last frame tracked.
        features: its N features.
        landmark: ``(N,)`` int32, the landmark that each of them tracks, or -1.
        T_cw: ``(4, 4)`` its pose.
        twist: ``(6,)`` the speed of the camera then, per second; None if unknown.
        lost_frames: since the last frame tracked.
        n_tracked: landmarks that it tracked at the time.
    """

    index: int
    timestamp: float
    features: Features
    landmark: NDArray[np.int32]
    T_cw: Matrix
    twist: Matrix | None
    lost_frames: int
    n_tracked: int


@dataclass(frozen=True)
class MapperState:
    """Of the mapper.

    Attributes:
        reference: the keyframe that frames are tracked against and placed by.
        last_frame, last_timestamp: index and seconds of the frame that became the last keyframe.
        patches: of the newest keyframes, oldest first.
    """

    reference: int
    last_frame: int
    last_timestamp: float
    patches: tuple[KeyframePatches, ...]


@dataclass(frozen=True)
class PolicyState:
    """Of the keyframe policy.

    Attributes:
        gained_close: close points that the first frame after a keyframe tracks, on average.
        gain_awaited: whether the next frame is such a frame.
    """

    gained_close: float
    gain_awaited: bool


@dataclass(frozen=True)
class ConsistencyState:
    """Of the consistency test of loop candidates.

    Attributes:
        places: that recent keyframes resembled.
        verified: loops that wait for others to agree, each with the ``turn`` of its keyframe.
        turn: keyframes asked about so far.
    """

    places: tuple[ResembledPlace, ...] = ()
    verified: tuple[tuple[int, LoopEdge], ...] = ()
    turn: int = 0


@dataclass(frozen=True)
class VerifierState:
    """Of the verifier of loop candidates: its last failed attempt by learned descriptors.

    Attributes:
        resting_until: before this keyframe, only clearly more alike candidates are tried.
        in_vain: how alike the images of the failed attempt were.
    """

    resting_until: int = 0
    in_vain: float = 0.0


@dataclass(frozen=True)
class ClosingState:
    """Of loop closing.

    Attributes:
        consistency, verifier: the states of its parts.
        followed: times that an old keyframe served instead of a new one.
    """

    consistency: ConsistencyState = field(default_factory=ConsistencyState)
    verifier: VerifierState = field(default_factory=VerifierState)
    followed: int = 0


@dataclass(frozen=True)
class Checkpoint:
    """The states of all parts.

    Attributes:
        rig: what was learned of the delay between the sides (``SideDelay``).
    """

    tracker: TrackerState
    mapper: MapperState
    policy: PolicyState
    closing: ClosingState
    rig: tuple[float, ...] = ()
