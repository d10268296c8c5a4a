"""The package of docs/howto/plugins.md is installed and used. Broken packages are rejected."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from source_files import open_from

from vslam.cli import main as cli
from vslam.config import Config
from vslam.datasets import open_sequence
from vslam.datasets.perturbation import Perturbation, parse_perturbation
from vslam.loopclosure.registry import create_detector, problem_of, require_detector
from vslam.report.folder import create_run_folder, write_results
from vslam.run.options import RunOptions, read_options
from vslam.run.pipeline import run_sequence
from vslam.run.recorder import Recorder
from vslam.run.slam_run import begin
from vslam.support import plugins
from vslam.support.errors import BrokenSourceError, InputError, UnreadableImageError
from vslam.types.features import Features
from vslam.types.map import Map

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "howto" / "plugins.md"
MODULES = ("vslam_example", "broken")
NO_FEATURES = Features(
    np.zeros((0, 2), np.float32),
    np.zeros(0, np.uint8),
    np.zeros(0, np.float32),
    np.zeros((0, 32), np.uint8),
    np.zeros(0, np.float32),
)


def written_package(folder: Path) -> Path:
    """The package as the page shows it."""
    text = PAGE.read_text()
    folder.mkdir()
    blocks = re.findall(r"```(toml|python)\n# (\S+)\n(.*?)```", text, re.DOTALL)
    for _, name, code in blocks:
        with (folder / name).open("a") as file:
            file.write(code)
    return folder


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which pip installed the package of the page, without a network."""
    root = tmp_path_factory.mktemp("plugins")
    package = written_package(root / "package")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    command += ["--no-build-isolation", "--target", str(root / "site"), str(package)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return root / "site"


@pytest.fixture
def installed(target: Path, monkeypatch) -> Path:
    monkeypatch.syspath_prepend(str(target))
    monkeypatch.setattr(sys, "modules", {k: v for k, v in sys.modules.items() if k not in MODULES})
    return target


@pytest.fixture
def broken(tmp_path: Path, monkeypatch):
    """Simulate an installed package ``broken 2.0`` with this source and these entry points."""

    def install(source: str, entry_points: str, package: str = "broken") -> None:
        folder = tmp_path / package
        metadata = folder / f"{package}-2.0.dist-info"
        metadata.mkdir(parents=True)
        (metadata / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {package}\nVersion: 2.0\n"
        )
        (metadata / "entry_points.txt").write_text(entry_points)
        (folder / f"{package}.py").write_text(source)
        monkeypatch.syspath_prepend(str(folder))
        monkeypatch.delitem(sys.modules, package, raising=False)

    return install


def write_frames(folder: Path, corridor, n: int) -> Path:
    c = corridor.camera
    folder.mkdir(exist_ok=True)
    camera = np.array([c.fx, c.fy, c.cx, c.cy, c.baseline])
    left, right = np.array(corridor.left[:n]), np.array(corridor.right[:n])
    np.savez(folder / "frames.npz", left=left, right=right, camera=camera)
    return folder


def test_an_environment_without_plugins_has_none():
    assert [plugins.find_plugins(group) for group in plugins.KINDS] == [{}, {}, {}]


def test_the_package_of_the_page_is_found(installed):
    found = {group: plugins.find_plugins(group) for group in plugins.KINDS}
    assert {group: list(names) for group, names in found.items()} == {
        "vslam.detectors": ["thumbnail"],
        "vslam.readers": ["frames"],
        "vslam.perturbations": ["haze"],
    }
    assert str(found["vslam.readers"]["frames"]) == (
        "the reader frames of the package vslam-example 1.0"
    )
    assert "vslam_example" not in sys.modules  # found, not imported


@pytest.mark.slow
def test_a_run_with_reader_perturbation_and_detector(target: Path, corridor, tmp_path: Path, call):
    """The command runs in a separate process, as a user would start it.

    The help lists all three plug-ins. Without the package, the run can neither be resumed nor its
    map continued.
    """
    data = write_frames(tmp_path / "data", corridor, 12)
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": str(target), "COLUMNS": "200"}
    environment["HOME"] = str(Path.home())
    words = ["run", "--dataset", "frames", "--data", str(data), "--detector", "thumbnail"]
    words += ["--perturb", "haze:0.5", "--start", "1", "--max-frames", "10", "--no-record"]
    words += ["--out", str(tmp_path / "runs")]

    def vslam(*words: str) -> str:
        command = [sys.executable, "-m", "vslam", *words]
        done = subprocess.run(
            command, env=environment, cwd=tmp_path, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    vslam(*words)
    folder = tmp_path / "runs" / "latest"
    report = json.loads((folder / "report.json").read_text())
    kept = {key: report[key] for key in ("dataset", "sequence", "perturb", "detector", "frames")}
    assert kept == {
        "dataset": "frames",
        "sequence": "frames",
        "perturb": "haze:0.5",
        "detector": "thumbnail",
        "frames": 10,
    }
    assert (report["lost_frames"], report["skipped_frames"]) == (0, 0)
    shown = vslam("run", "--help") + vslam("perturb", "--list")
    assert all(name in shown for name in ("thumbnail", "frames", "haze"))
    assert "vslam-example 1.0" in vslam("info", "--data", str(data))
    assert read_options(folder).plugins == dict.fromkeys(
        ("frames", "haze", "thumbnail"), "vslam-example 1.0"
    )

    code, _, err = call("run", "--resume", folder)
    assert code == 2
    assert "the run used frames of the package vslam-example 1.0, which is not installed" in err
    code, _, err = call("run", "--dataset", "synthetic", "--map", folder)
    assert code == 2
    assert "made with the detector thumbnail, a plug-in that is not installed here; install" in err


def test_the_detector_of_the_page_finds_the_same_image(installed):
    """The first image appears again after enough keyframes. It is the only candidate."""
    require_detector("thumbnail")
    detector = create_detector("thumbnail", Config())
    map_ = Map(np.array([1.0]))
    n = Config().bow.exclude_recent + 2
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (60, 80), dtype=np.uint8) for _ in range(n)] * 2
    for k, image in enumerate(images[: n + 1]):
        map_.add_keyframe(NO_FEATURES, np.eye(4), float(k), k)
        detector.add(k, image, NO_FEATURES)
    assert [c.match for c in detector.query(n, map_)] == [0]
    assert [c.match for c in detector.locate(images[3], NO_FEATURES, map_)] == [3]
    assert problem_of(detector) is None


