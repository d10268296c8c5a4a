"""Building blocks of the pages that vslam writes: tables, and templates filled in."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

Row = tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """``texts``: the columns that hold words, aligned to the left; ``note`` goes below, and
    ``points``, sentences of a list, below that."""

    title: str
    head: Row
    rows: list[Row]
    texts: Row = ()
    note: str = ""
    folded: bool = False
    points: tuple[str, ...] = ()


def render_page(template: str, **values: object) -> str:
    """Fill in one of the templates of this package; all text is escaped."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("vslam.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)


def markdown_table(head: Row, rows: Iterable[Row]) -> list[str]:
    """Lines of a table whose columns are aligned in the text, too."""
    rows = [tuple(cell.replace("|", "\\|").replace("\n", " ") for cell in row) for row in rows]
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    rule = tuple("-" * max(width, 3) for width in widths)
    return [
        "| " + " | ".join(cell.ljust(max(w, 3)) for cell, w in zip(row, widths, strict=True)) + " |"
        for row in (head, rule, *rows)
    ]
