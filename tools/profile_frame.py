"""Profile the CPU time of a run, and print a Markdown table with the time per frame of each stage.

    python tools/profile_frame.py DATA SEQ FRAMES [--detector bow] [--report]

DATA is a folder in KITTI's format. The run has only one thread, so that the CPU clock of this
thread measures every stage. The total is the CPU time of the process, from the start of Python
until the last file is written.

Run the script twice. In the second run, the kernels are loaded from Numba's cache. The time for
loading a kernel counts for the first stage that calls the kernel.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

# The functions of each stage, as pairs: module, and NAME or CLASS.NAME.
STAGES: tuple[tuple[str, tuple[tuple[str, str], ...]], ...] = (
    ("start: vocabulary", (("vslam.run.slam_run", "detector_with_images"),)),
    ("read images", (("vslam.datasets.image_files", "read_grey"),)),
    (
        "pyramids",
        (
            ("vslam.frontend.orb", "build_pyramid"),
            ("vslam.frontend.extraction", "build_pyramid"),
            ("vslam.frontend.extraction", "coarse_levels"),
        ),
    ),
    ("corners, orientations, smoothing, descriptors", (("vslam.frontend.orb", "extract_levels"),)),
    ("weak images", (("vslam.frontend.extraction", "extract_in_any_light"),)),
    ("extraction, the rest", (("vslam.frontend.weak_images", "extract"),)),
    ("features at patches", (("vslam.frontend.extraction", "extract_at"),)),
    ("stereo", (("vslam.frontend.extraction", "match_stereo"),)),
    ("sparse image alignment", (("vslam.frontend.tracker", "align_pose"),)),
    ("track by patches", (("vslam.frontend.tracker", "Tracker.track_patches"),)),
    ("match a keyframe's features", (("vslam.frontend.tracker", "Tracker.match_features"),)),
    ("track the previous frame", (("vslam.frontend.tracker", "Tracker._track_previous_frame"),)),
    ("track the local map", (("vslam.frontend.tracker", "Tracker.track_features"),)),
    ("insert keyframes", (("vslam.method.mapping", "Mapper.insert"),)),
    ("view of the map", (("vslam.method.published_map", "PublishedMap.refer_to"),)),
    ("triangulation", (("vslam.backend.local_mapping", "triangulate_with_neighbours"),)),
    ("fusion", (("vslam.backend.local_mapping", "fuse_neighbourhood"),)),
    ("local bundle adjustment", (("vslam.backend.local_mapping", "adjust_locally"),)),
    ("cull keyframes", (("vslam.backend.local_mapping", "cull_keyframes"),)),
    ("local mapping, the rest", (("vslam.method.mapping", "map_and_calibrate"),)),
    (
        "loops",
        (
            ("vslam.method.closing", "LoopClosing.search"),
            ("vslam.method.closing", "LoopClosing.close"),
            ("vslam.method.closing", "LoopClosing.finish"),
        ),
    ),
    ("publish", (("vslam.method.published_map", "PublishedMap.publish"),)),
    ("frame loop, the rest", (("vslam.run.pipeline", "run_sequence"),)),
    ("results", (("vslam.report.folder", "write_results"),)),
)


class StageClock:
    """Measures the CPU time of this thread in each stage, in seconds.

    If a stage calls another stage, the time counts only for the inner stage.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._inner = [0.0]

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def call(*args: Any, **named: Any) -> Any:
            self._inner.append(0.0)
            start = time.thread_time()
            try:
                return function(*args, **named)
            finally:
                passed = time.thread_time() - start
                self.seconds[stage] += passed - self._inner.pop()
                self._inner[-1] += passed

        return call

    def measure(self, stage: str, module_name: str, name: str) -> None:
        owner: Any = importlib.import_module(module_name)
        *classes, last = name.split(".")
        for each in classes:
            owner = getattr(owner, each)
        setattr(owner, last, self.timed(stage, getattr(owner, last)))


def table(seconds: dict[str, float], frames: int) -> str:
    whole = time.process_time()
    rows = [(stage, seconds[stage]) for stage, _ in STAGES]
    rows += [("imports and the rest of the start", whole - sum(s for _, s in rows))]
    lines = ["| stage | CPU ms/frame | share |", "|---|---|---|"]
    for stage, spent in [*rows, ("**whole process**", whole)]:
        lines.append(f"| {stage} | {1e3 * spent / frames:.2f} | {spent / whole:.1%} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("seq")
    parser.add_argument("frames", type=int)
    parser.add_argument("--detector", default="bow")
    parser.add_argument("--report", action="store_true", help="also write pages and figures")
    options = parser.parse_args()

    clock = StageClock()
    for stage, functions in STAGES:
        for module, name in functions:
            clock.measure(stage, module, name)

    from vslam.cli.main import main as run

    with tempfile.TemporaryDirectory(prefix="vslam-profile-") as out:
        sys.argv = [
            "vslam", "run", "--data", str(options.data), "--seq", options.seq, "--dataset", "kitti",
            "--max-frames", str(options.frames), "--detector", options.detector, "--threads", "1",
            "--no-record", "--quiet", "--out", out, "--report" if options.report else "--no-report",
        ]  # fmt: skip
        try:
            run()
        except SystemExit as end:
            if end.code:
                raise
    print(table(clock.seconds, options.frames))


if __name__ == "__main__":
    main()
