"""Loop detectors, readers and perturbations that other packages provide as entry points.

docs/howto/plugins.md explains how to write a plug-in. A package is imported only when its plug-in
is used, so a broken package does not affect other runs.
"""

from __future__ import annotations

import importlib.metadata
import logging
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass
from importlib.metadata import Distribution, EntryPoint, distributions
from pathlib import Path
from traceback import walk_tb
from typing import Any

from vslam.support.errors import InputError

DETECTORS = "vslam.detectors"
READERS = "vslam.readers"
PERTURBATIONS = "vslam.perturbations"
COMMANDS = "vslam.commands"  # typer applications of the laboratory
TOWNS = "vslam.towns"  # the reader of rendered towns
KINDS = {DETECTORS: "detector", READERS: "reader", PERTURBATIONS: "perturbation"}
# Commas, colons and plus signs separate names on the command line.
_NAME = re.compile(r"[A-Za-z0-9][\w.-]*")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PlugIn:
    """A plug-in of an installed package, which has not been imported yet.

    Attributes:
        group: the group of entry points, which is one of `KINDS`.
        name: the name on the command line.
        packages: all packages that provide a plug-in of this name, with versions. If there are
            several, the plug-in cannot be used.
        entry_point: the entry point of the first package.
    """

    group: str
    name: str
    packages: tuple[str, ...]
    entry_point: EntryPoint

    def __str__(self) -> str:
        return (
            f"the {KINDS[self.group]} {self.name} of the package {' and of '.join(self.packages)}"
        )

    def call(self, *arguments: object, **named: object) -> Any:
        """Import the function or class that the entry point names, and call it.

        Raises:
            InputError: the entry point cannot be imported, is not callable or fails, or several
                packages provide a plug-in of this name.
        """
        if len(self.packages) > 1:
            raise InputError(f"{self}: several packages offer this name; uninstall all but one.")
        try:
            target = self.entry_point.load()
        except Exception as error:  # importing foreign code may raise anything
            raise InputError(
                f"{self}: {self.entry_point.value} cannot be imported ({reason(error)}); repair "
                "or uninstall the package."
            ) from error
        if not callable(target):
            raise InputError(
                f"{self}: {self.entry_point.value} is neither a function nor a class; repair or "
                "uninstall the package."
            )
        return self.guarded(target, *arguments, **named)

    def guarded(self, function: Callable[..., Any], *arguments: object, **named: object) -> Any:
        """Call a function of the package that provides the plug-in.

        Raises:
            InputError: the function failed. If the function itself raises an `InputError`, this
                error is passed on.
        """
        try:
            return function(*arguments, **named)
        except InputError:
            raise
        except Exception as error:  # foreign code may raise anything
            raise InputError(
                f"{self} failed ({reason(error)}{self._line(error)}); repair or uninstall the "
                "package."
            ) from error

    def _line(self, error: Exception) -> str:
        """Return the last line of the package's own code in the traceback of an error, if any."""
        package = self.entry_point.module.partition(".")[0]
        lines = [
            f"; {Path(frame.f_code.co_filename).name}, line {line}"
            for frame, line in walk_tb(error.__traceback__)
            if str(frame.f_globals.get("__name__")).partition(".")[0] == package
        ]
        return lines[-1] if lines else ""


def reason(error: Exception) -> str:
    """Describe an exception in one line."""
    text = next(iter(str(error).splitlines()), "")
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def find_plugins(group: str) -> dict[str, PlugIn]:
    """Find the plug-ins of all installed packages in one of the groups `KINDS`, sorted by name."""
    found: dict[str, PlugIn] = {}
    for package, entry_point in _entry_points(group):
        name = entry_point.name
        if not _NAME.fullmatch(name):
            _log.warning(
                "%s: its plug-in '%s' is ignored; a name may contain only letters, digits and ._-",
                package,
                name,
            )
            continue
        others = found[name].packages if name in found else ()
        if package not in others:
            first = found[name].entry_point if name in found else entry_point
            found[name] = PlugIn(group, name, (*others, package), first)
    return dict(sorted(found.items()))


def laboratory(group: str) -> dict[str, Any]:
    """Import what the laboratory (``vslam_lab``) provides in ``COMMANDS`` or ``TOWNS``, by name.

    The laboratory is part of the same distribution, and vslam never imports it otherwise.
    """
    points = importlib.metadata.distribution("vslam").entry_points.select(group=group)
    return {point.name: point.load() for point in points}


def packages_of(names: Collection[str]) -> dict[str, str]:
    """Return the package and version of each plug-in in ``names``. Other names are left out."""
    found = {name: plugin for group in KINDS for name, plugin in find_plugins(group).items()}
    return {name: " and ".join(found[name].packages) for name in names if name in found}


def _entry_points(group: str) -> list[tuple[str, EntryPoint]]:
    """Return all entry points of a group, each with the name and version of its package."""
    found = []
    for distribution in distributions():
        text = distribution.read_text("entry_points.txt")
        if text is None or f"[{group}]" not in text:
            continue
        package = _package(distribution)
        try:
            points = list(distribution.entry_points.select(group=group))
        except (TypeError, ValueError) as error:  # a line is not "name = module:object"
            _log.warning("%s: its entry points cannot be read (%s)", package, reason(error))
            continue
        found += [(package, point) for point in points]
    return found


def _package(distribution: Distribution) -> str:
    return f"{distribution.metadata['Name']} {distribution.version}"
