"""Noise of stereo observations of the size that the weights of a stereo camera assume."""

from __future__ import annotations

import numpy as np

from vslam.camera import DISPARITY_WEIGHT

# Turns errors of u, v, u_right into those of u, v and the disparity, in standard deviations.
WHITENING = np.diag([1.0, 1.0, DISPARITY_WEIGHT]) @ np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 1]])


def white_noise(rng: np.random.Generator, stereo: np.ndarray) -> np.ndarray:
    """``(N, 3)`` errors of u, v, u_right, of one standard deviation at octave 0 each, for ``(N,)``
    bool whether it is a stereo observation; of u and v alone one pixel otherwise."""
    error = rng.normal(size=(len(stereo), 3))
    error[stereo] = error[stereo] @ np.linalg.inv(WHITENING).T
    return error
