"""Aligns learned matches to sub-pixel accuracy, from the stored images of keyframes.

The cells of the learned descriptors are four pixels wide, so a learned match is accurate to about
a pixel. Image patches around the landmarks are therefore registered to the query image, as in the
feature alignment of SVO (Forster et al., ICRA 2014, section III-B). Because changes in brightness
and contrast are estimated together with the shift, this still works by night.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.frontend.alignment import align, warps
from vslam.frontend.pose import optimise_pose
from vslam.loopclosure.learned_localisation import PoseEstimate, estimate_at, observations
from vslam.loopclosure.siamese.local_descriptors import WIDTH, KeyframeImages
from vslam.types.camera import Camera
from vslam.types.features import PATCH_PIXELS, PATCH_RADIUS
from vslam.types.geometry import Matrix
from vslam.types.map import Map

_ITERATIONS = 10
_MAX_SHIFT = 3.0  # pixels of the stored images; a learned pose is up to 0.3 degrees wrong
# By day, patches of the newest keyframes agree better (``alignment.min_correlation``).
_MIN_CORRELATION = 0.7
_SIGMA = 0.5  # standard deviation of an aligned position, pixels of the stored images


def aligned(
    map_: Map,
    query: int,
    keyframes: list[int],
    estimate: PoseEstimate,
    images: KeyframeImages,
    camera: Camera,
    min_inliers: int,
) -> PoseEstimate | None:
    """Refine the pose of a keyframe at a place, from patches of the landmarks that were seen.

    Args:
        query: id of the keyframe. Its image must be stored.
        keyframes: ids of the keyframes of the place whose images are stored. The patch of a
            landmark is taken from the first keyframe that observes it.
        estimate: the pose, estimated from learned matches.
        min_inliers: number of aligned patches that must agree with the pose.

    Returns:
        The estimate with another pose and other predicted positions. None if too few patches could
        be aligned.
    """
    seen = np.flatnonzero(estimate.seen)
    keyframe, xy = _first_observations(map_, estimate.landmarks[seen], keyframes)
    observed_before = keyframe >= 0
    seen, keyframe, xy = seen[observed_before], keyframe[observed_before], xy[observed_before]
    xyz = map_.arrays.xyz[estimate.landmarks[seen]]
    uv = np.full((len(seen), 2), np.nan)
    image = images.image(query)
    for one in np.unique(keyframe).tolist():
        of_one = np.flatnonzero(keyframe == one)
        uv[of_one] = _positions(
            images.image(one), image, xy[of_one], estimate.uv[seen[of_one]],
            xyz[of_one], map_.keyframe_pose(one), estimate.T_cw, camera,
        )  # fmt: skip
    found = np.flatnonzero(np.isfinite(uv[:, 0]))
    if len(found) < min_inliers:
        return None
    observed = observations(uv[found], _SIGMA * camera.width / WIDTH)
    T_cw, inlier = optimise_pose(estimate.T_cw, xyz[found], *observed, camera.intrinsics)
    if np.count_nonzero(inlier) < min_inliers:
        return None
    observed = observed[0][inlier], observed[1][inlier]
    return estimate_at(
        T_cw, map_, estimate.landmarks, estimate.seen, estimate.n_matches, xyz[found][inlier],
        observed, camera,
    )  # fmt: skip


def _first_observations(
    map_: Map, landmarks: NDArray[np.int32], keyframes: list[int]
) -> tuple[NDArray[np.int64], Matrix]:
    """Return the first of some keyframes that observes each of N landmarks, -1 if none does, and
    the ``(N, 2)`` positions of the landmarks in its image."""
    first, xy = np.full(len(landmarks), -1, np.int64), np.zeros((len(landmarks), 2))
    for keyframe in keyframes:
        rows = map_.rows(keyframe)
        own, row = np.unique(map_.arrays.landmark[rows], return_index=True)
        at = np.minimum(np.searchsorted(own, landmarks), len(own) - 1)
        new = (own[at] == landmarks) & (first < 0)
        first[new], xy[new] = keyframe, map_.arrays.xy[rows][row[at[new]]]
    return first, xy


def _positions(
    reference: NDArray[np.uint8],
    image: NDArray[np.uint8],
    xy: Matrix,
    uv: Matrix,
    xyz: Matrix,
    T_reference: Matrix,
    T_cw: Matrix,
    camera: Camera,
) -> Matrix:
    """Find patches of a keyframe's stored image in the stored image of another keyframe.

    Args:
        reference, image: ``(H, WIDTH)`` uint8 images of the two keyframes.
        xy: ``(N, 2)`` positions of landmarks in the first image, pixels of the camera's image.
        uv: ``(N, 2)`` expected positions in the second image, pixels of the camera's image.
        xyz: ``(N, 3)`` landmarks in the world frame.
        T_reference, T_cw: ``(4, 4)`` poses of the two cameras (world to camera).

    Returns:
        ``(N, 2)`` positions in the second image, pixels of the camera's image. NaN if the patch was
        not found.
    """
    zoom = WIDTH / camera.width
    seen, expected = _resized(xy, zoom), _resized(uv, zoom)
    patches, inside = _cut(reference, seen)
    around, expected_inside = _cut(image, expected)
    unit = np.ones(len(xyz))
    one_view = np.zeros(len(xyz), np.int64)
    warp = warps(T_cw, xyz, T_reference[None], one_view, unit, unit, camera.intrinsics * zoom)
    shift = align(
        around, patches, (seen - np.rint(seen)).astype(np.float32), np.arange(len(xyz)), warp,
        _ITERATIONS, _MAX_SHIFT, _MIN_CORRELATION,
    )  # fmt: skip
    found = np.rint(expected) + shift
    found[~(inside & expected_inside)] = np.nan
    return (found + 0.5) / zoom - 0.5


def _resized(xy: Matrix, zoom: float) -> Matrix:
    """Return positions in an image that was resized. Pixel centres have integer coordinates."""
    return (xy + 0.5) * zoom - 0.5


def _cut(image: NDArray[np.uint8], xy: Matrix) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Cut out the ``(N, PATCH_PIXELS)`` patches around positions that are rounded to whole pixels,
    and return which of them lie inside the image."""
    middle = np.rint(xy).astype(np.int64)
    last = np.array(image.shape[::-1]) - 1 - PATCH_RADIUS
    inside = np.all((middle >= PATCH_RADIUS) & (middle <= last), axis=1)
    column, row = np.clip(middle, PATCH_RADIUS, last).T
    offset = np.arange(-PATCH_RADIUS, PATCH_RADIUS + 1)
    patches = image[(row[:, None] + offset)[:, :, None], (column[:, None] + offset)[:, None, :]]
    return patches.reshape(len(xy), PATCH_PIXELS), inside
