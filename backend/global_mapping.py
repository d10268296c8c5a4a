"""Takes a snapshot of the map for global bundle adjustment, and merges the solution into the map.

Global bundle adjustment takes seconds. It therefore works on a snapshot, while tracking and local
mapping continue (Mur-Artal and Tardós, ORB-SLAM2, T-RO 2017, section III-D).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.backend.bundle_adjustment import BundleProblem, BundleSolution
from vslam.backend.local_mapping import assemble
from vslam.backend.loop_correction import carry_landmarks
from vslam.camera import Camera
from vslam.geometry import compose, inverse, orthonormalised
from vslam.kernels import kernel
from vslam.map import Map
from vslam.map_kernels import refresh_landmarks, unlink


@dataclass(frozen=True)
class GlobalSnapshot:
    """A copy of the map as a bundle problem, with the ids of its cameras, points and observations.

    Attributes:
        keyframes: ``(K,)`` int64 keyframe id of each camera of the problem.
        landmarks: ``(P,)`` int32 landmark id of each point of the problem.
        rows: ``(O,)`` int64 row of each observation in the observation arrays of the map.
        n_keyframes, n_landmarks: first ids of the keyframes and landmarks that are newer than the
            snapshot.
    """

    problem: BundleProblem
    keyframes: NDArray[np.int64]
    landmarks: NDArray[np.int32]
    rows: NDArray[np.int64]
    n_keyframes: int
    n_landmarks: int


def take_snapshot(map_: Map, camera: Camera) -> GlobalSnapshot:
    """Copy the map, without culled keyframes and landmarks, into a bundle problem for global bundle
    adjustment.

    The first keyframe of each connected part of the map is held fixed, because nothing else
    determines the position of this part. Two keyframes are connected if they observe a common
    landmark.
    """
    living = map_.living_keyframes()
    landmarks = map_.living_landmarks().astype(np.int32)
    part = connected_parts(map_.arrays, landmarks, map_.n_keyframes)
    first = part[living] == living
    free, fixed = living[~first], living[first]
    keyframes = np.concatenate([free, fixed])
    problem, rows = assemble(map_, free, fixed, landmarks, camera)
    return GlobalSnapshot(problem, keyframes, landmarks, rows, map_.n_keyframes, map_.n_landmarks)


@kernel
def connected_parts(a, landmarks, n_keyframes):
    """Find the connected part of the map that each keyframe belongs to. Returns ``(K,)`` int64, the
    id of the first keyframe of the part.

    Two keyframes are connected if they observe a common landmark. The parts are found by
    union-find.
    """
    part = np.arange(n_keyframes)
    for landmark in landmarks:
        first = -1
        row = a.head[landmark]
        while row >= 0:
            k = np.int64(a.keyframe[row])
            while part[k] != k:
                part[k] = part[part[k]]
                k = part[k]
            if first < 0:
                first = k
            elif k < first:
                part[first] = k
                first = k
            else:
                part[k] = first
            row = a.next_row[row]
    for k in range(n_keyframes):
        part[k] = part[part[k]]
    return part


def merge_solution(map_: Map, snapshot: GlobalSnapshot, solution: BundleSolution) -> None:
    """Apply the result of global bundle adjustment to the map, which may have changed since the
    snapshot.

    Newer keyframes keep their pose relative to their parent in the spanning tree (ORB-SLAM2,
    section III-D). Newer landmarks move with their anchor keyframe. Observations that failed the
    chi-square test are removed, unless their features have been assigned to other landmarks since.
    """
    a = map_.arrays
    T_cw_old = a.T_cw[: map_.n_keyframes].copy()
    living = a.keyframe_alive[snapshot.keyframes]
    a.T_cw[snapshot.keyframes[living]] = solution.T_cw[living]
    # A parent is older than its children, so it has already been moved.
    for k in range(snapshot.n_keyframes, map_.n_keyframes):
        parent = map_.parents[k]
        if a.keyframe_alive[k] and parent >= 0:
            T_k_parent = compose(T_cw_old[k], inverse(T_cw_old[parent]))
            a.T_cw[k] = orthonormalised(compose(T_k_parent, a.T_cw[parent]))
    carry_landmarks(map_, np.arange(snapshot.n_landmarks, map_.n_landmarks), T_cw_old)
    living = a.landmark_alive[snapshot.landmarks]
    a.xyz[snapshot.landmarks[living]] = solution.points[living]
    observed = np.repeat(snapshot.landmarks, np.diff(snapshot.problem.first))
    remove_unchanged(a, snapshot.rows[~solution.inlier], observed[~solution.inlier])
    refresh_landmarks(a, map_.living_landmarks().astype(np.int32), map_.scales)


@kernel
def remove_unchanged(a, rows, landmarks):
    """Remove the observations in ``(N,)`` rows of the observation arrays of the map that still
    belong to the given ``(N,)`` landmarks."""
    for i in range(len(rows)):
        if a.landmark[rows[i]] == landmarks[i]:
            unlink(a, rows[i])
