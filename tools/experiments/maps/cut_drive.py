"""Write the parts of a route out of order as one sequence, as if the camera were carried about.

    python tools/experiments/maps/cut_drive.py demo --parts 4 --overlap 60 --out cut
    vslam stress --data cut --seqs 00 --laws jpeg --steps 1 --seeds 1 --systems vslam,orbslam3 ...
    python tools/experiments/maps/cut_drive.py --score STRESS/kitti-00-none-*

Sequence 00 of the KITTI tree consists of the parts of ``merge_drives.py``, those with even numbers
first, each in its own light. After each part, the camera is a second later at another place. A
system with several maps starts a new one after each cut, and joins them where they meet.

``--score`` prints, for run folders, the lost frames and the ATE of the tracked ones; frames that
are lost between two places have no meaningful pose.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import cv2
import numpy as np
from merge_drives import lit_frames, parts

from vslam.datasets import open_sequence
from vslam.datasets.synthetic.store import calibration_text
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.trajectory import Trajectory, read_kitti_poses, write_kitti

FRAME_S, CUT_S = 0.1, 1.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("route", nargs="?", default="demo")
    parser.add_argument("--parts", type=int, default=4)
    parser.add_argument("--overlap", type=int, default=100, help="frames")
    parser.add_argument("--perturb", default="brightness:1")
    parser.add_argument("--max-frames", type=int)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--score", type=Path, nargs="+", default=[])
    options = parser.parse_args()
    for folder in options.score:
        score(folder)
    if options.out is not None:
        cut(options)


def cut(options: argparse.Namespace) -> None:
    sequence = open_sequence("synthetic", None, options.route, max_frames=options.max_frames)
    drives = list(enumerate(parts(len(sequence), options.parts, options.overlap)))
    folder = options.out / "sequences" / "00"
    for side in (0, 1):
        (folder / f"image_{side}").mkdir(parents=True)
    kept: list[int] = []
    times: list[float] = []
    for seed, frames in drives[::2] + drives[1::2]:
        start = times[-1] + CUT_S if times else 0.0
        for number, frame in enumerate(lit_frames(sequence, frames, options.perturb, seed)):
            for side, image in enumerate(frame.read(map)):
                cv2.imwrite(str(folder / f"image_{side}" / f"{len(kept):06d}.png"), image)
            kept.append(frames[number])
            times.append(start + FRAME_S * number)
    (folder / "times.txt").write_text("".join(f"{t:.9e}\n" for t in times))
    (folder / "calib.txt").write_text(calibration_text(sequence.camera))
    (options.out / "poses").mkdir()
    write_kitti(options.out / "poses" / "00.txt", sequence.ground_truth[np.array(kept)])
    print(f"{options.out}: {len(kept)} frames in {len(drives)} parts")


def score(folder: Path) -> None:
    with (folder / "frames.csv").open() as file:
        states = [row["state"] for row in csv.DictReader(file)]
    tracked = np.flatnonzero(np.array(states) != "LOST")
    paths = [folder / "trajectory_kitti.txt", folder / "ground_truth_kitti.txt"]
    found, truth = (
        Trajectory(np.arange(float(len(tracked))), read_kitti_poses(path)[tracked])
        for path in paths
    )
    ate = evaluate_trajectory(found, truth, "se3").ate_rmse_m
    print(f"{folder.name}: {len(states) - len(tracked)} of {len(states)} frames lost, ", end="")
    print(f"ATE of the others {ate:.4f} m")


if __name__ == "__main__":
    main()
