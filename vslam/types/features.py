"""Image features, and the results of feature extraction and of tracking for one frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import inline, inner_kernel, kernel
from vslam.types.geometry import inverse
from vslam.types.odometry import PoseUncertainty

MIN_DISPARITY = 0.01  # pixels; smaller disparities are set to this
PATCH_RADIUS = 8  # half width of the patch around a feature, in pixels of its octave
PATCH_SIDE = 2 * PATCH_RADIUS + 1
PATCH_PIXELS = PATCH_SIDE**2
CELL = 16  # side of a FeatureGrid cell in pixels; search windows are 5 to 60 px wide


@dataclass(frozen=True)
class Pyramid:
    """Image pyramid with all levels in one buffer, which can be passed to a kernel as one array.

    Attributes:
        pixels: ``(P + SPARE,)`` uint8, pixels of the levels, row by row, followed by padding.
            Vectorised kernels read up to one register beyond the last pixel and ignore the padding.
        offsets: ``(L,)`` int64, index of the first pixel of each level.
        shapes: ``(L, 2)`` int64, height and width of each level.
        scales: ``(L,)`` float64, size of a pixel of each level in full-resolution pixels.
    """

    pixels: NDArray[np.uint8]
    offsets: NDArray[np.int64]
    shapes: NDArray[np.int64]
    scales: NDArray[np.float64]

    def level(self, index: int) -> NDArray[np.uint8]:
        """Return a view of one pyramid level as an ``(h, w)`` image."""
        height, width = self.shapes[index].tolist()
        start = int(self.offsets[index])
        return self.pixels[start : start + height * width].reshape(height, width)


@inline
def level_of(pixels, offsets, shapes, level):
    """Return level ``level`` of a ``Pyramid`` as an ``(h, w)`` image, inside a kernel."""
    height, width = shapes[level]
    start = offsets[level]
    return pixels[start : start + height * width].reshape(height, width)


@inner_kernel
def level_pixel(x, ratio):
    """Convert an image coordinate to the nearest pixel of a pyramid level.

    Args:
        x: the coordinate in pixels of the image.
        ratio: number of image pixels per pixel of the level.
    """
    return int(np.rint((np.float64(x) + 0.5) / ratio - 0.5))


@dataclass(frozen=True)
class Features:
    """ORB features of one image and their stereo matches.

    Attributes:
        xy: ``(N, 2)`` float32, position at full resolution (pixels).
        octave: ``(N,)`` uint8, pyramid level.
        angle: ``(N,)`` float32, orientation in radians.
        descriptors: ``(N, 32)`` uint8, 256-bit rotated BRIEF.
        u_right: ``(N,)`` float32, column of the stereo match in the right image. NaN if the feature
            has no stereo match.
    """

    xy: NDArray[np.float32]
    octave: NDArray[np.uint8]
    angle: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    u_right: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.xy)

    @classmethod
    def none(cls) -> Features:
        """Return an empty set of features, for a frame without images."""
        return cls(
            np.empty((0, 2), np.float32),
            np.empty(0, np.uint8),
            np.empty(0, np.float32),
            np.empty((0, 32), np.uint8),
            np.empty(0, np.float32),
        )


Keypoints = tuple[NDArray[np.float32], NDArray[np.uint8]]
"""``(N, 2)`` positions in pixels at full resolution, and ``(N,)`` pyramid levels."""


@dataclass(frozen=True)
class Sides:
    """The difference in exposure between the left and the right image of a stereo pair.

    Attributes:
        darker_stops: difference in exposure, in stops; positive if the right image is darker. It is
            0 if the difference is below the threshold, or if a common gain does not explain the
            difference.
        black: the side whose image is black while the other image is not; empty if there is none.
    """

    darker_stops: float = 0.0
    black: Literal["", "left", "right"] = ""


@dataclass(frozen=True)
class Extracted:
    """The result of feature extraction for one frame.

    Attributes:
        features: the N features that were extracted from the left image.
        pyramid: the pyramid of this image. None if matches in this image are not refined to
            sub-pixel accuracy.
        disparity_offset: offset that has been added to every disparity, in pixels
            (``vslam.frontend.rig.with_offset``).
        sides: result of comparing the exposure of the left and the right image. None if there is no
            right image, or if none was read.
        problem: why the second image could not be read. None if there was no such problem.
    """

    features: Features
    pyramid: Pyramid | None = None
    disparity_offset: float = 0.0
    sides: Sides | None = None
    problem: str | None = None

    @classmethod
    def nothing(cls) -> Extracted:
        """Return a result without features, for a frame whose left image is missing or black."""
        return cls(Features.none())


class KeyframePatches(NamedTuple):
    """Image patches of the N features of a keyframe.

    Attributes:
        keyframe: id of the keyframe.
        pixels: ``(N, PATCH_PIXELS)`` uint8, the square patch around each keypoint, row by row.
        shift: ``(N, 2)`` float32, vector from each keypoint to the position of its landmark after
            sub-pixel alignment, in pixels of the keypoint's octave.
        xy: ``(N, 2)`` float32, this position in the map when ``shift`` was measured, in
            full-resolution pixels. Local mapping may align the keypoint later.
    """

    keyframe: int
    pixels: NDArray[np.uint8]
    shift: NDArray[np.float32]
    xy: NDArray[np.float32]


class FramePatches(NamedTuple):
    """Image patches of the N landmarks that a frame tracks.

    Attributes:
        frame: index of the frame.
        landmark: ``(N,)`` int32 landmark ids, sorted.
        octave: ``(N,)`` uint8, octave of the feature that tracks each landmark.
        angle: ``(N,)`` float32, orientation of this feature in radians.
        pixels: ``(N, PATCH_PIXELS)`` uint8, see ``KeyframePatches``.
        shift: ``(N, 2)`` float32, see ``KeyframePatches``.
    """

    frame: int
    landmark: NDArray[np.int32]
    octave: NDArray[np.uint8]
    angle: NDArray[np.float32]
    pixels: NDArray[np.uint8]
    shift: NDArray[np.float32]


class LandmarkPatches(NamedTuple):
    """Image patches of N landmarks, taken from K frames.

    Attributes:
        ids: ``(N,)`` int32 landmark ids, sorted.
        where: ``(N,)`` int64, index of the patch of each landmark in ``pixels`` and ``shift``.
        view: ``(N,)`` int64, index in ``T_cw`` of the frame that the patch of each landmark was
            taken from.
        size: ``(N,)`` float64, size of a pixel of the patch in full-resolution pixels.
        angle: ``(N,)`` float32, orientation of the feature in radians.
        pixels: ``(P, PATCH_PIXELS)`` uint8, the square patch around each keypoint, row by row.
        shift: ``(P, 2)`` float32, vector from each keypoint to the position of its landmark after
            sub-pixel alignment, in pixels of the keypoint's octave.
        T_cw: ``(K, 4, 4)`` float64 poses of the frames.
    """

    ids: NDArray[np.int32]
    where: NDArray[np.int64]
    view: NDArray[np.int64]
    size: NDArray[np.float64]
    angle: NDArray[np.float32]
    pixels: NDArray[np.uint8]
    shift: NDArray[np.float32]
    T_cw: NDArray[np.float64]

    def every(self, stride: int) -> LandmarkPatches:
        """Return the patches of every ``stride``-th landmark."""
        return self._replace(
            ids=self.ids[::stride],
            where=self.where[::stride],
            view=self.view[::stride],
            size=self.size[::stride],
            angle=self.angle[::stride],
        )


NO_PATCHES = LandmarkPatches(
    np.empty(0, np.int32),
    np.empty(0, np.int64),
    np.empty(0, np.int64),
    np.empty(0),
    np.empty(0, np.float32),
    np.empty((0, PATCH_PIXELS), np.uint8),
    np.empty((0, 2), np.float32),
    np.empty((0, 4, 4)),
)


def shifted_columns(
    u_right: NDArray[np.float32], u: NDArray[np.float32], change: float | NDArray[np.float64]
) -> NDArray[np.float32]:
    """Subtract ``change`` pixels from the columns of stereo matches in the right image.

    A disparity is never reduced below ``MIN_DISPARITY``, because a smaller disparity could move a
    point behind the camera.

    Args:
        u_right: ``(N,)`` columns of the matches in the right image, in pixels. NaN stays NaN.
        u: ``(N,)`` columns of the features in the left image, in pixels.
        change: pixels to subtract, as a number or as an ``(N,)`` array.
    """
    return np.minimum(u_right - np.asarray(change, np.float32), u - np.float32(MIN_DISPARITY))


class FeatureGrid(NamedTuple):
    """Indices of features, sorted by grid cell. The grid divides the image into equal cells.

    The cells are numbered row by row. The features in cell c are ``items[start[c]:start[c + 1]]``.
    """

    start: NDArray[np.int64]
    items: NDArray[np.int32]
    columns: int

    @classmethod
    def of_positions(cls, xy: NDArray[np.float32], width: int, height: int) -> FeatureGrid:
        """Sort features at ``(N, 2)`` pixel positions into the grid cells of an image."""
        columns, rows = -(-width // CELL), -(-height // CELL)
        start, items = build_grid(xy, columns, rows)
        return cls(start, items, columns)


@kernel
def build_grid(xy, columns, rows):
    """Sort features at ``(N, 2)`` positions into grid cells by counting sort.

    Returns:
        ``start`` (int64) and ``items`` (int32) of ``FeatureGrid``.
    """
    n = len(xy)
    cell = np.empty(n, np.int64)
    start = np.zeros(columns * rows + 1, np.int64)
    for i in range(n):
        column = min(max(int(xy[i, 0]) // CELL, 0), columns - 1)
        row = min(max(int(xy[i, 1]) // CELL, 0), rows - 1)
        cell[i] = row * columns + column
        start[cell[i] + 1] += 1
    for c in range(columns * rows):
        start[c + 1] += start[c]
    cursor = start[:-1].copy()
    items = np.empty(n, np.int32)
    for i in range(n):
        items[cursor[cell[i]]] = i
        cursor[cell[i]] += 1
    return start, items


class TrackingState(StrEnum):
    """How a frame was tracked.

    OK: the pose has enough inliers. WEAK: the pose has few inliers. INERTIAL: the images gave no
    pose, and the IMU has carried the camera for at most three seconds. LOST: the pose is only
    predicted, or no map exists yet. DROPPED: the images arrived while earlier images were still
    being processed (``--realtime``), so the pose is interpolated. LATER: the frame was LOST, and
    its pose was found when a monocular map began afterwards. Only the results of a finished run
    have this state.
    """

    OK = "OK"
    WEAK = "WEAK"
    LOST = "LOST"
    DROPPED = "DROPPED"
    INERTIAL = "INERTIAL"
    LATER = "LATER"  # last, because files number the states


@dataclass(frozen=True)
class TrackResult:
    """The result of tracking one frame. A lost frame also has a result.

    Attributes:
        index: frame number within the run, from 0.
        timestamp: seconds.
        T_wc: ``(4, 4)`` float64 pose (camera to world) at the time of tracking. Later bundle
            adjustments improve this pose. ``Slam.trajectory()`` returns the improved poses.
        state: how the frame was tracked.
        n_features: number of features that were extracted from the left image. It is 0 if the frame
            was tracked by patches.
        n_stereo: number of features with a stereo match.
        n_matches: number of landmarks that were matched by descriptor or by patch before the last
            pose optimisation.
        n_inliers: number of matched landmarks that are inliers of the last pose optimisation.
        is_keyframe: whether the frame became a keyframe.
        relocalised: whether the pose was found by relocalisation, which searches the whole map.
        stage_ms: wall time of each stage of the pipeline, in milliseconds.
        T_odom_camera: ``(4, 4)`` pose from odometry, which drifts but never jumps. It is the
            identity at the first frame. None in files of older versions.
        uncertainty: covariances of the pose. None in files of older versions.
        part: index of the part of the map in which the frame was tracked. Part 0 contains the world
            frame, which is the first frame of a new map. If the camera was lost and no place was
            recognised, another part begins at a predicted pose. When a loop joins two parts, the
            later frames have the smaller index.
        support: share of the landmarks at rest that should be visible and that agree with the pose.
            It is small if a large part of the image moves against the rest, or is covered. None for
            a frame that was not tracked by patches, and if hardly any landmark is known to be at
            rest, as at the start of a map.
        stands_still: whether the camera stands still.
        gravity: ``(3,)`` acceleration of free fall in the world frame, in m/s^2. None without an
            IMU, and until it is known. The world frame itself is never turned.
        imu_bias: ``(6,)`` biases of the gyroscope in rad/s and of the accelerometer in m/s^2, along
            the axes of the IMU. None while gravity is unknown.
        imu_bias_sigma: ``(6,)`` standard deviations of these biases.
        next_extraction: index of a later frame whose features will probably be needed, so that they
            can be extracted in advance. -1 if there is no such frame.
    """

    index: int
    timestamp: float
    T_wc: NDArray[np.float64]
    state: TrackingState
    n_features: int
    n_stereo: int
    n_matches: int
    n_inliers: int
    is_keyframe: bool
    relocalised: bool = False
    stage_ms: dict[str, float] = field(default_factory=dict)
    T_odom_camera: NDArray[np.float64] | None = None
    uncertainty: PoseUncertainty | None = None
    part: int = 0
    support: float | None = None
    stands_still: bool = False
    gravity: NDArray[np.float64] | None = None
    imu_bias: NDArray[np.float64] | None = None
    imu_bias_sigma: NDArray[np.float64] | None = None
    next_extraction: int = -1

    @property
    def measured(self) -> bool:
        """Whether the pose relative to the world frame was measured at the time of tracking.

        It was only predicted if the frame is lost or dropped, or belongs to a part of the map that
        no loop had joined to part 0.
        """
        return self.part == 0 and self.state in (TrackingState.OK, TrackingState.WEAK)

    @property
    def T_map_odom(self) -> NDArray[np.float64]:
        """``(4, 4)`` transformation from the odometry frame to the map frame (ROS REP 105).

        ``T_wc = T_map_odom @ T_odom_camera``. This transformation jumps when a loop is closed, when
        the map is adjusted, and when the camera is relocalised.
        """
        if self.T_odom_camera is None:
            return np.eye(4)
        T: NDArray[np.float64] = self.T_wc @ inverse(self.T_odom_camera)
        return T


def nearest_features(
    uv: NDArray[np.floating],
    xy: NDArray[np.float32],
    octave: NDArray[np.uint8],
    scales: NDArray[np.float64],
    reach: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Match image positions with the nearest features.

    Args:
        uv: ``(N, 2)`` positions in the image, pixels.
        xy, octave: ``(F, 2)`` positions in pixels and ``(F,)`` octaves of the features.
        scales: ``(levels,)`` pyramid scale factors.
        reach: upper bound of the distance of a match, in pixels of the feature's octave.

    Returns:
        ``(K,)`` indices of features, without duplicates, and ``(K,)`` indices of the matched
        positions. The pair with the smallest distance comes first.
    """
    if not len(uv) or not len(xy):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    # Brute force takes 3 ms. SciPy's k-d tree is faster, but its import takes 27 MB and 0.2 s. If
    # several features lie at the same pixel, the k-d tree returns an arbitrary one. ``argmin``
    # returns the first one, which has the finest octave.
    x, y = xy.T.astype(np.float64)
    feature = np.array([np.argmin((x - u) ** 2 + (y - v) ** 2) for u, v in uv.tolist()])
    distance = np.sqrt((x[feature] - uv[:, 0]) ** 2 + (y[feature] - uv[:, 1]) ** 2)
    near = np.flatnonzero(distance <= reach * scales[octave[feature]])
    near = near[np.argsort(distance[near], kind="stable")]
    _, first = np.unique(feature[near], return_index=True)
    near = near[np.sort(first)]
    return np.asarray(feature[near], np.int64), near