def test_vslam_selects_frames_of_a_reader(installed, corridor, tmp_path: Path):
    data = write_frames(tmp_path / "data", corridor, 9)
    sequence = open_sequence("frames", data, start=2, every=3, max_frames=2, monocular=True)
    assert (len(sequence), sequence.camera.sensor) == (2, "mono")
    assert sequence.timestamps.tolist() == pytest.approx([0.2, 0.5])
    left, second = sequence.read(1)
    assert np.array_equal(left, corridor.left[5])
    assert second is None
    with pytest.raises(InputError, match=r"--calib: the reader frames .* leave the option out"):
        open_sequence("frames", data, calib=[Path("a.yaml")])
    # The plug-in's own message.
    with pytest.raises(InputError, match=r"elsewhere\.npz: no such file"):
        open_sequence("frames", data, "elsewhere")


def test_haze_is_the_same_for_one_seed(installed, corridor):
    image = corridor.left[0]
    once, again, other = (
        parse_perturbation("haze:2", seed).apply(3, 0.3, image, image) for seed in (0, 0, 1)
    )
    assert np.array_equal(once[0], again[0])
    assert np.array_equal(once[0], once[1])
    assert not np.array_equal(once[0], other[0])
    assert parse_perturbation("haze,blur:1", 0).name == "haze:1,blur:1"


@pytest.mark.parametrize(
    ("source", "value", "says"),
    [
        ("import nothing_there", "broken:make", "broken:make cannot be imported (ModuleNotFound"),
        ("x = (", "broken:make", "cannot be imported (SyntaxError"),
        ("", "broken:make", "cannot be imported (AttributeError"),
        ("make = 3", "broken:make", "is neither a function nor a class"),
        (
            "def make(*a): return 1 / 0",
            "broken:make",
            "failed (ZeroDivisionError: division by zero; broken.py, line 1); ",
        ),
        ("def make(a): return a", "broken:make", "failed (TypeError: make() takes 1 positional"),
        ("def make(*a): return None", "broken:make", ""),
    ],
)
@pytest.mark.parametrize("kind", ["detector", "reader", "perturbation"])
def test_a_broken_package_is_named_in_one_sentence(broken, kind, source, value, says):
    broken(source, f"[vslam.{kind}s]\nmine = {value}\n")
    use = {
        "detector": lambda: require_detector("mine"),
        "reader": lambda: open_sequence("mine", Path()),
        "perturbation": lambda: parse_perturbation("mine", 0),
    }
    with pytest.raises(InputError) as found:
        use[kind]()
    text = str(found.value)
    assert text.startswith(f"the {kind} mine of the package broken 2.0")
    assert says in text
    assert text.endswith("repair or uninstall the package.")
    assert "\n" not in text


def test_a_broken_package_hurts_nobody_else(broken, monkeypatch, capsys):
    broken("raise SystemError('never')", "[vslam.detectors]\nmine = broken:make\n")
    monkeypatch.setattr(sys, "argv", ["vslam", "info", "--data", "."])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert not stop.value.code
    assert "broken 2.0" in capsys.readouterr().out
    require_detector("bow")


