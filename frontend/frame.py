"""A frame: the features of an image, the pose of the camera, and the landmarks that are tracked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NewType, Protocol

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, Image
from vslam.features import Extracted, FeatureGrid, Features, Keypoints, Pyramid
from vslam.frontend.masks import Mask
from vslam.frontend.sides import Sides
from vslam.geometry import Matrix, inverse


class FeatureSource(Protocol):
    """The images of a frame, whose features are extracted when they are first needed.

    Attributes:
        extracted: the features of the frame.
        image: the ``(H, W)`` uint8 image that the features are extracted from.
        sides: result of comparing the exposure of the left and the right image; None if there is no
            right image, or if it has not been read.
        problem: why the right image could not be read; None if there was no such problem.
    """

    sides: Sides | None
    problem: str | None

    @property
    def extracted(self) -> Extracted: ...

    def extracted_with(self, keypoints: Keypoints) -> Extracted:
        """Return the features of the frame, and additional features at the given positions and
        pyramid levels of the left image."""
        ...

    @property
    def image(self) -> Image: ...


@dataclass
class Frame:
    """One frame of the run: its features, its pose, and the landmarks that its features track.

    Attributes:
        index: index of the frame in the run.
        timestamp: seconds.
        image: ``(H, W)`` uint8 left image, for loop detectors that need it. None before
            ``extract`` is called, or if the frame has no image.
        features, grid: the N features of the image, and a grid to search them by position. Before
            features are extracted, ``features`` has one entry for each landmark whose image patch
            was found.
        pyramid, row_offset: see ``Extracted``.
        T_cw: ``(4, 4)`` estimated pose of the left camera (world to camera).
        landmark: ``(N,)`` int32, id of the landmark that each feature tracks, or -1.
        xyz: ``(N, 3)`` float64 position of the landmark that each feature tracks, in the world
            frame, in metres; NaN if the feature tracks none.
        disparity_offset: offset that has been added to every disparity, in pixels
            (``RigCalibration``).
        delay_removed: whether the columns in the right image have been corrected for the delay of
            that image.
        shift: ``(N, 2)`` float32 offset from each feature to its aligned position, in pixels; NaN
            where the match was not aligned. None if no match was aligned.
        twist: ``(6,)`` velocity of the camera when the frame was tracked, as a twist per second;
            None if unknown. ``exp(twist dt)`` maps points from the camera frame at one time to the
            camera frame dt seconds later.
        source: the images from which ``extract`` extracts the features; None after extraction.
        coarse: the small images of the frame (``coarse_levels``), to which the next frame is
            aligned; None if frames are not aligned.
        mask: the mask of the image; None if all pixels are used.
    """

    index: int
    timestamp: float
    image: NDArray[np.uint8] | None
    features: Features
    grid: FeatureGrid
    pyramid: Pyramid | None
    row_offset: NDArray[np.float32] | None
    T_cw: NDArray[np.float64]
    landmark: NDArray[np.int32]
    xyz: NDArray[np.float64]
    disparity_offset: float = 0.0
    delay_removed: bool = False
    shift: NDArray[np.float32] | None = None
    twist: Matrix | None = None
    source: FeatureSource | None = None
    coarse: Pyramid | None = None
    mask: Mask | None = None

    @classmethod
    def of(
        cls,
        extracted: Extracted,
        camera: Camera,
        index: int = 0,
        timestamp: float = 0.0,
        image: NDArray[np.uint8] | None = None,
    ) -> Frame:
        """Create a frame that is not tracked yet. Its pose is that of the first frame of a drive,
        and its features have no matches."""
        features, n = extracted.features, len(extracted.features)
        return cls(
            index=index,
            timestamp=timestamp,
            image=image,
            features=features,
            grid=FeatureGrid.of_positions(features.xy, camera.width, camera.height),
            pyramid=extracted.pyramid,
            row_offset=extracted.row_offset,
            T_cw=inverse(camera.T_mounted_camera),
            landmark=np.full(n, -1, np.int32),
            xyz=np.full((n, 3), np.nan),
        )

    def extract(self, camera: Camera) -> None:
        """Extract the features of the images, unless this has already been done.

        The pose is kept, but the new features do not track landmarks yet. Where the image patch of
        a landmark was found, a feature is extracted even if the detector finds no corner there.
        """
        if self.source is None:
            return
        source, found = self.source, self.features
        extracted = (
            source.extracted_with((found.xy, found.octave)) if len(found) else source.extracted
        )
        new = Frame.of(extracted, camera, self.index, self.timestamp, source.image)
        new.T_cw, new.twist, new.coarse, new.mask = self.T_cw, self.twist, self.coarse, self.mask
        self.restore(new)

    def match(
        self, features: NDArray[np.integer], landmarks: NDArray[np.int32], xyz: Matrix
    ) -> None:
        """Assign landmarks with the given ids and ``(M, 3)`` positions to ``(M,)`` features."""
        self.landmark[features], self.xyz[features] = landmarks, xyz

    def drop_matches(self, features: NDArray[np.integer] | slice = slice(None)) -> None:
        """Remove the matches of the given features; by default, of all features."""
        self.landmark[features], self.xyz[features] = -1, np.nan

    def snapshot(self) -> Frame:
        """Copy the frame. Later changes to its pose and its matches do not affect the copy."""
        return replace(self, landmark=self.landmark.copy(), xyz=self.xyz.copy())

    def restore(self, snapshot: Frame) -> None:
        """Restore the pose and the matches of a ``snapshot``."""
        vars(self).update(vars(snapshot))

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

    @property
    def n_stereo(self) -> int:
        """Number of features with a stereo match, or with a depth in an RGB-D frame."""
        return int(np.count_nonzero(np.isfinite(self.features.u_right)))


PlacedFrame = NewType("PlacedFrame", Frame)
"""A frame whose pose has been recorded (``Mapper.append_pose``). Only such a frame can become a
keyframe."""
