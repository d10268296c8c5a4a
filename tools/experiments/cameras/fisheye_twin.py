"""Compare the ATE on a rendered fisheye pair with that on its rectified twin.

    vslam synth block --fisheye --max-frames 100 --out fisheye
    python tools/experiments/cameras/fisheye_twin.py fisheye block

The twin is a crop, without resampling, of the pinhole images from which the fisheye images were
warped. It has the size of the fisheye images and contains the route's principal point.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from vslam.camera import ImageMap
from vslam.config import Config
from vslam.datasets.euroc import open_euroc
from vslam.datasets.frames import Images, Source, TimedFrame
from vslam.datasets.kitti import open_kitti
from vslam.datasets.perturbation import Perturbation
from vslam.datasets.synthetic import built_in_route
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.run.outcome import RunSettings, matched_ground_truth
from vslam.run.pipeline import run_sequence
from vslam.run.recorder import Recorder


def twin(folder: Path, route: str) -> Source:
    """The part of each image of the rectified sequence that shows the same pixels as a folder of
    `vslam synth --fisheye`."""
    (root,) = (folder / "pinhole").iterdir()
    whole = open_kitti(root, route)
    own = built_in_route(route).camera
    x, y = round(whole.camera.cx - own.cx), round(whole.camera.cy - own.cy)
    part = slice(y, y + own.height), slice(x, x + own.width)

    def cut(frame: TimedFrame) -> TimedFrame:
        def read(image_map: ImageMap) -> Images:
            left, right = frame.read(image_map)
            return left[part].copy(), None if right is None else right[part].copy()

        return TimedFrame(frame.timestamp, read)

    camera = replace(own, cx=whole.camera.cx - x, cy=whole.camera.cy - y)
    stored = tuple(map(cut, whole.stored))
    return replace(whole, dataset="cut", name="cut", camera=camera, stored=stored)


def ate(sequence: Source) -> float:
    """ATE (m) of a run without loop closing."""
    settings = RunSettings(
        dataset=sequence.dataset, sequence=sequence.name, perturb="none", detector="none",
        sensor="stereo", seed=0, threads=2, start=0, every=1, max_frames=None, config=Config(),
    )  # fmt: skip
    outcome = run_sequence(sequence, Perturbation("none"), settings, Recorder())
    truth = matched_ground_truth(outcome)
    assert truth is not None
    return evaluate_trajectory(outcome.trajectory, truth).ate_rmse_m


if __name__ == "__main__":
    folder, route = Path(sys.argv[1]), sys.argv[2]
    fisheye, rectified = ate(open_euroc(folder, "")), ate(twin(folder, route))
    print(f"fisheye {fisheye:.4f} m, rectified twin {rectified:.4f} m")
    print(f"ratio {fisheye / rectified:.3f}")
