"""docs/reference/thresholds.md agrees with vslam/config.py."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path

import pytest

from vslam.config import Config, OrbConfig

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "thresholds.md"
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
def test_every_threshold_has_a_description_and_a_source(table, section):
    model = type(getattr(Config(), section))
    described = table.descriptions(model)
    assert list(described) == list(model.model_fields)
    for name, text in described.items():
        end = r"\.\s\[(own|(OS1|OS2) [IVX]+(-[A-F])?, (printed|customary|own)|ZS, printed)\]$"
        assert re.search(r"^\S.{4,}" + end, text), f"{section}.{name}"


@pytest.mark.parametrize("section", SECTIONS)
def test_every_threshold_has_one_row(section):
    for name in type(getattr(Config(), section)).model_fields:
        assert PAGE.read_text().count(f"| `{section}.{name}` |") == 1


def test_a_default_that_changes_changes_the_page(table):
    fewer = OrbConfig(n_features=OrbConfig().n_features - 1)
    made = table.page(Config(orb=fewer))
    assert made != PAGE.read_text()
    assert f"| `orb.n_features` | {fewer.n_features} |" in made


class NoSource(OrbConfig):
    depth: int = 1
    """Depth."""


class NoDocstring(OrbConfig):
    depth: int = 1


@pytest.mark.parametrize("section", [NoSource(), NoDocstring()])
def test_a_threshold_without_docstring_or_source_is_refused(table, section):
    with pytest.raises(ValueError, match=r"orb\.depth: no source"):
        table.page(Config().model_copy(update={"orb": section}))
