"""Without the extra ``train``, vslam can do everything except training."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
from conftest import StereoSequence
from typer.testing import CliRunner

from vslam.cli.main import every_command
from vslam.support.errors import InputError

EXTRA = ("torch", "safetensors", "onnx", "onnxscript")
# None in sys.modules is not sufficient, because scipy reads attributes of sys.modules["torch"].
BLOCK = f"""
import sys
from importlib.machinery import PathFinder

class Finder(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name in {EXTRA} else super().find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = Finder
"""


@pytest.fixture(scope="module")
def pairs(corridor: StereoSequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two places that both cameras see, as ``vslam synth --pairs`` writes them."""
    folder = tmp_path_factory.mktemp("pairs")
    rows = []
    for k in (0, len(corridor) - 1):
        for side, images in (("a", corridor.left), ("b", corridor.right)):
            assert cv2.imwrite(str(folder / f"{k}{side}.png"), images[k])
        place = {f"{name}_{side}": 0.0 for side in "ab" for name in ("x", "yaw")}
        place |= {f"z_{side}": 20.0 * k for side in "ab"}
        rows.append({"a": f"{k}a.png", "b": f"{k}b.png", "same": 1, **place})
    with (folder / "pairs.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return folder


@pytest.mark.slow
def test_all_but_training_works_without_torch(kitti_tree: Path, pairs: Path, tmp_path: Path):
    """The test uses processes that cannot import torch.

    These include the processes that a benchmark starts.
    """
    blocked = tmp_path / "blocked"
    blocked.mkdir()
    (blocked / "sitecustomize.py").write_text(BLOCK)
    environment = os.environ | {"PYTHONPATH": str(blocked)}

    def vslam(*words: str | Path, code: int = 0) -> str:
        done = subprocess.run(
            [sys.executable, "-m", "vslam", *map(str, words)],
            capture_output=True, text=True, cwd=tmp_path, env=environment,
        )  # fmt: skip
        assert done.returncode == code, f"{words}: {done.stderr}"
        return done.stderr

    source, images = ("--data", kitti_tree), ("--data", f"pairs:{pairs}")
    vslam("run", *source, "--out", "mapped")
    vslam("run", *source, "--perturb", "brightness", "--no-record", "--out", "darker")
    mapped, darker = Path("mapped/latest"), Path("darker/latest")
    vslam("run", *source, "--map", mapped, "--localize", "--no-record")
    vslam("map", "info", mapped)
    vslam("map", "merge", mapped, darker, "--out", "merged.npz")
    vslam("doctor", kitti_tree)
    vslam("bench", *source, "--seqs", "00", "--detectors", "capsule-paper", "--perturb", "none",
          "--seeds", "1", "--max-frames", "8", "--out", "bench")  # fmt: skip
    vslam("report", "bench")
    vslam("loops", "bench", *images, "--perturb", "none",
          "--detectors", "bow,capsule,capsule-pruned,capsule-paper", "--out", "loops")  # fmt: skip
    vslam("export", "places", *images, "--out", "places.npz")
    assert (tmp_path / mapped / "report.html").exists()
    assert (tmp_path / "loops" / "loops.json").exists()
    said = vslam("train", "capsule", *images, code=2)
    assert said == "error: vslam train: torch is not installed; pip install 'vslam[train]'.\n"


@pytest.mark.parametrize("missing", EXTRA)
@pytest.mark.parametrize(
    "words",
    [
        ("train", "capsule", "--data", "pairs:towns"),
        ("export", "onnx", "--weights", "capsule.safetensors"),
        ("export", "weights", "--weights", "a.safetensors", "--out", "b.safetensors"),
    ],
)
def test_training_looks_for_every_library_before_it_starts(words, missing, monkeypatch):
    monkeypatch.setitem(sys.modules, missing, None)
    found = CliRunner().invoke(every_command(), words).exception
    assert isinstance(found, InputError)
    assert f"{missing} is not installed; pip install 'vslam[train]'" in str(found)
