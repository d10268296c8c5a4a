"""Recognises that the camera stands still, whatever moves in front of it.

When a large vehicle drives past a standing camera, or when a queue of cars moves off, most of the
image moves. The pose with the most inliers is then the pose relative to the vehicle. However, the
landmarks of the static scene stay exactly where they were in the image when the camera came to
rest. Landmarks of a moving object do not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

STAY = 0.4  # largest motion of a static landmark, pixels of its octave; patches are found to 0.1 px
BEGIN_SHARE = 0.8  # the camera has come to rest if this share of the landmarks did not move
# The camera still stands if this share of the close landmarks did not move, because they move at
# once when the camera moves off. If fewer landmarks than KEEP_LEAST did not move, because something
# covers the image, these must be at least FEWEST, and half of those that were found. If one motion
# explains all of them, they must be BEGIN_SHARE of those that were found.
KEEP_SHARE, KEEP_LEAST = 0.15, 40
FEWEST = 15
# The camera has moved off if less than half of the landmarks stayed, and if one motion explains
# where at least this share of the landmarks went.
MOVED_SHARE = 0.9
MEASURE_SHARE = 0.25  # share of the landmarks that are enough to measure the pose of the camera


def is_small(flow: NDArray[np.floating], scale: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether ``(M, 2)`` motions in the image may be errors of measurement. ``scale`` has
    the ``(M,)`` full-resolution pixels per pixel of the octaves of the landmarks."""
    small: NDArray[np.bool_] = np.linalg.norm(flow, axis=1) < STAY * scale
    return small


def has_come_to_rest(stayed: NDArray[np.bool_]) -> bool:
    """Return whether the camera has come to rest. ``stayed`` tells which of the landmarks that two
    frames tracked did not move in the image."""
    return bool(np.count_nonzero(stayed) >= max(KEEP_LEAST, BEGIN_SHARE * len(stayed)))


def still_stands(
    stayed: NDArray[np.bool_], follows: NDArray[np.bool_], close: NDArray[np.bool_]
) -> bool:
    """Return whether a standing camera still stands, given M landmarks that were seen when it came
    to rest.

    Args:
        stayed: ``(M,)`` bool, the landmarks that did not move in the image.
        follows: ``(M,)`` bool, the landmarks whose motion in the image follows from a motion of the
            camera that fits all landmarks best.
        close: ``(M,)`` bool, the landmarks that are so close that they would move in the image.
    """
    n_stayed = np.count_nonzero(stayed)
    if n_stayed < FEWEST:
        return False
    if n_stayed < KEEP_LEAST:
        share = BEGIN_SHARE if np.mean(follows) >= MOVED_SHARE else 0.5
        return bool(n_stayed >= share * len(stayed))
    if np.count_nonzero(close) >= KEEP_LEAST:
        stayed, follows = stayed[close], follows[close]
    if np.mean(stayed) < 0.5 and np.mean(follows) >= MOVED_SHARE:
        return False
    return bool(np.mean(stayed) >= KEEP_SHARE)
