"""The command line: fast help, clear errors with exit code 2, and how a run is set up."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import cv2
import numpy as np
import pytest
from test_report import make_outcome

from vslam.cli import main as cli
from vslam.cli import options
from vslam.cli import run as run_command
from vslam.config import PRESETS, as_config, changed_thresholds, thresholds_in_words
from vslam.datasets import open_sequence, png
from vslam.loopclosure.names import DETECTORS
from vslam.loopclosure.siamese.weights import NETWORKS
from vslam.report import figures
from vslam.report.folder import write_results
from vslam.report.run_page import option_rows
from vslam.report.schema import ReportJson
from vslam.run import pipeline as run_pipeline
from vslam.run import recorder, slam_run, warmup
from vslam.run.autosave import MAP
from vslam.run.moments import MomentRecorder
from vslam.run.options import RunOptions
from vslam.run.outcome import RunOutcome
from vslam.slam import Slam
from vslam.support import machine
from vslam.support.errors import InputError
from vslam.support.options import options_of
from vslam.types.features import TrackingState, TrackResult
from vslam.types.loops import LoopEdge
from vslam.types.trajectory import (
    Trajectory,
    read_kitti_poses,
    read_trajectory,
    write_euroc,
    write_kitti,
    write_tum,
)
from vslam_lab.cli import train

FRAMES = 12


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A KITTI sequence whose right camera lacks the last two frames."""
    data = tmp_path / "kitti"
    folder = data / "sequences" / "00"
    rng = np.random.default_rng(0)
    for side, count in (("image_0", FRAMES), ("image_1", FRAMES - 2)):
        (folder / side).mkdir(parents=True)
        for k in range(count):
            image = rng.integers(0, 256, (32, 64), dtype=np.uint8)
            cv2.imwrite(str(folder / side / f"{k:06d}.png"), image)
    (folder / "calib.txt").write_text(
        "P0: 50 0 30 0 0 50 16 0 0 0 1 0\nP1: 50 0 30 -25 0 50 16 0 0 0 1 0\n"
    )
    np.savetxt(folder / "times.txt", 0.1 * np.arange(FRAMES))
    (data / "poses").mkdir()
    write_kitti(data / "poses" / "00.txt", circle(FRAMES))
    return data


def circle(n: int) -> np.ndarray:
    T_wc = np.tile(np.eye(4), (n, 1, 1))
    T_wc[:, 0, 3], T_wc[:, 2, 3] = np.cos(0.3 * np.arange(n)), np.sin(0.3 * np.arange(n))
    return T_wc


NOT_UTF8 = os.fsdecode(b"dir\xff")


