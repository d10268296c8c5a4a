"""tools/bench_speed.py, without ORB-SLAM3."""

from __future__ import annotations

import argparse
import csv
import importlib
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.fixture
def speed(monkeypatch):
    monkeypatch.syspath_prepend(str(TOOLS))
    yield importlib.import_module("bench_speed")
    sys.modules.pop("bench_speed", None)


def test_a_case_is_a_title_and_a_place(speed, kitti_tree, tmp_path):
    case = speed.parse_case(f"a town={kitti_tree}:00:28")
    assert case == ("a town", kitti_tree, "00", 28, "stereo")
    assert speed.parse_case(f"a town={kitti_tree}:00:28:mono") == (*case[:4], "mono")
    for wrong in (
        "no place",
        f"t={kitti_tree}:00",
        f"t={kitti_tree}:00:all",
        "t=/nowhere:00:5",
        f"t={kitti_tree}:00:28:depth",
    ):
        with pytest.raises(argparse.ArgumentTypeError):
            speed.parse_case(wrong)
    (tmp_path / "sequences" / "00" / "image_0").mkdir(parents=True)
    with pytest.raises(argparse.ArgumentTypeError, match="image_1: no such folder; give"):
        speed.parse_case(f"t={tmp_path}:00:5")


def test_the_script_of_orbslam3_exists(speed):
    assert speed.SCRIPT.is_file()


def test_the_table_has_medians_and_ranges(speed, tmp_path):
    runs = [dict.fromkeys(speed.MEASURES, value) for value in (20.0, 10.0, 12.0)]
    runs = [run | {"ate_m": float("nan")} for run in runs]
    speed.write_table(tmp_path / "speed.csv", {"ring": {speed.FULL: runs}})
    with (tmp_path / "speed.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["case"], row["system"], row["runs"]) == ("ring", "vslam", "3")
    found = (row["loop_fps"], row["loop_fps_least"], row["loop_fps_greatest"], row["ate_m"])
    assert found == ("12.0", "10.0", "20.0", "")


@pytest.mark.slow
def test_the_command_runs_the_systems_in_turn(speed, kitti_tree, monkeypatch, capsys, tmp_path):
    words = ["--case", f"ring={kitti_tree}:00:28", "--repeats", "1"]
    words.append("--also=--detector none")
    words += ["--csv", str(tmp_path / "speed.csv")]
    monkeypatch.setattr(sys, "argv", ["bench_speed.py", *words])
    speed.main()
    lean = "vslam --no-report"
    turn = ["vslam", lean, f"{lean} --detector none"]
    load, *lines = capsys.readouterr().err.splitlines()
    assert load.startswith("load of the machine")
    assert [line.split(":")[0] for line in lines] == [f"ring, {system}" for system in turn * 2]
    with (tmp_path / "speed.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["case"], row["system"]) for row in rows] == [("ring", system) for system in turn]
    assert all(float(row["memory_mb"]) > 50 for row in rows)
    assert all(0 < float(row["process_fps"]) < float(row["loop_fps"]) for row in rows)
