"""A map with all data that a later run needs to continue the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.types.camera import Camera
from vslam.types.frame_poses import FrameTable
from vslam.types.geometry import inverses, orthonormalised
from vslam.types.loops import DetectorMemory, LoopEdge, PerKeyframe, ranges
from vslam.types.map import (
    CARRIED,
    KEYFRAME_FIELDS,
    LANDMARK_FIELDS,
    NONE,
    PREDICTED,
    ROW_FIELDS,
    UNPREDICTED,
    KeyframeTable,
    Map,
    loop_of_living,
    revisits_of_living,
)
from vslam.types.map_kernels import gather_observations, resolve
from vslam.types.states import Checkpoint


@dataclass(frozen=True)
class TruthAlignment:
    """The transformation from a map to the frame of a ground truth.

    Attributes:
        name: name of the data set and the sequence of the ground truth.
        S_truth_world: ``(4, 4)`` transformation from the world frame of the map to the world frame
            of the ground truth. It aligns the trajectory of the first drive. It is a rigid motion,
            or a similarity for a monocular map.
    """

    name: str
    S_truth_world: NDArray[np.float64]


@dataclass(frozen=True)
class StoredMap:
    """The content of a map file.

    Attributes:
        map: keyframes, landmarks and observations. Culled entries have been removed, except in a
            map with a checkpoint.
        loops: closed loops, without features and landmarks. Their translations are in the current
            unit of the map.
        detector: data that the loop detector has stored about the keyframes.
        images: JPEG files (uint8) of keyframes, from which learned descriptors can be computed.
            None if the run used no learned descriptors.
        frames: poses of the frames of the last drive. None if they were not kept.
        drives: source of the images of each drive, such as "kitti 06".
        thresholds: thresholds of the last drive that differed from the defaults, by dotted name.
        truth_alignment: the transformation from the map to the frame of a ground truth. None
            without ground truth.
        checkpoint: state from which the last drive continues with the same results as an
            uninterrupted run. None if the map has no culled entries or if no checkpoint was
            possible.
    """

    map: Map
    camera: Camera
    loops: tuple[LoopEdge, ...] = ()
    detector: DetectorMemory = field(default_factory=DetectorMemory)
    images: PerKeyframe | None = None
    frames: FrameTable | None = None
    drives: tuple[str, ...] = ()
    thresholds: dict[str, Any] = field(default_factory=dict)
    truth_alignment: TruthAlignment | None = None
    checkpoint: Checkpoint | None = None

    def compact(self, *, copy: bool = True) -> StoredMap:
        """Copy the map without its culled keyframes and landmarks.

        The remaining keyframes and landmarks are numbered without gaps. Poses of frames relative to
        a culled keyframe are converted to poses relative to the parent of this keyframe. Landmarks
        are ordered by the first remaining keyframe that observes them.

        Args:
            copy: if False and if all keypoints are kept, the arrays of keypoints are views instead
                of copies. These arrays make up three quarters of the size of a map.
        """
        return self.select(self.map.living_keyframes(), copy=copy)

    def select(self, keyframes: NDArray[np.int64], *, copy: bool = True) -> StoredMap:
        """Copy a part of the map: some keyframes, and the landmarks that they observe. Both are
        numbered without gaps.

        Args:
            keyframes: ``(K,)`` ids of keyframes that were not culled, in ascending order. The poses
                of frames are kept only if all keyframes that were not culled are selected.
            copy: if False and if all keypoints are kept, the arrays of keypoints are views instead
                of copies.
        """
        map_ = self.map
        whole = len(keyframes) == np.count_nonzero(map_.arrays.keyframe_alive[: map_.n_keyframes])
        new_id = np.full(map_.n_keyframes, NONE, np.int64)
        new_id[keyframes] = np.arange(len(keyframes))
        loops = []
        for loop in self.loops:
            edge = loop_of_living(map_, loop)
            query, match = int(new_id[edge.query]), int(new_id[edge.match])
            if query >= 0 and match >= 0 and query != match:
                loops.append(replace(edge, query=query, match=match, features=None, landmarks=None))
        frames = self.frames if whole else None
        tables = {name: table.select(keyframes) for name, table in self.detector.tables.items()}
        return replace(
            self,
            map=selected(map_, keyframes, copy=copy),
            loops=tuple(loops),
            detector=replace(self.detector, tables=tables),
            images=None if self.images is None else self.images.select(keyframes),
            frames=None if frames is None else _renumbered(frames, map_, new_id),
            checkpoint=None,
        )


def selected(map_: Map, keyframes: NDArray[np.int64], *, copy: bool = True) -> Map:
    """Copy a part of a map: some keyframes, and the landmarks that they observe. Both are numbered
    without gaps.

    The parent of a keyframe is its nearest selected ancestor, or the first selected keyframe if no
    ancestor is selected.

    Args:
        keyframes: ``(K,)`` ids of keyframes that were not culled, in ascending order.
        copy: see ``StoredMap.select``.
    """
    a, n = map_.arrays, len(keyframes)
    new_id = np.full(map_.n_keyframes, NONE, np.int64)
    new_id[keyframes] = np.arange(n)

    living = map_.living_landmarks()
    first, rows = gather_observations(a, living.astype(np.int32), new_id)
    count = np.diff(first)
    anchor = new_id[a.first_keyframe[living]]
    # If the first keyframe of a landmark is not selected, the earliest selected keyframe that
    # observes the landmark replaces it.
    earliest = np.full(len(living), n, np.int64)
    np.minimum.at(earliest, np.repeat(np.arange(len(living)), count), new_id[a.keyframe[rows]])
    anchor = np.where(anchor >= 0, anchor, earliest)
    kept = np.flatnonzero(count > 0)
    kept = kept[np.argsort(anchor[kept], kind="stable")]
    landmarks = living[kept]
    observing = rows[ranges(first[kept], count[kept])]

    kept_rows = ranges(a.first_row[keyframes], np.diff(a.first_row)[keyframes])
    new_row = np.full(map_.n_rows, NONE, np.int64)
    new_row[kept_rows] = np.arange(len(kept_rows))
    first_row = np.concatenate([[0], np.cumsum(np.diff(a.first_row)[keyframes])]).astype(np.int64)
    links = observations(
        new_row[observing],
        np.concatenate([[0], np.cumsum(count[kept])]),
        a.u_right[kept_rows],
    )
    all_kept = len(kept_rows) == map_.n_rows
    chosen_rows = slice(None) if all_kept and not copy else kept_rows
    parent, restart = _spanning_tree(map_, keyframes, new_id)
    follows = np.r_[False, np.diff(keyframes) == 1]  # its motion began at a selected keyframe
    renumbered: dict[str, NDArray] = {
        "first_row": first_row,
        "motion_seconds": np.where(follows, map_.keyframes.motion_seconds[keyframes], 0.0),
        "first_keyframe": anchor[kept].astype(np.int32),
        "keyframe": np.repeat(np.arange(n, dtype=np.int32), np.diff(first_row)),
        "parent": parent,
        "restart": restart,
        **links,
    }
    columns = map_.columns()
    for fields, chosen in (
        (KEYFRAME_FIELDS + KeyframeTable._fields, keyframes),
        (LANDMARK_FIELDS, landmarks),
        (ROW_FIELDS, chosen_rows),
    ):
        for name in fields:
            columns[name] = renumbered[name] if name in renumbered else columns[name][chosen]
    result = map_.with_columns(columns)
    new_landmark = np.full(map_.n_landmarks + 1, NONE, np.int32)  # the extra entry maps -1 to -1
    new_landmark[landmarks] = np.arange(len(landmarks))
    revisits = revisits_of_living(map_)
    revisits = revisits.observing(new_landmark[resolve(a, revisits.landmark)])
    revisits = replace(revisits, keyframe=new_id[revisits.keyframe])
    result.revisits = revisits.select(np.flatnonzero(revisits.keyframe >= 0))
    result.scalars = replace(map_.scalars, calibrated_until=n - 1)
    return result


def observations(
    rows: NDArray[np.int64], first: NDArray[np.int64], u_right: NDArray[np.float32]
) -> dict[str, NDArray]:
    """Create the arrays of a map (``Arrays``) that represent observations.

    Args:
        rows: ``(O,)`` indices of the keypoints that observe the landmarks, sorted by landmark. Each
            keypoint occurs at most once.
        first: ``(L + 1,)`` offset of each landmark in ``rows``.
        u_right: ``(R,)`` column of the stereo match of each keypoint, in the right image. NaN for a
            keypoint without a stereo match.
    """
    count = np.diff(first)
    landmark, next_row = (np.full(len(u_right), NONE, np.int32) for _ in range(2))
    landmark[rows] = np.repeat(np.arange(len(count), dtype=np.int32), count)
    seen = np.flatnonzero(count)
    last = np.zeros(len(rows), np.bool_)
    last[first[seen + 1] - 1] = True
    following = np.flatnonzero(~last)
    next_row[rows[following]] = rows[following + 1]
    weight = np.where(np.isnan(u_right[rows]), 1, 2)  # a stereo observation counts twice
    head, n_observations = np.full(len(count), NONE, np.int32), np.zeros(len(count), np.int32)
    if len(seen):
        head[seen] = rows[first[seen]]
        n_observations[seen] = np.add.reduceat(weight, first[seen])
    return {
        "landmark": landmark,
        "next_row": next_row,
        "head": head,
        "n_observations": n_observations,
    }


def appended(one: StoredMap, other: StoredMap) -> StoredMap:
    """Append a map to another map, as a sub-map at an unknown pose. Neither map may contain culled
    keyframes or landmarks."""
    a, b = one.map, other.map
    n, drives = a.n_keyframes, a.scalars.session + 1
    shift = {
        "first_row": a.n_rows, "first_keyframe": n, "keyframe": n, "landmark": a.n_landmarks,
        "fused_into": a.n_landmarks, "head": a.n_rows, "next_row": a.n_rows, "parent": n,
        "session": drives,
    }  # fmt: skip

    first, second = a.columns(), b.columns()
    for name, by in shift.items():
        column = second[name]
        second[name] = np.where(column >= 0, column + by, NONE).astype(column.dtype)
    first["first_row"] = first["first_row"][:-1]  # its last entry is the first of the second map
    columns = {name: np.concatenate([column, second[name]]) for name, column in first.items()}
    columns["parent"][n + np.flatnonzero(b.parents < 0)] = 0
    columns["restart"][n : n + 1] = UNPREDICTED
    both = a.with_columns(columns)
    both.revisits = a.revisits.followed_by(b.revisits, n, a.n_landmarks)
    both.scalars = replace(
        a.scalars, session=drives + b.scalars.session, calibrated_until=both.n_keyframes - 1
    )
    loops = tuple(replace(loop, query=n + loop.query, match=n + loop.match) for loop in other.loops)
    tables = {
        name: table.followed_by(other.detector.tables[name])
        for name, table in one.detector.tables.items()
    }
    images = None
    if one.images is not None or other.images is not None:
        images = _images_of(one).followed_by(_images_of(other))
    return StoredMap(
        map=both,
        camera=one.camera,
        loops=(*one.loops, *loops),
        detector=replace(one.detector, tables=tables),
        images=images,
        drives=(*one.drives, *other.drives),
        thresholds=one.thresholds,
        truth_alignment=one.truth_alignment,
    )


def _images_of(stored: StoredMap) -> PerKeyframe:
    """Return the images of a map. A map without images gets an empty entry for each keyframe."""
    if stored.images is not None:
        return stored.images
    return PerKeyframe(np.zeros(stored.map.n_keyframes + 1, np.int64), np.empty(0, np.uint8))


def _spanning_tree(
    map_: Map, keyframes: NDArray[np.int64], new_id: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return the arrays ``parent`` and ``restart`` for a map of the selected keyframes."""
    n, parents = len(keyframes), map_.parents.tolist()
    parent = np.full(n, NONE, np.int64)
    for k, keyframe in enumerate(keyframes.tolist()):
        ancestor = parents[keyframe]
        while ancestor >= 0 and new_id[ancestor] < 0:
            ancestor = parents[ancestor]
        if ancestor >= 0:
            parent[k] = new_id[ancestor]

    # If the first keyframe of a sub-map is not selected, the sub-map begins at its first selected
    # keyframe.
    restart = np.zeros(n, np.uint8)
    begins = np.array(map_.restarts, np.int64)
    position = np.searchsorted(keyframes, begins)
    inside = (position > 0) & (position < n)
    for how in (CARRIED, PREDICTED, UNPREDICTED):  # the least that is known counts
        restart[position[inside & (map_.keyframes.restart[begins] == how)]] = how

    orphans = 1 + np.flatnonzero(parent[1:] < 0)
    parent[orphans] = 0
    submap = map_.submaps()[keyframes]
    restart[orphans[submap[orphans] != submap[:1]]] = UNPREDICTED
    return parent, restart


