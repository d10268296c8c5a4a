"""Pages of reports: what each format shows of each part, and files of results."""

from __future__ import annotations

import re
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from vslam.report.drawing import LOW, Drawing, add_legend, draw, new_figure
from vslam.report.page import (
    Alert,
    Bullets,
    Code,
    Figure,
    Markup,
    Page,
    Pairs,
    Section,
    Table,
    Tile,
    Tiles,
)
from vslam.report.render import csv_text, html, markdown, show, write_files
from vslam.report.schema import Document
from vslam.support.errors import InputError, ResultsError

JPEG = b"\xff\xd8\xff"
TABLE = Table(("what", "ATE (m), bow"), [("a | b", "1.0"), ("<b>", "12.5")], ("what",), "Medians.")
PAGE = Page(
    "Title <1>",
    ["stereo", "", "seed 3"],
    [
        Section("", [Alert("Stopped.", "By hand."), Tiles([Tile("Lost", "3", "of 9", "bad")])]),
        Section("Errors", [TABLE, Bullets(["bow wins", "chance"])]),
        Section("Empty", [Table(("a", "b"), [], note="Never shown."), Bullets([]), ""]),
        Section("Run", [Pairs([("seed", "3"), ("sensor", "stereo")])], wide=False),
        Section("", [Figure("path", "The path.", JPEG, file="figures/path.jpg")]),
        Section("Folded", ["A sentence.", Code("vslam run")], folded=True),
        Section("Explorer", [Markup("<canvas></canvas>")]),
    ],
)


def test_markdown():
    assert (
        markdown(PAGE)
        == """# Title <1>

stereo · seed 3

**Stopped.** By hand.

|      |     |      |
| ---- | --- | ---- |
| Lost | 3   | of 9 |

## Errors

| what   | ATE (m), bow |
| ------ | ------------ |
| a \\| b | 1.0          |
| <b>    | 12.5         |

Medians.

- bow wins
- chance

## Run

|        |        |
| ------ | ------ |
| seed   | 3      |
| sensor | stereo |

![path](figures/path.jpg)

The path.

## Folded

A sentence.

    vslam run
"""
    )


def test_html():
    text = html(PAGE)
    assert "<h1>Title &lt;1&gt;</h1>" in text
    assert "<span>stereo</span><span>seed 3</span>" in text
    assert "<strong>Stopped.</strong> By hand." in text
    assert '<div class="card tile bad">' in text
    assert '<td class="text">&lt;b&gt;</td><td>12.5</td>' in text
    assert re.findall("<h2>(.*)</h2>", text) == ["Errors", "Run", "Explorer"]
    assert "<summary>Folded</summary>" in text
    assert '<figure class="card path wide">' in text
    assert 'src="data:image/jpeg;base64,/9j/"' in text
    assert "<canvas></canvas>" in text
    assert "Never shown." not in text
    assert not re.search(r"(src|href)\s*=\s*[\"']?\s*(https?:)?//", text)


def test_rows_of_a_table_wider_than_a_phone_become_blocks():
    def shown(head: tuple[str, ...], row: tuple[str, ...], texts: tuple[str, ...] = ()) -> str:
        return html(Page("", [], [Section("", [Table(head, [row], texts)])]))

    head, row = ("what", "ATE (m), bow", *"abcdefghi"), ("<b>", *10 * ["1.234"])
    assert '<td class="text" data-label="what">&lt;b&gt;</td>' in shown(head, row, ("what",))
    assert '<table class="stacked">' in shown(head, row)
    assert '<td data-label="ATE (m), bow">1.234</td>' in shown(head, row)
    assert "data-label=" not in shown(head[:6], row[:6])
    sentence = ("Words of a sentence. " * 5,)
    assert "data-label=" not in shown(head[:1], sentence, ("what",))  # wide tables are wrapped
    assert "data-label=" in shown(head[:1], sentence)


