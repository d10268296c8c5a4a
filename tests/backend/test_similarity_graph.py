"""The pose graph with scale: closed-form solutions, a lap with drift, and a corrected map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ring import CAMERA

from vslam.backend.pose_graph import _MIN_LENGTH, GAP, LOOP, TREE, WEAK, PoseGraph, edge_sigmas
from vslam.backend.similarity_graph import (
    _LOOP_SCALE,
    _SCALE_DRIFT,
    check_similarity_graph,
    edge_errors,
    loop_in_new_units,
    move_keyframes_similarly,
    optimise_similarities,
    rigid,
    scale_of,
    similarity,
)
from vslam.config import PoseGraphConfig
from vslam.types.features import Features
from vslam.types.geometry import inverse, inverses, se3_exp, transform
from vslam.types.loops import LoopEdge
from vslam.types.map import Map
from vslam.types.map_kernels import link_many

CONFIG = PoseGraphConfig()


def chain(T_wc: np.ndarray, T_first_last: np.ndarray, scale: float, **lost: int) -> PoseGraph:
    """Make odometry edges from each pose to the next, and one loop from the first to the last pose.

    ``after=k, kind=GAP`` means that tracking was lost after the k-th pose.
    """
    n = len(T_wc)
    edges = np.array([*((i, i + 1) for i in range(n - 1)), (0, n - 1)])
    kind = np.array([TREE] * (n - 1) + [LOOP], np.uint8)
    if lost:
        kind[lost["after"]] = lost["kind"]
    T_i_j = inverses(T_wc)[edges[:, 0]] @ T_wc[edges[:, 1]]
    T_i_j[-1] = T_first_last
    scales = np.ones(n)
    scales[-1] = scale
    sigmas = edge_sigmas(edges, T_i_j, kind, edges.astype(float), n, CONFIG)
    return PoseGraph(
        np.arange(n), inverses(T_wc), edges, T_i_j, kind, sigmas, np.arange(n) == 0, scales
    )


def test_similarities_compose_by_matrix_product():
    T, U = se3_exp(np.array([1, 2, 3, 0.1, 0.2, 0.3])), se3_exp(np.array([0, 1, 0, 0.4, 0, 0.1]))
    S = similarity(T, 2.0) @ similarity(U, 0.25)
    assert scale_of(S) == pytest.approx(0.5)
    p = np.array([[0.3, -0.2, 1.5]])
    expected = 2.0 * (0.25 * p @ U[:3, :3].T + U[:3, 3]) @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(p @ S[:3, :3].T + S[:3, 3], expected, atol=1e-12)
    np.testing.assert_allclose(rigid(S)[:3, :3] @ rigid(S)[:3, :3].T, np.eye(3), atol=1e-12)


def test_scale_alone_spreads_by_the_variances():
    """All keyframes are at the same place.

    Least squares distributes the scale error of the loop over the chain. The share of an edge is
    its sigma^2 divided by the sum over all edges, including the loop edge.
    """
    n, drift = 9, 0.02
    config = CONFIG.model_copy(update={"robust_scale": 1e3})  # Gaussian, for the closed form
    graph = chain(np.tile(np.eye(4), (n, 1, 1)), np.eye(4), np.exp(drift))
    found = optimise_similarities(graph, inverses(graph.T_cw), config)
    edge = _SCALE_DRIFT**2 * _MIN_LENGTH
    share = edge / ((n - 1) * edge + _LOOP_SCALE**2)
    np.testing.assert_allclose(np.log(scale_of(found)), drift * share * np.arange(n), atol=1e-7)
    np.testing.assert_allclose(found[:, :3, 3], 0.0, atol=1e-7)


def drifted_lap(growth: float, n: int = 120):
    """Make a lap on a circle of radius 30, and its odometry with a shrinking unit.

    Each step is ``growth`` times as many units as the previous step. Returns the true and the
    estimated ``T_wc``.
    """
    step = se3_exp(np.array([0.0, 0.0, 2 * np.pi * 30 / n, 0.0, 2 * np.pi / n, 0.0]))
    truth, estimate = [np.eye(4)], [np.eye(4)]
    for k in range(n):
        truth.append(truth[-1] @ step)
        long = step.copy()
        long[:3, 3] *= growth**k
        estimate.append(estimate[-1] @ long)
    return np.array(truth), np.array(estimate)


def test_a_lap_whose_scale_drifted_closes():
    growth = 1.004  # 61 % in 120 steps
    truth, estimate = drifted_lap(growth)
    n = len(truth)
    before = np.linalg.norm((estimate - truth)[:, :3, 3], axis=1)
    # The last keyframe is at the position of the first one. Its unit is smaller by growth^n.
    T = inverse(truth[0]) @ truth[-1]
    graph = chain(estimate, T, growth ** -(n - 1))
    start = inverses(graph.T_cw)
    found = optimise_similarities(graph, start, CONFIG)
    after = np.linalg.norm((found - truth)[:, :3, 3], axis=1)
    assert before.max() > 15.0
    assert after[-1] < 0.2
    assert after.max() < 2.0
    assert scale_of(found[-1]) == pytest.approx(growth ** -(n - 1), rel=0.03)
    verdict = check_similarity_graph(graph, start, found, CONFIG)
    assert verdict.consistent


def test_where_tracking_was_lost_the_error_of_a_lap_spreads_if_the_camera_drove_on():
    """Tracking is lost half-way, and the unit changes by a third.

    The predicted motion in the gap is too short and has a wrong direction.
    """
    growth, after = 1.004, 60
    truth, estimate = drifted_lap(growth)
    steps = inverses(estimate)[:-1] @ estimate[1:]
    steps[after:, :3, 3] *= 1.3
    steps[after] = steps[after] @ se3_exp(np.array([0, 0, -0.6, 0, 0.1, 0]))
    for k in range(after, len(steps)):
        estimate[k + 1] = estimate[k] @ steps[k]
    loop = inverse(truth[0]) @ truth[-1], growth ** -(len(steps)) / 1.3
    worst = {}
    for kind in (GAP, WEAK):
        graph = chain(estimate, *loop, after=after, kind=kind)
        start = inverses(graph.T_cw)
        found = optimise_similarities(graph, start, CONFIG)
        assert check_similarity_graph(graph, start, found, CONFIG).consistent
        unit = np.linalg.norm(np.diff(found[:, :3, 3], axis=0), axis=1)
        unit /= np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
        worst[kind] = np.abs(np.log(np.delete(unit, after))).max()
    # If the motion in the gap is unknown, nothing is distributed: half a lap keeps its wrong unit.
    assert worst[GAP] < 0.15
    assert worst[WEAK] > 0.23


def test_a_scale_that_no_drift_explains_is_refused():
    truth, _ = drifted_lap(1.0)
    graph = chain(truth, inverse(truth[0]) @ truth[-1], 8.0)
    start = inverses(graph.T_cw)
    found = optimise_similarities(graph, start, CONFIG)
    assert not check_similarity_graph(graph, start, found, CONFIG).consistent


def test_a_consistent_graph_stays_as_it_is():
    truth, _ = drifted_lap(1.0)
    graph = chain(truth, inverse(truth[0]) @ truth[-1], 1.0)
    found = optimise_similarities(graph, inverses(graph.T_cw), CONFIG)
    np.testing.assert_allclose(found, truth, atol=1e-6)
    assert edge_errors(graph, found, CONFIG).max() < 1e-8


def test_the_same_bytes_every_time():
    _, estimate = drifted_lap(1.004, 40)
    graph = chain(estimate, np.eye(4), 0.9)
    one, two = (optimise_similarities(graph, estimate, CONFIG) for _ in range(2))
    assert one.tobytes() == two.tobytes()


def small_map() -> tuple[Map, np.ndarray]:
    """Make a map of three keyframes in a row.

    Each keyframe has its own landmarks. The second keyframe is culled.
    """
    map_, rng = Map(1.2 ** np.arange(8)), np.random.default_rng(0)
    for k in range(3):
        T_cw = inverse(se3_exp(np.array([2.0 * k, 0, 0, 0, 0.2 * k, 0.0])))
        p = rng.uniform([-3, -2, 8], [3, 2, 15], (20, 3))
        uv = CAMERA.project(p)[:, :2].astype(np.float32)
        features = Features(
            uv,
            np.zeros(20, np.uint8),
            np.zeros(20, np.float32),
            rng.integers(0, 256, (20, 32), dtype=np.uint8),
            np.full(20, np.nan, np.float32),
        )
        map_.add_keyframe(features, T_cw, 0.1 * k, k)
        map_.parents[k] = k - 1
        rows = np.arange(20) + map_.rows(k).start
        ids = map_.add_landmarks(transform(inverse(T_cw), p), map_.arrays.descriptor[rows], k)
        link_many(map_.arrays, rows, ids)
    map_.parents[2] = 0
    map_.cull_keyframe(1)
    return map_, np.array([0, 2])


def test_a_correction_leaves_every_keyframe_its_picture():
    map_, keyframes = small_map()
    a = map_.arrays

    def picture(k):
        ids = map_.landmarks_of(k)
        return CAMERA.project(transform(a.T_cw[k], a.xyz[ids]))[:, :2]

    before = [picture(k) for k in keyframes]
    depth = [transform(a.T_cw[k], a.xyz[map_.landmarks_of(k)])[:, 2] for k in keyframes]
    offset = map_.keyframes.T_c_parent[1].copy()
    S_wc = np.array([similarity(inverse(a.T_cw[k]), s) for k, s in ((0, 1.5), (2, 0.5))])
    S_wc[1, :3, 3] += [3.0, 0.0, 1.0]
    growth = move_keyframes_similarly(map_, keyframes, S_wc)
    np.testing.assert_allclose(growth, [1.5, 1.5, 0.5])
    for k, pixels, z, s in zip(keyframes, before, depth, (1.5, 0.5), strict=True):
        np.testing.assert_allclose(picture(k), pixels, atol=1e-9)
        seen = transform(a.T_cw[k], a.xyz[map_.landmarks_of(k)])[:, 2]
        np.testing.assert_allclose(seen, s * z)
        np.testing.assert_allclose(a.T_cw[k][:3, :3] @ a.T_cw[k][:3, :3].T, np.eye(3), atol=1e-12)
        ids = map_.landmarks_of(k)
        away = np.linalg.norm(a.xyz[ids] - inverse(a.T_cw[k])[:3, 3], axis=1)
        np.testing.assert_allclose(a.distance_range[ids, 1], away)
    # A culled keyframe keeps its pose relative to the keyframe that replaced it.
    np.testing.assert_allclose(map_.keyframes.T_c_parent[1][:3, 3], 1.5 * offset[:3, 3])
    np.testing.assert_allclose(map_.unit_scale, [1.5, 1.5, 0.5])


def test_a_closed_loop_is_kept_in_the_units_of_today():
    T = se3_exp(np.array([0.4, 0.0, 1.0, 0.0, 0.1, 0.0]))
    edge = LoopEdge(2, 0, 1.0, True, "closed", T_query_match=T, scale=3.0)
    new = loop_in_new_units(edge, np.array([2.0, 1.0, 0.5]))
    np.testing.assert_allclose(new.T_query_match[:3, 3], 2.0 * T[:3, 3])
    assert new.scale == pytest.approx(3.0 * 0.5 / 2.0)
    assert replace(new, T_query_match=None, scale=3.0) == replace(edge, T_query_match=None)
