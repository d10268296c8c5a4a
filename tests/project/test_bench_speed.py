"""The calculations and the tables of tools/bench_speed.py, without ORB-SLAM3."""

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


def made_run(speed, report, held=(), memory_mb=300.0):
    process = speed.Process("", 10.0, 15.0, memory_mb, list(held))
    return speed.Run(process, report, 0, 0, Path("trajectory.txt"))


def test_a_case_is_a_title_and_a_place(speed, kitti_tree, tmp_path):
    case = speed.parse_case(f"a town={kitti_tree}:00:28")
    assert case == ("a town", kitti_tree, "00", 28)
    assert speed.rate(case) == pytest.approx(10.0)
    for wrong in ("no place", f"t={kitti_tree}:00", f"t={kitti_tree}:00:all", "t=/nowhere:00:5"):
        with pytest.raises(argparse.ArgumentTypeError):
            speed.parse_case(wrong)
    (tmp_path / "sequences" / "00" / "image_0").mkdir(parents=True)
    with pytest.raises(argparse.ArgumentTypeError, match="image_1: no such folder; give"):
        speed.parse_case(f"t={tmp_path}:00:5")


@pytest.mark.slow
def test_reading_is_measured(speed, kitti_tree):
    case = speed.Case("", kitti_tree, "00", 5)
    for system in (speed.FULL, speed.ORBSLAM3):
        assert speed.reading_ms(case, system) > 0.0


def test_comparison_has_medians_and_ratios(speed):
    names = [name for name, *_ in speed.MEASURES]
    ours = [dict.fromkeys(names, value) for value in (10.0, 12.0, 20.0)]
    theirs = [dict.fromkeys(names, 6.0)]
    table = speed.comparison({speed.FULL: ours, speed.ORBSLAM3: theirs})
    head, _, first, *_ = table.splitlines()
    assert head == "| | vslam | ORB-SLAM3 | vslam / ORB-SLAM3 |"
    assert first == "| frames/s, whole process ↑ | 12.0 (10.0 - 20.0) | 6.0 | 2.00 |"
    other = speed.comparison(
        {speed.FULL: ours, speed.ORBSLAM3: theirs, "vslam --detector capsule": ours[1:2]}
    )
    assert other.splitlines()[0].startswith("| | vslam | vslam --detector capsule | ORB-SLAM3 |")
    assert other.splitlines()[2].endswith("| 12.0 | 6.0 | 2.00 | 2.00 |")
    alone = speed.comparison({speed.FULL: ours[:1]})
    assert alone.splitlines()[2] == "| frames/s, whole process ↑ | 10.0 |"


def test_latency_of_both_systems(speed, kitti_tree):
    case = speed.Case("", kitti_tree, "00", 28)
    report = {"latency_ms": {"median": 40.0, "p95": 50.0, "p99": 55.0}, "dropped_frames": 0}
    ours = made_run(speed, report)
    theirs = made_run(speed, {"track_ms_median": 60.0, "track_ms_p95": 90.0})
    alone = speed.latency({speed.LIVE: [ours]}, case)
    assert alone.splitlines()[2] == "| vslam, image to pose, 10 Hz | 40 | 50 | 55 | 0 |"
    assert "ORB-SLAM3" not in alone
    assert "| 60 | 90 | | |" in speed.latency({speed.LIVE: [ours], speed.ORBSLAM3: [theirs]}, case)


def test_a_keyframe_costs_what_memory_grew_by(speed):
    report = {"startup_s": 2.0, "keyframes": 50}
    run = made_run(speed, report, [(0.5, 100.0), (1.5, 200.0), (2.5, 250.0)])
    assert "200 MB of memory before the first frame and 300 MB" in speed.memory(run)
    assert "2.00 MB per keyframe" in speed.memory(run)
    assert "too short" in speed.memory(made_run(speed, report))


def test_what_people_wrote_stays_on_the_page(speed, tmp_path):
    page = tmp_path / "performance.md"
    assert speed.written(page) == ("# Performance\n\n", "")
    page.write_text(f"# Speed\n\nFast.\n\n{speed.BEGIN}\nTables.\n\n## Limits\n\nBy hand.\n")
    assert speed.written(page) == ("# Speed\n\nFast.\n\n", "\n## Limits\n\nBy hand.\n")


def test_the_command_on_the_page_names_variables_instead_of_paths(speed, monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    monkeypatch.setenv("TOWNS", "/home/me/.cache/towns")
    words = ["tools/bench_speed.py", "--case", "Town 07=/home/me/.cache/towns:07:9"]
    assert speed.anonymous(words) == 'tools/bench_speed.py --case "Town 07=$TOWNS:07:9"'


@pytest.mark.slow
def test_the_command_runs_the_systems_in_turn(speed, kitti_tree, monkeypatch, capsys, tmp_path):
    words = ["--case", f"ring={kitti_tree}:00:28", "--repeats", "1"]
    words.append("--also=--detector none")
    words += ["--csv", str(tmp_path / "speed.csv")]
    monkeypatch.setattr(sys, "argv", ["bench_speed.py", *words])
    speed.main()
    out, err = capsys.readouterr()
    lean = "vslam --no-report"
    turn = ["vslam", lean, f"{lean} --detector none"]
    assert [line.split(":")[0] for line in err.splitlines()] == [
        *(f"ring, {system}" for system in turn),
        *(f"ring, {system}" for system in (*turn[:2], "vslam --realtime", turn[2])),
    ]
    (memory,) = (line for line in out.splitlines() if line.startswith("| peak memory"))
    cells = [cell.strip() for cell in memory.split("|")[2:5]]
    assert all(float(cell) > 50 for cell in cells)
    with (tmp_path / "speed.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["case"], row["system"], row["memory_mb"]) for row in rows] == [
        ("ring", system, cell) for system, cell in zip(turn, cells, strict=True)
    ]