def test_names_that_are_not_utf8_are_refused(call, kitti_tree, tmp_path):
    said = (2, "", "error: dir\ufffd: this name is not UTF-8; rename it.\n")
    assert call("run", "--data", kitti_tree, "--out", NOT_UTF8) == said
    assert call("doctor", NOT_UTF8) == said
    shutil.copytree(kitti_tree / "sequences" / "00" / "image_0", tmp_path / "images")
    (tmp_path / "images" / f"{NOT_UTF8}.png").write_bytes(b"damaged")
    folder = tmp_path / NOT_UTF8
    folder.mkdir()
    (folder / "report.json").write_text("{}")
    for command in (("run", "images", "--fps", 10), ("report", ".")):
        code, _, err = call(*command)
        assert (code, err.count("\n")) == (2, 1)
        assert "dir\ufffd" in err
        assert err.endswith("this name is not UTF-8; rename it.\n")


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        [],
        ["run"],
        ["eval"],
        ["perturb"],
        ["info"],
        ["vocabulary", "train"],
        ["bench"],
        ["report"],
        ["export", "colmap"],
        ["map", "info"],
    ],
)
def test_help_loads_nothing_heavy(command):
    script = (
        "import sys\n"
        f"sys.argv = ['vslam', *{command!r}, '--help']\n"
        "from vslam.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as stop:\n    assert not stop.code\n"
        "heavy = ('numpy', 'numba', 'cv2', 'evo', 'rerun', 'matplotlib', 'scipy', 'torch',\n"
        "         'gtsam', 'pandas', 'distributed')\n"
        "loaded = [name for name in heavy if name in sys.modules]\n"
        "assert not loaded, loaded\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "Usage" in done.stdout


def test_version(call):
    assert call("--version") == (0, "0.1.0\n", "")


def refused(result: tuple[int, str, str], *parts: str) -> None:
    code, out, err = result
    assert code == 2
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    for part in parts:
        assert part in err


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("--detector capsule --weights no.safetensors", ["no.safetensors", "no such file"]),
        ("--detector none --weights no.npz", ["--weights", "'none' has no weights"]),
        ("--detector bow --weights no.npz", ["--weights no.npz", "vocabulary"]),
        ("--dataset synthetic --seq 77", ["synthetic route 77", "choose one of demo"]),
        ("--dataset kitti", ["data/kitti", "cvlibs.net", "--data", "$KITTI_ROOT"]),
        ("--config nothing.json", ["nothing.json", "no file or preset"]),
        ("--config fats", ["did you mean fast?", "the presets are: fast"]),
        ("--compare none --detector none", ["--compare none", "give another"]),
        ("--keep-open --view native", ["--keep-open: only for --view web"]),
        ("--compare both,bow --detector bow", ["--compare bow", "give another"]),
        ("--compare bow,words --detector none", ["--compare words", "unknown; choose one of"]),
        ("--data nowhere", ["nowhere", "no such file or folder", "--data"]),
        ("--data .", ["the folder is empty", "--data"]),
        ("nowhere", ["nowhere", "no such file or folder", "--data"]),
        ("nowhere --data .", ["nowhere: data is also given with --data"]),
        ("--data other", ["not a known data set", "sequences", "mav0", "rgb.txt"]),
        ("--data 77 --sensor mono", ["camera 77", "no such device"]),
        ("--dataset images --data . --fps 0", ["--fps 0", "positive"]),
        ("--dataset kitti --topics /a,/b", ["--topics", "only for --dataset bag"]),
    ],
)
def test_run_refuses_without_data(call, words, parts, tmp_path):
    if "other" in words:
        (tmp_path / "other").mkdir()
        (tmp_path / "other" / "notes.txt").write_text("nothing to run on")
    refused(call("run", *words.split()), *parts)
    assert not Path("runs").exists()


@pytest.mark.parametrize("command", ["run", "bench", "stress", "doctor", "perturb"])
def test_a_bare_command_without_data_says_what_to_do(call, command):
    code, out, err = call(command)
    assert (code, out) == (2, "")
    assert err.startswith("error: there is no data to read; ")
    ways = [line.strip().split("  ")[0] for line in err.splitlines()[1:]]
    assert ways == ["--dataset synthetic", "DATA --calib FILE", "--data FOLDER"]
    assert not any(Path().iterdir())


