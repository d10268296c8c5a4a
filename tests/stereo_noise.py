"""Noise of stereo observations with the variances that the weights of a stereo camera assume."""

from __future__ import annotations

import numpy as np

from vslam.types.camera import DISPARITY_WEIGHT

# Converts errors of u, v and u_right to errors of u, v and the disparity, in standard deviations.
WHITENING = np.diag([1.0, 1.0, DISPARITY_WEIGHT]) @ np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 1]])


def white_noise(rng: np.random.Generator, stereo: np.ndarray) -> np.ndarray:
    """Draw ``(N, 3)`` random errors of u, v and u_right.

    The errors of a stereo observation have one standard deviation at octave 0. The errors of u and
    v of a monocular observation have one pixel.

    Args:
        stereo: ``(N,)`` bool, whether an observation is a stereo observation.
    """
    error = rng.normal(size=(len(stereo), 3))
    error[stereo] = error[stereo] @ np.linalg.inv(WHITENING).T
    return error
