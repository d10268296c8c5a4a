"""Measure how the scale of a monocular drive drifts if the focal length is wrong.

    python tools/experiments/results/focal_length.py --data $KITTI_ROOT --seq 00 --frames 500
    python tools/experiments/results/focal_length.py --dataset synthetic --seq 05 --frames 600

The left camera runs without loop closing, with its focal length multiplied by ``--factors``. A
wrong focal length changes the scale where the camera turns, but not where it drives straight ahead.
Prints the ATE after Sim3 alignment, and how much the scale grows with each quarter turn and each
100 m: a linear fit to the logarithm of the ratio of estimated to true length, over pieces of
``--piece`` frames.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.config import Config
from vslam.datasets import open_sequence
from vslam.evaluation.trajectories import evaluate_trajectory, path_length
from vslam.geometry import Matrix
from vslam.run.preparation import prepared_frames
from vslam.slam import Slam
from vslam.trajectory import Trajectory


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dataset", default="kitti")
    parser.add_argument("--data", type=Path, help="folder of the data set, if it has one")
    parser.add_argument("--seq", default="00")
    parser.add_argument("--frames", type=int, default=500)
    parser.add_argument("--factors", type=float, nargs="+", default=[0.97, 1.0, 1.03])
    parser.add_argument("--piece", type=int, default=25, help="frames")
    options = parser.parse_args()
    sequence = open_sequence(
        options.dataset, options.data, options.seq, max_frames=options.frames, monocular=True
    )
    truth = Trajectory(sequence.timestamps, sequence.ground_truth)
    print("| focal length | ATE, Sim3, m | scale by 90 degrees | by 100 m |\n|---|---|---|---|")
    for factor in options.factors:
        fx, fy = sequence.camera.fx * factor, sequence.camera.fy * factor
        slam = Slam(replace(sequence.camera, fx=fx, fy=fy), Config())
        for timestamp, prepared in prepared_frames(sequence.frames(), slam.context, 2):
            slam.step_images(prepared.images, timestamp)
        slam.finish()
        estimate = slam.trajectory()
        by_turn, by_metre = scale_drift(estimate.T_wc, truth.T_wc, options.piece)
        ate = evaluate_trajectory(estimate, truth, "sim3").ate_rmse_m
        turn, metres = np.expm1(by_turn * np.pi / 2), np.expm1(100.0 * by_metre)
        print(f"| {factor:.3f} | {ate:.3f} | {turn:+.1%} | {metres:+.1%} |", flush=True)


def scale_drift(
    T_wc: NDArray[np.float64], T_true: NDArray[np.float64], piece: int
) -> tuple[float, float]:
    """Growth of the logarithm of the scale per radian of turning, and per metre."""
    ours, theirs = path_length(T_wc), path_length(T_true)
    turned = np.concatenate([[0.0], np.cumsum([angle(*ends) for ends in pairwise(T_true)])])
    edges = np.arange(0, len(T_wc), piece)
    driven, true = np.diff(ours[edges]), np.diff(theirs[edges])
    moved = (true > 1.0) & (driven > 0.0)  # before the map begins, the estimate stands still
    middle = (edges[:-1] + piece // 2)[moved]
    columns = np.stack([np.ones(len(middle)), turned[middle], theirs[middle]], axis=1)
    fit = np.linalg.lstsq(columns, np.log(driven[moved] / true[moved]), rcond=None)[0]
    return float(fit[1]), float(fit[2])


def angle(one: Matrix, other: Matrix) -> float:
    """Radians between the viewing directions of two poses."""
    return float(np.arccos(np.clip(one[:3, 2] @ other[:3, 2], -1.0, 1.0)))


if __name__ == "__main__":
    main()
