"""The pose graph behind a closed loop: how its error is spread over the path, and whether it may.

The essential graph of ORB-SLAM (Mur-Artal et al., T-RO 2015, III-D and VII-C): spanning tree,
strong covisibility edges and loop edges. Poses go in as ``T_cw`` and come out as ``T_cw``. GTSAM
does the optimisation, from its built-in factors; it is loaded by the first loop.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.config import PoseGraphConfig
from vslam.geometry import compose, inverse, inverses, se3_log
from vslam.kernels import kernel
from vslam.loops import LoopEdge
from vslam.map import Map, loop_of_living
from vslam.map_kernels import covisible_pairs

TREE, COVISIBLE, WEAK, LOOP, GAP = range(5)  # kinds of edges
HOLD = 1e-6  # sigma, m and rad, of the prior that holds a keyframe


@dataclass(frozen=True)
class PoseGraph:
    """Keyframes and what is known of their relative poses.

    Attributes:
        keyframes: ``(N,)`` int64 ids, ascending.
        T_cw: ``(N, 4, 4)`` poses to start from.
        edges: ``(E, 2)`` int64, positions i, j in ``keyframes``.
        T_i_j: ``(E, 4, 4)`` measured pose of j in the camera frame of i.
        kind: ``(E,)`` uint8, TREE, COVISIBLE, WEAK, LOOP or GAP.
        sigmas: ``(E, 2)`` standard deviations, translation (m) and rotation (rad), of each axis.
        fixed: ``(N,)`` bool, keyframes that are held: one in each connected part.
        scale: ``(E,)`` units around i for one around j; ``T_i_j`` is in the unit of i. 1 except
            for loops of monocular maps (``similarity_graph``).
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
    """Whether the edges of an optimised graph agree.

    Attributes:
        consistent: whether the correction may stand.
        reason: "consistent", or in a few words what speaks against it.
        strain: chi-square of the tree, covisibility and gap edges: how much drift, in the units of
            the drift model, the correction implies.
        closed: loop edges that were open before: what the strain is to be shared by.
        loop_error: ``(E,)`` chi-square of the loop edges, NaN for others.
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
    weak: Collection[int] = (),
    unpredicted: Collection[int] = (),
    driven: bool = False,
) -> PoseGraph:
    """The essential graph of a map, *before* anything of the new loop has been written to it.

    Tree and covisibility edges are measured by the map's poses. Were landmarks of the new loop
    fused already, keyframes on both sides would be covisible, and such an edge would hold the
    drift in place: correct and fuse afterwards, when the graph was found consistent.

    A loop edge stands for all that is known between its two keyframes: no other edge joins them.
    The end of a loop that was culled is replaced by the living keyframe that it is placed by; of
    two loops that so join the same keyframes the last counts.

    Args:
        loops: that were closed, and last the new one; all with their pose.
        weak: keyframes that began anew after tracking was lost, culled ones too. Tree edges that
            lead past one of them, and whose ends share hardly a landmark, come from a prediction.
        unpredicted: those of them that not even a prediction led to: always WEAK.
        driven: trust such an edge as far as a car's motion can be predicted over that time (GAP);
            otherwise the camera may have been carried anywhere (WEAK).

    Raises:
        ValueError: a loop has no pose.
    """
    living = map_.living_keyframes()
    index = np.full(map_.n_keyframes, -1, np.int64)
    index[living] = np.arange(len(living))
    T_cw = map_.arrays.T_cw[living]
    pairs, shared = covisible_pairs(map_.arrays, living, map_.n_keyframes, config.min_shared_tree)
    seen = set(map(tuple, pairs.tolist()))
    # Edge by the pair of its ends: what is written later wins.
    kind = dict.fromkeys(map(tuple, pairs[shared >= config.min_shared].tolist()), COVISIBLE)
    restarts, unpredicted_restarts = (np.array(sorted(at), np.int64) for at in (weak, unpredicted))
    for child, parent in zip(living.tolist(), map_.parents[living].tolist(), strict=True):
        if parent >= 0:
            pair = (min(parent, child), max(parent, child))
            if not _passes(pair, restarts) or pair in seen:
                kind[pair] = TREE
            else:
                kind[pair] = GAP if driven and not _passes(pair, unpredicted_restarts) else WEAK
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
        fixed=_first_of_parts(edges, len(living)),
        scale=scales,
    )


def held_by(map_: Map) -> NDArray[np.int64]:
    """``(n_keyframes,)`` what holds the map together at each keyframe: the most landmarks that a
    keyframe before it shares with one that is not; 0 at the first one."""
    living = map_.living_keyframes()
    pairs, shared = covisible_pairs(map_.arrays, living, map_.n_keyframes, 1)
    held = np.zeros(map_.n_keyframes, np.int64)
    order = np.argsort(shared, kind="stable")  # greater numbers are written last
    for (one, other), n in zip(pairs[order].tolist(), shared[order].tolist(), strict=True):
        held[one + 1 : other + 1] = n
    return held


def _passes(pair: tuple[int, int], keyframes: NDArray[np.int64]) -> bool:
    """Whether one of the sorted keyframes lies behind the first and not behind the second."""
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
    """Standard deviations of edges, ``(E, 2)``, m and rad; ``seconds`` ``(E, 2)`` of their ends.

    Drift is a random walk: the variance of a tree or covisibility edge grows with its length.
    These edges repeat what is one measurement, the path as it was estimated; were they independent
    the path would be the stiffer the more of them pass over it. Therefore each variance is
    multiplied by how many times the edges at its ends cover the path there: then all together
    resist to being stretched as the drift model says, however many they are.

    A GAP may be wrong by a share of the way predicted, or by what a slow car gathers in that time;
    of a WEAK edge nothing is known.
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


