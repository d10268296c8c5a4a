"""The wheel is reproducible, has complete metadata, and container files exist."""

from __future__ import annotations

import csv
import email
import os
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from conftest import corridor_depth
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PARTS = ("vslam", "frontend", "backend", "loopclosure", "tools/vslam_lab")
# Only training and experiments need these; they stay in the repository.
NOT_SHIPPED = {".safetensors", "capsule-pruned.onnx"}


def build(source: Path, out: Path) -> Path:
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-index"]
    command += ["--no-build-isolation", "--wheel-dir", str(out), str(source)]
    done = subprocess.run(
        command,
        env=os.environ | {"SOURCE_DATE_EPOCH": "1700000000"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    (wheel,) = out.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two wheels, built from copies in different folders whose files have different times."""
    root = tmp_path_factory.mktemp("wheels")
    made = []
    for number in range(2):
        source = root / f"source{number}"
        source.mkdir()
        for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
            shutil.copyfile(ROOT / name, source / name)
        for name in PARTS:
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(ROOT / name, source / name, ignore=ignored, dirs_exist_ok=True)
        for path in source.rglob("*"):
            os.utime(path, (1e9 + 1e6 * number, 1e9 + 1e6 * number))
        made.append(build(source, root / f"wheel{number}"))
    return made[0], made[1]


@pytest.mark.slow
def test_the_same_bytes_twice(wheels):
    assert wheels[0].read_bytes() == wheels[1].read_bytes()


@pytest.mark.slow
def test_the_wheel_holds_every_source_and_the_files_beside_them(wheels):
    with zipfile.ZipFile(wheels[0]) as archive:
        inside = set(archive.namelist())
    missing = []
    for part in PARTS:
        for path in (ROOT / part).rglob("*"):
            if path.suffix not in {
                ".py",
                ".jinja",
                ".npy",
                ".npz",
                ".onnx",
                ".typed",
            }:
                continue
            if {path.name, path.suffix} & NOT_SHIPPED:
                continue
            name = path.relative_to(ROOT).as_posix().removeprefix("tools/")
            name = name if name.startswith("vslam") else f"vslam/{name}"
            missing += [] if name in inside else [name]
    assert missing == []
    assert not {name for name in inside if "tests/" in name or name.endswith(".pyc")}
    assert not {name for name in inside if name.endswith(tuple(NOT_SHIPPED))}


@pytest.mark.slow
def test_its_metadata_are_complete(wheels):
    with zipfile.ZipFile(wheels[0]) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        metadata = email.message_from_string(archive.read(name).decode())
        points = archive.read(name.replace("METADATA", "entry_points.txt")).decode()
    for key in ("Name", "Version", "Summary", "Author", "Keywords", "License-Expression",
                "License-File", "Requires-Python", "Description-Content-Type"):  # fmt: skip
        assert metadata[key], key
    classifiers = metadata.get_all("Classifier") or []
    for version in ("3.11", "3.12", "3.13"):
        assert f"Programming Language :: Python :: {version}" in classifiers
    assert {"bag", "cluster", "docs", "dev", "gps", "oakd", "realsense", "train"} == set(
        metadata.get_all("Provides-Extra") or []
    )
    assert "vslam = vslam.cli.main:main" in points
    assert "# vslam" in str(metadata.get_payload())


def test_an_old_python_is_refused_in_one_sentence():
    code = "import sys, setuptools; sys.modules['tomllib'] = None; import setup"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("vslam needs Python 3.11 or later; this is Python 3.")


def readme_for(source: str, tmp_path: Path) -> str:
    """Return the README that setup.py makes if pyproject.toml names this page."""
    for name in ("setup.py", "README.md"):
        shutil.copyfile(ROOT / name, tmp_path / name)
    urls = f"[project.urls]\nSource = '{source}'\n" if source else ""
    (tmp_path / "pyproject.toml").write_text(
        f"[project]\nname = 'vslam'\nversion = '1'\ndynamic = ['readme']\n{urls}"
    )
    command = [sys.executable, "setup.py", "--long-description"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_readme_of_a_registry_has_no_link_that_leads_nowhere(wheels, tmp_path: Path):
    with zipfile.ZipFile(wheels[0]) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        shown = str(email.message_from_string(archive.read(name).decode()).get_payload())
    source = PROJECT.get("urls", {}).get("Source", "")
    link = re.compile(r"\]\((?!https?:|#)")
    assert link.search((ROOT / "README.md").read_text())
    for text in (shown, readme_for("", tmp_path), readme_for("https://example.org/v/", tmp_path)):
        assert not link.search(text)
    assert "](https://example.org/v/blob/main/docs/howto/cameras.md)" in text
    assert "![" not in readme_for("", tmp_path)
    assert "![The same street" in text
    assert "](https://example.org/v/raw/main/docs/images/night.jpg)" in text
    assert ("![" in shown) == bool(source)


def test_a_plain_installation_stays_lean():
    """Packages that only some users need are in an extra.

    If one is missing, the message names the extra.
    """
    plain = " ".join(PROJECT["dependencies"])
    extras = {
        re.split(r"[<>=\[]", item)[0]
        for name, items in PROJECT["optional-dependencies"].items()
        for item in items
    } - {"vslam"}
    assert not [name for name in extras if re.search(rf"\b{name}\b", plain)]
    for library, extra, where in (
        ("rosbags", "bag", "vslam/datasets/bag_files.py"),
        ("pymap3d", "gps", "vslam/datasets/fixes.py"),
        ("distributed", "cluster", "tools/vslam_lab/bench/cluster.py"),
        ("torch", "train", "tools/vslam_lab/cli/train.py"),
    ):
        assert library in extras
        assert f"vslam[{extra}]" in (ROOT / where).read_text()
    # `make test` installs all of them.
    assert "vslam[bag,cluster,docs,gps,train]" in PROJECT["optional-dependencies"]["dev"]


def test_a_comment_says_what_each_dependency_is_needed_for():
    text = (ROOT / "pyproject.toml").read_text()
    for requirement in PROJECT["dependencies"]:
        assert re.search(rf'^    "{re.escape(requirement)}", # \w', text, re.MULTILINE), requirement


def make_targets() -> set[str]:
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


def test_the_image_is_not_root_and_copies_what_exists():
    lines = (ROOT / "Dockerfile").read_text().replace("\\\n", " ").splitlines()
    steps = [line.split(None, 1) for line in lines if line and not line.startswith("#")]
    words = [step[0] for step in steps]
    assert words.index("USER") < words.index("ENTRYPOINT")
    assert ["USER", "vslam"] in steps
    assert all("slim" in rest for word, rest in steps if word == "FROM")
    for rest in (rest for word, rest in steps if word == "COPY" and "--from" not in rest):
        assert all((ROOT / name).exists() for name in rest.split()[:-1])
    comment = "\n".join(line for line in lines if line.startswith("#"))
    assert "docker build --tag vslam ." in comment
    (command,) = re.findall(r"docker run .* vslam (run .*)", comment)
    from typer.main import get_command

    from vslam.cli.main import every_command

    known = {o for p in get_command(every_command()).commands["run"].params for o in p.opts}  # type: ignore[attr-defined]
    assert {word for word in command.split() if word.startswith("--")} <= known
    (compiling,) = (rest for word, rest in steps if word == "RUN" and "compile_kernels" in rest)
    assert "chmod -R a+rwX /cache/*" in compiling  # any --user must be able to write there
    for name in re.findall(r"from (vslam\.\S+) import (\w+)", "\n".join(lines)):
        source = ROOT / (name[0].replace(".", "/") + ".py")
        assert f"def {name[1]}(" in source.read_text()


@pytest.mark.parametrize(
    ("file", "at_least"),
    [
        (".devcontainer/devcontainer.json", {"dev", "demo", "test"}),
        (".ci/run", {"check", "figures-check", "test"}),
        (".github/workflows/ci.yml", {"test-fast"}),
        (".pre-commit-config.yaml", {"types", "dev"}),
    ],
)
def test_files_name_targets_of_make(file, at_least):
    named = re.findall(r"make ((?:[a-z-]+ ?)+)", (ROOT / file).read_text())
    assert at_least <= {target for words in named for target in words.split()} <= make_targets()


# -- tools/packaging ------------------------------------------------------------------------------

PACKAGING = ROOT / "tools" / "packaging"
IN_CONDA = {"opencv-python-headless": "py-opencv", "matplotlib": "matplotlib-base"}


def test_the_conda_recipe_has_the_requirements_of_the_project():
    recipe = yaml.safe_load((PACKAGING / "conda" / "recipe.yaml").read_text())
    wanted = [re.fullmatch(r"([\w-]+)(.*)", one).groups() for one in PROJECT["dependencies"]]
    run = [f"{IN_CONDA.get(name, name)} {least}" for name, least in wanted]
    assert recipe["requirements"]["run"] == ["python >=${{ python_min }}", *run]
    assert recipe["context"]["version"] == PROJECT["version"]
    assert f">={recipe['context']['python_min']}" == PROJECT["requires-python"]
    (entry,) = PROJECT["scripts"].items()
    assert recipe["build"]["python"]["entry_points"] == [" = ".join(entry)]


LAB_CALIBRATION = """%YAML 1.2
---
cameras:
  - {{cam_name: rgb_0,
     cam_type: gray,
     {depth}cam_model: pinhole,
     focal_length: [240.0, '240.0'],
     principal_point: [239.5, 79.5],
     image_dimension: [480, 160],
     fps: 10,
     T_BS: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1] # Sensor extrinsics.
    }}
  - {{cam_name: rgb_1,
     cam_type: gray,
     cam_model: pinhole,
     focal_length: [240.0, 240.0],
     principal_point: [239.5, 79.5],
     image_dimension: [480, 160],
     fps: 10,
     T_BS: [1, 0, 0, {baseline}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    }}
"""


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["stereo", "rgbd"])
def test_a_sequence_of_vslam_lab(corridor, tmp_path, monkeypatch, mode):
    sides = {"rgb_0": corridor.left, "rgb_1": corridor.right}
    scale = 0.2 if mode == "rgbd" else 1.0  # in a small corridor, depth images are accurate
    if mode == "rgbd":
        metres = [corridor_depth(corridor.camera, T) for T in corridor.T_wc]
        del sides["rgb_1"]
        sides["depth_0"] = [
            np.uint16(5000 * scale * np.where(one < 65.0, one, 0)) for one in metres
        ]
    rows = [",".join(f"ts_{name} (ns),path_{name}" for name in sides)]
    for k, time in enumerate(corridor.timestamps):
        rows.append(",".join(f"{round(1e9 * time)},{name}/{k:06}.png" for name in sides))
        for name, images in sides.items():
            (tmp_path / name).mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / name / f"{k:06}.png"), images[k])
    (tmp_path / "rgb_exp.csv").write_text("\n".join(rows) + "\n")
    depth = "depth_name: depth_0, depth_factor: 5000.0, " if mode == "rgbd" else ""
    text = LAB_CALIBRATION.format(baseline=corridor.camera.baseline, depth=depth)
    (tmp_path / "calibration.yaml").write_text(text)
    options = {"sequence_path": tmp_path, "calibration_yaml": tmp_path / "calibration.yaml",
               "rgb_csv": tmp_path / "rgb_exp.csv", "exp_folder": tmp_path, "exp_it": 3,
               "settings_yaml": "none", "verbose": 0, "mode": mode, "detector": "none"}  # fmt: skip
    words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    monkeypatch.setattr(sys, "argv", ["vslamlab_vslam.py", *words])
    runpy.run_path(str(PACKAGING / "vslamlab" / "vslamlab_vslam.py"), run_name="__main__")
    with (tmp_path / "00003_KeyFrameTrajectory.csv").open() as file:
        table = list(csv.reader(file))
    assert table[0] == ["ts (ns)", "tx (m)", "ty (m)", "tz (m)", "qx", "qy", "qz", "qw"]
    found = np.array(table[1:], float)
    np.testing.assert_allclose(found[:, 0] / 1e9, corridor.timestamps)
    np.testing.assert_allclose(found[:, 1:4], scale * corridor.T_wc[:, :3, 3], atol=0.05 * scale)
    turns = Rotation.from_quat(found[:, 4:]) * Rotation.from_matrix(corridor.T_wc[:, :3, :3]).inv()
    assert turns.magnitude().max() < 0.01


def test_the_baseline_names_tasks_and_options_that_exist(monkeypatch):
    class Base:  # what VSLAM-LAB's class does with its arguments
        def __init__(self, name: str, folder: str, parameters: dict[str, object]) -> None:
            self.name, self.parameters = name, parameters
            self.baseline_path = Path(folder)

    module = SimpleNamespace(BaselineVSLAMLab=Base)
    monkeypatch.setitem(sys.modules, "Baselines", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "Baselines.BaselineVSLAMLab", module)
    program = runpy.run_path(str(PACKAGING / "vslamlab" / "baseline_vslam.py"))
    baseline = program["VslamBaseline"]()
    feature = tomllib.loads((PACKAGING / "vslamlab" / "pixi.toml").read_text())["feature"]
    tasks = feature[baseline.name]["tasks"]
    assert {f"execute-{mode}" for mode in baseline.modes} <= tasks.keys()
    runner = (PACKAGING / "vslamlab" / "vslamlab_vslam.py").read_text()
    assert all(f'"--{name}"' in runner for name in baseline.parameters if name != "verbose")
    assert baseline.is_installed()[0] is False
