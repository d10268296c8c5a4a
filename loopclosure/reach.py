"""Uses odometry to limit loop detection and relocalisation to the keyframes at which the camera may
be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.config import SiameseConfig
from vslam.types.geometry import inverses
from vslam.types.loops import LastSeen
from vslam.types.map import Map


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
    beyond = _distances_beyond_reach(map_, keyframe, _positions(map_), config)
    direction = map_.arrays.T_cw[: map_.n_keyframes, 2, :3]  # in the world frame
    beyond[direction @ direction[keyframe] < np.cos(np.radians(config.reach_angle))] = np.inf
    beyond[_in_other_submap(map_, keyframe)] = 0.0
    return beyond


def within_reach(map_: Map, last: LastSeen, config: SiameseConfig) -> NDArray[np.bool_]:
    """Return the keyframes at which a lost camera may be, as an ``(n_keyframes,)`` mask.

    The distance between a keyframe and the place where the camera was last tracked is limited as in
    :func:`beyond_reach`. The limit is larger by the distance that the camera may have travelled
    while it was lost, now and before earlier sub-maps. Its speed is assumed to be at most
    ``config.reach_speedup`` times the mean speed along the keyframes of the map.

    The viewing direction is not limited. Keyframes of other drives are always within reach. This is
    also true of keyframes of other sub-maps if their poses relative to the camera are unknown.
    """
    living, position = map_.living_keyframes(), _positions(map_)
    same_drive = np.diff(map_.sessions[living]) == 0
    elapsed = np.where(same_drive, np.diff(map_.timestamps[living]), 0.0)
    steps = np.where(same_drive, _steps(position[living]), 0.0)
    if elapsed.sum() <= 0.0:
        return np.ones(map_.n_keyframes, np.bool_)
    restarts = map_.keyframes.restart[living[1:]] != 0
    lost_s = _between(map_, last.keyframe, np.where(restarts, elapsed, 0.0)) + last.elapsed_s
    travelled = config.reach_speedup * steps.sum() / elapsed.sum() * lost_s
    beyond = _distances_beyond_reach(map_, last.keyframe, position, config) - travelled
    unknown = map_.sessions != map_.sessions[last.keyframe]
    if map_.unpredicted_restarts or not _is_metric(map_, last.keyframe):
        unknown |= _in_other_submap(map_, last.keyframe)
    return (beyond <= 0.0) | unknown


def _distances_beyond_reach(
    map_: Map, keyframe: int, position: NDArray[np.float64], config: SiameseConfig
) -> NDArray[np.float64]:
    driven = _between(map_, keyframe, _steps(position[map_.living_keyframes()]))
    distance = np.linalg.norm(position - position[keyframe], axis=1)
    if _is_metric(map_, keyframe):
        beyond = distance - config.reach - config.reach_share * driven
    else:
        beyond = distance - config.monocular_reach_share * driven
    return np.asarray(beyond, np.float64)


def _between(map_: Map, keyframe: int, steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum up a quantity along the drive, between a keyframe and each keyframe of the map. ``steps``
    are its values between consecutive keyframes that have not been culled."""
    at_keyframe = np.zeros(map_.n_keyframes)
    at_keyframe[map_.living_keyframes()[1:]] = steps
    total = np.cumsum(at_keyframe)
    return np.asarray(np.abs(total - total[keyframe]), np.float64)


def _is_metric(map_: Map, keyframe: int) -> bool:
    return bool(np.isfinite(map_.arrays.u_right[map_.rows(keyframe)]).any())


def _in_other_submap(map_: Map, keyframe: int) -> NDArray[np.bool_]:
    if not map_.restarts:
        return np.zeros(map_.n_keyframes, np.bool_)
    submap = map_.submaps()
    return np.asarray(submap != submap[keyframe], np.bool_)


def _positions(map_: Map) -> NDArray[np.float64]:
    return inverses(map_.arrays.T_cw[: map_.n_keyframes])[:, :3, 3]


def _steps(position: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(np.diff(position, axis=0), axis=1), np.float64)
