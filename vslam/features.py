"""Image features, what the images of a frame give, and what tracking says of a frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.kernels import inner_kernel, kernel

MIN_DISPARITY = 0.01  # pixels; a point farther away counts as so far
PATCH_RADIUS = 8  # of the pixels that are kept around a feature, in its octave
PATCH_SIDE = 2 * PATCH_RADIUS + 1
PATCH_PIXELS = PATCH_SIDE**2
CELL = 16  # pixels of a FeatureGrid cell; search windows are 5 to 60 px wide


@dataclass(frozen=True)
class Pyramid:
    """Levels of one image, back to back in one buffer so that kernels can take all of them.

    Attributes:
        pixels: ``(P + SPARE,)`` uint8, the levels row by row; kernels may read, and ignore, as much
            as a register holds beyond the end.
        offsets: ``(L,)`` int64, where each level starts.
        shapes: ``(L, 2)`` int64, height and width.
        scales: ``(L,)`` float64, full-resolution pixels for each pixel of the level.
    """

    pixels: NDArray[np.uint8]
    offsets: NDArray[np.int64]
    shapes: NDArray[np.int64]
    scales: NDArray[np.float64]

    def level(self, index: int) -> NDArray[np.uint8]:
        """View of one level, ``(h, w)``."""
        height, width = self.shapes[index]
        start = self.offsets[index]
        return self.pixels[start : start + height * width].reshape(height, width)


@inner_kernel
def level_pixel(x, ratio):
    """Pixel of a level at a coordinate of the image, which has ``ratio`` pixels for one of it."""
    return int(np.rint((np.float64(x) + 0.5) / ratio - 0.5))


@dataclass(frozen=True)
class Features:
    """ORB features of one image, with the stereo match of each where there is one.

    Attributes:
        xy: ``(N, 2)`` float32, position at full resolution (pixels).
        octave: ``(N,)`` uint8, pyramid level.
        angle: ``(N,)`` float32, orientation in radians.
        descriptors: ``(N, 32)`` uint8, 256-bit rotated BRIEF.
        u_right: ``(N,)`` float32, column of the match in the right image, NaN without one.
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
        """Those of a frame without images."""
        return cls(
            np.empty((0, 2), np.float32),
            np.empty(0, np.uint8),
            np.empty(0, np.float32),
            np.empty((0, 32), np.uint8),
            np.empty(0, np.float32),
        )


class Side(StrEnum):
    """One camera of a stereo pair. A camera without a second one counts as the left one."""

    LEFT = "left"
    RIGHT = "right"


@dataclass(frozen=True)
class Extracted:
    """What the images of one frame give.

    Attributes:
        features: the N features that were extracted from the image of ``side``.
        pyramid: of that image; None if matches are not to be aligned in it.
        row_offset: ``(N,)`` float32, by how many pixels a stereo match is lower in the right image
            than in the left one; NaN for features of which this was not measured. None if it was
            measured for none.
        side: the camera that took that image: the right one only where the left image is black,
            and no feature has a stereo match then.
    """

    features: Features
    pyramid: Pyramid | None = None
    row_offset: NDArray[np.float32] | None = None
    side: Side = Side.LEFT

    @classmethod
    def nothing(cls) -> Extracted:
        """What a frame without images gives."""
        return cls(Features.none())


class KeyframePatches(NamedTuple):
    """Of the N features of a keyframe: ``pixels`` (N, PATCH_PIXELS) u1 around the keypoints, and
    ``shift`` (N, 2) f4 from there to what each observes, in pixels of its octave."""

    keyframe: int
    pixels: NDArray[np.uint8]
    shift: NDArray[np.float32]


class LandmarkPatches(NamedTuple):
    """Of N landmarks: ``ids`` (N,) i4, sorted; ``where`` (N,) i8 row of each in ``pixels`` (P,
    PATCH_PIXELS) u1 and ``shift`` (P, 2) f4, which are as of ``KeyframePatches``; ``view`` (N,) i8
    the camera that saw it, of ``T_cw`` (K, 4, 4) f8; ``size`` (N,) f8 full-resolution pixels for
    one of its patch."""

    ids: NDArray[np.int32]
    where: NDArray[np.int64]
    view: NDArray[np.int64]
    size: NDArray[np.float64]
    pixels: NDArray[np.uint8]
    shift: NDArray[np.float32]
    T_cw: NDArray[np.float64]


NO_PATCHES = LandmarkPatches(
    np.empty(0, np.int32),
    np.empty(0, np.int64),
    np.empty(0, np.int64),
    np.empty(0),
    np.empty((0, PATCH_PIXELS), np.uint8),
    np.empty((0, 2), np.float32),
    np.empty((0, 4, 4)),
)


def shifted_columns(
    u_right: NDArray[np.float32], u: NDArray[np.float32], change: float | NDArray[np.float64]
) -> NDArray[np.float32]:
    """``(N,)`` columns in the right image, ``change`` pixels further to the left, but never so far
    to the right that the point would lie behind the camera. NaN stays NaN."""
    return np.minimum(u_right - np.asarray(change, np.float32), u - np.float32(MIN_DISPARITY))


class FeatureGrid(NamedTuple):
    """Features by image cell, row by row: those of cell c are ``items[start[c]:start[c + 1]]``."""

    start: NDArray[np.int64]
    items: NDArray[np.int32]
    columns: int

    @classmethod
    def of_positions(cls, xy: NDArray[np.float32], width: int, height: int) -> FeatureGrid:
        """Sort ``(N, 2)`` positions into the cells of an image."""
        columns, rows = -(-width // CELL), -(-height // CELL)
        start, items = build_grid(xy, columns, rows)
        return cls(start, items, columns)


@kernel
def build_grid(xy, columns, rows):
    """Counting sort of ``(N, 2)`` positions into cells, row by row."""
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
    """OK: enough inliers. WEAK: a pose, but on few inliers. LOST: the pose is predicted. DROPPED:
    the images came while others were worked on (``--realtime``); the pose is interpolated."""

    OK = "OK"
    WEAK = "WEAK"
    LOST = "LOST"
    DROPPED = "DROPPED"


@dataclass(frozen=True)
class TrackResult:
    """Outcome of one frame; lost frames have one too.

    Attributes:
        index: frame number within the run, from 0.
        timestamp: seconds.
        T_wc: ``(4, 4)`` float64 pose at the time of tracking (camera to world); the final
            trajectory, after later bundle adjustments, comes from ``Slam.trajectory()``.
        state: OK, WEAK, LOST or DROPPED.
        n_features: features extracted from the left image.
        n_stereo: of these, features with a stereo match.
        n_matches: landmark matches before the last pose optimisation.
        n_inliers: matches that survived it.
        is_keyframe: whether the frame became a keyframe.
        relocalised: whether it was looked for in the whole map, and found.
        stage_ms: milliseconds by stage of the pipeline (wall time of that stage).
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
