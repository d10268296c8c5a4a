"""Time what runs behind a closed loop, on simulated drives with loops.

    python tools/experiments/design/bench_optimisers.py [bundle] [graph] [covisibility]

prints, for each: its size, the time of the whole call (best of three, and the first one with
compilation left out), and how well it did.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from vslam.backend.bundle_adjustment import BundleProblem
from vslam.backend.global_bundle_adjustment import adjust_globally
from vslam.backend.pose_graph import (
    COVISIBLE,
    LOOP,
    TREE,
    PoseGraph,
    edge_sigmas,
    essential_graph,
    optimise,
)
from vslam.camera import Camera
from vslam.config import PoseGraphConfig
from vslam.features import Features
from vslam.geometry import inverse, inverses, se3_exp
from vslam.machine import peak_memory_mb
from vslam.map import Map
from vslam.map_kernels import covisible_pairs, link_many

CAMERA = Camera(718.0, 718.0, 607.0, 185.0, 0.54, 1241, 376)
BLOCK = (200.0, 120.0)  # sides of the block of houses that the car drives round, metres


def drive(n: int, step: float) -> np.ndarray:
    """``(n, 4, 4)`` T_wc, ``step`` metres apart, round a block with round corners."""
    long, short = BLOCK
    along = np.arange(n) * step % (2 * (long + short))
    corners = np.array([0.0, long, long + short, 2 * long + short])
    # Each corner turns by 90 degrees over 10 m.
    turned = np.clip((along[:, None] - corners[1:] + 5.0) / 10.0, 0.0, 1.0).sum(axis=1)
    start = np.clip((along - 2 * (long + short) + 5.0) / 10.0, 0.0, 1.0)
    yaw = 0.5 * np.pi * (turned + start)
    T_wc = np.tile(np.eye(4), (n, 1, 1))
    T_wc[:, 0, 0], T_wc[:, 0, 2] = np.cos(yaw), np.sin(yaw)
    T_wc[:, 2, 0], T_wc[:, 2, 2] = -np.sin(yaw), np.cos(yaw)
    side = np.searchsorted(corners, along, side="right") - 1
    way = along - corners[side]
    T_wc[:, 0, 3] = np.choose(side, [0 * way, way, 0 * way + short, short - way])
    T_wc[:, 2, 3] = np.choose(side, [way, 0 * way + long, long - way, 0 * way])
    return T_wc


def bundle_problem(
    n_keyframes: int, n_points: int, track: float, seed: int = 0
) -> tuple[BundleProblem, np.ndarray]:
    """A drive of one metre between keyframes with pixel noise and drifting start; true ``T_cw``.

    A point is tracked through ``track`` keyframes on average, and half of the points once more on
    each later lap. The last keyframe of the problem is the first of the drive, held.
    """
    rng = np.random.default_rng(seed)
    lap = int(2 * sum(BLOCK))
    T_wc = drive(n_keyframes, 1.0)
    T_cw = inverses(T_wc)
    # Points stand left and right of the road.
    born = rng.integers(0, min(n_keyframes, lap), n_points)
    aside = rng.choice([-1, 1], n_points) * rng.uniform(2, 12, n_points)
    local = np.stack([aside, rng.uniform(-4, 1.5, n_points), rng.uniform(10, 40, n_points)], axis=1)
    points = np.einsum("nij,nj->ni", T_wc[born, :3, :3], local) + T_wc[born, :3, 3]
    camera_of, point_of = [], []
    for start in range(0, n_keyframes, lap):
        length = rng.geometric(1 / track, n_points)
        if start:
            length[rng.random(n_points) < 0.5] = 0
        point_of.append(np.repeat(np.arange(n_points), length))
        offset = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
        camera_of.append(born[point_of[-1]] + start + offset)
    camera, point = np.concatenate(camera_of), np.concatenate(point_of)
    camera, point = camera[camera < n_keyframes], point[camera < n_keyframes]
    p_c = np.einsum("nij,nj->ni", T_cw[camera, :3, :3], points[point]) + T_cw[camera, :3, 3]
    seen = CAMERA.project(np.where(p_c[:, 2:] > 3.0, p_c, [0.0, 0.0, -1.0]))
    inside = (seen[:, :2] >= 0).all(axis=1) & (seen[:, :2] < [CAMERA.width, CAMERA.height]).all(
        axis=1
    )
    inside &= p_c[:, 2] > 3.0
    order = np.flatnonzero(inside)
    order = order[np.argsort(point[order], kind="stable")]
    camera, point = camera[order], point[order]
    seen = seen[order] + 0.5 * rng.normal(size=(len(order), 3))
    used, first, counts = np.unique(point, return_index=True, return_counts=True)
    drift = np.eye(4)
    start = T_cw.copy()
    for k in range(1, n_keyframes):
        drift = se3_exp(rng.normal(size=6) * [2e-3, 2e-3, 2e-3, 1e-4, 1e-4, 1e-4]) @ drift
        start[k] = drift @ T_cw[k]
    # As local mapping leaves it: each point where the first keyframe that sees it thinks it is.
    anchor = camera[first]
    moved = inverses(start)[anchor] @ T_cw[anchor]
    xyz = np.einsum("nij,nj->ni", moved[:, :3, :3], points[used]) + moved[:, :3, 3]
    roll = np.roll(np.arange(n_keyframes), -1)  # the held one comes last
    problem = BundleProblem(
        T_cw=start[roll],
        n_free=n_keyframes - 1,
        points=xyz + 0.05 * rng.normal(size=xyz.shape),
        first=np.concatenate([[0], np.cumsum(counts)]),
        camera=(camera - 1) % n_keyframes,
        uvr=seen,
        inverse_sigma2=np.ones(len(seen)),
        intrinsics=CAMERA.intrinsics,
    )
    return problem, T_cw[roll]


def best_time(function: Callable[[], Any], repeats: int = 3) -> tuple[float, Any]:
    """Seconds of the fastest call, and what it returned."""
    best, result = np.inf, None
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        best = min(best, time.perf_counter() - start)
    return best, result


def position_error(T_cw: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square distance of the camera centres, metres; both begin at one pose."""
    return float(np.sqrt(((inverses(T_cw) - inverses(truth))[:, :3, 3] ** 2).sum(axis=1).mean()))


