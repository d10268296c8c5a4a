"""The map: keyframes, landmarks and observations as a structure of arrays.

A *row* is one keypoint of one keyframe; rows of a keyframe are consecutive. The table of rows is
the table of observations too: ``landmark[row]`` names the landmark that the keypoint observes, and
``next_row`` chains the rows of each landmark. Nothing is derived twice: covisibility is counted
from the rows when it is needed (after DPVO's PatchGraph, arrays instead of objects). Ids of
keyframes are never reused, those of landmarks until dead ones are dropped; arrays grow by half.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.features import Features
from vslam.geometry import compose, inverse, orthonormalised
from vslam.loops import LoopEdge
from vslam.map_kernels import count_shared, detach_keyframe, resolve

NONE = -1
_FEW_LANDMARKS = 8192  # 1 MB


class Arrays(NamedTuple):
    """The map as kernels see it. K keyframes, L landmarks, R rows (capacities, not counts).

    Keyframes: ``T_cw`` (K, 4, 4) f8; ``first_row`` (K + 1,) i8; ``keyframe_alive`` (K,) bool.
    Landmarks: ``xyz`` (L, 3) f8 world; ``normal`` (L, 3) f8 mean viewing direction;
    ``distance_range`` (L, 2) f8 least and greatest distance at which the pyramid sees it;
    ``landmark_descriptor`` (L, 4) u8; ``first_keyframe`` (L,) i4; ``visible``, ``found`` (L,) i4
    frames that should, and did, see it; ``landmark_alive`` (L,) bool; ``merged_into`` (L,) i4;
    ``head`` (L,) i4 first row of its chain; ``n_observations`` (L,) i4, stereo ones counting twice
    (ORB-SLAM2).
    Rows: ``xy`` (R, 2) f4; ``u_right`` (R,) f4; ``octave`` (R,) u1; ``angle`` (R,) f4;
    ``descriptor`` (R, 4) u8; ``keyframe`` (R,) i4; ``landmark``, ``next_row`` (R,) i4;
    ``certainty`` (R,) u1 how many times smaller the variance of ``xy`` is than that of a keypoint.
    """

    T_cw: NDArray[np.float64]
    first_row: NDArray[np.int64]
    keyframe_alive: NDArray[np.bool_]
    xyz: NDArray[np.float64]
    normal: NDArray[np.float64]
    distance_range: NDArray[np.float64]
    landmark_descriptor: NDArray[np.uint64]
    first_keyframe: NDArray[np.int32]
    visible: NDArray[np.int32]
    found: NDArray[np.int32]
    landmark_alive: NDArray[np.bool_]
    merged_into: NDArray[np.int32]
    head: NDArray[np.int32]
    n_observations: NDArray[np.int32]
    xy: NDArray[np.float32]
    u_right: NDArray[np.float32]
    octave: NDArray[np.uint8]
    angle: NDArray[np.float32]
    descriptor: NDArray[np.uint64]
    keyframe: NDArray[np.int32]
    landmark: NDArray[np.int32]
    next_row: NDArray[np.int32]
    certainty: NDArray[np.uint8]


KEYFRAME_FIELDS = Arrays._fields[:3]
LANDMARK_FIELDS = Arrays._fields[3:14]
ROW_FIELDS = Arrays._fields[14:]


def _grown(array: NDArray, capacity: int) -> NDArray:
    bigger = np.zeros((capacity, *array.shape[1:]), array.dtype)
    bigger[: len(array)] = array
    return bigger


class Map:
    """Growable map. One writer at a time: the caller orders tracking and local mapping.

    Attributes:
        arrays: everything that kernels touch.
        n_keyframes, n_landmarks, n_rows: how much of the capacity is in use, dead ones included.
        timestamps, frames, parents: of each keyframe: seconds, frame index, spanning-tree parent.
        sessions: of each keyframe: the drive that its time and frame are of, from 0.
        session: the drive of the keyframes to come.
        T_c_parent: pose relative to the parent, set when a keyframe is culled.
        unit_scale: of each keyframe: units of the map around it that were one when it was
            added. 1 in metric maps; loops of monocular ones change it.
        restarts: keyframes at which mapping began anew after the camera was lost, in order; each
            is the root of a sub-map, its pose relative to its parent only a prediction.
        unpredicted_restarts: those of them whose pose is not even that, since the speed of the
            camera was not known.
        disparity_offset: pixels that the pair sees too little of every disparity; ``u_right`` of
            all rows is free of it (``backend/disparity_offset.py``).
        offset_information: what measured it, an inverse variance.
        calibrated_until: the newest keyframe that did.
    """

    def __init__(self, scales: NDArray[np.float64]) -> None:
        """``scales``: ``(levels,)`` pyramid scale factors that octaves refer to."""
        self.scales = scales
        self.n_keyframes = 0
        self.n_landmarks = 0
        self.n_rows = 0
        self.timestamps: list[float] = []
        self.frames: list[int] = []
        self.parents: list[int] = []
        self.sessions: list[int] = []
        self.session = 0
        self.T_c_parent: dict[int, NDArray[np.float64]] = {}
        self.unit_scale: list[float] = []
        self.restarts: list[int] = []
        self.unpredicted_restarts: list[int] = []
        self.disparity_offset = 0.0
        self.offset_information = 0.0
        self.calibrated_until = -1
        k, n, r = 64, 8192, 65536
        self.arrays = Arrays(
            T_cw=np.zeros((k, 4, 4)),
            first_row=np.zeros(k + 1, np.int64),
            keyframe_alive=np.zeros(k, np.bool_),
            xyz=np.zeros((n, 3)),
            normal=np.zeros((n, 3)),
            distance_range=np.zeros((n, 2)),
            landmark_descriptor=np.zeros((n, 4), np.uint64),
            first_keyframe=np.zeros(n, np.int32),
            visible=np.zeros(n, np.int32),
            found=np.zeros(n, np.int32),
            landmark_alive=np.zeros(n, np.bool_),
            merged_into=np.zeros(n, np.int32),
            head=np.zeros(n, np.int32),
            n_observations=np.zeros(n, np.int32),
            xy=np.zeros((r, 2), np.float32),
            u_right=np.zeros(r, np.float32),
            octave=np.zeros(r, np.uint8),
            angle=np.zeros(r, np.float32),
            descriptor=np.zeros((r, 4), np.uint64),
            keyframe=np.zeros(r, np.int32),
            landmark=np.zeros(r, np.int32),
            next_row=np.zeros(r, np.int32),
            certainty=np.zeros(r, np.uint8),
        )

    def _reserve(self, fields: tuple[str, ...], used: int, extra: int) -> None:
        capacity = len(getattr(self.arrays, fields[-1]))
        if used + extra <= capacity:
            return
        target = max(used + extra, capacity + capacity // 2)
        for name in fields:  # one after the other: two copies of all of them are much memory
            grown = _grown(getattr(self.arrays, name), target + (name == "first_row"))
            self.arrays = self.arrays._replace(**{name: grown})

    def add_keyframe(
        self,
        features: Features,
        T_cw: NDArray[np.float64],
        timestamp: float,
        frame: int,
        certainty: NDArray[np.uint8] | int = 1,
    ) -> int:
        """Append a keyframe without observations; returns its id.

        Args:
            certainty: ``(N,)`` of the features.
        """
        k, n = self.n_keyframes, len(features)
        self._reserve(KEYFRAME_FIELDS, k, 1)
        self._reserve(ROW_FIELDS, self.n_rows, n)
        a = self.arrays
        rows = slice(self.n_rows, self.n_rows + n)
        a.xy[rows], a.u_right[rows] = features.xy, features.u_right
        a.octave[rows], a.angle[rows] = features.octave, features.angle
        a.descriptor[rows] = features.descriptors.view(np.uint64)
        a.keyframe[rows] = k
        a.certainty[rows] = certainty
        a.landmark[rows] = NONE
        a.next_row[rows] = NONE
        a.T_cw[k] = T_cw
        a.first_row[k], a.first_row[k + 1] = self.n_rows, self.n_rows + n
        a.keyframe_alive[k] = True
        self.timestamps.append(timestamp)
        self.frames.append(frame)
        self.parents.append(NONE)
        self.sessions.append(self.session)
        self.unit_scale.append(1.0)
        self.n_rows += n
        self.n_keyframes += 1
        return k

    def add_landmarks(
        self, xyz: NDArray[np.float64], descriptors: NDArray[np.uint64], keyframe: int
    ) -> NDArray[np.int32]:
        """Append ``(N, 3)`` landmarks first seen by ``keyframe``; returns their ``(N,)`` ids.

        They have no observation yet: link them before the next use of the map.
        """
        n, start = len(xyz), self.n_landmarks
        self._reserve(LANDMARK_FIELDS, start, n)
        a = self.arrays
        new = slice(start, start + n)
        a.xyz[new], a.landmark_descriptor[new] = xyz, descriptors
        a.first_keyframe[new] = keyframe
        a.visible[new], a.found[new] = 1, 1
        a.landmark_alive[new] = True
        a.merged_into[new], a.head[new] = NONE, NONE
        a.n_observations[new] = 0
        self.n_landmarks += n
        return np.arange(start, start + n, dtype=np.int32)

    def used_arrays(self) -> Arrays:
        """A copy of ``arrays`` without the capacity that is not in use."""
        used = {"first_row": self.n_keyframes + 1}
        for fields, size in (
            (KEYFRAME_FIELDS, self.n_keyframes),
            (LANDMARK_FIELDS, self.n_landmarks),
            (ROW_FIELDS, self.n_rows),
        ):
            used |= {name: size for name in fields if name not in used}
        a = self.arrays
        return Arrays(*(getattr(a, name)[: used[name]].copy() for name in Arrays._fields))

    @property
    def many_dead_landmarks(self) -> bool:
        """Whether dead landmarks take so much room that ``drop_dead_landmarks`` is worth it."""
        living = int(np.count_nonzero(self.arrays.landmark_alive[: self.n_landmarks]))
        return self.n_landmarks - living > max(_FEW_LANDMARKS, living // 2)

    def drop_dead_landmarks(self) -> NDArray[np.int32]:
        """Forget the landmarks that are dead; the others are numbered anew, in their order.

        Most landmarks die within a few keyframes of their birth.

        Returns:
            ``(n_landmarks,)`` by old id, the new one of the landmark that it stands for
            (``resolve``), or -1.
        """
        a, living = self.arrays, self.living_landmarks()
        stands_for = resolve(a, np.arange(self.n_landmarks, dtype=np.int32))
        new_id = np.full(self.n_landmarks + 1, NONE, np.int32)  # the last one is that of -1
        new_id[living] = np.arange(len(living))
        for name in LANDMARK_FIELDS:
            values = getattr(a, name)
            values[: len(living)] = values[living]
            values[len(living) : self.n_landmarks] = 0
        a.landmark[: self.n_rows] = new_id[a.landmark[: self.n_rows]]
        self.n_landmarks = len(living)
        return new_id[stands_for]

    def rows(self, keyframe: int) -> slice:
        """Rows of one keyframe."""
        first = self.arrays.first_row
        return slice(int(first[keyframe]), int(first[keyframe + 1]))

    def landmarks_of(self, keyframe: int) -> NDArray[np.int32]:
        """Ids of the landmarks that a keyframe observes, by row."""
        observed = self.arrays.landmark[self.rows(keyframe)]
        return observed[observed != NONE]

    def covisible(
        self, keyframe: int, minimum: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Keyframes sharing at least ``minimum`` landmarks, most first, and how many they share."""
        counts = count_shared(self.arrays, keyframe, self.n_keyframes)
        enough = np.flatnonzero(counts >= max(1, minimum))  # of many thousands that share none
        order = enough[np.argsort(-counts[enough], kind="stable")]
        return order, counts[order]

    def keyframe_pose(self, keyframe: int) -> NDArray[np.float64]:
        """Copy of ``T_cw``; a culled keyframe follows the living one that took its place."""
        if self.arrays.keyframe_alive[keyframe]:
            return self.arrays.T_cw[keyframe].copy()
        return self.T_c_parent[keyframe] @ self.arrays.T_cw[self.parents[keyframe]]

    def cull_keyframe(self, keyframe: int) -> None:
        """Remove a keyframe and its observations; its children move to its parent.

        Keyframes culled before it are children too: every parent is alive.
        """
        parent, a = self.parents[keyframe], self.arrays
        T_c_parent = compose(a.T_cw[keyframe], inverse(a.T_cw[parent]))
        for child in [k for k, p in enumerate(self.parents) if p == keyframe]:
            self.parents[child] = parent
            if not a.keyframe_alive[child]:
                moved = compose(self.T_c_parent[child], T_c_parent)
                self.T_c_parent[child] = orthonormalised(moved)
        self.T_c_parent[keyframe] = T_c_parent
        detach_keyframe(a, keyframe)
        a.keyframe_alive[keyframe] = False

    def begin_submap(self, keyframe: int, parent: int, *, predicted: bool) -> None:
        """Note that mapping began anew at a keyframe; its pose relative to the parent is a
        prediction, or not even that."""
        self.parents[keyframe] = parent
        self.restarts.append(keyframe)
        if not predicted:
            self.unpredicted_restarts.append(keyframe)

    def submaps(self) -> NDArray[np.int64]:
        """``(n_keyframes,)`` the sub-map of each keyframe, by the keyframe at which it began."""
        root = np.zeros(self.n_keyframes, np.int64)
        for keyframe in range(1, self.n_keyframes):
            restarted = keyframe in self.restarts
            root[keyframe] = keyframe if restarted else root[self.parents[keyframe]]
        return root

    def living_keyframes(self) -> NDArray[np.int64]:
        """Ids of the keyframes that were not culled."""
        return np.flatnonzero(self.arrays.keyframe_alive[: self.n_keyframes])

    def living_landmarks(self) -> NDArray[np.int64]:
        """Ids of the landmarks that were neither culled nor merged into another."""
        return np.flatnonzero(self.arrays.landmark_alive[: self.n_landmarks])


def loop_of_living(map_: Map, loop: LoopEdge) -> LoopEdge:
    """A loop between the living keyframes that its ends, where they were culled, are placed by.

    Raises:
        ValueError: it has no pose.
    """
    if loop.T_query_match is None:
        raise ValueError(f"The loop from keyframe {loop.query} to {loop.match} has no pose.")
    query, match, T = loop.query, loop.match, loop.T_query_match
    if not map_.arrays.keyframe_alive[query]:
        T_parent_query = inverse(map_.T_c_parent[query])
        T_parent_query[:3, 3] /= loop.scale  # to the unit of the match
        T = compose(T_parent_query, T)
        query = map_.parents[query]
    if not map_.arrays.keyframe_alive[match]:
        T = compose(T, map_.T_c_parent[match])
        match = map_.parents[match]
    return replace(loop, query=query, match=match, T_query_match=orthonormalised(T))
