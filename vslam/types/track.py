"""A frame that was tracked or is lost."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from vslam.types.features import Extracted, Features, Pyramid, TrackingState
from vslam.types.geometry import Matrix
from vslam.types.imu import GravityDirection, InertialWindow


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
        inertial: what local bundle adjustment needs to know from the IMU; None if gravity is not
            known.
        gravity: direction of free fall in the frame of the camera; None if it is unknown.
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
    inertial: InertialWindow | None = None
    gravity: GravityDirection | None = None

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
