"""Compare the numbers on pages with the CSV files from which they come.

A table in Markdown names its source in a comment before it. Each line of the comment describes one
row of the table. The last line also describes all further rows::

    <!-- from: docs/x.csv | drive=$1, light=clean | | ate_m (system=ours) | found; missed -->

The fields of a line, separated by ``|``, are:

- The CSV file, or several files separated by ``+``, whose rows are joined.
- A filter that selects a row of the file. ``$1`` stands for the text of the first cell of the
  table's row. If a part of this text is in backticks, ``$1`` stands for that part. ``$0`` stands
  for the head of the column. ``x=1 or 2`` allows several values.
- A field for each further cell of the table's row. The field lists columns of the file. The cell
  must show the values of these columns, rounded as in the cell. The last field also applies to all
  further cells. If a field is empty, its cell is not compared. A filter in parentheses applies to
  the columns that precede it in the field. ``mean x``, ``median x``, ``sum x`` and ``max x`` stand
  for the mean, median, sum and maximum of column x over all selected rows. ``each x`` stands for
  all values of column x in these rows, in the order of the file. Empty values are left out.

A line that contains only ``-`` skips a row, or the whole table if it is the only line. A comment
may also stand before a paragraph. Such a comment names columns whose values the paragraph must
mention.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from statistics import mean, median

COMMENT = re.compile(r"<!-- from:(.*?)-->[ ]*\n", re.DOTALL)
TABLE = re.compile(r"(--> *\n)?(?:^ *\|.*\n)+?^ *\|[-| :]+\|\n((?:^ *\|.*\n?)+)", re.MULTILINE)
DECIMAL = re.compile(r"\d\.\d")
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:,\d{3})*(?:\.\d+)?")
OVER_ROWS = {"mean": mean, "median": median, "sum": sum, "max": max}


def lines_of(comment: str) -> list[str]:
    return [line.strip() for line in comment.strip().splitlines()]


def files_of(comment: str) -> set[str]:
    """Return the CSV files that a comment names as sources of a table."""
    fields = (line.partition("|")[0] for line in lines_of(comment))
    return {file.strip() for field in fields for file in field.split(" + ")} - {"-"}


def untraced(text: str) -> tuple[int, int]:
    """Count the tables on a page that name no source, and all tables on the page.

    Only tables that contain decimal numbers need a source.
    """
    tables = TABLE.findall(text)
    return sum(not comment and bool(DECIMAL.search(body)) for comment, body in tables), len(tables)


def compare(text: str, root: Path) -> Iterator[str]:
    """Compare a page with its sources. Yield a sentence for each value that differs."""
    for found in COMMENT.finditer(text):
        lines, after = lines_of(found[1]), _block_after(found, text)
        try:
            if after.lstrip().startswith("|"):
                for cell in _traced_cells(lines, after, root):
                    yield from cell.faults()
            else:
                for line in lines:
                    yield from _paragraph_faults(line, after, root)
        except (LookupError, ValueError, OSError) as error:
            yield f"source {lines[0]!r} cannot be read: {error}"


def fill(text: str, root: Path) -> str:
    """Write the numbers of the sources into the tables of a page, and return the new page.

    Each number keeps its decimals. Cells that contain text from the source are left unchanged, and
    so are cells with too many or too few numbers, and paragraphs.

    Raises:
        LookupError, ValueError, OSError: a source cannot be read.
    """
    for found in reversed([*COMMENT.finditer(text)]):
        table = filled = _block_after(found, text)
        if not table.lstrip().startswith("|"):
            continue
        for cell in reversed([*_traced_cells(lines_of(found[1]), table, root)]):
            filled = filled[: cell.start] + cell.filled() + filled[cell.start + len(cell.text) :]
        text = text[: found.end()] + filled + text[found.end() + len(table) :]
    return text


def _block_after(found: re.Match[str], text: str) -> str:
    """Return the table or paragraph that follows a comment."""
    return text[found.end() :].partition("\n\n")[0]


@dataclass(frozen=True)
class Cell:
    """A cell of a table, and the values of its source.

    Attributes:
        start: position of the text of the cell, counted from the beginning of the table.
        text: text of the cell.
        row: text of the first cell of the row.
        source: file and columns.
        values: values that the cell must show.
    """

    start: int
    text: str
    row: str
    source: str
    values: list[float | str]

    def faults(self) -> Iterator[str]:
        """Yield a sentence for each value that the cell does not show."""
        left = self.text
        for value in self.values:
            if isinstance(value, str):
                if value not in left:
                    yield f"{self.row}: {self.text!r} does not show {value!r} of {self.source}"
                left = left.replace(value, "", 1)
        numbers, shown = self._numbers(), NUMBER.findall(left)
        if not (len(shown) == len(numbers) and all(map(_is_rounded, shown, numbers))):
            yield f"{self.row}: {self.text!r} differs from {self.values} of {self.source}"

    def filled(self) -> str:
        """Return the text with the numbers of the source, or the same text if they do not fit."""
        numbers = self._numbers()
        if not len(NUMBER.findall(self.text)) == len(numbers) == len(self.values):
            return self.text
        values = iter(numbers)
        return NUMBER.sub(lambda shown: _updated(shown[0], next(values)), self.text)

    def _numbers(self) -> list[float]:
        return [value for value in self.values if not isinstance(value, str)]


def _traced_cells(lines: list[str], table: str, root: Path) -> Iterator[Cell]:
    """Yield the cells of a table that have a source.

    Raises:
        ValueError: after all cells, if there are more source lines than rows.
    """
    head, _, *rows = table.splitlines()
    names = _cells(head)
    start = table.index(rows[0])
    for line, row in zip_longest(lines[: len(rows)], rows, fillvalue=lines[-1]):
        texts, position = _cells(row), start
        start += len(row) + 1
        if line == "-":
            continue
        file, filters, *columns = [part.strip() for part in line.split("|")]
        columns += columns[-1:] * (len(texts) - len(columns))
        for name, text, column in zip(names, texts, columns, strict=True):
            position = table.index("|", position) + 1
            if column:
                values = _values(root, file, filters, column, [name, *texts])
                at = table.index(text, position)
                yield Cell(at, text, texts[0], f"{file} ({column})", values)
    if len(lines) > len(rows):
        raise ValueError(f"it has {len(lines)} lines, and the table has {len(rows)} rows")


def _cells(row: str) -> list[str]:
    return [cell.strip() for cell in row.strip().strip("|").split("|")]


def _paragraph_faults(line: str, paragraph: str, root: Path) -> Iterator[str]:
    file, filters, column = [part.strip() for part in line.split("|")]
    shown = NUMBER.findall(paragraph)
    for value in _values(root, file, filters, column, []):
        if isinstance(value, str):
            found = value in paragraph
        else:
            found = any(_is_rounded(number, value) for number in shown)
        if not found:
            yield f"{paragraph[:40]!r}... does not mention {value} of {file} ({column})"


def _updated(shown: str, value: float) -> str:
    """Return a value with the decimals of the number that is shown, or this number if it agrees."""
    if _is_rounded(shown, value):
        return shown
    decimals = len(shown.partition(".")[2])
    return f"{value:,.{decimals}f}" if abs(value) >= 1000 else f"{value:.{decimals}f}"


def _is_rounded(shown: str, value: float) -> bool:
    number = shown.replace(",", "")
    decimals = len(number.partition(".")[2])
    return abs(float(number) - value) <= 0.5 * 10.0**-decimals * (1 + 1e-6)


def _values(root: Path, files: str, filters: str, column: str, row: list[str]) -> list[float | str]:
    """Return the numbers and texts of the CSV files that a cell of a table must show.

    ``row`` contains the head of the cell's column, followed by all cells of the row.
    """
    table = []
    for name in files.split(" + "):
        with (root / name).open(newline="", encoding="utf-8") as file:
            table += list(csv.DictReader(file))
    found: list[float | str] = []
    in_parentheses = ""
    for field in reversed(column.split(";")):
        name, _, more = field.strip().removesuffix(")").partition(" (")
        in_parentheses = more or in_parentheses
        wanted = _wanted(f"{filters}, {in_parentheses}", row)
        rows = [
            one for one in table if all(one.get(key) in any_of for key, any_of in wanted.items())
        ]
        over, _, operand = name.partition(" ")
        if over == "each" and rows:
            found += [_parsed(one[operand]) for one in reversed(rows) if one.get(operand)]
        elif over in OVER_ROWS and rows:
            known = [float(one[operand]) for one in rows if one[operand]]
            found.append(OVER_ROWS[over](known))
        elif len(rows) != 1:
            shown = {key: " or ".join(any_of) for key, any_of in wanted.items()}
            raise LookupError(f"{len(rows)} rows of {files} have {shown}")
        elif value := rows[0][name]:
            found.append(_parsed(value))
    return found[::-1]


def _parsed(value: str) -> float | str:
    return float(value) if NUMBER.fullmatch(value) else value


def _wanted(filters: str, row: list[str]) -> dict[str, list[str]]:
    """Return the values that a filter allows for each column. ``$1`` stands for ``row[1]``."""

    def text(found: re.Match[str]) -> str:
        cell = row[int(found[1])]
        code = re.search("`(.*?)`", cell)
        return code[1] if code else cell.strip("*")

    pairs = [one.split("=", 1) for one in re.split(r", (?=\w+=)", filters.strip(", "))]
    return {key: re.sub(r"\$(\d)", text, value).split(" or ") for key, value in pairs}
