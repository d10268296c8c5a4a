"""Measure how time and memory grow with the number of keyframes in a simulated map.

    python tools/experiments/scale/growth.py --sizes 1250 2500 5000 --out growth.csv

The map represents a town with crossing streets. The camera travels along each street once, and
there is a keyframe every 5 m. Each keyframe has 2,000 features. 560 of them observe landmarks, of
which 140 are new. At a crossing, keyframes of both streets observe 40 common landmarks. Each
measurement runs in a process of its own, and times are CPU times of one core.
"""

from __future__ import annotations

import argparse
import csv
import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import psutil
from numpy.typing import NDArray

from vslam.backend.bundle_adjustment import BundleProblem
from vslam.backend.global_bundle_adjustment import adjust_globally
from vslam.backend.pose_graph import check_pose_graph, essential_graph, optimise
from vslam.config import Config
from vslam.loopclosure.bow import BowDetector
from vslam.loopclosure.vocabulary import load
from vslam.support.machine import peak_memory_mb
from vslam.types.camera import Camera
from vslam.types.features import Features
from vslam.types.geometry import compose, inverse, inverses, se3_exp
from vslam.types.loops import LoopEdge, PerKeyframe
from vslam.types.map import Map
from vslam.types.map_kernels import link_many
from vslam.types.map_view import local_map

CAMERA = Camera(718.856, 718.856, 607.2, 185.2, 0.54, 1241, 376)
STEP_M, BLOCK = 5.0, 20  # between keyframes; number of keyframes between crossings
FEATURES, NEW, AHEAD = 2000, 140, 3  # features, new landmarks, later keyframes that observe them
SHARED = 40  # landmarks that both streets observe at a crossing
LOCAL_KEYFRAMES = 30
REPEATS = 30


@dataclass(frozen=True)
class Town:
    """A simulated town with K keyframes and L landmarks.

    Attributes:
        T_cw: ``(K, 4, 4)`` poses of the keyframes.
        crossings: ``(C, 2)`` pairs of keyframes of two streets at the same place.
        observed: ``(O, 2)`` keyframe and landmark of each observation, sorted by landmark.
        points: ``(L, 3)`` landmarks in the world frame, in metres.
        starts_street: ``(K,)`` whether a keyframe is the first one of its street.
    """

    T_cw: NDArray[np.float64]
    crossings: NDArray[np.int64]
    observed: NDArray[np.int64]
    points: NDArray[np.float64]
    starts_street: NDArray[np.bool_]


