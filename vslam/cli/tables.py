"""Results in a terminal."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterable

from vslam.report.page import Pairs, Section


def show_sections(sections: Iterable[Section]) -> None:
    """Print sections of a report on stdout, without breaking lines where it is not a terminal."""
    from rich.console import Console

    from vslam.report.render import show

    show(sections, Console(width=None if sys.stdout.isatty() else 1000))


def print_rows(rows: Collection[tuple[str, str]]) -> None:
    """Print names and values, the values one below the other."""
    show_sections([Section("", [Pairs(tuple(rows))])])
