"""SLAM on a rendered fisheye pair against its rectified twin: ATE of both.

    vslam synth block --fisheye --max-frames 100 --out fisheye
    python tools/experiments/cameras/fisheye_twin.py fisheye block

The twin is cut out of the pinhole images that the fisheye ones were warped from, pixel by pixel
without resampling: of the size of the fisheye images, about the route's own principal point.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, ImageMap
from vslam.config import Config
from vslam.datasets.euroc import open_euroc
from vslam.datasets.kitti import KittiSequence, open_kitti
from vslam.datasets.perturbation import Perturbation
from vslam.datasets.sequence import Image, Sequence
from vslam.datasets.synthetic import built_in_route
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.run.outcome import RunSettings, matched_ground_truth
from vslam.run.pipeline import run_sequence
from vslam.run.recorder import Recorder


@dataclass(frozen=True)
class Cut:
    """A part of each image of a rectified sequence; see `vslam.datasets.sequence.Sequence`."""

    whole: KittiSequence
    camera: Camera
    x: int
    y: int
    dataset: str = "cut"
    name: str = "cut"

    @property
    def timestamps(self) -> NDArray[np.float64]:
        return self.whole.timestamps

    @property
    def ground_truth(self) -> NDArray[np.float64] | None:
        return self.whole.ground_truth

    def __len__(self) -> int:
        return len(self.whole)

    def read(self, index: int, image_map: ImageMap = map) -> tuple[Image, Image | None]:
        """Left and right part."""
        down = slice(self.y, self.y + self.camera.height)
        across = slice(self.x, self.x + self.camera.width)
        left, right = self.whole.read(index, image_map)
        return left[down, across].copy(), None if right is None else right[down, across].copy()


def twin(folder: Path, route: str) -> Cut:
    """The rectified sequence of the same pixels as a folder of `vslam synth --fisheye`."""
    (root,) = (folder / "pinhole").iterdir()
    whole = open_kitti(root, route)
    own = built_in_route(route).camera
    x, y = round(whole.camera.cx - own.cx), round(whole.camera.cy - own.cy)
    camera = replace(own, cx=whole.camera.cx - x, cy=whole.camera.cy - y)
    return Cut(whole, camera, x, y)


def ate(sequence: Sequence) -> float:
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
