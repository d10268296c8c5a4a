"""A run that is split by saving and loading its map, beside the whole run, and localisation in it.

    python tools/experiments/maps/split_run.py --data KITTI --seq 06
    python tools/experiments/maps/split_run.py --dataset synthetic --seq demo --detector both

Prints ATE (m) of the whole run, of the run that was saved after some of its frames, loaded and
resumed, and of all frames localised in the map of the whole run, with their share.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from vslam.config import Config
from vslam.datasets import open_sequence
from vslam.datasets.frames import Source
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.run.outcome import alignment_of
from vslam.run.preparation import prepared_frames
from vslam.slam import Slam
from vslam.trajectory import Trajectory


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dataset", default="kitti")
    parser.add_argument("--data", type=Path, default=Path("data/kitti"))
    parser.add_argument("--seq", default="00")
    parser.add_argument("--mono", action="store_true")
    parser.add_argument("--detector", default="bow")
    parser.add_argument("--max-frames", type=int)
    parser.add_argument("--at", type=float, default=0.5, help="share of the frames before the cut")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    sequence = open_sequence(
        options.dataset,
        options.data,
        options.seq,
        max_frames=options.max_frames,
        monocular=options.mono,
    )
    with tempfile.TemporaryDirectory() as folder:
        compare(sequence, options.detector, options.at, options.threads, Path(folder))


def compare(sequence: Source, detector: str, at: float, threads: int, folder: Path) -> None:
    n, half = len(sequence), round(at * len(sequence))
    whole = begin(sequence, detector, threads)
    drive(whole, sequence, range(n), threads)
    whole.save(folder / "whole.npz")
    split = begin(sequence, detector, threads)
    drive(split, sequence, range(half), threads)
    split.save(folder / "half.npz", resumable=True)
    split = Slam.load(folder / "half.npz", threads=threads, resume=True)
    lost = drive(split, sequence, range(half, n), threads)
    found = Slam.load(folder / "whole.npz", threads=threads, localize=True)
    drive(found, sequence, range(n), threads)
    inside = found.in_map()
    ate = error(whole.trajectory(), sequence)
    resumed = error(split.trajectory(), sequence)
    localised = error(found.trajectory(), sequence)
    kind = "mono" if sequence.camera.monocular else sequence.camera.sensor
    print(
        f"| {sequence.dataset} {sequence.name}, {n} frames, {kind} | {detector} | {ate:.4f} m | "
        f"{resumed:.4f} m ({resumed / ate:.2f}), {lost} lost | "
        f"{100 * np.mean(inside):.1f} %, {localised:.4f} m ({localised / ate:.2f}) |"
    )


def begin(sequence: Source, detector: str, threads: int) -> Slam:
    return Slam(sequence.camera, Config(), detector, threads=threads)


def drive(slam: Slam, sequence: Source, frames: range, threads: int) -> int:
    """Returns how many frames were lost."""
    lost = 0
    chosen = (frame for k, frame in enumerate(sequence.frames()) if k in frames)
    for timestamp, prepared in prepared_frames(chosen, slam.context, threads):
        result = slam.step_features(prepared.extracted, timestamp, prepared.image)
        lost += result.state == "LOST"
    slam.finish()
    return lost


def error(trajectory: Trajectory, sequence: Source) -> float:
    truth = Trajectory(sequence.timestamps, sequence.ground_truth)
    alignment = alignment_of("mono" if sequence.camera.monocular else "stereo")
    return evaluate_trajectory(trajectory, truth, alignment).ate_rmse_m


if __name__ == "__main__":
    main()
