"""The content of a page of results: sections of text, tables and figures.

Every report of vslam is such a page. ``vslam.report.render`` writes a page as Markdown, as HTML and
to a terminal. Each format omits the parts that it cannot show, and sections without parts.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass

Row = tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """A table of a page. If a table has no rows, the table and its note are not shown.

    Attributes:
        head: a heading for each column.
        rows: the cells. Each row has a cell for each column.
        texts: the headings of the columns that contain text. Text is aligned to the left.
        note: explanation below the table.
        links: for each row, the address of a page to which HTML links the last cell; empty for no
            link. If there are no links, this is empty.
    """

    head: Row
    rows: Sequence[Row]
    texts: Row = ()
    note: str = ""
    links: Sequence[str] = ()


@dataclass(frozen=True)
class Pairs:
    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Tile:
    """One number of the summary of a page. ``tone`` is ``good`` (green), ``bad`` (red) or empty."""

    label: str
    value: str
    note: str = ""
    tone: str = ""


@dataclass(frozen=True)
class Tiles:
    """The most important numbers of a page, which readers should see first."""

    tiles: Sequence[Tile]

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        return [(tile.label, tile.value, tile.note) for tile in self.tiles]


@dataclass(frozen=True)
class Bullets:
    sentences: Sequence[str]


@dataclass(frozen=True)
class Alert:
    """A warning. It says what happened, in bold, and what this means."""

    what: str
    meaning: str = ""


@dataclass(frozen=True)
class Code:
    """Text that the reader types or copies literally."""

    text: str


@dataclass(frozen=True)
class Figure:
    """A drawing or photograph with a caption.

    Attributes:
        name: identifier, unique in the page.
        caption: description of the figure.
        image: PNG or JPEG.
        svg: the drawing as an ``<svg>`` element whose neutral colours are CSS variables. It is
            empty for a photograph.
        file: path of ``image`` relative to the page. Markdown shows only figures with a path.
    """

    name: str
    caption: str
    image: bytes
    svg: str = ""
    file: str = ""

    @property
    def address(self) -> str:
        """The image as a ``data:`` URL, for HTML pages that load no other files."""
        kind = "png" if self.image.startswith(b"\x89PNG") else "jpeg"
        return f"data:image/{kind};base64,{b64encode(self.image).decode()}"


@dataclass(frozen=True)
class Markup:
    """Trusted HTML, which is not escaped. Other formats omit it."""

    html: str


Part = str | Table | Pairs | Tiles | Bullets | Alert | Code | Figure | Markup


@dataclass(frozen=True)
class Section:
    """A part of a page under a heading.

    Attributes:
        title: the heading. If it is empty, HTML shows each part in its own card.
        parts: the content, such as tables and figures. A string is a paragraph.
        folded: whether HTML shows only the heading until the reader opens the section.
        wide: whether HTML makes the section as wide as the page. Other sections share a row.
    """

    title: str
    parts: Sequence[Part]
    folded: bool = False
    wide: bool = True


@dataclass(frozen=True)
class Page:
    """A page with a whole report. ``about`` is shown in one line below the title."""

    title: str
    about: Sequence[str]
    sections: Sequence[Section]


def number(value: float | None, form: str = "{}") -> str:
    """Format a number as a cell of a table. None becomes ``n/a``."""
    return "n/a" if value is None else form.format(value)
