"""Sub-pixel alignment of what keyframes observe, to the image patches of other keyframes.

Tracking aligns the matches of a frame. Local mapping then finds further observations of landmarks
by their descriptors: both ends of a triangulated pair, and those of fused landmarks. A keypoint is
off by about half a pixel, with a bias towards the focus of expansion (``alignment``). The scale of
one camera drifts with this bias, because nothing else tells how far it moves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.frontend.alignment import register
from vslam.support.kernels import kernel
from vslam.types.context import Context
from vslam.types.features import KeyframePatches, LandmarkPatches
from vslam.types.map import Map


def align_observations(
    map_: Map, keyframe: int, patches: tuple[KeyframePatches, ...], context: Context
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Align the observations of a new keyframe's landmarks that are positions of keypoints only.

    Each is aligned to the patch of the newest keyframe that has an aligned observation of the
    landmark, or that observes the landmark first.

    Args:
        patches: image patches of the newest keyframes. Only their observations are aligned.

    Returns:
        ``(N,)`` rows of the aligned observations in the observation arrays of the map, and
        ``(N, 2)`` float32 new positions in pixels.
    """
    if not patches:
        return np.empty(0, np.int64), np.empty((0, 2), np.float32)
    a = map_.arrays
    ids = np.array([one.keyframe for one in patches])
    first = np.cumsum([0, *(len(one.pixels) for one in patches)])
    row, view, other, view_of_other = unaligned_rows(a, ids, map_.landmarks_of(keyframe))
    at, size = first[view] + row - a.first_row[ids[view]], map_.scales[a.octave[row]]
    known = LandmarkPatches(
        a.landmark[row],
        first[view_of_other] + other - a.first_row[ids[view_of_other]],
        view_of_other,
        map_.scales[a.octave[other]],
        a.angle[other],
        np.concatenate([one.pixels for one in patches]),
        np.concatenate([_shift_in(map_, one) for one in patches]),
        a.T_cw[ids],
    )
    found = np.empty((len(row), 2), np.float32)
    for k, one in enumerate(ids):
        here = np.flatnonzero(view == k)
        found[here] = register(
            known.pixels[at[here]],
            a.T_cw[one],
            a.xyz[a.landmark[row[here]]],
            size[here],
            known,
            here,
            context.camera.intrinsics,
            context.config.alignment,
        )
    aligned = np.isfinite(found[:, 0])
    moved = (found - known.shift[at]) * size[:, None].astype(np.float32)
    return row[aligned], (a.xy[row] + moved)[aligned]


def _shift_in(map_: Map, patches: KeyframePatches) -> NDArray[np.float32]:
    """Return ``KeyframePatches.shift`` of a keyframe's features as they are in the map now."""
    a, rows = map_.arrays, map_.rows(patches.keyframe)
    moved = (a.xy[rows] - patches.xy) / map_.scales[a.octave[rows]][:, None]
    return patches.shift + moved.astype(np.float32)


@kernel
def unaligned_rows(a, keyframes, landmarks):
    """Find the observations of landmarks that are not aligned, and what they can be aligned to.

    Args:
        a: the arrays of the map.
        keyframes: ``(K,)`` ids of the keyframes whose observations are considered, ascending.
        landmarks: ``(L,)`` ids of the landmarks.

    Returns:
        Four ``(N,)`` int64 arrays: the row of each unaligned observation and the index of its
        keyframe in ``keyframes``; the row and the index of the newest observation of the same
        landmark that is more certain than a keypoint.
    """
    oldest, newest = keyframes[0], keyframes[-1]
    place = np.full(newest - oldest + 1, -1, np.int64)
    for k in range(len(keyframes)):
        place[keyframes[k] - oldest] = k
    n = 0
    for landmark in landmarks:
        row = a.head[landmark]
        while row >= 0:
            n += 1
            row = a.next_row[row]
    out = np.empty((4, n), np.int64)
    n = 0
    for landmark in landmarks:
        best, best_view, first = -1, -1, n
        row = a.head[landmark]
        while row >= 0:
            keyframe = a.keyframe[row]
            if oldest <= keyframe <= newest and place[keyframe - oldest] >= 0:
                view = place[keyframe - oldest]
                if a.certainty[row] > 1:
                    if view > best_view:
                        best, best_view = row, view
                else:
                    out[0, n], out[1, n] = row, view
                    n += 1
            row = a.next_row[row]
        if best < 0:
            n = first
        for i in range(first, n):
            out[2, i], out[3, i] = best, best_view
    return out[0, :n], out[1, :n], out[2, :n], out[3, :n]
