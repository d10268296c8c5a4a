"""Compare the errors of odometry and of loops with their covariances, for each drive.

    python tools/experiments/uncertainty/nees.py DATA SEQ[:START[:FRAMES]] ... [--perturb LAW ...]

DATA is a folder in KITTI's format with exact ground truth, for example with rendered drives. vslam
is run on every drive under every perturbation. The script prints the normalised estimation error
squared (NEES) of the motion over intervals of 1 s and of 10 s. The NEES is defined by Bar-Shalom et
al., Estimation with Applications to Tracking and Navigation, 2001, section 5.4. The script divides
the NEES by the six degrees of freedom. The mean is then 1 if the covariances are consistent, and
larger than 1 if the covariances are too small.

The last columns give the number of loops whose pose was verified, and the mean NEES of these poses.
The covariance of a loop is multiplied by ``pose_graph.loop_inflation``, as in the pose graph.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.config import Config
from vslam.datasets import open_sequence
from vslam.datasets.frames import Source
from vslam.datasets.perturbation import parse_perturbation, perturbed
from vslam.evaluation.odometry import motion_errors
from vslam.slam import Slam
from vslam.types.features import TrackResult
from vslam.types.geometry import inverse, se3_log
from vslam.types.trajectory import Trajectory

Float = NDArray[np.float64]
INFLATION = Config().pose_graph.loop_inflation
INTERVALS_S = (1.0, 10.0)
SKIPPED = 20  # frames at the start that are left out, because the map is still new
EVERY = 7  # frames between the starts of intervals; overlapping intervals have nearly equal errors


def results_of(source: Source, law: str, seed: int) -> tuple[list[TrackResult], Slam]:
    slam = Slam(source.camera)
    perturbation = parse_perturbation(law, seed).bound_to(source)
    results = []
    for frame in perturbed(source.frames(), perturbation):
        left, right = frame.read(map)
        results.append(slam.step(left, right, frame.timestamp))
    slam.finish()
    return results, slam


def mean_nees(results: list[TrackResult], truth: Trajectory, interval_s: float) -> float:
    """Compute the mean NEES of motions over intervals, divided by the degrees of freedom."""
    return float(motion_errors(results, truth, interval_s).nees[SKIPPED::EVERY].mean())


def nees_of_loops(slam: Slam, times: Float, truth: Float) -> list[float]:
    """Compute the NEES of each loop whose pose was verified, divided by the degrees of freedom."""
    found = []
    for loop in slam.loops:
        verified = loop.accepted or loop.reason.startswith("verified")
        if not verified or loop.T_query_match is None or loop.covariance is None:
            continue
        ends = slam.map.timestamps[[loop.query, loop.match]]
        query, match = truth[np.searchsorted(times, ends - 1e-6)]
        error = se3_log(inverse(query) @ match @ inverse(loop.T_query_match))
        found.append(error @ np.linalg.solve(INFLATION * loop.covariance, error) / 6.0)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("drives", nargs="+", metavar="SEQ[:START[:FRAMES]]")
    parser.add_argument("--perturb", nargs="+", default=["none"], metavar="LAW")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print("| drive | law | NEES over 1 s | NEES over 10 s | loops | NEES of loops |")
    print("|---|---|---|---|---|---|")
    rows, of_loops = [], []
    for drive in options.drives:
        name, *part = drive.split(":")
        start, frames = (*map(int, part), 0, 0)[:2]
        source = open_sequence("kitti", options.data, name, start=start, max_frames=frames or None)
        times, poses = source.timestamps, source.ground_truth
        if poses is None:
            parser.error(f"{drive} has no ground truth")
        for law in options.perturb:
            results, slam = results_of(source, law, options.seed)
            truth, loops = Trajectory(times, poses), nees_of_loops(slam, times, poses)
            rows.append([mean_nees(results, truth, s) for s in INTERVALS_S])
            of_loops += loops
            print(f"| {drive} | {law} | {_cells(rows[-1], loops)} |", flush=True)
    print(f"| mean | | {_cells(np.mean(rows, axis=0).tolist(), of_loops)} |")


def _cells(of_odometry: list[float], of_loops: list[float]) -> str:
    loops = f"{len(of_loops)} | {np.mean(of_loops):.2f}" if of_loops else "0 | "
    return " | ".join(f"{value:.2f}" for value in of_odometry) + f" | {loops}"


if __name__ == "__main__":
    main()