def test_the_environment_names_kitti_alone(call, root, monkeypatch):
    monkeypatch.setenv("KITTI_ROOT", str(root))
    refused(call("run"), "unequal counts")
    refused(call("doctor", "--dataset", "euroc"), "--dataset euroc: give the data with --data")


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("run --detector orb", ["--detector", "'orb'", "'bow'"]),
        ("run --sensor lidar", ["--sensor", "'lidar'", "'stereo'", "'mono'"]),
        ("run --dataset nuscenes", ["--dataset", "'nuscenes'", "'kitti'"]),
        ("bench --dataset nuscenes", ["--dataset", "'nuscenes'", "'kitti'"]),
        ("perturb --dataset nuscenes", ["--dataset", "'nuscenes'", "'kitti'"]),
        ("eval gt.txt --gt gt.txt --align x", ["--align", "'x'", "'se3'", "'sim3'"]),
        ("train alexandria --data photos:x", ["'alexandria'", "'capsule'", "'capsule-paper'"]),
        ("train capsule --data photos:x --preset worst", ["--preset", "'worst'", "'paper'"]),
        ("train capsule --data photos:x --device tpu", ["--device", "'tpu'", "'cuda'"]),
        ("export places --data photos:x --fit best", ["--fit", "'best'", "'squash'"]),
    ],
)
def test_choices_are_checked_by_the_parser(call, words, parts):
    code, out, err = call(*words.split())
    assert (code, out) == (2, "")
    for part in parts:
        assert part in err


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("run --perturb brigthness:1", "brightness"),
        ("run --perturb Fog", "fog"),
        ("run --detector capsul", "capsule"),
        ("run --dataset kiti", "kitti"),
        ("run --dataset synthetic --seq dmo", "demo"),
        ("perturb --dataset eurok", "euroc"),
        ("train capsul --data photos:x", "capsule"),
        ("stress --laws rian", "rain"),
        ("loops bench --detectors capsle", "capsule"),
        ("loops bench --perturb blurr:0.5", "blur"),
        ("bench --detectors capsul", "capsule"),
        ("run --compare bwo --detector none", "bow"),
        ("stress --systems orbslm3", "orbslam3"),
        ("stress --baseline boht", "both"),
        ("synth dmo", "demo"),
        ("loops bench --data ptohos:x", "photos"),
    ],
)
def test_a_misspelt_name_is_told_which_one_may_be_meant(call, root, words, meant):
    command, *rest = words.split()
    data = ["--data", root] if "--dataset" not in words and command in ("run", "stress") else []
    more = ["--max-frames", 5] if data else []
    code, _, err = call(command, *rest, *data, *more)
    assert code == 2
    assert f"(did you mean {meant}?)" in " ".join(err.replace("│", " ").split())
    assert "Value error" not in err


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("run --start -3", "'--start': must be at least 0"),
        ("run --seed x", "'--seed': must be a whole number"),
        ("run --fps x", "'--fps': must be a number"),
    ],
)
def test_a_value_out_of_range_is_told_in_our_words(call, words, part):
    code, _, err = call(*words.split())
    assert code == 2
    assert f"Invalid value for {part} " in err


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ('{"orb": {"n_feature": 500}}', "orb.n_feature: unknown key (did you mean n_features?)"),
        ('{"n_features": 500}', "n_features: unknown key (did you mean orb.n_features?)"),
        ('{"orb": {"n_features": -1}}', "orb.n_features: must be at least 100."),
        ('{"orb.n_features": -1}', "orb.n_features: must be at least 100."),
        ('{"orb": 5}', "orb must map names to values"),
        ("[]", "the configuration must map names to values"),
        ("orb:\n  n_features: 900\n", "the configuration is not JSON (expected value at line 1 "),
        (
            '{"orb": {\n "n_features": 900,\n}}',
            "the configuration is not JSON (trailing comma at l",
        ),
    ],
)
def test_a_wrong_configuration_is_told_in_our_words(call, text, part):
    Path("config.json").write_text(text)
    refused(call("run", "--config", "config.json", "--data", "."), f"config.json: {part}")


def test_thresholds_are_given_as_values_too(call, tmp_path):
    found = options.read_thresholds("orb.n_features=1000, tracking.method=patches")
    assert (found.orb.n_features, found.tracking.method) == (1000, "patches")
    refused(call("run", "--config", "orb.n_feature=9", "--data", "."), "(did you mean n_features?)")
    file = tmp_path / "a=b.json"
    file.write_text('{"tracking.method": "patches"}')
    assert options.read_thresholds(str(file)).tracking.method == "patches"


def test_a_preset_sets_several_thresholds_and_later_values_replace_its_own():
    for name, thresholds in PRESETS.items():
        assert changed_thresholds(options.read_thresholds(name).model_dump()) == thresholds
        assert as_config(name) == options.read_thresholds(name)
    many = ",".join(["orb.n_features=800"] * 30)  # longer than the name of a file may be
    assert options.read_thresholds(many).orb.n_features == 800
    found = options.read_thresholds("fast, orb.n_features=900")
    assert found.orb.n_features == 900
    assert found.mapping.neighbours == PRESETS["fast"]["mapping.neighbours"]
    assert options.read_thresholds("orb.n_features=900,fast") == as_config("fast")
    changed = changed_thresholds(options.read_thresholds("fast,orb.n_levels=7").model_dump())
    assert thresholds_in_words(changed) == "preset=fast, orb.n_levels=7"
    changed = changed_thresholds(found.model_dump())
    assert thresholds_in_words(changed).startswith("orb.n_features=900")
    with pytest.raises(InputError, match="no preset 'slow'"):
        as_config("slow")


def commands(group: Any, words: str = "vslam") -> Iterator[tuple[str, Any]]:
    for name, found in group.commands.items():
        if hasattr(found, "commands"):
            yield from commands(found, f"{words} {name}")
        elif not found.hidden:
            yield f"{words} {name}", found


def test_every_option_has_a_placeholder_and_a_sentence_that_describes_it():
    from typer.main import get_command

    for words, command in commands(get_command(cli.every_command())):
        for one in command.params:
            assert (one.help or "").endswith("."), f"{words}: {one.name}"
            needs = one.param_type_name == "option" and not one.is_flag
            assert not needs or one.metavar, f"{words}: {one.name}"


