"""Measure the effect of GPS on the error of a drive.

    python tools/experiments/gps/drive.py RUN [RUN ...] --seeds 5

The script simulates a GPS receiver along the ground truth of finished runs. The receiver gives one
fix per second. The fixes have white noise and a bias that follows a random walk. They also have
gaps, and jumps by 20 m that last ten seconds. The script prints the RMSE of the following
positions, as a mean over the seeds:

- the positions of the run without GPS, after the alignment for its sensor;
- the positions of the fixes;
- the positions of the fixes, interpolated at the times of the frames, with and without SE3
  alignment;
- the positions of the run with GPS, with and without SE3 alignment;
- with ``--antenna``, the positions of a run with GPS, in which the antenna is assumed to be at the
  camera.

Finally, it prints the median CPU time that was needed to add the fixes after the drive.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.backend import gps
from vslam.config import load_config
from vslam.datasets.fixes import Fixes, to_enu, to_geodetic
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.maps.storage import load_map
from vslam.run.gps import locate
from vslam.run.outcome import alignment_of
from vslam.types.trajectory import Trajectory, read_trajectory

DATUM = np.array([49.0, 8.4, 115.0])
# The axes x, y and z of the ground truth point right, down and ahead of the camera at the first
# frame. It is assumed that this camera looks north-east.
R_ENU_TRUTH = np.array([[1, 0, 1], [0, 2**0.5, 0], [-1, 0, 1]])[[0, 2, 1]] / 2**0.5
R_ENU_TRUTH[2] *= -1.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="folders of runs with ground truth")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--noise", type=float, default=1.0, help="white noise per axis, m")
    parser.add_argument(
        "--walk", type=float, default=0.05, help="random walk of the bias, m/sqrt s"
    )
    parser.add_argument("--gaps", type=int, default=3, help="number of gaps of 30 s")
    parser.add_argument("--jumps", type=int, default=3, help="number of jumps")
    parser.add_argument("--hertz", type=float, default=1.0, help="fixes per second")
    parser.add_argument("--sigma", type=float, default=1.5, help="accuracy that fixes claim, m")
    parser.add_argument(
        "--correlation", type=float, default=gps.CORRELATION_S, help="correlation time assumed, s"
    )
    parser.add_argument(
        "--antenna", type=float, nargs=3, default=(0.0, 0.0, 0.0), metavar=("X", "Y", "Z"),
        help="position of the antenna in the frame of the left camera, m",
    )  # fmt: skip
    options = parser.parse_args()
    gps.CORRELATION_S = options.correlation
    print("| run | positions of | error after alignment, m | error, m | refused, wrongly refused |")
    print("|---|---|---|---|---|")
    for run in options.runs:
        measure(run, options)


def measure(run: Path, options: argparse.Namespace) -> None:
    """Measure the errors of a run with GPS for every seed, and print the means over the seeds."""
    visual = read_trajectory(run / "trajectory.tum")
    truth = read_trajectory(run / "ground_truth_kitti.txt", visual.timestamps)
    truth = Trajectory(truth.timestamps, truth.T_wc.copy())
    truth.T_wc[:, :3] = R_ENU_TRUTH @ truth.T_wc[:, :3]
    stored, config = load_map(run / "map.npz"), load_config(run / "config.json")
    arms = {"with GPS": np.array(options.antenna)}
    if arms["with GPS"].any():
        arms["with GPS, antenna taken to be at the camera"] = np.zeros(3)
    names = "fixes", "GPS alone", *arms
    rows: dict[str, list[tuple[float, ...]]] = {name: [] for name in names}
    spent: list[float] = []
    for seed in range(options.seeds):
        fixes, is_jump = simulated(truth, options, seed)
        alone = np.column_stack(
            [np.interp(truth.timestamps, fixes.times, x) for x in to_enu(fixes.geodetic, DATUM).T]
        )
        rows["GPS alone"].append((*errors(alone, truth), np.nan, np.nan))
        true = antenna_at(fixes.times, truth, fixes.antenna)
        apart = np.linalg.norm(to_enu(fixes.geodetic, DATUM) - true, axis=1)
        rows["fixes"].append((np.nan, float(np.sqrt(np.mean(apart**2))), np.nan, np.nan))
        for name, antenna in arms.items():
            start = time.process_time()
            track = locate(stored, replace(fixes, antenna=antenna), config.pose_graph)
            spent.append(time.process_time() - start)
            assert len(track.anchored.used) == len(fixes)
            wrongly = float(np.mean(~track.anchored.used[~is_jump]))
            missed = int(np.sum(track.anchored.used & is_jump))
            # The first fix is the datum of a run.
            placed = to_enu(to_geodetic(track.trajectory.T_wc[:, :3, 3], track.datum), DATUM)
            rows[name].append((*errors(placed, truth), wrongly, missed))
    alignment = alignment_of(stored.camera.sensor)
    without = evaluate_trajectory(visual, truth, alignment).ate_rmse_m
    print(f"| {run.resolve().name} | vision alone | {without:.2f} ({alignment}) | | |")
    for label, values in rows.items():
        aligned, absolute, wrongly, missed = np.mean(values, axis=0)
        jumps = f"{100 * wrongly:.1f} % of the good, {missed:.1f} jumped fixes kept"
        jumps = "" if np.isnan(wrongly) else jumps
        shown = "" if np.isnan(aligned) else f"{aligned:.2f}"
        print(f"| | {label} | {shown} | {absolute:.2f} | {jumps} |", flush=True)
    print(
        f"\n{np.median(spent):.1f} s CPU for {len(fixes)} fixes, {len(stored.map.frames)} keyframes"
    )


def errors(positions: NDArray[np.float64], truth: Trajectory) -> tuple[float, float]:
    """Compute the RMSE of ``(N, 3)`` positions in metres, with and without SE3 alignment."""
    T_wc = truth.T_wc.copy()
    T_wc[:, :3, 3] = positions
    aligned = evaluate_trajectory(Trajectory(truth.timestamps, T_wc), truth, "se3").ate_rmse_m
    apart = np.linalg.norm(positions - truth.T_wc[:, :3, 3], axis=1)
    return aligned, float(np.sqrt(np.mean(apart**2)))


def antenna_at(
    times: NDArray[np.float64], truth: Trajectory, antenna: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Compute the ``(M, 3)`` true positions of the antenna at ``(M,)`` times.

    ``antenna`` is the position of the antenna in the camera frame.
    """
    points = truth.T_wc[:, :3, :3] @ antenna + truth.T_wc[:, :3, 3]
    return np.column_stack([np.interp(times, truth.timestamps, x) for x in points.T])


