"""A frame: the features of an image, where it was taken from, and what of the map it sees."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
from vslam.features import FeatureGrid, Features
from vslam.geometry import Matrix
from vslam.image_motion import columns_without_delay


@dataclass
class Frame:
    """A frame being tracked.

    Attributes:
        index: number of the frame in the run, from 0.
        timestamp: seconds.
        image: ``(H, W)`` uint8 left image, for loop detectors that look at it, or None.
        features, grid: of the left image, or of the right one (``Features.from_right``).
        T_cw: ``(4, 4)`` pose estimate, of the left camera once the frame is tracked; while it is,
            of the camera that its features are of.
        landmark: ``(N,)`` int32, landmark that each feature tracks, or -1.
        xyz: ``(N, 3)`` float64, its position; NaN without one.
        disparity_offset: pixels that the disparities of the features were corrected by.
        shift: ``(N, 2)`` float32, pixels from each feature to where its match was aligned, NaN for
            those that were not; None if none was.
        twist: ``(6,)`` speed of the camera when the frame was tracked, per second; None if unknown.
    """

    index: int
    timestamp: float
    image: NDArray[np.uint8] | None
    features: Features
    grid: FeatureGrid
    T_cw: NDArray[np.float64]
    landmark: NDArray[np.int32]
    xyz: NDArray[np.float64]
    disparity_offset: float = 0.0
    shift: NDArray[np.float32] | None = None
    twist: Matrix | None = None

    @classmethod
    def untracked(
        cls,
        features: Features,
        camera: Camera,
        index: int = 0,
        timestamp: float = 0.0,
        image: NDArray[np.uint8] | None = None,
    ) -> Frame:
        """A frame of which nothing is known but its features."""
        n = len(features)
        return cls(
            index=index,
            timestamp=timestamp,
            image=image,
            features=features,
            grid=FeatureGrid.of_positions(features.xy, camera.width, camera.height),
            T_cw=np.eye(4),
            landmark=np.full(n, -1, np.int32),
            xyz=np.full((n, 3), np.nan),
        )

    def snapshot(self) -> Frame:
        """A copy that keeps what the frame tracks now."""
        return replace(self, landmark=self.landmark.copy(), xyz=self.xyz.copy())

    def restore(self, snapshot: Frame) -> None:
        """Track again what the frame tracked when the snapshot was taken."""
        self.T_cw, self.shift = snapshot.T_cw, snapshot.shift
        self.landmark, self.xyz = snapshot.landmark, snapshot.xyz

    def correct_disparities(self, offset: float) -> None:
        """Correct the features by the whole offset of the pair (``Map.disparity_offset``)."""
        if offset != self.disparity_offset:
            change = offset - self.disparity_offset
            self.features = self.features.with_larger_disparities(change)
            self.disparity_offset = offset

    def take_out_right_delay(self, twist: Matrix | None, camera: Camera) -> None:
        """Move the features' columns in the right image to where they were when the left image was
        taken (``Camera.right_delay``). Call it once; without a known motion nothing changes.

        Args:
            twist: ``(6,)`` how points move past the camera, per second; None if unknown.
        """
        if camera.right_delay == 0.0 or twist is None:
            return
        xy, u_right = self.features.xy, self.features.u_right
        u_right = columns_without_delay(xy, u_right, twist, camera.right_delay, camera)
        self.features = replace(self.features, u_right=u_right)

    @property
    def aligned(self) -> NDArray[np.bool_]:
        """``(N,)`` features whose match was aligned."""
        if self.shift is None:
            return np.zeros(len(self.features), np.bool_)
        return (self.landmark >= 0) & np.isfinite(self.shift[:, 0])

    def observed(self) -> Features:
        """The features, those that were aligned where they were aligned to; disparities stay."""
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
