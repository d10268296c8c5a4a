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

from vslam.frontend.alignment import find_patches
from vslam.frontend.masks import Mask
from vslam.frontend.pose import MIN_TRUSTED, optimise_pose
from vslam.frontend.standstill import MEASURE_SHARE, is_small, still_stands
from vslam.frontend.tracking import predict_landmarks, trusted_landmarks
from vslam.types.context import Context
from vslam.types.features import PATCH_RADIUS, Features, LandmarkPatches, Pyramid
from vslam.types.geometry import Matrix, orthonormalised, transform
from vslam.types.map_view import LocalMap, MapView
from vslam.types.track import Standstill

_MARGIN = PATCH_RADIUS + 2  # least distance of a patch centre from the border of its level, pixels

# In ordinary drives, at least this share of the expected trusted landmarks agrees with the pose.
SUPPORT_SHARE = 0.4


# About this many patches are searched for in a frame of an RGB-D camera. SVO tracks 120 to 180.
# [own]
_ENOUGH = 500


class PatchTrack(NamedTuple):
    """The result of tracking a frame by image patches. N landmarks are inliers of the pose
    optimisation.

    Attributes:
        T_cw: ``(4, 4)`` pose (world to camera).
        ids, xyz: ``(N,)`` ids and ``(N, 3)`` world positions of the inliers.
        features: a feature for each inlier, at the position where the patch was found. It has the
            descriptor of the landmark and no column in the right image.
        n_matches: number of landmarks whose patches were found, including outliers.
        n_expected: number of trusted landmarks that should be visible (``trusted_landmarks``).
        n_trusted: number of trusted landmarks among the inliers.
        visible: ``(M,)`` ids of the landmarks that the frame should see.
        stands_still: whether the camera stands still (`track_standing`).
    """

    T_cw: Matrix
    ids: NDArray[np.int32]
    xyz: Matrix
    features: Features
    n_matches: int
    n_expected: int
    n_trusted: int
    visible: NDArray[np.int32]
    stands_still: bool = False

    @property
    def support(self) -> int:
        """Number of inliers that count when poses are compared. New landmarks may belong to a
        moving object. They count only if hardly any trusted landmark is expected."""
        return self.n_trusted if self.n_expected >= MIN_TRUSTED else len(self.ids)

    @property
    def trusted_share(self) -> float | None:
        """Share of the expected trusted landmarks among the inliers; None if few are expected."""
        few = self.n_expected < MIN_TRUSTED
        return None if few else self.n_trusted / self.n_expected

    @property
    def lacks_support(self) -> bool:
        """Whether so few of the trusted landmarks agree that the pose may be that of a moving
        object."""
        return self.support < SUPPORT_SHARE * self.n_expected

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
    0,
    0,
    np.empty(0, np.int32),
)


class _Found(NamedTuple):
    """The patches that were found in an image.

    Attributes:
        visible, expected: ``(L,)`` bool, the landmarks with patches that the frame should see, and
            those whose patches were searched for.
        seen: ``(N,)`` indices of the landmarks whose patches were found.
        xy, level: ``(N, 2)`` float32 positions in pixels, and ``(N,)`` uint8 octaves.
    """

    visible: NDArray[np.bool_]
    expected: NDArray[np.bool_]
    seen: NDArray[np.int64]
    xy: NDArray[np.float32]
    level: NDArray[np.uint8]

    def select(self, chosen: NDArray[np.bool_]) -> _Found:
        """Return only the chosen patches; ``chosen`` is ``(N,)`` bool."""
        return self._replace(seen=self.seen[chosen], xy=self.xy[chosen], level=self.level[chosen])


def stride_of(patches: LandmarkPatches, local: LocalMap, T_cw: Matrix, context: Context) -> int:
    """Return the ``MapView.patch_stride``. It is 1 for a stereo or monocular camera.

    An RGB-D camera maps nearly all features of a keyframe at once, so that thousands of landmarks
    are visible in a room. With 500 of them, poses are already more accurate than by features. The
    others are left out evenly, so that the shares of patches that are found, that agree with the
    pose and that are trusted stay the same.

    Args:
        patches: patches of landmarks of ``local``.
        T_cw: ``(4, 4)`` pose of the reference keyframe (world to camera).
    """
    if not context.camera.depth:
        return 1
    at = np.searchsorted(local.ids, patches.ids)
    known = LocalMap._make(values[at] for values in local)
    _, radius, _ = predict_landmarks(T_cw, known, 1.0, None, context)
    return max(1, round(np.count_nonzero(radius) / _ENOUGH))


