"""Detectors, readers and perturbations of other packages, found by their entry points.

docs/howto/plugins.md tells how to write one. The packages' metadata name them; a package is
imported when its plug-in is used, not before, and a broken one hurts nobody who does not use it.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import Distribution, EntryPoint, distributions
from typing import Any

from vslam.errors import InputError

DETECTORS = "vslam.detectors"
READERS = "vslam.readers"
PERTURBATIONS = "vslam.perturbations"
KINDS = {DETECTORS: "detector", READERS: "reader", PERTURBATIONS: "perturbation"}
# Commas, colons and plus signs separate names on the command line.
_NAME = re.compile(r"[A-Za-z0-9][\w.-]*")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PlugIn:
    """What a package offers under a name; nothing of it has been imported yet.

    Attributes:
        group: one of `KINDS`.
        name: as people type it.
        packages: all that offer it, each with its version; more than one is an error on use.
        entry_point: of the first of them.
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
        """Import what the entry point names and call it.

        Raises:
            InputError: it cannot be imported, is nothing that can be called, fails, or is offered
                by two packages.
        """
        if len(self.packages) > 1:
            raise InputError(f"{self}: two packages offer one name; uninstall one of them.")
        try:
            made = self.entry_point.load()
        except Exception as error:  # anything can go wrong in an import
            raise InputError(
                f"{self}: {self.entry_point.value} cannot be imported ({reason(error)}); repair "
                "or uninstall the package."
            ) from error
        if not callable(made):
            raise InputError(
                f"{self}: {self.entry_point.value} is no function and no class; repair or "
                "uninstall the package."
            )
        return self.guarded(made, *arguments, **named)

    def guarded(self, function: Callable[..., Any], *arguments: object, **named: object) -> Any:
        """Call a function of the package.

        Raises:
            InputError: it fails; an `InputError` of its own is passed on.
        """
        try:
            return function(*arguments, **named)
        except InputError:
            raise
        except Exception as error:  # a package of other people raises what it likes
            raise InputError(
                f"{self} failed ({reason(error)}); repair or uninstall the package."
            ) from error


def reason(error: Exception) -> str:
    """An exception in one line."""
    text = next(iter(str(error).splitlines()), "")
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def find_plugins(group: str) -> dict[str, PlugIn]:
    """The plug-ins of all installed packages by name, in alphabetical order.

    Args:
        group: one of `KINDS`.
    """
    found: dict[str, PlugIn] = {}
    for package, entry_point in _entry_points(group):
        name = entry_point.name
        if not _NAME.fullmatch(name):
            _log.warning("%s: its plug-in '%s' has a name that nobody can type", package, name)
            continue
        others = found[name].packages if name in found else ()
        if package not in others:
            first = found[name].entry_point if name in found else entry_point
            found[name] = PlugIn(group, name, (*others, package), first)
    return dict(sorted(found.items()))


def _entry_points(group: str) -> list[tuple[str, EntryPoint]]:
    """Package with its version, and entry point."""
    found = []
    for distribution in distributions():
        text = distribution.read_text("entry_points.txt")
        if text is None or f"[{group}]" not in text:
            continue
        package = _package(distribution)
        try:
            points = list(distribution.entry_points.select(group=group))
        except (TypeError, ValueError) as error:  # a line that is no "name = module:object"
            _log.warning("%s: its entry points cannot be read (%s)", package, reason(error))
            continue
        found += [(package, point) for point in points]
    return found


def _package(distribution: Distribution) -> str:
    return f"{distribution.metadata['Name']} {distribution.version}"
