"""Local mapping: updates the map after each new keyframe (section VI of the ORB-SLAM paper)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vslam.backend.bundle_adjustment import BundleProblem, adjust
from vslam.backend.fusion import fuse_neighbourhood
from vslam.backend.inertial_adjustment import InertialChain, adjust_with_imu, chain_of
from vslam.backend.keyframe_motions import forget_motion, motions_between, record_motion
from vslam.backend.triangulation import triangulate_with_neighbours
from vslam.config import Config
from vslam.support.kernels import kernel
from vslam.types.camera import DISPARITY_WEIGHT, Camera
from vslam.types.context import Context
from vslam.types.imu import InertialWindow
from vslam.types.map import Map
from vslam.types.map_kernels import (
    erase_landmark,
    gather_observations,
    refresh_landmarks,
    unlink,
)
from vslam.types.reprojection import stack_uvr

# A recent landmark is culled if it is found in less than this fraction of the frames in which it
# should be visible. [OS1 VI-B, printed]
_MIN_FOUND_RATIO = 0.25
# Two keyframes are joined by a covisibility edge if they share at least this many landmarks. [OS1
# III-D, printed]
MIN_SHARED = 15

# Newest keyframes that inertial factors connect. The other keyframes of the window are moved by
# images alone and pull these with them: if only 10 are connected, the error of the rotation of
# flights over one second doubles. The bound keeps the dense system small. [own]
INERTIAL_KEYFRAMES = 30
RECENT_KEYFRAMES = 3  # how long a landmark is on probation, in keyframes (ORB-SLAM, VI-B)


def extend_map(map_: Map, keyframe: int, context: Context) -> None:
    """Find further observations of a new keyframe, which must already be linked to its landmarks:
    triangulate new landmarks, and fuse duplicates."""
    cull_recent_landmarks(map_, keyframe, context.camera)
    triangulate_with_neighbours(map_, keyframe, context)
    refresh_keyframe(map_, keyframe)
    fuse_neighbourhood(map_, keyframe, context)
    refresh_keyframe(map_, keyframe)


def refine_map(
    map_: Map, keyframe: int, context: Context, inertial: InertialWindow | None = None
) -> None:
    """Adjust the map around a new keyframe (``extend_map``), and cull redundant keyframes.

    Args:
        inertial: what is known from the IMU at the keyframe; None without an IMU.
    """
    if inertial is not None:
        record_motion(map_, keyframe, inertial)
    adjust_locally(map_, keyframe, context, inertial)
    cull_keyframes(map_, keyframe, context)


def refresh_keyframe(map_: Map, keyframe: int) -> None:
    """Recompute the descriptor, normal and distance range of each landmark that a keyframe
    observes."""
    refresh_landmarks(map_.arrays, map_.landmarks_of(keyframe), map_.scales)


def cull_recent_landmarks(map_: Map, keyframe: int, camera: Camera) -> None:
    """Erase recently created landmarks that tracking rarely finds, or that too few keyframes
    observe."""
    a, n = map_.arrays, map_.n_landmarks
    first = int(np.searchsorted(a.first_keyframe[:n], keyframe - RECENT_KEYFRAMES))
    # A stereo observation counts twice. In a stereo map, one stereo and one monocular observation
    # are too few. In a monocular map, two observations are too few.
    too_few = 2 if camera.monocular else 3
    _cull_landmarks(a, first, n, keyframe, _MIN_FOUND_RATIO, too_few)


@kernel
def _cull_landmarks(a, first, last, keyframe, min_found_ratio, too_few):
    for landmark in range(first, last):
        if not a.landmark_alive[landmark]:
            continue
        rarely_found = a.found[landmark] < min_found_ratio * a.visible[landmark]
        age = keyframe - a.first_keyframe[landmark]
        if rarely_found or (age >= 2 and a.n_observations[landmark] <= too_few):
            erase_landmark(a, landmark)


def adjust_locally(
    map_: Map, keyframe: int, context: Context, inertial: InertialWindow | None = None
) -> None:
    """Run local bundle adjustment around a keyframe (section VI-D of the ORB-SLAM paper).

    The keyframe, its covisible keyframes and all landmarks that these keyframes observe are
    optimised. Other keyframes that observe these landmarks are held fixed. The first keyframe of
    the map is also held fixed, because it defines the world frame. Afterwards, observations that
    fail the chi-square test are removed.

    Args:
        inertial: what is known from the IMU at the keyframe; None without an IMU.
    """
    config = context.config
    free, fixed, landmarks = local_window(map_, keyframe, config)
    problem, rows = assemble(map_, free, fixed, landmarks, context.camera)
    if len(free) == 0 or len(rows) == 0:
        return
    coarse = adjust(problem, iterations=config.mapping.ba_iterations // 2, tolerance=1e-3)
    refined = replace(problem, T_cw=coarse.T_cw, points=coarse.points)
    cameras, iterations = np.concatenate([free, fixed]), config.mapping.ba_iterations
    chain = None if inertial is None else chain_in(map_, keyframe, cameras, inertial)
    final = None
    if chain is not None:
        final = adjust_with_imu(
            refined, chain, iterations=iterations, use=coarse.inlier, tolerance=1e-3
        )
        # With one camera, the scale of the images may be wrong, and not the motion.
        if final is None and not context.camera.monocular:
            forget_motion(map_, keyframe)
    if final is None:
        final = adjust(refined, iterations=iterations, use=coarse.inlier, tolerance=1e-3)
    a = map_.arrays
    a.T_cw[free] = final.T_cw[: len(free)]
    a.xyz[landmarks] = final.points
    remove_observations(a, rows[~final.inlier])
    refresh_landmarks(a, landmarks, map_.scales)


def chain_in(
    map_: Map, keyframe: int, cameras: NDArray[np.int64], inertial: InertialWindow
) -> InertialChain | None:
    """Connect the newest keyframes of a local window by inertial factors, up to a keyframe that is
    not part of the window. None if there are no two such keyframes.

    Args:
        cameras: ``(K,)`` ids of the keyframes of the window.
    """
    a, restarts = map_.arrays, map_.restarts
    index = map_.places_among(cameras)
    ids: list[int] = []
    for one in range(keyframe, -1, -1):
        if not a.keyframe_alive[one]:
            continue
        if index[one] < 0 or map_.sessions[one] != map_.sessions[keyframe]:
            break
        ids.append(one)
        if one in restarts or len(ids) == INERTIAL_KEYFRAMES:
            break
    ids.reverse()
    motions, R_world_camera = motions_between(map_, np.array(ids)), a.T_cw[keyframe, :3, :3].T
    return chain_of(inertial, motions, index[ids], R_world_camera)


def local_window(
    map_: Map, keyframe: int, config: Config
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int32]]:
    """Select the keyframes and landmarks of local bundle adjustment. Returns the ids of the
    keyframes that are optimised, of the keyframes that are held fixed, and of the landmarks."""
    strong = strong_neighbours(map_, keyframe)
    window = np.concatenate([[keyframe], strong])[: config.mapping.max_ba_keyframes]
    landmarks, others = window_landmarks(
        map_.arrays, window.astype(np.int64), map_.n_landmarks, map_.n_keyframes
    )
    free = np.sort(window[window != 0])
    fixed = np.flatnonzero(others)
    if 0 in window:
        fixed = np.concatenate([[0], fixed])
    if len(fixed) == 0 and len(free) > 1:
        # No fixed keyframe connects the window to the map, so the oldest keyframe of the window is
        # held fixed.
        free, fixed = free[1:], free[:1]
    return free.astype(np.int64), fixed.astype(np.int64), landmarks


def strong_neighbours(map_: Map, keyframe: int) -> NDArray[np.int64]:
    """Return the ids of the neighbours of a keyframe in the covisibility graph, those that share
    the most landmarks first.

    Neighbours that share few landmarks are left out, except the best neighbour (section III-D of
    the ORB-SLAM paper).
    """
    neighbours, shared = map_.covisible(keyframe)
    return neighbours[(shared >= MIN_SHARED) | (np.arange(len(shared)) == 0)]


@kernel
def window_landmarks(a, window, n_landmarks, n_keyframes):
    """Find the landmarks that the keyframes of a window observe, and the other keyframes that
    observe them.

    Returns:
        The ``(P,)`` int32 ids of the landmarks, and a ``(K,)`` bool mask of the other keyframes.
    """
    seen = np.zeros(n_landmarks, np.bool_)
    others = np.zeros(n_keyframes, np.bool_)
    for keyframe in window:
        for row in range(a.first_row[keyframe], a.first_row[keyframe + 1]):
            if a.landmark[row] >= 0:
                seen[a.landmark[row]] = True
    landmarks = np.flatnonzero(seen).astype(np.int32)
    for landmark in landmarks:
        row = a.head[landmark]
        while row >= 0:
            others[a.keyframe[row]] = True
            row = a.next_row[row]
    for keyframe in window:
        others[keyframe] = False
    return landmarks, others


def assemble(
    map_: Map,
    free: NDArray[np.int64],
    fixed: NDArray[np.int64],
    landmarks: NDArray[np.int32],
    camera: Camera,
) -> tuple[BundleProblem, NDArray[np.int64]]:
    """Assemble the bundle problem of the given keyframes and landmarks.

    Args:
        free, fixed: ids of the keyframes that are optimised, and ids of the keyframes that are held
            fixed.
        landmarks: ``(P,)`` ids of the landmarks.

    Returns:
        The problem, and the ``(O,)`` int64 row of each observation in the observation arrays of the
        map.
    """
    a = map_.arrays
    cameras = np.concatenate([free, fixed])
    index = map_.places_among(cameras)
    first, rows = gather_observations(a, landmarks, index)
    problem = BundleProblem(
        T_cw=a.T_cw[cameras],
        n_free=len(free),
        points=a.xyz[landmarks],
        first=first,
        camera=index[a.keyframe[rows]],
        uvr=stack_uvr(a.xy[rows], a.u_right[rows]),
        inverse_sigma2=map_.scales[a.octave[rows]] ** -2.0 * a.certainty[rows],
        intrinsics=camera.intrinsics,
        disparity_weight=DISPARITY_WEIGHT / np.sqrt(a.certainty[rows], dtype=np.float64),
    )
    return problem, rows


@kernel
def remove_observations(a, rows):
    """Remove the observations in ``(N,)`` rows of the observation arrays of the map. Rows that no
    longer hold an observation are skipped."""
    for row in rows:
        if a.landmark[row] >= 0:
            unlink(a, row)


def cull_keyframes(map_: Map, keyframe: int, context: Context) -> None:
    """Cull redundant keyframes among the covisible keyframes of a keyframe (section VI-E of the
    ORB-SLAM paper).

    A keyframe is redundant if most of its close landmarks are redundant (``count_redundant``).
    """
    neighbours, shared = map_.covisible(keyframe)
    bf, restarts = context.camera.bf, map_.restarts
    for neighbour in neighbours[shared >= MIN_SHARED]:
        if neighbour == 0 or neighbour in restarts:
            continue  # the first keyframe of a sub-map defines its frame
        seen, redundant = count_redundant(map_.arrays, int(neighbour), bf, context.close_depth)
        if redundant > context.config.mapping.redundant_ratio * seen:
            map_.cull_keyframe(int(neighbour))


@kernel
def count_redundant(a, keyframe, bf, close_depth):
    """Count the close landmarks of a keyframe, and count how many of these landmarks are redundant.

    A landmark is redundant if at least three other keyframes observe it at a finer or about the
    same scale. If ``bf`` is 0 (monocular camera), all landmarks count as close.
    """
    seen, redundant = 0, 0
    for row in range(a.first_row[keyframe], a.first_row[keyframe + 1]):
        landmark = a.landmark[row]
        if landmark < 0:
            continue
        # A comparison with NaN is false, so observations without depth do not count.
        if bf > 0.0 and not bf < close_depth * (a.xy[row, 0] - a.u_right[row]):
            continue
        seen += 1
        others = 0
        other = a.head[landmark]
        while other >= 0 and others < 3:
            if a.keyframe[other] != keyframe and a.octave[other] <= a.octave[row] + 1:
                others += 1
            other = a.next_row[other]
        if others >= 3:
            redundant += 1
    return seen, redundant
