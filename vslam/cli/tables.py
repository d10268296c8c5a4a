"""Tables of reports in a terminal."""

from __future__ import annotations

import re
import shutil
import sys
import textwrap
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from vslam.report.page import Table


def show_tables(tables: Iterable[Table]) -> None:
    """Print tables on stdout, each with its title above, its note and its points below.

    Sentences are folded at the width of a terminal, lines of a table never: a number that is torn
    apart cannot be read.
    """
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else 1000
    for table in tables:
        typer.echo(f"\n{table.title}\n")
        for line in table_lines(table):
            typer.echo(line)
        typer.echo()
        for sentence in filter(None, (table.note, *(f"- {point}" for point in table.points))):
            indent = "  " if sentence.startswith("- ") else ""
            typer.echo(textwrap.fill(sentence, width, subsequent_indent=indent))


def table_lines(table: Table) -> Iterator[str]:
    """The lines of a table in columns; headings are broken at their commas and brackets."""
    broken = [re.split(r", | (?=\()", name) for name in table.head]
    height = max(map(len, broken))
    head = list(zip(*([""] * (height - len(lines)) + lines for lines in broken), strict=True))
    widths = [max(map(len, column)) for column in zip(*head, *table.rows, strict=True)]

    def line(cells: tuple[str, ...]) -> str:
        columns = zip(table.head, cells, widths, strict=True)
        return " ".join(
            cell.ljust(width) if name in table.texts else cell.rjust(width)
            for name, cell, width in columns
        ).rstrip()

    yield from map(line, head)
    yield "-" * (sum(widths) + len(widths) - 1)
    yield from map(line, table.rows)
