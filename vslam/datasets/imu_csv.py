"""Reads inertial samples from CSV files whose first line names the columns and their units.

EuRoC's ``imu0/data.csv`` is such a file. A unit may follow a name in brackets or after an underline
(``[deg/s]``, ``_dps``). Columns that are not needed are ignored.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.support.errors import InputError
from vslam.support.file_kinds import read_text
from vslam.types.geometry import Matrix
from vslam.types.imu import GRAVITY

IMU_FILE = "imu.csv"
"""The name of the file beside images."""

HEADER = "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
"""The names of the columns in a file of the user's own, for messages."""

_TIMES = {"time", "timestamp", "timestamps", "t", "stamp", "times"}
_TIME_UNITS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_TIME_UNITS |= {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
_GYRO = r"(?:w|gyro(?:scope)?|omega|ang(?:ular)?_?(?:vel(?:ocity)?|rate)|w_rs_s|g|gyr)"
_ACCEL = r"(?:a|acc|accel(?:eration|erometer)?|lin(?:ear)?_?acc(?:el(?:eration)?)?|a_rs_s|force)"
_DEGREE = float(np.pi / 180.0)
# Factors by unit, without blanks, brackets, underlines, points, stars and "^".
_GYRO_UNITS = dict.fromkeys(("rad/s", "rads-1", "rads", "radps", "radpersec"), 1.0)
_GYRO_UNITS |= dict.fromkeys(("deg/s", "dps", "degs-1", "degs", "degree/s", "°/s"), _DEGREE)
_ACCEL_UNITS = dict.fromkeys(("m/s2", "ms-2", "mps2", "m/s/s", "ms2", "m/s²"), 1.0)
_ACCEL_UNITS |= {"g": GRAVITY, "mg": 1e-3 * GRAVITY}
# A sample comes every 0.3 ms to 0.3 s. Units of time differ by 1000, so only one of them fits.
_SHORTEST_S, _LONGEST_S = 3e-4, 0.3
_GRAVITIES = (0.5, 2.0)  # median length of the specific force, relative to gravity
_FIX = f"name the columns in the first line, such as {HEADER}"


def read_imu_csv(path: Path) -> Matrix:
    """Read inertial samples from a CSV file.

    Times are in the unit that the header names or, without it, in the only one of s, ms, us and ns
    with which 3 to 3,300 samples come in a second. Rates are in rad/s and specific forces in m/s^2
    unless the header names deg/s or g.

    Returns:
        ``(N, 7)`` float64, as described in `vslam.types.imu`, in the order of the file.

    Raises:
        InputError: the file is missing or malformed, the names of the columns are missing or a unit
            is unknown, the times have no plausible unit, or the specific forces cannot be m/s^2.
    """
    try:
        lines = list(csv.reader(_text(path).splitlines(), skipinitialspace=True))
    except csv.Error as error:
        raise InputError(f"{path}: not a CSV file ({error}); {_FIX}.") from error
    lines = [line for line in lines if any(word.strip() for word in line)]
    if not lines:
        raise InputError(f"{path}: the file is empty; {_FIX}.")
    columns = _columns(path, lines[0])
    rows = _numbers(path, lines, [at for at, _ in columns])
    rows[:, 1:] *= [factor for _, factor in columns[1:]]
    rows[:, 0] = _seconds(path, rows[:, 0], columns[0][1])
    strength = float(np.median(np.linalg.norm(rows[:, 4:], axis=1))) / GRAVITY
    least, most = _GRAVITIES
    if not least < strength < most:
        unit = "g; write accel_x [g] and so on in the first line"
        other = "not m/s^2; name the unit in the first line, such as accel_x [g]"
        in_g = least < strength * GRAVITY < most
        raise InputError(
            f"{path}: the specific force is mostly {strength * GRAVITY:.3g} long, but gravity is "
            f"{GRAVITY} m/s^2; the numbers are {unit if in_g else other}."
        )
    return rows


def _text(path: Path) -> str:
    return read_text(path, "a CSV file of inertial samples")


def _columns(path: Path, head: list[str]) -> list[tuple[int, float]]:
    """Return the index of each of the seven columns, and the factor of its unit. That of the time
    is the number of units per second, or 0 if the header names no unit."""
    found: dict[str, tuple[int, float]] = {}
    named: dict[str, float] = {}  # an axis without a unit has that of the axis before it
    for at, text in enumerate(head):
        name, unit = _name_and_unit(text)
        stem, _, last = name.rpartition("_")
        if name in _TIMES or (stem in _TIMES and last in _TIME_UNITS):
            unit = unit or (last if stem in _TIMES else "")
            if unit and unit not in _TIME_UNITS:
                raise _unknown(path, text, "s, ms, us or ns")
            found.setdefault("time", (at, _TIME_UNITS.get(unit, 0.0)))
            continue
        for kind, pattern, units in (
            ("gyro", _GYRO, _GYRO_UNITS),
            ("accel", _ACCEL, _ACCEL_UNITS),
        ):
            match = re.fullmatch(rf"{pattern}[._]?([xyz])(?:[._](.+))?", name)
            if match is None:
                continue
            unit = unit or _plain(match[2] or "")
            if unit and unit not in units:
                known = "rad/s or deg/s" if kind == "gyro" else "m/s^2 or g"
                raise _unknown(path, text, known)
            if unit:
                named.setdefault(kind, units[unit])
            factor = units[unit] if unit else named.get(kind, 1.0)
            found.setdefault(f"{kind} {match[1]}", (at, factor))
    wanted = ["time", *(f"{kind} {axis}" for kind in ("gyro", "accel") for axis in "xyz")]
    missing = [name for name in wanted if name not in found]
    if missing:
        raise InputError(f"{path}: the first line names no column for {missing[0]}; {_FIX}.")
    return [found[name] for name in wanted]


def _name_and_unit(text: str) -> tuple[str, str]:
    text = text.strip().lower().lstrip("# ")
    name, bracket, unit = re.match(r"([^\[(]*)([\[(]?)(.*)", text).groups()  # type: ignore[union-attr]
    name = re.sub(r"[\s./-]+", "_", name.strip()).strip("_")
    return name, _plain(unit) if bracket else ""


def _plain(unit: str) -> str:
    return re.sub(r"[\s\]\[()_.*^]", "", unit)


def _unknown(path: Path, text: str, known: str) -> InputError:
    return InputError(f"{path}: the unit of the column {text.strip()} is unknown; use {known}.")


def _numbers(path: Path, lines: list[list[str]], at: list[int]) -> NDArray[np.float64]:
    rows = np.empty((len(lines) - 1, len(at)))
    for k, line in enumerate(lines[1:]):
        try:
            rows[k] = [float(line[column]) for column in at]
        except (ValueError, IndexError) as error:
            raise InputError(
                f"{path}: row {k + 2} does not have the numbers that the first line names; repair "
                "or remove it."
            ) from error
    if len(rows) < 2:
        raise InputError(f"{path}: {len(rows)} inertial samples are too few; record more.")
    return rows


def _seconds(path: Path, times: NDArray[np.float64], per_second: float) -> NDArray[np.float64]:
    steps = np.diff(times)
    step = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    fitting = [unit for unit in (1.0, 1e3, 1e6, 1e9) if _SHORTEST_S <= step / unit < _LONGEST_S]
    if per_second and per_second not in fitting:
        raise InputError(
            f"{path}: in the unit that the first line names, a sample comes every "
            f"{step / per_second:.3g} s, which no IMU does; correct the unit or the times."
        )
    if not fitting:
        raise InputError(
            f"{path}: the times are mostly {step:.3g} apart, which is no rate of an IMU in s, ms, "
            "us or ns; correct the times."
        )
    return times / fitting[0]
