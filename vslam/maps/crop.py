"""Selection of the keyframes in a part of a map, by their x and z; the height is ignored."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vslam.geometry import inverses
from vslam.map import Map


def in_box(map_: Map, box: Sequence[float]) -> NDArray[np.int64]:
    """Ids of the living keyframes in ``box`` (two x and two z, metres), ascending."""
    keyframes, xz = _places(map_)
    low, high = np.array(box).reshape(2, 2).T
    return keyframes[((xz >= low) & (xz <= high)).all(axis=1)]


def near_point(map_: Map, point: Sequence[float], within: float) -> NDArray[np.int64]:
    """Ids of the living keyframes within a distance (metres) of a point (x and z), ascending."""
    keyframes, xz = _places(map_)
    return keyframes[np.linalg.norm(xz - point, axis=1) <= within]


def near_frames(
    map_: Map, drive: int, first: float, last: float, within: float
) -> NDArray[np.int64]:
    """Ids of the living keyframes within a distance (metres) of the keyframes that were made from
    the frames ``first`` to ``last`` of a drive, ascending."""
    from scipy.spatial import cKDTree

    keyframes, xz = _places(map_)
    frame, session = map_.frames[keyframes], map_.sessions[keyframes]
    named = (session == drive) & (frame >= first) & (frame <= last)
    if not named.any():
        return keyframes[:0]
    distance, _ = cKDTree(xz[named]).query(xz)
    return keyframes[distance <= within]


def _places(map_: Map) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Living keyframes, and their x and z ``(N, 2)``."""
    keyframes = map_.living_keyframes()
    return keyframes, inverses(map_.arrays.T_cw[keyframes])[:, [0, 2], 3]
