"""Compile every kernel before the first frame, so that no run is timed while it compiles."""

from __future__ import annotations

import cv2
import numpy as np

from vslam.camera import StereoCamera
from vslam.config import Config, KeyframeConfig
from vslam.slam import Slam

WIDTH, HEIGHT, DISPARITY, STEP, FRAMES = 480, 240, 12, 6, 6


def compile_kernels() -> None:
    """Run SLAM on a few small images with a keyframe at each; Numba caches what it compiles.

    A camera slides along a textured wall: enough for tracking, triangulation, fusion and bundle
    adjustment to take all their branches.
    """
    rng = np.random.default_rng(0)
    noise = rng.uniform(0, 255, (HEIGHT, WIDTH + DISPARITY + STEP * FRAMES)).astype(np.float32)
    wall = cv2.GaussianBlur(noise, (0, 0), 2.0)
    wall = np.clip(128 + 5.0 * (wall - 128), 0, 255).astype(np.uint8)
    camera = StereoCamera(240.0, 240.0, WIDTH / 2, HEIGHT / 2, 0.5, WIDTH, HEIGHT)
    every_frame = KeyframeConfig(max_interval_s=0.05, merge_after_frames=1)
    slam = Slam(camera, Config(keyframes=every_frame), threads=1)
    for k in range(FRAMES):
        x = STEP * k
        left, right = wall[:, x : x + WIDTH], wall[:, x + DISPARITY : x + DISPARITY + WIDTH]
        slam.step(np.ascontiguousarray(left), np.ascontiguousarray(right), 0.1 * k)
    slam.finish()
    slam.trajectory()