def test_the_help_of_resume_names_the_options_that_can_be_given_with_it():
    from typer.main import get_command

    options = {
        one.name: one
        for one in dict(commands(get_command(cli.every_command())))["vslam run"].params
    }
    named = set(re.findall(r"--[a-z-]+", options["resume"].help))
    assert named == {options[name].opts[0] for name in run_command._WITH_RESUME - {"resume"}}


def test_help_is_grouped_and_short(call, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = call("run", "--help")
    assert code == 0
    assert re.findall(r"^╭─ (\w+) ", out, re.M) == [
        "Input", "Method", "Map", "Execution", "Output",
    ]  # fmt: skip
    assert len(out.splitlines()) <= 115
    assert "<" not in out + call("--help")[1] + call("map", "--help")[1]  # types
    assert "│ --map FILE|FOLDER " in out
    assert "First frame. [default: 0]" in out


def test_perturbations_are_listed(call):
    code, out, _ = call("perturb", "--list")
    assert code == 0
    listed = [line.split()[0] for line in out.splitlines()[2:] if line.strip()]
    assert listed[:2] == ["brightness", "gamma"]
    assert len(listed) > 25


def test_the_doctor_keeps_the_page_of_an_earlier_visit(call):
    pages = [call("doctor", "nowhere")[1].splitlines()[-1] for _ in range(3)]
    assert pages == ["doctor.html: 1 fault", "doctor-2.html: 1 fault", "doctor-3.html: 1 fault"]
    call("doctor", "nowhere", "--out", "doctor.html")
    assert len(list(Path().iterdir())) == 3


def test_a_name_like_no_other_is_told_of_none(call):
    assert "did you mean" not in call("run", "--dataset", "synthetic", "--seq", "77")[2]


def test_the_choices_of_detectors_are_those_of_the_registry():
    assert dict(options_of(RunOptions))["detector"].choices() == DETECTORS
    assert get_args(train.NetworkName) == NETWORKS


def test_the_choices_of_presets_are_those_of_the_settings():
    from vslam_lab.training.settings import PRESETS

    assert set(get_args(train.PresetName)) == set(PRESETS)


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("--seq 05", ["no such sequence", "00"]),
        ("", ["unequal counts", "--max-frames 10"]),
        ("--max-frames 5 --perturb snow", ["unknown law 'snow'", "brightness"]),
        ("--max-frames 5 --start 99", ["--start 99"]),
        ("--max-frames 5 --out kitti/poses/00.txt", ["cannot create a run folder", "--out"]),
    ],
)
def test_run_refuses_bad_input(call, root, words, parts, monkeypatch):
    monkeypatch.setattr("vslam.run.warmup.is_cold", lambda: False)  # prints no message
    refused(call("run", "--data", root, *words.split()), *parts)
    assert not Path("runs").exists()


def test_misspelt_option(call):
    code, _, err = call("run", "--frames", "5")
    assert code == 2
    assert "No such option" in err
    assert "--max-frames" in err


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("eval --seq 00", ["vslam eval takes RUN|FILE: Folder of a run", "are --gt, --align,"]),
        ("report --data runs", ["vslam report takes FOLDER...: Folders of runs", "--trajectory"]),
        ("info --seq 00", ["No such option: --seq. Its options are --data"]),
    ],
)
def test_an_option_that_only_other_commands_have(call, words, parts):
    code, _, err = call(*words.split())
    assert code == 2
    text = " ".join(err.replace("│", " ").split())
    assert all(part in text for part in parts)


def shaken(trajectory: Trajectory) -> Trajectory:
    """Move every other pose by 0.2 m, which gives an ATE of 0.1 m."""
    T_wc = trajectory.T_wc.copy()
    T_wc[::2, 1, 3] += 0.2
    return replace(trajectory, T_wc=T_wc)


def fake_result(index: int, T_wc: np.ndarray) -> TrackResult:
    state = TrackingState.LOST if index == 3 else TrackingState.OK
    return TrackResult(index, 0.1 * index, T_wc, state, 9, 9, 9, 9, False)


