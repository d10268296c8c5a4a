"""Renders pages as Markdown, as HTML and in a terminal, and writes files."""

from __future__ import annotations

import csv
import io
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from vslam.report.page import (
    Alert,
    Bullets,
    Code,
    Figure,
    Markup,
    Page,
    Pairs,
    Part,
    Row,
    Section,
    Table,
    Tiles,
)
from vslam.support.errors import write_file

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table as RichTable

_PHONE, _PAD = 48, 2  # width of a phone and the space between two columns, in characters


def write_files(
    folder: Path, files: Mapping[str, str | bytes], fix: str = "give another folder"
) -> None:
    """Write files into a folder, which is created if it does not exist.

    Args:
        files: text or bytes by file name, in the order in which they are written.
        fix: advice to the user, which is added to the error message.
    """
    for name, content in files.items():
        write_file(folder / name, content, fix)


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Format rows as comma-separated values. None becomes an empty field."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def markdown(page: Page) -> str:
    """Format a page as Markdown. Its tables are aligned, so that they can also be read in a
    terminal."""
    blocks = [f"# {page.title}", " · ".join(filter(None, page.about))]
    for section in page.sections:
        if parts := [text for part in section.parts if (text := _markdown_part(part))]:
            blocks += [f"## {section.title}"] if section.title else []
            blocks += parts
    return "\n\n".join(filter(None, blocks)) + "\n"


def markdown_table(head: Row, rows: Iterable[Row]) -> list[str]:
    """Return the lines of a Markdown table with aligned columns."""
    rows = [tuple(cell.replace("|", "\\|").replace("\n", " ") for cell in row) for row in rows]
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    rule = tuple("-" * max(width, 3) for width in widths)
    return [
        "| " + " | ".join(cell.ljust(max(w, 3)) for cell, w in zip(row, widths, strict=True)) + " |"
        for row in (head, rule, *rows)
    ]


def _markdown_part(part: Part) -> str:
    match part:
        case Table(rows=[_, *_]):
            lines = markdown_table(part.head, part.rows)
            return "\n".join([*lines, *(["", part.note] if part.note else [])])
        case Pairs(rows=[first, *_]) | Tiles(rows=[first, *_]):
            return "\n".join(markdown_table(("",) * len(first), part.rows))
        case Bullets():
            return "\n".join(f"- {sentence}" for sentence in part.sentences)
        case Alert():
            return " ".join(filter(None, (part.what and f"**{part.what}**", part.meaning)))
        case Code():
            return textwrap.indent(part.text, "    ")
        case Figure(file=str(file)) if file:
            return f"![{part.name}]({file})\n\n{part.caption}"
        case str():
            return part
    return ""


def page_files(page: Page, stem: str) -> dict[str, str]:
    """Format a page as Markdown and as HTML, by file name."""
    return {f"{stem}.md": markdown(page), f"{stem}.html": html(page)}


def html(page: Page) -> str:
    """Format a page as self-contained HTML, which loads no other files."""
    return fill_template("page.html.jinja", page=page)


def fill_template(template: str, **values: object) -> str:
    """Insert values into an HTML template of this package. Text in the values is escaped."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("vslam.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["kind"] = lambda part: type(part).__name__
    environment.filters["heading_lines"] = _heading_lines
    environment.tests["shown"] = _is_shown
    environment.tests["wide"] = _is_wide
    return environment.get_template(template).render(**values)


def _heading_lines(name: str) -> list[str]:
    """Break a column heading into lines at commas and brackets."""
    return re.split(r", | (?=\()", name)


def _is_shown(part: Part) -> bool:
    match part:
        case Table() | Pairs():
            return bool(part.rows)
        case Bullets():
            return bool(part.sentences)
    return part != ""


def _is_wide(table: Table) -> bool:
    """Return whether a table is too wide for a phone. Headings and text may be broken at spaces."""
    columns = zip(table.head, zip(*table.rows, strict=True), strict=True)
    width = 0
    for name, cells in columns:
        unbroken = " ".join(cells).split() if name in table.texts else cells
        width += max(map(len, (*name.split(), *unbroken)), default=0) + _PAD
    return width > _PHONE


def show(sections: Iterable[Section], console: Console) -> None:
    """Print sections of a page to a terminal.

    Sentences are wrapped at the width of the console. Tables and values are not wrapped, because a
    wrapped number cannot be read, and a wrapped command cannot be copied.
    """

    def say(text: str, *, style: str = "", indent: str = "") -> None:
        text = textwrap.fill(text, console.width, subsequent_indent=indent)
        console.out(text, style=style, highlight=False)

    def is_printed(part: Part) -> bool:
        return _is_shown(part) and not isinstance(part, Code | Figure | Markup)

    shown = [(one.title, list(filter(is_printed, one.parts))) for one in sections]
    for k, (title, parts) in enumerate(one for one in shown if one[1]):
        if k:
            console.out()
        if title:
            console.out(f"{title}\n", style="bold", highlight=False)
        for part in parts:
            match part:
                case Table():
                    wide = rich_table(part, gap=2)
                    fits = (wide.width or 0) <= console.width
                    console.print(wide if fits else rich_table(part, gap=1), crop=False)
                    console.out()
                    if part.note:
                        say(part.note)
                case Pairs() | Tiles():
                    for line in _aligned_lines(part.rows):
                        console.out(line, highlight=False)
                case Bullets():
                    for sentence in part.sentences:
                        say(f"- {sentence}", indent="  ")
                case Alert():
                    say(" ".join(filter(None, (part.what, part.meaning))), style="bold")
                case str():
                    say(part)


def _aligned_lines(rows: Sequence[Row]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def rich_table(table: Table, gap: int) -> RichTable:
    """Create a ``rich`` table in which no cell is cut off. Headings are broken at commas and
    brackets.

    Args:
        gap: number of spaces between two columns.
    """
    from rich import box
    from rich.table import Table as RichTable
    from rich.text import Text

    heads = [_heading_lines(name) for name in table.head]
    columns = zip(*table.rows, strict=True) if table.rows else [()] * len(heads)
    widths = [max(map(len, [*head, *cells])) for head, cells in zip(heads, columns, strict=True)]
    made = RichTable(
        box=box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
        padding=(0, 0, 0, gap - 1),
        # Without a width, rich would shrink the columns to fit the terminal.
        width=sum(widths) + gap * (len(widths) - 1),
    )
    for name, head in zip(table.head, heads, strict=True):
        justify: Literal["left", "right"] = "left" if name in table.texts else "right"
        made.add_column(Text("\n".join(head)), justify=justify, vertical="bottom", no_wrap=True)
    for row in table.rows:
        made.add_row(*map(Text, row))
    return made
