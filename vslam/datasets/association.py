"""Associates images and poses by their times."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.times import UNITS
from vslam.support.errors import InputError
from vslam.types.trajectory import Trajectory, could_be_seconds, read_trajectory, trajectory_format

DEPTH_NEAR_S = 0.02
"""Upper limit of the seconds between an image and its depth, as in TUM's associate.py."""

MAX_TIME_DIFFERENCE_S = 0.01
"""Upper limit of the seconds between a frame and a pose of the ground truth that is used for it
without interpolation, as in evo."""

# Times in seconds since 1970 that are closer than this are equal but for rounding.
_SAME_TIME_S = 1e-6
# Longest gap in the ground truth across which poses are interpolated. Ground truth comes at 100 Hz
# (TUM), 200 Hz (EuRoC) or 10 Hz (vehicles). At an acceleration of 2 m/s^2, linear interpolation is
# off by 6 mm in the middle of this gap.
_MAX_GAP_S = 0.15
# Shares of images without a partner. Above the first share, a warning is shown. Above the second
# share, `Pairing.is_poor` is true. In TUM's sequences, up to 7 % of the images have no partner.
_FEW, _MANY = 0.01, 0.1
# For the clocks of two cameras, in steps from frame to frame: largest difference between the times
# of a pair, and largest difference that needs no further evidence. The nearest wrong partner of a
# frame is at least twice as far away.
_SAME_FRAME = 0.3
_EXACT = 0.02
_FIRST = 40  # number of frames at the start from which offsets between the clocks are tried
# The offset between two clocks is clear if all others leave differences that are this many times as
# large. Offsets count if they pair at least this share of the frames.
_CLEAR, _SHARE = 5.0, 0.8
_CLOCKS_DIFFER_S = 0.005  # smallest difference between the clocks that is reported
_ROUNDING = 1e-4  # differences that come from rounded times, in steps


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


@dataclass(frozen=True)
class ClockPairs:
    """Pairs of frames of two cameras.

    Attributes:
        first, second: ``(P,)`` int64 increasing indices of the frames of each pair.
        offset: constant by which the times of the second camera are later.
        within: upper limit of the remaining difference between the times of a pair, in the same
            unit. It is 0 if the frames were not paired by numbers or times.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    offset: float = 0.0
    within: float = 0.0


def pair_clocks(
    first: NDArray[np.float64], second: NDArray[np.float64], most: float = np.inf
) -> ClockPairs | None:
    """Pair the frames of two cameras by their times or frame numbers.

    The clocks of the cameras may differ by a constant. After this constant has been subtracted, the
    frames of a pair differ by less than 0.3 steps from frame to frame. A frame without a partner is
    therefore never paired with a neighbour of its partner.

    The constant is the median difference between frames that are nearest to each other if this is
    less than 0.3 steps and no other constant fits much better. Otherwise, it is the constant that
    fits much better than all others.

    Args:
        first: ``(N,)`` increasing times in any unit, with N at least 1.
        second: ``(M,)`` increasing times in the same unit, with M at least 1.
        most: upper limit of the remaining difference between the times of a pair.

    Returns:
        None if the times do not tell which frames belong together.
    """
    steps = [float(np.median(np.diff(times))) for times in (first, second) if len(times) > 1]
    step = min(steps, default=np.inf)
    within = min(_SAME_FRAME * step, most)
    apart = _to_nearest(first, second)
    apart = apart[np.abs(apart) < 0.5 * step]
    near = float(np.median(apart)) if len(apart) else np.inf
    offset = near if abs(near) < _SAME_FRAME * step else None
    if offset is None or _fit(first, second, offset, within)[2] > _EXACT * step:
        clear = _clear_offset(first, second, step, within)
        offset = offset if clear is None else clear
    if offset is not None:
        pairs = associate(first + offset, second, within)
        return ClockPairs(*pairs, offset, within) if len(pairs[0]) else None
    return None


def _to_nearest(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ``(N,)`` differences from each time to the nearest time of the other list."""
    after = np.searchsorted(second, first)
    later = second[after.clip(max=len(second) - 1)] - first
    earlier = second[(after - 1).clip(0)] - first
    return np.where(np.abs(earlier) < np.abs(later), earlier, later)


def _fit(
    first: NDArray[np.float64], second: NDArray[np.float64], offset: float, within: float
) -> tuple[int, float, float]:
    """Improve an offset between two clocks by the median of the differences that remain.

    Returns:
        The number of frames with a partner, the offset, and the 90th percentile of the differences
        that remain.
    """
    apart = _to_nearest(first + offset, second)
    apart = apart[np.abs(apart) < within]
    if not len(apart):
        return 0, offset, np.inf
    middle = float(np.median(apart))
    return len(apart), offset + middle, float(np.percentile(np.abs(apart - middle), 90))


