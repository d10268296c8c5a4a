"""A frame: the features of an image, where it was taken from, and what of the map it sees."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NewType

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
from vslam.features import Extracted, FeatureGrid, Features, Pyramid, Side
from vslam.geometry import Matrix, inverse


@dataclass
class Frame:
    """A frame being tracked.

    "The camera" is the one that took the image of the features: as a rule the left one, and the
    right one if the left image is black. The pose of the frame is always that of the left camera.

    Attributes:
        index: number of the frame in the run, from 0.
        timestamp: seconds.
        image: ``(H, W)`` uint8 image of the camera, for loop detectors that look at it, or None.
        features, grid: N features of that image.
        pyramid, row_offset, side: see ``Extracted``.
        T_camera_left: ``(4, 4)`` the left camera in the camera: the identity, or
            ``Camera.T_right_left``.
        T_cw: ``(4, 4)`` pose estimate of the left camera.
        landmark: ``(N,)`` int32, landmark that each feature tracks, or -1.
        xyz: ``(N, 3)`` float64, its position; NaN without one.
        disparity_offset, delay_removed: what the disparities of the features were corrected by:
            the pixels added to each, and whether the delay of the right image was removed
            (``RigCalibration``).
        shift: ``(N, 2)`` float32, pixels from each feature to where its match was aligned, NaN for
            those that were not; None if none was.
        twist: ``(6,)`` speed of the camera when the frame was tracked, per second; None if unknown.
    """

    index: int
    timestamp: float
    image: NDArray[np.uint8] | None
    features: Features
    grid: FeatureGrid
    pyramid: Pyramid | None
    row_offset: NDArray[np.float32] | None
    side: Side
    T_camera_left: NDArray[np.float64]
    T_cw: NDArray[np.float64]
    landmark: NDArray[np.int32]
    xyz: NDArray[np.float64]
    disparity_offset: float = 0.0
    delay_removed: bool = False
    shift: NDArray[np.float32] | None = None
    twist: Matrix | None = None

    @classmethod
    def of(
        cls,
        extracted: Extracted,
        camera: Camera,
        index: int = 0,
        timestamp: float = 0.0,
        image: NDArray[np.uint8] | None = None,
    ) -> Frame:
        """A frame that is not tracked yet: nothing is known but what its images gave."""
        features, n = extracted.features, len(extracted.features)
        return cls(
            index=index,
            timestamp=timestamp,
            image=image,
            features=features,
            grid=FeatureGrid.of_positions(features.xy, camera.width, camera.height),
            pyramid=extracted.pyramid,
            row_offset=extracted.row_offset,
            side=extracted.side,
            T_camera_left=camera.T_right_left if extracted.side == Side.RIGHT else np.eye(4),
            T_cw=np.eye(4),
            landmark=np.full(n, -1, np.int32),
            xyz=np.full((n, 3), np.nan),
        )

    @property
    def T_camera_w(self) -> Matrix:
        """``(4, 4)`` pose of the camera, by which landmarks are projected to the features."""
        T: Matrix = self.T_camera_left @ self.T_cw
        return T

    def snapshot(self) -> Frame:
        """A copy that keeps what the frame tracks now."""
        return replace(self, landmark=self.landmark.copy(), xyz=self.xyz.copy())

    def restore(self, snapshot: Frame) -> None:
        """Track again what the frame tracked when the snapshot was taken."""
        self.T_cw, self.shift = snapshot.T_cw, snapshot.shift
        self.landmark, self.xyz = snapshot.landmark, snapshot.xyz

    def set_camera_pose(self, T_camera_w: Matrix) -> None:
        """Set the pose of the frame from the ``(4, 4)`` pose of the camera."""
        self.T_cw = inverse(self.T_camera_left) @ T_camera_w

    @property
    def can_become_keyframe(self) -> bool:
        """Whether the frame can join the map, which is made of left images."""
        return self.side == Side.LEFT

    @property
    def aligned(self) -> NDArray[np.bool_]:
        """``(N,)`` features whose match was aligned."""
        if self.shift is None:
            return np.zeros(len(self.features), np.bool_)
        return (self.landmark >= 0) & np.isfinite(self.shift[:, 0])

    def refined_features(self) -> Features:
        """The features at their aligned positions; disparities are unchanged."""
        aligned = self.aligned
        if self.shift is None or not aligned.any():
            return self.features
        xy, u_right = self.features.xy.copy(), self.features.u_right.copy()
        xy[aligned] += self.shift[aligned]
        u_right[aligned] += self.shift[aligned, 0]
        return replace(self.features, xy=xy, u_right=u_right)

    @property
    def n_stereo(self) -> int:
        """Features with a stereo match."""
        return int(np.count_nonzero(np.isfinite(self.features.u_right)))


PlacedFrame = NewType("PlacedFrame", Frame)
"""A frame whose pose has been recorded (``Mapper.append_pose``). Only such a frame can become a
keyframe."""
