"""The report of many runs: its counts, its statements, and how it looks in a browser."""

from __future__ import annotations

import csv
import json
import re
import runpy
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from browser import chromium, dumped
from rich.console import Console

from vslam import METHOD_VERSION
from vslam.cli import main as cli
from vslam.config import Config
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.report.page import Table
from vslam.report.render import show
from vslam.report.schema import DetectorFigures
from vslam.support.errors import InputError
from vslam.types.trajectory import Trajectory, read_trajectory, write_kitti, write_tum
from vslam_lab.overview import figures
from vslam_lab.overview.collect import Found, collect, read_aligned
from vslam_lab.overview.render import overview_page, write_overview
from vslam_lab.overview.schema import ALL, MEASURES, Drive, OverviewJson, RunEntry, Spread
from vslam_lab.overview.summary import (
    compare,
    least_pairs,
    make_rows,
    strengths,
    summarize,
    systems,
)
from vslam_lab.overview.versus import versus

LAWS = ("none", "brightness:0.5", "brightness:1")


def copy_run(source: Path, folder: Path, **changes: object) -> Path:
    folder.mkdir(parents=True)
    for name in ("trajectory.tum", "trajectory_kitti.txt", "ground_truth_kitti.txt", "config.json"):
        shutil.copy(source / name, folder)
    (folder / "run.json").write_text("{}")
    report = json.loads((source / "report.json").read_text())
    (folder / "report.json").write_text(json.dumps(report | changes))
    return folder


