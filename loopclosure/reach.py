"""Uses odometry to limit loop detection to the keyframes that the camera may be revisiting."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.config import SiameseConfig
from vslam.map import Map


def beyond_reach(map_: Map, keyframe: int, config: SiameseConfig) -> NDArray[np.float64]:
    """Compute how far each keyframe is beyond the reach of the camera. A keyframe is within reach
    if, according to odometry, the camera may be revisiting it.

    The result is the distance between the camera and each keyframe, minus a bound on the position
    error of odometry. The bound is a constant plus a fraction of the distance travelled since the
    keyframe. In a monocular map, whose scale is unknown and drifts, the bound is a larger fraction
    without the constant.

    Keyframes of other sub-maps are always within reach, because their pose relative to the camera
    is unknown.

    A keyframe of the same sub-map is out of reach if its viewing direction differs too much from
    that of the camera. The heading from odometry is accurate to a few degrees, and the detectors do
    not recognise a place from behind or from the side.

    Args:
        keyframe: id of the current keyframe.

    Returns:
        ``(n_keyframes,)`` float64, in the unit of the map. The value is at most 0 for keyframes
        within reach, and infinite for keyframes with a different viewing direction.
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
    direction = T[:, 2, :3]  # viewing direction of each keyframe in the world frame
    beyond[direction @ direction[keyframe] < np.cos(np.radians(config.reach_angle))] = np.inf
    if map_.restarts:
        submap = map_.submaps()
        beyond[submap != submap[keyframe]] = 0.0
    return np.asarray(beyond, np.float64)
