"""Calls all kernels, by SLAM in a small synthetic room. ``vslam/run/warmup.py`` tells why.

The camera drives along a circle in a round room and looks outwards. Its view is therefore always
the same warp of the picture on the wall, which is turned from frame to frame. It meets everything
that calls kernels: a drive with an IMU, frames in the dark, after which the camera is relocalised,
and a loop, followed by global bundle adjustment. ``call_rare_kernels`` calls the others.

Monocular runs need no further kernels.
"""

from __future__ import annotations

import gc
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from vslam.config import Config, as_config
from vslam.datasets.png import unfilter
from vslam.frontend.pose import MIN_TRUSTED, optimise_pose
from vslam.loopclosure.local_matching import DescriptorMaps, locate, locate_near, match_coarse
from vslam.run.warmup import record_file
from vslam.slam import Slam
from vslam.types.camera import Camera, Image
from vslam.types.imu import GRAVITY, ImuCalibration
from vslam.types.map import Map

CAMERA = Camera(160.0, 160.0, 160.0, 120.0, 0.1, 320, 240)
WALL, CIRCLE = 2.0, 0.5  # radii of the room and of the circle, in metres
LAP, PERIOD = 60, 0.1  # number of frames of a lap, and seconds between frames
DARK = (12, 13)  # frames without light
AROUND, HIGH = 4096, 512  # size of the picture on the wall, in pixels
# Loops may be short and are closed whatever their error, and most keyframes are redundant.
LOOP = as_config({
    "bow": {"exclude_recent": 5},
    "mapping": {"redundant_ratio": 1e-6},
    "pose_graph": {"max_loop_error": 1e9},
})  # fmt: skip
FEATURES = as_config({"tracking": {"method": "orb"}})


def call_kernels() -> None:
    """Call every kernel that a run may call."""
    drive(CAMERA, LOOP, LAP + LAP // 4)
    drive(replace(CAMERA, depth=True), FEATURES, DARK[-1] + 3, ImuCalibration(np.eye(4)))
    call_rare_kernels()


def drive(camera: Camera, config: Config, frames: int, imu: ImuCalibration | None = None) -> None:
    """Run SLAM on a drive through the room."""
    wall = picture()
    left, right = view(0.0), view(CAMERA.baseline)
    turn = 2.0 * np.pi / (LAP * PERIOD)  # rad/s
    samples = np.zeros((10, 7))
    samples[:, 2] = turn
    samples[:, 4:] = 0.0, -GRAVITY, -CIRCLE * turn**2
    slam = Slam(camera, config, "bow", threads=1, imu=imu)
    for k in range(frames):
        lit = np.zeros_like(wall) if k in DARK else wall
        images: list[Image] = []
        for x, y in (left[:2], right[:2]):
            x = np.mod(x + np.float32(k * AROUND / LAP), np.float32(AROUND - 1))
            image = cv2.remap(lit, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
            images.append(image.astype(np.uint8))
        samples[:, 0] = PERIOD * (k + np.arange(-9, 1) / 10.0)
        second = left[2] if camera.depth else images[1]
        slam.step(images[0], second, PERIOD * k, imu=samples)
    slam.finish()
    slam.trajectory()


def picture() -> NDArray[np.uint8]:
    """Return the picture on the wall: random blots of three sizes."""
    rng = np.random.default_rng(0)
    wall = np.full((HIGH, AROUND), 128.0, np.float32)
    for size in (2.0, 6.0, 20.0):
        noise = cv2.GaussianBlur(rng.standard_normal(wall.shape, np.float32), (0, 0), size)
        wall += 30.0 / noise.std() * noise
    return np.clip(wall, 0, 255).astype(np.uint8)


def view(x: float) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return where a camera sees the wall that lies ``x`` metres to the right of the left camera.

    Returns:
        ``(H, W)`` columns and rows in the picture on the wall, and depths in metres.
    """
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    right, down = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    # The ray (x + right * depth, CIRCLE + depth) meets the circle with radius WALL.
    a, b, c = right**2 + 1.0, x * right + CIRCLE, x**2 + CIRCLE**2 - WALL**2
    depth = (np.sqrt(b**2 - a * c) - b) / a
    angle = np.arctan2(x + right * depth, CIRCLE + depth)
    pixels_per_radian = AROUND / (2.0 * np.pi)
    columns, rows = angle * pixels_per_radian, down * depth / WALL * pixels_per_radian + HIGH / 2
    return columns.astype(np.float32), rows.astype(np.float32), depth.astype(np.float32)


def call_rare_kernels() -> None:
    """Call the kernels for learned descriptors, moving objects, sub-maps and PNG files."""
    rng = np.random.default_rng(0)
    coarse, fine = (rng.standard_normal((rows, 2 * rows, 4), np.float32) for rows in (4, 16))
    maps, xy = DescriptorMaps(coarse, fine, 1.0), np.full((2, 2), 20.0, np.float32)
    locate(xy, maps, maps, match_coarse(maps, maps, -1.0), 1, -1.0)
    locate_near(xy, np.full((2, 2), 20.0), maps, maps, 1, -1.0)

    points = rng.uniform([-4.0, -2.0, 9.0], [4.0, 2.0, 12.0], (200, 3))
    trusted = np.arange(len(points)) < 2 * MIN_TRUSTED
    uvr = CAMERA.project(points + np.where(trusted, 0.0, 0.5)[:, None])
    weights = np.ones(len(points))
    optimise_pose(np.eye(4), points, uvr, weights, CAMERA.intrinsics, trusted=trusted)

    Map(np.ones(1)).submaps()
    unfilter(np.zeros((2, 5), np.uint8), np.empty((2, 4), np.uint8))


def record_sources() -> None:
    """Record from which files the kernels were compiled (``warmup.is_cold``)."""
    functions = [one.py_func for one in gc.get_objects() if isinstance(one, Dispatcher)]
    files = {one.__code__.co_filename for one in functions if one.__module__.startswith("vslam.")}
    times = {file: Path(file).stat().st_mtime_ns for file in sorted(files)}
    record_file().write_text(json.dumps(times))


if __name__ == "__main__":
    gc.disable()  # it would take 14 % of the time, but free little memory
    call_kernels()
    record_sources()
