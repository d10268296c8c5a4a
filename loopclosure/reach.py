"""Which keyframes the camera may see again, as far as odometry tells: no others are compared."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.config import SiameseConfig
from vslam.map import Map


def beyond_reach(map_: Map, keyframe: int, config: SiameseConfig) -> NDArray[np.float64]:
    """How far each keyframe lies beyond what the error of odometry may hide.

    The error of a position grows with the way driven. A monocular map has no metres and its unit
    drifts, so there the error is a larger share of the way alone. Keyframes of different sub-maps
    are always within reach: where the camera was lost between them, their relative pose is unknown,
    and in a monocular map so is the ratio of their units.

    Within a sub-map, a keyframe that looks another way than the camera is out of reach wherever it
    lies: odometry knows directions to a few degrees, and nothing here recognises a place from
    behind or from the side.

    Args:
        keyframe: where the camera is.

    Returns:
        ``(n_keyframes,)`` in the unit of the map; 0 or less for those that the camera may see
        again, infinite for those that look another way.
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
    ahead = T[:, 2, :3]  # where each keyframe looks, in the world
    beyond[ahead @ ahead[keyframe] < np.cos(np.radians(config.reach_angle))] = np.inf
    if map_.restarts:
        submap = map_.submaps()
        beyond[submap != submap[keyframe]] = 0.0
    return np.asarray(beyond, np.float64)
