"""YAML of calibration files, as everybody writes it: numbers out of it, or one sentence.

OpenCV's dialect is understood, too: the header ``%YAML:1.0``, ``!!opencv-matrix``, and brackets
straight behind a colon. Scalars are read as text and turned into what is asked for, because YAML
1.1 takes ``1e-05`` for text and OpenCV takes it for a number.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vslam.calibration.models import Array
from vslam.errors import InputError

_HEADER = re.compile(r"\A\ufeff?%YAML[: ]1\.\d.*\n?")
# A list of aliases of lists of aliases, and so on, is a few lines of text and gigabytes of numbers.
_ALIAS = re.compile(r"(?:^|[\s\[{,:])\*\w")
_NO_SPACE = re.compile(r"^(\s*[\w.]+):(?=\[)", re.MULTILINE)


@dataclass(frozen=True)
class Document:
    """A mapping of a file.

    Attributes:
        source: file, and section in it, for messages.
        values: text, lists and mappings by key.
    """

    source: str
    values: Mapping[str, object]

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def section(self, key: str) -> Document:
        """The mapping below a key."""
        values = self._value(key)
        if not isinstance(values, Mapping):
            raise InputError(f"{self.source}: {key} must be a section with keys of its own.")
        return Document(f"{self.source}: {key}", values)

    def text(self, key: str) -> str:
        """The word at a key."""
        value = self._value(key)
        if not isinstance(value, str):
            raise InputError(f"{self.source}: {key} must be one word.")
        return value

    def number(self, key: str) -> float:
        """The number at a key."""
        return self._numbers(key, "one number", 1)[0]

    def numbers(self, key: str, *counts: int) -> tuple[float, ...]:
        """Numbers at a key, flat, of one of these counts; of any without."""
        wanted = " or ".join(map(str, counts))
        return self._numbers(key, f"{wanted} numbers" if counts else "numbers", *counts)

    def matrix(self, key: str, rows: int, columns: int) -> Array:
        """A matrix at a key, written row by row in whatever brackets."""
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
            found = tuple(float(text) for text in _flat(value))
        except ValueError:
            found = ()
            counts = counts or (-1,)
        if (counts and len(found) not in counts) or not np.isfinite(found).all():
            raise InputError(f"{self.source}: {key} must be {wanted}, all finite.")
        return found


def read_document(path: Path) -> Document:
    """Read a YAML file whose top is a mapping.

    Raises:
        InputError: missing, unreadable or no YAML.
    """
    import yaml

    try:
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: the calibration is missing or no text; name another.") from error
    text = _NO_SPACE.sub(r"\1: ", _HEADER.sub("", text))
    if _ALIAS.search(text):
        raise InputError(f"{path}: the calibration has an alias of YAML (*NAME); write it out.")
    try:
        values = yaml.load(text, yaml.BaseLoader)
    except (yaml.YAMLError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f" at line {mark.line + 1}" if mark else ""
        raise InputError(f"{path}: the calibration is no YAML{line}; repair it.") from error
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise InputError(f"{path}: the calibration must be a list of keys with values, in YAML.")
    return Document(str(path), values)


def _flat(value: object) -> list[str]:
    if isinstance(value, list):
        return [text for item in value for text in _flat(item)]
    return [str(value)] if isinstance(value, str) else ["no number"]
