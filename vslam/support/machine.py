"""Properties of this machine and of this process, which are determined without slow imports."""

from __future__ import annotations

import os
import platform
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

# Constants of glibc's malloc.h.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
KEPT_BYTES = 1 << 28
_PACKAGES = (
    "vslam",
    "numpy",
    "numba",
    "opencv-python-headless",
    "opencv-python",
    "opencv-contrib-python-headless",
    "opencv-contrib-python",
    "evo",
    "rerun-sdk",
    "torch",
    "gtsam",
)


def versions() -> dict[str, str]:
    """Return the version of Python and of each listed package that is installed."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def opencv_conflict(found: dict[str, str]) -> str | None:
    """Return a warning if several installed wheels provide the module ``cv2``, otherwise None."""
    wheels = [name for name in found if name.startswith("opencv-")]
    if len(wheels) < 2:
        return None
    return (
        f"{' and '.join(wheels)} both install cv2 and overwrite each other: uninstall all, "
        "then install opencv-python-headless"
    )


def available_cores() -> int:
    """Return the number of cores that this process may use.

    A container may have fewer cores than its machine.
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def process_age() -> float:
    """Return the seconds since this process started."""
    with suppress(OSError, AttributeError):  # the system is not Linux
        # The process name is in brackets and may contain spaces. Field 22 is the start time in
        # ticks since boot.
        started = Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]
        return time.clock_gettime(time.CLOCK_BOOTTIME) - int(started) / os.sysconf("SC_CLK_TCK")
    import psutil

    return time.time() - psutil.Process().create_time()


def peak_memory_mb() -> float:
    """Return the peak resident memory of this process so far, in MB (2**20 bytes)."""
    import resource

    # Linux's getrusage includes the memory of the parent process from before exec.
    if found := _property("/proc/self/status", "VmHWM"):
        return int(found.split()[0]) / 2**10
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def keep_memory() -> None:
    """Let the C library keep large freed blocks for the next frame's images.

    By default, the C library returns these blocks to the system, which must clear each page again.
    This takes 1/30 of the CPU time. In addition, this function makes all threads share one arena,
    which saves 40 MB. It does nothing if the C library is not glibc.
    """
    import ctypes

    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        for option in (M_MMAP_THRESHOLD, M_TRIM_THRESHOLD):
            libc.mallopt(option, KEPT_BYTES)
        libc.mallopt(M_ARENA_MAX, 1)


def give_back_memory() -> None:
    """Give the unused memory that ``keep_memory`` retained back to the system (glibc only)."""
    import ctypes

    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def set_up_openblas() -> None:
    """Set up OpenBLAS, which computes NumPy's matrix products. NumPy must not be imported yet.

    OpenBLAS gets one thread. Idle threads burn CPU time, and no matrix of a run is large enough to
    profit from several threads.

    OpenBLAS also gets the kernels for AVX2 on every CPU that has AVX2. By default, it uses other
    kernels on CPUs with AVX-512. They round differently, so a few pixels of rendered images differ.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if has_avx2():
        os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")


def has_avx2() -> bool:
    """Return whether the processor is known to have AVX2 and FMA (Linux only)."""
    return {"avx2", "fma"} <= set(_property("/proc/cpuinfo", "flags").split())


def cpu_name() -> str:
    """Return the model name of the processor."""
    # platform.processor() is empty or just "x86_64" on Linux.
    model = _property("/proc/cpuinfo", "model name")
    return model or platform.processor() or platform.machine()


def _property(file: str, name: str) -> str:
    """Return the first value of a name in a file of Linux's ``/proc``; empty if there is none."""
    with suppress(OSError), open(file) as lines:
        for line in lines:
            if line.startswith(name):
                return line.partition(":")[2].strip()
    return ""


@dataclass
class StageClock:
    """Measures the wall time of each stage of the pipeline, in milliseconds."""

    ms: dict[str, float] = field(default_factory=dict)
    last: float = field(default_factory=time.perf_counter)

    def lap(self, stage: str) -> None:
        """Add the time since the last call, or since the clock was created, to a stage."""
        now = time.perf_counter()
        self.ms[stage] = self.ms.get(stage, 0.0) + 1e3 * (now - self.last)
        self.last = now
