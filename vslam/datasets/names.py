"""Pairs the images of two folders by the numbers or times in their names."""

from __future__ import annotations

import re
from collections.abc import Sequence as Several
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.association import ClockPairs, pair_clocks

_TOKENS = re.compile(r"\d{3,}\.\d{3,}|\d+|\D+")  # the decimal numbers are times in seconds
_COMPARABLE = 4.0  # largest ratio of the steps of two lists of times or numbers
# Words that tell the side or the kind of an image
_ROLES = {
    "left": re.compile(r"(?<![a-z])(left|l)(?![a-z])|(cam|camera|image|img)[_-]?0"),
    "right": re.compile(r"(?<![a-z])(right|r)(?![a-z])|(cam|camera|image|img)[_-]?1"),
    "depth": re.compile(r"(?<![a-z])(depth|disp)"),
}
_NUMBERS = re.compile(r"(?i)((?:cam|camera|image|img)[_-]?[01](?!\d))|\d+")
_Key = tuple[int | float | str, ...]


def pair_names(
    first: Several[str],
    second: Several[str],
    times: tuple[Several[float], Several[float]] | None = None,
) -> ClockPairs | None:
    """Pair the names of two folders by their parts that vary from image to image.

    If this part is one number, it may be a time, and `pair_clocks` pairs the numbers. ``left_1``
    and ``right_0001`` form a pair, for example. Otherwise, the times are paired. Without times,
    names with equal parts form pairs. Names are paired in order only if both folders contain the
    same number of images, and if the numbers cannot be compared or increase by the same steps.

    Args:
        first, second: names without suffixes, in the order in which the images were taken.
        times: the times in seconds that the names contain; None if some names contain no time.

    Returns:
        None if the names do not tell which images belong together.
    """
    parts = _keys(first), _keys(second)
    keys = parts if all(parts) else ([(name,) for name in first], [(name,) for name in second])
    numbers = _relative(*map(_numbers, keys)) or (None if times is None else _relative(*times))
    if numbers is not None:
        return pair_clocks(*numbers) or _same_steps(*numbers)
    at = {key: k for k, key in enumerate(keys[1])}
    common = [(k, at[key]) for k, key in enumerate(keys[0]) if key in at]
    if not common and len(first) == len(second):
        common = [(k, k) for k in range(len(first))]
    pairs = np.array(common, np.int64).reshape(-1, 2)
    return ClockPairs(pairs[:, 0], pairs[:, 1]) if len(pairs) else None


def group_names(names: Several[str]) -> dict[str, list[str]]:
    """Group names by their text. Numbers do not count, except the number of a camera (0 or 1).

    Returns:
        The names of each group, by their text with # for each number.
    """
    groups: dict[str, list[str]] = {}
    for name in names:
        alone = len(re.findall(r"\d+", name)) < 2
        text = re.sub(r"\d+", "#", name) if alone else _NUMBERS.sub(lambda m: m[1] or "#", name)
        groups.setdefault(text, []).append(name)
    return groups


def role_of(name: str) -> str:
    """Tell from a name whether an image is ``left``, ``right`` or ``depth``. The result is empty if
    the name does not tell."""
    words = re.sub(r"([a-z])([A-Z])", r"\1_\2", name).lower()
    return next((role for role, word in _ROLES.items() if word.search(words)), "")


def sides_by_name(names: Several[str], sensor: str | None) -> tuple[list[list[str]], bool] | None:
    """Tell left from right images, or images from depth images, which are in one folder.

    Args:
        sensor: ``stereo``, ``rgbd`` or ``mono``; None for a pair of any kind. With ``mono``, only
            the names of the left images are returned.

    Returns:
        One or two lists of names, and whether the second list contains depth images. None if the
        names do not tell the images apart.
    """
    groups: dict[str, list[list[str]]] = {}
    for text, group in group_names(names).items():
        groups.setdefault(role_of(text), []).append(group)
    if len(groups) < 2 or any(len(of_role) > 1 for of_role in groups.values()):
        return None
    sides = {role: of_role[0] for role, of_role in groups.items()}
    depth = sides.pop("depth", None)
    if sides.keys() == {"left", "right"} and (sensor != "rgbd" or depth is None):
        found, is_depth = [sides["left"], sides["right"]], False
    elif depth is not None and len(sides) == 1:
        found, is_depth = [*sides.values(), depth], True
    else:
        return None
    if sensor == "mono":
        return found[:1], False
    return (found, is_depth) if sensor in (None, "rgbd" if is_depth else "stereo") else None


def _same_steps(first: NDArray[np.float64], second: NDArray[np.float64]) -> ClockPairs | None:
    """Pair two lists of numbers in order if they differ by a constant. Otherwise, return None."""
    if len(first) != len(second):
        return None
    offset = float(np.median(second - first))
    pairs = pair_clocks(first + offset, second)
    if pairs is None or len(pairs.first) < len(first):
        return None
    return replace(pairs, offset=offset + pairs.offset)


def _keys(names: Several[str]) -> list[_Key]:
    """Split names into numbers and other text, and keep only the parts that vary.

    The result is empty if the names differ in structure or if the keys would not be unique.
    """
    rows = [[_parsed(token) for token in _TOKENS.findall(name)] for name in names]
    if len({tuple(isinstance(part, str) for part in row) for row in rows}) > 1:
        return []
    columns = [column for column in zip(*rows, strict=True) if len(set(column)) > 1]
    keys = list(zip(*columns, strict=True))
    return keys if len(set(keys)) == len(names) else []


def _parsed(token: str) -> int | float | str:
    if token.isdecimal():
        return int(token)
    return float(token) if token[0].isdecimal() else token


def _numbers(keys: Several[_Key]) -> list[int | float]:
    """Return the numbers of which the keys consist. The list is empty if there are other keys."""
    numbers = [key[0] for key in keys if len(key) == 1 and not isinstance(key[0], str)]
    return numbers if len(numbers) == len(keys) else []


def _relative(
    first: Several[int | float], second: Several[int | float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Convert two lists of numbers to float64 numbers in one unit, relative to the first number.

    The units may differ by a power of 1000, such as seconds and nanoseconds.

    Returns:
        None if a list has fewer than two numbers, does not increase, or has a different step.
    """
    if min(len(first), len(second)) < 2:
        return None
    steps = [np.diff([n - side[0] for n in side]).astype(np.float64) for side in (first, second)]
    if any((step <= 0).any() for step in steps):
        return None
    ratio = float(np.median(steps[1]) / np.median(steps[0]))
    power = round(np.log10(ratio) / 3)
    if not 1.0 / _COMPARABLE < ratio / 1000.0**power < _COMPARABLE:
        return None
    a, b = ([n * 1000 ** max(0, k) for n in side] for side, k in ((first, power), (second, -power)))
    return np.array([n - a[0] for n in a], np.float64), np.array([n - a[0] for n in b], np.float64)
