"""Tells how long the camera moved between two frames that may have been stamped on arrival."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

RECENT = 25  # number of times that are looked at
_LEAST = 4  # number of steps that are needed to judge them
_REGULAR = 0.25  # a step is regular if it is this close to a multiple of the median step
_MANY = 0.25  # share of irregular steps above which frames were stamped on arrival
_GAP = 2.5  # multiple of the mean step above which frames are missing


def motion_seconds(times: NDArray[np.float64]) -> float:
    """Return the seconds of motion between the last two of N times.

    This is usually their difference. Frames that a loaded computer stamps when they arrive come in
    bursts, for example after 58, 58, 23 and 1 ms. A velocity that is divided by 1 ms and then
    multiplied by 58 ms predicts a wrong pose. Such frames were taken at regular intervals, so the
    result is then the mean step. A step is still taken as it is if frames are missing.

    Args:
        times: ``(N,)`` increasing seconds, with N at least 2. The last `RECENT` times are used.
    """
    steps = np.diff(times[-RECENT:])
    multiple = steps / np.median(steps)
    regular = np.abs(multiple - np.maximum(np.rint(multiple), 1.0)) <= _REGULAR
    last, mean = float(steps[-1]), float(np.mean(steps))
    if len(steps) < _LEAST or np.mean(~regular) < _MANY or last > _GAP * mean:
        return last
    return mean
