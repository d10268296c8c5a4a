"""Cuts out image patches around keypoints, and stores the patches of the newest keyframes. Matches
are aligned to these patches with sub-pixel accuracy.

Older patches are discarded. They are rarely needed, because the newest keyframes observe nearly all
landmarks that are being tracked. In addition, a patch takes more memory than the rest of an
observation. At a known place, where old keyframes observe the landmarks, patches are taken from a
frame that returned to this place.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import kernel
from vslam.types.context import Context
from vslam.types.features import (
    PATCH_PIXELS,
    PATCH_RADIUS,
    PATCH_SIDE,
    FramePatches,
    KeyframePatches,
    LandmarkPatches,
    Pyramid,
    level_pixel,
)
from vslam.types.geometry import Matrix
from vslam.types.map import Map
from vslam.types.track import Track


def patches_around(
    pyramid: Pyramid, xy: NDArray[np.float32], octave: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Cut out a square patch around each keypoint, from the pyramid level of its octave.

    Args:
        xy: ``(N, 2)`` positions in full-resolution pixels. The patches must lie inside their
            levels.
        octave: ``(N,)`` pyramid levels.

    Returns:
        ``(N, PATCH_PIXELS)`` uint8 patches, row by row.
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


def _patches_of(
    track: Track, chosen: NDArray[np.int64], scales: NDArray[np.float64]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return the patches around some features of a frame as ``KeyframePatches.pixels`` and
    ``shift``. The frame must have a pyramid."""
    pyramid = track.extracted.pyramid
    assert pyramid is not None
    octave, shift = track.features.octave[chosen], np.zeros((len(chosen), 2), np.float32)
    if track.shift is not None:
        aligned = track.aligned[chosen]
        shift[aligned] = track.shift[chosen[aligned]] / scales[octave[aligned]][:, None]
    return patches_around(pyramid, track.features.xy[chosen], octave), shift


def patches_of_frame(track: Track, scales: NDArray[np.float64]) -> FramePatches | None:
    """Cut out the patches of the landmarks that a frame tracks. None if it has no pyramid.

    Args:
        scales: ``(levels,)`` full-resolution pixels per pixel of each octave.
    """
    if track.extracted.pyramid is None:
        return None
    tracked = np.flatnonzero(track.landmark >= 0)
    landmark, first = np.unique(track.landmark[tracked], return_index=True)
    tracked = tracked[first]
    return FramePatches(
        track.index,
        landmark,
        track.features.octave[tracked],
        track.features.angle[tracked],
        *_patches_of(track, tracked, scales),
    )


def patches_of_landmarks(
    patches: FramePatches, ids: NDArray[np.int32], T_cw: Matrix, scales: NDArray[np.float64]
) -> LandmarkPatches:
    """Look up the patches of landmarks among those of a frame. Landmarks without one are omitted.

    Args:
        ids: ``(L,)`` ids of the landmarks, sorted.
        T_cw: ``(4, 4)`` pose of the frame.
        scales: ``(levels,)`` full-resolution pixels per pixel of each octave.
    """
    known, where, _ = np.intersect1d(patches.landmark, ids, assume_unique=True, return_indices=True)
    return LandmarkPatches(
        known,
        where,
        np.zeros(len(known), np.int64),
        scales[patches.octave[where]],
        patches.angle[where],
        patches.pixels,
        patches.shift,
        T_cw[None],
    )


