"""Conditions stored beside measurements, so that a folder never mixes different ones."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vslam.errors import InputError


def keep_conditions(path: Path, given: Mapping[str, Any]) -> None:
    """Add conditions, ``{name: JSON value}``, to those stored in a file.

    Raises:
        InputError: the file has a different value for one of them.
    """
    known = json.loads(path.read_text()) if path.exists() else {}
    for name, value in given.items():
        if known.get(name, value) != value:
            raise InputError(
                f"{path.parent}: was made with {name} {known[name]}, not {value}; name another "
                "folder or remove this one."
            )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**known, **given}, indent=1) + "\n")


def digest(path: Path) -> str:
    """The first digits of the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]