def test_metadata_that_cannot_be_read_are_left_out_with_a_warning(broken, caplog):
    broken("", "[vslam.detectors]\nno equals sign\n")
    assert plugins.find_plugins(plugins.DETECTORS) == {}
    assert "broken 2.0: its entry points cannot be read" in caplog.text


def test_a_name_that_nobody_can_type_is_left_out_with_a_warning(broken, caplog):
    broken("", "[vslam.perturbations]\na,b = broken:make\n")
    assert plugins.find_plugins(plugins.PERTURBATIONS) == {}
    assert "'a,b'" in caplog.text


def test_two_packages_with_one_name_are_an_error_and_own_names_win(broken):
    for package in ("broken", "second"):
        broken("make = None", f"[vslam.detectors]\nmine = {package}:make\nbow = x:y\n", package)
    with pytest.raises(InputError, match=r"second 2.0 and of broken 2.0: several packages"):
        require_detector("mine")
    require_detector("bow")


FAILING = """
class Detector:
    n = 0
    def __init__(self, config, weights): pass
    def add(self, keyframe, image, features):
        assert not image.flags.writeable
        Detector.n += 1
        if Detector.n == 3:
            raise RuntimeError("out of memory")
    def query(self, keyframe, map_): return []
    def locate(self, image, features, map_): return []
"""


@pytest.mark.parametrize("threads", [1, 2])
def test_a_detector_that_fails_ends_the_run_with_what_it_has(broken, kitti_tree, tmp_path, threads):
    broken(FAILING, "[vslam.detectors]\nmine = broken:Detector\n")
    sequence = open_sequence("kitti", kitti_tree, "00")
    settings = RunOptions(detector="mine", threads=threads)
    outcome = run_sequence(begin(sequence, settings), Perturbation("none"), Recorder())
    assert outcome.interrupted is not None
    assert outcome.interrupted.startswith("the detector mine of the package broken 2.0 failed")
    assert "RuntimeError: out of memory" in outcome.interrupted
    assert 3 <= len(outcome.trajectory) <= len(sequence)
    folder = create_run_folder(tmp_path, "kitti", "00", "none", "mine")
    assert write_results(folder, outcome, pages=False, ply=False).interrupted is not None
    assert (folder / "trajectory.tum").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_a_compared_detector_that_fails_ends_alone(broken, kitti_tree, tmp_path, threads):
    broken(FAILING, "[vslam.detectors]\nmine = broken:Detector\n")
    sequence = open_sequence("kitti", kitti_tree, "00")
    settings = RunOptions(detector="none", threads=threads, compare=("mine",))
    outcome = run_sequence(begin(sequence, settings), Perturbation("none"), Recorder())
    assert outcome.interrupted is None
    assert len(outcome.trajectory) == len(sequence)
    assert 3 <= len(outcome.compared[0].trajectory) <= len(sequence)
    report = write_results(tmp_path, outcome)
    assert [one.interrupted is None for one in report.detectors] == [True, False]
    for name in ("report.md", "report.html"):
        assert "broken 2.0 failed" in (tmp_path / name).read_text()
    assert (tmp_path / "trajectory_mine.tum").is_file()


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        ("None", "query returned NoneType, not a list"),
        ("[7]", "query returned a list with int, not LoopCandidate"),
        ("[LoopCandidate(0, 5, 1.0)]", "returned keyframe 5, which is not in the map"),
        ("[LoopCandidate(0, 0, float('nan'))]", "with score nan"),
        ("[LoopCandidate(4, 0, 1.0)]", "returned query 4"),
        ("[LoopCandidate(0, 0.5, 1.0)]", "returned a LoopCandidate of int, float, float"),
        ("[LoopCandidate(0, 0, '1')]", "returned a LoopCandidate of int, int, str"),
    ],
)
def test_candidates_that_are_none_are_caught_before_kernels_see_them(broken, answer, says):
    source = FAILING.replace("map_): return []", f"map_): return {answer}", 1)
    broken(
        f"from vslam.types.loops import LoopCandidate\n{source}",
        "[vslam.detectors]\nmine = broken:Detector\n",
    )
    map_ = Map(np.array([1.0]))
    map_.add_keyframe(NO_FEATURES, np.eye(4), 0.0, 0)
    detector = create_detector("mine", Config())
    assert detector.query(0, map_) == []
    assert says in (problem_of(detector) or "")


