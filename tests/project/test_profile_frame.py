"""The profile of a frame names functions that exist."""

from __future__ import annotations

import sys
from functools import reduce
from importlib import import_module
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from profile_frame import STAGES


@pytest.mark.parametrize(
    ("module", "name"), [place for _, places in STAGES for place in places], ids=lambda word: word
)
def test_every_stage_is_a_function(module: str, name: str):
    assert callable(reduce(getattr, name.split("."), import_module(module)))
