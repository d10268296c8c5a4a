"""Functions that relate a frame to the map through observations, landmarks and places.

The caller must ensure that no other thread writes the map while one of these functions runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.frontend.patches import certainty_of
from vslam.frontend.rig import with_offset
from vslam.method.hypotheses import joined_submaps
from vslam.method.starter import TwoViewStart
from vslam.types.context import Context
from vslam.types.features import TrackingState
from vslam.types.frame_poses import FramePoses
from vslam.types.geometry import compose, inverse, inverses, orthonormalised, transform
from vslam.types.loops import LoopEdge
from vslam.types.map import Map
from vslam.types.map_kernels import (
    count_seen_by,
    gather_observations,
    link_many,
    refresh_landmarks,
    resolve,
)
from vslam.types.map_view import MapView
from vslam.types.reprojection import stack_uvr
from vslam.types.revisits import MAX_REVISITS, Revisits
from vslam.types.track import Track
from vslam.types.trajectory import Trajectory

_STRETCH = 10  # keyframes of a stretch after which a place is old


def add_frame(
    map_: Map, track: Track, certainty: NDArray[np.uint8] | int, reference: int, *, predicted: bool
) -> int:
    """Add a frame, with the landmarks that it tracks, to the map as a keyframe. Return its id.

    A frame that tracks no landmark of another keyframe begins a sub-map.

    Args:
        certainty: ``(N,)`` certainty of the features of the frame (``Arrays.certainty``).
        reference: if the keyframe begins a sub-map, its parent.
        predicted: if the keyframe begins a sub-map, whether its pose was predicted.
    """
    keyframe = map_.add_keyframe(
        track.refined_features(), track.T_cw, track.timestamp, track.index, certainty, track.gravity
    )
    tracked = np.flatnonzero(track.landmark >= 0)
    link_many(map_.arrays, map_.rows(keyframe).start + tracked, track.landmark[tracked])
    if keyframe > 0:
        neighbours, _ = map_.covisible(keyframe)
        if len(neighbours):
            map_.parents[keyframe] = int(neighbours[0])
        else:
            carried = track.state == TrackingState.INERTIAL
            map_.begin_submap(keyframe, reference, predicted=predicted, carried=carried)
    return keyframe


def add_two_views(
    map_: Map, start: TwoViewStart, reference: int, context: Context
) -> tuple[int, int]:
    """Add the first two keyframes of a monocular map or sub-map, and their common landmarks.

    Args:
        reference: if the first keyframe begins a sub-map, its parent.

    Returns:
        The ids of the two keyframes.
    """
    one, two, T_1_w = start.first, start.second, start.first.T_cw
    keyframes = []
    for track, T_cw, seen in (
        (one, T_1_w, start.features[0]),
        (two, compose(start.T_2_1, T_1_w), start.features[1]),
    ):
        # Only which features match matters here; the landmarks have no ids yet.
        matched = track.matching(seen, np.zeros(len(seen), np.int32), start.points)
        certainty = certainty_of(matched if track is two else track, context)
        keyframe = map_.add_keyframe(
            matched.refined_features(), T_cw, track.timestamp, track.index, certainty, track.gravity
        )
        keyframes.append(keyframe)
    first, second = keyframes
    rows = [
        map_.rows(keyframe).start + features
        for keyframe, features in zip((first, second), start.features, strict=True)
    ]
    xyz = transform(inverse(T_1_w), start.points)
    ids = map_.add_landmarks(xyz, map_.arrays.descriptor[rows[1]], first)
    for rows_of_view in rows:
        link_many(map_.arrays, rows_of_view, ids)
    refresh_landmarks(map_.arrays, ids, map_.scales)
    if first > 0:
        map_.begin_submap(first, reference, predicted=start.predicted, carried=start.is_carried)
    map_.parents[second] = first
    return first, second


def newest_unit(map_: Map) -> int:
    """Return the first keyframe of a monocular map whose unit of length is that of the newest
    keyframe: that of the newest sub-map if the map was metric before, otherwise the first one."""
    return map_.restarts[-1] if map_.scalars.metric and map_.restarts else 0


class LandmarkCounts:
    """Counts how often landmarks should have been seen, and how often they were found.

    The counters of the map can be updated only while no other thread writes the map. Until then,
    this object stores the ids of the landmarks to be counted.
    """

    def __init__(self) -> None:
        self._visible: list[NDArray[np.int32]] = []
        self._found: list[NDArray[np.int32]] = []

    def add(self, visible: NDArray[np.int32], found: NDArray[np.int32]) -> None:
        """Add ``(N,)`` landmarks that a frame should have seen, and ``(M,)`` that it found."""
        self._visible.append(visible)
        self._found.append(found)

    def write(self, map_: Map) -> None:
        """Update the counters of the map, and forget the stored landmarks."""
        a = map_.arrays
        for seen, counter in ((self._visible, a.visible), (self._found, a.found)):
            for ids in seen:
                counter[ids] += 1
            seen.clear()


def has_more_points(map_: Map, keyframe: int, track: Track) -> bool:
    """Return whether the far stereo points of a keyframe have not been mapped yet.

    This is the case if the keyframe begins a map or sub-map, no keyframe follows it, and ``track``
    is the frame that became this keyframe.
    """
    begins = keyframe == 0 or keyframe in map_.restarts
    return begins and keyframe == map_.n_keyframes - 1 and map_.frames[keyframe] == track.index


def observe_keyframe(track: Track, map_: Map, keyframe: int) -> Track:
    """Return a frame that became a keyframe with all landmarks that this keyframe observes."""
    track = with_landmarks(track, map_.arrays.landmark[map_.rows(keyframe)], map_)
    return replace(track, is_keyframe=True)


def with_landmarks(track: Track, landmark: NDArray[np.int32], map_: Map) -> Track:
    """Return a frame with the landmarks of its features, where they are in the map now.

    The ids of culled landmarks become -1. If two landmarks were fused, only the first of the two
    features keeps the landmark.

    Args:
        landmark: ``(N,)`` int32 id of the landmark of each feature, or -1.
    """
    arrays = map_.arrays
    ids = resolve(arrays, landmark)
    _, first = np.unique(ids, return_index=True)
    repeated = np.ones(len(ids), np.bool_)
    repeated[first] = False
    ids[repeated] = -1
    xyz = np.where((ids >= 0)[:, None], arrays.xyz[ids], np.nan)
    return replace(track, landmark=ids, xyz=xyz)


@dataclass(frozen=True)
class MapChange:
    """What publishing a result changed for the frames that tracking holds.

    Apply it before the map is changed again.

    Attributes:
        before, after: what tracking saw of the map before and after the change.
        map: the changed map.
        frames: the recorded poses of all frames.
    """

    before: MapView
    after: MapView
    map: Map
    frames: FramePoses

    def applied_to(self, track: Track) -> Track:
        """Return a frame after the change: its landmarks, disparities, pose and velocity.

        A frame whose pose has been recorded moves with its own reference keyframe. Any other frame
        moves with the current reference keyframe.
        """
        before, after = self.before, self.after
        growth = after.unit_scale / before.unit_scale
        if track.index < len(self.frames):
            T_cw = self.frames.pose(track.index)
        else:
            T_c_reference = track.T_cw @ inverse(before.T_reference)
            T_c_reference[:3, 3] *= growth
            T_cw = orthonormalised(T_c_reference @ after.T_reference)
        twist = track.twist
        if twist is not None:
            twist = np.concatenate([twist[:3] * growth, twist[3:]])
        extracted = with_offset(track.extracted, after.disparity_offset)
        moved = replace(track, T_cw=T_cw, twist=twist, extracted=extracted)
        return with_landmarks(moved, track.landmark, self.map)


def count_shared_landmarks(map_: Map, track: Track) -> NDArray[np.int64]:
    """Count the landmarks that each of ``(n_keyframes,)`` keyframes shares with a frame."""
    a, n = map_.arrays, map_.n_keyframes
    _, rows = gather_observations(a, track.tracked, np.arange(n))
    return np.bincount(a.keyframe[rows], minlength=n)


class OldPlace(NamedTuple):
    """A place that was mapped some time ago, or on an earlier drive.

    Attributes:
        keyframe: the keyframe that shares the most landmarks with a frame.
        n_shared: number of landmarks that the keyframe shares with the frame.
        n_place: number of landmarks of the keyframe that at least three keyframes observe.
    """

    keyframe: int
    n_shared: int
    n_place: int


def find_old_place(map_: Map, track: Track, known_after_s: float) -> OldPlace | None:
    """Find the old keyframe that shares the most landmarks with a frame.

    A keyframe is old if it was added at least ``known_after_s`` seconds ago or on an earlier drive.
    The result is None if no old keyframe shares a landmark with the frame.
    """
    young = map_.sessions == map_.scalars.session
    young &= map_.timestamps > track.timestamp - known_after_s
    shared = np.where(young, 0, count_shared_landmarks(map_, track))
    best = int(np.argmax(shared))
    if shared[best] == 0:
        return None
    return OldPlace(best, int(shared[best]), count_seen_by(map_.arrays, best, 3))


def sees_old_place(map_: Map, keyframe: int, min_shared: int) -> bool:
    """Return whether a new keyframe has returned to an old place.

    The keyframe then shares landmarks with keyframes before and after a stretch of the drive, but
    not with the keyframes of this stretch.

    Args:
        min_shared: two keyframes show the same place if they share this many landmarks.
    """
    seen = np.sort(map_.covisible(keyframe, min_shared)[0])
    number = np.searchsorted(map_.living_keyframes(), [*seen, keyframe])
    return bool((np.diff(number) > _STRETCH).any())


def add_revisit(map_: Map, keyframe: int, track: Track, certainty: NDArray[np.uint8] | int) -> bool:
    """Keep what a frame at a known place observes, unless there are enough revisits of this place.

    Args:
        keyframe: the old keyframe that becomes the reference keyframe of the frame.
        certainty: ``(N,)`` certainty of the features of the frame (``Arrays.certainty``).

    Returns:
        Whether the observations were kept.
    """
    if np.count_nonzero(map_.revisits.keyframe == keyframe) >= MAX_REVISITS:
        return False
    features = track.refined_features()
    tracked = np.flatnonzero(track.landmark >= 0)
    new = Revisits(
        np.array([keyframe]),
        (track.T_cw @ inverse(map_.keyframe_pose(keyframe)))[None],
        np.array([0, len(tracked)]),
        track.landmark[tracked],
        stack_uvr(features.xy[tracked], features.u_right[tracked]).astype(np.float32),
        features.octave[tracked],
        np.broadcast_to(np.uint8(certainty), len(features))[tracked],
    )
    map_.revisits = map_.revisits.followed_by(new)
    return True


def keyframe_trajectory(map_: Map) -> Trajectory:
    """Return the poses of the keyframes of the last drive, without culled keyframes."""
    living = map_.living_keyframes()
    living = living[map_.sessions[living] == map_.scalars.session]
    return Trajectory(map_.timestamps[living], inverses(map_.arrays.T_cw[living]))


def in_first_part(map_: Map, closed: Sequence[LoopEdge], frames: FramePoses) -> NDArray[np.bool_]:
    """Return an ``(N,)`` bool array, True for frames that were tracked in the first sub-map.

    If a closed loop has joined another sub-map to the first one, its frames count as well.
    """
    table = frames.table()
    if not map_.n_keyframes:
        return table.tracked
    part = joined_submaps(map_, closed)
    return table.tracked & (part[table.reference] == part[0])
