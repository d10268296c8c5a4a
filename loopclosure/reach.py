"""Limits loop detection to keyframes whose view the camera may see again according to odometry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.config import SiameseConfig
from vslam.map import Map


def beyond_reach(map_: Map, keyframe: int, config: SiameseConfig) -> NDArray[np.float64]:
    """By how much the distance to each keyframe exceeds the possible error of odometry.

    The error of a position grows with the distance driven. A monocular map has no metric scale and
    its scale drifts, so its error is taken as a larger share of the distance driven, without a
    constant part. Keyframes of different sub-maps are always within reach: the camera was lost
    between them, so their relative pose is unknown, and in a monocular map also the ratio of their
    units.

    Within a sub-map, a keyframe that faces another direction than the camera is out of reach at any
    distance: odometry knows directions to a few degrees, and the detectors do not recognise a place
    from behind or from the side.

    Args:
        keyframe: id of the current keyframe.

    Returns:
        ``(n_keyframes,)`` float64 in the unit of the map: at most 0 for keyframes within reach,
        infinite for those that face another direction.
    """
    n, a = map_.n_keyframes, map_.arrays
    T = a.T_cw[:n]
    position = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    living = map_.living_keyframes()
    steps = np.linalg.norm(np.diff(position[living], axis=0), axis=1)
    driven = np.zeros(n)
    driven[living[1:]] = np.cumsum(steps)
    way = np.abs(driven[keyframe] - driven)
    apart = np.linalg.norm(position - position[keyframe], axis=1)
    if np.isfinite(a.u_right[map_.rows(keyframe)]).any():
        beyond = apart - config.reach - config.reach_share * way
    else:
        beyond = apart - config.monocular_reach_share * way
    ahead = T[:, 2, :3]  # viewing direction of each keyframe in the world
    beyond[ahead @ ahead[keyframe] < np.cos(np.radians(config.reach_angle))] = np.inf
    if map_.restarts:
        submap = map_.submaps()
        beyond[submap != submap[keyframe]] = 0.0
    return np.asarray(beyond, np.float64)
