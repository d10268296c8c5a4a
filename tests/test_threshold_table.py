"""docs/thresholds.md says what vslam/config/ says."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path

import pytest
from pydantic import Field, create_model

from vslam.config import Config, OrbConfig

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "thresholds.md"
SECTIONS = list(Config.model_fields)


@pytest.fixture
def table(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    yield importlib.import_module("threshold_table")
    sys.modules.pop("threshold_table", None)


def test_the_committed_page_is_the_one_that_the_tool_makes(table):
    made = table.page(Config())
    assert made == PAGE.read_text(), "run: python tools/threshold_table.py"


@pytest.mark.parametrize("section", SECTIONS)
def test_every_threshold_has_a_description_and_a_source(section):
    for name, field in type(getattr(Config(), section)).model_fields.items():
        end = r"\.\s\[(own|(OS1|OS2) [IVX]+(-[A-F])?, (printed|customary|own)|ZS, printed)\]$"
        described = " ".join((field.description or "").split())
        assert re.search(r"^\S.{4,}" + end, described), f"{section}.{name}"


@pytest.mark.parametrize("section", SECTIONS)
def test_every_threshold_has_one_row(section):
    for name in type(getattr(Config(), section)).model_fields:
        assert PAGE.read_text().count(f"| `{section}.{name}` |") == 1


def test_a_default_that_changes_changes_the_page(table):
    fewer = OrbConfig(n_features=OrbConfig().n_features - 1)
    made = table.page(Config(orb=fewer))
    assert made != PAGE.read_text()
    assert f"| `orb.n_features` | {fewer.n_features} |" in made


def test_a_description_without_source_is_refused(table):
    more = create_model("More", __base__=OrbConfig, depth=(int, Field(1, description="Depth.")))
    with pytest.raises(ValueError, match=r"orb\.depth"):
        table.page(Config().model_copy(update={"orb": more()}))


def test_check_tells_a_page_that_differs(table, monkeypatch, tmp_path):
    out = tmp_path / "page.md"
    monkeypatch.setattr(sys, "argv", ["threshold_table.py", "--out", str(out)])
    table.main()
    monkeypatch.setattr(sys, "argv", [*sys.argv, "--check"])
    table.main()
    out.write_text(out.read_text().replace("2000", "1999"))
    with pytest.raises(SystemExit) as stopped:
        table.main()
    assert "differs" in str(stopped.value)
