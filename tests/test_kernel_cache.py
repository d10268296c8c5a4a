"""Kernels out of the cache: what is left out when they are loaded, and what is not."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numba

# Writes what it loaded of Numba's compiler, then the result, in a process of its own.
INNER = """
import sys
import numpy as np
from numba.core import types
from vslam import kernels
from vslam.kernels import inner_kernel, kernel

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
from vslam.kernels import kernel

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


def run(folder: Path, *words: str) -> list[str]:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache")}
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_a_kernel_is_loaded_without_what_compiles(tmp_path: Path) -> None:
    (tmp_path / "inner.py").write_text(INNER)
    assert run(tmp_path, "-c", CALL)[0] == "6.0 [0.0, 1.0, 2.0, 3.0] 0"
    assert run(tmp_path, "-c", CALL) == ["6.0 [0.0, 1.0, 2.0, 3.0] 1", "False False"]


def test_a_kernel_is_compiled_from_loaded_ones(tmp_path: Path) -> None:
    (tmp_path / "inner.py").write_text(INNER)
    (tmp_path / "outer.py").write_text(OUTER)
    run(tmp_path, "-c", CALL)
    assert run(tmp_path, "outer.py") == ["12.0", "0 1", "first"]
    assert run(tmp_path, "outer.py") == ["12.0", "1 0", "first"]


def test_the_installed_release_of_numba_is_known() -> None:
    """Another one works, with its own cache; see whether ``_KernelCache`` does with it."""
    from vslam.kernels import TESTED_NUMBA

    assert numba.__version__.startswith(TESTED_NUMBA)


def test_an_unknown_release_uses_its_own_cache(tmp_path: Path) -> None:
    (tmp_path / "inner.py").write_text(INNER.replace("from vslam.kernels", UNKNOWN, 1))
    for hits in "01":
        assert run(tmp_path, "-c", CALL)[0] == f"6.0 [0.0, 1.0, 2.0, 3.0] {hits}"


UNKNOWN = """kernels.TESTED_NUMBA = "unknown"
from vslam.kernels"""
