"""The grid of a benchmark, its cells and their results. No cell is lost."""

from __future__ import annotations

import functools
import io
import json
import re
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import psutil
import pytest
from source_files import write_calibration, write_video
from stub_runner import COMMAND, started, wait_for
from typer.testing import CliRunner

from vslam.cli import main as cli
from vslam.cli.main import every_command
from vslam.config import Config
from vslam.support.errors import InputError, ResultsError
from vslam_lab.bench import estimate, execute, grid, table
from vslam_lab.bench.grid import Cell

CONFIG = Config().model_dump_json(indent=2) + "\n"


def options_for(out: Path) -> execute.CellOptions:
    return execute.CellOptions(
        data=None, config=CONFIG, threads=1, command=COMMAND, scratch=execute.scratch_folder(out)
    )


CELLS = grid.make_grid("kitti", ["00", "05"], ["none", "brightness:1"], ["none", "bow"], 2)


def test_sequences():
    assert grid.parse_sequences("00-02,05,demo,01") == ["00", "01", "02", "05", "demo"]
    assert grid.parse_sequences("9-11") == ["9", "10", "11"]
    for text, part in (("05-00", "write 00-05"), (" ,", "no sequence")):
        with pytest.raises(InputError, match=part):
            grid.parse_sequences(text)


def test_perturbations():
    text = "none,brightness:0.50,brightness:1.5+blur,none"
    assert grid.parse_perturbations(text) == ["none", "brightness:0.5", "brightness:1.5,blur:1"]
    with pytest.raises(InputError, match="unknown law 'snow'"):
        grid.parse_perturbations("none,snow:2")


def test_only_seeded_perturbations_are_repeated_and_seeds_come_last():
    assert [(c.sequence, c.perturb, c.seed) for c in CELLS if c.detector == "bow"] == [
        ("00", "none", 0),
        ("00", "brightness:1", 0),
        ("05", "none", 0),
        ("05", "brightness:1", 0),
        ("00", "brightness:1", 1),
        ("05", "brightness:1", 1),
    ]
    assert not grid.draws("blur:2")
    assert grid.draws("blur:2,noise:1")


def test_cells_know_the_weights_of_their_detector(tmp_path: Path):
    file = tmp_path / "mine.safetensors"
    file.write_bytes(b"weights")
    ours, plain = grid.make_grid(
        "kitti", ["00"], ["none"], ["capsule", "bow"], 1, 9, {"capsule": file}
    )
    assert ours.arguments()[-4:] == ["--weights", str(file), "--max-frames", "9"]
    assert "--weights" not in plain.arguments()
    file.write_bytes(b"others")
    (other,) = grid.make_grid("kitti", ["00"], ["none"], ["capsule"], 1, 9, {"capsule": file})
    (shipped,) = grid.make_grid("kitti", ["00"], ["none"], ["capsule"], 1, 9)
    assert len({ours.name, other.name, shipped.name, plain.name}) == 4
    with pytest.raises(InputError, match=r"--weights .* cannot be read"):
        grid.make_grid("kitti", ["00"], ["none"], ["capsule"], 1, 9, {"capsule": tmp_path / "no"})


def test_names_of_cells_differ():
    cells = [
        *CELLS,
        *(Cell("kitti", "00", law, "bow", 0) for law in ("blur:1", "blur:0.1", "blur:1,noise:1")),
        Cell("kitti", "00", "none", "bow", 0, 50),
        Cell("synthetic", "00", "none", "bow", 0),
    ]
    assert len({cell.name for cell in cells}) == len(cells)
    assert CELLS[0].name == "kitti-00-none-none-seed0"
    assert Cell("kitti", "a/b", "none", "bow", 1).name == "kitti-a_b-none-bow-seed1"


def test_a_cell_is_finished_only_by_a_whole_run_of_the_same_settings(run_folder: Path):
    cell = Cell("kitti", "00", "brightness:1", "none", 3, 150)
    assert grid.is_finished(cell, run_folder, CONFIG)
    assert not grid.is_finished(cell, run_folder, CONFIG.replace("2000", "1999"))
    assert not grid.is_finished(Cell("kitti", "00", "brightness:1", "none", 3), run_folder, CONFIG)
    assert not grid.is_finished(Cell("kitti", "00", "none", "none", 3, 150), run_folder, CONFIG)
    assert not grid.is_finished(cell, run_folder.parent, CONFIG)


