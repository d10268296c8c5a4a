"""Patches: the pixels around keypoints, and of landmarks as the newest keyframes saw them.

Only the newest keyframes keep theirs: those see nearly all that tracking follows, and a patch takes
more memory than the rest of an observation.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from vslam.features import (
    PATCH_PIXELS,
    PATCH_RADIUS,
    PATCH_SIDE,
    KeyframePatches,
    LandmarkPatches,
    Pyramid,
    level_pixel,
)
from vslam.kernels import kernel
from vslam.map import Map

NO_PATCHES = LandmarkPatches(
    np.empty(0, np.int32),
    np.empty((0, PATCH_PIXELS), np.uint8),
    np.empty((0, 2), np.float32),
    np.empty(0),
)


def patches_around(
    pyramid: Pyramid, xy: NDArray[np.float32], octave: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """``(N, PATCH_PIXELS)`` the pixels around keypoints in their octaves, row by row.

    Args:
        xy: ``(N, 2)`` full-resolution pixels, at least ``PATCH_RADIUS`` pixels of the octave from
            its border.
        octave: ``(N,)``.
    """
    return _cut(pyramid.pixels, pyramid.offsets, pyramid.shapes, xy, octave)


@kernel
def _cut(pixels, offsets, shapes, xy, octave):
    patches = np.empty((len(xy), PATCH_PIXELS), np.uint8)
    for i in range(len(xy)):
        level = octave[i]
        height, width = shapes[level]
        x = level_pixel(xy[i, 0], shapes[0, 1] / width) - PATCH_RADIUS
        y = level_pixel(xy[i, 1], shapes[0, 0] / height) - PATCH_RADIUS
        start = offsets[level] + y * width + x
        for row in range(PATCH_SIDE):
            for k in range(np.uintp(PATCH_SIDE)):
                patches[i, row * PATCH_SIDE + k] = pixels[start + row * width + k]
    return patches


def patches_of(
    map_: Map, ids: NDArray[np.int32], recent: Collection[KeyframePatches]
) -> LandmarkPatches:
    """The patches of landmarks, each by the newest keyframe that observes it.

    Args:
        ids: ``(L,)`` landmarks, sorted.
        recent: oldest first.
    """
    if not recent or not len(ids):
        return NO_PATCHES
    row, extent = newest_rows(
        map_.arrays, np.array([one.keyframe for one in recent]), ids, map_.scales
    )
    seen = np.flatnonzero(row >= 0)
    row = row[seen]
    pixels = np.empty((len(seen), PATCH_PIXELS), np.uint8)
    shift = np.empty((len(seen), 2), np.float32)
    for one in recent:
        rows = map_.rows(one.keyframe)
        mine = np.flatnonzero((row >= rows.start) & (row < rows.stop))
        pixels[mine] = one.pixels[row[mine] - rows.start]
        shift[mine] = one.shift[row[mine] - rows.start]
    return LandmarkPatches(ids[seen], pixels, shift, extent[seen])


@kernel
def newest_rows(a, keyframes, ids, scales):
    """By which row the last of some keyframes observes each landmark, -1 for none, and the depth
    in it times the width of a pixel of the octave."""
    row = np.full(len(ids), -1, np.int64)
    extent = np.zeros(len(ids))
    for keyframe in keyframes:
        if not a.keyframe_alive[keyframe]:
            continue
        T = a.T_cw[keyframe]
        for r in range(a.first_row[keyframe], a.first_row[keyframe + 1]):
            landmark = a.landmark[r]
            at = np.searchsorted(ids, landmark)
            if landmark < 0 or at == len(ids) or ids[at] != landmark:
                continue
            p = a.xyz[landmark]
            depth = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
            if depth > 0.0:
                row[at], extent[at] = r, depth * scales[a.octave[r]]
    return row, extent
