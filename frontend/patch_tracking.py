"""Tracks a frame without extracting features, by searching the image for image patches of
landmarks.

The patches come from the newest keyframes. The method follows SVO (Forster et al., ICRA 2014,
section III, and T-RO 2017). First, sparse image alignment to the last frame estimates the pose
(``pose_alignment``). Then the patch of each landmark is aligned with the image separately. Finally,
the pose is optimised using the image positions of the patches.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.features import PATCH_RADIUS, Features, Pyramid
from vslam.frontend.alignment import find_patches
from vslam.frontend.masks import Mask
from vslam.frontend.pose import optimise_pose
from vslam.frontend.tracking import TrackingContext, predict_landmarks
from vslam.geometry import Matrix, orthonormalised
from vslam.map_view import MapView

_MARGIN = PATCH_RADIUS + 2  # least distance of a patch centre from the border of its level, pixels


class PatchTrack(NamedTuple):
    """The result of tracking a frame by image patches. N landmarks are inliers of the pose
    optimisation.

    Attributes:
        T_cw: ``(4, 4)`` pose (world to camera).
        ids, xyz: ``(N,)`` ids and ``(N, 3)`` world positions of the inliers.
        features: a feature for each inlier, at the position where the patch was found. It has the
            descriptor of the landmark and no column in the right image.
        n_matches: number of landmarks whose patches were found, including outliers.
        visible: ``(M,)`` ids of the landmarks that the frame should see.
    """

    T_cw: Matrix
    ids: NDArray[np.int32]
    xyz: Matrix
    features: Features
    n_matches: int
    visible: NDArray[np.int32]

    @property
    def share(self) -> float:
        """Fraction of inliers among the landmarks whose patches were found."""
        return len(self.ids) / max(1, self.n_matches)


NO_PATCHES_FOUND = PatchTrack(
    np.eye(4),
    np.empty(0, np.int32),
    np.empty((0, 3)),
    Features.none(),
    0,
    np.empty(0, np.int32),
)


def track_patches(
    pyramid: Pyramid,
    T_cw: Matrix,
    view: MapView,
    context: TrackingContext,
    mask: Mask | None = None,
) -> PatchTrack:
    """Search an image for the image patches of the landmarks in the local map, and optimise the
    pose.

    Args:
        T_cw: ``(4, 4)`` initial pose (world to camera). Its error may shift projected landmarks by
            about two pixels.
        mask: the mask of the image; None uses all pixels.
    """
    known, local = view.patches, view.with_patches
    camera, scales, config = context.camera, context.scales, context.config.alignment
    uvr, radius, octave = predict_landmarks(T_cw, local, 1.0, mask, context)
    margin = _MARGIN * scales[octave]
    size = np.array([camera.width, camera.height])
    inside = (uvr[:, :2] > margin[:, None]) & (uvr[:, :2] < size - 1 - margin[:, None])
    tried = np.flatnonzero((radius > 0) & inside.all(axis=1))
    level = octave[tried].astype(np.uint8)
    xy = _whole_pixels(uvr[tried, :2], pyramid, level)
    shift = find_patches(
        pyramid, xy, level, T_cw, local.xyz[tried], known, tried, scales, camera.intrinsics, config
    )
    found = np.isfinite(shift[:, 0])
    seen, level = tried[found], level[found]
    scale = scales[level]
    xy = xy[found] + shift[found] * scale[:, None].astype(np.float32)
    uvr = np.full((len(seen), 3), np.nan)
    uvr[:, :2] = xy
    weight = config.certainty * scale**-2.0
    T_found, inlier = optimise_pose(T_cw, local.xyz[seen], uvr, weight, camera.intrinsics)
    seen, xy, level = seen[inlier], xy[inlier], level[inlier]
    features = Features(
        xy=xy,
        octave=level,
        angle=known.angle[seen],
        descriptors=local.descriptor[seen].view(np.uint8).reshape(-1, 32),
        u_right=np.full(len(seen), np.nan, np.float32),
    )
    return PatchTrack(
        orthonormalised(T_found),
        local.ids[seen],
        local.xyz[seen],
        features,
        len(inlier),
        local.ids[radius > 0],
    )


def _whole_pixels(
    uv: NDArray[np.float64], pyramid: Pyramid, level: NDArray[np.uint8]
) -> NDArray[np.float32]:
    """Round ``(N, 2)`` full-resolution positions to the nearest whole pixels of their levels."""
    ratio = pyramid.shapes[0, ::-1] / pyramid.shapes[level][:, ::-1]
    pixel = np.rint((uv + 0.5) / ratio - 0.5)
    return ((pixel + 0.5) * ratio - 0.5).astype(np.float32)
