"""How the command line shows the fields of a model of options.

A field with an ``Option`` in its annotation is an option of every command that takes the model. It
is defined once: the command line, ``run.json`` and the commands of a benchmark are made from it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel

# Panels of --help.
INPUT, METHOD, MAP, OUTPUT, EXECUTION = "Input", "Method", "Map", "Output", "Execution"


@dataclass(frozen=True)
class Option:
    """An option of the command line.

    Attributes:
        panel: the panel of ``--help``.
        metavar: stands for the value in ``--help``. Empty for an option without a value.
        help: description. ``{choices}`` is replaced by the choices.
        name: the option, such as ``--map`` or ``--imu/--no-imu``. Empty if it is that of the field.
        unset: text that ``--help`` shows as the default. Empty shows the default of the field.
        min: smallest value; None if any value is allowed.
        choices: function that returns the names among which the user chooses; None if there are
            none.
        given_as: type of the value on the command line, if it is not that of the field. The command
            converts it. The default is then None.
    """

    panel: str
    metavar: str
    help: str
    name: str = ""
    unset: str = ""
    min: int | None = None
    choices: Callable[[], tuple[str, ...]] | None = None
    given_as: Any = None


def options_of(model: type[BaseModel]) -> Iterator[tuple[str, Option]]:
    """Return the names and options of all fields of a model that the command line shows."""
    for name, field in model.model_fields.items():
        for one in field.metadata:
            if isinstance(one, Option):
                yield name, one


def words_of(given: BaseModel, without: tuple[str, ...] = ()) -> list[str]:
    """Return the words of the command line that give these options. Options with their default
    values are left out."""
    words: list[str] = []
    for name, option in options_of(type(given)):
        value = getattr(given, name)
        if name in without or value == type(given).model_fields[name].default:
            continue
        yes, _, no = (option.name or f"--{name.replace('_', '-')}").partition("/")
        if not option.metavar:
            words.append(yes if value else no)
            continue
        for one in value if isinstance(value, tuple) else (value,):
            words += [yes, str(one)]
    return words


def with_paths(given: BaseModel, convert: Callable[[Path], Path]) -> dict[str, Any]:
    """Return the fields that contain paths, with converted paths, such as absolute ones."""
    found: dict[str, Any] = {}
    for name in type(given).model_fields:
        value = getattr(given, name)
        if isinstance(value, Path):
            found[name] = convert(value)
        elif isinstance(value, tuple) and value and all(isinstance(one, Path) for one in value):
            found[name] = tuple(map(convert, value))
    return found