def bench_bundle() -> None:
    small, _ = bundle_problem(30, 500, 5.0)
    adjust_globally(small, iterations=2)
    for n_keyframes, n_points, track in ((1000, 60_000, 4.5), (1300, 150_000, 6.0)):
        problem, truth = bundle_problem(n_keyframes, n_points, track)
        seconds, solution = best_time(
            lambda p=problem: adjust_globally(p, iterations=10, tolerance=1e-3)
        )
        before, after = (position_error(T, truth) for T in (problem.T_cw, solution.T_cw))
        print(
            f"bundle: {n_keyframes} keyframes, {len(problem.points)} points, "
            f"{len(problem.camera)} observations: {seconds:.2f} s, "
            f"{solution.iterations} iterations, position error {before:.3f} -> {after:.3f} m, "
            f"cost per observation "
            f"{solution.cost / len(problem.camera):.3f}, peak memory of the process "
            f"{peak_memory_mb():.0f} MB"
        )


def simulated_graph(n: int, reach: int, config: PoseGraphConfig) -> tuple[PoseGraph, np.ndarray]:
    """Odometry of a drive, 1.2 m between keyframes, edges to the next ``reach``, and a loop at each
    later lap, fifty keyframes apart; the true ``T_wc``."""
    rng = np.random.default_rng(0)
    truth = drive(n, 1.2)
    lap = round(2 * sum(BLOCK) / 1.2)
    T_wc = truth.copy()
    for k in range(1, n):
        error = se3_exp(rng.normal(size=6) * [0.02, 0.02, 0.02, 3e-4, 1e-3, 3e-4])
        T_wc[k] = T_wc[k - 1] @ inverse(truth[k - 1]) @ truth[k] @ error
    path = [(i, i + s) for s in range(1, reach + 1) for i in range(n - s)]
    loops = [(k, k - lap) for k in range(lap + 10, n, 50)]
    edges = np.array(path + loops)
    source = np.repeat([True, False], [len(path), len(loops)])[:, None, None]
    T_i_j = np.where(
        source,
        inverses(T_wc)[edges[:, 0]] @ T_wc[edges[:, 1]],
        inverses(truth)[edges[:, 0]] @ truth[edges[:, 1]],
    )
    kind = np.repeat([TREE, COVISIBLE, LOOP], [n - 1, len(path) - n + 1, len(loops)])
    kind = kind.astype(np.uint8)
    sigmas = edge_sigmas(edges, T_i_j, kind, edges.astype(float), n, config)
    graph = PoseGraph(
        np.arange(n),
        inverses(T_wc),
        edges,
        T_i_j,
        kind,
        sigmas,
        np.arange(n) == 0,
        np.ones(len(edges)),
    )
    return graph, truth


def bench_graph() -> None:
    config = PoseGraphConfig()
    optimise(simulated_graph(10, 2, config)[0], config)
    graph, truth = simulated_graph(1500, 4, config)
    seconds, T_cw = best_time(lambda: optimise(graph, config), repeats=5)
    before, after = (position_error(T, inverses(truth)) for T in (graph.T_cw, T_cw))
    print(
        f"graph: {len(graph.T_cw)} keyframes, {len(graph.edges)} edges, "
        f"{np.count_nonzero(graph.kind == LOOP)} loops: {seconds:.3f} s, "
        f"position error {before:.2f} -> {after:.2f} m"
    )


def bench_covisibility() -> None:
    """The essential graph of a map whose keyframes observe 300 landmarks, each seen by seven."""
    rng = np.random.default_rng(0)
    for n in (10, 1500, 5000):
        map_ = Map(1.2 ** np.arange(8))
        each, new = 300, 43
        features = Features(
            xy=rng.uniform(0, 300, (each, 2)).astype(np.float32),
            octave=np.zeros(each, np.uint8),
            angle=np.zeros(each, np.float32),
            descriptors=rng.integers(0, 256, (each, 32), dtype=np.uint8),
            u_right=np.full(each, np.nan, np.float32),
        )
        for k, T_cw in enumerate(inverses(drive(n, 1.0))):
            map_.add_keyframe(features, T_cw, 0.1 * k, k)
            map_.parents[k] = k - 1
            descriptors = features.descriptors[:new].copy().view(np.uint64)
            map_.add_landmarks(np.zeros((new, 3)), descriptors, k)
            seen = np.arange(max(0, new * k + new - each), new * (k + 1))
            link_many(map_.arrays, np.arange(each * k, each * k + len(seen)), seen)
        config = PoseGraphConfig()
        seconds, graph = best_time(lambda m=map_, c=config: essential_graph(m, [], c))
        living = map_.living_keyframes()
        pairs, _ = best_time(
            lambda m=map_, ids=living: covisible_pairs(m.arrays, ids, len(ids), 100)
        )
        print(
            f"covisibility: {n} keyframes, {len(graph.edges)} edges: {seconds:.3f} s, "
            f"of these {pairs:.3f} s counting shared landmarks"
        )


BENCHES = {"bundle": bench_bundle, "graph": bench_graph, "covisibility": bench_covisibility}

if __name__ == "__main__":
    for name in sys.argv[1:] or BENCHES:
        BENCHES[name]()
