"""Measure how much a visible car hood degrades tracking, and how much a mask helps.

    python tools/experiments/masks/hood.py --data TOWNS --seq kitti07 --rows 0.2 0.35

A hood with a random texture is painted over the lower part of the images of a stereo drive. The
hood stays in place in the image while the street moves. The script runs vslam on the drive without
the hood, with the hood, and with the hood and a mask. For each run, it prints the number of lost
frames, the number of inliers and the ATE.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.config import Config
from vslam.datasets import open_sequence
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.frontend.masks import Mask
from vslam.slam import Slam
from vslam.types.features import TrackingState
from vslam.types.trajectory import Trajectory

DISPARITY = 90  # disparity of the hood in pixels; it is large because the hood is near


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="folder of KITTI, or of rendered towns")
    parser.add_argument("--seq", default="00")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--rows", type=float, nargs="+", default=[0.3], help="height, 0 to 1")
    parser.add_argument("--method", default="auto", help="tracking.method")
    options = parser.parse_args()
    source = open_sequence("kitti", options.data, options.seq, max_frames=options.frames)
    truth = Trajectory(source.timestamps, source.ground_truth)
    config = Config.model_validate({"tracking": {"method": options.method}})
    print("| hood | mask | lost | median inliers | ATE, m |\n|---|---|---|---|---|")
    for rows, masked in [(0.0, False), *((r, m) for r in options.rows for m in (False, True))]:
        hood, mask = draw_hood(source.camera.height, source.camera.width, rows)
        slam = Slam(source.camera, config, threads=1)
        results = []
        for k, timestamp in enumerate(source.timestamps.tolist()):
            left, right = source.read(k)
            left = np.where(mask > 0, left, hood)
            on_right = (np.roll(one, -DISPARITY, axis=1) for one in (mask, hood))
            right = np.where(next(on_right) > 0, right, next(on_right))
            results.append(slam.step(left, right, timestamp, mask=mask if masked else None))
        slam.finish()
        lost = sum(result.state == TrackingState.LOST for result in results)
        inliers = np.median([result.n_inliers for result in results])
        ate = evaluate_trajectory(slam.trajectory(), truth, "se3").ate_rmse_m
        used = "yes" if masked else "no"
        print(f"| {rows:.0%} | {used} | {lost} | {inliers:.0f} | {ate:.3f} |", flush=True)
    start = time.perf_counter()
    for _ in range(100):
        Mask.of(mask, config.orb)
    print(f"preparing a mask takes {10.0 * (time.perf_counter() - start):.1f} ms")


def draw_hood(height: int, width: int, rows: float) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Draw the ``(H, W)`` texture of a car hood, and its mask (0 on the hood, 255 elsewhere).

    The upper edge of the hood is an arc. ``rows`` is the share of the rows that the hood covers in
    the middle column of the image.
    """
    texture = np.random.default_rng(0).integers(20, 230, (height // 4, width // 4), dtype=np.uint8)
    texture = cv2.resize(cv2.GaussianBlur(texture, (0, 0), 1.0), (width, height))
    arc = height * (1.0 - rows * (1.0 - (np.arange(width) / width - 0.5) ** 2))
    mask = np.where(np.arange(height)[:, None] < arc, 255, 0).astype(np.uint8)
    return np.asarray(texture, np.uint8), mask


if __name__ == "__main__":
    main()