def simulated(
    truth: Trajectory, options: argparse.Namespace, seed: int
) -> tuple[Fixes, NDArray[np.bool_]]:
    """Simulate GPS fixes along the ground truth.

    Returns the fixes, and for each fix whether it lies in a simulated jump.
    """
    rng = np.random.default_rng(seed)
    first, last = truth.timestamps[[0, -1]]
    times = np.arange(first, last, 1.0 / options.hertz)
    antenna = np.array(options.antenna)
    enu = antenna_at(times, truth, antenna)
    steps = rng.normal(0.0, options.walk / options.hertz**0.5, enu.shape)
    enu += rng.normal(0.0, options.noise, enu.shape) + np.cumsum(steps, axis=0)
    is_jump, is_gap = np.zeros((2, len(times)), np.bool_)
    for begin in rng.uniform(first, max(first, last - 10.0), options.jumps):
        at = (times >= begin) & (times < begin + 10.0)
        angle = rng.uniform(0.0, 2.0 * np.pi)
        enu[at & ~is_jump] += 20.0 * np.array([np.cos(angle), np.sin(angle), 0.0])
        is_jump |= at
    for begin in rng.uniform(first, max(first, last - 30.0), options.gaps):
        is_gap |= (times >= begin) & (times < begin + 30.0)
    fixes = Fixes(times, to_geodetic(enu, DATUM), np.full(enu.shape, options.sigma), antenna)
    return fixes.select(~is_gap), is_jump[~is_gap]


if __name__ == "__main__":
    main()
