"""Limits loop detection to keyframes that the camera may be revisiting, according to odometry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.config import SiameseConfig
from vslam.map import Map


def beyond_reach(map_: Map, keyframe: int, config: SiameseConfig) -> NDArray[np.float64]:
    """By how much the distance to each keyframe exceeds the possible error of odometry.

    The error of a position is bounded by a constant plus a share of the distance driven. In a
    monocular map, which has no metric scale and whose scale drifts, the bound is a larger share
    without a constant. Keyframes of other sub-maps are always within reach: the camera was lost
    between the sub-maps, so their relative pose is unknown, and so is their relative scale if the
    map is monocular.

    Within a sub-map, keyframes that face another direction than the camera are out of reach at any
    distance, because the heading from odometry is accurate to a few degrees, and the detectors do
    not recognise a place from behind or from the side.

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
    odometer = np.zeros(n)
    odometer[living[1:]] = np.cumsum(steps)
    driven = np.abs(odometer[keyframe] - odometer)
    distance = np.linalg.norm(position - position[keyframe], axis=1)
    if np.isfinite(a.u_right[map_.rows(keyframe)]).any():
        beyond = distance - config.reach - config.reach_share * driven
    else:
        beyond = distance - config.monocular_reach_share * driven
    direction = T[:, 2, :3]  # viewing direction of each keyframe in the world
    beyond[direction @ direction[keyframe] < np.cos(np.radians(config.reach_angle))] = np.inf
    if map_.restarts:
        submap = map_.submaps()
        beyond[submap != submap[keyframe]] = 0.0
    return np.asarray(beyond, np.float64)
