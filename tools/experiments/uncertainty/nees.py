"""Compare the errors of odometry with the covariances that vslam estimates, for each drive.

    python tools/experiments/uncertainty/nees.py DATA SEQ[:START[:FRAMES]] ... [--perturb LAW ...]

DATA is a folder in KITTI's format with exact ground truth, for example with rendered drives. vslam
is run on every drive under every perturbation. The script prints the normalised estimation error
squared (NEES) of the motion over intervals of 1 s and of 10 s. The NEES is defined by Bar-Shalom et
al., Estimation with Applications to Tracking and Navigation, 2001, section 5.4. The script divides
the NEES by the six degrees of freedom. The mean is then 1 if the covariances are consistent, and
larger than 1 if the covariances are too small.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from vslam.datasets import open_sequence
from vslam.datasets.frames import Source
from vslam.datasets.perturbation import parse_perturbation, perturbed
from vslam.evaluation.odometry import motion_errors
from vslam.features import TrackResult
from vslam.slam import Slam
from vslam.trajectory import Trajectory

INTERVALS_S = (1.0, 10.0)
SKIPPED = 20  # frames at the start that are left out, because the map is still new
EVERY = 7  # frames between the starts of intervals; overlapping intervals have nearly equal errors


def results_of(source: Source, law: str, seed: int) -> list[TrackResult]:
    slam = Slam(source.camera)
    perturbation = parse_perturbation(law, seed).bound_to(source)
    results = []
    for frame in perturbed(source.frames(), perturbation):
        left, right = frame.read(map)
        results.append(slam.step(left, right, frame.timestamp))
    slam.finish()
    return results


def mean_nees(results: list[TrackResult], truth: Trajectory, interval_s: float) -> float:
    """Compute the mean NEES of motions over intervals, divided by the degrees of freedom."""
    return float(motion_errors(results, truth, interval_s).nees[SKIPPED::EVERY].mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("drives", nargs="+", metavar="SEQ[:START[:FRAMES]]")
    parser.add_argument("--perturb", nargs="+", default=["none"], metavar="LAW")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print("| drive | law | NEES over 1 s | NEES over 10 s |\n|---|---|---|---|")
    rows = []
    for drive in options.drives:
        name, *part = drive.split(":")
        start, frames = (*map(int, part), 0, 0)[:2]
        source = open_sequence("kitti", options.data, name, start=start, max_frames=frames or None)
        for law in options.perturb:
            results = results_of(source, law, options.seed)
            truth = Trajectory(source.timestamps, source.ground_truth)
            rows.append([mean_nees(results, truth, s) for s in INTERVALS_S])
            print(f"| {drive} | {law} | {rows[-1][0]:.2f} | {rows[-1][1]:.2f} |", flush=True)
    one, ten = np.mean(rows, axis=0)
    print(f"| mean | | {one:.2f} | {ten:.2f} |")


if __name__ == "__main__":
    main()