def _renumbered(frames: FrameTable, map_: Map, new_id: NDArray[np.int64]) -> FrameTable:
    """Convert the poses of frames so that they are relative to keyframes that were not culled."""
    reference = frames.reference.copy()
    T_c_reference, unit = frames.T_c_reference.copy(), frames.unit_scale.copy()
    table = map_.keyframes
    for i, keyframe in enumerate(frames.reference.tolist()):
        if not map_.n_keyframes or map_.arrays.keyframe_alive[keyframe]:
            continue
        # This replaces the reference, but does not change the pose that FramePoses.pose returns.
        T_c_reference[i, :3, 3] *= table.unit_scale[keyframe] / unit[i]
        T_c_reference[i] = orthonormalised(T_c_reference[i] @ table.T_c_parent[keyframe])
        reference[i] = table.parent[keyframe]
        unit[i] = table.unit_scale[reference[i]]
    reference = new_id[reference] if map_.n_keyframes else reference
    return frames._replace(reference=reference, T_c_reference=T_c_reference, unit_scale=unit)


def in_box(map_: Map, box: Sequence[float]) -> NDArray[np.int64]:
    """Return the ids of the keyframes in a box, in ascending order, without culled keyframes.
    ``box`` is the range of x followed by the range of z, in metres."""
    keyframes, xz = _places(map_)
    low, high = np.array(box).reshape(2, 2).T
    return keyframes[((xz >= low) & (xz <= high)).all(axis=1)]


