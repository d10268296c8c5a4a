"""Reads the YAML of calibration files, and gives typed access to its values.

OpenCV's dialect is accepted: the header ``%YAML:1.0``, ``!!opencv-matrix``, and brackets directly
after a colon. Scalars are read as text and converted on access. This is necessary because OpenCV
writes numbers such as ``1e-05``, which YAML 1.1 defines as text.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vslam.calibration.models import Array
from vslam.support.errors import InputError
from vslam.support.file_kinds import identify, read_text

_HEADER = re.compile(r"\A\ufeff?%YAML[: ]1\.\d.*\n?")
# A file of this size takes two seconds to parse. A calibration file has about 5,000 bytes.
_MOST_BYTES = 100_000
_MOST_STEPS = 10_000  # largest number of lists and numbers at one key
_NO_SPACE = re.compile(r"^(\s*[\w.]+):(?=\[)", re.MULTILINE)


@dataclass(frozen=True)
class Document:
    """A mapping in a YAML file. Its methods raise an `InputError` if a key is missing or has
    another type of value.

    Attributes:
        source: name of the file and of the section in it, for error messages.
        values: the values by key. A value is text, a list or a mapping.
    """

    source: str
    values: Mapping[str, object]

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def section(self, key: str) -> Document:
        """Return the mapping that is stored under a key."""
        values = self._value(key)
        if not isinstance(values, Mapping):
            raise InputError(f"{self.source}: {key} must be a section with keys of its own.")
        return Document(f"{self.source}: {key}", values)

    def text(self, key: str) -> str:
        """Return the scalar that is stored under a key, as text."""
        value = self._value(key)
        if not isinstance(value, str):
            raise InputError(f"{self.source}: {key} must be one word.")
        return value

    def number(self, key: str) -> float:
        return self._numbers(key, "one number", 1)[0]

    def integers(self, key: str, count: int) -> tuple[int, ...]:
        """Return the ``count`` integers that are stored under a key."""
        wanted = "one integer" if count == 1 else f"{count} integers"
        found = self._numbers(key, wanted, count)
        if any(number % 1 for number in found):
            raise InputError(f"{self.source}: {key} must be {wanted}.")
        return tuple(map(int, found))

    def numbers(self, key: str, *counts: int) -> tuple[float, ...]:
        """Return the numbers that are stored under a key, as a flat tuple. If ``counts`` are given,
        its length must be one of them."""
        wanted = " or ".join(map(str, counts))
        return self._numbers(key, f"{wanted} numbers" if counts else "numbers", *counts)

    def matrix(self, key: str, rows: int, columns: int) -> Array:
        """Return the ``(rows, columns)`` matrix that is stored under a key. The value may be a list
        of rows, or a flat list of the numbers row by row."""
        found = self._numbers(key, f"{rows}x{columns} numbers", rows * columns)
        return np.array(found).reshape(rows, columns)

    def _value(self, key: str) -> object:
        if key not in self.values:
            raise InputError(f"{self.source}: {key} is missing; add it.")
        return self.values[key]

    def _numbers(self, key: str, wanted: str, *counts: int) -> tuple[float, ...]:
        value = self._value(key)
        if isinstance(value, Mapping):  # OpenCV's, ROS's and EuRoC's matrices
            value = value.get("data", [])
        try:
            found = tuple(float(word) for text in _flat(value) for word in text.split())
        except ValueError:
            found = ()
            counts = counts or (-1,)
        if (counts and len(found) not in counts) or not np.isfinite(found).all():
            raise InputError(f"{self.source}: {key} must be {wanted}, all finite.")
        return found


def read_document(path: Path) -> Document:
    """Read a YAML file whose top level is a mapping.

    Raises:
        InputError: the file is missing, unreadable, too large or not YAML.
    """
    import yaml

    try:
        too_large = path.stat().st_size > _MOST_BYTES and identify(path) is None
    except FileNotFoundError as error:
        raise InputError(f"{path}: the calibration is missing; give another file.") from error
    except OSError as error:
        raise InputError(
            f"{path}: the calibration cannot be read ({error.strerror}); give another file."
        ) from error
    if too_large:
        raise InputError(
            f"{path}: is larger than {_MOST_BYTES // 1000} kB, so it is not a calibration; give "
            "another file."
        )
    text = read_text(path, "the YAML file with the parameters of the cameras")
    if not text.strip():
        raise InputError(f"{path}: the calibration is empty; give another file.")
    if text.lstrip("\ufeff \n").startswith("<?xml"):
        raise InputError(
            f"{path}: the calibration is XML, which is not supported; save it as YAML, which "
            "cv2.FileStorage writes to names that end in .yml."
        )
    text = _NO_SPACE.sub(r"\1: ", _HEADER.sub("", text))
    try:
        values = yaml.load(text, yaml.BaseLoader)
    except (yaml.YAMLError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f" at line {mark.line + 1}" if mark else ""
        raise InputError(f"{path}: the calibration is not valid YAML{line}; correct it.") from error
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise InputError(f"{path}: the calibration must be a list of keys with values, in YAML.")
    return Document(str(path), values)


def _flat(value: object) -> list[str]:
    """Flatten nested lists of text to a single list.

    Nested YAML aliases can expand a few lines into gigabytes, or form a cycle. Therefore, a list
    that has more items than any matrix is replaced with the text "no number", which the caller
    rejects.
    """
    found: list[str] = []
    waiting = [value]
    for _ in range(_MOST_STEPS):
        if not waiting:
            return found
        item = waiting.pop()
        if isinstance(item, list):
            waiting.extend(reversed(item))
        else:
            found.append(item if isinstance(item, str) else "no number")
    return ["no number"]
