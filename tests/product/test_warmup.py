"""Compilation in two processes: together they compile everything, and no result depends on it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

from vslam.run import warmup

# In a separate process, because other tests have called kernels in this one.
SHARES = """
import gc
from numba.core.dispatcher import Dispatcher
from vslam.run import warmup

def signatures():
    kernels = (o for o in gc.get_objects() if isinstance(o, Dispatcher))
    ours = (k for k in kernels if k.py_func.__module__.startswith("vslam."))
    return {(k.py_func.__module__, k.py_func.__name__): set(k.signatures) for k in ours}

for share in warmup.COMPILE_SHARES["first"]:
    share()
first = signatures()
for share in warmup.COMPILE_SHARES["second"]:
    share()
both = signatures()
for name, known in first.items():
    assert not known or both[name] == known, f"both shares compile {name}, for other types"
for share in warmup.EVERYTHING:
    share()
for name, known in signatures().items():
    assert both[name] == known, f"neither share compiles {name}{known - both[name]}"
assert len([name for name, known in both.items() if known]) > 30
# Called only where something in view moves, as in none of the drives below.
assert both["vslam.frontend.pose", "_classify"], "no share compiles the check of trusted landmarks"
warmup.mark_warm()
assert not warmup.is_cold()

from test_closing import EXACT, closed, run
from vslam.config import Config
from vslam.loopclosure.registry import create_detector

warm = signatures()
assert closed().corrections
jump = [*range(40), *(k + 0.4 for k in range(10, 20))]
_, results = run(EXACT, jump, create_detector("bow", Config()))
assert results[-1].state.name == "OK", "not relocalised"
for name, known in signatures().items():
    assert known <= warm.get(name, set()), f"a loop compiles {name}{known - warm.get(name, set())}"

from test_monocular import closed as closed_with_one_camera

assert closed_with_one_camera()[0].corrections
for name, known in signatures().items():
    assert known <= warm.get(name, set()), f"mono compiles {name}{known - warm.get(name, set())}"
"""


@pytest.mark.slow
def test_the_two_shares_compile_all_that_slam_calls() -> None:
    here = Path(__file__).parent
    done = subprocess.run(
        [sys.executable, "-c", SHARES],
        env=os.environ | {"PYTHONPATH": f"{here}{os.pathsep}{here.parent}"},
        capture_output=True,
        text=True,
        cwd=here,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("age_s", "cold"), [(None, True), (-10, True), (10, False)])
def test_kernels_are_cold_without_a_cache_newer_than_the_source(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, age_s: float | None, cold: bool
) -> None:
    source = tmp_path / "bundle_adjustment.py"
    source.touch()
    if age_s is not None:
        index = tmp_path / "bundle_adjustment._adjust-88.py311.nbi"
        index.touch()
        changed = source.stat().st_mtime + age_s
        os.utime(index, (changed, changed))
    kernel = SimpleNamespace(stats=SimpleNamespace(cache_path=str(tmp_path)))
    module = SimpleNamespace(__file__=str(source), _adjust=kernel)
    monkeypatch.setattr(warmup, "COLD_PROBES", ((module, "_adjust"),))
    assert warmup.is_cold() is cold


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the calls of ``compile_kernels`` on a machine with two cores and an empty cache."""
    made: list[str] = []
    monkeypatch.setattr(warmup, "is_cold", lambda: True)
    monkeypatch.setattr(warmup, "available_cores", lambda: 2)
    monkeypatch.setattr(warmup, "EVERYTHING", (lambda: made.append("everything"),))
    return made


def python_is(monkeypatch: pytest.MonkeyPatch, folder: Path, script: str) -> Path:
    """Replace Python with a shell script, and return the folder of its output.

    Each call writes its process id into a file that is named as its last argument.
    """
    python, traces = folder / "python", folder / "started"
    traces.mkdir()
    leave = f"echo $$ > {folder}/$4 && mv {folder}/$4 {traces}/"
    python.write_text(f"#!/bin/sh\n{leave}\n{script}\n")
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    return traces


def assert_both_ended(traces: Path) -> None:
    assert {trace.name for trace in traces.iterdir()} == set(warmup.COMPILE_SHARES)
    for trace in traces.iterdir():
        with pytest.raises(ProcessLookupError):
            os.kill(int(trace.read_text()), 0)


def test_processes_that_fail_cost_only_their_help(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, calls: list[str]
) -> None:
    traces = python_is(monkeypatch, tmp_path, "exit 1")
    warmup.compile_kernels()
    assert_both_ended(traces)
    assert calls == ["everything"]


@pytest.mark.parametrize("why", [subprocess.TimeoutExpired("python", 300.0), KeyboardInterrupt()])
def test_processes_that_hang_are_ended(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, calls: list[str], why: BaseException
) -> None:
    traces = python_is(monkeypatch, tmp_path, "exec sleep 600")

    def stop_waiting(*_: object) -> None:
        while len(list(traces.iterdir())) < 2:
            time.sleep(0.01)
        raise why

    wait = subprocess.Popen.wait
    waits = iter([stop_waiting, wait, wait])
    monkeypatch.setattr(subprocess.Popen, "wait", lambda *a, **k: next(waits)(*a, **k))
    interrupted = isinstance(why, KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt) if interrupted else nullcontext():
        warmup.compile_kernels()
    assert calls == ([] if interrupted else ["everything"])
    assert_both_ended(traces)


@pytest.mark.parametrize("why", ["warm", "one core", "one process", "frozen", "no Python"])
def test_no_other_process_where_it_cannot_help(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, calls: list[str], why: str
) -> None:
    traces = python_is(monkeypatch, tmp_path, "exit 0")
    if why == "warm":
        monkeypatch.setattr(warmup, "is_cold", lambda: False)
    elif why == "one core":
        monkeypatch.setattr(warmup, "available_cores", lambda: 1)
    elif why == "frozen":
        monkeypatch.setattr(sys, "frozen", True, raising=False)
    elif why == "no Python":
        monkeypatch.setattr(sys, "executable", str(tmp_path / "absent"))
    warmup.compile_kernels(processes=1 if why == "one process" else 2)
    assert calls == ([] if why == "warm" else ["everything"])
    assert not list(traces.iterdir())
    if why == "warm":
        warmup.compile_kernels(load=True)
        assert calls == ["everything"]