@pytest.mark.parametrize(
    ("sensor", "asked", "finished"),
    [
        ("rgbd", None, True),
        ("mono", None, True),  # a reader of a plug-in, whose data has one camera
        ("mono", "mono", True),
        ("stereo", "mono", False),
        ("mono", "stereo", False),
    ],
)
def test_a_run_counts_if_it_is_of_the_sensor_asked_for(stub, tmp_path, sensor, asked, finished):
    report = json.loads((stub / "report.json").read_text())
    (stub / "report.json").write_text(json.dumps(report | {"sensor": sensor}))
    cell = Cell("tum", "desk", "none", "none", 0, sensor=asked)
    out = tmp_path / "bench"
    list(execute.run_here([cell], options_for(out), 1, out))
    assert execute.finished_cells([cell], out, CONFIG) == [cell] * finished


@pytest.mark.parametrize(
    "change",
    ['"schema_version": 5|"schema_version": 4', '"se3"|"se4"', "{|", "0|"],
)
def test_a_report_of_another_schema_or_damaged_is_none(run_folder, tmp_path, change):
    old, new = change.split("|")
    text = (run_folder / "report.json").read_text()
    (tmp_path / "report.json").write_text(text.replace(old, new, 1) if old != "0" else text[:99])
    assert grid.read_report(tmp_path) is None


def test_cells_become_folders(stub: Path, tmp_path: Path):
    out = tmp_path / "bench"
    outcomes = list(execute.run_here(CELLS, options_for(out), 2, out))
    assert {outcome.cell for outcome in outcomes} == set(CELLS)
    assert len(started(stub)) == len(CELLS) == 12
    assert execute.finished_cells(CELLS, out, CONFIG) == CELLS
    folder = out / CELLS[0].name
    assert {path.name for path in folder.iterdir()} == {
        "config.json",
        "ground_truth_kitti.txt",
        "log.txt",
        "report.json",
        "run.json",
        "trajectory.tum",
    }
    report = grid.read_report(folder)
    assert report is not None
    assert report.evo_command == f"evo_ape kitti {folder}/ground_truth_kitti.txt --align"
    execute.tidy(out)
    assert {path.name for path in out.iterdir()} == {cell.name for cell in CELLS}


def test_failing_cells_are_told_and_done_again(stub: Path, tmp_path: Path):
    out, cells = tmp_path / "bench", CELLS[:3]
    (stub / "fail-00-none-bow-0").touch()
    (stub / "interrupt-00-none-none-0").touch()
    outcomes = {o.cell: o for o in execute.run_here(cells, options_for(out), 2, out)}
    failed = outcomes[cells[1]]
    assert isinstance(failed, execute.Failed)
    assert failed.message == "images of the moon; point the camera down."
    assert "some talk" in (out / "failed" / f"{cells[1].name}.txt").read_text()
    interrupted = outcomes[cells[0]]
    assert isinstance(interrupted, execute.Failed)
    assert "incomplete" in interrupted.message
    assert execute.finished_cells(cells, out, CONFIG) == cells[2:]

    (stub / "fail-00-none-bow-0").unlink()
    assert [type(o) for o in execute.run_here(cells[1:2], options_for(out), 1, out)] == [
        execute.Finished
    ]
    assert not (out / "failed" / f"{cells[1].name}.txt").exists()


def test_a_run_that_tracked_nothing_is_a_result_and_one_not_written_is_none(stub: Path, tmp_path):
    (stub / "lost-00-none-none-0").touch()
    (stub / "unwritten-00-none-bow-0").touch()
    outcomes = execute.run_here(CELLS[:2], options_for(tmp_path), 1, tmp_path)
    assert [type(outcome) for outcome in outcomes] == [execute.Finished, execute.Failed]


def test_a_runner_that_does_not_start_is_a_failed_cell(tmp_path: Path):
    options = execute.CellOptions(None, CONFIG, 1, command=("/no/such/program",))
    (outcome,) = execute.run_here(CELLS[:1], options, 1, tmp_path)
    assert isinstance(outcome, execute.Failed)
    assert "No such file" in outcome.message


def test_leaving_kills_what_runs_and_keeps_what_is_finished(stub: Path, tmp_path: Path):
    out, cells = tmp_path / "bench", CELLS[:4]
    held = stub / "hold-00-none-bow-0"
    held.touch()
    with closing(execute.run_here(cells, options_for(out), 2, out)) as outcomes:
        first = next(outcomes)
        assert first.cell != cells[1]
        process = next(p for p in psutil.Process().children() if COMMAND[1] in p.cmdline())
    assert not process.is_running() or process.status() == psutil.STATUS_ZOMBIE
    kept = execute.finished_cells(cells, out, CONFIG)
    assert first.cell in kept
    assert cells[1] not in kept
    assert not (out / "failed").exists()


