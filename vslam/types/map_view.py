"""Copies of parts of the map, which tracking reads while local mapping writes the map."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.types.features import NO_PATCHES, LandmarkPatches
from vslam.types.geometry import Matrix
from vslam.types.map import Map
from vslam.types.map_kernels import collect_landmarks, count_seen_by


class LocalMap(NamedTuple):
    """A copy of the N landmarks that a keyframe and its covisible keyframes observe.

    Attributes:
        ids: ``(N,)`` int32 ids of the landmarks.
        xyz, normal, distance_range, descriptor: ``(N, ...)`` data of the landmarks, as in
            ``Arrays``.
        confirmed: ``(N,)`` bool, whether at least two keyframes observe the landmark. It was then
            at rest between these keyframes. A new landmark may belong to a moving object.
    """

    ids: NDArray[np.int32]
    xyz: NDArray[np.float64]
    normal: NDArray[np.float64]
    distance_range: NDArray[np.float64]
    descriptor: NDArray[np.uint64]
    confirmed: NDArray[np.bool_]

    def confirms(self, ids: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Return an ``(M,)`` bool array that tells which of M landmarks are in this local map and
        confirmed. The landmarks are given by their ids, or -1."""
        if not len(self.ids):
            return np.zeros(len(ids), np.bool_)
        at = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return (self.ids[at] == ids) & self.confirmed[at]


def local_map(map_: Map, keyframe: int, limit: int) -> LocalMap:
    """Copy the landmarks of a keyframe and of its covisible keyframes (ORB-SLAM, V-D).

    ORB-SLAM also takes the neighbours of the covisible keyframes. Including these neighbours made
    no difference in our measurements (docs/explanation/design.md).

    Args:
        limit: greatest number of keyframes. The keyframes that share the most landmarks are chosen.
    """
    first, _ = map_.covisible(keyframe)
    chosen = [keyframe, *first[: limit - 1].tolist()]
    a = map_.arrays
    ids = collect_landmarks(a, np.array(chosen, np.int64), map_.n_landmarks)
    return LocalMap(
        ids,
        a.xyz[ids],
        a.normal[ids],
        a.distance_range[ids],
        a.landmark_descriptor[ids],
        a.next_row[a.head[ids]] >= 0,
    )


NO_LANDMARKS = LocalMap(
    np.empty(0, np.int32),
    np.empty((0, 3)),
    np.empty((0, 3)),
    np.empty((0, 2)),
    np.empty((0, 4), np.uint64),
    np.empty(0, np.bool_),
)


@dataclass(frozen=True)
class MapView:
    """A copy of the parts of the map that tracking reads. The default values describe an empty map.

    Attributes:
        reference: the keyframe that frames are tracked against. It is usually the newest keyframe.
        T_reference: ``(4, 4)`` pose ``T_cw`` of the reference keyframe.
        unit_scale: factor by which loop closures have scaled lengths near the reference keyframe
            since it was added. It is 1 in metric maps.
        n_keyframes: number of keyframes so far, including culled keyframes.
        local_landmarks: landmarks of the reference keyframe and of its covisible keyframes.
        reference_landmarks: landmarks of the reference keyframe alone.
        n_reference: number of ``reference_landmarks`` that at least three keyframes observe. If the
            map has fewer than three keyframes, all of its keyframes must observe the landmark.
        patches: image patches of the local landmarks that the newest keyframes observe.
        searched: every ``patch_stride``-th of these patches, which tracking searches for.
        with_patches: the landmarks of these patches, in the same order as in ``searched``.
        patch_stride: see above. It is 1 unless many landmarks are visible.
        disparity_offset: offset that is added to every measured disparity, in pixels.
        offset_sigma: standard deviation of ``disparity_offset``, in pixels.
        part: index of the part of the map that contains the reference keyframe
            (``TrackResult.part``).
        metric: whether the unit of a monocular map is the metre.
    """

    reference: int = 0
    T_reference: Matrix = field(default_factory=lambda: np.eye(4))
    unit_scale: float = 1.0
    n_keyframes: int = 0
    local_landmarks: LocalMap = NO_LANDMARKS
    reference_landmarks: LocalMap = NO_LANDMARKS
    n_reference: int = 0
    patches: LandmarkPatches = NO_PATCHES
    searched: LandmarkPatches = NO_PATCHES
    with_patches: LocalMap = NO_LANDMARKS
    patch_stride: int = 1
    disparity_offset: float = 0.0
    offset_sigma: float = 0.0
    part: int = 0
    metric: bool = False


def view_of(
    map_: Map,
    keyframe: int,
    local: LocalMap,
    patches: LandmarkPatches,
    patch_stride: int,
    *,
    monocular: bool,
) -> MapView:
    """Create the view of the map for a reference keyframe.

    Args:
        local: the landmarks of the keyframe and of its covisible keyframes.
        patches: image patches of those landmarks that the newest keyframes observe.
        patch_stride: see ``MapView``.
    """
    living = map_.living_keyframes()
    if monocular and map_.restarts:
        # A new sub-map counts as a young map: the monocular keyframe decision depends on it.
        living = living[living >= map_.restarts[-1]]
    searched = patches.every(patch_stride)
    at = np.searchsorted(local.ids, searched.ids)
    return MapView(
        reference=keyframe,
        T_reference=map_.keyframe_pose(keyframe),
        unit_scale=float(map_.unit_scale[keyframe]),
        n_keyframes=map_.n_keyframes,
        local_landmarks=local,
        reference_landmarks=local_map(map_, keyframe, 1),
        n_reference=count_seen_by(map_.arrays, keyframe, min(3, len(living))),
        patches=patches,
        searched=searched,
        patch_stride=patch_stride,
        with_patches=LocalMap._make(values[at] for values in local),
        disparity_offset=map_.scalars.disparity_offset,
        offset_sigma=map_.scalars.offset_sigma,
        metric=map_.scalars.metric,
    )
