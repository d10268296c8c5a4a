"""Pose-graph optimisation of a monocular map, whose scale drifts (Mur-Artal et al., ORB-SLAM, T-RO
2015, section VII-C; Strasdat et al., "Scale drift-aware large scale monocular SLAM", RSS 2010).

Each keyframe has a similarity transform ``S_wc`` from the camera frame to the world. The transform
is a ``(4, 4)`` matrix with the scale in its upper left 3x3 block, so that ``@`` composes
similarities. Lengths in the camera frame are in the unit that the map had around the keyframe
before the correction. Initially, all scales are 1. Only loop edges measure scales that differ from
1. GTSAM optimises the graph with its built-in Similarity3 factors.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vslam.backend.loop_correction import carry_landmarks_by
from vslam.backend.pose_graph import (
    GAP,
    LOOP,
    ROTATION_FIRST,
    WEAK,
    GraphCheck,
    PoseGraph,
    check_edge_errors,
    optimised_values,
)
from vslam.config import PoseGraphConfig
from vslam.types.geometry import Matrix, inverses, se3_log
from vslam.types.loops import LoopEdge, scaled_loop
from vslam.types.map import Map
from vslam.types.map_kernels import refresh_landmarks

# Standard deviation of the scale drift of monocular odometry, as the logarithm of the scale per
# square root of a map unit. [own]
_SCALE_DRIFT = 0.01
# Standard deviation of the logarithm of the scale of a verified loop. [own]
_LOOP_SCALE = 0.02
# Standard deviation of the logarithm of the scale of a weak edge. [own]
_WEAK_SCALE = 3.0
# Standard deviation of the logarithm of the scale of a gap. [own]
GAP_SCALE = 0.3


def similarity(T_a_b: Matrix, scale: NDArray[np.float64] | float) -> Matrix:
    """Compose ``(..., 4, 4)`` similarities from ``(..., 4, 4)`` rigid motions and ``(...,)``
    scales."""
    S = T_a_b.copy()
    S[..., :3, :3] *= np.asarray(scale)[..., None, None]
    return S


def scale_of(S: Matrix) -> NDArray[np.float64]:
    """Return the ``(...,)`` scales of ``(..., 4, 4)`` similarities."""
    return np.cbrt(np.linalg.det(S[..., :3, :3]))


def rigid(S: Matrix) -> Matrix:
    """Set the scale of ``(..., 4, 4)`` similarities to 1."""
    return similarity(S, 1.0 / scale_of(S))


def optimise_similarities(graph: PoseGraph, S_wc: Matrix, config: PoseGraphConfig) -> Matrix:
    """Find the ``(N, 4, 4)`` similarities that agree best with the edges, starting from ``S_wc``.

    The loss functions and the optimiser are the same as in ``pose_graph.optimise``. Fixed keyframes
    keep their pose and their scale.
    """
    import gtsam

    def as_gtsam(S: Matrix) -> gtsam.Similarity3:
        s = float(scale_of(S))  # GTSAM: s (R p + t)
        return gtsam.Similarity3(S[:3, :3] / s, S[:3, 3] / s, s)

    result = optimised_values(
        graph,
        [as_gtsam(S) for S in S_wc],
        [as_gtsam(S) for S in similarity(graph.T_i_j, graph.scale)],
        sigmas(graph, config),
        (gtsam.PriorFactorSimilarity3, gtsam.BetweenFactorSimilarity3),
        config,
    )
    found = [result.atSimilarity3(i) for i in range(len(S_wc))]
    R = np.array([pose.rotation().matrix() for pose in found])
    t = np.array([pose.translation() for pose in found])
    s = np.array([pose.scale() for pose in found])
    S_wc = S_wc.copy()
    free = ~graph.fixed
    S_wc[free, :3, :3] = (s[:, None, None] * R)[free]
    S_wc[free, :3, 3] = (s[:, None] * t)[free]
    return S_wc


def sigmas(graph: PoseGraph, config: PoseGraphConfig) -> NDArray[np.float64]:
    """Compute the ``(E, 7)`` standard deviations of the edges: rotation, translation, and the
    logarithm of the scale. The drift of the scale is modelled as a random walk along the path."""
    scale = graph.sigmas[:, 3] * (_SCALE_DRIFT / config.rotation_drift)
    scale[graph.kind == LOOP] = _LOOP_SCALE
    scale[graph.kind == WEAK] = _WEAK_SCALE
    scale[graph.kind == GAP] = GAP_SCALE
    return np.column_stack([graph.sigmas[:, ROTATION_FIRST], scale])


def check_similarity_graph(
    graph: PoseGraph, S_wc_before: Matrix, S_wc: Matrix, config: PoseGraphConfig
) -> GraphCheck:
    """Test whether an optimised graph is plausible, as ``check_pose_graph`` does, from the
    similarities before and after the optimisation."""
    before, after = (edge_errors(graph, S, config) for S in (S_wc_before, S_wc))
    return check_edge_errors(graph, before, after, config)


def edge_errors(graph: PoseGraph, S_wc: Matrix, config: PoseGraphConfig) -> NDArray[np.float64]:
    """Compute the ``(E,)`` chi-square of each edge from the rotation, translation and scale of its
    residual."""
    i, j = graph.edges.T
    S_i_j = np.linalg.inv(S_wc[i]) @ S_wc[j]
    residual = np.linalg.inv(similarity(graph.T_i_j, graph.scale)) @ S_i_j
    twist = np.array([se3_log(T) for T in rigid(residual)]).reshape(-1, 6)
    error = np.column_stack([twist[:, 3:], twist[:, :3], np.log(scale_of(residual))])
    return ((error / sigmas(graph, config)) ** 2).sum(axis=1)


def move_keyframes_similarly(
    map_: Map, keyframes: NDArray[np.integer], S_wc: Matrix
) -> NDArray[np.float64]:
    """Move keyframes by similarity transforms. Each landmark is moved and scaled with its anchor
    keyframe (section VII-C of the ORB-SLAM paper).

    The poses of culled keyframes and of revisits, which are stored relative to other keyframes, are
    scaled as well.
    ``map_.keyframes.unit_scale`` is multiplied by the scales.

    Args:
        keyframes: ``(N,)`` ids of keyframes that have not been culled.
        S_wc: ``(N, 4, 4)`` new similarities of these keyframes (camera to world).

    Returns:
        ``(n_keyframes,)`` factor by which lengths around each keyframe were multiplied.
    """
    a, n = map_.arrays, map_.n_keyframes
    motion = np.zeros((n, 4, 4))
    motion[keyframes] = S_wc @ a.T_cw[keyframes]  # from old to new world coordinates
    moved = np.zeros(n, np.bool_)
    moved[keyframes] = True
    a.T_cw[keyframes] = inverses(rigid(S_wc))
    carry_landmarks_by(map_, motion, moved)
    growth = np.ones(n)
    growth[keyframes] = scale_of(S_wc)
    culled = np.flatnonzero(~a.keyframe_alive[:n])
    growth[culled] = growth[map_.parents[culled]]
    map_.keyframes.T_c_parent[culled, :3, 3] *= growth[culled, None]
    map_.keyframes.unit_scale[:n] *= growth
    map_.revisits = map_.revisits.scaled(growth)
    refresh_landmarks(a, map_.living_landmarks().astype(np.int32), map_.scales)
    return growth


def loop_in_new_units(edge: LoopEdge, growth: NDArray[np.float64]) -> LoopEdge:
    """Convert a loop edge to the units of length after a correction of a monocular map. ``growth``
    is the factor by which the correction multiplied lengths around each keyframe."""
    assert edge.T_query_match is not None
    scaled = scaled_loop(edge, float(growth[edge.match]))
    scale = edge.scale * float(growth[edge.query] / growth[edge.match])
    return replace(scaled, scale=scale)
