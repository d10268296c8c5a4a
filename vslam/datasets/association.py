"""Associates images and poses by their times."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.trajectory import Trajectory

_log = logging.getLogger(__name__)

DEPTH_NEAR_S = 0.02
"""Upper limit of the seconds between an image and its depth, as in TUM's associate.py."""

# Longest gap in the ground truth across which poses are interpolated. Ground truth comes at 100 Hz
# (TUM), 200 Hz (EuRoC) or 10 Hz (vehicles). At an acceleration of 2 m/s^2, linear interpolation is
# off by 6 mm in the middle of this gap.
_MAX_GAP_S = 0.15
# Shares of images without a partner. Above the first share, a warning is shown. Above the second
# share, `Pairing.is_poor` is true. In TUM's sequences, up to 7 % of the images have no partner.
_FEW, _MANY = 0.01, 0.1


def associate(
    first: NDArray[np.float64], second: NDArray[np.float64], max_difference: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pair the times of two lists. The two times of a pair differ by less than ``max_difference``.

    The closest pairs are formed first. Each time is used at most once, so that some times may have
    no partner.

    Args:
        first: ``(N,)`` increasing times in any unit.
        second: ``(M,)`` increasing times in the same unit.
        max_difference: upper limit in the same unit.

    Returns:
        ``(P,)`` increasing indices into ``first``, and ``(P,)`` indices of their partners in
        ``second``.
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


@dataclass
class Pairing:
    """Counts how many images a reader pairs by time, and how many images it leaves out.

    A stream is counted while it is read. The warnings are shown in the summary and in the report of
    a run, and by ``vslam doctor`` and ``vslam calibrate``.

    Attributes:
        source: file or folder of the images, for messages.
        partner: what the second image of a pair is called in messages, such as ``depth image``.
        within_s: largest difference in seconds between the two times of a pair.
        fix: what the user can do if images are left out.
        n_pairs: number of pairs.
        left_out: times in seconds of the images without a partner.
        seconds: times in seconds of all possible partners, whether they are paired or not.
    """

    source: Path
    partner: str
    within_s: float
    fix: str
    n_pairs: int = 0
    left_out: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    @property
    def measured(self) -> str:
        """Text that says how many images are left out, and why."""
        n = len(self.left_out)
        said = f"{n} of {n + self.n_pairs} images are left out"
        if not n:
            return said
        apart = self._seconds_to_nearest_partner()
        far = apart[apart > self.within_s]
        alone = f"because no {self.partner} is within {1e3 * self.within_s:g} ms of them"
        if len(far) and np.isfinite(far).all():
            alone += f" (the nearest is {1e3 * float(np.median(far)):.0f} ms away)"
        taken = f"because each {self.partner} is paired only once, with the image nearest in time"
        if len(far) == n:
            return f"{said} {alone}"
        if not len(far):
            return f"{said} {taken}"
        return f"{said}, {len(far)} {alone}, and {n - len(far)} {taken}"

    @property
    def is_poor(self) -> bool:
        """Whether more than a tenth of the images are left out, so that tracking suffers."""
        return len(self.left_out) > _MANY * (len(self.left_out) + self.n_pairs)

    def warnings(self) -> list[str]:
        """Return a warning if more than a hundredth of the images are left out."""
        if len(self.left_out) <= _FEW * (len(self.left_out) + self.n_pairs):
            return []
        return [f"{self.source}: {self.measured}; {self.fix}."]

    def count(
        self, times: NDArray[np.float64], paired: NDArray[np.int64], seconds: NDArray[np.float64]
    ) -> None:
        """Count all images of a stored sequence.

        Args:
            times: ``(N,)`` times of the images in seconds.
            paired: ``(P,)`` indices of the images that have a partner.
            seconds: ``(M,)`` times in seconds of the images that can be partners.
        """
        self.n_pairs = len(paired)
        self.left_out = np.delete(times, paired).tolist()
        self.seconds = seconds.tolist()

    def restart(self) -> None:
        """Reset all counts, before a stream is read again from its beginning."""
        self.n_pairs = 0
        self.left_out.clear()
        self.seconds.clear()

    def _seconds_to_nearest_partner(self) -> NDArray[np.float64]:
        """The time is infinite if there are no possible partners."""
        times = np.array(self.left_out)
        if not self.seconds:
            return np.full(len(times), np.inf)
        known = np.sort(self.seconds)
        after = np.searchsorted(known, times).clip(0, len(known) - 1)
        before = (after - 1).clip(0)
        return np.minimum(abs(known[after] - times), abs(times - known[before]))


def poses_at(
    source: Path, measured: Trajectory, times: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Interpolate the poses of the ground truth at given times.

    Positions are interpolated linearly, and rotations by slerp. If no time has a pose, a warning is
    logged.

    Args:
        source: name of the ground-truth file, for the log.
        times: ``(N,)`` seconds.

    Returns:
        ``(N, 4, 4)`` float64 ``T_wc``. A pose is NaN if its time is before the first measurement,
        after the last one, or in a gap longer than 0.15 s. None if no time has a pose.
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
