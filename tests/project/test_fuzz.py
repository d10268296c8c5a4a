"""Damaged files are rejected with one sentence. This is a short version of ``tools/fuzz.py``.

``VSLAM_FUZZ_INPUTS=1000`` tries more inputs for each reader.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
INPUTS = int(os.environ.get("VSLAM_FUZZ_INPUTS", "5"))
SLOW = ("weights",)  # torch


@pytest.fixture
def fuzz(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    import fuzz

    return fuzz


@pytest.mark.slow
def test_every_reader_survives_damaged_files(fuzz, tmp_path: Path):
    names = [name for name in fuzz.READERS if name not in SLOW or INPUTS > 100]
    names.remove("map-meaning")
    command = [sys.executable, str(ROOT / "tools" / "fuzz.py"), "--work", ",".join(names)]
    command += ["0", str(INPUTS), "0", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace")
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    tried = [line for line in lines if "number" in line]
    wrong = [line for line in tried if line["outcome"] not in ("read", "refused")]
    assert wrong == []
    assert done.returncode == 0, done.stderr[-3000:]
    assert len(tried) == INPUTS * len(names)
    # Most files are damaged so much that the readers notice it.
    assert sum(line["outcome"] == "refused" for line in tried) > len(tried) / 4


@pytest.mark.slow
def test_maps_that_say_what_cannot_be_are_refused_or_used_to_the_end(fuzz):
    """The arrays have the right types and shapes but wrong values, which kernels do not check."""
    found = fuzz.fuzz("map-meaning", 8 * INPUTS, 0)
    assert found["failures"] == []
    assert found["tried"] == 8 * INPUTS
    assert min(found["read"], found["refused"]) > INPUTS


def test_mutations_are_seeded_and_change_the_file(fuzz):
    data = bytes(range(256)) * 4
    made = [fuzz.mutate(data, np.random.default_rng(seed), "a.bin") for seed in (1, 1, 2)]
    assert made[0] == made[1] != made[2]
    assert made[0] != data


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hang", "wall", "code"), [("import time; time.sleep(60)", 15, 1), ("pass", 300, -27)]
)
def test_the_harness_sees_an_exception_a_crash_and_a_hang(tmp_path, hang, wall, code):
    script = f"""
import sys
sys.path.insert(0, {str(ROOT / "tools")!r})
import fuzz
from pathlib import Path
fuzz.SECONDS, fuzz.WALL_SECONDS = 3, {wall}
def write(folder): (folder / "a.txt").write_text("1 2 3")
calls = iter(range(99))
def read(folder):
    number = next(calls)
    if number == 1: raise KeyError("x")
    if number == 2: bytearray(700 * 2**20)[::4096] = b"x" * (700 * 256)
    while number == 3:
        {hang}
fuzz.READERS = {{"bad": fuzz.Reader(write, read, "a.txt")}}
fuzz._work("bad", 0, 4, 0, Path({str(tmp_path)!r}))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["outcome"] for line in lines if "number" in line] == ["KeyError", "memory"]
    assert lines[-1] == {"begin": 2}
    assert done.returncode == code  # minus SIGPROF: the CPU time was exceeded
    assert ", line" in done.stderr  # the traceback
