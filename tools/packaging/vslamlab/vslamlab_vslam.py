"""Runs vslam on a sequence of VSLAM-LAB. VSLAM-LAB calls this program with these options.

The sequence is a folder with images, a list of them (``rgb_exp.csv``, times in nanoseconds) and
``calibration.yaml``. The result is ``ITERATION_KeyFrameTrajectory.csv`` with the final poses of all
frames.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vslam import Slam
from vslam.calibration.models import Calibration, CameraModel
from vslam.datasets.frames import Source
from vslam.datasets.image_files import checked_files, depth_scale_of
from vslam.datasets.rectified import rectified
from vslam.types.geometry import inverse
from vslam.types.trajectory import Trajectory, quaternions

HEADER = ["ts (ns)", "tx (m)", "ty (m)", "tz (m)", "qx", "qy", "qz", "qw"]
LENSES = {"equid4": "fisheye"}  # all other distortions are those of a pinhole camera


def open_sequence(
    folder: Path, rgb_csv: Path, calibration_yaml: Path, mode: str
) -> tuple[Source, list[int]]:
    """Open a sequence for the mode ``mono``, ``stereo`` or ``rgbd``.

    Returns:
        The source of rectified frames, and the time of each frame in nanoseconds.
    """
    with rgb_csv.open(newline="") as file:
        rows = list(csv.DictReader(file))
    second = {"mono": [], "stereo": ["rgb_1"], "rgbd": ["depth_0"]}[mode]
    names = ["rgb_0", *second]
    files = [[folder / row[f"path_{name}"] for row in rows] for name in names]
    stamps = [int(float(row["ts_rgb_0 (ns)"])) for row in rows]
    given = yaml.safe_load(calibration_yaml.read_text())["cameras"]
    cameras = {camera["cam_name"]: camera for camera in given}
    left = cameras["rgb_0"]
    scale = None
    calibration = Calibration(model_of(left), source=str(calibration_yaml))
    if mode == "stereo":
        T_body_left, T_body_right = (pose_of(cameras[name]) for name in ("rgb_0", "rgb_1"))
        calibration = Calibration(
            calibration.left,
            model_of(cameras["rgb_1"]),
            inverse(T_body_left) @ T_body_right,
            source=str(calibration_yaml),
        )
    elif mode == "rgbd":
        scale = depth_scale_of(None, float(left["depth_factor"]))
    times = np.array(stamps, np.float64) / 1e9
    raw = checked_files("vslamlab", folder.name, times, None, files, scale)
    return rectified(raw, calibration), stamps


def model_of(camera: dict[str, Any]) -> CameraModel:
    (fx, fy), (cx, cy) = (map(float, camera[key]) for key in ("focal_length", "principal_point"))
    width, height = camera["image_dimension"]
    lens = LENSES.get(camera.get("distortion_type", ""), "pinhole")
    distortion = tuple(map(float, camera.get("distortion_coefficients", ())))
    return CameraModel(fx, fy, cx, cy, width, height, lens, distortion)


def pose_of(camera: dict[str, Any]) -> np.ndarray:
    """Return ``(4, 4)`` ``T_body_camera``."""
    return np.reshape(np.array(camera["T_BS"], np.float64), (4, 4))


def run(source: Source, detector: str) -> Trajectory:
    slam = Slam(source.camera, detector=detector)
    for frame in source.frames():
        left, second = frame.read(map)
        slam.step(left, second, frame.timestamp)
    slam.finish()
    return slam.trajectory()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("sequence_path", "calibration_yaml", "rgb_csv", "exp_folder"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--exp_it", default="0")
    parser.add_argument("--mode", choices=["mono", "stereo", "rgbd"], default="mono")
    parser.add_argument("--detector", default="both")
    options, _ = parser.parse_known_args()  # VSLAM-LAB also gives --settings_yaml and --verbose
    source, stamps = open_sequence(
        options.sequence_path, options.rgb_csv, options.calibration_yaml, options.mode
    )
    T_wc = run(source, options.detector).T_wc
    path = options.exp_folder / f"{options.exp_it.zfill(5)}_KeyFrameTrajectory.csv"
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(HEADER)
        for stamp, T, q in zip(stamps, T_wc, quaternions(T_wc[:, :3, :3]), strict=True):
            table.writerow([stamp, *T[:3, 3].tolist(), *q.tolist()])


if __name__ == "__main__":
    main()
