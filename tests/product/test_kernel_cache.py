"""Kernels from the cache: what is skipped when they are loaded, and what is not."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from vslam.support.kernels import _CheckedFiles

# A separate process prints the loaded modules of Numba's compiler, and then the result.
INNER = """
import sys
import numpy as np
from numba.core import types
from vslam.support import kernels
from vslam.support.kernels import inner_kernel, kernel

@inner_kernel
def total(values, first):
    if first < 0:
        raise ValueError("first")
    copy = np.zeros(len(values))
    for i in range(first, len(values)):
        copy[i] = values[i]
    return np.sum(copy)

@kernel
def both(values):
    return total(values, len(values) - len(values)), values.copy()
"""
OUTER = """
from inner import both, total
import numpy as np
from vslam.support.kernels import kernel

@kernel
def three(values, first):
    return total(values, first) + both(values)[0]

if __name__ == "__main__":
    print(three(np.arange(4.0), 1))
    print(sum(three.stats.cache_hits.values()), sum(total.stats.cache_hits.values()))
    try:
        three(np.arange(4.0), -1)
    except ValueError as error:
        print(error)
"""
CALL = """
import sys
from inner import both
import numpy as np
value, copy = both(np.arange(4.0))
print(value, copy.tolist(), sum(both.stats.cache_hits.values()))
print("scipy.linalg" in sys.modules, "numba.np.arrayobj" in sys.modules)
"""


def run(folder: Path, *words: str, **variables: str) -> list[str]:
    """Run Python and return what it prints. Its warnings are in the file ``errors``."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache")} | variables
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    (folder / "errors").write_text(done.stderr)
    return done.stdout.splitlines()


@pytest.mark.slow
def test_a_kernel_is_loaded_without_what_compiles(tmp_path: Path) -> None:
    (tmp_path / "inner.py").write_text(INNER)
    assert run(tmp_path, "-c", CALL)[0] == "6.0 [0.0, 1.0, 2.0, 3.0] 0"
    assert run(tmp_path, "-c", CALL) == ["6.0 [0.0, 1.0, 2.0, 3.0] 1", "False False"]


@pytest.mark.slow
def test_a_kernel_is_compiled_from_loaded_ones(tmp_path: Path) -> None:
    (tmp_path / "inner.py").write_text(INNER)
    (tmp_path / "outer.py").write_text(OUTER)
    run(tmp_path, "-c", CALL)
    assert run(tmp_path, "outer.py") == ["12.0", "0 1", "first"]
    assert run(tmp_path, "outer.py") == ["12.0", "1 0", "first"]


def test_the_installed_release_of_numba_is_known() -> None:
    """A different release works with its own cache.

    For a new release, check that ``_KernelCache`` still works.
    """
    from vslam.support.kernels import TESTED_NUMBA

    assert numba.__version__.startswith(TESTED_NUMBA)


@pytest.mark.slow
def test_an_unknown_release_uses_its_own_cache(tmp_path: Path) -> None:
    (tmp_path / "inner.py").write_text(INNER.replace("from vslam.support.kernels", UNKNOWN, 1))
    for hits in "01":
        assert run(tmp_path, "-c", CALL)[0] == f"6.0 [0.0, 1.0, 2.0, 3.0] {hits}"


def damage(path: Path, how: str) -> None:
    size = path.stat().st_size
    keep = path.read_bytes()[: {"emptied": 0, "cut": size // 2, "zeroed": size // 2}[how]]
    path.write_bytes(keep.ljust(size, b"\0") if how == "zeroed" else keep)


@pytest.mark.slow
@pytest.mark.parametrize("how", ["emptied", "cut", "zeroed"])
@pytest.mark.parametrize("kind", ["nbi", "nbc"])
def test_damaged_kernels_are_compiled_again(tmp_path: Path, how: str, kind: str) -> None:
    """A power failure can damage files that have just been written."""
    (tmp_path / "inner.py").write_text(INNER)
    run(tmp_path, "-c", CALL)
    for path in tmp_path.rglob(f"*.{kind}"):
        damage(path, how)
    errors = tmp_path / "errors"
    assert run(tmp_path, "-c", CALL)[0] == "6.0 [0.0, 1.0, 2.0, 3.0] 0"
    assert errors.read_text().count("damaged; they are compiled again") == 1
    assert run(tmp_path, "-c", CALL)[0] == "6.0 [0.0, 1.0, 2.0, 3.0] 1"
    assert errors.read_text() == ""


def test_signatures_that_two_processes_save_at_once_are_not_mixed_up(tmp_path, monkeypatch) -> None:
    one, two, later = (_CheckedFiles(str(tmp_path), "kernel", 0) for _ in range(3))
    read, write = two._load_index(), one._save_index
    monkeypatch.setattr(two, "_load_index", lambda: read)  # before the first process saved its own
    monkeypatch.setattr(one, "_save_index", lambda index: (write(index), two.save("int64", 64)))
    one.save("int32", 32)
    assert later.load("int32") in (32, None)
    assert later.load("int64") == 64


SMALL_DISK = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
"""


@pytest.mark.slow
def test_kernels_that_do_not_fit_on_the_disk(tmp_path: Path) -> None:
    (tmp_path / "inner.py").write_text(INNER)
    errors = tmp_path / "errors"
    no_bytecode = {"PYTHONDONTWRITEBYTECODE": "1"}  # Python would write half a file, and read it
    for _ in range(2):
        printed = run(tmp_path, "-c", SMALL_DISK + CALL, **no_bytecode)
        assert printed[0] == "6.0 [0.0, 1.0, 2.0, 3.0] 0"
        assert errors.read_text().count("cannot be kept (File too large)") == 1


@pytest.mark.slow
@pytest.mark.parametrize("numba_of", ["from vslam.support.kernels", "UNKNOWN"])
def test_an_installation_without_a_writable_folder(tmp_path: Path, numba_of: str) -> None:
    source = (
        INNER if numba_of != "UNKNOWN" else INNER.replace("from vslam.support.kernels", UNKNOWN, 1)
    )
    (tmp_path / "inner.py").write_text(source)
    (tmp_path / "__pycache__").touch()  # not even root can make a folder here
    nowhere = {name: "/dev/null/none" for name in ("NUMBA_CACHE_DIR", "HOME", "XDG_CACHE_HOME")}
    (tmp_path / "temporary").mkdir()
    nowhere["TMPDIR"] = str(tmp_path / "temporary")
    errors = tmp_path / "errors"
    assert run(tmp_path, "-c", CALL, **nowhere)[0] == "6.0 [0.0, 1.0, 2.0, 3.0] 0"
    assert errors.read_text().count("Set NUMBA_CACHE_DIR to a writable folder") == 1
    assert list((tmp_path / "temporary").iterdir()) == []


UNKNOWN = """kernels.TESTED_NUMBA = "unknown"
from vslam.support.kernels"""
