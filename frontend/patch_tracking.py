"""Tracking without features: the patches of the newest keyframes are found in the image itself.

After SVO (Forster et al., ICRA 2014, III, and T-RO 2017): the pose first, by sparse image alignment
to the last frame; then each landmark by itself, where its patch agrees with the image; at last the
pose once more, from where the landmarks were found.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.features import PATCH_RADIUS, Features, Pyramid
from vslam.frontend.alignment import find_patches
from vslam.frontend.masks import Mask
from vslam.frontend.matching import predict_view
from vslam.frontend.pose import optimise_pose
from vslam.frontend.tracking import TrackingContext
from vslam.geometry import Matrix, orthonormalised
from vslam.map_view import MapView

_MARGIN = PATCH_RADIUS + 2  # of a patch from the border of its level, pixels


class PatchTrack(NamedTuple):
    """Landmarks that were found by their patches, and the pose that follows.

    ``T_cw`` (4, 4); ``ids`` (N,) i4 and ``xyz`` (N, 3) of the inliers; ``features`` of these, where
    they were found, with the descriptors of the landmarks and without columns in a right image;
    ``n_matches`` before outliers were removed; ``visible`` (M,) i4 landmarks that were looked for.
    """

    T_cw: Matrix
    ids: NDArray[np.int32]
    xyz: Matrix
    features: Features
    n_matches: int
    visible: NDArray[np.int32]


def track_patches(
    pyramid: Pyramid,
    T_cw: Matrix,
    view: MapView,
    context: TrackingContext,
    mask: Mask | None = None,
) -> PatchTrack:
    """Find the landmarks of the local map that have patches, and the pose of the camera.

    Args:
        pyramid: of the image.
        T_cw: ``(4, 4)`` pose, right to about two pixels.
        mask: of the image; None if all of it is used.
    """
    known, local = view.patches, view.local_landmarks
    camera, config, scales = context.camera, context.config.alignment, context.scales
    at = np.searchsorted(local.ids, known.ids)
    xyz = local.xyz[at]
    uvr, radius, octave = predict_view(
        T_cw,
        xyz,
        local.normal[at],
        local.distance_range[at],
        camera.intrinsics,
        camera.width,
        camera.height,
        scales,
        1.0,
    )
    if mask is not None:
        radius[~mask.shows(uvr[:, :2], octave)] = 0.0
    margin = _MARGIN * scales[octave]
    size = np.array([camera.width, camera.height])
    inside = (uvr[:, :2] > margin[:, None]) & (uvr[:, :2] < size - 1 - margin[:, None])
    tried = np.flatnonzero((radius > 0) & inside.all(axis=1))
    level = octave[tried].astype(np.uint8)
    xy = _whole_pixels(uvr[tried, :2], pyramid, level)
    shift = find_patches(
        pyramid, xy, level, T_cw, xyz[tried], known, tried, scales, camera.intrinsics, config
    )
    found = np.isfinite(shift[:, 0])
    seen, level = tried[found], level[found]
    scale = scales[level]
    xy = xy[found] + shift[found] * scale[:, None].astype(np.float32)
    uvr = np.full((len(seen), 3), np.nan)
    uvr[:, :2] = xy
    certain = config.certainty * scale**-2.0
    T_found, inlier = optimise_pose(T_cw, xyz[seen], uvr, certain, camera.intrinsics)
    seen, xy, level = seen[inlier], xy[inlier], level[inlier]
    features = Features(
        xy=xy,
        octave=level,
        angle=known.angle[seen],
        descriptors=local.descriptor[at[seen]].view(np.uint8).reshape(-1, 32),
        u_right=np.full(len(seen), np.nan, np.float32),
    )
    return PatchTrack(
        orthonormalised(T_found),
        known.ids[seen],
        xyz[seen],
        features,
        len(inlier),
        known.ids[radius > 0],
    )


def _whole_pixels(
    uv: NDArray[np.float64], pyramid: Pyramid, level: NDArray[np.uint8]
) -> NDArray[np.float32]:
    """``(N, 2)`` full-resolution positions of the pixels of a level that are nearest to ``uv``."""
    ratio = pyramid.shapes[0, ::-1] / pyramid.shapes[level][:, ::-1]
    pixel = np.rint((uv + 0.5) / ratio - 0.5)
    return ((pixel + 0.5) * ratio - 0.5).astype(np.float32)
