"""Pose-graph optimisation after a loop closure, and a test of whether its result is plausible.

The graph is the essential graph of ORB-SLAM (Mur-Artal et al., T-RO 2015, sections III-D and
VII-C). It consists of the spanning tree, strong covisibility edges and loop edges. Poses are
``T_cw`` on input and output. GTSAM optimises the graph with its built-in factors. GTSAM is imported
inside the functions that need it, because the import is slow.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.backend.gravity import gravity_at
from vslam.config import PoseGraphConfig
from vslam.support.kernels import kernel
from vslam.types.geometry import compose, inverse, inverses, se3_log
from vslam.types.loops import LoopEdge, reversed_loop
from vslam.types.map import Map, loop_of_living
from vslam.types.map_kernels import covisible_pairs

# An edge of the spanning tree across a restart of mapping is weak if its two keyframes share
# fewer landmarks than this. [OS1 III-D, printed]
_MIN_SHARED_TREE = 15
# An edge shorter than this counts as this long in the drift model, in metres. [own]
_MIN_LENGTH = 0.3
# Standard deviation of the translation of a loop whose covariance is unknown, in metres. [own]
_LOOP_TRANSLATION = 0.1
# Standard deviation of the rotation of a loop whose covariance is unknown, in radians. [own]
_LOOP_ROTATION = 0.005
# Standard deviation of the translation of a weak edge, in metres. [own]
_WEAK_TRANSLATION = 100.0
# Standard deviation of the rotation of a weak edge, in radians. [own]
_WEAK_ROTATION = 1.0
# Standard deviation of the translation of a gap, as a fraction of the predicted distance. [own]
_GAP_TRANSLATION = 0.5
# Lower bound of the standard deviation of the translation of a gap, in metres per second of its
# duration. [own]
_GAP_SPEED = 2.0
# Standard deviation of the rotation of a gap, in radians per second of its duration. [own]
_GAP_ROTATION = 0.3
# A gap shorter than this counts as this long, in seconds. [own]
_MIN_GAP = 0.3
# Focal length to which ``PoseGraphConfig.rotation_drift`` refers, in pixels. It is about that of
# KITTI, with which it was chosen.
_FOCAL_LENGTH = 700.0
# Upper bound of the number of Levenberg-Marquardt iterations. [own]
_ITERATIONS = 50

TREE, COVISIBLE, WEAK, LOOP, GAP = range(5)  # kinds of edges, see ``essential_graph``
ROTATION_FIRST = [3, 4, 5, 0, 1, 2]  # the order of GTSAM
HOLD = 1e-6  # standard deviation of the prior that fixes a keyframe, m and rad


@dataclass(frozen=True)
class PoseGraph:
    """A pose graph: keyframes, and measurements of their relative poses as edges.

    Attributes:
        keyframes: ``(N,)`` int64 ids, ascending.
        T_cw: ``(N, 4, 4)`` initial poses (world to camera).
        edges: ``(E, 2)`` int64 indices i, j into ``keyframes``.
        T_i_j: ``(E, 4, 4)`` measured pose of camera j in the frame of camera i.
        kind: ``(E,)`` uint8: TREE, COVISIBLE, WEAK, LOOP or GAP.
        sigmas: ``(E, 6)`` standard deviations of the error of ``T_i_j``: of the translation (m) and
            of the rotation (rad), for each axis of camera j.
        fixed: ``(N,)`` bool, True for keyframes that are held fixed: one in each connected part of
            the graph.
        scale: ``(E,)`` factor that converts lengths from the unit of length around keyframe j to
            the unit of length around keyframe i. ``T_i_j`` is in the unit around i. The factor
            differs from 1 only for loops of monocular maps, whose scale drifts
            (``similarity_graph``).
        gravity: ``(N, 3)`` direction of free fall in the frame of each keyframe, as unit vectors;
            zero where it is unknown.
        gravity_sigma: ``(N,)`` standard deviation of ``gravity`` along each of the two axes across
            it, in radians; zero where it is unknown. Both arrays are empty if gravity is not used.
    """

    keyframes: NDArray[np.int64]
    T_cw: NDArray[np.float64]
    edges: NDArray[np.int64]
    T_i_j: NDArray[np.float64]
    kind: NDArray[np.uint8]
    sigmas: NDArray[np.float64]
    fixed: NDArray[np.bool_]
    scale: NDArray[np.float64]
    gravity: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    gravity_sigma: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True)
class GraphCheck:
    """The result of testing whether the edges of an optimised pose graph agree with each other.

    Attributes:
        consistent: whether the edges agree, so that the correction is plausible.
        reason: "consistent", or a short explanation of why the correction is not plausible.
    """

    consistent: bool
    reason: str


def essential_graph(
    map_: Map,
    loops: Collection[LoopEdge],
    config: PoseGraphConfig,
    *,
    driven: bool = False,
) -> PoseGraph:
    """Build the essential graph of a map, including a new loop. The graph must be built *before*
    the new loop changes the map.

    The measurements of tree and covisibility edges are taken from the poses in the map. If
    landmarks of the new loop were already fused, there would be edges across the loop that preserve
    the drift. Therefore, correct the map and fuse landmarks only after the graph has been found to
    be consistent.

    A loop edge replaces any other edge between its two keyframes. A culled keyframe of a loop is
    replaced by the keyframe that its pose is stored relative to. If several loops then connect the
    same two keyframes, only the last loop is used.

    If the camera was lost between the two keyframes of a tree edge, their relative pose was not
    measured. The edge is a GAP edge if the pose was predicted and ``driven`` is true, and a WEAK
    edge otherwise.

    Args:
        loops: all closed loops, with the new loop at the end. Each loop must have a pose.
        driven: whether the camera is on a vehicle, whose motion during a gap can be predicted
            roughly. Any other camera may have been carried anywhere.

    Raises:
        ValueError: a loop has no pose.
    """
    living = map_.living_keyframes()
    index = map_.places_among(living)
    T_cw = map_.arrays.T_cw[living]
    pairs, shared = covisible_pairs(map_.arrays, living, map_.n_keyframes, _MIN_SHARED_TREE)
    seen = set(map(tuple, pairs.tolist()))
    # The kind of each edge, by its two ends. Later entries overwrite earlier ones.
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
    measured: dict[tuple[int, int], LoopEdge] = {}
    for loop in loops:
        found = loop_of_living(map_, loop)
        if found.query != found.match:
            found = found if found.query > found.match else reversed_loop(found)
            kind[found.match, found.query] = LOOP
            measured[found.match, found.query] = found
    edges = index[np.array(sorted(kind), np.int64).reshape(-1, 2)]
    kinds = np.array([kind[pair] for pair in sorted(kind)], np.uint8)
    T_i_j = T_cw[edges[:, 0]] @ inverses(T_cw)[edges[:, 1]]
    scales = np.ones(len(edges))
    seconds = map_.timestamps[living]
    sigmas = edge_sigmas(edges, T_i_j, kinds, seconds[edges], len(living), config)
    for e in np.flatnonzero(kinds == LOOP).tolist():
        i, j = living[edges[e]].tolist()
        loop = measured[i, j]
        assert loop.T_query_match is not None
        T_i_j[e], scales[e] = inverse(loop.T_query_match), 1.0 / loop.scale
        if loop.covariance is not None:
            sigmas[e] = np.sqrt(config.loop_inflation * np.diag(loop.covariance))
    return PoseGraph(
        keyframes=living,
        T_cw=T_cw,
        edges=edges,
        T_i_j=T_i_j,
        kind=kinds,
        sigmas=sigmas,
        fixed=parts_of(edges, len(living)) == np.arange(len(living)),
        scale=scales,
    )


def with_gravity(graph: PoseGraph, map_: Map) -> PoseGraph:
    """Return a pose graph with what an IMU measured of gravity at the keyframes."""
    gravity, sigma = gravity_at(map_, graph.keyframes)
    return replace(graph, gravity=gravity, gravity_sigma=sigma)


def connectivity(map_: Map) -> NDArray[np.int64]:
    """Measure how well each keyframe and all later keyframes are connected to the earlier
    keyframes. Returns ``(n_keyframes,)`` int64.

    The value of a keyframe is the largest number of landmarks that an earlier keyframe shares with
    this or a later keyframe. It is 0 for the first keyframe.
    """
    living = map_.living_keyframes()
    pairs, shared = covisible_pairs(map_.arrays, living, map_.n_keyframes, 1)
    most = np.zeros(map_.n_keyframes, np.int64)
    order = np.argsort(shared, kind="stable")  # so that greater numbers overwrite smaller ones
    for (first, second), n in zip(pairs[order].tolist(), shared[order].tolist(), strict=True):
        most[first + 1 : second + 1] = n
    return most


def _spans(pair: tuple[int, int], keyframes: NDArray[np.int64]) -> bool:
    """Return whether any of the sorted ids ``keyframes`` is greater than the first id of a pair and
    at most equal to the second."""
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
    """Compute the ``(E, 6)`` standard deviations of the edges (``PoseGraph.sigmas``).

    Drift is modelled as a random walk, so the variance of a tree or covisibility edge grows with
    its length. All these edges are derived from the same measurement, the estimated path. If they
    were treated as independent, a path with more edges would have a smaller total uncertainty.
    Therefore, the variance of an edge is multiplied by the number of edges that span the path at
    its ends.

    For the translation of a GAP edge, two possible errors are compared: a fraction of the predicted
    distance, and the distance that a slow car travels in the elapsed time. The larger error is
    used. A WEAK edge has very large standard deviations. A LOOP edge has those of a loop whose
    covariance is unknown.

    Args:
        seconds: ``(E, 2)`` timestamps of the ends of the edges.
    """
    length = np.maximum(np.linalg.norm(T_i_j[:, :3, 3], axis=1), _MIN_LENGTH)
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
    share = _GAP_TRANSLATION * length[gap]
    sigmas[gap, 0] = np.maximum(share, _GAP_SPEED * elapsed)
    sigmas[gap, 1] = _GAP_ROTATION * np.maximum(elapsed, _MIN_GAP)
    sigmas[kind == WEAK] = _WEAK_TRANSLATION, _WEAK_ROTATION
    sigmas[kind == LOOP] = _LOOP_TRANSLATION, _LOOP_ROTATION
    return np.repeat(sigmas, 3, axis=1)


def drift_of_camera(config: PoseGraphConfig, focal_length: float) -> PoseGraphConfig:
    """Return the configuration for a camera with a focal length, in pixels.

    A pixel of a shorter focal length is a larger angle, so the rotation drifts more. A longer one
    changes nothing, because the calibration then limits the accuracy.
    """
    rotation_drift = config.rotation_drift * max(1.0, _FOCAL_LENGTH / focal_length)
    return config.model_copy(update={"rotation_drift": rotation_drift})


def parts_of(edges: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """Find the connected part of the graph that each of ``n`` nodes belongs to. Returns ``(n,)``
    int64, the index of the first node of the part."""
    above: dict[int, int] = {}  # of the nodes with edges; without an entry, a node is the first

    def first_of(node: int) -> int:
        while (up := above.get(node, node)) != node:
            above[node] = node = above.get(up, up)
        return node

    for i, j in edges.tolist():
        first, second = sorted((first_of(i), first_of(j)))
        above[second] = first
    part = np.arange(n)
    for node in above:
        part[node] = first_of(node)
    return part


def optimise(graph: PoseGraph, config: PoseGraphConfig) -> NDArray[np.float64]:
    """Find the ``(N, 4, 4)`` poses ``T_cw`` that agree best with the edges, using
    Levenberg-Marquardt.

    Loop edges have the Cauchy loss. A loop that contradicts the other loops then loses its
    influence, and ``check_pose_graph`` can detect it. All other edges have a Gaussian loss.
    """
    T_cw = inverses(_optimised_poses(graph, config))
    T_cw[graph.fixed] = graph.T_cw[graph.fixed]
    return T_cw


def optimise_level(graph: PoseGraph, config: PoseGraphConfig) -> NDArray[np.float64]:
    """Find the ``(N, 4, 4)`` poses ``T_cw`` that agree best with the edges, and in which gravity
    has the same direction everywhere.

    This direction in the world frame is found together with the poses. In the optimisation, the
    world frame is the one in which gravity keeps its direction, and the fixed keyframe may turn.
    The result is turned back, so that the fixed keyframe stays as it was.

    Args:
        graph: a connected graph, in which gravity is known at one keyframe or more.
    """
    import gtsam

    known = np.flatnonzero(graph.gravity_sigma > 0.0)
    fixed = int(np.flatnonzero(graph.fixed)[0])
    R_cw, weights = graph.T_cw[known, :3, :3], graph.gravity_sigma[known] ** -2.0
    down = gtsam.Unit3(np.einsum("n,nji,nj->i", weights, R_cw, graph.gravity[known]))
    attitudes = [
        gtsam.AttitudeFactorPose3(
            i, down, gtsam.noiseModel.Isotropic.Sigma(2, sigma), gtsam.Unit3(direction)
        )
        for i, sigma, direction in zip(
            known.tolist(), graph.gravity_sigma[known].tolist(), graph.gravity[known], strict=True
        )
    ]
    T_wc = _optimised_poses(graph, config, hold=np.repeat([1.0, HOLD], 3), factors=attitudes)
    T_cw = inverses(T_wc) @ (T_wc[fixed] @ graph.T_cw[fixed])
    T_cw[fixed] = graph.T_cw[fixed]
    return T_cw


def _optimised_poses(
    graph: PoseGraph,
    config: PoseGraphConfig,
    *,
    hold: NDArray[np.float64] | None = None,
    factors: Sequence[Any] = (),
) -> NDArray[np.float64]:
    """Return the ``(N, 4, 4)`` poses ``T_wc`` that agree best with the edges and with further
    factors (``optimised_values``)."""
    import gtsam

    result = optimised_values(
        graph,
        [gtsam.Pose3(T_wc) for T_wc in inverses(graph.T_cw)],
        [gtsam.Pose3(T_i_j) for T_i_j in graph.T_i_j],
        graph.sigmas[:, ROTATION_FIRST],
        (gtsam.PriorFactorPose3, gtsam.BetweenFactorPose3),
        config,
        hold=hold,
        factors=factors,
    )
    return np.array([result.atPose3(i).matrix() for i in range(len(graph.T_cw))])


def optimised_values(
    graph: PoseGraph,
    poses: list[Any],
    measured: list[Any],
    sigmas: NDArray[np.float64],
    factor_types: tuple[Any, Any],
    config: PoseGraphConfig,
    *,
    hold: NDArray[np.float64] | None = None,
    factors: Sequence[Any] = (),
) -> Any:
    """Find the ``gtsam.Values`` of the keyframes that agree best with the edges.

    Args:
        poses: initial values of the N keyframes, as GTSAM objects.
        measured: measurements of the E edges, as GTSAM objects of the same type.
        sigmas: ``(E, D)`` standard deviations of the edges.
        factor_types: GTSAM's prior factor and between factor for this type.
        hold: ``(D,)`` standard deviations with which fixed keyframes are held; ``HOLD`` by default.
        factors: further factors of GTSAM.
    """
    import gtsam

    noise = gtsam.noiseModel
    prior, between = factor_types
    whole, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    held = noise.Diagonal.Sigmas(np.full(sigmas.shape[1], HOLD) if hold is None else hold)
    for i, pose in enumerate(poses):
        start.insert(i, pose)
        if graph.fixed[i]:
            whole.add(prior(i, pose, held))
    cauchy = noise.mEstimator.Cauchy.Create(config.robust_scale)
    for (i, j), pose, kind, sigma in zip(
        graph.edges.tolist(), measured, graph.kind.tolist(), sigmas, strict=True
    ):
        plain = noise.Diagonal.Sigmas(sigma)
        model = noise.Robust.Create(cauchy, plain) if kind == LOOP else plain
        whole.add(between(i, j, pose, model))
    for factor in factors:
        whole.add(factor)
    return minimised(whole, start)


def minimised(factors: Any, start: Any) -> Any:
    """Find the ``gtsam.Values`` that minimise the error of a ``gtsam.NonlinearFactorGraph``, using
    Levenberg-Marquardt."""
    import gtsam

    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_ITERATIONS)
    parameters.setRelativeErrorTol(1e-5)
    return gtsam.LevenbergMarquardtOptimizer(factors, start, parameters).optimize()


def check_pose_graph(
    graph: PoseGraph, T_cw: NDArray[np.float64], config: PoseGraphConfig
) -> GraphCheck:
    """Test whether an optimised graph is plausible. If it is not, the new loop is wrong and must be
    rejected.

    The first test checks the residual of each loop edge. A loop edge whose residual is still large
    contradicts the other loops, or a large part of the path.

    The second test checks the strain: the total chi-square of the tree, covisibility and gap edges.
    If the drift follows the model, the strain has six degrees of freedom per closed loop. If the
    strain is several times larger, no plausible drift explains the loop. Only loops whose edges
    were violated before the optimisation are counted. A single loop across a WEAK edge always
    passes the tests, because it causes no strain.

    Args:
        T_cw: ``(N, 4, 4)`` poses that ``optimise`` returned.
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
    """Test whether an optimised graph is plausible, as ``check_pose_graph`` does, from the ``(E,)``
    chi-squares of the edges before and after the optimisation."""
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
    return GraphCheck(reason == "consistent", reason)


@kernel
def edge_errors(T_cw, edges, T_i_j, sigmas):
    """Compute the ``(E,)`` chi-square of each edge. The residual motion is expressed as a twist,
    whose components are divided by the standard deviations."""
    chi2 = np.empty(len(edges))
    for e in range(len(edges)):
        T = compose(T_cw[edges[e, 0]], inverse(T_cw[edges[e, 1]]))
        twist = se3_log(compose(inverse(T_i_j[e]), T))
        chi2[e] = 0.0
        for i in range(6):
            chi2[e] += (twist[i] / sigmas[e, i]) ** 2
    return chi2
