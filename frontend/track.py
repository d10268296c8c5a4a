"""What is known about a frame: before its images are tracked, and afterwards."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vslam.frontend.masks import Mask
from vslam.frontend.motion_time import motion_seconds
from vslam.frontend.sides import Sides
from vslam.types.camera import Image
from vslam.types.features import Extracted, Features, Keypoints, Pyramid, TrackingState
from vslam.types.geometry import Matrix
from vslam.types.imu import InertialState
from vslam.types.loops import LastSeen
from vslam.types.map_view import MapView
from vslam.types.states import Standstill


class Images(Protocol):
    """The images of a frame, whose features are extracted when they are first needed.

    Attributes:
        pyramid: the pyramid of the left image. None if frames are not tracked by patches.
        coarse: the small images of the frame (``coarse_levels``). None if ``pyramid`` is None.
        mask: the mask of the left image. None if all pixels are used.
        sides: result of comparing the exposure of the left and the right image. None if there is no
            right image, or if it has not been read.
        problem: why the second image could not be read. None if there was no such problem.
    """

    pyramid: Pyramid | None
    coarse: Pyramid | None
    mask: Mask | None
    sides: Sides | None
    problem: str | None

    @property
    def extracted(self) -> Extracted:
        """The features of the frame."""
        ...

    def extracted_with(self, keypoints: Keypoints) -> Extracted:
        """Return the features of the frame, and additional features at the given positions and
        pyramid levels of the left image."""
        ...

    @property
    def image(self) -> Image | None:
        """The ``(H, W)`` uint8 left image for loop detectors. None if it is not available."""
        ...


@dataclass
class GivenFeatures:
    """The images of a frame whose features were extracted in advance (``Images``)."""

    extracted: Extracted
    image: Image | None = None
    pyramid: Pyramid | None = None
    coarse: Pyramid | None = None
    mask: Mask | None = None
    sides: Sides | None = None
    problem: str | None = None

    def extracted_with(self, keypoints: Keypoints) -> Extracted:
        return self.extracted


class By(StrEnum):
    """How the pose of a frame was found."""

    PREDICTION = "prediction"
    """The pose was predicted with constant velocity. The frame is lost or was dropped."""
    INERTIA = "inertia"
    """The pose was predicted from the samples of the IMU."""
    PATCHES = "patches"
    """Image patches of landmarks were found in the image. No features were extracted."""
    STANDSTILL = "standstill"
    """The same, and the camera stands still."""
    FEATURES = "features"
    """Features were matched near a predicted pose, or with the reference keyframe."""
    PLACE = "place"
    """The frame was relocalised: a similar keyframe was found in the whole map."""


def _no_ids() -> NDArray[np.int32]:
    return np.empty(0, np.int32)


@dataclass(frozen=True, eq=False)
class Track:
    """A frame that was tracked or is lost. Its N features observe landmarks.

    Nothing writes into a track or its arrays. A step of tracking returns a new track.

    Attributes:
        index: index of the frame in the drive.
        timestamp: seconds.
        T_cw: ``(4, 4)`` pose (world to camera).
        extracted: the features. If the frame was tracked by patches, there is one feature for each
            landmark whose patch was found, without a column in the right image.
        landmark: ``(N,)`` int32, id of the landmark that each feature observes, or -1.
        xyz: ``(N, 3)`` float64 position of this landmark in the world frame, in metres; NaN if the
            feature observes none.
        shift: ``(N, 2)`` float32 offset from each feature to its aligned position, in pixels; NaN
            where the match was not aligned. None if no match was aligned.
        state: how the frame was tracked.
        by: how the pose was found.
        near: id of the keyframe at which the frame was relocalised; -1 if it was not relocalised.
        n_matches, n_inliers: number of matched landmarks before and after the last pose
            optimisation.
        visible: ``(V,)`` int32 ids of the landmarks that the frame should see.
        is_doubtful: whether there are so few inliers that the matches may be wrong.
        support: see ``TrackResult``.
        twist: ``(6,)`` velocity of the camera, as a twist per second; None if unknown.
            ``exp(twist dt)`` maps points from the camera frame at one time to the camera frame dt
            seconds later. If the frame is lost, the velocity with which its pose was predicted.
        still: where the camera came to rest; None if it moves.
        coarse: the small images of the frame (``coarse_levels``), to which the next frame is
            aligned; None if frames are not aligned.
        is_keyframe: whether the frame became a keyframe.
    """

    index: int
    timestamp: float
    T_cw: Matrix
    extracted: Extracted = field(default_factory=Extracted.nothing)
    landmark: NDArray[np.int32] = field(default_factory=_no_ids)
    xyz: Matrix = field(default_factory=lambda: np.empty((0, 3)))
    shift: NDArray[np.float32] | None = None
    state: TrackingState = TrackingState.LOST
    by: By = By.PREDICTION
    near: int = -1
    n_matches: int = 0
    n_inliers: int = 0
    visible: NDArray[np.int32] = field(default_factory=_no_ids)
    is_doubtful: bool = False
    support: float | None = None
    twist: Matrix | None = None
    still: Standstill | None = None
    coarse: Pyramid | None = None
    is_keyframe: bool = False

    @property
    def features(self) -> Features:
        """The N features."""
        return self.extracted.features

    @property
    def is_lost(self) -> bool:
        """Whether the pose was only predicted."""
        return self.state in (TrackingState.LOST, TrackingState.INERTIAL, TrackingState.DROPPED)

    @property
    def by_patches(self) -> bool:
        """Whether the frame was tracked by patches, so that no features were extracted."""
        return self.by in (By.PATCHES, By.STANDSTILL)

    @property
    def tracked(self) -> NDArray[np.int32]:
        """``(M,)`` int32 ids of the landmarks that the features observe."""
        return self.landmark[self.landmark >= 0]

    @property
    def n_stereo(self) -> int:
        """Number of features with a stereo match, or with a depth in an RGB-D frame."""
        return int(np.count_nonzero(np.isfinite(self.features.u_right)))

    @property
    def aligned(self) -> NDArray[np.bool_]:
        """``(N,)`` bool, True for features whose match was aligned with sub-pixel accuracy."""
        if self.shift is None:
            return np.zeros(len(self.features), np.bool_)
        return (self.landmark >= 0) & np.isfinite(self.shift[:, 0])

    def refined_features(self) -> Features:
        """Return the features, moved to their aligned positions. Disparities are unchanged."""
        aligned = self.aligned
        if self.shift is None or not aligned.any():
            return self.features
        xy, u_right = self.features.xy.copy(), self.features.u_right.copy()
        xy[aligned] += self.shift[aligned]
        u_right[aligned] += self.shift[aligned, 0]
        return replace(self.features, xy=xy, u_right=u_right)

    def with_features(self, extracted: Extracted) -> Track:
        """Return the frame with other features, which do not observe landmarks yet."""
        n = len(extracted.features)
        nothing, nowhere = np.full(n, -1, np.int32), np.full((n, 3), np.nan)
        return replace(self, extracted=extracted, landmark=nothing, xyz=nowhere, shift=None)

    def matching(
        self, features: NDArray[np.integer], landmarks: NDArray[np.int32], xyz: Matrix
    ) -> Track:
        """Return the frame, in which ``(M,)`` features also observe landmarks with the given ids
        and ``(M, 3)`` positions."""
        landmark, positions = self.landmark.copy(), self.xyz.copy()
        landmark[features], positions[features] = landmarks, xyz
        return replace(self, landmark=landmark, xyz=positions)

    def without(
        self, features: NDArray[np.integer] | NDArray[np.bool_] | slice = slice(None)
    ) -> Track:
        """Return the frame without the matches of the given features; by default, of all."""
        landmark, xyz = self.landmark.copy(), self.xyz.copy()
        landmark[features], xyz[features] = -1, np.nan
        return replace(self, landmark=landmark, xyz=xyz)


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