@pytest.fixture
def pipeline(monkeypatch) -> SimpleNamespace:
    """A replacement of SLAM that returns a shifted ground truth and records its arguments."""
    calls = SimpleNamespace(interrupted=None, loops=[], lost=False)

    def run_sequence(run, perturbation, recorder, on_frame, autosave=None):
        sequence, settings = run.source, run.settings
        T_wc = circle(len(sequence))  # the ground truth, if there is one
        T_wc[:, 1, 3] += 2.0
        tracks = [fake_result(k, T_wc[k]) for k in range(len(sequence))]
        if calls.lost:
            tracks = [replace(track, state=TrackingState.LOST) for track in tracks]
        for track in tracks:
            on_frame(track)
        trajectory = Trajectory(sequence.timestamps, T_wc)
        compared = [
            run_sequence(begin(sequence, one), perturbation, recorder, lambda track: None)
            for name in settings.compare
            for one in [settings.model_copy(update={"detector": name, "compare": ()})]
        ]
        calls.settings, calls.recorder = settings, recorder
        if calls.interrupted:
            (Path("runs/latest") / MAP).touch()
        return RunOutcome(
            settings, sequence, trajectory, trajectory, tracks, [], wall_s=2.0, cpu_s=2.0,
            startup_s=0.1, peak_memory_mb=1.0, n_keyframes=4, n_landmarks=99,
            loops=calls.loops if settings.detector != "none" else [],
            keyframe_frames=np.arange(0, len(sequence), 3),
            n_submaps=2, interrupted=calls.interrupted, step_s=1.5,
            compared=tuple(replace(one, trajectory=shaken(one.trajectory)) for one in compared),
        )  # fmt: skip

    def begin(source, settings, resume=None):
        return SimpleNamespace(source=source, settings=settings)

    def draw_figures(outcome, evaluation, verdict):
        calls.evaluation, calls.outcome = evaluation, outcome
        return []  # drawing takes a second

    monkeypatch.setattr(run_pipeline, "run_sequence", run_sequence)
    monkeypatch.setattr(slam_run, "begin", begin)
    monkeypatch.setattr(recorder, "Recorder", lambda: "null")
    monkeypatch.setattr(recorder, "RerunRecorder", lambda target, pictures: str(target))
    monkeypatch.setattr(recorder, "SeveralRecorders", lambda recorders: recorders[1])
    monkeypatch.setattr(figures, "draw_figures", draw_figures)
    monkeypatch.setattr(warmup, "is_cold", lambda: False)
    monkeypatch.setattr(warmup.Compilation, "finish", lambda self: None)
    return calls


def test_run_writes_its_folder_and_a_summary(call, root, pipeline):
    code, out, err = call(
        "run", "--data", root, "--max-frames", 10, "--perturb", "blur:0.5", "--threads", 3
    )
    assert code == 0, err
    assert re.search("Lost frames +1 +10.0 % of 10; 0 weak, 0 skipped", out)
    assert "5.0 fps" in out
    assert "report.html" in out
    assert "10/10" in err
    folder = Path("runs/latest").resolve()
    assert folder.name.endswith("-kitti-00-blur0.5-both")
    assert pipeline.settings.threads == 3
    assert pipeline.settings.perturb == "blur:0.5"
    assert pipeline.recorder == str(Path("runs") / folder.name / "recording.rrd")
    assert pipeline.evaluation.ate_rmse_m < 1e-9
    assert len(read_kitti_poses(folder / "ground_truth_kitti.txt")) == 10


def test_changed_thresholds_are_in_the_name_of_the_folder_and_the_summary(call, root, pipeline):
    config = "orb.n_features=1000,orb.n_levels=7,tracking.method=orb,depth.min_metres=0.5"
    code, out, err = call("run", "--data", root, "--max-frames", 10, "--config", config)
    assert code == 0, err
    assert (
        "· thresholds orb.n_features=1000, orb.n_levels=7, depth.min_metres=0.5, 1 more in" in out
    )
    folder = Path("runs/latest").resolve()
    assert folder.name.endswith("-kitti-00-none-both-orb.n_features=1000+3more")
    report = ReportJson.read(folder / "report.json")
    assert report.thresholds["tracking.method"] == "orb"
    row = dict(option_rows(report))["thresholds"]
    assert row == ", ".join(f"{name}={value}" for name, value in report.thresholds.items())
    assert "thresholds" not in dict(option_rows(report.model_copy(update={"thresholds": {}})))


def test_a_map_is_continued_with_its_own_thresholds_by_default(call, root, pipeline):
    camera = open_sequence("kitti", root, "00", max_frames=10).camera
    Slam(camera, {"orb.n_features": 900}, "none", threads=1).save("map.npz")
    words = ("run", "--data", root, "--max-frames", 10, "--map", "map.npz")
    for given, n in (((), 900), (("--config", "orb.n_features=800"), 800)):
        code, _, err = call(*words, *given)
        assert code == 0, err
        assert pipeline.settings.thresholds.orb.n_features == n