def track_patches(
    pyramid: Pyramid,
    T_cw: Matrix,
    view: MapView,
    context: Context,
    mask: Mask | None = None,
) -> PatchTrack:
    """Search an image for the image patches of the landmarks in the local map, and optimise the
    pose.

    Args:
        T_cw: ``(4, 4)`` initial pose (world to camera). Its error may shift projected landmarks by
            about two pixels.
        mask: the mask of the image; None uses all pixels.
    """
    found = _search(pyramid, T_cw, view, context, mask)
    return _optimised(found, T_cw, view, context)


def track_standing(
    pyramid: Pyramid,
    T_cw: Matrix,
    standstill: Standstill,
    view: MapView,
    context: Context,
    mask: Mask | None = None,
) -> PatchTrack:
    """Do the same for a camera that stood still in the last frame. The result has no landmarks if
    the camera has moved off.

    The landmarks that did not move in the image determine the pose.

    Args:
        T_cw: ``(4, 4)`` pose of the last frame (world to camera).
    """
    found = _search(pyramid, T_cw, view, context, mask)
    known, flow = standstill.flow(view.with_patches.ids[found.seen], found.xy)
    found, flow = found.select(known), flow[known]
    xyz, scale = view.with_patches.xyz[found.seen], context.scales[found.level]
    stayed = is_small(flow, scale)
    moving = _optimised(found, T_cw, view, context, ask_trusted=False)
    project = context.camera.project
    moved = project(transform(moving.T_cw, xyz)) - project(transform(standstill.T_cw, xyz))
    close = transform(T_cw, xyz)[:, 2] < context.close_depth
    if not still_stands(stayed, is_small(flow - moved[:, :2], scale), close):
        return NO_PATCHES_FOUND
    track = _optimised(found.select(stayed), T_cw, view, context, ask_trusted=False)
    if np.count_nonzero(stayed) < MEASURE_SHARE * len(standstill.ids):
        # The rest is covered. What is left measures the pose worse than the last frame did.
        track = track._replace(T_cw=T_cw)
    return track._replace(stands_still=True)


def _search(
    pyramid: Pyramid, T_cw: Matrix, view: MapView, context: Context, mask: Mask | None
) -> _Found:
    known, local = view.searched, view.with_patches
    camera, scales, config = context.camera, context.scales, context.config.alignment
    uvr, radius, octave = predict_landmarks(T_cw, local, 1.0, mask, context)
    margin = _MARGIN * scales[octave]
    size = np.array([camera.width, camera.height])
    inside = (uvr[:, :2] > margin[:, None]) & (uvr[:, :2] < size - 1 - margin[:, None])
    expected = (radius > 0) & inside.all(axis=1)
    tried = np.flatnonzero(expected)
    level = octave[tried].astype(np.uint8)
    xy = _whole_pixels(uvr[tried, :2], pyramid, level)
    shift = find_patches(
        pyramid, xy, level, T_cw, local.xyz[tried], known, tried, scales, camera.intrinsics, config
    )
    found = np.isfinite(shift[:, 0])
    xy = xy[found] + shift[found] * scales[level[found]][:, None].astype(np.float32)
    return _Found(radius > 0, expected, tried[found], xy, level[found])


def _optimised(
    found: _Found,
    T_cw: Matrix,
    view: MapView,
    context: Context,
    *,
    ask_trusted: bool = True,
) -> PatchTrack:
    """Optimise the pose. ``ask_trusted`` is whether trusted landmarks decide if most landmarks
    contradict them (`optimise_pose`)."""
    expected = np.flatnonzero(found.expected)
    trusted = np.zeros(len(found.expected), np.bool_)
    trusted[expected] = trusted_landmarks(
        view.with_patches.confirmed[expected], view.with_patches.xyz[expected], T_cw, context
    )
    known, local, scale = view.searched, view.with_patches, context.scales[found.level]
    uvr = np.full((len(found.seen), 3), np.nan)
    uvr[:, :2] = found.xy
    T_found, inlier = optimise_pose(
        T_cw,
        local.xyz[found.seen],
        uvr,
        context.aligned_certainty * scale**-2.0,
        context.camera.intrinsics,
        trusted=trusted[found.seen] if ask_trusted else None,
        confirmed=local.confirmed[found.seen],
    )
    seen, xy, level = found.seen[inlier], found.xy[inlier], found.level[inlier]
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
        int(np.count_nonzero(trusted)),
        int(np.count_nonzero(trusted[seen])),
        local.ids[found.visible],
    )


def _whole_pixels(
    uv: NDArray[np.float64], pyramid: Pyramid, level: NDArray[np.uint8]
) -> NDArray[np.float32]:
    """Round ``(N, 2)`` full-resolution positions to the nearest whole pixels of their levels."""
    ratio = pyramid.shapes[0, ::-1] / pyramid.shapes[level][:, ::-1]
    pixel = np.rint((uv + 0.5) / ratio - 0.5)
    return ((pixel + 0.5) * ratio - 0.5).astype(np.float32)