@pytest.fixture(scope="module")
def runs(run_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs on two sequences with three strengths and two detectors, and other files.

    There are two seeds if the perturbation is random.
    """
    root = tmp_path_factory.mktemp("runs")
    for s, sequence in enumerate(("00", "05")):
        for k, perturb in enumerate(LAWS):
            for detector in ("none", "bow"):
                for seed in range(2 if k else 1):
                    copy_run(
                        run_folder,
                        root / f"{sequence}-{k}-{detector}-{seed}",
                        sequence=sequence,
                        perturb=perturb,
                        detector=detector,
                        seed=seed,
                        max_frames=None,
                        ate_rmse_m=1.0 + s + k + 0.1 * seed - 0.5 * (detector == "bow"),
                        loops_found=3 - k if detector == "bow" else 0,
                        loops_missed=k if detector == "bow" else 3,
                    )
    copy_run(run_folder, root / "stopped", interrupted="Ctrl-C")
    copy_run(run_folder, root / "old", schema_version=1, unknown=3)
    copy_run(run_folder, root / ".parts" / "1" / "half", sequence="99")
    (root / "damaged").mkdir()
    (root / "damaged" / "report.json").write_text("{")
    return root


@pytest.fixture(scope="module")
def written(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[OverviewJson, Path]:
    out = tmp_path_factory.mktemp("report")
    estimate = runs / "00-0-bow-0" / "trajectory_kitti.txt"
    return write_overview([runs], [f"ORB-SLAM3@00={estimate}"], out), out


def entry(
    system: str,
    sequence: str,
    ate: float | None,
    seed: int = 0,
    perturb: str = "brightness:1",
    **measures: float,
) -> RunEntry:
    return RunEntry(
        drive=Drive(dataset="kitti", sequence=sequence, excerpt="", perturb=perturb),
        system=system,
        seed=seed,
        frames=100,
        measures={name: None for name, *_ in MEASURES} | {"ate_rmse_m": ate} | measures,
        source=f"{system}-{sequence}-{perturb}-{seed}",
        machine=None,
    )


def table_of(report: OverviewJson, title: str) -> Table:
    (section,) = (one for one in overview_page(report, [], {}).sections if one.title == title)
    (table,) = section.parts
    return table


def test_json_is_versioned_and_round_trips(written):
    report, out = written
    text = (out / "report.json").read_text()
    found = json.loads(text)
    assert (found["kind"], found["schema_version"]) == ("overview", 4)
    assert OverviewJson.model_validate_json(text).model_dump_json(indent=2) + "\n" == text
    assert OverviewJson.model_validate_json(text) == report


def test_rows_are_medians_with_spread(written):
    report, _ = written
    assert len(report.runs) == 21
    assert len(report.rows) == 13
    row = next(r for r in report.rows if r.drive.perturb == "brightness:1" and r.system == "bow")
    assert (row.drive.sequence, row.runs, row.frames) == ("00", 2, 150)
    ate = row.measures["ate_rmse_m"]
    assert ate is not None
    assert (ate.n, ate.least, ate.greatest) == (2, 2.5, 2.6)
    assert ate.median == pytest.approx(2.55)
    lights = [r.drive.perturb for r in report.rows if r.drive.sequence == "00"]
    assert list(dict.fromkeys(lights)) == list(LAWS)
    assert systems(report.rows) == ["none", "bow", "ORB-SLAM3"]


def test_detectors_that_were_compared_in_a_run_are_systems_of_their_own(run_folder, tmp_path):
    figures = json.loads((run_folder / "report.json").read_text())
    known = DetectorFigures.model_fields
    own = {k: figures[k] for k in known if k in figures} | {"seconds": 2.0}
    others = [own | {"detector": "bow", "ate_rmse_m": 0.75}, own | {"detector": "none"}]
    others[1]["interrupted"] = "failed"
    folder = copy_run(
        run_folder,
        tmp_path / "run",
        detector="both",
        detectors=[own | {"detector": "both"}, *others],
    )
    shutil.copyfile(folder / "trajectory.tum", folder / "trajectory_bow.tum")
    found = collect([tmp_path], [])
    assert [run.system for run in found.runs] == ["both", "bow"]
    assert [run.measures["fps"] for run in found.runs] == [None, None]
    assert found.runs[1].measures["ate_rmse_m"] == 0.75
    assert found.runs[1].drive == found.runs[0].drive
    assert len(read_aligned(found, found.runs[1])[0]) == found.runs[1].frames
    assert found.notes == [f"left out: none in {folder} (failed)"]


def test_what_is_left_out_is_noted(written, runs: Path):
    notes = "\n".join(written[0].notes)
    assert f"{runs / 'stopped'} was interrupted (Ctrl-C)" in notes
    assert "old/report.json: report schema 1, but this version of vslam reads 5" in notes
    assert "damaged/report.json: missing or damaged" in notes
    assert "half" not in notes
    assert not any(row.drive.sequence == "99" for row in written[0].rows)


def test_external_trajectory_is_evaluated_like_a_run(written, run_folder: Path):
    report, _ = written
    row = next(row for row in report.rows if row.system == "ORB-SLAM3")
    truth, estimate = (
        read_trajectory(run_folder / f"{name}_kitti.txt") for name in ("ground_truth", "trajectory")
    )
    ate = row.measures["ate_rmse_m"]
    assert ate is not None
    assert ate.median == pytest.approx(evaluate_trajectory(estimate, truth).ate_rmse_m, abs=1e-9)
    assert row.measures["lost_frames"] is row.measures["loops_found"] is row.measures["fps"] is None
    assert (row.drive.perturb, row.drive.sequence) == ("none", "00")


def test_external_trajectory_with_frames_missing(runs: Path, run_folder: Path, tmp_path: Path):
    whole = read_trajectory(run_folder / "trajectory.tum")
    write_tum(tmp_path / "other.tum", whole.select(np.arange(10, 150)))
    found = collect([runs], [f"ORB-SLAM3@05@brightness:1={tmp_path / 'other.tum'}"])
    assert any("ORB-SLAM3 has poses for 140 of 150 frames of 05" in note for note in found.notes)
    write_kitti(tmp_path / "short.txt", whole.T_wc[:9])
    with pytest.raises(InputError, match="9 poses but 150 timestamps"):
        collect([runs], [f"ORB-SLAM3@05={tmp_path / 'short.txt'}"])


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("ORB-SLAM3=x.txt", "its sequence is not clear.*one of 00, 05"),
        ("ORB-SLAM3@07=x.txt", "its sequence is not clear"),
        ("x.txt", "NAME=FILE"),
        ("=x.txt", "NAME=FILE"),
        ("ORB-SLAM3@00=none.txt", "none.txt: cannot read"),
    ],
)
def test_external_trajectories_refused(runs: Path, text: str, part: str):
    with pytest.raises(InputError, match=part):
        collect([runs], [text])


def test_no_runs_are_refused(tmp_path: Path):
    with pytest.raises(InputError, match="no finished run here"):
        write_overview([tmp_path], [], tmp_path / "out")
    with pytest.raises(InputError, match="no such folder"):
        write_overview([tmp_path / "nothing"], [], tmp_path / "out")


def test_the_same_run_named_twice_counts_once(runs: Path):
    assert len(collect([runs, runs / "00-0-bow-0", runs / "00-0-bow-0" / ".."], []).runs) == 20


def test_too_few_sequences_for_a_test_are_said(written):
    report, out = written
    bow = next(c for c in report.comparisons if (c.first, c.second) == ("none", "bow"))
    assert (bow.second_better, bow.first_better, bow.ties, bow.p_value) == (2, 0, 0, None)
    assert bow.median_difference == pytest.approx(-0.5)
    for name in ("report.md", "report.html"):
        text = (out / name).read_text().replace("&#39;", "'").replace("&lt;", "<")
        assert "bow has the smaller ATE on 2 (00, 05)" in text
        assert text.count("Where fewer than 6 sequences differ, Wilcoxon's test cannot") == 1


def test_wilcoxon_pairs_sequences_not_runs():
    """There are six sequences with three runs each. p has the smallest value for 6 pairs."""
    assert least_pairs() == 6
    runs = [
        entry(
            system, f"{k:02d}", 1.0 + k - (0.1 + 0.01 * k) * (system == "bow") + 0.001 * seed, seed
        )
        for k in range(6)
        for system in ("none", "bow")
        for seed in range(3)
    ]
    found = compare(make_rows(runs), "none", "bow", "brightness:1", "ate_rmse_m")
    assert found is not None
    assert len(found.pairs) == found.second_better == 6
    assert found.p_value == pytest.approx(2 * 0.5**6)
    assert "p = 0.0312, unlikely to be chance" in found.words


def test_equal_trajectories_are_ties_and_not_counted():
    runs = [
        entry(system, f"{k:02d}", 1.0 + (0.2 if k == 6 and system == "bow" else 0.0))
        for k in range(8)
        for system in ("none", "bow")
    ]
    runs.append(entry("none", "09", None))
    found = compare(make_rows(runs), "none", "bow", "brightness:1", "ate_rmse_m")
    assert found is not None
    assert (found.first_better, found.second_better, found.ties, found.p_value) == (1, 0, 7, None)
    assert "none has the smaller ATE on 1 (06)" in found.words
    assert compare(make_rows(runs), "none", "capsule", "brightness:1", "ate_rmse_m") is None
    assert compare(make_rows(runs), "none", "bow", "none", "ate_rmse_m") is None


def test_noise_is_not_called_a_win():
    rng = np.random.default_rng(0)
    runs = [
        entry(system, f"{k:02d}", 1.0 + float(rng.normal(0.0, 0.1)))
        for k in range(10)
        for system in ("none", "bow")
    ]
    found = compare(make_rows(runs), "none", "bow", "brightness:1", "ate_rmse_m")
    assert found is not None
    assert found.p_value is not None
    assert found.p_value > 0.05
    assert "may be chance" in found.words


def loops(found: int, missed: int, lost: int = 0, rpe: float = 0.02) -> dict[str, float]:
    counts = {"loops_found": found, "loops_missed": missed, "loops_wrong": 0}
    return {**counts, "lost_frames": lost, "rpe_m": rpe, "rpe_deg": 0.05}


@pytest.fixture
def two_conditions() -> list[RunEntry]:
    """Runs on six sequences.

    Under brightness, ``both`` closes the loop of each sequence, and ``bow`` closes no loop.
    """
    runs = []
    for name in (f"{k:02d}" for k in range(6)):
        for system in ("bow", "both"):
            runs.append(entry(system, name, 1.0, perturb="none", **loops(1, 0)))
            finds = system == "both"
            ate = 1.5 if finds else 2.0 + 0.1 * int(name)
            runs += [entry(system, name, ate, k, **loops(finds, not finds, lost=k)) for k in (0, 1)]
    return runs


@pytest.fixture
def switched_off(tmp_path: Path, monkeypatch):
    """Return a function that runs switch_off.py on given runs and returns its table."""

    def table(runs: list[RunEntry], *words: str) -> list[dict[str, str]]:
        def bench(command: list[str]) -> SimpleNamespace:
            out = Path(command[command.index("--out") + 1])
            out.mkdir(parents=True)
            report = summarize(Found(runs, [])).model_dump_json()
            (out / "report.json").write_text(report)
            return SimpleNamespace(returncode=0)

        script = Path(__file__).parents[2] / "tools/experiments/ablation/switch_off.py"
        monkeypatch.setattr("subprocess.run", bench)
        arguments = ["--source", "", "--out", str(tmp_path / "out"), *words]
        monkeypatch.setattr(sys, "argv", [str(script), *arguments])
        runpy.run_path(str(script), run_name="__main__")
        return list(csv.DictReader((tmp_path / "out" / "ablation.csv").open()))

    return table


def test_a_part_is_switched_off_together_with_its_reference(switched_off):
    rows = switched_off([entry("both", "00", 1.0, perturb="none", **loops(1, 0))],
                        "--only", "alignment")  # fmt: skip
    assert [(row["without"], row["compared_with"]) for row in rows] == [
        ("nothing", "nothing"), ("tracking by patches", "nothing"),
        ("alignment of matches", "tracking by patches"),
    ]  # fmt: skip


def test_an_ablation_has_a_row_for_each_perturbation_of_the_images(switched_off):
    perturbs = ("none", "moving:6", "noise:1", "aliased,noise:1", "dark:4,noise:1")
    runs = [entry("both", "00", 1.0, perturb=one, **loops(1, 0)) for one in perturbs]
    rows = switched_off(runs, "--only", "triangulation", "--perturb", "none,noise,dark:4+noise")
    found = [(r["perturb"], r["drives"]) for r in rows if r["without"] == "triangulation"]
    assert found == [("none", "2"), ("noise:1", "2"), ("dark:4+noise:1", "1")]


def test_a_row_for_each_sequence_and_condition_and_who_wins_over_all(two_conditions):
    (section,) = versus(summarize(Found(two_conditions, [])))
    table, points = section.parts
    assert section.title == "Side by side: bow / both"
    assert len(table.rows) == 12
    assert list(zip(table.head, table.rows[3], strict=True)) == [
        ("sequence", "01"), ("perturbation", "brightness:1"), ("lost, bow", "0.5"),
        ("lost, both", "0.5"), ("ATE (m), bow", "2.100"), ("ATE (m), both", "1.500"),
        ("RPE (mm), bow", "20.0"), ("RPE (mm), both", "20.0"), ("RPE (°), bow", "0.050"),
        ("RPE (°), both", "0.050"), ("loops, bow", "0 of 1"), ("loops, both", "1 of 1"),
    ]  # fmt: skip
    assert "Loops: revisits found of those in the ground truth" in table.note
    lost, found, ate, rpe = points.sentences
    assert lost == "Lost frames: bow 6 in 18 runs, both 6 in 18 runs."
    assert found.endswith(": bow found 6 of 18, 0 wrong; both found 18 of 18, 0 wrong.")
    # Half of the difference under brightness, because the other condition is a tie.
    assert ate.startswith(
        "ATE over all conditions, both against bow: both wins. Of 6 sequences, bo"
    )
    assert "median -0.375 m (-0.500 to -0.250)" in ate
    assert "p = 0.0312" in ate
    assert rpe == "RPE over all conditions, both against bow: a tie on all 6 sequences."


def test_the_table_of_a_short_name_fits_a_terminal_of_80_columns(two_conditions, capsys):
    show(versus(summarize(Found(two_conditions, []))), Console(width=80))
    printed = capsys.readouterr().out
    lines = printed.splitlines()[2:18]
    assert max(map(len, lines)) <= 80
    assert lines[2].split() == [
        "sequence", "perturbation", *["bow", "both"] * 5,
    ]  # fmt: skip
    for head in lines[:3]:  # numbers are aligned with their headings
        ends = {match.end() for match in re.finditer(r"\S+", lines[4])}
        assert {match.end() for match in re.finditer(r"\S+", head[22:])} <= {e - 22 for e in ends}
    assert "- RPE over all conditions, both against bow: a tie on all 6 sequences." in printed


def test_long_names_take_more_tables_instead_of_wider_ones(two_conditions, capsys):
    runs = [
        run.model_copy(update={"system": "bow (orb.n_features=1000, tracking.method=patches)"})
        if run.system == "both"
        else run
        for run in two_conditions
    ]
    show(versus(summarize(Found(runs, []))), Console(width=80))
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80


def test_one_condition_is_not_called_all(two_conditions):
    runs = [run for run in two_conditions if run.drive.perturb == "none"]
    report = summarize(Found(runs, []))
    assert {c.perturb for c in report.comparisons} == {"none"}
    _, points = versus(report)[0].parts
    assert points.sentences[2].startswith("ATE, unperturbed images, both against bow: a tie")


def test_the_winner_is_who_has_the_smaller_errors(two_conditions):
    report = summarize(Found(two_conditions, []), "both")
    assert report.systems == ["both", "bow"]
    winners = {(c.perturb, c.measure): c.winner for c in report.comparisons}
    assert winners == {
        (perturb, measure): "both" if perturb != "none" and measure == "ate_rmse_m" else None
        for perturb in ("none", "brightness:1", ALL)
        for measure in ("ate_rmse_m", "rpe_m")
    }
    assert versus(report)[0].title == "Side by side: both / bow"


def test_every_system_stands_beside_its_baseline():
    runs = [entry(name, "00", 1.0) for name in ("none", "bow", "both")]
    mono = {"alignment": "sim3"}
    runs += [entry(name, "00", 1.0).model_copy(update=mono) for name in ("bow, mono", "both, mono")]
    runs.append(entry("alone", "01", 1.0))
    report = summarize(Found(runs, []), "bow")
    stereo, *others = versus(report)
    assert [stereo.title, *(section.title for section in others)] == [
        "Side by side: bow / none / both", "Side by side: bow, mono / both, mono", "alone",
    ]  # fmt: skip
    *tables, points = stereo.parts
    assert [len(table.head) for table in tables] == [2 + 3 * 3, 2 + 2 * 3]
    light = "brightness:1"
    assert points.sentences[1].startswith(f"ATE, {light}, none against bow: a tie")
    assert points.sentences[2].startswith(f"ATE, {light}, both against bow: a tie")
    with pytest.raises(
        InputError, match="--baseline capsule: there is no such run; choose from none, bow"
    ):
        summarize(Found(runs, []), "capsule")


def test_what_a_run_does_not_have_is_not_made_up():
    runs = [
        entry("bow", "00", None, **loops(1, 0)),
        entry("both", "00", 1.0),
        entry("bow", "01", 1.0),
    ]
    (section,) = versus(summarize(Found(runs, [])))
    table, points = section.parts
    assert table.rows[0][2:] == (
        "0", "n/a", "n/a", "1.000", "20.0", "n/a", "0.050", "n/a", "1 of 1", "n/a",
    )  # fmt: skip
    assert table.rows[1][2:5] == ("n/a", "n/a", "1.000")
    assert points.sentences[0] == "Lost frames: bow 0 in 1 run, both n/a in 1 run."
    assert len(points.sentences) == 2  # there is no comparison


@pytest.mark.parametrize(("ate", "part"), [(1.0, "cannot differ"), (1.5, "on shorter stretches")])
def test_drives_without_a_revisit_are_told_once(ate, part):
    runs = [
        entry(name, sequence, value, perturb=light, **loops(0, 0))
        for name, value in (("bow", 1.0), ("both", ate))
        for sequence in ("01", "03")
        for light in ("none", "fog:60")
    ]
    first, section = versus(summarize(Found(runs, [])))
    (sentence,) = first.parts
    assert sentence.startswith("No drive revisits a stretch of 20 m or more")
    assert part in sentence
    assert section.parts[0].rows[0][-2:] == ("-", "-")


def test_wrong_loops_stand_beside_those_found():
    counts = {**loops(1, 1), "loops_wrong": 2}
    (section,) = versus(summarize(Found([entry("bow", "00", 1.0, **counts)], [])))
    assert section.parts[0].rows[0][-1] == "1 of 2, 2 wrong"


def test_comparisons_that_tie_everywhere_are_left_out_of_the_differences(two_conditions):
    rows = table_of(summarize(Found(two_conditions, [])), "Differences").rows
    assert {(row[1], row[2]) for row in rows} == {("brightness:1", "ATE RMSE"), ("all", "ATE RMSE")}


def test_a_label_has_the_true_number_of_frames(run_folder: Path, tmp_path: Path):
    for most in (100, 500):
        copy_run(run_folder, tmp_path / str(most), max_frames=most, frames=100, seed=most)
    runs = collect([tmp_path], []).runs
    assert {run.drive.excerpt for run in runs} == {"100 frames"}


def thresholds_of(folder: Path, **values: object) -> None:
    config = {"orb": Config().orb.model_dump() | values}
    (folder / "config.json").write_text(json.dumps(config))


@pytest.fixture
def thresholds(run_folder: Path, tmp_path: Path) -> Path:
    """Runs with three sets of thresholds, one of which occurs twice.

    All runs also share the value of a further threshold.
    """
    for k, n in enumerate((2000, 1000, 1000, 1500)):
        folder = copy_run(
            run_folder, tmp_path / "runs" / str(k), detector="bow", seed=k, ate_rmse_m=1.0 + k
        )
        thresholds_of(folder, n_features=n, n_levels=7, retired=3)
    return tmp_path / "runs"


def test_thresholds_do_not_concern_other_systems(thresholds: Path):
    """Runs of other systems have no ``run.json``."""
    for folder in thresholds.iterdir():
        (folder / "run.json").unlink()
    assert {run.system for run in collect([thresholds], []).runs} == {"bow"}


def test_runs_of_different_thresholds_are_different_systems(thresholds: Path, tmp_path: Path):
    report = write_overview([thresholds], [], tmp_path / "out", baseline="bow")
    ates = {row.system: row.measures["ate_rmse_m"] for row in report.rows}
    assert {system: (ate.n, ate.median) for system, ate in ates.items() if ate} == {
        "bow": (1, 1.0), "bow (orb.n_features=1000)": (2, 2.5), "bow (orb.n_features=1500)": (1, 4),
    }  # fmt: skip
    assert [c.first for c in report.comparisons[:2]] == ["bow", "bow"]
    assert "all runs have orb.n_levels=7, orb.retired=3" in report.notes
    method = {"method": str(METHOD_VERSION)}
    assert report.runs[0].settings == {"orb.n_levels": 7, "orb.retired": 3} | method
    assert not any("method" in text for text in (*report.systems, *report.notes))
    for name in ("report.md", "report.html", "table.csv"):
        assert "bow (orb.n_features=1500)" in (tmp_path / "out" / name).read_text(), name
    other = summarize(collect([thresholds], []), "bow (orb.n_features=1500)")
    assert other.systems[0] == "bow (orb.n_features=1500)"


def test_versions_of_the_method_are_different_systems(run_folder: Path, tmp_path: Path):
    for version in ("1", "2"):
        copy_run(run_folder, tmp_path / version, detector="bow", versions={"method": version})
    assert summarize(collect([tmp_path], [])).systems == ["bow (method=1)", "bow (method=2)"]


def test_runs_of_other_systems_do_not_change_names(run_folder: Path, tmp_path: Path):
    copy_run(run_folder, tmp_path / "ours", detector="bow", mask="hood.png")
    other = copy_run(run_folder, tmp_path / "other", detector="orbslam3")
    (other / "run.json").unlink()
    assert summarize(collect([tmp_path], [])).systems == ["bow", "orbslam3"]


def test_options_that_change_results_make_systems_too(run_folder: Path, tmp_path: Path):
    for name, options in (("a", {}), ("b", {"weights": "mine.onnx"}), ("c", {"realtime": True})):
        copy_run(run_folder, tmp_path / name, detector="capsule", sensor="mono", **options)
    copy_run(run_folder, tmp_path / "d", detector="capsule", sensor="mono", threads=7)
    copy_run(run_folder, tmp_path / "e", detector="capsule", sensor="mono", mask="hood.png")
    calib = ["left.yaml", "right.yaml"]
    copy_run(run_folder, tmp_path / "f", detector="capsule", sensor="mono", calib=calib)
    rows = summarize(collect([tmp_path], [])).rows
    assert {row.system: row.runs for row in rows} == {
        "capsule, mono": 2, "capsule (weights=mine.onnx), mono": 1,
        "capsule (realtime=True), mono": 1, "capsule (mask=hood.png), mono": 1,
        "capsule (calib=left.yaml right.yaml), mono": 1,
    }  # fmt: skip


def test_thresholds_do_not_make_loop_detectors_differ():
    runs = [
        entry(f"bow{own}", "01", 1.0 + len(own), **loops(0, 0)) for own in ("", " (orb.n_levels=7)")
    ]
    assert [section.title for section in versus(summarize(Found(runs, [])))] == [
        "Side by side: bow / bow (orb.n_levels=7)"
    ]


@pytest.mark.parametrize("text", ["{", "[]", '{"orb": 3}', "[" * 9999])
def test_a_run_with_damaged_thresholds_is_left_out(thresholds: Path, text: str):
    (thresholds / "0" / "config.json").write_text(text)
    found = collect([thresholds], [])
    assert len(found.runs) == 3
    assert f"left out: {thresholds / '0'}: config.json is damaged" in found.notes


def test_changes_of_a_rendered_town_are_perturbations(run_folder: Path, tmp_path: Path):
    for name, perturb in (("05", "none"), ("05+change:0.5", "none"), ("05+change:1", "blur:1")):
        copy_run(run_folder, tmp_path / name, dataset="synthetic", sequence=name, perturb=perturb)
    drives = [run.drive for run in collect([tmp_path], []).runs]
    assert {drive.sequence for drive in drives} == {"05"}
    assert [drive.perturb for drive in drives] == ["none", "change:0.5", "change:1,blur:1"]
    assert list(strengths(drives, "change").values()) == [0.0, 0.5]


def test_a_name_is_never_a_formula(run_folder: Path, tmp_path: Path):
    copy_run(run_folder, tmp_path / "runs" / "one", sequence="$\\frac$")
    write_overview([tmp_path / "runs"], [], tmp_path / "out")
    assert re.search(r"<text[^>]*>[^<]*\$\\frac\$", (tmp_path / "out" / "report.html").read_text())


def test_a_drive_with_a_name_of_its_own_keeps_it(run_folder: Path, tmp_path: Path):
    for name in ("night", "night+moving:2"):
        copy_run(run_folder, tmp_path / name, dataset="synthetic", sequence=name, perturb="none")
    runs = collect([tmp_path], []).runs
    assert [(run.drive.sequence, run.drive.perturb, run.town) for run in runs] == [
        ("night", "none", 1), ("night", "moving:2", 1),
    ]  # fmt: skip


def test_towns_of_other_seeds_are_put_together_as_seeds_are(run_folder: Path, tmp_path: Path):
    for town, ate in (("05+change:0.5", 1.0), ("05+change:0.5+seed:1", 2.0), ("05+seed:2", 4.0)):
        copy_run(
            run_folder,
            tmp_path / town,
            dataset="synthetic",
            sequence=town,
            perturb="none",
            ate_rmse_m=ate,
            seed=3,
        )
    report = summarize(collect([tmp_path], []))
    found = {row.drive.perturb: row.measures["ate_rmse_m"] for row in report.rows}
    assert found["change:0.5"] == Spread(n=2, median=1.5, least=1.0, greatest=2.0)
    assert found["none"] == Spread(n=1, median=4.0, least=4.0, greatest=4.0)
    assert not any("towns" in note for note in report.notes)
    runs = table_of(report, "Runs")
    assert sorted(row[3] for row in runs.rows) == ["3", "3, town 1", "3, town 2"]


def test_medians_of_unlike_towns_are_noted(run_folder: Path, tmp_path: Path):
    for system, town in (("bow", "05"), ("bow", "05+seed:1"), ("capsule", "05+seed:1")):
        copy_run(
            run_folder, tmp_path / (system + town), dataset="synthetic", sequence=town,
            perturb="none", detector=system,
        )  # fmt: skip
    notes = summarize(collect([tmp_path], [])).notes
    assert any(
        note.endswith("none: systems ran in different towns (bow in 0, 1; capsule in 1)")
        for note in notes
    )


def test_a_report_of_an_unknown_town_is_left_out_with_a_note(run_folder: Path, tmp_path: Path):
    copy_run(run_folder, tmp_path / "known", dataset="synthetic", sequence="05", perturb="none")
    copy_run(run_folder, tmp_path / "odd", dataset="synthetic", sequence="05+fog", perturb="none")
    found = collect([tmp_path], [])
    assert [run.drive.sequence for run in found.runs] == ["05"]
    assert any(f"left out: {tmp_path / 'odd'}: " in note and "fog" in note for note in found.notes)


@pytest.fixture(scope="module")
def monocular(run_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = copy_run(
        run_folder, tmp_path_factory.mktemp("mono") / "mono", sensor="mono", detector="bow",
        perturb="none", alignment="sim3", ate_rmse_m=0.25,
    )  # fmt: skip
    truth = read_trajectory(folder / "ground_truth_kitti.txt", read_trajectory(
        folder / "trajectory.tum").timestamps)  # fmt: skip
    T_wc = truth.T_wc.copy()
    T_wc[:, :3, 3] *= 0.1
    write_kitti(folder / "trajectory_kitti.txt", T_wc)
    write_tum(folder / "trajectory.tum", Trajectory(truth.timestamps, T_wc))
    return folder


def test_monocular_runs_are_aligned_with_scale(monocular: Path):
    found = collect([monocular], [f"ORB-SLAM3={monocular / 'trajectory.tum'}"])
    assert [(run.system, run.alignment) for run in found.runs] == [
        ("bow, mono", "sim3"), ("ORB-SLAM3", "sim3"),
    ]  # fmt: skip
    aligned, truth = read_aligned(found, found.runs[0])
    assert truth is not None
    np.testing.assert_allclose(aligned.T_wc[:, :3, 3], truth.T_wc[:, :3, 3], atol=1e-4)
    ate = found.runs[1].measures["ate_rmse_m"]
    assert ate is not None
    assert ate < 1e-4
    errors = table_of(summarize(found), "Errors")
    column = errors.head.index("alignment")
    assert [row[column] for row in errors.rows] == ["Sim3", "Sim3"]


def test_different_alignments_are_not_compared(run_folder: Path, monocular: Path, tmp_path: Path):
    stereo = copy_run(run_folder, tmp_path / "stereo", detector="bow", perturb="none")
    estimate = monocular / "trajectory.tum"
    found = collect([stereo, monocular], [f"ORB-SLAM3, mono={estimate}", f"ORB-SLAM3={estimate}"])
    report = summarize(found)
    assert {run.system: run.alignment for run in report.runs} == {
        "bow": "se3", "bow, mono": "sim3", "ORB-SLAM3, mono": "sim3", "ORB-SLAM3": "se3",
    }  # fmt: skip
    assert {(c.first, c.second) for c in report.comparisons} == {
        ("bow", "ORB-SLAM3"), ("bow, mono", "ORB-SLAM3, mono"),
    }  # fmt: skip


def test_one_monocular_drive_does_not_hide_the_others():
    mono = {"alignment": "sim3"}
    runs = [
        entry("bow", "00", 1.0),
        entry("X", "00", 2.0),
        entry("bow, mono", "05", 1.0),
        entry("X", "05", 3.0),
    ]
    runs = [*runs[:2], *(run.model_copy(update=mono) for run in runs[2:])]
    rows = make_rows(runs)
    light = "brightness:1"
    stereo = compare(rows, "bow", "X", light, "ate_rmse_m")
    assert stereo is not None
    assert [pair.drive.sequence for pair in stereo.pairs] == ["00"]
    alone = compare(rows, "bow, mono", "X", light, "ate_rmse_m")
    assert alone is not None
    assert [pair.drive.sequence for pair in alone.pairs] == ["05"]


def test_csv_has_a_line_for_each_row(written):
    report, out = written
    lines = list(csv.DictReader((out / "table.csv").open()))
    assert len(lines) == len(report.rows)
    assert lines[0]["system"] == "none"
    assert float(lines[0]["ate_rmse_m"]) == float(lines[0]["ate_rmse_m_greatest"]) == 1.0
    assert {line["loops_found"] for line in lines if line["system"] == "ORB-SLAM3"} == {""}


FIGURES = {
    *(f"ate-{law}" for law in ("none", "brightness-0-5", "brightness-1")),
    *(f"strength-brightness-kitti-{name}" for name in ("00", "05")),
    *(f"path-kitti-{name}-{law}" for name in ("00", "05")
      for law in ("none", "brightness-0-5", "brightness-1")),
}  # fmt: skip


def test_runs_without_an_error_do_not_shift_the_median_that_is_drawn(monkeypatch):
    ates = (3.0, None, 1.0, 2.0, None)
    found = Found([entry("bow", "00", ate, seed) for seed, ate in enumerate(ates)], [])
    asked = []

    def no_trajectory(found: Found, run: RunEntry):
        asked.append(run.measures["ate_rmse_m"])
        raise InputError("no trajectory")

    monkeypatch.setattr(figures, "read_aligned", no_trajectory)
    figures.draw_overview(summarize(found), found)
    assert asked == [2.0]


def test_html_has_every_figure_and_loads_nothing(written):
    html = (written[1] / "report.html").read_text()
    assert set(re.findall('<figure class="card ([^"]*)"', html)) == FIGURES
    assert html.count("<table") == 8
    assert not re.search("<(script|iframe|object|embed|img)", html)


def test_the_page_links_the_page_of_each_run_that_has_one(run_folder: Path, tmp_path: Path):
    with_page = copy_run(run_folder, tmp_path / "runs" / "a: 100%")
    (with_page / "report.html").write_text("<h1>a</h1>")
    copy_run(run_folder, tmp_path / "runs" / "b")
    estimate = with_page / "trajectory_kitti.txt"
    write_overview([tmp_path / "runs"], [f"ORB-SLAM3={estimate}"], tmp_path / "made" / "out")
    text = (tmp_path / "made" / "out" / "report.html").read_text()
    links = re.findall(r'<a href="([^"]+)">', text)
    assert links == ["../../runs/a%3A%20100%25/report.html"]


_PROBE = """<!doctype html><link rel="icon" href="data:,"><body>
<iframe id="page" style="width:400px;height:900px;border:0"></iframe><pre id="found"></pre><script>
const page = document.getElementById("page");
page.onload = () => {
  const inner = page.contentDocument;
  const boxes = [...inner.querySelectorAll("figure")].map(x => x.getBoundingClientRect());
  document.getElementById("found").textContent = "FOUND" + JSON.stringify({
    shown: inner.documentElement.clientWidth,
    needed: inner.documentElement.scrollWidth,
    figures: boxes.map(box => [box.left, box.right, box.height]),
    drawings: [...inner.querySelectorAll("figure svg")].map(x => x.getBoundingClientRect().right),
    letters: Math.min(...[...inner.querySelectorAll("figure svg text")].map(x =>
      parseFloat(page.contentWindow.getComputedStyle(x).fontSize)
      * x.ownerSVGElement.clientWidth / x.ownerSVGElement.viewBox.baseVal.width)),
    paths: [...inner.querySelectorAll("figure svg path")].length,
    requests: page.contentWindow.performance.getEntriesByType("resource").map(x => x.name),
    scrolled: [...inner.querySelectorAll(".scroll")].map(x => x.scrollWidth - x.clientWidth),
    font: getComputedStyle(inner.querySelector("td")).fontSize,
  }) + "END";
};
page.src = "report.html";
</script>"""


@pytest.mark.slow
def test_report_in_a_browser_as_wide_as_a_phone(written, tmp_path: Path):
    """At a width of 400 px, all figures are drawn, and nothing is wider than the page.

    The page makes no network requests.
    """
    chromium()
    served = tmp_path / "served"
    served.mkdir()
    shutil.copy(written[1] / "report.html", served)
    (served / "probe.html").write_text(_PROBE)
    asked: list[str] = []

    text = dumped(
        served,
        "probe.html",
        tmp_path / "profile",
        milliseconds=8000,
        timeout=120,
        on_request=asked.append,
    )
    answer = re.search("FOUND(.*)END</pre>", text)
    assert answer, text[-4000:]
    found = json.loads(answer[1].replace("&amp;", "&"))
    assert max(found["scrolled"]) <= 1
    assert len(found["figures"]) == len(FIGURES)
    assert all(
        0 <= left < right <= 400 and height > 100 for left, right, height in found["figures"]
    )
    assert found["paths"] > 10 * len(FIGURES)
    assert max(found["drawings"]) <= 400
    assert found["letters"] >= 9
    assert found["needed"] <= found["shown"] <= 400
    assert found["requests"] == []
    assert sorted(set(asked)) == ["/probe.html", "/report.html"]
    assert float(found["font"].removesuffix("px")) >= 12


def test_command_line(runs: Path, tmp_path: Path, monkeypatch, capsys):
    runs = runs / "05-0-bow-0", runs / "05-0-none-0", runs / "stopped"
    words = ["vslam", "report", *runs, "--out", tmp_path / "made", "--trajectory"]
    words.append(f"ORB-SLAM3={runs[0] / 'trajectory.tum'}")
    monkeypatch.setattr(sys, "argv", list(map(str, words)))
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert not stop.value.code
    output = capsys.readouterr()
    assert f"{tmp_path / 'made' / 'report.html'}: 3 runs" in output.out
    for part in ("Side by side: none / bow / ORB-SLAM3", "Lost frames: none "):
        assert part in output.out
    assert "note: " in output.err
    # A report of many runs is not a run.
    assert len(collect([tmp_path / "made", *runs], []).runs) == 2
