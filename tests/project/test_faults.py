"""Every part of a run fails once. No other result is lost, and one sentence says what failed."""

from __future__ import annotations

import csv
import importlib
import subprocess
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from faults import FAULTS, FRAMES, MAPLESS, POINTS, RING, failing, view
from ring import CAMERA, Oracle

from vslam.slam import Slam
from vslam.types.features import Extracted

TOOL = Path(__file__).parents[2] / "tools" / "experiments" / "lifelong" / "inject_faults.py"
INCOMPLETE = r"^mapping a keyframe failed .* incomplete; continue from a map that was saved before$"
SOME = [  # one of each kind; tools/experiments/lifelong tests all of them
    "a frame's track",
    "closing job, fusion",
    "global adjustment",
    "image source",
    "handing thread",
    "moments",
    "result: figures",
    "warm-up of the kernels",
]
CORE = ("vslam.frontend.tracker.", "vslam.method.modes.", "vslam.method.mapping.",
        "vslam.method.published_map.", "vslam.method.shared_map.", "vslam.method.closing.",
        "vslam.loopclosure.verification.", "ring.")  # fmt: skip


def test_every_point_names_a_function_that_exists():
    for point in POINTS:
        module, _, name = point.function.rpartition(".")
        try:
            owner = importlib.import_module(module)
        except ModuleNotFoundError:  # the name is that of a method
            module, _, owner_name = module.rpartition(".")
            owner = getattr(importlib.import_module(module), owner_name)
        assert callable(getattr(owner, name)), point.name


@pytest.mark.slow
def test_what_fails_in_a_run_costs_itself_alone(tmp_path):
    """A separate process forks, because the process of the tests may have threads."""
    table = tmp_path / "faults.csv"
    words = ["--once", "--points", *SOME, "--out", str(table)]
    done = subprocess.run(
        [sys.executable, str(TOOL), *words], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert sorted(row["point"] for row in rows) == sorted(SOME)
    assert len({row["fault"] for row in rows}) > 1
    assert not any(row["wrong"] for row in rows)


@pytest.mark.parametrize(
    "point", [one for one in POINTS if one.function.startswith(CORE)], ids=lambda one: one.name
)
def test_a_slam_goes_on_after_a_fault_or_refuses(point, tmp_path, monkeypatch):
    """This is the behaviour that docs/howto/python.md promises."""
    failing(point, min(5, point.last_call), FAULTS["RuntimeError"], monkeypatch.setattr)
    frames = 40 if point.last_call > 2 else FRAMES
    slam = Slam(CAMERA, None, Oracle(RING, [float(k) for k in range(FRAMES)]), threads=2)
    path = tmp_path / "map.npz"
    path.write_bytes(b"an older map")

    def step(k: int) -> None:
        image = np.array([[k & 255, k >> 8]], np.uint8)
        slam.step_features(Extracted(view(k)), 0.1 * k, image)

    uses = [*(partial(step, k) for k in range(frames)), slam.finish, slam.trajectory]
    failed = 0
    for use in uses:
        with suppress(RuntimeError):
            use()
            continue
        failed += 1
        if point.expected == MAPLESS:
            break
    if point.expected == MAPLESS:
        assert failed == 1
        for use in (lambda: slam.map, lambda: slam.save(path), slam.finish, slam.trajectory,
                    partial(step, frames)):  # fmt: skip
            with pytest.raises(RuntimeError, match=INCOMPLETE):
                use()
        assert path.read_bytes() == b"an older map"
        return
    assert failed + len(slam.problems) == 1
    trajectory = slam.trajectory()
    assert len(trajectory) in (frames, frames - failed)
    assert np.isfinite(trajectory.T_wc).all()
    slam.save(path)
    assert Slam.load(path, detector=slam.detector).map.n_keyframes == len(
        slam.map.living_keyframes()
    )
