"""The process that compiles the kernels compiles all that runs call, and no result needs it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from vslam.run import warmup
from vslam.run.warmup import Compilation, compile_kernels, is_cold

# In a separate process, because other tests have called kernels in this one.
KERNELS = """
import gc
from numba.core.dispatcher import Dispatcher
from vslam.run import toy_room

def signatures():
    kernels = (o for o in gc.get_objects() if isinstance(o, Dispatcher))
    ours = (k for k in kernels if k.py_func.__module__.startswith("vslam."))
    return {(k.py_func.__module__, k.py_func.__name__): set(k.signatures) for k in ours}

def check(what):
    for name, known in signatures().items():
        assert known <= warm.get(name, set()), f"{what} compiles {name}{known - warm[name]}"

toy_room.call_kernels()
warm = signatures()
assert len([name for name, known in warm.items() if known]) > 30
# Called only where something in view moves, as in none of the drives below.
assert warm["vslam.frontend.pose", "_classify"], "nothing compiles the check of trusted landmarks"

from test_closing import EXACT, closed, run
from vslam.config import Config
from vslam.loopclosure.registry import create_detector

assert closed().corrections
jump = [*range(40), *(k + 0.4 for k in range(10, 20))]
_, results = run(EXACT, jump, create_detector("bow", Config()))
assert results[-1].state.name == "OK", "not relocalised"
check("a loop")

from test_monocular import closed as closed_with_one_camera

assert closed_with_one_camera()[0].corrections
check("mono")

import pytest

clips = ["test_method_version.py", "test_inertial_drive.py"]
assert not pytest.main(["-q", "-p", "no:cacheprovider", *clips]), "the clips failed"
check("a clip with images")
"""


@pytest.mark.slow
def test_the_toy_room_calls_all_kernels_that_slam_calls() -> None:
    here = Path(__file__).parent
    done = subprocess.run(
        [sys.executable, "-c", KERNELS],
        env=os.environ | {"PYTHONPATH": f"{here}{os.pathsep}{here.parent}"},
        capture_output=True,
        text=True,
        cwd=here,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture
def record(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Return the record of the compiled kernels, which does not exist yet."""
    file = tmp_path / "compiled.json"
    monkeypatch.setattr(warmup, "record_file", lambda: file)
    return file


def test_kernels_are_cold_until_all_sources_are_recorded_as_they_are(record, tmp_path):
    assert is_cold()
    source = tmp_path / "kernels.py"
    source.touch()
    record.write_text(json.dumps({str(source): source.stat().st_mtime_ns}))
    assert not is_cold()
    os.utime(source, (0, 0))
    assert is_cold()
    source.unlink()
    assert is_cold()
    record.write_text("{")
    assert is_cold()


def python_is(monkeypatch: pytest.MonkeyPatch, folder: Path, script: str) -> Path:
    """Replace Python with a shell script, and return the file to which it writes its process id."""
    python, trace = folder / "python", folder / "started"
    python.write_text(f"#!/bin/sh\necho $$ >> {trace}\n{script}\n")
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    return trace


def assert_ended(trace: Path) -> None:
    (number,) = trace.read_text().split()
    with pytest.raises(ProcessLookupError):
        os.kill(int(number), 0)


def test_a_process_that_fails_costs_only_its_help(monkeypatch, tmp_path, record):
    trace = python_is(monkeypatch, tmp_path, "exit 1")
    compile_kernels()
    assert_ended(trace)


def test_a_process_that_hangs_is_ended(monkeypatch, tmp_path, record):
    trace = python_is(monkeypatch, tmp_path, "exec sleep 600")
    monkeypatch.setattr(warmup, "PATIENCE_S", 0.5)
    compile_kernels()
    assert_ended(trace)


def test_the_process_works_while_images_are_rendered_and_is_started_once(
    monkeypatch, tmp_path, record
):
    trace = python_is(monkeypatch, tmp_path, "exec sleep 600")
    with Compilation() as kernels:
        kernels.start()
        kernels.start()
        while not trace.exists() or not trace.read_text():
            time.sleep(0.01)
    assert_ended(trace)


@pytest.mark.parametrize("why", ["warm", "frozen", "no Python"])
def test_no_process_where_it_cannot_help(monkeypatch, tmp_path, record, why):
    trace = python_is(monkeypatch, tmp_path, "exit 0")
    if why == "warm":
        record.write_text("{}")
    elif why == "frozen":
        monkeypatch.setattr(sys, "frozen", True, raising=False)
    elif why == "no Python":
        monkeypatch.setattr(sys, "executable", str(tmp_path / "absent"))
    compile_kernels()
    assert not trace.exists()