def build_town(n: int) -> Town:
    """Build a square grid with just enough streets for ``n`` keyframes."""
    streets = max(2, int(np.ceil(np.sqrt(n / (2 * BLOCK)))))
    length = -(-n // (2 * streets))
    street, along = np.divmod(np.arange(n), length)
    across = street >= streets  # the street runs along x, otherwise along z
    place = np.stack([street % streets * BLOCK, along], axis=1)
    place[across] = place[across, ::-1]
    T_wc = np.array([se3_exp(np.array([0.0, 0, 0, 0, turn, 0])) for turn in (0.0, np.pi / 2)])
    T_wc = T_wc[across.astype(int)]
    T_wc[:, [0, 2], 3] = STEP_M * place

    rng = np.random.default_rng(0)
    ahead = rng.uniform(AHEAD * STEP_M + 5.0, 45.0, (n, NEW))
    side = rng.uniform(-0.5, 0.5, (n, NEW)) * (ahead - AHEAD * STEP_M)
    up = rng.uniform(-0.15, 0.15, (n, NEW)) * (ahead - AHEAD * STEP_M)
    local = np.stack([side, up, ahead], axis=2)
    points = np.einsum("nij,nkj->nki", T_wc[:, :3, :3], local) + T_wc[:, None, :3, 3]

    places = [tuple(one) for one in place.tolist()]
    along_z = {places[k]: k for k in np.flatnonzero(~across).tolist()}
    pairs = [
        (along_z[places[k]], k) for k in np.flatnonzero(across).tolist() if places[k] in along_z
    ]
    crossings = np.array(pairs, np.int64).reshape(-1, 2)
    # One camera looks along z, the other along x. Both see the landmarks between these directions.
    between = rng.uniform([8, -2, 8], [20, 1, 20], (len(crossings), SHARED, 3))
    points[crossings[:, 0], :SHARED] = T_wc[crossings[:, 0], None, :3, 3] + between

    landmark = np.arange(n * NEW).reshape(n, NEW)
    common = landmark[crossings[:, 0], :SHARED]
    along_street = np.ones(n * NEW, np.bool_)
    along_street[common] = False
    observed = [
        np.stack([np.repeat(np.arange(n), NEW), landmark.ravel()], axis=1),
        np.stack([np.repeat(crossings[:, 1], SHARED), common.ravel()], axis=1),
    ]
    for later in range(1, AHEAD + 1):
        k = np.flatnonzero(street[later:] == street[:-later])
        seen = np.stack([np.repeat(k + later, NEW), landmark[k].ravel()], axis=1)
        observed.append(seen[along_street[seen[:, 1]]])
    of_all = np.concatenate(observed)
    of_all = of_all[np.lexsort((of_all[:, 0], of_all[:, 1]))]
    return Town(inverses(T_wc), crossings, of_all, points.reshape(-1, 3), along == 0)


def build_map(town: Town) -> Map:
    """Build the map of a town."""
    map_, n = Map(1.2 ** np.arange(8)), len(town.T_cw)
    features = Features(
        np.zeros((FEATURES, 2), np.float32),
        np.zeros(FEATURES, np.uint8),
        np.zeros(FEATURES, np.float32),
        np.zeros((FEATURES, 32), np.uint8),
        np.full(FEATURES, np.nan, np.float32),
    )
    by_keyframe = town.observed[np.argsort(town.observed[:, 0], kind="stable")]
    first = np.searchsorted(by_keyframe[:, 0], np.arange(n + 1))
    for k in range(n):
        map_.add_keyframe(features, town.T_cw[k], 0.5 * k, 5 * k)
        map_.parents[k] = k - 1
        points = town.points[k * NEW : (k + 1) * NEW]
        map_.add_landmarks(points, np.zeros((NEW, 4), np.uint64), k)
        ids = by_keyframe[first[k] : first[k + 1], 1].astype(np.int32)
        link_many(map_.arrays, map_.rows(k).start + np.arange(len(ids)), ids)
    return map_


def measure_keyframe(n: int) -> dict[str, float]:
    """Measure the steps of a new keyframe whose time could depend on the size of the map, and the
    memory of the map and of its visual words."""
    town, vocabulary = build_town(n), load()
    before = memory_gb()
    map_ = build_map(town)
    of_map = memory_gb() - before

    # Words are drawn with the frequency that their weight, log(images / images with it), implies.
    cumulative, rng = np.cumsum(np.exp(-vocabulary.weight.astype(float))), np.random.default_rng(2)
    words = np.empty((n, FEATURES), np.int32)
    for of_keyframe in words:
        of_keyframe[:] = np.searchsorted(cumulative, cumulative[-1] * rng.random(FEATURES))
    known = PerKeyframe(FEATURES * np.arange(n + 1), words.ravel())
    detector, before = BowDetector(vocabulary), memory_gb()
    detector.restore(replace(detector.memory(), tables={"words": known}))
    of_words = memory_gb() - before

    return {
        "query_ms": median_ms(lambda k: detector.query(k, map_), n),
        "local_map_ms": median_ms(lambda k: local_map(map_, k, LOCAL_KEYFRAMES), n),
        "map_gb": of_map,
        "words_gb": of_words,
    }


def measure_loop(n: int) -> dict[str, float]:
    """Measure the pose graph after a loop between the last crossing's two streets."""
    town, config = build_town(n), Config().pose_graph
    map_ = build_map(town)
    match, query = town.crossings[-1].tolist()
    # In the tree, a street along x begins at a crossing, not at the end of the previous street.
    for first, second in town.crossings[::-1].tolist():
        if town.starts_street[second]:
            map_.parents[second] = first
    drift = se3_exp(np.array([0.3, 0.0, 0.2, 0.0, 2e-3, 0.0]))
    T_query_match = compose(drift, compose(town.T_cw[query], inverse(town.T_cw[match])))
    edge = LoopEdge(query, match, 1.0, True, "closed", T_query_match=T_query_match)
    seconds = 0.0
    for _ in range(2):  # the first call compiles kernels and imports GTSAM
        start = time.process_time()
        graph = essential_graph(map_, [edge], config)
        check_pose_graph(graph, optimise(graph, config), config)
        seconds = time.process_time() - start
    return {"pose_graph_s": seconds}


def measure_bundle(n: int) -> dict[str, float]:
    """Measure global bundle adjustment of all keyframes."""
    adjust_globally(bundle_problem(100), iterations=1)  # compiles the kernels
    problem = bundle_problem(n)
    before = memory_gb()
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    start = time.process_time()
    adjust_globally(problem, iterations=0)
    prepared = time.process_time() - start
    start = time.process_time()
    done = adjust_globally(problem, iterations=4, tolerance=0.0).iterations
    return {
        "bundle_preparation_s": prepared,
        "bundle_iteration_s": (time.process_time() - start - prepared) / done,
        "bundle_gb": peak_memory_mb() * 2**20 / 1e9 - before,
    }


def bundle_problem(n: int) -> BundleProblem:
    """Create a bundle adjustment problem with noisy observations, poses and landmarks."""
    town, rng = build_town(n), np.random.default_rng(1)
    keyframe, landmark = town.observed.T
    T = town.T_cw[keyframe]
    noise = rng.normal(0, 0.5, (len(keyframe), 3))
    noise[:, 2] = noise[:, 0] - noise[:, 2] / CAMERA.intrinsics[5]  # disparities are more accurate
    uvr = CAMERA.project(np.einsum("nij,nj->ni", T[:, :3, :3], town.points[landmark]) + T[:, :3, 3])
    twists = rng.normal(0, [0.05, 0.05, 0.05, 2e-3, 2e-3, 2e-3], (n, 6))
    T_cw = np.matmul([se3_exp(twist) for twist in twists], town.T_cw)
    T_cw[0] = town.T_cw[0]
    # The first keyframe is held fixed. Such cameras come last.
    return BundleProblem(
        T_cw=np.roll(T_cw, -1, axis=0),
        n_free=n - 1,
        points=town.points + rng.normal(0, 0.05, town.points.shape),
        first=np.searchsorted(landmark, np.arange(len(town.points) + 1)),
        camera=(keyframe - 1) % n,
        uvr=uvr + noise,
        inverse_sigma2=np.ones(len(uvr)),
        intrinsics=CAMERA.intrinsics,
    )


def median_ms(call: Callable[[int], object], n: int) -> float:
    """Return the median CPU time of ``call`` over the newest keyframes, in milliseconds."""
    times = []
    for k in range(n - REPEATS, n):
        start = time.thread_time()
        call(k)
        times.append(1e3 * (time.thread_time() - start))
    return float(np.median(times))


def memory_gb() -> float:
    """Return the resident memory of this process, in GB."""
    return float(psutil.Process().memory_info().rss) / 1e9


def measure(n: int) -> dict[str, float]:
    """Run each measurement in a new process, so that memory does not depend on the others."""
    found: dict[str, float] = {}
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, spawn, max_tasks_per_child=1) as pool:
        for measurement in (measure_keyframe, measure_loop, measure_bundle):
            found |= pool.submit(measurement, n).result()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", required=True, help="numbers of keyframes")
    parser.add_argument("--out", type=Path, required=True, metavar="CSV")
    options = parser.parse_args()
    rows = []
    for n in options.sizes:
        rows.append({"keyframes": str(n)} | {k: f"{v:.4g}" for k, v in measure(n).items()})
        print(rows[-1], flush=True)
    with options.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
