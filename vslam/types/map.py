"""The map: keyframes, landmarks and observations as a structure of arrays.

A *row* is one keypoint of one keyframe. The rows of a keyframe are consecutive. ``landmark[row]``
is the landmark that the keypoint observes. The rows that observe the same landmark form a linked
list, in which ``next_row`` is the next row. Covisibility is not stored. It is counted from the rows
when it is needed. The use of arrays instead of objects follows DPVO's PatchGraph.

Culled keyframes and landmarks stay in the arrays and are marked as culled. A landmark that was
fused with another landmark counts as culled. Ids of keyframes are never reused. Ids of landmarks
change only when culled landmarks are dropped.

Each array is called a column. To add a column, declare it in ``Arrays`` or ``KeyframeTable`` with
an empty array of its dtype and shape as the default. The new column is then grown, copied, saved
and loaded like the other columns. A new entry is zero unless ``Map.add_keyframe`` or
``Map.add_landmarks`` sets it. A number that describes the map as a whole belongs in ``Scalars``.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.types.features import Features
from vslam.types.geometry import adjoint, compose, inverse, orthonormalised
from vslam.types.imu import GravityDirection
from vslam.types.loops import LoopEdge
from vslam.types.map_kernels import count_shared, detach_keyframe, first_of_submaps, resolve
from vslam.types.revisits import Revisits

NONE = -1
_FEW_LANDMARKS = 8192  # they take about 1 MB; it is not worth dropping fewer landmarks


class Arrays(NamedTuple):
    """The part of the map that kernels read and write.

    The arrays have a capacity of K keyframes, L landmarks and R keypoints of keyframes (rows). An
    id of -1 means none. The types are abbreviated as in NumPy: f8 is float64, u8 is uint64, i4 is
    int32.

    Attributes:
        T_cw: ``(K, 4, 4)`` f8, pose of each keyframe.
        first_row: ``(K + 1,)`` i8, index of the first keypoint of each keyframe.
        keyframe_alive: ``(K,)`` bool, False for a culled keyframe.
        xyz: ``(L, 3)`` f8, position of each landmark in the world frame.
        normal: ``(L, 3)`` f8, mean viewing direction of each landmark.
        distance_range: ``(L, 2)`` f8, least and greatest distance at which each landmark can be
            detected in the image pyramid.
        landmark_descriptor: ``(L, 4)`` u8, 256-bit descriptor of each landmark.
        first_keyframe: ``(L,)`` i4, the first keyframe that observed the landmark.
        visible: ``(L,)`` i4, number of frames in which the landmark was expected to be visible.
        found: ``(L,)`` i4, number of frames in which the landmark was found.
        landmark_alive: ``(L,)`` bool, False for a culled or fused landmark.
        fused_into: ``(L,)`` i4, the landmark that this landmark was fused with.
        head: ``(L,)`` i4, index of the first keypoint that observes the landmark.
        n_observations: ``(L,)`` i4, number of observations. A stereo observation counts twice
            (ORB-SLAM2).
        xy: ``(R, 2)`` f4, position of each keypoint in pixels.
        u_right: ``(R,)`` f4, column of the stereo match in the right image, in pixels. NaN if there
            is no match.
        octave: ``(R,)`` u1, pyramid level.
        angle: ``(R,)`` f4, orientation in radians.
        descriptor: ``(R, 4)`` u8, 256-bit descriptor of each keypoint.
        keyframe: ``(R,)`` i4, the keyframe that the keypoint belongs to.
        landmark: ``(R,)`` i4, the landmark that the keypoint observes.
        next_row: ``(R,)`` i4, index of the next keypoint that observes the same landmark.
        certainty: ``(R,)`` u1, ratio of two variances: the variance of a keypoint position without
            sub-pixel alignment, divided by the variance of ``xy``.
    """

    T_cw: NDArray[np.float64] = np.zeros((0, 4, 4))
    first_row: NDArray[np.int64] = np.zeros(1, np.int64)
    keyframe_alive: NDArray[np.bool_] = np.zeros(0, np.bool_)
    xyz: NDArray[np.float64] = np.zeros((0, 3))
    normal: NDArray[np.float64] = np.zeros((0, 3))
    distance_range: NDArray[np.float64] = np.zeros((0, 2))
    landmark_descriptor: NDArray[np.uint64] = np.zeros((0, 4), np.uint64)
    first_keyframe: NDArray[np.int32] = np.zeros(0, np.int32)
    visible: NDArray[np.int32] = np.zeros(0, np.int32)
    found: NDArray[np.int32] = np.zeros(0, np.int32)
    landmark_alive: NDArray[np.bool_] = np.zeros(0, np.bool_)
    fused_into: NDArray[np.int32] = np.zeros(0, np.int32)
    head: NDArray[np.int32] = np.zeros(0, np.int32)
    n_observations: NDArray[np.int32] = np.zeros(0, np.int32)
    xy: NDArray[np.float32] = np.zeros((0, 2), np.float32)
    u_right: NDArray[np.float32] = np.zeros(0, np.float32)
    octave: NDArray[np.uint8] = np.zeros(0, np.uint8)
    angle: NDArray[np.float32] = np.zeros(0, np.float32)
    descriptor: NDArray[np.uint64] = np.zeros((0, 4), np.uint64)
    keyframe: NDArray[np.int32] = np.zeros(0, np.int32)
    landmark: NDArray[np.int32] = np.zeros(0, np.int32)
    next_row: NDArray[np.int32] = np.zeros(0, np.int32)
    certainty: NDArray[np.uint8] = np.zeros(0, np.uint8)


_FIRST_OF_LANDMARKS, _FIRST_OF_ROWS = (Arrays._fields.index(name) for name in ("xyz", "xy"))
KEYFRAME_FIELDS = Arrays._fields[:_FIRST_OF_LANDMARKS]
LANDMARK_FIELDS = Arrays._fields[_FIRST_OF_LANDMARKS:_FIRST_OF_ROWS]
ROW_FIELDS = Arrays._fields[_FIRST_OF_ROWS:]

PREDICTED, UNPREDICTED, CARRIED = 1, 2, 3  # values of KeyframeTable.restart


class KeyframeTable(NamedTuple):
    """Data of keyframes that kernels do not need. The arrays have a capacity of K keyframes.

    Attributes:
        timestamp: ``(K,)`` f8, seconds.
        frame: ``(K,)`` i8, index of the frame that became the keyframe.
        parent: ``(K,)`` i8, parent of the keyframe in the spanning tree, or -1.
        session: ``(K,)`` i8, index of the drive in which the keyframe was added. The first drive
            has index 0. The timestamp and the frame index refer to this drive.
        unit_scale: ``(K,)`` f8, factor by which loop closures have scaled lengths near the keyframe
            since it was added. It is always 1 in metric maps.
        T_c_parent: ``(K, 4, 4)`` f8, pose of a culled keyframe relative to its parent. It is the
            identity while the keyframe is alive.
        restart: ``(K,)`` u1, nonzero if the keyframe is the first keyframe of a sub-map, which
            begins after the camera was lost. The value is ``PREDICTED`` if the pose of the keyframe
            relative to its parent was predicted, ``UNPREDICTED`` if it is unknown, and ``CARRIED``
            if an IMU measured it.
        gravity: ``(K, 3)`` f8, direction of free fall in the frame of the camera, as a unit vector.
            It is zero if it was unknown when the keyframe was added.
        gravity_sigma: ``(K,)`` f8, standard deviation of ``gravity`` along each of the two axes
            across it, in radians. It is zero if ``gravity`` is unknown.
        motion_seconds, motion_rotation, motion_velocity, motion_position, motion_bias,
            motion_by_bias, motion_covariance: ``(K,)``, ``(K, 3, 3)``, ``(K, 3)``, ``(K, 3)``,
            ``(K, 6)``, ``(K, 9, 6)`` and ``(K, 9, 9)`` f8, the motion of the IMU since the keyframe
            before (``Preintegration``). All are zero if it is unknown.
        motion_walk: ``(K, 6)`` f8, variances of the change of the biases in this time.
        T_imu_camera: ``(K, 4, 4)`` f8, maps points of the camera to the IMU.
    """

    timestamp: NDArray[np.float64] = np.zeros(0)
    frame: NDArray[np.int64] = np.zeros(0, np.int64)
    parent: NDArray[np.int64] = np.zeros(0, np.int64)
    session: NDArray[np.int64] = np.zeros(0, np.int64)
    unit_scale: NDArray[np.float64] = np.zeros(0)
    T_c_parent: NDArray[np.float64] = np.zeros((0, 4, 4))
    restart: NDArray[np.uint8] = np.zeros(0, np.uint8)
    gravity: NDArray[np.float64] = np.zeros((0, 3))
    gravity_sigma: NDArray[np.float64] = np.zeros(0)
    motion_seconds: NDArray[np.float64] = np.zeros(0)
    motion_rotation: NDArray[np.float64] = np.zeros((0, 3, 3))
    motion_velocity: NDArray[np.float64] = np.zeros((0, 3))
    motion_position: NDArray[np.float64] = np.zeros((0, 3))
    motion_bias: NDArray[np.float64] = np.zeros((0, 6))
    motion_by_bias: NDArray[np.float64] = np.zeros((0, 9, 6))
    motion_covariance: NDArray[np.float64] = np.zeros((0, 9, 9))
    motion_walk: NDArray[np.float64] = np.zeros((0, 6))
    T_imu_camera: NDArray[np.float64] = np.zeros((0, 4, 4))


@dataclass(frozen=True)
class Scalars:
    """Numbers that describe the whole map.

    Attributes:
        session: index of the drive to which new keyframes belong. The first drive has index 0.
        disparity_offset: number of pixels by which every measured disparity is too small. All
            columns of stereo matches in the right image (``Arrays.u_right``) are already corrected
            by this offset (``backend/disparity_offset.py``).
        offset_sigma: standard deviation of ``disparity_offset``, in pixels. It is 0 before the
            offset has been estimated.
        offset_mean, offset_information, offset_scatter, offset_windows: weighted mean of the
            estimates of the offset, in pixels, the sum of their weights, the weighted sum of their
            squared deviations from the mean, and their number.
        calibrated_until: the newest keyframe from which the disparity offset was estimated, or -1.
        metric: whether an IMU has shown that the unit of a monocular map is the metre.
    """

    session: int = 0
    disparity_offset: float = 0.0
    offset_sigma: float = 0.0
    offset_mean: float = 0.0
    offset_information: float = 0.0
    offset_scatter: float = 0.0
    offset_windows: int = 0
    calibrated_until: int = NONE
    metric: bool = False


def _grown(array: NDArray, capacity: int) -> NDArray:
    bigger = np.zeros((capacity, *array.shape[1:]), array.dtype)
    bigger[: len(array)] = array
    return bigger


class Map:
    """A map that can grow. Only one thread may write it at a time.

    Attributes:
        n_keyframes, n_landmarks: number of keyframes and landmarks, including culled ones.
        n_rows: number of keypoints of all keyframes.
        revisits: observations of frames at known places.
    """

    def __init__(self, scales: NDArray[np.float64]) -> None:
        """Create an empty map. ``scales`` are the ``(levels,)`` scales of the image pyramid."""
        self.scales = scales
        self.n_keyframes = 0
        self.n_landmarks = 0
        self.n_rows = 0
        self.scalars = Scalars()
        self.revisits = Revisits()
        self.arrays = Arrays()
        self.keyframes = KeyframeTable()
        self._reserve_keyframes(64)
        self._reserve(LANDMARK_FIELDS, 0, 8192)
        self._reserve(ROW_FIELDS, 0, 65536)

    @property
    def timestamps(self) -> NDArray[np.float64]:
        """``(n_keyframes,)`` timestamps of the keyframes in seconds, as a view."""
        return self.keyframes.timestamp[: self.n_keyframes]

    @property
    def frames(self) -> NDArray[np.int64]:
        """``(n_keyframes,)`` indices of the frames that became keyframes, as a view."""
        return self.keyframes.frame[: self.n_keyframes]

    @property
    def parents(self) -> NDArray[np.int64]:
        """``(n_keyframes,)`` parents of the keyframes in the spanning tree, or -1, as a view."""
        return self.keyframes.parent[: self.n_keyframes]

    @property
    def sessions(self) -> NDArray[np.int64]:
        """``(n_keyframes,)`` index of the drive in which each keyframe was added, as a view."""
        return self.keyframes.session[: self.n_keyframes]

    @property
    def unit_scale(self) -> NDArray[np.float64]:
        """``(n_keyframes,)`` view of ``KeyframeTable.unit_scale``."""
        return self.keyframes.unit_scale[: self.n_keyframes]

    @property
    def restarts(self) -> list[int]:
        """Ids of the keyframes at which mapping restarted after the camera was lost, ascending."""
        return np.flatnonzero(self.keyframes.restart[: self.n_keyframes]).tolist()

    @property
    def unpredicted_restarts(self) -> list[int]:
        """Ids of the keyframes at which mapping restarted with a pose that was not predicted."""
        unpredicted = self.keyframes.restart[: self.n_keyframes] == UNPREDICTED
        return np.flatnonzero(unpredicted).tolist()

    def _reserve(self, fields: tuple[str, ...], used: int, extra: int) -> None:
        capacity = len(getattr(self.arrays, fields[-1]))
        if used + extra <= capacity:
            return
        target = max(used + extra, capacity + capacity // 2)
        for name in fields:  # only one column at a time exists twice in memory
            grown = _grown(getattr(self.arrays, name), target + (name == "first_row"))
            self.arrays = self.arrays._replace(**{name: grown})

    def _reserve_keyframes(self, extra: int) -> None:
        self._reserve(KEYFRAME_FIELDS, self.n_keyframes, extra)
        capacity = len(self.arrays.keyframe_alive)
        if len(self.keyframes.parent) < capacity:
            self.keyframes = KeyframeTable._make(_grown(c, capacity) for c in self.keyframes)

    def add_keyframe(
        self,
        features: Features,
        T_cw: NDArray[np.float64],
        timestamp: float,
        frame: int,
        certainty: NDArray[np.uint8] | int = 1,
        gravity: GravityDirection | None = None,
    ) -> int:
        """Append a keyframe without observations, and return its id.

        Args:
            T_cw: ``(4, 4)`` pose of the keyframe.
            timestamp: seconds.
            frame: index of the frame that becomes the keyframe.
            certainty: ``Arrays.certainty`` of each feature, or of all features.
            gravity: in the frame of the keyframe; None if it is unknown.
        """
        k, n = self.n_keyframes, len(features)
        self._reserve_keyframes(1)
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
        table = self.keyframes
        table.timestamp[k], table.frame[k] = timestamp, frame
        table.parent[k] = NONE
        table.session[k] = self.scalars.session
        table.unit_scale[k] = 1.0
        table.T_c_parent[k] = np.eye(4)
        if gravity is not None:
            table.gravity[k], table.gravity_sigma[k] = gravity.direction, gravity.sigma
        self.n_rows += n
        self.n_keyframes += 1
        return k

    def move_observations(
        self, rows: NDArray[np.int64], xy: NDArray[np.float32], certainty: int
    ) -> None:
        """Replace the positions of ``(N,)`` keypoints by ``(N, 2)`` aligned ones, in pixels.

        Args:
            certainty: ``Arrays.certainty`` of the new positions.
        """
        self.arrays.xy[rows], self.arrays.certainty[rows] = xy, certainty

    def add_landmarks(
        self, xyz: NDArray[np.float64], descriptors: NDArray[np.uint64], keyframe: int
    ) -> NDArray[np.int32]:
        """Append landmarks without observations, which ``keyframe`` sees first.

        They must be linked to keypoints before the map is used again.

        Args:
            xyz: ``(N, 3)`` positions in the world frame.
            descriptors: ``(N, 4)`` descriptors.

        Returns:
            ``(N,)`` ids of the landmarks.
        """
        n, start = len(xyz), self.n_landmarks
        self._reserve(LANDMARK_FIELDS, start, n)
        a = self.arrays
        new = slice(start, start + n)
        a.xyz[new], a.landmark_descriptor[new] = xyz, descriptors
        a.first_keyframe[new] = keyframe
        a.visible[new], a.found[new] = 1, 1
        a.landmark_alive[new] = True
        a.fused_into[new], a.head[new] = NONE, NONE
        a.n_observations[new] = 0
        self.n_landmarks += n
        return np.arange(start, start + n, dtype=np.int32)

    def columns(self) -> dict[str, NDArray]:
        """Return views of all ``Arrays`` and of the ``KeyframeTable``, without unused capacity."""
        of_arrays = {
            name: getattr(self.arrays, name)[:size]
            for fields, size in (
                (KEYFRAME_FIELDS, self.n_keyframes),
                (LANDMARK_FIELDS, self.n_landmarks),
                (ROW_FIELDS, self.n_rows),
            )
            for name in fields
        }
        of_arrays["first_row"] = self.arrays.first_row[: self.n_keyframes + 1]
        of_keyframes = self.keyframes._asdict().items()
        return of_arrays | {name: column[: self.n_keyframes] for name, column in of_keyframes}

    def with_columns(self, columns: dict[str, NDArray]) -> Map:
        """Create a map with the given arrays, and the scalars and revisits of this map.

        The arrays are not copied. Their names are the names that ``columns()`` returns.
        """
        other = copy.copy(self)
        other.arrays = Arrays(**{name: columns[name] for name in Arrays._fields})
        other.keyframes = KeyframeTable(**{name: columns[name] for name in KeyframeTable._fields})
        other.n_keyframes = len(other.arrays.keyframe_alive)
        other.n_landmarks = len(other.arrays.landmark_alive)
        other.n_rows = len(other.arrays.keyframe)
        return other

    def copy(self) -> Map:
        """Copy the map, without unused capacity."""
        return self.with_columns({name: column.copy() for name, column in self.columns().items()})

    def begin_drive(self) -> None:
        """Begin a new drive. Keyframes that are added later belong to this drive."""
        self.scalars = replace(self.scalars, session=self.scalars.session + 1)

    @property
    def many_culled_landmarks(self) -> bool:
        """Whether culled landmarks take so much memory that they should be dropped."""
        living = int(np.count_nonzero(self.arrays.landmark_alive[: self.n_landmarks]))
        return self.n_landmarks - living > max(_FEW_LANDMARKS, living // 2)

    def drop_culled_landmarks(self) -> NDArray[np.int32]:
        """Remove culled landmarks, and renumber the other landmarks in their order.

        Returns:
            ``(n_landmarks,)`` new id of each old landmark, or -1 if it was culled. A landmark that
            was fused with another landmark has the new id of that landmark (``resolve``).
        """
        a, living = self.arrays, self.living_landmarks()
        resolved = resolve(a, np.arange(self.n_landmarks, dtype=np.int32))
        new_id = np.full(self.n_landmarks + 1, NONE, np.int32)  # the extra entry maps -1 to -1
        new_id[living] = np.arange(len(living))
        for name in LANDMARK_FIELDS:
            values = getattr(a, name)
            values[: len(living)] = values[living]
            values[len(living) : self.n_landmarks] = 0
        a.landmark[: self.n_rows] = new_id[a.landmark[: self.n_rows]]
        self.n_landmarks = len(living)
        new_id = np.append(new_id[resolved], np.int32(NONE))  # again for -1
        self.revisits = self.revisits.observing(new_id[self.revisits.landmark])
        return new_id[:-1]

    def rows(self, keyframe: int) -> slice:
        """Return the range of indices of a keyframe's keypoints in ``Arrays``."""
        first = self.arrays.first_row
        return slice(int(first[keyframe]), int(first[keyframe + 1]))

    def landmarks_of(self, keyframe: int) -> NDArray[np.int32]:
        """Return the ids of the landmarks that a keyframe observes, ordered by keypoint."""
        observed = self.arrays.landmark[self.rows(keyframe)]
        return observed[observed != NONE]

    def covisible(
        self, keyframe: int, minimum: int = 1
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Find keyframes that share at least ``minimum`` landmarks with a keyframe.

        Returns:
            ``(N,)`` ids of these keyframes, sorted by decreasing number of shared landmarks, and
            the ``(N,)`` numbers of shared landmarks.
        """
        counts = count_shared(self.arrays, keyframe, self.n_keyframes)
        enough = np.flatnonzero(counts >= max(1, minimum))  # few, and only these are sorted
        order = enough[np.argsort(-counts[enough], kind="stable")]
        return order, counts[order]

    def keyframe_pose(self, keyframe: int) -> NDArray[np.float64]:
        """Return a copy of the pose ``T_cw`` of a keyframe.

        The pose of a culled keyframe is computed from the pose of its parent.
        """
        if self.arrays.keyframe_alive[keyframe]:
            return self.arrays.T_cw[keyframe].copy()
        table = self.keyframes
        return table.T_c_parent[keyframe] @ self.arrays.T_cw[table.parent[keyframe]]

    def cull_keyframe(self, keyframe: int) -> None:
        """Cull a keyframe and remove its observations. Its children become children of its parent.

        This includes children that have been culled earlier, so no parent is a culled keyframe.
        """
        a, table, parents = self.arrays, self.keyframes, self.parents
        parent = parents[keyframe]
        T_c_parent = compose(a.T_cw[keyframe], inverse(a.T_cw[parent]))
        children = np.flatnonzero(parents == keyframe)
        parents[children] = parent
        for child in children[~a.keyframe_alive[children]]:
            table.T_c_parent[child] = orthonormalised(compose(table.T_c_parent[child], T_c_parent))
        table.T_c_parent[keyframe] = T_c_parent
        detach_keyframe(a, keyframe)
        a.keyframe_alive[keyframe] = False

    def begin_submap(
        self, keyframe: int, parent: int, *, predicted: bool, carried: bool = False
    ) -> None:
        """Record that a keyframe begins a sub-map, and its parent in the spanning tree.

        Args:
            predicted: whether the pose of the keyframe relative to its parent was predicted.
            carried: whether an IMU measured this pose.
        """
        how = CARRIED if carried else PREDICTED if predicted else UNPREDICTED
        self.keyframes.parent[keyframe] = parent
        self.keyframes.restart[keyframe] = how

    def submaps(self) -> NDArray[np.int64]:
        """Return the sub-map of each keyframe as an ``(n_keyframes,)`` array.

        A sub-map is identified by the id of its first keyframe.
        """
        restart = self.keyframes.restart[: self.n_keyframes]
        return np.asarray(first_of_submaps(restart, self.parents))

    def living_keyframes(self) -> NDArray[np.int64]:
        """Return the ids of the keyframes that have not been culled."""
        return np.flatnonzero(self.arrays.keyframe_alive[: self.n_keyframes])

    def places_among(self, keyframes: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return the place of each keyframe of the map in an array of ids, or -1 if it is not
        among them."""
        places = np.full(self.n_keyframes, -1, np.int64)
        places[keyframes] = np.arange(len(keyframes))
        return places

    def living_landmarks(self) -> NDArray[np.int64]:
        """Return the ids of the landmarks that were not culled or fused with another landmark."""
        return np.flatnonzero(self.arrays.landmark_alive[: self.n_landmarks])


def loop_of_living(map_: Map, loop: LoopEdge) -> LoopEdge:
    """Move a loop edge to keyframes that have not been culled.

    A culled keyframe of the edge is replaced by its parent, and the relative pose is adapted.

    Raises:
        ValueError: the relative pose of the loop is unknown.
    """
    if loop.T_query_match is None:
        raise ValueError(f"The loop from keyframe {loop.query} to {loop.match} has no pose.")
    query, match, T = loop.query, loop.match, loop.T_query_match
    covariance = loop.covariance
    if not map_.arrays.keyframe_alive[query]:
        T_parent_query = inverse(map_.keyframes.T_c_parent[query])
        T_parent_query[:3, 3] /= loop.scale  # convert to the unit of the match
        T = compose(T_parent_query, T)
        if covariance is not None:
            A = adjoint(T_parent_query)
            covariance = A @ covariance @ A.T
        query = int(map_.parents[query])
    if not map_.arrays.keyframe_alive[match]:
        T = compose(T, map_.keyframes.T_c_parent[match])
        match = int(map_.parents[match])
    T = orthonormalised(T)
    return replace(loop, query=query, match=match, T_query_match=T, covariance=covariance)


def revisits_of_living(map_: Map) -> Revisits:
    """Return the revisits of a map, relative to keyframes that have not been culled. A culled
    keyframe is replaced by its parent."""
    revisits, table = map_.revisits, map_.keyframes
    keyframe, T = revisits.keyframe.copy(), revisits.T_c_keyframe.copy()
    for revisit in np.flatnonzero(~map_.arrays.keyframe_alive[keyframe]):
        culled = keyframe[revisit]
        T[revisit] = orthonormalised(compose(T[revisit], table.T_c_parent[culled]))
        keyframe[revisit] = table.parent[culled]
    return replace(revisits, keyframe=keyframe, T_c_keyframe=T)
