"""The pose graph of a loop under two hypotheses about how the camera moved while it was lost.

After tracking is lost, a new sub-map begins, whose pose in the map is only predicted. Under the
first hypothesis, the camera moved about as predicted, and the prediction is a measurement with a
known error. Under the second hypothesis, the camera was carried to an unknown place (a "kidnapped
robot"), and the prediction is worthless.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from vslam.backend.pose_graph import (
    GAP,
    WEAK,
    GraphCheck,
    PoseGraph,
    check_pose_graph,
    essential_graph,
    optimise,
    parts_of,
)
from vslam.backend.similarity_graph import (
    check_similarity_graph,
    optimise_similarities,
    rigid,
)
from vslam.config import PoseGraphConfig
from vslam.geometry import Matrix, compose, inverse, inverses, orthonormalised
from vslam.loops import LoopEdge
from vslam.map import Map


class Hypothesis(Enum):
    """A hypothesis about how the camera moved while tracking was lost."""

    PREDICTED = "it moved about as predicted"
    KIDNAPPED = "it was carried to an unknown place"


@dataclass(frozen=True)
class Solution:
    """An optimised pose graph.

    Attributes:
        graph: the graph of N keyframes, with the initial poses of the optimisation.
        T_cw: ``(N, 4, 4)`` optimised poses.
        S_wc: ``(N, 4, 4)`` inverses of the optimised poses, as similarities. Their scale is 1 in a
            metric map.
        verdict: whether the edges of the optimised graph are consistent.
    """

    graph: PoseGraph
    T_cw: Matrix
    S_wc: Matrix
    verdict: GraphCheck

    @property
    def has_gaps(self) -> bool:
        """Whether tracking was lost between keyframes of the graph.

        Without such a gap, both values of ``Hypothesis`` give the same solution.
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
        monocular: optimise similarities instead of rigid motions, because the scale drifts.
    """
    predicted = hypothesis is Hypothesis.PREDICTED
    graph = essential_graph(map_, [*closed, edge], config, driven=predicted)
    T_cw = map_.arrays.T_cw[: map_.n_keyframes]
    if monocular:
        S_wc = inverses(T_cw) if predicted else _aligned_similarities(map_, closed, edge)
        start = S_wc[graph.keyframes]
        found = optimise_similarities(graph, start, config)
        verdict = check_similarity_graph(graph, start, found, config)
        return Solution(graph, inverses(rigid(found)), found, verdict)
    start = T_cw if predicted else _aligned(map_, closed, edge)
    graph = replace(graph, T_cw=start[graph.keyframes])
    found = optimise(graph, config)
    return Solution(graph, found, inverses(found), check_pose_graph(graph, found, config))


def joined_submaps(map_: Map, closed: Sequence[LoopEdge]) -> NDArray[np.int64]:
    """Return the index of the sub-map of each keyframe as an ``(n_keyframes,)`` array.

    Sub-maps that are joined by a closed loop count as one sub-map.
    """
    submap = map_.submaps()
    ends = np.array([(edge.query, edge.match) for edge in closed], np.int64).reshape(-1, 2)
    return parts_of(submap[ends], len(submap))[submap]


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
