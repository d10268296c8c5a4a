"""Which keyframes of a map lie in a part of it. Their height does not count."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vslam.geometry import inverses
from vslam.map import Map


def in_box(map_: Map, box: Sequence[float]) -> NDArray[np.int64]:
    """Living keyframes between two x and two z, ascending."""
    keyframes, xz = _places(map_)
    low, high = np.array(box).reshape(2, 2).T
    return keyframes[((xz >= low) & (xz <= high)).all(axis=1)]


def near_point(map_: Map, point: Sequence[float], within: float) -> NDArray[np.int64]:
    """Living keyframes within a distance of an x and z, ascending."""
    keyframes, xz = _places(map_)
    return keyframes[np.linalg.norm(xz - point, axis=1) <= within]


def near_frames(
    map_: Map, drive: int, first: float, last: float, within: float
) -> NDArray[np.int64]:
    """Living keyframes within a distance of those that frames of a drive, ``first`` to ``last``,
    were; ascending."""
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
