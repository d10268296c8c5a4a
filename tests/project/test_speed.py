"""Guards against changes that make a method ten times slower.

Examples are a kernel that is compiled at each call, or work that grows with the square of the map.

The CPU time of this thread is measured alternately for the method and for a fixed kernel. A slower
or busier machine slows both of them. Their ratio differs by a factor of two or three between
processors, which the limit allows. `tools/bench_speed.py` measures smaller differences.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from vslam.config import Config
from vslam.slam import Slam
from vslam.support.kernels import kernel

REPEATS = 3
RATIO_MEASURED = 0.56  # frames tracked and mapped on two Xeon cores with AVX-512, November 2026


@kernel
def fixed_work(image, out):
    """Compute the sum of a star of nine pixels for every pixel, 20 times."""
    height, width = image.shape
    for _ in range(20):
        for y in range(2, height - 2):
            for x in range(2, width - 2):
                across = image[y, x - 2] + 2 * image[y, x - 1] + 4 * image[y, x]
                across += 2 * image[y, x + 1] + image[y, x + 2]
                down = image[y - 2, x] + 2 * image[y - 1, x] + 2 * image[y + 1, x]
                down += image[y + 2, x]
                out[y, x] = (across + down) >> 4


def least_in_turn(*calls: Callable[[], object]) -> list[float]:
    """Return the least CPU time of each call in seconds. The first round compiles."""
    taken = np.empty((REPEATS + 1, len(calls)))
    for repeat in range(REPEATS + 1):
        for number, call in enumerate(calls):
            start = time.thread_time()
            call()
            taken[repeat, number] = time.thread_time() - start
    return taken[1:].min(axis=0).tolist()


@pytest.mark.slow
def test_a_frame_tracked_and_mapped(corridor):
    image = np.random.default_rng(0).integers(0, 256, (376, 1241)).astype(np.int32)
    out = np.zeros_like(image)

    def drive() -> None:
        slam = Slam(corridor.camera, Config(), "none", threads=1)
        for k in range(len(corridor.left)):
            slam.step(corridor.left[k], corridor.right[k], corridor.timestamps[k])
        slam.finish()

    cv2.setNumThreads(1)  # the time of other threads would not be counted
    fixed, driven = least_in_turn(lambda: fixed_work(image, out), drive)
    assert driven / fixed / len(corridor.left) < 10 * RATIO_MEASURED
