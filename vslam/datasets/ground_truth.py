"""Ground truth measured at times of its own, at the times of frames."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.trajectory import Trajectory

_log = logging.getLogger(__name__)


def poses_at(
    source: Path, measured: Trajectory, times: NDArray[np.float64], start: int, every: int
) -> NDArray[np.float64] | None:
    """Interpolated poses: positions linearly, rotations along the shortest arc.

    Where the measured ones do not cover all frames there are none, and the log says which frames
    they cover.

    Args:
        source: file, for the log.
        times: ``(N,)`` seconds of the frames that ``start`` and ``every`` select.

    Returns:
        ``(N, 4, 4)`` float64 ``T_wc``, or None.
    """
    from scipy.spatial.transform import Rotation, Slerp

    known = measured.timestamps
    covered = np.flatnonzero((times >= known[0]) & (times <= known[-1]))
    if len(covered) < len(times):
        inside = "none of the frames"
        if len(covered):
            first, n = start + every * int(covered[0]), len(covered)
            inside = f"a part of the frames; --start {first} --max-frames {n} takes them"
        _log.warning("%s: the ground truth covers %s.", source, inside)
        return None
    T_wc = np.tile(np.eye(4), (len(times), 1, 1))
    turns = Rotation.from_matrix(measured.T_wc[:, :3, :3])
    T_wc[:, :3, :3] = Slerp(known, turns)(times).as_matrix()
    for k in range(3):
        T_wc[:, k, 3] = np.interp(times, known, measured.T_wc[:, k, 3])
    return T_wc