def _first_of_parts(edges: NDArray[np.int64], n: int) -> NDArray[np.bool_]:
    """``(n,)`` bool, the first node of each connected part."""
    # The least node that each one is known to be joined to, which halves the way to the first one
    # in each round.
    least = np.arange(n)
    while True:
        ends = least[edges].min(axis=1, initial=n)
        known = least.copy()
        for side in range(2):
            np.minimum.at(known, least[edges[:, side]], ends)
            np.minimum.at(known, edges[:, side], ends)
        known = known[known]
        if np.array_equal(known, least):
            return np.asarray(least == np.arange(n))
        least = known


def load_optimiser() -> None:
    """Import what the first loop needs: a tenth of a second that no frame of a camera can wait."""
    import gtsam  # noqa: F401


def optimise(graph: PoseGraph, config: PoseGraphConfig) -> NDArray[np.float64]:
    """Poses ``T_cw`` ``(N, 4, 4)`` that agree best with the edges.

    Levenberg-Marquardt. Loop edges are under the Cauchy loss: one that contradicts the others
    loses its influence, and shows in ``check_pose_graph``; all others are Gaussian.
    """
    import gtsam

    noise = gtsam.noiseModel
    factors, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    hold = noise.Isotropic.Sigma(6, HOLD)
    for i, T_wc in enumerate(inverses(graph.T_cw)):
        pose = gtsam.Pose3(T_wc)
        start.insert(i, pose)
        if graph.fixed[i]:
            factors.add(gtsam.PriorFactorPose3(i, pose, hold))
    cauchy = noise.mEstimator.Cauchy.Create(config.robust_scale)
    sigmas = np.repeat(graph.sigmas[:, ::-1], 3, axis=1)  # GTSAM: rotation first
    for (i, j), T_i_j, kind, sigma in zip(
        graph.edges.tolist(), graph.T_i_j, graph.kind.tolist(), sigmas, strict=True
    ):
        plain = noise.Diagonal.Sigmas(sigma)
        model = noise.Robust.Create(cauchy, plain) if kind == LOOP else plain
        factors.add(gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(T_i_j), model))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(config.iterations)
    parameters.setRelativeErrorTol(1e-5)
    result = gtsam.LevenbergMarquardtOptimizer(factors, start, parameters).optimize()
    T_wc = np.array([result.atPose3(i).matrix() for i in range(len(graph.T_cw))])
    T_cw = inverses(T_wc)
    T_cw[graph.fixed] = graph.T_cw[graph.fixed]
    return T_cw


def check_pose_graph(
    graph: PoseGraph, T_cw: NDArray[np.float64], config: PoseGraphConfig
) -> GraphCheck:
    """Whether an optimised graph makes sense, or a loop was wrong and is to be undone.

    Two tests. A loop edge far from its measurement contradicts the others or more of the path than
    the loss would give up. The strain, chi-square of what tree and covisibility edges were bent by,
    has six degrees of freedom for each loop that was closed if drift is what the model says; beyond
    several times that no plausible drift explains the loop. What a GAP is bent by counts as well.
    Nothing can be said against a single loop across a weak edge: it strains nothing.

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
    """``check_pose_graph`` from the chi-square ``(E,)`` of each edge before and after."""
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
    """Chi-square of each edge, ``(E,)``: squared whitened logarithm of its residual motion."""
    chi2 = np.empty(len(edges))
    for e in range(len(edges)):
        T = compose(T_cw[edges[e, 0]], inverse(T_cw[edges[e, 1]]))
        twist = se3_log(compose(inverse(T_i_j[e]), T))
        chi2[e] = 0.0
        for i in range(6):
            chi2[e] += (twist[i] / sigmas[e, i // 3]) ** 2
    return chi2