CLOSED = LoopEdge(3, 0, 0.6, True, "closed", 80, 60)  # no pose, so it is not judged
REJECTED = LoopEdge(2, 0, 0.2, False, "too few matches")


@pytest.fixture
def with_detector(pipeline) -> SimpleNamespace:
    pipeline.loops = [CLOSED, REJECTED, REJECTED]
    return pipeline


def test_summary_counts_loops(call, root, with_detector):
    code, out, err = call("run", "--data", root, "--max-frames", 10, "--detector", "bow")
    assert code == 0, err
    assert re.search("Loops +1 closed .* no stretch .*, 0 wrong, 2 candidates rejected\n", out)
    assert re.search("Map +99 +landmarks, .* 2 sub-maps", out)
    assert "detector bow (the bag of words)" in out
    assert "detectors together" not in out
    (root / "poses" / "00.txt").unlink()
    _, out, _ = call("run", "--data", root, "--max-frames", 10, "--detector", "bow")
    assert re.search("Loops +1 closed +2 candidates rejected", out)


def test_summary_without_a_detector(call, root, pipeline):
    _, out, _ = call("run", "--data", root, "--max-frames", 10, "--detector", "none")
    assert re.search("Loops +off +no detector; the drive revisits no stretch", out)


def detectors_in(out: str) -> list[list[str]]:
    """Return the cells of the table of detectors that a run prints. The first row is the head."""
    table = out.split("Detectors\n\n")[1].split("\n\n")[0]
    head, _, *rows = [re.split(r"  +", line.strip()) for line in table.splitlines()]
    return [head, *rows]


def test_compare_prints_a_row_for_each_detector(call, root, with_detector):
    words = ("run", "--data", root, "--max-frames", 10, "--detector", "bow")
    code, out, err = call(*words, "--compare", "both, none,none")
    assert code == 0, err
    assert with_detector.settings.compare == ("both", "none")
    assert re.search("5.0 fps .* 3 detectors together", out)
    head, *rows = detectors_in(out)
    assert head == [
        "detector", "lost", "ATE", "causal ATE", "RPE", "RPE rotation",
        "loops found", "missed", "wrong", "time",
    ]  # fmt: skip
    assert [row[0] for row in rows] == ["bow", "both", "none"]
    assert rows[0][1:3] == ["1", "0.000 m"]
    assert [float(row[2].split()[0]) for row in rows[1:]] == pytest.approx([0.1, 0.1], rel=0.02)
    assert {row[-1] for row in rows} == {"1.5 s"}
    folder = Path("runs/latest").resolve()
    assert folder.name.endswith("-bow")
    assert json.loads((folder / "run.json").read_text())["compare"] == ["both", "none"]
    assert len(read_trajectory(folder / "trajectory_both.tum")) == 10
    assert (folder / "trajectory_none.tum").is_file()


def test_compare_without_ground_truth_counts_the_loops_closed(call, root, with_detector):
    (root / "poses" / "00.txt").unlink()
    words = ("run", "--data", root, "--max-frames", 10, "--detector", "bow", "--compare", "none")
    head, *rows = detectors_in(call(*words)[1])
    assert head == ["detector", "lost", "loops closed", "time"]
    assert rows == [["bow", "1", "1", "1.5 s"], ["none", "1", "0", "1.5 s"]]
    with_detector.interrupted = "Ctrl-C"
    code, out, _ = call(*words)
    assert code == 1
    assert detectors_in(out)[-1][-2:] == ["1.5 s", "Ctrl-C"]


@pytest.mark.parametrize(
    ("detector", "other"),
    [("bow", "both"), ("none", "both"), ("both", "bow"), ("capsule", "bow")],
)
def test_the_last_line_says_how_to_compare(call, root, pipeline, detector, other):
    words = ("run", "--data", root, "--max-frames", 10, "--detector", detector)
    last = call(*words)[1].splitlines()[-1]
    assert last.split()[:4] == ["compare", "add", "--compare", other]
    assert call(*words, "--quiet")[1] == ""
    assert "add --compare" not in call(*words, "--compare", other)[1]
    (root / "poses" / "00.txt").unlink()
    assert "add --compare" not in call(*words)[1]


def test_a_monocular_run_says_that_its_scale_is_arbitrary(call, root, pipeline):
    code, out, err = call("run", "--data", root, "--sensor", "mono")
    assert code == 0, err
    assert "Scale" in out
    assert "arbitrary" in out
    assert pipeline.evaluation.alignment == "sim3"
    assert pipeline.outcome.sequence.camera.monocular
    _, out, _ = call("run", "--data", root, "--max-frames", 10)
    assert "arbitrary" not in out
    assert pipeline.evaluation.alignment == "se3"