def _clear_offset(
    first: NDArray[np.float64], second: NDArray[np.float64], step: float, within: float
) -> float | None:
    """Find the offset between two clocks that fits much better than all others; None without it."""
    tried = (second[:_FIRST, None] - first[None, :_FIRST]).ravel()
    cells = np.unique(np.rint(tried / within), return_index=True)[1]
    fits = [_fit(first, second, float(tried[k]), within) for k in cells]
    most = max(n for n, _, _ in fits)
    fits = [fit for fit in fits if fit[0] >= max(2, _SHARE * most)]
    if not fits:
        return None
    _, offset, spread = min(fits, key=lambda fit: fit[2])
    others = [fit[2] for fit in fits if abs(fit[1] - offset) > 0.5 * step]
    least = _CLEAR * max(spread, _ROUNDING * step)
    return offset if all(other > least for other in others) else None


@dataclass
class Pairing:
    """Counts how many images a reader pairs by time, and how many images it leaves out.

    A stream is counted while it is read. The warnings are shown in the summary and in the report of
    a run, and by ``vslam doctor`` and ``vslam calibrate``.

    Attributes:
        source: file or folder of the images, for messages.
        partner: what the second image of a pair is called in messages, such as ``depth image``.
        within_s: largest difference in seconds between the two times of a pair. 0 if the images are
            paired by the numbers or times in their names.
        fix: what the user can do if images are left out.
        n_pairs: number of pairs.
        left_out: times in seconds of the images without a partner.
        seconds: times in seconds of all possible partners, whether they are paired or not.
        n_alone: number of partners that are left out because they have no image. Partners that are
            expected to be more frequent than images are not counted.
        late_s: constant in seconds by which the clock of the partners is late. It has been
            subtracted before the images were paired.
    """

    source: Path
    partner: str
    within_s: float
    fix: str
    n_pairs: int = 0
    left_out: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    n_alone: int = 0
    late_s: float = 0.0

    @property
    def measured(self) -> str:
        """Text that says how many images are left out, and why."""
        said = self._images_left_out()
        if self.n_alone:
            all_partners = self.n_alone + self.n_pairs
            said += f"; of the {self.partner}s, {self.n_alone} of {all_partners} are left out"
        return said

    def _images_left_out(self) -> str:
        n = len(self.left_out)
        said = f"{n} of {n + self.n_pairs} images are left out"
        if not n:
            return said
        if not self.within_s:
            return f"{said} because no {self.partner} has the same number or time in its name"
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
        """Return warnings if more than a hundredth of the images are left out, or if the clocks of
        the two cameras differ."""
        said = []
        n = max(len(self.left_out), self.n_alone)
        if n > _FEW * (n + self.n_pairs):
            said.append(f"{self.source}: {self.measured}; {self.fix}.")
        if abs(self.late_s) > _CLOCKS_DIFFER_S:
            side = "later" if self.late_s > 0 else "earlier"
            said.append(
                f"{self.source}: the times of the {self.partner}s are {abs(self.late_s):.3g} s "
                f"{side} than those of their images, which were paired as if only the clocks "
                "differed; use one clock for both cameras."
            )
        return said

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

    def add_pair(self) -> None:
        """Count a pair of a stream."""
        self.n_pairs += 1

    def count_names(self, pairs: ClockPairs, n_images: int, n_partners: int) -> None:
        """Count images that were paired by their names. The index of an image replaces its time."""
        self.n_pairs = len(pairs.first)
        self.left_out = np.delete(np.arange(float(n_images)), pairs.first).tolist()
        self.n_alone = n_partners - self.n_pairs

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
    truth: Trajectory, times: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the poses of a ground truth at given times.

    This is the only rule by which frames get a ground truth, in a run and in ``vslam eval``:

    - A frame that has the time of a pose has this pose.
    - A frame between two poses that are at most 0.15 s apart has an interpolated pose. Positions
      are interpolated linearly, and rotations by slerp.
    - Any other frame has the pose that is nearest in time, if they are less than 10 ms apart and no
      other frame is nearer to the pose.

    Args:
        times: ``(N,)`` increasing seconds.

    Returns:
        ``(N, 4, 4)`` float64 ``T_wc``, NaN for times without ground truth, and an ``(N,)`` mask of
        the interpolated poses.
    """
    from scipy.spatial.transform import Rotation, Slerp

    frames, poses, between = _match(truth.timestamps, times)
    T_wc = np.full((len(times), 4, 4), np.nan)
    T_wc[frames] = truth.T_wc[poses]
    if between.any():
        known, turns = truth.timestamps, Rotation.from_matrix(truth.T_wc[:, :3, :3])
        T_wc[between] = np.eye(4)
        T_wc[between, :3, :3] = Slerp(known, turns)(times[between]).as_matrix()
        for k in range(3):
            T_wc[between, k, 3] = np.interp(times[between], known, truth.T_wc[:, k, 3])
    return T_wc, between


def _match(
    known: NDArray[np.float64], times: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return indices of frames and of the poses that they have, and an ``(N,)`` mask of the frames
    that have an interpolated pose."""
    frames, poses = associate(times, known, MAX_TIME_DIFFERENCE_S)
    between = np.zeros(len(times), np.bool_)
    if len(known) > 1:
        after = np.clip(np.searchsorted(known, times), 1, len(known) - 1)
        near = known[after] - known[after - 1] <= _MAX_GAP_S
        between = near & (times >= known[0]) & (times <= known[-1])
    between[frames[abs(times[frames] - known[poses]) < _SAME_TIME_S]] = False
    kept = ~between[frames]
    return frames[kept], poses[kept], between


