"""Turns the times in file names, lists and streams into seconds, and judges them.

A number is read in the unit that gives a frame rate that a camera can have. Numbers that count the
frames are not times. Frames whose times do not increase are left out and counted. If the clock of a
camera was set back, the times after that are continued.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable, Iterator
from collections.abc import Sequence as Several
from dataclasses import dataclass, field
from datetime import UTC, datetime
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from vslam.support.errors import InputError, counted
from vslam.support.file_kinds import read_text
from vslam.types.trajectory import read_table

Number = int | float | Decimal
Times = NDArray[np.float64]
_Content = TypeVar("_Content")

GAP = 1.75
"""A longer step, in intervals, means that a frame is missing."""

JITTER = 0.2
"""Largest standard deviation of the steps that is not reported, relative to the interval."""

UNITS = {"seconds": 1, "milliseconds": 10**3, "microseconds": 10**6, "nanoseconds": 10**9}
"""Number of each unit of time per second."""

FIX_LIST = "correct them, or open the folders of the images with --fps and --calib"
"""What the user can do if the times in the list of a data set are unusable."""

# Seconds between the frames of a camera. If times are in their usual unit, they may be longer.
_SHORTEST_S, _LONGEST_S, _LONGEST_USUAL_S = 0.0008, 5.0, 10.0
_TYPICAL_S = 0.07  # in the middle between the limits, on a logarithmic scale
# Seconds since 1970 in 2001 and in 2039. A number that is a date between them in one of the units
# has this unit even if the frames are up to an hour apart, as in a time lapse.
_FIRST_S, _LAST_S, _LONGEST_DATED_S = 1e9, 2.2e9, 3600.0
_LATEST_S = 4.1e9  # in the year 2099; no clock of a camera is later
# Integers in names that are smaller, with smaller steps, are the numbers of frames.
_NUMBERS, _NUMBER_STEP = 10**9, 10_000
_TOO_FEW = 2  # largest number of times that cannot prove their usual unit wrong

_RECENT = 31  # number of steps of which the median is the interval
# A step to a later time of this many intervals may be a wrong time of one frame. The next frame
# decides.
_FAR = 3.5
# The clock was set back if this many frames in a row are not later than the frame before them. At
# the end of a stream, fewer suffice. A frame that follows those frames by less than `GAP` intervals
# continues them, and is no older frame than they are.
_SET_BACK, _SET_BACK_AT_END, _SET_BACK_FOLLOWED = 10, 3, 2
_FEW = 3  # number of steps below which there is no interval to compare a step with
_MANY = 0.1  # share of a list that may be left out


@dataclass
class Timing:
    """Says how a reader understood the times of its frames, and counts the frames that it left out.

    A stream is counted while it is read. The warnings are shown in the summary and in the report of
    a run, and by ``vslam doctor``.

    Attributes:
        source: file or name of the images, for messages.
        remarks: sentences about decisions that are not obvious, such as the unit of the times.
        first: time in seconds of the first frame; None before it is read.
        left_out: for each frame that is left out, the time in seconds of the frame before it, and
            whether it has the same time as that frame.
        set_back: for each time at which the clock was set back, the time in seconds of the last
            frame before that, and by how many seconds.
    """

    source: str
    remarks: list[str] = field(default_factory=list)
    first: float | None = None
    left_out: list[tuple[float, bool]] = field(default_factory=list)
    set_back: list[tuple[float, float]] = field(default_factory=list)

    @property
    def measured(self) -> str:
        """Text about the frames that are left out, and about a clock that was set back."""
        parts = []
        first = self.first or 0.0
        if self.left_out:
            n, repeated = len(self.left_out), sum(same for _, same in self.left_out)
            kinds = {
                "the time of the frame before": repeated,
                "a wrong or earlier time": n - repeated,
            }
            why = " and ".join(f"{k} with {kind}" for kind, k in kinds.items() if k)
            after = f"the first after {self.left_out[0][0] - first:.3f} s"
            parts.append(f"{counted(n, 'frame')} left out ({why}), {after}")
        for at, by in self.set_back[:1]:
            n = len(self.set_back)
            parts.append(
                f"the clock was set back by {by:.3g} s after {at - first:.3f} s"
                + (f", and {counted(n - 1, 'more time')}" if n > 1 else "")
                + ": the times after that are continued at the median interval, and differ from "
                "the recorded times"
            )
        return "; ".join(parts)

    def warnings(self) -> list[str]:
        """Return the remarks, and a sentence if frames are left out or the clock was set back."""
        return [*self.remarks, *([f"{self.source}: {self.measured}."] if self.measured else [])]

    def add(self, second: Timing) -> None:
        """Add what was found in the list of the second images."""
        self.remarks.extend(second.remarks)
        self.set_back = self.set_back or second.set_back

    def restart(self) -> None:
        """Reset all counts, before a stream is read again from its beginning."""
        self.first = None
        self.left_out.clear()
        self.set_back.clear()


def in_order(
    frames: Iterable[tuple[float, _Content]], timing: Timing, per_second: int = 1
) -> Iterator[tuple[float, _Content]]:
    """Yield frames with increasing times. Frames that are repeated or out of order are left out.

    If the clock was set back, the times after that are continued at the median interval. If the
    iterator of the frames raises an exception, all frames before that are yielded first.

    Args:
        frames: the time and the content of each frame, in the order in which they were recorded.
            Integers stay integers.
        timing: counts the frames that are left out.
        per_second: number of units of the times per second.
    """
    timing.restart()
    order = _Order[_Content](timing, per_second)
    try:
        for stamp, content in frames:
            yield from order.add(stamp, content)
    except Exception:
        yield from order.finish()
        raise
    yield from order.finish()


class _Order(Generic[_Content]):
    """Holds back the frames whose times are doubtful until the frames after them have decided."""

    def __init__(self, timing: Timing, per_second: int) -> None:
        self._timing, self._per_second = timing, per_second
        self._last: float | None = None  # time of the last frame that was yielded
        self._shift: float = 0  # from a recorded time to the time of the frame
        self._steps: deque[float] = deque(maxlen=_RECENT)
        self._far: tuple[float, _Content] | None = None  # with its time
        self._early: list[tuple[float, _Content]] = []  # with their times

    def add(self, stamp: float, content: _Content) -> Iterator[tuple[float, _Content]]:
        time = stamp + self._shift
        if self._last is None:
            self._timing.first = time / self._per_second
            yield self._used(time, content)
            return
        if (far := self._far) is not None:
            self._far = None
            if self._last < time < far[0]:
                self._leave_out()
            else:
                yield self._used(*far)
        if time <= self._last:
            yield from self._add_early(time, content)
            return
        if self._early:
            many, gap = len(self._early) >= _SET_BACK_FOLLOWED, time - self._early[-1][0]
            if many and gap < GAP * self._interval(self._early):
                yield from self._set_back()
                time = stamp + self._shift
            else:
                self._leave_out_early()
        if len(self._steps) >= _FEW and time - self._last > _FAR * self._interval():
            self._far = time, content
        else:
            yield self._used(time, content)

    def finish(self) -> Iterator[tuple[float, _Content]]:
        if self._far is not None:
            yield self._used(*self._far)
        if len(self._early) >= _SET_BACK_AT_END:
            yield from self._set_back()
        self._leave_out_early()

    def _add_early(self, time: float, content: _Content) -> Iterator[tuple[float, _Content]]:
        newest = self._early[-1][0] if self._early else self._last
        if time == newest:
            self._leave_out(repeated=True)
            return
        if self._early and time < self._early[-1][0]:
            self._leave_out_early()
        self._early.append((time, content))
        if len(self._early) == _SET_BACK:
            yield from self._set_back()

    def _used(self, time: float, content: _Content) -> tuple[float, _Content]:
        if self._last is not None:
            self._steps.append(time - self._last)
        self._last = time
        return time, content

    def _set_back(self) -> Iterator[tuple[float, _Content]]:
        assert self._last is not None
        early, self._early = self._early, []
        by = self._last + self._interval(early) - early[0][0]
        self._timing.set_back.append((self._last / self._per_second, by / self._per_second))
        self._shift += by
        for time, content in early:
            yield self._used(time + by, content)

    def _leave_out_early(self) -> None:
        for _ in self._early:
            self._leave_out()
        self._early = []

    def _leave_out(self, *, repeated: bool = False) -> None:
        assert self._last is not None
        self._timing.left_out.append((self._last / self._per_second, repeated))

    def _interval(self, early: Several[tuple[float, _Content]] = ()) -> float:
        """Return the median of the last steps; without steps, of those of the early frames."""
        steps = self._steps or [b[0] - a[0] for a, b in pairwise(early)]
        return sorted(steps)[len(steps) // 2]  # an element, so that integers stay integers


def ordered_list(
    stamps: Several[float], timing: Timing, fix: str, per_second: int = 1
) -> tuple[list[float], NDArray[np.int64]]:
    """Put the times of a list in order, as `in_order` does.

    Args:
        fix: what the user can do if the list is unusable.

    Returns:
        The increasing times, and the ``(N,)`` indices of their frames in the list.

    Raises:
        InputError: more than a tenth of the frames would be left out.
    """
    kept = list(in_order(zip(stamps, range(len(stamps)), strict=True), timing, per_second))
    n = len(timing.left_out)
    if n > _MANY * len(stamps):
        number = 2 + next(k for k, (a, b) in enumerate(pairwise(stamps)) if b <= a)
        raise InputError(
            f"{timing.source}: {n} of {len(stamps)} times are not later than those before them "
            f"(time {number} is the first); {fix}."
        )
    return [time for time, _ in kept], np.array([k for _, k in kept], np.int64)


def jitter(timestamps: Times) -> float:
    """Return the standard deviation of the steps of ``(N,)`` times, relative to their median.

    Steps with missing frames are left out. The result is 0 for fewer than four times.
    """
    steps = np.diff(timestamps)
    if len(steps) < _FEW:
        return 0.0
    interval = float(np.median(steps))
    return float(np.std(steps[steps <= GAP * interval])) / interval


def jitter_warnings(timestamps: Times, source: str) -> list[str]:
    """Return a warning if ``(N,)`` increasing times in seconds look like times of arrival."""
    if (found := jitter(timestamps)) <= JITTER:
        return []
    shortest, longest = np.percentile(1e3 * np.diff(timestamps), (5, 95))
    return [
        f"{source}: the steps between the times vary by {100 * found:.0f} % ({shortest:.0f} to "
        f"{longest:.0f} ms), as if the frames were stamped when they arrived; stamp them when they "
        "are exposed."
    ]


def times_of_names(stems: Several[str], source: Path) -> tuple[Times, list[str]] | None:
    """Read file names as times.

    Args:
        stems: file names without suffix, in any order.
        source: folder of the files, for messages.

    Returns:
        ``(N,)`` float64 seconds, and remarks on their unit. None if a name is not a number, or if
        the numbers count the frames.

    Raises:
        InputError: no unit gives a frame rate that a camera can have.
    """
    numbers = [number_of(stem) for stem in stems]
    known = [number for number in numbers if number is not None]
    if not known or len(known) < len(numbers):
        return None
    whole = all(isinstance(number, int) for number in known)
    step = _interval(sorted(known))
    if whole and max(known) < _NUMBERS and (step is None or step < _NUMBER_STEP):
        return None
    usual = None if whole else "seconds"
    unit, remark = _unit_of(sorted(known), f"{source}: the names", usual, "give --fps")
    seconds = [
        (number if isinstance(number, int) else float(number)) / UNITS[unit] for number in known
    ]
    return np.array(seconds, np.float64), [f"{remark}; give --fps if this is wrong."] * bool(remark)


def times_of_list(path: Path, fix: str) -> tuple[list[float], Timing]:
    """Read a list with the time of one image per line, as a number or as a date.

    Args:
        fix: what the user can do if the numbers are no times.

    Returns:
        The times in seconds in the order of the list, and a `Timing` of the list.

    Raises:
        InputError: the file is missing, empty or malformed, or `unit_of_list` refuses the numbers.
    """
    times = read_times(path)
    unit, timing = unit_of_list(times.tolist(), path, "seconds", fix)
    return (times / UNITS[unit]).tolist(), timing


def read_times(path: Path) -> Times:
    """Read a list with one time per line: a number of seconds, or a date and time (ISO 8601).

    The first line may contain a heading.

    Returns:
        ``(N,)`` float64 seconds. Dates become seconds since 1970.

    Raises:
        InputError: the file is missing, empty or malformed.
    """
    times: list[float] = []
    for number, line in enumerate(read_text(path, "a list of times").splitlines(), start=1):
        if not line.strip() or line.startswith("#") or (not times and line.strip()[0].isalpha()):
            continue
        try:
            times.append(seconds_of_date(line.strip()))
        except ValueError as error:
            if not times:
                return read_table(path, (1,), "a time in seconds")[:, 0]
            raise InputError(
                f"{path}: line {number} is not a date and time, unlike the lines before it; "
                "correct it."
            ) from error
    return np.array(times) if times else read_table(path, (1,), "a time in seconds")[:, 0]


def seconds_of_date(text: str) -> float:
    """Convert a date and time of ISO 8601 to seconds since 1970, exact to a microsecond.

    Without a time zone, the time is taken for UTC. The date may be written with slashes.

    Raises:
        ValueError: the text is not a date with a time.
    """
    time = datetime.fromisoformat(text.replace("/", "-"))
    if ":" not in text:  # fromisoformat also accepts numbers such as 20110926
        raise ValueError(text)
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def unit_of_list(numbers: Several[Number], path: Path, usual: str, fix: str) -> tuple[str, Timing]:
    """Find the unit of the times in a list from the frame rate that follows from it.

    Args:
        numbers: the times in the order of the list.
        usual: unit that such times have, unless the frame rate proves it wrong.
        fix: what the user can do if the numbers are no times.

    Returns:
        One of `UNITS`, and a `Timing` with a remark if the unit is not the usual one.

    Raises:
        InputError: the numbers count the frames, or no unit gives a frame rate that a camera can
            have.
    """
    whole = all(number == int(number) for number in numbers) and max(numbers) < _NUMBERS
    by_one = sum(b - a == 1 for a, b in pairwise(numbers))  # type: ignore[operator]
    if len(numbers) > _TOO_FEW and whole and 2 * by_one > len(numbers) - 1:
        first = ", ".join(f"{int(number)}" for number in numbers[:3])
        raise InputError(
            f"{path}: {first}, ... look like the numbers of frames, not their times; {fix}."
        )
    unit, remark = _unit_of(numbers, f"{path}: the times", usual, fix)
    return unit, Timing(str(path), [f"{remark}."] * bool(remark))


def rate_text(interval_s: float) -> str:
    """Format the interval between frames in seconds as a frame rate, or as it is if it is long."""
    if interval_s > _LONGEST_S:
        return f"one frame every {interval_s:.3g} s"
    return f"{1.0 / interval_s:.{1 if interval_s < 1.0 else 2}f} Hz"


def is_frame_rate(interval_s: float) -> bool:
    """Return whether a camera can have an interval of so many seconds between its frames."""
    return _SHORTEST_S <= interval_s <= _LONGEST_S


def number_of(text: str) -> int | Decimal | None:
    """Read an unsigned integer or decimal number; None if the text is something else."""
    if text.isascii() and text.isdecimal():
        return int(text)
    return Decimal(text) if re.fullmatch(r"[0-9]+\.[0-9]+", text) else None


def _unit_of(numbers: Several[Number], what: str, usual: str | None, fix: str) -> tuple[str, str]:
    """Return one of `UNITS`, and a remark without full stop if this unit is not obvious."""
    interval, latest = _interval(numbers), float(max(numbers))
    dated = next((u for u, per in UNITS.items() if _FIRST_S <= latest / per < _LAST_S), None)
    if interval is None or (usual is not None and len(numbers) <= _TOO_FEW):
        return usual or dated or "nanoseconds", ""
    seconds = {unit: interval / per_second for unit, per_second in UNITS.items()}
    date_fits = dated is not None and is_frame_rate(seconds[dated])
    if usual and not date_fits and _SHORTEST_S <= seconds[usual] <= _LONGEST_USUAL_S:
        return usual, ""
    if dated and _SHORTEST_S <= seconds[dated] <= _LONGEST_DATED_S:
        obvious = usual in (None, dated) and seconds[dated] <= _LONGEST_USUAL_S
        rate = rate_text(seconds[dated])
        return dated, "" if obvious else f"{what} are read as {dated} since 1970: {rate}"
    possible = [u for u in UNITS if is_frame_rate(seconds[u]) and latest / UNITS[u] < _LATEST_S]
    if not possible:
        raise InputError(
            f"{what} increase in steps of {interval:g}, which gives no frame rate that a camera "
            f"can have, neither in seconds nor in ms, us or ns; {fix}."
        )
    unit = min(possible, key=lambda name: abs(np.log(seconds[name] / _TYPICAL_S)))
    instead = "" if usual is None else f", not {usual}"
    return unit, f"{what} are read as {unit}{instead}: {rate_text(seconds[unit])}"


def _interval(numbers: Several[Number]) -> float | None:
    """Return the median of the positive steps; None if there is none."""
    steps = [float(b - a) for a, b in pairwise(numbers) if b > a]  # type: ignore[operator]
    return float(np.median(steps)) if steps else None