def test_quiet_run_says_nothing(call, root, pipeline):
    assert call("run", "--data", root, "--max-frames", 10, "--no-record", "--quiet") == (0, "", "")
    assert isinstance(pipeline.recorder, MomentRecorder)  # not a file


def test_a_run_without_recording_and_report_keeps_no_images(call, root, pipeline):
    words = ("--max-frames", 10, "--no-record", "--no-report")
    assert call("run", "--data", root, *words)[0] == 0
    assert pipeline.recorder == "null"


def test_clip_too_short_to_evaluate_is_reported_all_the_same(call, root, pipeline):
    code, out, _ = call("run", "--data", root, "--max-frames", 1)
    assert code == 0
    assert pipeline.evaluation is None
    assert "too little motion" in out


def test_interrupted_run_keeps_its_results(call, root, pipeline):
    pipeline.interrupted = "Ctrl-C"
    code, out, _ = call("run", "--data", root, "--max-frames", 10)
    assert code == 1
    assert "Interrupted: Ctrl-C. The results cover the 10 frames before that." in out
    folder = Path("runs") / Path("runs/latest").readlink()
    assert (folder / "trajectory.tum").is_file()
    assert f"\ncontinue  vslam run --resume {folder}\n" in out


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("", "vslam doctor checks images"),
        ("--perturb night:9", "under --perturb night:9; a weaker perturbation"),
        ("--sensor mono", "a single camera must move sideways"),
    ],
)
def test_a_run_that_tracked_nothing_exits_with_1_and_says_why(call, root, pipeline, words, why):
    pipeline.lost = True
    command = ("run", "--data", root, "--max-frames", 10, *words.split())
    code, out, err = call(*command)
    assert (code, "error" in err) == (1, False)
    assert "nothing was tracked in 10 frames" in out
    assert why in " ".join(out.split())
    code, out, err = call(*command, "--quiet")
    assert (code, out) == (1, "")
    assert err.startswith("error: nothing was tracked in 10 frames")
    assert why in err


def test_eval(call, tmp_path):
    T_wc = circle(50)
    write_kitti(tmp_path / "gt.txt", T_wc)
    T_wc[:, 1, 3] += np.tile([0.1, -0.1], 25)
    write_kitti(tmp_path / "estimate.txt", T_wc)
    code, out, _ = call("eval", "estimate.txt", "--gt", "gt.txt")
    assert code == 0
    assert "50 of 50 have a ground truth" in out
    assert "0.1000 m" in out
    assert "evo_ape kitti gt.txt estimate.txt --align\n" in out
    code, out, _ = call("eval", "estimate.txt", "--gt", "gt.txt", "--json")
    assert json.loads(out)["ate_rmse_m"] == pytest.approx(0.1, rel=1e-3)


def test_eval_warns_of_a_ground_truth_that_cannot_be_right(call, tmp_path):
    t = 0.1 * np.arange(50)
    T_wc = circle(50)
    T_wc[:, 1, 3] = np.sin(t)
    write_euroc(tmp_path / "estimate.csv", Trajectory(t, T_wc))
    for factors, says in (
        ([1.0, -1.0, 1.0], "Warning: the ground truth is a mirror image of the trajectory"),
        ([2.0, 2.0, 2.0], "Warning: the trajectory is 0.5 times as large as the ground truth"),
        ([1.0, 1.0, 1.0], ""),
    ):
        truth = T_wc.copy()
        truth[:, :3, 3] *= factors
        write_euroc(tmp_path / "gt.csv", Trajectory(t, truth))
        code, out, err = call("eval", "estimate.csv", "--gt", "gt.csv")
        assert code == 0, err
        assert says in out
        assert ("Warning" in out) == bool(says)
        warnings = json.loads(call("eval", "estimate.csv", "--gt", "gt.csv", "--json")[1])[
            "warnings"
        ]
        assert len(warnings) == bool(says)


def test_eval_of_two_formats_names_no_evo_command(call, tmp_path):
    truth = Trajectory(0.1 * np.arange(50), circle(50))
    write_kitti(tmp_path / "gt.txt", truth.T_wc)
    write_tum(tmp_path / "estimate.tum", truth)
    np.savetxt(tmp_path / "times.txt", truth.timestamps)
    code, out, err = call("eval", "estimate.tum", "--gt", "gt.txt", "--times", "times.txt")
    assert code == 0, err
    assert "50 of 50 have a ground truth" in out
    assert "evo_ape" not in out  # evo only compares files of the same format