def test_one_folder_is_for_one_data_set(tmp_path: Path):
    dead = tmp_path / ".parts" / "999999999"
    dead.mkdir(parents=True)
    execute.prepare(tmp_path, "/data/kitti")
    assert not dead.exists()
    execute.prepare(tmp_path, "/data/kitti")
    with pytest.raises(InputError, match=r"runs on /data/kitti, not on /other; .* --out"):
        execute.prepare(tmp_path, "/other")
    assert (tmp_path / "data.txt").read_text() == "/data/kitti\n"
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        execute.prepare(tmp_path / "file", "/other")


def test_results_that_cannot_be_written_are_said(tmp_path: Path):
    (tmp_path / "out").touch()
    done = execute.Finished(CELLS[0], "/tmp/run", {"report.json": b"{}"})
    with pytest.raises(ResultsError, match="finished cells are kept"):
        execute.publish(done, tmp_path / "out")


def test_estimate_learns_from_finished_cells(run_folder: Path, tmp_path: Path):
    frames = {"00": 4541, "05": 2761}
    guess = estimate.estimate(CELLS, {}, frames, 2)
    assert "guess" in guess.basis
    assert guess.kept > 12e6
    report = grid.read_report(run_folder)
    assert report is not None
    slow = report.model_copy(update={"fps": 2.0, "startup_s": 10.0})
    learned = estimate.estimate(CELLS[1:3], {CELLS[0]: slow}, frames, 2)
    expected = (2 * 10.0 + 2 * 4541 / 2.0) / 2
    assert learned.seconds == pytest.approx(expected)
    assert "1 finished" in learned.basis
    assert estimate.estimate([], {}, frames, 2).seconds == 0.0
    huge = estimate.Estimate(1.0, 10**18, 0, "")
    with pytest.raises(InputError, match=r"needs 1000000000\.0 GB"):
        estimate.check_disk(huge, tmp_path)
    assert [estimate.duration(s) for s in (40, 420, 7500)] == ["40 s", "7 min", "2 h 05 min"]


def test_table_counts_cells(stub: Path, tmp_path: Path):
    from rich.console import Console

    (stub / "fail-00-none-bow-0").touch()
    progress = table.GridProgress(CELLS, [], {"00": 100, "05": 100}, tmp_path, 1)
    outcomes = execute.run_here(CELLS[:2], options_for(tmp_path), 1, tmp_path)
    said = [progress.add(outcome) for outcome in outcomes]
    assert said[0].startswith("1/12 kitti-00-none-none-seed0: ATE 1.")
    assert said[1] == (
        "2/12 kitti-00-none-bow-seed0: failed: images of the moon; point the camera down."
    )
    assert progress.missing == CELLS[2:]
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(progress.table())
    text = console.export_text()
    for part in (
        "1 of 1  1.",
        "1 failed",
        "0 of 2",
        "finished runs",
        "1 of 12 runs finished, 1 failed, about",
        "left",
    ):
        assert part in text


@pytest.mark.parametrize("color", [False, True])
def test_the_table_stays_only_if_cells_are_missing_or_failed(
    monkeypatch, capsys, stub: Path, tmp_path: Path, color: bool
):
    """With ``color``, rich treats stderr as a terminal."""
    if color:
        monkeypatch.setenv("FORCE_COLOR", "1")
    for cells, stays in ((CELLS[:2], True), (CELLS[:1], False)):
        progress = table.GridProgress(cells, [], {"00": 100}, tmp_path, 1)
        with table.shown_live(progress, shown=True) as say:
            say("a line for logs")
            for outcome in execute.run_here(CELLS[:1], options_for(tmp_path), 1, tmp_path):
                progress.add(outcome)
        text = capsys.readouterr().err
        assert ("a line for logs" in text) is not color
        last = text.rpartition("1 of 2 runs" if stays else "1 of 1 run")[2]
        assert (f"of {len(cells)} run{'s' * stays} finished" in text) is (stays or color)
        assert ("\x1b[2K" in last) is (color and not stays)  # the table is erased


