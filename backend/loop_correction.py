"""Moves keyframes and their landmarks, for example after a loop correction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import inner_kernel, kernel
from vslam.types.geometry import compose, inverse
from vslam.types.map import Map


def move_keyframes(
    map_: Map, keyframes: NDArray[np.integer], T_cw_new: NDArray[np.float64]
) -> None:
    """Set the poses of keyframes, and move each landmark rigidly with its anchor keyframe.

    The anchor of a landmark is the keyframe that first observed it (section VII-C of the ORB-SLAM
    paper). If that keyframe was culled, the anchor is the oldest keyframe that observes the
    landmark. A landmark whose anchor is not among ``keyframes`` does not move.

    The distance range of a landmark stays the same, and its normal is rotated with the anchor. Both
    are exact only if all keyframes that observe the landmark move in the same way. Culled keyframes
    need no update, because their poses are stored relative to other keyframes.

    Args:
        keyframes: ``(N,)`` ids of keyframes that have not been culled.
        T_cw_new: ``(N, 4, 4)`` new poses of these keyframes (world to camera).

    Raises:
        ValueError: one of the keyframes was culled, so that its pose cannot be set.
    """
    a = map_.arrays
    if not a.keyframe_alive[keyframes].all():
        raise ValueError("move_keyframes: some of the keyframes were culled; leave them out")
    T_cw_old = a.T_cw[: map_.n_keyframes].copy()
    a.T_cw[keyframes] = T_cw_new
    carry_landmarks(map_, np.arange(map_.n_landmarks), T_cw_old)


def carry_landmarks(map_: Map, landmarks: NDArray[np.int64], T_cw_old: NDArray[np.float64]) -> None:
    """Move landmarks rigidly with their anchor keyframes, which have already moved from
    ``T_cw_old`` to their current poses in the map.

    Args:
        landmarks: ``(N,)`` int64 ids; erased landmarks are skipped.
        T_cw_old: ``(K, 4, 4)`` previous poses of all keyframes (world to camera).
    """
    a, n = map_.arrays, map_.n_keyframes
    moved = np.any(T_cw_old != a.T_cw[:n], axis=(1, 2)) & a.keyframe_alive[:n]
    _carry(a, landmarks, _motions(T_cw_old, a.T_cw, moved), moved)


def carry_landmarks_by(map_: Map, motion: NDArray[np.float64], moved: NDArray[np.bool_]) -> None:
    """Move all landmarks by the given motions of their anchor keyframes.

    Args:
        motion: ``(K, 4, 4)`` transforms in the world frame, one for each anchor keyframe. If they
            are similarities, the caller must refresh the normals and distance ranges of the
            landmarks afterwards.
        moved: ``(K,)`` bool, True for keyframes that move. For the other keyframes, ``motion`` is
            ignored.
    """
    _carry(map_.arrays, np.arange(map_.n_landmarks), motion, moved)


@kernel
def _motions(T_cw_old, T_cw_new, moved):
    """Compute the ``(K, 4, 4)`` motion of each keyframe in the world frame. A point p that is fixed
    to the keyframe moves to ``motion p``."""
    motion = np.zeros((len(moved), 4, 4))
    for k in range(len(moved)):
        if moved[k]:
            T = compose(inverse(T_cw_new[k]), T_cw_old[k])
            for i in range(4):
                for j in range(4):
                    motion[k, i, j] = T[i, j]
    return motion


@kernel
def _carry(a, landmarks, motion, moved):
    p, n = np.empty(3), np.empty(3)
    for landmark in landmarks:
        if not a.landmark_alive[landmark]:
            continue
        anchor = anchor_of(a, landmark)
        if anchor < 0 or not moved[anchor]:
            continue
        for i in range(3):
            p[i], n[i] = a.xyz[landmark, i], a.normal[landmark, i]
        T = motion[anchor]
        for i in range(3):
            a.xyz[landmark, i] = T[i, 0] * p[0] + T[i, 1] * p[1] + T[i, 2] * p[2] + T[i, 3]
            a.normal[landmark, i] = T[i, 0] * n[0] + T[i, 1] * n[1] + T[i, 2] * n[2]


@inner_kernel
def anchor_of(a, landmark):
    """Return the id of the keyframe that a landmark moves with, or -1 if no keyframe observes the
    landmark."""
    first = a.first_keyframe[landmark]
    if a.keyframe_alive[first]:
        return first
    first = -1
    row = a.head[landmark]
    while row >= 0:
        if first < 0 or a.keyframe[row] < first:
            first = a.keyframe[row]
        row = a.next_row[row]
    return first