@pytest.mark.parametrize("sensor", ["stereo", "mono"])
def test_eval_of_a_run(call, tmp_path, sensor):
    scale = 1.0 if sensor == "stereo" else 3.0
    outcome = make_outcome(60)
    camera = outcome.sequence.camera
    camera = camera if sensor == "stereo" else camera.left_camera()
    T_wc = outcome.trajectory.T_wc.copy()
    T_wc[:, :3, 3] *= scale
    outcome = replace(
        outcome,
        sequence=replace(outcome.sequence, camera=camera),
        trajectory=replace(outcome.trajectory, T_wc=T_wc),
    )
    run = tmp_path / "run"
    run.mkdir()
    report = write_results(run, outcome, pages=False)
    truth = Trajectory(outcome.sequence.timestamps, outcome.sequence.ground_truth)
    write_tum(tmp_path / "gt.tum", truth)
    np.savetxt(tmp_path / "times.txt", truth.timestamps)
    for words in (
        (),
        ("--gt", "gt.tum"),
        ("--gt", run / "ground_truth_kitti.txt"),
        ("--gt", run / "ground_truth_kitti.txt", "--times", "times.txt"),
    ):
        code, out, err = call("eval", run, *words, "--json")
        assert code == 0, err
        assert json.loads(out)["ate_rmse_m"] == pytest.approx(report.ate_rmse_m, rel=1e-6)
    imu = tmp_path / "state_groundtruth_estimate0/data.csv"
    imu.parent.mkdir()
    write_euroc(imu, truth)
    assert "has the poses of the IMU" in call("eval", run, "--gt", imu)[1]
    (run / "ground_truth_kitti.txt").unlink()
    refused(call("eval", run), "no ground truth", "--gt")


def test_eval_refusals(call, tmp_path):
    write_kitti(tmp_path / "gt.txt", circle(50))
    refused(call("eval", "nothing.txt", "--gt", "gt.txt"), "nothing.txt", "cannot read")
    refused(call("eval", "drive.mp4"), "drive.mp4", "--gt", "vslam run")
    refused(call("eval", tmp_path), str(tmp_path), "folder of a run")


def test_perturb_writes_a_contact_sheet(call, root):
    words = ("perturb", "--data", root, "--max-frames", 10, "--frames", 3)
    code, out, _ = call(*words, "--out", "sheet.png")
    assert code == 0
    assert "frames 0, 4, 9" in out
    _, later, _ = call(*words[:-4], "--start", 5, "--every", 2, "--max-frames", 2, "--frames", 2)
    assert "frames 5, 7" in later
    assert cv2.imread("sheet.png").shape[0] == 3 * (240 + 30)
    refused(call(*words, "--out", "no/folder/sheet.png"), "no/folder/sheet.png", "--out")


def test_info(call, root):
    code, out, _ = call("info", "--data", root)
    assert code == 0
    assert "12 left, 10 right images" in out
    for package in ("vslam", "numpy", "numba", "evo", "rerun-sdk", "opencv", "cores"):
        assert package in out
    code, out, _ = call("info", "--data", "nowhere")
    assert code == 0
    assert "nowhere: holds no KITTI odometry data" in out


@pytest.mark.skipif("NUMBA_CACHE_DIR" in os.environ, reason="kernels are cached elsewhere")
def test_info_lists_the_compiled_kernels_of_subfolders(call):
    encoded = cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1]
    assert png.decode_png(encoded.tobytes()) is not None  # compiles the kernels of the folder
    folder = Path(png.__file__).parent / "__pycache__"
    assert f"{folder}: " in call("info", "--data", "nowhere")[1]


def test_two_opencv_wheels_are_noticed():
    assert machine.opencv_conflict({"numpy": "2", "opencv-python-headless": "5"}) is None
    warning = machine.opencv_conflict({"opencv-python": "5", "opencv-python-headless": "5"})
    assert "opencv-python and opencv-python-headless" in warning


def test_defects_are_not_dressed_up_as_bad_input(call, monkeypatch):
    def broken() -> None:
        raise ZeroDivisionError("no frames")

    monkeypatch.setattr(cli, "every_command", lambda: broken)
    code, _, err = call("info")
    assert code == 1
    assert "no frames: this is a fault of vslam or of the machine; please report it" in err