def read_ground_truth(
    path: Path, times: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Read the ground truth of the frames of a data set, in the format of TUM or EuRoC, if any.

    Args:
        times: ``(N,)`` increasing times of the frames in seconds.

    Returns:
        The ``(N, 4, 4)`` poses of `poses_at`, or None if the file does not exist or no frame has a
        pose. Then warnings: that no frame has a pose, or that the times of the file are read in
        another unit.

    Raises:
        InputError: the file is malformed, or its poses have no times.
    """
    if not path.is_file():
        return None, ()
    instead = "or remove the file to run without ground truth"
    try:
        if trajectory_format(path) == "kitti":
            raise InputError(f"{path}: the poses have no times; write t x y z qx qy qz qw.")
        truth = read_trajectory(path)
    except InputError as error:
        raise InputError(f"{str(error).rstrip('.')}, {instead}.") from error
    of_truth, of_frames = common_units(truth.timestamps, times)
    warnings: tuple[str, ...] = ()
    if of_frames == 1.0 != of_truth:
        truth = Trajectory(of_truth * truth.timestamps, truth.T_wc)
        warnings = (f"{path}: {said_of_unit('the ground truth', of_truth, 'the frames')}.",)
    T_wc, _ = poses_at(truth, times)
    if np.isfinite(T_wc).any():
        return T_wc, warnings
    apart = said_of_clocks("the times of the frames", times, "those of the poses", truth.timestamps)
    return None, (f"{path}: the ground truth covers none of the frames: {apart}.",)


_UNITS_S = {1.0 / per_second: name for name, per_second in UNITS.items()}


def common_units(first: NDArray[np.float64], second: NDArray[np.float64]) -> tuple[float, float]:
    """Judge the units of two lists of times by whether the times then belong together.

    Args:
        first: ``(N,)`` increasing times.
        second: ``(M,)`` increasing times of the same clock, perhaps in another unit.

    Returns:
        The units of both in seconds. They are 1 unless the times belong together only in other
        units: at least half of the times of the shorter list then have a partner in the other list,
        but hardly any if all times are read as seconds.
    """

    def partners(unit: float, other: float) -> int:
        frames, _, between = _match(other * second, unit * first)
        return len(frames) + int(between.sum())

    as_given = partners(1.0, 1.0)
    shorter = min(len(first), len(second))
    if 2 * as_given >= shorter:
        return 1.0, 1.0
    one, other = ([u for u in _UNITS_S if could_be_seconds(u * times)] for times in (first, second))
    # Equally good units differ by a common factor. Seconds are then most likely, or else the
    # smallest unit.
    pairs = sorted(product(one, other), key=lambda units: (sum(u < 1.0 for u in units), units))
    others = [(partners(*units), units) for units in pairs]
    most, units = max(others, key=lambda found: found[0], default=(0, (1.0, 1.0)))
    if 2 * most < shorter or as_given > max(1, most // 10):
        return 1.0, 1.0
    return units


def said_of_unit(what: str, unit: float, other: str) -> str:
    """Say that the times of one trajectory are read in another unit than seconds."""
    return (
        f"the times of {what} are read as {_UNITS_S[unit]}, because only then do they agree with "
        f"those of {other}"
    )


def said_of_clocks(
    what: str, times: NDArray[np.float64], other: str, known: NDArray[np.float64]
) -> str:
    """Say how two lists of times without partners differ, and what to do about it."""
    spans = [f"from {t[0]:.3f} to {t[-1]:.3f} s" for t in (times, known)]
    said = f"{what} are {spans[0]} and {other} {spans[1]}; give both the times of one clock"
    if times[0] <= known[-1] and known[0] <= times[-1]:
        return said
    later = times[0] - known[0]
    return f"{said}, for example add {later:.3f} s to {other} if both begin together"