@pytest.fixture
def bench(stub: Path, kitti_tree: Path, tmp_path: Path, monkeypatch, capsys):
    """Run ``vslam bench`` with a stub in place of runs. Return the exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        execute, "CellOptions", functools.partial(execute.CellOptions, command=COMMAND)
    )
    monkeypatch.setattr("vslam.run.warmup.is_cold", lambda: False)

    def call(*words: object) -> tuple[int, str, str]:
        line = ["vslam", "bench", "--data", kitti_tree, "--seqs", "00", "--seeds", 2, *words]
        monkeypatch.setattr(sys, "argv", list(map(str, line)))
        code: object = 0
        try:
            cli.main()
        except SystemExit as stop:
            code = stop.code or 0
        output = capsys.readouterr()
        assert isinstance(code, int)
        return code, output.out, output.err

    return call


@pytest.mark.slow
def test_bench_runs_the_grid_and_writes_the_report(bench, stub: Path):
    code, out, err = bench("--jobs", 2)
    assert code == 0, err
    assert "6 runs, 6 to do: about" in err
    assert "6 of 6 runs finished, 0 failed" in out
    assert {p.name for p in Path("bench").iterdir() if p.is_file()} == {
        "data.txt",
        "report.html",
        "report.json",
        "report.md",
        "table.csv",
    }
    code, out, err = bench("--jobs", 2)
    assert (code, len(started(stub))) == (0, 6)
    assert "0 to do" in err


@pytest.mark.slow
def test_bench_shows_the_detectors_beside_the_first_one(bench):
    code, out, err = bench("--detectors", "bow,none,both")
    assert code == 0, err
    first, second = out.index("none against bow"), out.index("both against bow")
    assert first < second < out.index("9 of 9 runs finished")
    assert "Side by side: bow / none / both" in out
    rows = [line.split() for line in out.splitlines() if line.startswith("00 ")]
    assert [row[:2] for row in rows] == [["00", "none"], ["00", "brightness:1"]] * 2
    assert [len(row) for row in rows] == [11, 11, 8, 8]  # numbers of cells in both tables
    assert re.search(r"- Lost frames: bow \d+ in 3 runs, none \d+ in 3 runs, both \d+ in 3 ", out)
    assert "ATE over all conditions, both against bow: no winner. Of 1 sequence, " in out
    assert "both against bow" in Path("bench/report.md").read_text()
    assert bench("--detectors", "both", "--quiet")[1] == ""


@pytest.mark.slow
def test_bench_shows_what_is_left_when_all_runs_of_the_baseline_fail(bench, stub: Path):
    for name in ("none-bow-0", "brightness:1-bow-0", "brightness:1-bow-1"):
        (stub / f"fail-00-{name}").touch()
    code, out, err = bench()
    assert code == 1
    assert err.count("failed: ") > 2
    assert out.startswith("both\n")
    assert "against" not in out


@pytest.mark.slow
def test_other_thresholds_are_other_rows_and_overwrite_nothing(bench, stub: Path):
    grid_of = ("--perturb", "none", "--detectors", "none,bow")
    assert bench(*grid_of)[0] == 0
    kept = {path: path.stat().st_mtime_ns for path in Path("bench").glob("kitti-*/report.json")}
    code, out, err = bench(*grid_of, "--config", "orb.n_features=1000")
    assert code == 0, err
    assert len(started(stub)) == 4
    assert len(kept) == 2
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    systems = "none / none (orb.n_features=1000) / bow / bow (orb.n_features=1000)"
    assert f"Side by side: {systems}\n" in out
    assert "2 runs, 0 to do" in bench(*grid_of, "--config", "orb.n_features=1000")[2]
    assert "2 runs, 0 to do" in bench(*grid_of)[2]


def test_help_begins_with_the_table_of_the_mission():
    text = CliRunner().invoke(every_command(), ["bench", "--help"], env={"COLUMNS": "100"}).output
    examples = [
        line.split("(")[0].split()
        for line in text.splitlines()
        if line.strip().startswith("vslam ")
    ]
    assert examples[:2] == [["vslam", "bench"], ["vslam", "bench", "--dataset", "synthetic"]]


@pytest.mark.slow
def test_bench_counts_failures_and_ends_with_1(bench, stub: Path):
    (stub / "fail-00-brightness:1-bow-1").touch()
    code, out, err = bench()
    assert code == 1
    assert "failed: kitti-00-brightness1-bow-seed1: images of the moon" in err
    assert "5 of 6 runs finished, 1 failed; repeat the command to continue" in out
    (stub / "fail-00-brightness:1-bow-1").unlink()
    assert bench()[0] == 0
    assert len(started(stub)) == 7


@pytest.mark.slow
def test_bench_loses_nothing_to_an_interrupt(bench, stub: Path, monkeypatch):
    add = table.GridProgress.add

    def interrupted(self, outcome):
        if len(self.reports) == 2:
            raise KeyboardInterrupt
        return add(self, outcome)

    monkeypatch.setattr(table.GridProgress, "add", interrupted)
    code, out, _ = bench()
    assert code == 1
    assert "stopped: 2 of 6 runs finished" in out
    kept = {path.name for path in Path("bench").glob("kitti-*")}
    assert len(kept) >= 3  # including the run that was being written
    monkeypatch.setattr(table.GridProgress, "add", add)
    assert bench()[0] == 0
    done = started(stub)
    assert len(done) <= 7  # the interrupted run is repeated
    assert len(set(done)) == 6
    assert not Path("bench/.parts").exists()


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("--detectors orb", ["--detectors orb", "unknown"]),
        ("--seqs 00-02", ["no such sequence", "01"]),
        ("--perturb snow", ["unknown law 'snow'"]),
    ],
)
def test_bench_refuses_before_it_starts(bench, words, parts):
    code, out, err = bench(*words.split())
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert all(part in err for part in parts)
    assert not Path("bench").exists()


@pytest.mark.slow
def test_a_real_grid_killed_and_resumed(kitti_tree: Path, tmp_path: Path):
    """The benchmark is killed by SIGKILL during its second cell, whose process also ends."""
    out = tmp_path / "bench"
    command = [sys.executable, "-m", "vslam", "bench", "--data", str(kitti_tree), "--seqs", "00"]
    command += ["--max-frames", "6", "--perturb", "none,brightness", "--detectors", "none"]
    command += ["--seeds", "1", "--threads", "1", "--out", str(out)]
    first, second = (
        out / f"kitti-00-{light}-none-seed0-6frames" for light in ("none", "brightness1")
    )
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        wait_for(first.exists, 300)
        wait_for(lambda: psutil.Process(process.pid).children())
        (child,) = psutil.Process(process.pid).children()
    finally:
        process.kill()
        process.wait()
    wait_for(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE)
    assert not second.exists()
    before = (first / "report.json").stat().st_mtime_ns

    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "2 runs, 1 to do" in done.stderr
    assert (first / "report.json").stat().st_mtime_ns == before
    report = grid.read_report(second)
    assert report is not None
    assert (report.frames, report.perturb, report.lost_frames) == (6, "brightness:1", 0)
    assert not (out / ".parts").exists()
    assert "brightness:1" in (out / "report.md").read_text()


@pytest.mark.slow
def test_a_cell_runs_with_the_networks_that_are_shipped(kitti_tree: Path, tmp_path: Path):
    options = execute.CellOptions(kitti_tree, CONFIG, threads=2, scratch=tmp_path / "scratch")
    cell = Cell("kitti", "00", "none", "both", 0)
    outcome = execute.run_cell(cell, options)
    assert isinstance(outcome, execute.Finished), outcome
    execute.publish(outcome, tmp_path)
    report = grid.read_report(tmp_path / cell.name)
    assert report is not None
    assert (report.detector, report.frames, report.lost_frames) == ("both", 28, 0)


def test_a_run_ends_by_itself_though_its_standard_input_is_open():
    command = [sys.executable, "-m", "vslam_lab.cli.child", "--version"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.wait(60) == 0


@pytest.mark.slow
def test_a_video_is_a_grid_of_one_sequence(corridor, tmp_path: Path, monkeypatch):
    pairs = [np.hstack(pair) for pair in zip(corridor.left, corridor.right, strict=True)][:5]
    video = write_video(tmp_path / "drive.mkv", pairs)
    calib = write_calibration(tmp_path / "stereo.yaml", corridor.camera)
    words = ["bench", "--data", "drive.mkv", "--side-by-side", "--calib", "stereo.yaml"]
    words += ["--perturb", "none", "--detectors", "none", "--out", "grid"]
    monkeypatch.chdir(tmp_path)
    first = CliRunner().invoke(every_command(), words)
    assert first.exit_code == 0, first.output
    assert "1 of 1 run finished" in first.output
    (report,) = (tmp_path / "grid").glob("*/report.json")
    found = json.loads(report.read_text())
    assert (found["dataset"], found["sequence"], found["frames"]) == ("video", "drive", 5)
    assert found["calib"] == [str(calib)]
    again = CliRunner().invoke(every_command(), words)
    assert "1 run, 0 to do" in again.output
    other = CliRunner().invoke(every_command(), [*words, "--fps", "20"])
    assert f"contains runs on {video} --side-by-side {calib}, not on {video}" in str(
        other.exception
    )


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("--data 0", "--data 0: a live camera cannot be repeated; record a video"),
        ("--dataset video --data a.mkv --seqs 00", "--seq 00: only for data sets, not video"),
    ],
)
def test_sources_that_cannot_be_a_grid(tmp_path: Path, monkeypatch, words, part):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(every_command(), ["bench", *words.split()])
    assert part in str(done.exception)
