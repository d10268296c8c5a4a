"""What an IMU measured of gravity at the keyframes, as independent measurements."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.types.map import Map

# The direction of the odometry drifts. In rad/sqrt(s); at 10 m/s, this is 0.3 degrees in 100 m, as
# the worst of KITTI's sequences.
DRIFT = 1.5e-3


def gravity_at(
    map_: Map, keyframes: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what an IMU measured of gravity at keyframes (``KeyframeTable.gravity``).

    The errors of keyframes that follow each other soon are nearly equal, because the filter forgets
    slowly: after the time in which the odometry tilts by one standard deviation. The variance of a
    keyframe is multiplied by the number of keyframes within this time. [own]

    Args:
        keyframes: ``(N,)`` ids.

    Returns:
        ``(N, 3)`` directions of free fall in the frames of the cameras, and their ``(N,)`` standard
        deviations in radians. Both are zero where gravity is unknown.
    """
    direction, sigma = (
        column[keyframes] for column in (map_.keyframes.gravity, map_.keyframes.gravity_sigma)
    )
    known = np.flatnonzero(sigma > 0.0)
    drive, seconds = map_.sessions[keyframes[known]], map_.timestamps[keyframes[known]]
    reach = 0.5 * (sigma[known] / DRIFT) ** 2
    alike = np.empty(len(known))
    for one in np.unique(drive):
        of_drive = drive == one
        times, around = np.sort(seconds[of_drive]), reach[of_drive]
        end = np.searchsorted(times, seconds[of_drive] + around, "right")
        alike[of_drive] = end - np.searchsorted(times, seconds[of_drive] - around)
    sigma[known] *= np.sqrt(alike)
    return direction, sigma
