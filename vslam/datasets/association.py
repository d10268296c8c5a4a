"""Association by time: pairing images, and interpolating ground truth at the times of frames."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.trajectory import Trajectory

_log = logging.getLogger(__name__)

# Longest gap in the ground truth across which poses are interpolated. Ground truth comes at 100 Hz
# (TUM), 200 Hz (EuRoC) or 10 Hz (vehicles). At an acceleration of 2 m/s^2, linear interpolation is
# off by 6 mm in the middle of this gap.
_MAX_GAP_S = 0.15
_MANY = 0.1  # share of images without a partner that causes a warning; TUM's have up to 7 %


def associate(
    first: NDArray[np.float64], second: NDArray[np.float64], max_difference: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pair times that are less than ``max_difference`` apart.

    The closest pairs are formed first, and each time is used at most once.

    Args:
        first, second: ``(N,)`` and ``(M,)`` seconds, increasing.

    Returns:
        ``(P,)`` increasing indices into ``first``, and ``(P,)`` indices into ``second``.
    """
    low = np.searchsorted(second, first - max_difference, side="right")
    high = np.searchsorted(second, first + max_difference, side="left")
    near = [(i, j) for i in range(len(first)) for j in range(low[i], high[i])]
    near.sort(key=lambda pair: (abs(first[pair[0]] - second[pair[1]]), pair))
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for i, j in near:
        if i not in partner and j not in taken:
            partner[i] = j
            taken.add(j)
    pairs = np.array(sorted(partner.items()), np.int64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def warn_of_unpaired(source: Path, n_pairs: int, n_images: int) -> None:
    """Warn if many colour images are skipped because no depth image is near them in time."""
    if n_pairs < (1.0 - _MANY) * n_images:
        _log.warning(
            "%s: only %d of %d images have a depth image within 20 ms; the others are skipped.",
            source,
            n_pairs,
            n_images,
        )


def poses_at(
    source: Path, measured: Trajectory, times: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Interpolate poses at given times: positions linearly, rotations by slerp.

    Args:
        source: file of the ground truth, for the log.
        times: ``(N,)`` seconds.

    Returns:
        ``(N, 4, 4)`` float64 ``T_wc``, NaN outside the measured time and in gaps longer than
        0.15 s. None, with a warning, if no time has a pose.
    """
    from scipy.spatial.transform import Rotation, Slerp

    known = measured.timestamps
    after = np.clip(np.searchsorted(known, times), 1, max(len(known) - 1, 1))
    if len(known) < 2:
        covered = np.zeros(len(times), np.bool_)
    else:
        near = known[after] - known[after - 1] <= _MAX_GAP_S
        covered = near & (times >= known[0]) & (times <= known[-1])
    if not covered.any():
        _log.warning("%s: the ground truth covers none of the frames.", source)
        return None
    T_wc = np.full((len(times), 4, 4), np.nan)
    T_wc[covered] = np.eye(4)
    turns = Rotation.from_matrix(measured.T_wc[:, :3, :3])
    T_wc[covered, :3, :3] = Slerp(known, turns)(times[covered]).as_matrix()
    for k in range(3):
        T_wc[covered, k, 3] = np.interp(times[covered], known, measured.T_wc[:, k, 3])
    return T_wc
