"""A page of results: sections of text, tables and figures.

Every report of vslam is such a page; :mod:`vslam.report.render` writes it as Markdown, as HTML and
to a terminal. What a form cannot show is left out of it, and so is a section of which nothing is
left.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass

Row = tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """Rows of cells; a table without rows is not shown, nor is its note.

    Attributes:
        head: a heading for each column.
        rows: as many cells each.
        texts: the headings of the columns that hold words, which are aligned to the left.
        note: what the figures mean, below the table.
    """

    head: Row
    rows: Sequence[Row]
    texts: Row = ()
    note: str = ""


@dataclass(frozen=True)
class Pairs:
    """Names with their values."""

    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Tile:
    """One number of a summary; ``tone`` is ``good``, ``bad`` or empty."""

    label: str
    value: str
    note: str = ""
    tone: str = ""


@dataclass(frozen=True)
class Tiles:
    """The numbers that a reader should see first."""

    tiles: Sequence[Tile]

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        """Label, value and note of each."""
        return [(tile.label, tile.value, tile.note) for tile in self.tiles]


@dataclass(frozen=True)
class Bullets:
    """Sentences of a list."""

    sentences: Sequence[str]


@dataclass(frozen=True)
class Alert:
    """A warning: what happened, in bold letters, and what it means."""

    what: str
    meaning: str = ""


@dataclass(frozen=True)
class Code:
    """Text to be typed or copied as it is."""

    text: str


@dataclass(frozen=True)
class Figure:
    """A picture with a caption, a drawing or a photograph.

    Attributes:
        name: identifies it in its page.
        caption: what it shows.
        image: PNG or JPEG.
        svg: a drawing; it begins at its ``<svg`` tag and takes its neutral colours from CSS
            variables. Empty for a photograph.
        file: where ``image`` lies, relative to the page; Markdown shows no figure without one.
    """

    name: str
    caption: str
    image: bytes
    svg: str = ""
    file: str = ""

    @property
    def address(self) -> str:
        """The image as a ``data:`` address, for a page that loads nothing."""
        kind = "png" if self.image.startswith(b"\x89PNG") else "jpeg"
        return f"data:image/{kind};base64,{b64encode(self.image).decode()}"


@dataclass(frozen=True)
class Markup:
    """HTML, trusted as it is; no other form shows it."""

    html: str


Part = str | Table | Pairs | Tiles | Bullets | Alert | Code | Figure | Markup


@dataclass(frozen=True)
class Section:
    """Parts under a title; those of a section without a title stand by themselves.

    Attributes:
        title: the heading, or empty.
        parts: what is shown; a string is a paragraph.
        folded: closed in HTML until the reader opens it.
        wide: as wide as the page in HTML; others share their row.
    """

    title: str
    parts: Sequence[Part]
    folded: bool = False
    wide: bool = True


@dataclass(frozen=True)
class Page:
    """A whole report; ``about`` is shown below the title, in one line."""

    title: str
    about: Sequence[str]
    sections: Sequence[Section]


def number(value: float | None, form: str = "{}") -> str:
    """A number as a cell of a table; ``n/a`` for None."""
    return "n/a" if value is None else form.format(value)