class RecentPatches:
    """Stores the image patches around the features of the newest ``capacity`` keyframes.

    Frames without an image pyramid have no patches.
    """

    def __init__(self, capacity: int) -> None:
        self._keyframes = np.full(capacity, -1, np.int64)  # id of the keyframe in each slot, or -1
        self._n_features = np.zeros(capacity, np.int64)
        self._pixels = np.empty((capacity, 0, PATCH_PIXELS), np.uint8)
        self._shift = np.empty((capacity, 0, 2), np.float32)
        self._xy = np.empty((capacity, 0, 2), np.float32)
        self._next = 0

    def remember(self, track: Track, keyframe: int, scales: NDArray[np.float64]) -> None:
        """Store the patches around the features of a frame that became a keyframe.

        Args:
            keyframe: id of the new keyframe.
            scales: ``(levels,)`` full-resolution pixels per pixel of each octave.
        """
        if track.extracted.pyramid is not None:
            everything = np.arange(len(track.features))
            patches = _patches_of(track, everything, scales)
            self.add(KeyframePatches(keyframe, *patches, track.refined_features().xy))

    def add(self, patches: KeyframePatches) -> None:
        """Store the patches of one keyframe. If the store is full, they replace the patches of the
        oldest keyframe."""
        slot, n = self._next, len(patches.pixels)
        if n > self._shift.shape[1]:
            self._pixels = _widened(self._pixels, n)
            self._shift, self._xy = _widened(self._shift, n), _widened(self._xy, n)
        self._pixels[slot, :n], self._shift[slot, :n] = patches.pixels, patches.shift
        self._xy[slot, :n] = patches.xy
        self._keyframes[slot], self._n_features[slot] = patches.keyframe, n
        self._next = (slot + 1) % len(self._keyframes)

    def all(self) -> tuple[KeyframePatches, ...]:
        """Return the stored patches of all keyframes, oldest keyframe first."""
        slots = np.roll(np.arange(len(self._keyframes)), -self._next)
        return tuple(
            KeyframePatches(
                int(self._keyframes[slot]),
                self._pixels[slot, : self._n_features[slot]].copy(),
                self._shift[slot, : self._n_features[slot]].copy(),
                self._xy[slot, : self._n_features[slot]].copy(),
            )
            for slot in slots
            if self._keyframes[slot] >= 0
        )

    def of(self, map_: Map, ids: NDArray[np.int32]) -> LandmarkPatches:
        """Look up the image patches of landmarks in the map.

        Each patch comes from the newest keyframe that observes the landmark and whose patches are
        stored. A landmark without such a keyframe is omitted. The result is valid until ``add`` is
        called.

        Args:
            ids: ``(L,)`` ids of the landmarks, sorted.
        """
        width, arrays = self._shift.shape[1], map_.arrays
        row, view = newest_rows(arrays, self._keyframes, ids)
        seen = np.flatnonzero(row >= 0)
        row, view = row[seen], view[seen]
        keyframes, size = np.maximum(self._keyframes, 0), map_.scales[arrays.octave[row]]
        where = view * width + row - arrays.first_row[keyframes[view]]
        shift = self._shift.reshape(-1, 2).copy()
        shift[where] += (arrays.xy[row] - self._xy.reshape(-1, 2)[where]) / size[:, None]
        return LandmarkPatches(
            ids[seen],
            where,
            view,
            size,
            arrays.angle[row],
            self._pixels.reshape(-1, PATCH_PIXELS),
            shift,
            arrays.T_cw[keyframes],
        )


def _widened(array: NDArray, n: int) -> NDArray:
    wide = np.zeros((len(array), n, array.shape[2]), array.dtype)
    wide[:, : array.shape[1]] = array
    return wide


def certainty_of(track: Track, context: Context) -> NDArray[np.uint8] | int:
    """Compute the ``(N,)`` uint8 certainty of the position of each feature (``Arrays.certainty``):
    the usual variance of a keypoint's position, divided by the variance of this position. It is 1
    for all features of a frame without a pyramid.

    The position of an aligned match is accurate. A feature without a match is also considered
    accurate, because its position defines the landmark that is created from it. The position of a
    match that was not aligned is wrong by about half a pixel.
    """
    if track.extracted.pyramid is None:
        return 1
    unaligned = (track.landmark >= 0) & ~track.aligned
    return np.where(unaligned, 1, context.aligned_certainty).astype(np.uint8)


@kernel
def newest_rows(a, keyframes, ids):
    """For each of ``(L,)`` landmarks, find its observation by the newest of the given keyframes.

    The observations of a landmark are linked roughly from the newest to the oldest keyframe. The
    search therefore ends at the first observation that is older than all ``keyframes``.

    Returns:
        Two ``(L,)`` int64 arrays: the row of each observation in the observation arrays of the map,
        and the index into ``keyframes`` of the keyframe that made the observation. Both are -1
        where none of ``keyframes`` observes the landmark.
    """
    found, view = np.full(len(ids), -1, np.int64), np.full(len(ids), -1, np.int64)
    newest = keyframes.max()
    if newest < 0:
        return found, view
    oldest = newest
    for keyframe in keyframes:
        if keyframe >= 0:
            oldest = min(oldest, keyframe)
    place = np.full(newest - oldest + 1, -1, np.int64)
    for k in range(len(keyframes)):
        if keyframes[k] >= 0:
            place[keyframes[k] - oldest] = k
    for i in range(len(ids)):
        row, best = a.head[ids[i]], -1
        while row >= 0 and a.keyframe[row] >= oldest:
            keyframe = a.keyframe[row]
            if best < keyframe <= newest and place[keyframe - oldest] >= 0:
                found[i], view[i], best = row, place[keyframe - oldest], keyframe
            row = a.next_row[row]
    return found, view