def near_point(map_: Map, point: Sequence[float], within: float) -> NDArray[np.int64]:
    """Return the ids of the keyframes near a point, in ascending order, without culled keyframes.

    Args:
        point: x and z in metres.
        within: largest distance in metres.
    """
    keyframes, xz = _places(map_)
    return keyframes[np.linalg.norm(xz - point, axis=1) <= within]


def near_frames(
    map_: Map, drive: int, first: float, last: float, within: float
) -> NDArray[np.int64]:
    """Return the ids of the keyframes near some frames of a drive, in ascending order, without
    culled keyframes.

    A keyframe is included if it is at most ``within`` metres from a keyframe that was made from the
    frames ``first`` to ``last``.
    """
    from scipy.spatial import cKDTree

    keyframes, xz = _places(map_)
    frame, session = map_.frames[keyframes], map_.sessions[keyframes]
    named = (session == drive) & (frame >= first) & (frame <= last)
    if not named.any():
        return keyframes[:0]
    distance, _ = cKDTree(xz[named]).query(xz)
    return keyframes[distance <= within]


def _places(map_: Map) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the keyframes that were not culled, and their ``(N, 2)`` positions x and z."""
    keyframes = map_.living_keyframes()
    return keyframes, inverses(map_.arrays.T_cw[keyframes])[:, [0, 2], 3]
