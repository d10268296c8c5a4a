"""The table of detector_cost.py in tools/experiments, and one real run of each detector."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[1] / "tools" / "experiments" / "local_descriptors"


@pytest.fixture
def tool(monkeypatch):
    monkeypatch.syspath_prepend(str(TOOLS))
    yield importlib.import_module("detector_cost")
    for name in ("detector_cost", "bench_speed", "compare_orbslam3"):
        sys.modules.pop(name, None)


def test_medians_are_compared_with_the_first_detector_of_the_case(tool):
    bow = [tool.Cost(cpu, cpu + 2.0, 300.0, 1, 0, 0) for cpu in (9.0, 10.0, 30.0)]
    both = [tool.Cost(11.0, 9.0, 357.4, 2, None, 0)]
    alone = [tool.Cost(1.0, 1.0, 200.0, 0, 0, 0)]
    lines = tool.table({("a", "bow"): bow, ("a", "both"): both, ("b", "bow"): alone}).splitlines()
    assert lines[2] == "| a | `bow` | 10.00 | 12.00 | 300 | 1 / 0 / 0 |"
    assert lines[3] == "| a | `both` | 11.00 (+10.0 %) | 9.00 (-25.0 %) | 357 (+57) | 2 / - / 0 |"
    assert lines[4] == "| b | `bow` | 1.00 | 1.00 | 200 | 0 / 0 / 0 |"


@pytest.mark.slow
def test_the_command_runs_the_detectors_in_turn(tool, kitti_tree, monkeypatch, capsys):
    words = ["detector_cost.py", "--case", f"ring={kitti_tree}:00:8", "--repeats", "1"]
    monkeypatch.setattr(sys, "argv", [*words, "--detectors", "none,bow"])
    tool.main()
    out, err = capsys.readouterr()
    assert [line.split(":")[0] for line in err.splitlines()] == ["ring, none", "ring, bow"] * 2
    none, bow = out.splitlines()[2:]
    assert none.startswith("| ring | `none` | ")
    assert bow.startswith("| ring | `bow` | ")
    assert bow.count("%") == 2
    # Not less than the process that starts it holds, which is pytest here.
    assert float(bow.split("|")[5].split()[0]) > 50
