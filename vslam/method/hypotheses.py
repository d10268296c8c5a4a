"""The pose graph of a loop under three hypotheses about how the camera moved.

After tracking is lost, a new sub-map begins, whose pose in the map is only predicted. Under the
first hypothesis, the camera moved about as predicted, and the prediction is a measurement with a
known error. Under the second hypothesis, the camera was carried to an unknown place (a "kidnapped
robot"), and the prediction is worthless. Under the third hypothesis, tracking went wrong without
being lost, for example because it followed a vehicle that covered the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from vslam.backend.pose_graph import (
    COVISIBLE,
    GAP,
    LOOP,
    TREE,
    WEAK,
    GraphCheck,
    PoseGraph,
    check_pose_graph,
    connectivity,
    essential_graph,
    optimise,
    optimise_level,
    parts_of,
    with_gravity,
)
from vslam.backend.similarity_graph import (
    check_similarity_graph,
    optimise_similarities,
    rigid,
)
from vslam.config import PoseGraphConfig
from vslam.types.geometry import Matrix, compose, inverse, inverses, orthonormalised
from vslam.types.imu import GRAVITY
from vslam.types.loops import LoopEdge
from vslam.types.map import CARRIED, Map


class Hypothesis(Enum):
    """A hypothesis about how the camera moved between the two keyframes of a loop."""

    PREDICTED = "while it was lost, it moved about as predicted"
    KIDNAPPED = "while it was lost, it was carried to an unknown place"
    MISTRACKED = "it did not move as tracked"


# Largest scale that a loop of a metric map measures, as a natural logarithm: three standard
# deviations of the scale of a loop (``similarity_graph``). [own]
SAME_SCALE = 0.06
WEAK_PLACE = 0.3  # fraction of the shared landmarks that are usual in the map
# Standard deviations of the odometry across a weak place: metres and radians.
DOUBTFUL_SIGMAS = np.array([100.0, 100.0, 100.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Solution:
    """An optimised pose graph.

    Attributes:
        graph: the graph of N keyframes, with the initial poses of the optimisation.
        T_cw: ``(N, 4, 4)`` optimised poses.
        S_wc: ``(N, 4, 4)`` inverses of the optimised poses, as similarities. Their scale is 1 in a
            metric map.
        verdict: whether the edges of the optimised graph are consistent.
        mistracked: keyframes before which tracking went wrong, under ``MISTRACKED``.
    """

    graph: PoseGraph
    T_cw: Matrix
    S_wc: Matrix
    verdict: GraphCheck
    mistracked: tuple[int, ...] = ()

    @property
    def has_gaps(self) -> bool:
        """Whether tracking was lost between keyframes of the graph.

        Without such a gap, ``PREDICTED`` and ``KIDNAPPED`` give the same solution.
        """
        return bool(np.isin(self.graph.kind, (GAP, WEAK)).any())


def solve(
    map_: Map,
    closed: Sequence[LoopEdge],
    edge: LoopEdge,
    hypothesis: Hypothesis,
    config: PoseGraphConfig,
    *,
    monocular: bool,
) -> Solution:
    """Build and optimise the pose graph with a new loop. The map is only read.

    Args:
        closed: loops that were closed before, in the current unit of the map.
        edge: the new loop, whose relative pose is known.
        monocular: optimise similarities instead of rigid motions, because the scale drifts, unless
            an IMU keeps the scale.
    """
    predicted = hypothesis is not Hypothesis.KIDNAPPED
    graph = essential_graph(map_, [*closed, edge], config, driven=predicted)
    mistracked: tuple[int, ...] = ()
    if hypothesis is Hypothesis.MISTRACKED:
        places = _weak_places(map_)
        graph, mistracked = _without_odometry(graph, places), tuple(places.tolist())
        # With a robust loss, a loop that is far from fulfilled would have no influence.
        config = config.model_copy(update={"robust_scale": 1e6})
    T_cw = map_.arrays.T_cw[: map_.n_keyframes]
    if monocular and not _keeps_scale(map_, graph):
        S_wc = inverses(T_cw) if predicted else _aligned_similarities(map_, closed, edge)
        start = S_wc[graph.keyframes]
        found = optimise_similarities(graph, start, config)
        verdict = check_similarity_graph(graph, start, found, config)
        return Solution(graph, inverses(rigid(found)), found, verdict, mistracked)
    start = T_cw if predicted else _aligned(map_, closed, edge)
    graph = replace(graph, T_cw=start[graph.keyframes])
    found = optimise(graph, config)
    verdict = check_pose_graph(graph, found, config)
    level = with_gravity(graph, map_)
    if verdict.consistent and level.gravity_sigma.any():
        found = optimise_level(level, config)
    return Solution(graph, found, inverses(found), verdict, mistracked)


def _keeps_scale(map_: Map, graph: PoseGraph) -> bool:
    """Return whether an IMU has kept the scale of a monocular map: it is metric, and no loop
    measured another scale. The scale of a sub-map whose unit is unknown is another one."""
    measured = np.log(graph.scale[graph.kind == LOOP])
    return map_.scalars.metric and bool((np.abs(measured) <= SAME_SCALE).all())


def _weak_places(map_: Map) -> NDArray[np.int64]:
    """Return the keyframes before which tracking may have gone wrong: earlier keyframes share few
    landmarks with them and later ones.

    If the path is weak nowhere, it stands. A town whose streets look exactly alike gives
    overwhelming evidence for wrong loops, which only a sound path contradicts.
    """
    shared = connectivity(map_)
    return np.flatnonzero(shared < WEAK_PLACE * np.median(shared))[1:]  # the first shares nothing


def _without_odometry(graph: PoseGraph, places: NDArray[np.int64]) -> PoseGraph:
    """Weaken the edges of odometry that cross one of some places of the path."""
    first, second = graph.keyframes[graph.edges].T
    crosses = np.searchsorted(places, second, "right") > np.searchsorted(places, first, "right")
    doubtful = crosses & np.isin(graph.kind, (TREE, COVISIBLE))
    return replace(graph, sigmas=np.where(doubtful[:, None], DOUBTFUL_SIGMAS, graph.sigmas))


def joined_submaps(map_: Map, closed: Sequence[LoopEdge]) -> NDArray[np.int64]:
    """Return the index of the sub-map of each keyframe as an ``(n_keyframes,)`` array.

    Sub-maps that are joined by a closed loop, or by the motion that an IMU measured, count as one
    sub-map.
    """
    submap = map_.submaps()
    carried = np.flatnonzero(map_.keyframes.restart[: map_.n_keyframes] == CARRIED)
    joined = [(edge.query, edge.match) for edge in closed]
    joined += [(int(one), int(map_.parents[one])) for one in carried]
    ends = np.array(joined, np.int64).reshape(-1, 2)
    return parts_of(submap[ends], len(submap))[submap]


def map_gravity(map_: Map, closed: Sequence[LoopEdge]) -> Matrix | None:
    """Return the ``(3,)`` acceleration of free fall in the world frame of a map, in m/s^2.

    It is the mean of what an IMU measured at the keyframes, weighted by the inverse variances.
    Keyframes whose pose in the world was not measured are left out.

    Args:
        closed: the closed loops, which join sub-maps.

    Returns:
        None if gravity is not known.
    """
    keyframes = map_.living_keyframes()
    sigma = map_.keyframes.gravity_sigma[keyframes]
    known = (sigma > 0.0) & (joined_submaps(map_, closed)[keyframes] == 0)
    if not known.any():
        return None
    keyframes, weights = keyframes[known], sigma[known] ** -2.0
    T_cw, directions = map_.arrays.T_cw[keyframes], map_.keyframes.gravity[keyframes]
    total = np.einsum("n,nji,nj->i", weights, T_cw[:, :3, :3], directions)
    gravity: Matrix = GRAVITY / np.linalg.norm(total) * total
    return gravity


def part_of(map_: Map, closed: Sequence[LoopEdge], keyframe: int) -> int:
    """Return the index of the part of the map that contains a keyframe (``TrackResult.part``)."""
    restarts = map_.restarts
    if not restarts:
        return 0
    first = joined_submaps(map_, closed)[keyframe]
    return int(np.searchsorted(restarts, first, side="right"))


def _aligned(map_: Map, closed: Sequence[LoopEdge], edge: LoopEdge) -> Matrix:
    """Compute initial poses ``T_cw`` under the hypothesis that the lost camera was carried away.

    The sub-map at one end of the loop is moved rigidly to the pose that the loop implies. The
    result has shape ``(n_keyframes, 4, 4)``.
    """
    T_cw = map_.arrays.T_cw[: map_.n_keyframes].copy()
    moving, keyframes = _moving_submap(map_, closed, edge)
    assert edge.T_query_match is not None
    if moving == edge.query:
        T_new = compose(edge.T_query_match, T_cw[edge.match])
    else:
        T_new = compose(inverse(edge.T_query_match), T_cw[edge.query])
    T_old_new = compose(inverse(T_cw[moving]), T_new)  # from the new world frame to the old
    for keyframe in keyframes:
        T_cw[keyframe] = orthonormalised(compose(T_cw[keyframe], T_old_new))
    return T_cw


def _aligned_similarities(map_: Map, closed: Sequence[LoopEdge], edge: LoopEdge) -> Matrix:
    """Compute initial poses ``S_wc`` under the hypothesis that a monocular camera was carried away.

    The sub-map at one end of the loop is moved to the pose that the loop implies. This sub-map is
    also scaled to the unit of length of the other sub-map, so its poses become similarities.
    """
    T_cw = map_.arrays.T_cw[: map_.n_keyframes]
    S_wc = inverses(T_cw)
    moving, keyframes = _moving_submap(map_, closed, edge)
    assert edge.T_query_match is not None
    S_query_match = edge.T_query_match.copy()
    S_query_match[:3] *= edge.scale
    if moving == edge.query:
        S_new = S_wc[edge.match] @ np.linalg.inv(S_query_match)
    else:
        S_new = S_wc[edge.query] @ S_query_match
    S_wc[keyframes] = S_new @ T_cw[moving] @ S_wc[keyframes]
    return S_wc


def _moving_submap(
    map_: Map, closed: Sequence[LoopEdge], edge: LoopEdge
) -> tuple[int, NDArray[np.int64]]:
    """Determine the sub-map that is moved to close a loop.

    Returns:
        The keyframe of the loop that lies in this sub-map, and the ``(N,)`` keyframes of the
        sub-map. N is 0 if both keyframes of the loop lie in the same sub-map.
    """
    submap = joined_submaps(map_, closed)
    if submap[edge.query] == submap[edge.match]:
        return edge.query, np.empty(0, np.int64)
    # The sub-map of the first keyframe defines the world and never moves.
    moving = edge.match if submap[edge.query] == submap[0] else edge.query
    return moving, np.flatnonzero(submap == submap[moving])
