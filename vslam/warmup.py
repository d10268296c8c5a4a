"""Compile every kernel before the first frame, so that no run is timed while it compiles.

Compiling takes longer than anything else in a first run, and one process compiles one kernel at a
time: Numba holds a lock. Two processes share the work, and find each other's in Numba's cache:

- *this* process calls ``HERE``: what comes before and around local mapping;
- a *second* one, ``python -m vslam.warmup``, calls ``BESIDE``: local mapping;
- then this process runs a small SLAM over everything. It loads what was compiled, and compiles
  what the second process did not, all of it if there was none.

A module with new kernels adds a function that calls them to the shorter of ``HERE`` and ``BESIDE``
(and to ``run_everything``, if the small SLAM does not reach them). Which one is shorter:

    for half in HERE BESIDE; do
        NUMBA_CACHE_DIR=$(mktemp -d) python -c "
    import time; from vslam import warmup
    [share() for share in warmup.$half]; print('$half', time.process_time(), 's')"
    done

A kernel that both need is compiled by whoever comes to it first. Both must call it with the same
types: for one signature two writers of Numba's cache cannot harm each other, for two they can.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np

from vslam.backend import bundle_adjustment
from vslam.backend.bundle_adjustment import BundleProblem, adjust
from vslam.camera import StereoCamera
from vslam.config import Config, KeyframeConfig, MappingConfig
from vslam.features import Features
from vslam.frontend.orb import scale_factors
from vslam.info import available_cores
from vslam.mapping import DeferredMapping
from vslam.slam import Slam

WIDTH, HEIGHT, DISPARITY, STEP, FRAMES = 480, 240, 12, 6, 6
CAMERA = StereoCamera(240.0, 240.0, WIDTH / 2, HEIGHT / 2, 0.5, WIDTH, HEIGHT)
# A second process that takes longer is stuck: it has less to do than this one.
PATIENCE_S = 60.0


def compile_kernels(*, processes: int = 2) -> None:
    """Call every kernel once; Numba caches what it compiles.

    Args:
        processes: with 1 no second process is started, nor if the kernels are compiled already or
            there is one core only.
    """
    if processes > 1 and available_cores() > 1 and is_cold():
        with second_process() as is_running:
            if is_running:
                for share in HERE:
                    share()
    run_everything()


def is_cold() -> bool:
    """Whether kernels must be compiled: the largest one is not in Numba's cache, or older than its
    source."""
    source = Path(bundle_adjustment.__file__)
    largest = bundle_adjustment._adjust
    cache = Path(largest.stats.cache_path)  # type: ignore[attr-defined]
    indices = cache.glob(f"{source.stem}.{largest.__name__}-*.nbi")
    return all(index.stat().st_mtime < source.stat().st_mtime for index in indices)


@contextmanager
def second_process() -> Iterator[bool]:
    """Run ``BESIDE`` in another process and wait for it on leaving; gives whether one was started.

    If it fails, nothing is lost but its help. An exception, Ctrl-C above all, ends it.
    """
    process = None
    # The executable of a frozen application is not Python.
    if sys.executable and not getattr(sys, "frozen", False):
        # -P: not from a folder "vslam" that happens to be where we are.
        command = [sys.executable, "-P", "-m", "vslam.warmup"]
        quiet = subprocess.DEVNULL
        with suppress(OSError):
            process = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet)
    if process is None:
        yield False
        return
    try:
        yield True
        process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        pass
    finally:
        process.kill()
        process.wait()


def run_everything() -> None:
    """Run SLAM on a few small images with a keyframe at each.

    A camera slides along a textured wall: enough for tracking, triangulation, fusion and bundle
    adjustment to take all their branches.
    """
    every_frame = KeyframeConfig(max_interval_s=0.05, merge_after_frames=1)
    run_slam(Config(keyframes=every_frame), FRAMES)


def compile_tracking() -> None:
    """Extraction, stereo, matching, pose and tracking: the small SLAM with one keyframe."""
    no_other = KeyframeConfig(max_interval_s=1e9, max_tracked_ratio=1e-6, min_tracked_close=0)
    run_slam(Config(keyframes=no_other), 3)


def run_slam(config: Config, frames: int) -> None:
    rng = np.random.default_rng(0)
    noise = rng.uniform(0, 255, (HEIGHT, WIDTH + DISPARITY + STEP * FRAMES)).astype(np.float32)
    wall = cv2.GaussianBlur(noise, (0, 0), 2.0)
    wall = np.clip(128 + 5.0 * (wall - 128), 0, 255).astype(np.uint8)
    slam = Slam(CAMERA, config, threads=1)
    for k in range(frames):
        x = STEP * k
        left, right = wall[:, x : x + WIDTH], wall[:, x + DISPARITY : x + DISPARITY + WIDTH]
        slam.step(np.ascontiguousarray(left), np.ascontiguousarray(right), 0.1 * k)
    slam.finish()
    slam.trajectory()


def compile_insertion() -> None:
    """What inserting a keyframe needs, in tracking's time."""
    map_synthetic(1)


