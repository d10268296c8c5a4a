"""Pose-graph optimisation after a loop closure, and a test of whether its result is plausible.

The graph is the essential graph of ORB-SLAM (Mur-Artal et al., T-RO 2015, III-D and VII-C):
spanning tree, strong covisibility edges and loop edges. Poses are ``T_cw`` on input and output.
GTSAM optimises the graph with its built-in factors; it is imported at the first loop.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.config import PoseGraphConfig
from vslam.geometry import compose, inverse, inverses, se3_log
from vslam.kernels import kernel
from vslam.loops import LoopEdge
from vslam.map import Map, loop_of_living
from vslam.map_kernels import covisible_pairs

TREE, COVISIBLE, WEAK, LOOP, GAP = range(5)  # kinds of edges, see ``essential_graph``
HOLD = 1e-6  # standard deviation of the prior that fixes a keyframe, m and rad


@dataclass(frozen=True)
class PoseGraph:
    """Keyframes and measurements of their relative poses.

    Attributes:
        keyframes: ``(N,)`` int64 ids, ascending.
        T_cw: ``(N, 4, 4)`` initial poses.
        edges: ``(E, 2)`` int64, indices i, j into ``keyframes``.
        T_i_j: ``(E, 4, 4)`` measured pose of camera j in the frame of camera i.
        kind: ``(E,)`` uint8, TREE, COVISIBLE, WEAK, LOOP or GAP.
        sigmas: ``(E, 2)`` standard deviations of translation (m) and rotation (rad), per axis.
        fixed: ``(N,)`` bool, keyframes that are held fixed: one in each connected part.
        scale: ``(E,)`` factor that converts lengths in the unit around j to the unit around i.
            ``T_i_j`` is in the unit around i. The factor is 1 except for loops of monocular maps
            (``similarity_graph``).
    """

    keyframes: NDArray[np.int64]
    T_cw: NDArray[np.float64]
    edges: NDArray[np.int64]
    T_i_j: NDArray[np.float64]
    kind: NDArray[np.uint8]
    sigmas: NDArray[np.float64]
    fixed: NDArray[np.bool_]
    scale: NDArray[np.float64]


@dataclass(frozen=True)
class GraphCheck:
    """Whether the edges of an optimised graph agree with each other.

    Attributes:
        consistent: whether the correction is plausible.
        reason: "consistent", or in a few words why the correction is not plausible.
        strain: total chi-square of the tree, covisibility and gap edges, that is, how much drift
            the correction implies relative to the drift model.
        closed: number of loop edges that were violated before the optimisation; the limit on the
            strain is proportional to it.
        loop_error: ``(E,)`` chi-square of the loop edges, NaN for other edges.
    """

    consistent: bool
    reason: str
    strain: float
    closed: int
    loop_error: NDArray[np.float64]


def essential_graph(
    map_: Map,
    loops: Collection[LoopEdge],
    config: PoseGraphConfig,
    *,
    driven: bool = False,
) -> PoseGraph:
    """The essential graph of a map, to be built *before* the new loop changes the map.

    The measurements of tree and covisibility edges are taken from the poses in the map. If
    landmarks of the new loop were already fused, keyframes on both sides of it would be covisible,
    and their edges would preserve the drift. So correct the map and fuse landmarks only after the
    graph was found to be consistent.

    A loop edge replaces any other edge between its two keyframes. If a keyframe of a loop was
    culled, the living keyframe that its pose is stored relative to takes its place. If several
    loops then connect the same keyframes, only the last one is used.

    A tree edge across a restart of the map, whose ends share hardly any landmarks, was not measured
    but predicted. If there was no prediction either, it is always WEAK.

    Args:
        loops: all closed loops, the new one last; each has a pose.
        driven: whether the camera is on a vehicle. If so, a predicted edge is trusted as far as the
            motion of a car can be predicted over that time (GAP); otherwise the camera may have
            been carried anywhere (WEAK).

    Raises:
        ValueError: a loop has no pose.
    """
    living = map_.living_keyframes()
    index = np.full(map_.n_keyframes, -1, np.int64)
    index[living] = np.arange(len(living))
    T_cw = map_.arrays.T_cw[living]
    pairs, shared = covisible_pairs(map_.arrays, living, map_.n_keyframes, config.min_shared_tree)
    seen = set(map(tuple, pairs.tolist()))
    # The kind of each edge by its two ends; later entries overwrite earlier ones.
    kind = dict.fromkeys(map(tuple, pairs[shared >= config.min_shared].tolist()), COVISIBLE)
    restarts = np.array(map_.restarts, np.int64)
    unpredicted_restarts = np.array(map_.unpredicted_restarts, np.int64)
    for child, parent in zip(living.tolist(), map_.parents[living].tolist(), strict=True):
        if parent >= 0:
            pair = (min(parent, child), max(parent, child))
            if not _spans(pair, restarts) or pair in seen:
                kind[pair] = TREE
            else:
                kind[pair] = GAP if driven and not _spans(pair, unpredicted_restarts) else WEAK
    measured: dict[tuple[int, int], tuple[NDArray[np.float64], float]] = {}
    for loop in loops:
        found = loop_of_living(map_, loop)
        query, match, scale = found.query, found.match, found.scale
        assert found.T_query_match is not None
        T = found.T_query_match
        if query != match:
            if query > match:
                query, match, T, scale = match, query, inverse(T), 1.0 / scale
            elif scale != 1.0:
                T[:3, 3] *= scale
            kind[query, match], measured[query, match] = LOOP, (T, scale)
    edges = index[np.array(sorted(kind), np.int64).reshape(-1, 2)]
    kinds = np.array([kind[pair] for pair in sorted(kind)], np.uint8)
    T_i_j = T_cw[edges[:, 0]] @ inverses(T_cw)[edges[:, 1]]
    scales = np.ones(len(edges))
    loop_edges = np.flatnonzero(kinds == LOOP)
    for e in loop_edges.tolist():
        i, j = living[edges[e]].tolist()
        T_i_j[e], scales[e] = measured[i, j]
    seconds = map_.timestamps[living]
    return PoseGraph(
        keyframes=living,
        T_cw=T_cw,
        edges=edges,
        T_i_j=T_i_j,
        kind=kinds,
        sigmas=edge_sigmas(edges, T_i_j, kinds, seconds[edges], len(living), config),
        fixed=parts_of(edges, len(living)) == np.arange(len(living)),
        scale=scales,
    )


def connectivity(map_: Map) -> NDArray[np.int64]:
    """``(n_keyframes,)`` int64, how well each keyframe is connected to the earlier part of the map:
    the largest number of landmarks that any earlier keyframe shares with this keyframe or any later
    one; 0 for the first keyframe."""
    living = map_.living_keyframes()
    pairs, shared = covisible_pairs(map_.arrays, living, map_.n_keyframes, 1)
    most = np.zeros(map_.n_keyframes, np.int64)
    order = np.argsort(shared, kind="stable")  # so that greater numbers overwrite smaller ones
    for (first, second), n in zip(pairs[order].tolist(), shared[order].tolist(), strict=True):
        most[first + 1 : second + 1] = n
    return most


def _spans(pair: tuple[int, int], keyframes: NDArray[np.int64]) -> bool:
    """Whether any of the sorted ids ``keyframes`` is greater than the first of a pair of ids, and
    not greater than the second."""
    low, high = np.searchsorted(keyframes, pair, side="right")
    return bool(low < high)


def edge_sigmas(
    edges: NDArray[np.int64],
    T_i_j: NDArray[np.float64],
    kind: NDArray[np.uint8],
    seconds: NDArray[np.float64],
    n: int,
    config: PoseGraphConfig,
) -> NDArray[np.float64]:
    """``(E, 2)`` standard deviations of the edges, translation (m) and rotation (rad).

    Drift is modelled as a random walk, so the variance of a tree or covisibility edge grows with
    its length. All these edges are derived from one measurement, the estimated path. If they were
    treated as independent, a path with more edges would be stiffer. Therefore the variance of each
    edge is multiplied by the number of edges that cover the path at the ends of the edge. Together
    the edges are then as stiff as the drift model, regardless of their number.

    The translation of a GAP edge may be wrong by a share of the predicted distance, or by the
    distance that a slow car drives in that time. Nothing is known about a WEAK edge.

    Args:
        seconds: ``(E, 2)`` timestamps of the ends of the edges.
        n: number of keyframes.
    """
    length = np.maximum(np.linalg.norm(T_i_j[:, :3, 3], axis=1), config.min_length)
    tree, path = kind == TREE, (kind == TREE) | (kind == COVISIBLE)
    covered = np.bincount(edges[path].ravel(), np.repeat(length[path], 2), n)
    once = np.bincount(edges[tree].ravel(), np.repeat(length[tree], 2), n)
    coverage = np.ones(n)
    np.divide(covered, once, out=coverage, where=once > 0)
    root = np.sqrt(length * coverage[edges].mean(axis=1))
    drift = np.array([config.translation_drift, config.rotation_drift])
    sigmas = root[:, None] * drift
    gap = kind == GAP
    elapsed = np.abs(seconds[gap, 1] - seconds[gap, 0])
    share = config.gap_translation * length[gap]
    sigmas[gap, 0] = np.maximum(share, config.gap_speed * elapsed)
    sigmas[gap, 1] = config.gap_rotation * np.maximum(elapsed, config.min_gap)
    sigmas[kind == WEAK] = config.weak_translation, config.weak_rotation
    sigmas[kind == LOOP] = config.loop_translation, config.loop_rotation
    return sigmas


def parts_of(edges: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """``(n,)`` int64, the first node of the connected part that each node is in (union-find)."""
    part = list(range(n))

    def first_of(node: int) -> int:
        while part[node] != node:
            part[node] = part[part[node]]
            node = part[node]
        return node

    for i, j in edges.tolist():
        first, second = sorted((first_of(i), first_of(j)))
        part[second] = first
    return np.array([first_of(node) for node in range(n)], np.int64)


def load_optimiser() -> None:
    """Import GTSAM before the first loop. The import takes a tenth of a second, which is too long
    while frames of a live camera are waiting."""
    import gtsam  # noqa: F401


def optimise(graph: PoseGraph, config: PoseGraphConfig) -> NDArray[np.float64]:
    """``(N, 4, 4)`` poses ``T_cw`` that best agree with the edges, by Levenberg-Marquardt.

    Loop edges have the Cauchy loss, so that a loop that contradicts the others loses its influence
    and is detected by ``check_pose_graph``. All other edges have a Gaussian loss.
    """
    import gtsam

    result = optimised_values(
        graph,
        [gtsam.Pose3(T_wc) for T_wc in inverses(graph.T_cw)],
        [gtsam.Pose3(T_i_j) for T_i_j in graph.T_i_j],
        np.repeat(graph.sigmas[:, ::-1], 3, axis=1),  # GTSAM: rotation first
        (gtsam.PriorFactorPose3, gtsam.BetweenFactorPose3),
        config,
    )
    T_wc = np.array([result.atPose3(i).matrix() for i in range(len(graph.T_cw))])
    T_cw = inverses(T_wc)
    T_cw[graph.fixed] = graph.T_cw[graph.fixed]
    return T_cw


def optimised_values(
    graph: PoseGraph,
    poses: list[Any],
    measured: list[Any],
    sigmas: NDArray[np.float64],
    factor_types: tuple[Any, Any],
    config: PoseGraphConfig,
) -> Any:
    """The ``gtsam.Values`` of the keyframes that best agree with the edges.

    Args:
        poses: initial values of the N keyframes, objects of GTSAM.
        measured: measurements of the E edges, objects of the same type.
        sigmas: ``(E, D)`` standard deviations of the edges.
        factor_types: GTSAM's prior and between factors of this type.
    """
    import gtsam

    noise = gtsam.noiseModel
    prior, between = factor_types
    factors, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    hold = noise.Isotropic.Sigma(sigmas.shape[1], HOLD)
    for i, pose in enumerate(poses):
        start.insert(i, pose)
        if graph.fixed[i]:
            factors.add(prior(i, pose, hold))
    cauchy = noise.mEstimator.Cauchy.Create(config.robust_scale)
    for (i, j), pose, kind, sigma in zip(
        graph.edges.tolist(), measured, graph.kind.tolist(), sigmas, strict=True
    ):
        plain = noise.Diagonal.Sigmas(sigma)
        model = noise.Robust.Create(cauchy, plain) if kind == LOOP else plain
        factors.add(between(i, j, pose, model))
    return minimised(factors, start, config)


def minimised(factors: Any, start: Any, config: PoseGraphConfig) -> Any:
    """The ``gtsam.Values`` that minimise a ``gtsam.NonlinearFactorGraph`` (Levenberg-Marquardt)."""
    import gtsam

    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(config.iterations)
    parameters.setRelativeErrorTol(1e-5)
    return gtsam.LevenbergMarquardtOptimizer(factors, start, parameters).optimize()


def check_pose_graph(
    graph: PoseGraph, T_cw: NDArray[np.float64], config: PoseGraphConfig
) -> GraphCheck:
    """Test whether an optimised graph is plausible. If it is not, the new loop is wrong and must be
    rejected.

    There are two tests. First, a loop edge whose residual is still large contradicts the other
    loops or too much of the path. Second, the strain (the total chi-square of tree, covisibility
    and gap edges) has six degrees of freedom per closed loop if the drift follows the model; if it
    is several times larger, no plausible drift explains the loop. A single loop across a WEAK edge
    always passes, because it causes no strain.

    Args:
        T_cw: ``(N, 4, 4)`` result of ``optimise``.
    """
    before = edge_errors(graph.T_cw, graph.edges, graph.T_i_j, graph.sigmas)
    after = edge_errors(T_cw, graph.edges, graph.T_i_j, graph.sigmas)
    return check_edge_errors(graph, before, after, config)


def check_edge_errors(
    graph: PoseGraph,
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    config: PoseGraphConfig,
) -> GraphCheck:
    """``check_pose_graph`` for given ``(E,)`` chi-squares of the edges before and after the
    optimisation."""
    loop = graph.kind == LOOP
    loop_error = np.where(loop, after, np.nan)
    strain = float(after[~loop & (graph.kind != WEAK)].sum())
    closed = int(np.count_nonzero(before[loop] > config.max_loop_error))
    reason = "consistent"
    if loop.any() and np.nanmax(loop_error) > config.max_loop_error:
        worst = int(np.nanargmax(loop_error))
        query, match = graph.keyframes[graph.edges[worst]][::-1]
        reason = (
            f"loop {query}-{match} is contradicted by the rest of the graph "
            f"(chi-square {loop_error[worst]:.0f})"
        )
    elif strain > config.max_strain * max(1, closed):
        reason = f"the loop implies more drift than is plausible (chi-square {strain:.0f})"
    return GraphCheck(reason == "consistent", reason, strain, closed, loop_error)


@kernel
def edge_errors(T_cw, edges, T_i_j, sigmas):
    """``(E,)`` chi-square of each edge: the logarithm of the residual motion is divided by the
    standard deviations, and its squared norm is returned."""
    chi2 = np.empty(len(edges))
    for e in range(len(edges)):
        T = compose(T_cw[edges[e, 0]], inverse(T_cw[edges[e, 1]]))
        twist = se3_log(compose(inverse(T_i_j[e]), T))
        chi2[e] = 0.0
        for i in range(6):
            chi2[e] += (twist[i] / sigmas[e, i // 3]) ** 2
    return chi2