def printed(page: Page, width: int) -> list[str]:
    out = StringIO()
    show(page.sections, Console(file=out, width=width))
    return [line.rstrip() for line in out.getvalue().splitlines()]


def test_terminal():
    lines = printed(PAGE, 1000)
    assert lines[:2] == ["Stopped. By hand.", "Lost  3  of 9"]
    assert lines[2:11] == [
        "", "Errors", "", "        ATE", "        (m)", "what    bow", "───────────", "a | b   1.0",
        "<b>    12.5",
    ]  # fmt: skip
    assert lines[11:15] == ["", "Medians.", "- bow wins", "- chance"]
    assert "sensor  stereo" in lines
    assert lines[-3:] == ["Folded", "", "A sentence."]  # the explorer is not for a terminal


def test_a_narrow_terminal_folds_sentences_and_never_a_table():
    wide = Table(("name", "value"), [("a" * 30, "1.234")], ("name",), "One two three four.")
    lines = printed(Page("", [], [Section("", [wide, Pairs([("path", "b" * 40)])])]), 12)
    assert "a" * 30 + " 1.234" in lines
    assert lines[-3:] == ["One two", "three four.", "path  " + "b" * 40]


def test_figures_of_one_page_share_no_ids_and_are_equal_every_time():
    def drawings() -> list[Drawing]:
        made = []
        for name in ("one", "two"):
            figure, axes = new_figure(name, "x", "y", LOW)
            axes.plot([0, 1], [0, 1])
            made.append((name, "", figure))
        return made

    first, second = draw(drawings())
    clips = [re.findall(r'<clipPath id="(\w+)"', figure.svg) for figure in (first, second)]
    assert all(clips)
    assert not set(clips[0]) & set(clips[1])
    assert draw(drawings()) == [first, second]


@pytest.mark.parametrize(
    ("labels", "columns"), [(["both", "bow", "none"], 3), (["a detector with a long name"] * 3, 1)]
)
def test_a_legend_is_not_wider_than_its_figure(labels: list[str], columns: int):
    figure, axes = new_figure("Long names", "x", "y", LOW)
    for label in labels:
        axes.plot([0, 1], [0, 1], label=label)
    add_legend(figure, axes)
    figure.draw_without_rendering()
    box = figure.legends[0].get_window_extent()
    assert 0 <= box.x0 < box.x1 <= figure.bbox.width
    assert len({round(text.get_window_extent().x0) for text in figure.legends[0].texts}) == columns


def test_files_that_cannot_be_written_are_named(tmp_path: Path):
    write_files(tmp_path / "new", {"a.md": "ä", "b.jpg": JPEG})
    assert (tmp_path / "new" / "a.md").read_text("utf-8") == "ä"
    assert (tmp_path / "new" / "b.jpg").read_bytes() == JPEG
    (tmp_path / "file").touch()
    with pytest.raises(ResultsError, match=r"a\.md: cannot be written .*; free space\."):
        write_files(tmp_path / "file", {"a.md": ""}, "free space")


def test_csv():
    assert csv_text([("a", "b"), (1, None), ("x,y", 2.5)]) == 'a,b\n1,\n"x,y",2.5\n'


class Measured(Document):
    schema_version: int = 2
    metres: float


def test_a_document_is_read_as_it_was_written_and_by_its_version_alone(tmp_path: Path):
    path, found = tmp_path / "found.json", Measured(metres=1.5)
    path.write_text(found.to_json())
    assert Measured.read(path) == found
    for text, says in (
        ("{", "missing or damaged"),
        ("[1]", "missing or damaged"),
        (
            '{"schema_version": 1, "metres": 1.5}',
            "report schema 1, but this version of vslam reads 2",
        ),
        ('{"schema_version": 2, "feet": 5}', "missing or damaged"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=re.escape(f"{path}: {says}")):
            Measured.read(path)
    with pytest.raises(InputError, match="missing or damaged"):
        Measured.read(tmp_path / "nothing.json")