def compile_local_mapping() -> None:
    """What follows an insertion: triangulation, fusion, bundle adjustment, culling."""
    map_synthetic(4)


def map_synthetic(keyframes: int) -> None:
    """Map a camera that moves sideways past a cloud of points, without images.

    Every keyframe sees all points. The first half of them are near and have a stereo match, the
    rest are left for triangulation. A keyframe is redundant from one landmark, so that the fourth
    insertion culls one.
    """
    config = Config(mapping=MappingConfig(redundant_ratio=1e-6))
    mapping = DeferredMapping(scale_factors(config.orb), CAMERA, config, threads=1)
    rng = np.random.default_rng(0)
    n = 400
    points = rng.uniform([-5.0, -4.0, 9.0], [9.0, 4.0, 12.0], (n, 3))
    descriptors = rng.integers(0, 256, (n, 32), dtype=np.uint8)
    landmark = np.full(n, -1, np.int32)
    for k in range(keyframes):
        T_cw = np.eye(4)
        T_cw[0, 3] = -1.0 * k
        uvr = CAMERA.project(points + T_cw[:3, 3])
        uvr[n // 2 :, 2] = np.nan
        features = Features(
            uvr[:, :2].astype(np.float32),
            np.zeros(n, np.uint8),
            np.zeros(n, np.float32),
            descriptors,
            uvr[:, 2].astype(np.float32),
        )
        landmark, _ = mapping.insert(features, landmark, T_cw, 0.1 * k, k)
        mapping.merge()
        landmark, _ = mapping.current(landmark)


def compile_bundle_adjustment() -> None:
    """A problem of one free camera and two points, as ``assemble`` makes them."""
    points = np.array([[-1.0, 0.5, 8.0], [1.0, -0.5, 9.0]])
    uvr = np.repeat(CAMERA.project(points), 2, axis=0)
    problem = BundleProblem(
        T_cw=np.stack([np.eye(4), np.eye(4)]),
        n_free=1,
        points=points,
        first=np.array([0, 2, 4], np.int64),
        camera=np.array([0, 1, 0, 1], np.int64),
        uvr=uvr,
        inverse_sigma2=np.ones(4),
        intrinsics=CAMERA.intrinsics,
    )
    adjust(problem, iterations=1)


# ``BESIDE`` starts with what it needs alone: when it comes to insert keyframes, the kernels for
# that are in the cache, because ``HERE`` starts with them.
HERE: tuple[Callable[[], None], ...] = (compile_insertion, compile_tracking)
BESIDE: tuple[Callable[[], None], ...] = (compile_bundle_adjustment, compile_local_mapping)


if __name__ == "__main__":
    for share in BESIDE:
        share()
