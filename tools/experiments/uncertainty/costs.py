"""Measure the CPU time of covariances, masks and the export to ROS.

    python tools/experiments/uncertainty/costs.py --data "$KITTI_ROOT" --seq 06 --frames 51

The script runs vslam on a stereo drive, alternately without a mask and with a mask that hides
nothing, and prints the medians of the CPU times. It fails if the trajectories of any two runs
differ.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from vslam.cli.export import ros
from vslam.datasets.perturbation import parse_perturbation
from vslam.datasets.sources import open_source
from vslam.frontend import tracking
from vslam.method import motion
from vslam.report.folder import write_results
from vslam.run.options import RunOptions
from vslam.run.outcome import RunOutcome
from vslam.run.pipeline import run_sequence
from vslam.run.recorder import Recorder
from vslam.run.slam_run import begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", required=True, help="folder of KITTI")
    parser.add_argument("--seq", default="06")
    parser.add_argument("--frames", type=int, default=51)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    n, camera = options.repeats, run(options, None).sequence.camera  # this compiles the kernels
    spent: dict[str, list[float]] = defaultdict(list)
    for owner, name in (
        (tracking, "pose_covariance"), (tracking, "offset_effect"), (motion, "moved")
    ):  # fmt: skip
        setattr(owner, name, timed(getattr(owner, name), spent[name]))
    outcomes: dict[str, list[RunOutcome]] = defaultdict(list)
    with TemporaryDirectory() as folder:
        white = Path(folder) / "white.png"
        cv2.imwrite(str(white), np.full((camera.height, camera.width), 255, np.uint8))
        for _ in range(n):
            outcomes["no mask"].append(run(options, None))
            outcomes["mask"].append(run(options, white))
        last = outcomes["mask"][-1]
        write_results(Path(folder), last, pages=False)
        for k in range(n):
            out = Path(folder) / f"{k}.mcap"
            timed(ros, spent["export ros"])(Path(folder), out=out, quiet=True)
    every = [outcome for several in outcomes.values() for outcome in several]
    trajectories = {outcome.trajectory.T_wc.tobytes() for outcome in every}
    assert len(trajectories) == 1, "the trajectories differ"
    for name, several in outcomes.items():
        ms = [1e3 * outcome.cpu_s / len(outcome.tracks) for outcome in several]
        print(f"{name}: {np.median(ms):.2f} ms per frame ({min(ms):.2f} to {max(ms):.2f})")
    for name, times in spent.items():
        per_frame = len(times) / (len(every) * len(last.tracks))
        print(f"{name}: {1e3 * np.median(times):.3f} ms per call, {per_frame:.2f} calls per frame")


def run(options: argparse.Namespace, mask: Path | None) -> RunOutcome:
    given = RunOptions(
        data=options.data, dataset="kitti", seq=options.seq, max_frames=options.frames, mask=mask,
        detector="none",
    )  # fmt: skip
    return run_sequence(begin(open_source(given), given), parse_perturbation("none", 0), Recorder())


def timed(function: Callable[..., Any], times: list[float]) -> Callable[..., Any]:
    """Wrap a function so that the CPU time of each call, in seconds, is appended to ``times``."""

    def called(*args: Any, **more: Any) -> Any:
        start = time.thread_time()
        result = function(*args, **more)
        times.append(time.thread_time() - start)
        return result

    return called


if __name__ == "__main__":
    main()