def test_a_reader_that_fails_costs_one_frame(broken, kitti_tree):
    source = (
        "from dataclasses import replace\n"
        "from vslam.datasets import open_sequence\n"
        "from vslam.datasets.frames import stored_frames\n"
        "def reader(root, name):\n"
        "    inner = open_sequence('kitti', root, name)\n"
        "    def read(index, image_map):\n"
        "        if index == 2: raise KeyError('gone')\n"
        "        left, right = inner.read(index)\n"
        "        return (left[:-1] if index == 3 else left), right\n"
        "    return replace(inner, stored=stored_frames(inner.timestamps, read))\n"
    )
    broken(source, "[vslam.readers]\nmine = broken:reader\n")
    sequence = open_sequence("mine", kitti_tree, "00")
    with pytest.raises(UnreadableImageError, match=r"broken 2.0 failed at frame 2 \(KeyError"):
        sequence.read(2)
    with pytest.raises(
        UnreadableImageError, match=r"returned uint8 \(159, 480\) and .* at frame 3"
    ):
        sequence.read(3)
    assert np.array_equal(sequence.read(1)[0], open_sequence("kitti", kitti_tree, "00").read(1)[0])


STREAM = (
    "from vslam.datasets import open_sequence\n"
    "from vslam.datasets.frames import Source\n"
    "def reader(root, name):\n"
    "    inner = open_sequence('kitti', root, name)\n"
    "    def play():\n"
    "        for k, frame in enumerate(inner.frames()):\n"
    "            if k == 8: raise OSError('unplugged')\n"
    "            yield frame\n"
    "    return Source(dataset='mine', name='x', camera=inner.camera, play=play, live=LIVE)\n"
)


def test_a_reader_that_streams(broken, kitti_tree):
    """Frames of the stream are selected. A failure ends the stream."""
    broken(STREAM.replace("LIVE", "True"), "[vslam.readers]\nmine = broken:reader\n")
    source = open_from("mine", kitti_tree, start=1, every=2, sensor="mono")
    assert not source.seekable
    assert (source.live, source.n_expected, source.camera.monocular) == (True, None, True)
    inner = open_sequence("kitti", kitti_tree, "00")
    frames = source.frames()
    several = [next(frames) for _ in range(4)]
    with pytest.raises(BrokenSourceError, match=r"broken 2.0 failed \(OSError: unplugged\)"):
        next(frames)
    times = [frame.timestamp for frame in several]
    images = [frame.read(map) for frame in several]
    assert times == inner.timestamps[1:8:2].tolist()
    assert all(right is None for _, right in images)
    assert np.array_equal(images[1][0], inner.read(3)[0])
    few = open_from("mine", kitti_tree, max_frames=3)
    assert few.n_expected == len(list(few.frames())) == 3


def test_a_run_on_a_reader_that_streams(broken, kitti_tree):
    broken(STREAM.replace("LIVE", "False"), "[vslam.readers]\nmine = broken:reader\n")
    source = open_from("mine", kitti_tree, max_frames=6)
    settings = RunOptions(detector="none")
    outcome = run_sequence(begin(source, settings), Perturbation("none"), Recorder())
    assert len(outcome.trajectory) == 6


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("return Source", "return dict"), "returned dict, not vslam.datasets.frames.Source"),
        (("camera=inner.camera", "camera=3"), "camera is int, not vslam.types.camera.Camera"),
        (("live=LIVE", "n_expected=-1"), "n_expected is -1, neither None nor a number"),
        (
            ("play=play", "stored=(__import__('types').SimpleNamespace(timestamp=0.0),)"),
            "stored has a SimpleNamespace, not vslam.datasets.frames.TimedFrame",
        ),
        (
            ("play=play", "stored=(*inner.stored, inner.stored[0])"),
            "x: the times of the frames do not increase",
        ),
    ],
)
def test_what_is_no_stream_is_refused(broken, kitti_tree, change, says):
    broken(STREAM.replace(*change).replace("LIVE", "True"), "[vslam.readers]\nmine = broken:reader")
    with pytest.raises(InputError, match=says):
        open_from("mine", kitti_tree)


def test_a_perturbation_that_fails_costs_one_frame(broken):
    source = (
        "def make(strength, stream):\n"
        "    def law(frame, t, side, image):\n"
        "        if frame == 1: raise ValueError('no')\n"
        "        return image[:2] if frame == 2 else image\n"
        "    return law\n"
    )
    broken(source, "[vslam.perturbations]\nmine = broken:make\n")
    law = parse_perturbation("mine:2", 0)
    image = np.zeros((5, 6), np.uint8)
    assert np.array_equal(law.apply(0, 0.0, image, None)[0], image)
    for frame, says in (
        (1, r"broken 2.0 failed \(ValueError: no; broken.py, line 3\)"),
        (2, r"returned uint8 \(2, 6\)"),
    ):
        with pytest.raises(UnreadableImageError, match=says):
            law.apply(frame, 0.1, image, None)
