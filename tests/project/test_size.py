"""tools/size.py counts lines of each kind, thresholds and options."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

SOURCE = '''"""One line.

Another, after a blank one.
"""

import os  # a comment beside code

# a comment
x = """not
a docstring"""


class A:
    y: int = 1
    """About y."""
'''


@pytest.fixture
def size(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    import size

    yield size
    sys.modules.pop("size", None)


def test_each_line_has_one_kind(size):
    found = size.lines_of(SOURCE)
    assert found == {"docstrings": 5, "code": 5, "comments": 1, "blank": 4}
    assert found.total() == SOURCE.count("\n")


def test_packages_of_vslam_and_tools_are_their_folders(size):
    names = ("setup.py", "backend/gps.py", "vslam/slam.py", "vslam/datasets/perturbation/law.py")
    found = [size.package_of(Path(name)) for name in names]
    assert found == [".", "backend", "vslam", "vslam/datasets"]


def test_thresholds_are_the_fields_of_the_sections(size):
    from vslam.config import Config

    sections = (type(getattr(Config(), name)) for name in Config.model_fields)
    counted = size.thresholds((ROOT / "vslam" / "config.py").read_text())
    assert counted == sum(len(section.model_fields) for section in sections)
