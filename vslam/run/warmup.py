"""Compiles all kernels before the first frame, so that compilation does not slow down the run.

In the first run on a machine, compilation takes most of the time. A process of its own,
``python -m vslam.run.toy_room``, calls every kernel, which leaves it in Numba's cache. It can work
while images are rendered, and the process of the run does not need the memory of the compiler.
Later runs load a kernel when they first call it.

If the process cannot be started or fails, the run compiles each kernel at its first call.
"""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

# A process that takes longer hangs. Even on a slow machine, it takes less than three minutes.
PATIENCE_S = 600.0


class Compilation:
    """The process that compiles the kernels. It is ended when the context ends.

    >>> with Compilation() as kernels:
    ...     kernels.start()  # if something else can be done meanwhile
    ...     kernels.finish()
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Compilation:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def start(self) -> None:
        """Start the process if kernels are missing in the cache. A second call does nothing."""
        # The executable of a frozen application is not Python.
        here = sys.executable and not getattr(sys, "frozen", False)
        if self._process is None and here and is_cold():
            # -P: do not import a folder "vslam" in the current directory.
            command = [sys.executable, "-P", "-m", "vslam.run.toy_room"]
            quiet = subprocess.DEVNULL
            with suppress(OSError):
                self._process = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet)

    def finish(self) -> None:
        """Start the process if necessary, and wait until it has compiled the kernels."""
        self.start()
        if self._process is not None:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(PATIENCE_S)


def compile_kernels() -> None:
    """Compile the kernels that are missing in the cache, in a process of its own."""
    with Compilation() as kernels:
        kernels.finish()


def is_cold() -> bool:
    """Return whether kernels have not been compiled, or have changed since then."""
    try:
        known = json.loads(record_file().read_text())
        return any(Path(file).stat().st_mtime_ns != time for file, time in known.items())
    except (OSError, ValueError):
        return True


def record_file() -> Path:
    """Return the file that lists the sources of the compiled kernels and their times of change.

    It lies in Numba's cache. Each version of Python and Numba has its own file.
    """
    import numba  # takes a quarter of a second

    from vslam.types.geometry import compose

    folder = Path(compose.stats.cache_path)  # type: ignore[attr-defined]
    return folder / f"compiled-{sys.implementation.cache_tag}-numba-{numba.__version__}.json"
