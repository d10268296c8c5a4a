"""Fuses landmarks that represent the same point in the world (section VI-C of the ORB-SLAM
paper)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import hamming, kernel
from vslam.types.context import Context
from vslam.types.features import CELL, FeatureGrid
from vslam.types.loops import LoopEdge
from vslam.types.map import Map
from vslam.types.map_kernels import (
    collect_landmarks,
    fuse_landmarks,
    link,
    observed_by,
    predict_octave,
)
from vslam.types.reprojection import chi_square_ratio, unpacked

# Duplicate landmarks of a new keyframe and of this many covisible keyframes are fused. [OS1 VI-C,
# customary]
_FUSE_NEIGHBOURS = 10
# Search radius for duplicate landmarks, in pixels at octave 0. [OS1 VI-C, customary]
_FUSE_WINDOW = 3.0


def fuse_neighbourhood(map_: Map, keyframe: int, context: Context) -> None:
    """Fuse the landmarks of a keyframe with the landmarks of its neighbours.

    The landmarks of the keyframe are projected into its neighbours, and the landmarks of the
    neighbours into the keyframe. If a projected landmark matches a feature that observes another
    landmark, the two landmarks are fused. If the feature has no landmark, it becomes an
    observation of the projected landmark.
    """
    neighbours = fusion_neighbours(map_, keyframe)
    for neighbour in neighbours:
        fuse_into(map_, map_.landmarks_of(keyframe), neighbour, context)
    landmarks = collect_landmarks(map_.arrays, np.array(neighbours, np.int64), map_.n_landmarks)
    fuse_into(map_, landmarks, keyframe, context)


def fusion_neighbours(map_: Map, keyframe: int) -> list[int]:
    """Return the ids of the keyframes whose landmarks are fused with the landmarks of a keyframe
    (ORB-SLAM2).

    First, they are the ``_FUSE_NEIGHBOURS`` keyframes that share the most landmarks with the
    keyframe. For each of these keyframes, the five keyframes that share the most landmarks with it
    are added.
    """
    first, _ = map_.covisible(keyframe)
    chosen = first[:_FUSE_NEIGHBOURS].tolist()
    known = {keyframe, *chosen}
    for neighbour in list(chosen):
        second, _ = map_.covisible(neighbour)
        new = [k for k in second[:5].tolist() if k not in known]
        chosen += new
        known.update(new)
    return chosen


def fuse_loop(
    map_: Map,
    edge: LoopEdge,
    query_side: list[int],
    match_side: list[int],
    context: Context,
) -> None:
    """Fuse the landmarks on the two sides of a loop, after the loop was corrected (section VII-D of
    the ORB-SLAM paper).

    The matches of loop verification are fused first. Then the landmarks of each side are projected
    into the keyframes of the other side.

    Args:
        edge: the loop. Its ``features`` and ``landmarks`` must be set.
        query_side, match_side: ids of the keyframes around the two ends of the loop. Their poses
            must already be corrected.
    """
    assert edge.features is not None
    assert edge.landmarks is not None
    a = map_.arrays
    first = map_.rows(edge.query).start
    _fuse_pairs(a, first + edge.features.astype(np.int64), edge.landmarks, edge.query)
    old = collect_landmarks(a, np.array(match_side, np.int64), map_.n_landmarks)
    for keyframe in query_side:
        fuse_into(map_, old, keyframe, context)
    new = collect_landmarks(a, np.array(query_side, np.int64), map_.n_landmarks)
    for keyframe in match_side:
        fuse_into(map_, new, keyframe, context)


@kernel
def _fuse_pairs(a, rows, landmarks, keyframe):
    """Assign each of the given landmarks to a feature of a keyframe. If the feature already
    observes another landmark, the two landmarks are fused. ``rows`` gives the row of each feature
    in the observation arrays of the map."""
    for i in range(len(rows)):
        row, landmark = rows[i], landmarks[i]
        own = a.landmark[row]
        if not a.landmark_alive[landmark] or own == landmark:
            continue
        if own >= 0:
            fuse_landmarks(a, own, landmark)
        elif observed_by(a, landmark, keyframe) < 0:
            link(a, row, landmark)


def fuse_into(map_: Map, landmarks: NDArray[np.int32], keyframe: int, context: Context) -> int:
    """Project ``(N,)`` landmarks into a keyframe, and fuse them with its features and landmarks.
    Returns the number of fusions."""
    a, rows, camera = map_.arrays, map_.rows(keyframe), context.camera
    grid = FeatureGrid.of_positions(a.xy[rows], camera.width, camera.height)
    return _fuse(
        a,
        landmarks,
        keyframe,
        grid,
        camera.intrinsics,
        camera.width,
        camera.height,
        map_.scales,
        _FUSE_WINDOW,
        context.config.mapping.fuse_distance,
    )


@kernel
def _fuse(
    a,
    landmarks,
    keyframe,
    grid,
    intrinsics,
    width,
    height,
    scales,
    window,
    max_distance,
):
    pinhole = unpacked(intrinsics)
    fx, fy, cx, cy, _, _ = pinhole
    start, items, columns = grid
    T = a.T_cw[keyframe]
    first_row = a.first_row[keyframe]
    grid_rows = (len(start) - 1) // columns
    log_scale = np.log(scales[1] / scales[0])
    centre = np.empty(3)
    for i in range(3):
        centre[i] = -(T[0, i] * T[0, 3] + T[1, i] * T[1, 3] + T[2, i] * T[2, 3])
    fused = 0
    for landmark in landmarks:
        if not a.landmark_alive[landmark]:
            continue
        p = a.xyz[landmark]
        z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        if z <= 0.1:
            continue
        x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
        y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
        u, v = fx * x / z + cx, fy * y / z + cy
        if u < 0.0 or u >= width or v < 0.0 or v >= height:
            continue
        dx, dy, dz = p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        if (
            distance < 0.8 * a.distance_range[landmark, 0]
            or distance > 1.2 * a.distance_range[landmark, 1]
        ):
            continue
        normal = a.normal[landmark]
        if dx * normal[0] + dy * normal[1] + dz * normal[2] < 0.5 * distance:
            continue
        if observed_by(a, landmark, keyframe) >= 0:
            continue
        octave = predict_octave(distance, a.distance_range[landmark, 1], log_scale, len(scales))
        r = window * scales[octave]
        # With a literal -1, Numba would compile ``link`` a second time for a literal argument.
        best, best_distance = np.int64(-1), max_distance + 1
        column_first, column_last = max(0, int((u - r) / CELL)), int((u + r) / CELL)
        column_last = min(columns - 1, column_last)
        for grid_row in range(
            max(0, int((v - r) / CELL)), min(grid_rows - 1, int((v + r) / CELL)) + 1
        ):
            for k in range(
                start[grid_row * columns + column_first],
                start[grid_row * columns + column_last + 1],
            ):
                row = first_row + items[k]
                level = int(a.octave[row])
                if level < octave - 1 or level > octave:
                    continue
                seen_u, seen_v = np.float64(a.xy[row, 0]), np.float64(a.xy[row, 1])
                seen_right, weight = np.float64(a.u_right[row]), scales[level] ** -2.0
                if chi_square_ratio(x, y, z, seen_u, seen_v, seen_right, weight, pinhole) > 1.0:
                    continue
                bits = hamming(a.landmark_descriptor[landmark], a.descriptor[row])
                if bits < best_distance:
                    best, best_distance = row, bits
        if best < 0:
            continue
        other = a.landmark[best]
        if other < 0:
            link(a, best, landmark)
            a.certainty[best] = 1  # not aligned, so its position is no better than a keypoint's
        elif a.n_observations[other] > a.n_observations[landmark]:
            fuse_landmarks(a, landmark, other)
        else:
            fuse_landmarks(a, other, landmark)
        fused += 1
    return fused
