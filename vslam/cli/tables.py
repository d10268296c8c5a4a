"""Tables of reports in a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vslam.report.page import Table


def show_tables(tables: Iterable[Table]) -> None:
    """Print tables on stdout, each with its title above, its note and its points below.

    A comma in a heading breaks its line. A terminal folds what is too wide for it; a file or a
    pipe gets whole lines.
    """
    from rich import box, table
    from rich.console import Console
    from rich.markup import escape

    console = Console(highlight=False, width=None if sys.stdout.isatty() else 1000)
    for found in tables:
        console.print(f"\n[b]{escape(found.title)}[/b]\n")
        grid = table.Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
        for name in found.head:
            text = name in found.texts
            grid.add_column(
                escape(name.replace(", ", "\n")), justify="left" if text else "right",
                vertical="bottom", overflow="fold", header_style="",
            )  # fmt: skip
        for row in found.rows:
            grid.add_row(*map(escape, row))
        console.print(grid)
        for line in filter(None, (found.note, *(f"- {point}" for point in found.points))):
            console.print(escape(line))
