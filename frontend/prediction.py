"""What is known about a frame before its images are tracked."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vslam.frontend.motion_time import motion_seconds
from vslam.types.geometry import Matrix
from vslam.types.imu import InertialState
from vslam.types.loops import LastSeen
from vslam.types.map_view import MapView
from vslam.types.track import Standstill, Track


@dataclass(frozen=True, eq=False)
class Prediction:
    """What is known about a frame before its images are tracked.

    Attributes:
        index, timestamp: of the frame.
        T_cw: ``(4, 4)`` predicted pose (world to camera).
        twist: ``(6,)`` velocity with which the pose was predicted, see ``Track.twist``; None if it
            is unknown. The pose is then that of the frame before.
        last: the last frame that was tracked; None if no frame has been tracked.
        lost_frames: number of frames that have been lost since the last one was tracked.
        is_resumed: whether the camera continues from the end of an earlier drive.
        seconds: duration of the motion since the frame before (``motion_seconds``).
        times: ``(N,)`` timestamps of the frames before, in seconds (at most ``RECENT``).
        inertial: the state of the IMU from which the pose was predicted; None if it was predicted
            with constant velocity.
    """

    index: int
    timestamp: float
    T_cw: Matrix
    twist: Matrix | None = None
    last: Track | None = None
    lost_frames: int = 0
    is_resumed: bool = False
    seconds: float = 0.0
    times: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    inertial: InertialState | None = None

    @property
    def interval(self) -> float:
        """Duration of the motion between the last two frames before; 0 if it is unknown."""
        return motion_seconds(self.times) if len(self.times) > 1 else 0.0

    @property
    def is_tracking(self) -> bool:
        """Whether the frame before was tracked."""
        return self.last is not None and self.lost_frames == 0

    @property
    def lost(self) -> Track:
        """The frame, if it cannot be tracked."""
        return Track(self.index, self.timestamp, self.T_cw, twist=self.twist)

    def standstill(self, view: MapView) -> Standstill | None:
        """Return where the camera came to rest; None if it moves, or if the ids of landmarks may
        have changed since."""
        still = None if self.last is None else self.last.still
        return still if still is not None and still.n_keyframes == view.n_keyframes else None

    def last_seen(self, view: MapView) -> LastSeen | None:
        """Return where the camera was last tracked, and how long ago that was; None if it has not
        been tracked yet."""
        if self.last is None:
            return None
        return LastSeen(view.reference, self.timestamp - self.last.timestamp)
