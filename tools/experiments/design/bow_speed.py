"""CPU time of a query of the bag-of-words detector among many keyframes.

Words are drawn as often as training images had them, which is harder than real streets: there,
rare words come together. Every keyframe shares landmarks with those around it.

usage: python tools/experiments/design/bow_speed.py [KEYFRAMES] [FEATURES]
"""

from __future__ import annotations

import sys
import time

import numpy as np

from vslam.features import Features
from vslam.loopclosure.bow import BowDetector
from vslam.loopclosure.vocabulary import load
from vslam.map import Map
from vslam.map_kernels import link_many

REPEATS = 50
NEIGHBOURS, LANDMARKS = 10, 50  # a keyframe sees so many new ones, and those of so many before


def main() -> None:
    n_keyframes, n_features = (*map(int, sys.argv[1:]), *(5000, 2000)[len(sys.argv) - 1 :])
    rng = np.random.default_rng(0)
    tree = load()
    leaves = tree.descriptors[tree.word >= 0].view(np.uint8)
    popular = np.cumsum(np.exp(-tree.weight.astype(float)))
    detector, map_ = BowDetector(tree), Map(np.ones(8))
    seen = NEIGHBOURS * LANDMARKS
    blank = features(np.zeros((seen, 32), np.uint8))
    added, asked, located = [], [], []
    for k in range(n_keyframes):
        map_.add_keyframe(blank, np.eye(4), float(k), k)
        map_.add_landmarks(np.zeros((LANDMARKS, 3)), np.zeros((LANDMARKS, 4), np.uint64), k)
        rows = np.arange(map_.rows(k).start, map_.rows(k).stop)
        landmarks = np.arange((k + 1) * LANDMARKS - seen, (k + 1) * LANDMARKS, dtype=np.int32)
        link_many(map_.arrays, rows[landmarks >= 0], landmarks[landmarks >= 0])
        image = features(leaves[np.searchsorted(popular, rng.random(n_features) * popular[-1])])
        start = time.thread_time()
        detector.add(k, None, image)
        added.append(time.thread_time() - start)
        if k < n_keyframes - REPEATS:
            continue
        start = time.thread_time()
        detector.query(k, map_)
        asked.append(time.thread_time() - start)
        start = time.thread_time()
        detector.locate(None, image, map_)
        located.append(time.thread_time() - start)
    print(f"{n_keyframes} keyframes of {n_features} features")
    for name, times in (("add", added[-REPEATS:]), ("query", asked), ("locate", located)):
        ms = np.percentile(times, [0, 50]) * 1e3
        print(f"{name:<8}{ms[0]:.2f} ms at best, {ms[1]:.2f} ms median")


def features(descriptors: np.ndarray) -> Features:
    n = len(descriptors)
    none = np.full(n, np.nan, np.float32)
    return Features(
        np.zeros((n, 2), np.float32), np.zeros(n, np.uint8), np.zeros(n, np.float32),
        descriptors, none,
    )  # fmt: skip


if __name__ == "__main__":
    main()
