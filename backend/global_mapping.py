"""Takes a snapshot of the map for global bundle adjustment, and applies the solution to the map.

Global bundle adjustment takes seconds. It therefore works on a snapshot, while tracking and local
mapping continue (Mur-Artal and Tardós, ORB-SLAM2, T-RO 2017, section III-D).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vslam.backend.bundle_adjustment import BundleProblem, BundleSolution
from vslam.backend.gravity import gravity_at
from vslam.backend.inertial_factor import InertialLinks
from vslam.backend.keyframe_motions import motions_between
from vslam.backend.local_mapping import assemble
from vslam.backend.loop_correction import carry_landmarks
from vslam.support.kernels import kernel
from vslam.types.camera import DISPARITY_WEIGHT, Camera
from vslam.types.geometry import compose, inverse, orthonormalised
from vslam.types.imu import GRAVITY
from vslam.types.map import Map
from vslam.types.map_kernels import refresh_landmarks, resolve, unlink


@dataclass(frozen=True)
class GlobalSnapshot:
    """A copy of the map as a bundle problem, with the ids of its cameras, points and observations.

    Attributes:
        keyframes: ``(K,)`` int64 keyframe id of each camera of the problem.
        landmarks: ``(P,)`` int32 landmark id of each point of the problem.
        rows: ``(O,)`` int64 row of each observation in the observation arrays of the map. It is -1
            for the observations of revisits.
        n_keyframes, n_landmarks: first ids of the keyframes and landmarks that are newer than the
            snapshot.
        n_revisits: number of revisits of the map, which are the first cameras of the problem. The
            keyframes follow.
    """

    problem: BundleProblem
    keyframes: NDArray[np.int64]
    landmarks: NDArray[np.int32]
    rows: NDArray[np.int64]
    n_keyframes: int
    n_landmarks: int
    n_revisits: int


def take_snapshot(map_: Map, camera: Camera) -> GlobalSnapshot:
    """Copy the map, without culled keyframes and landmarks, into a bundle problem for global bundle
    adjustment. The revisits of the map are further cameras, which are optimised.

    The first keyframe of each connected part of the map is held fixed, because nothing else
    determines the position of this part. Two keyframes are connected if they observe a common
    landmark. In the part of the first keyframe, gravity has the same direction everywhere, where an
    IMU has measured it, and the motions of the IMU connect consecutive keyframes.
    """
    living = map_.living_keyframes()
    landmarks = map_.living_landmarks().astype(np.int32)
    part = connected_parts(map_.arrays, landmarks, map_.n_keyframes)
    first = part[living] == living
    free, fixed = living[~first], living[first]
    keyframes = np.concatenate([free, fixed])
    problem, rows = assemble(map_, free, fixed, landmarks, camera)
    n_revisits = len(map_.revisits)
    if n_revisits:
        problem, rows = _with_revisits(map_, problem, rows, landmarks)
    gravity, sigma = gravity_at(map_, keyframes)
    sigma[part[keyframes] != part[living[0]]] = 0.0  # other parts may have any attitude
    if sigma.any():
        unknown = np.zeros((n_revisits, 3))
        gravity, sigma = np.concatenate([unknown, gravity]), np.r_[unknown[:, 0], sigma]
        links = _links(map_, n_revisits + np.argsort(keyframes), part, gravity, sigma)
        problem = replace(problem, gravity=gravity, gravity_sigma=sigma, links=links)
    return GlobalSnapshot(
        problem, keyframes, landmarks, rows, map_.n_keyframes, map_.n_landmarks, n_revisits
    )


def _links(
    map_: Map,
    camera: NDArray[np.int64],
    part: NDArray[np.int64],
    gravity: NDArray[np.float64],
    sigma: NDArray[np.float64],
) -> InertialLinks | None:
    """Connect the keyframes of the part of the first keyframe by the motions of the IMU.

    Args:
        camera: ``(K,)`` indices of the living keyframes, in the order of their ids.
        part: see ``connected_parts``.
        gravity, sigma: see ``BundleProblem``.
    """
    living = map_.living_keyframes()
    motions = motions_between(map_, living)
    usable = part[living] == part[living[0]]
    known = (motions.seconds > 0.0) & usable[:-1] & usable[1:]
    if not known.any():
        return None
    felt = sigma[camera] > 0.0
    R_cw, weight = map_.arrays.T_cw[living[felt], :3, :3], sigma[camera[felt]] ** -2.0
    down = np.einsum("n,nji,nj->i", weight, R_cw, gravity[camera[felt]])
    down *= GRAVITY / np.linalg.norm(down)
    return InertialLinks(camera[:-1][known], camera[1:][known], motions.some(known), down)


def _with_revisits(
    map_: Map, problem: BundleProblem, rows: NDArray[np.int64], landmarks: NDArray[np.int32]
) -> tuple[BundleProblem, NDArray[np.int64]]:
    """Add the revisits to the cameras of a bundle problem, before all other cameras. ``rows`` and
    ``landmarks`` are those of ``GlobalSnapshot``."""
    revisits = map_.revisits.observing(resolve(map_.arrays, map_.revisits.landmark))
    seen = np.flatnonzero(revisits.landmark >= 0)
    certainty = revisits.certainty[seen].astype(np.float64)
    point_of = np.empty(map_.n_landmarks, np.int64)
    point_of[landmarks] = np.arange(len(landmarks))
    known = np.diff(problem.first)
    point = np.r_[np.repeat(np.arange(len(known)), known), point_of[revisits.landmark[seen]]]
    order = np.argsort(point, kind="stable")  # each revisit follows the keyframes
    camera = np.repeat(np.arange(len(revisits)), np.diff(revisits.first))[seen]
    weight = map_.scales[revisits.octave[seen]] ** -2.0 * certainty
    T_keyframe = np.array([map_.keyframe_pose(k) for k in revisits.keyframe.tolist()])
    together = replace(
        problem,
        T_cw=np.concatenate([revisits.T_c_keyframe @ T_keyframe, problem.T_cw]),
        n_free=len(revisits) + problem.n_free,
        first=np.searchsorted(point[order], np.arange(len(known) + 1)),
        camera=np.r_[problem.camera + len(revisits), camera][order],
        uvr=np.concatenate([problem.uvr, revisits.uvr[seen]])[order],
        inverse_sigma2=np.r_[problem.inverse_sigma2, weight][order],
        disparity_weight=np.r_[problem.disparity_weights(), DISPARITY_WEIGHT / np.sqrt(certainty)][
            order
        ],
    )
    return together, np.r_[rows, np.full(len(seen), -1)][order]


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


def apply_solution(map_: Map, snapshot: GlobalSnapshot, solution: BundleSolution) -> None:
    """Apply the result of global bundle adjustment to the map, which may have changed since the
    snapshot.

    Newer keyframes keep their pose relative to their parent in the spanning tree (ORB-SLAM2,
    section III-D). Newer landmarks move with their anchor keyframe. Observations that failed the
    chi-square test are removed, unless their features have been assigned to other landmarks since.
    """
    a = map_.arrays
    T_cw_old = a.T_cw[: map_.n_keyframes].copy()
    living = a.keyframe_alive[snapshot.keyframes]
    T_revisit, T_keyframe = np.split(solution.T_cw, [snapshot.n_revisits])
    a.T_cw[snapshot.keyframes[living]] = T_keyframe[living]
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
    outlier = ~solution.inlier & (snapshot.rows >= 0)
    remove_unchanged(a, snapshot.rows[outlier], observed[outlier])
    refresh_landmarks(a, map_.living_landmarks().astype(np.int32), map_.scales)
    reused = map_.revisits.keyframe[: snapshot.n_revisits].tolist()
    map_.revisits = map_.revisits.moved(
        np.array(
            [T @ inverse(map_.keyframe_pose(k)) for T, k in zip(T_revisit, reused, strict=True)]
        )
    )


@kernel
def remove_unchanged(a, rows, landmarks):
    """Remove the observations in ``(N,)`` rows of the observation arrays of the map that still
    belong to the given ``(N,)`` landmarks."""
    for i in range(len(rows)):
        if a.landmark[rows[i]] == landmarks[i]:
            unlink(a, rows[i])
