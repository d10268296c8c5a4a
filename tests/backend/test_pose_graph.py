"""The pose graph: closed-form solutions, the edges of the essential graph, and rejected loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vslam.backend.pose_graph import (
    COVISIBLE,
    GAP,
    LOOP,
    TREE,
    WEAK,
    PoseGraph,
    check_pose_graph,
    drift_of_camera,
    edge_errors,
    edge_sigmas,
    essential_graph,
    optimise,
    optimise_level,
    with_gravity,
)
from vslam.config import PoseGraphConfig
from vslam.types.features import Features
from vslam.types.geometry import inverse, inverses, orthonormalised, se3_exp, se3_log
from vslam.types.imu import GravityDirection
from vslam.types.loops import LoopEdge, reversed_loop
from vslam.types.map import UNPREDICTED, Map
from vslam.types.map_kernels import covisible_pairs, link_many

CONFIG = PoseGraphConfig()


def translation(*t: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = t
    return T


def turn(yaw: float) -> np.ndarray:
    return se3_exp(np.array([0, 0, 0, 0, yaw, 0.0]))


def chain_graph(T_wc: np.ndarray, loops=(), measured=(), reach: int = 1, weak=()) -> PoseGraph:
    """Make odometry edges to the next ``reach`` keyframes, and loop edges.

    The odometry edges are computed from the poses. Only a weak tree edge leads past the keyframes
    in ``weak``.
    """
    n = len(T_wc)
    pairs = [(i, i + s) for s in range(1, reach + 1) for i in range(n - s)]
    past = {p: any(p[0] < w <= p[1] for w in weak) for p in pairs}
    pairs = [p for p in pairs if not past[p] or p[1] == p[0] + 1]
    kind = [WEAK if past[p] else TREE if p[1] == p[0] + 1 else COVISIBLE for p in pairs]
    edges = np.array([*pairs, *loops])
    kinds = np.array(kind + [LOOP] * len(loops), np.uint8)
    T_cw = inverses(T_wc)
    T_i_j = T_cw[edges[:, 0]] @ T_wc[edges[:, 1]]
    if len(loops):
        T_i_j[-len(loops) :] = measured
    sigmas = edge_sigmas(edges, T_i_j, kinds, edges.astype(float), n, CONFIG)
    return PoseGraph(
        np.arange(n), T_cw, edges, T_i_j, kinds, sigmas, np.arange(n) == 0, np.ones(len(edges))
    )


# ------------------------------------------------------------------------------ closed forms


def test_translation_error_spreads_evenly():
    """Twelve keyframes form a circle without rotation, and all edges have equal weights.

    Each edge, including the loop edge, takes a twelfth of the error.
    """
    n = 12
    angle = 2 * np.pi * np.arange(n) / n
    T_wc = np.array([translation(10 * np.sin(a), 0, 10 * np.cos(a)) for a in angle])
    missing = np.array([0.06, -0.024, 0.036])
    loop = inverse(T_wc[n - 1]) @ T_wc[0] @ translation(*missing)
    graph = chain_graph(T_wc, [(n - 1, 0)], [loop])
    # Rotation is fixed, so that it cannot absorb the error.
    graph = replace(graph, sigmas=np.tile(np.repeat([0.1, 1e-6], 3), (n, 1)))
    T_cw = optimise(graph, CONFIG.model_copy(update={"robust_scale": 1e6}))
    moved = inverses(T_cw)[:, :3, 3] - T_wc[:, :3, 3]
    np.testing.assert_allclose(moved, np.arange(n)[:, None] * -missing / n, atol=1e-6)
    chi2 = edge_errors(T_cw, graph.edges, graph.T_i_j, graph.sigmas)
    np.testing.assert_allclose(chi2, (missing @ missing) / (n * 0.1) ** 2, rtol=1e-4)


@pytest.mark.parametrize("share", [1.0, 3.0])
def test_rotation_error_spreads_by_the_variances(share):
    """The camera turns on the spot.

    An edge with ``share`` times the variance takes ``share`` times as much of the error.
    """
    n, missing = 9, 0.3
    T_wc = np.array([turn(2 * np.pi * k / n) for k in range(n)])
    graph = chain_graph(T_wc, [(n - 1, 0)], [turn(2 * np.pi / n + missing)])
    sigmas = np.full((n, 6), 0.05)
    sigmas[3, 3:] *= np.sqrt(share)
    graph = replace(graph, sigmas=sigmas)
    T_cw = optimise(graph, CONFIG.model_copy(update={"robust_scale": 1e6}))
    yaw = [
        se3_log(inverse(T) @ T_cw[i] @ inverse(T_cw[j]))[4]
        for (i, j), T in zip(graph.edges, graph.T_i_j, strict=True)
    ]
    expected = np.full(n, missing / (n - 1 + share))
    expected[3] *= share
    np.testing.assert_allclose(yaw, -expected, rtol=1e-4)


def test_a_consistent_graph_stays_as_it_is():
    T_wc = np.array([se3_exp(np.array([0.1, 0, 1, 0, 0.1, 0]) * k) for k in range(20)])
    graph = chain_graph(T_wc, [(19, 2)], [inverse(T_wc[19]) @ T_wc[2]], reach=3)
    np.testing.assert_allclose(optimise(graph, CONFIG), graph.T_cw, atol=1e-9)
    assert edge_errors(graph.T_cw, graph.edges, graph.T_i_j, graph.sigmas).max() < 1e-16


SIGMAS = np.array([0.5, 0.4, 0.3, 0.1, 0.2, 0.05])


def test_error_of_an_edge_is_the_whitened_twist():
    twist = np.array([0.3, -0.2, 0.1, 0.02, 0.01, -0.03])
    T_wc = np.array([turn(0.4), turn(0.4) @ translation(1, 2, 3)])
    T_i_j = inverse(T_wc[0]) @ T_wc[1] @ se3_exp(-twist)
    chi2 = edge_errors(inverses(T_wc), np.array([[0, 1]]), T_i_j[None], SIGMAS[None])
    assert chi2[0] == pytest.approx(((twist / SIGMAS) ** 2).sum())


def test_redundant_edges_do_not_make_the_path_stiffer():
    """A path is stretched by a metre.

    The chi-square is the same for edges to the next one and to the next six keyframes.
    """
    straight = np.array([translation(0, 0, k) for k in range(200)])
    stretched = inverses(np.array([translation(0, 0, k * (1 + 1 / 199)) for k in range(200)]))
    chi2 = {}
    for reach in (1, 6):
        graph = chain_graph(straight, reach=reach)
        chi2[reach] = edge_errors(stretched, graph.edges, graph.T_i_j, graph.sigmas).sum()
    assert chi2[1] == pytest.approx(1 / (199 * CONFIG.translation_drift**2), rel=1e-6)
    assert chi2[6] == pytest.approx(chi2[1], rel=0.05)


def test_same_bytes_every_time():
    T_wc, loops, true = simulate(0)
    graph = chain_graph(T_wc, loops, true, reach=3)
    assert optimise(graph, CONFIG).tobytes() == optimise(graph, CONFIG).tobytes()


# ------------------------------------------------------------------------- the essential graph


def make_map(views: list[range], T_cw: np.ndarray) -> Map:
    """Make a chain of keyframes in which keyframe k observes the landmarks ``views[k]``."""
    map_ = Map(1.2 ** np.arange(8))
    n = max(view.stop for view in views)
    for k, view in enumerate(views):
        features = Features(
            xy=np.zeros((len(view), 2), np.float32),
            octave=np.zeros(len(view), np.uint8),
            angle=np.zeros(len(view), np.float32),
            descriptors=np.zeros((len(view), 32), np.uint8),
            u_right=np.full(len(view), np.nan, np.float32),
        )
        map_.add_keyframe(features, T_cw[k], 0.1 * k, k)
        map_.parents[k] = k - 1
    map_.add_landmarks(np.zeros((n, 3)), np.zeros((n, 4), np.uint64), 0)
    for k, view in enumerate(views):
        rows = map_.rows(k)
        link_many(map_.arrays, np.arange(rows.start, rows.stop), np.array(view, np.int64))
    return map_


def line_map(n: int = 8, shift: int = 60) -> Map:
    """Make a map of keyframes along a line with 240 landmarks each.

    A keyframe shares 180, 120 and 60 landmarks with the next three keyframes.
    """
    T_cw = inverses(np.array([translation(0, 0, k) for k in range(n)]))
    return make_map([range(shift * k, shift * k + 240) for k in range(n)], T_cw)


def named(graph: PoseGraph) -> dict[tuple[int, int], int]:
    pairs = map(tuple, graph.keyframes[graph.edges].tolist())
    return dict(zip(pairs, graph.kind.tolist(), strict=True))


def closed(query: int, match: int, T: np.ndarray) -> LoopEdge:
    return LoopEdge(query, match, 1.0, True, "closed", T_query_match=T)


def test_covisible_pairs_are_those_of_each_keyframe():
    rng = np.random.default_rng(0)
    views = [range(s, s + 50) for s in rng.integers(0, 300, 40)]
    map_ = make_map(views, np.tile(np.eye(4), (40, 1, 1)))
    map_.cull_keyframe(7)
    pairs, shared = covisible_pairs(map_.arrays, map_.living_keyframes(), 40, 10)
    expected = {
        (k, int(other)): int(count)
        for k in map_.living_keyframes().tolist()
        for other, count in zip(*map_.covisible(k, 10), strict=True)
        if other > k
    }
    assert len(expected) > 64  # the arrays had to grow
    assert dict(zip(map(tuple, pairs.tolist()), shared.tolist(), strict=True)) == expected
    assert pairs.tolist() == sorted(pairs.tolist())


def test_tree_and_strong_covisibility_make_the_graph():
    graph = essential_graph(line_map(), [], CONFIG)
    edges = named(graph)
    assert [p for p, kind in edges.items() if kind == TREE] == [(k, k + 1) for k in range(7)]
    assert [p for p, kind in edges.items() if kind == COVISIBLE] == [(k, k + 2) for k in range(6)]
    assert len(edges) == 13
    np.testing.assert_allclose(graph.T_i_j[:, 2, 3], np.ptp(graph.edges, axis=1), atol=1e-12)
    assert graph.fixed.tolist() == [True] + [False] * 7
    fewer = named(essential_graph(line_map(), [], CONFIG.model_copy(update={"min_shared": 60})))
    assert len(fewer) == 18


def test_culled_keyframes_are_left_out_and_their_loops_kept():
    map_ = line_map()
    loop = closed(6, 1, inverse(translation(0, 0, 6)) @ translation(0.5, 0, 1))
    map_.cull_keyframe(1)
    map_.cull_keyframe(6)
    graph = essential_graph(map_, [loop], CONFIG)
    assert graph.keyframes.tolist() == [0, 2, 3, 4, 5, 7]
    edges = named(graph)
    assert edges[0, 5] == LOOP  # between the parents of 1 and 6
    assert edges[0, 2] == edges[5, 7] == TREE
    e = graph.kind.tolist().index(LOOP)
    np.testing.assert_allclose(
        graph.T_i_j[e], inverse(translation(0.5, 0, 0)) @ translation(0, 0, 5), atol=1e-12
    )
    T = graph.T_cw[graph.edges[e]]
    error = T[0] @ inverse(T[1]) @ inverse(graph.T_i_j[e])
    np.testing.assert_allclose(error[:3, 3], [0.5, 0, 0], atol=1e-12)


def test_the_loop_edge_wins_over_the_edge_of_the_same_keyframes():
    """When the drifted covisibility edge was kept instead, the ATE rose from 0.96 to 5.2 m."""
    map_ = line_map()
    T_covisible, T_tree = translation(0, 0, 1.5), translation(0, 0, 0.75)
    for loops in (
        [closed(2, 4, T_covisible), closed(5, 6, T_tree)],
        # Keyframes in reverse order.
        [closed(4, 2, inverse(T_covisible)), closed(6, 5, inverse(T_tree))],
        [closed(2, 4, np.eye(4)), closed(4, 2, inverse(T_covisible)), closed(5, 6, T_tree)],
    ):
        graph = essential_graph(map_, loops, CONFIG)
        assert len(graph.edges) == len(np.unique(np.sort(graph.edges), axis=0)) == 13
        edges = named(graph)
        assert edges[2, 4] == edges[5, 6] == LOOP
        for pair, T in (((2, 4), T_covisible), ((5, 6), T_tree)):
            e = list(edges).index(pair)
            np.testing.assert_allclose(graph.T_i_j[e], T, atol=1e-15)
            expected = np.repeat([0.1, 0.005], 3)
            assert graph.sigmas[e].tolist() == expected.tolist()


def test_a_loop_weighs_what_its_covariance_says():
    """The covariance is converted if the ends of the edge are exchanged."""
    map_ = line_map()
    T = translation(0.3, 0, 1.5) @ turn(0.2)
    axes = np.array([0.01, 0.02, 0.03, 0.001, 0.002, 0.003])
    loop = replace(closed(4, 2, T), covariance=np.diag(axes**2))

    def sigmas(loop):
        graph = essential_graph(map_, [loop], CONFIG)
        return graph.sigmas[int(np.flatnonzero(graph.kind == LOOP)[0])]

    expected = np.sqrt(CONFIG.loop_inflation) * axes
    np.testing.assert_allclose(sigmas(loop), expected)
    np.testing.assert_allclose(sigmas(reversed_loop(loop)), expected, rtol=1e-6)
    back = reversed_loop(reversed_loop(replace(loop, scale=1.3)))
    np.testing.assert_allclose(back.covariance, loop.covariance, atol=1e-12)
    np.testing.assert_allclose(back.T_query_match, T, atol=1e-12)
    # exp(xi) T is the true pose. The errors of the reversed edge have the reversed covariance.
    rng = np.random.default_rng(0)
    errors = [
        se3_log(inverse(se3_exp(xi) @ T) @ T) for xi in 0.1 * axes * rng.normal(size=(4000, 6))
    ]
    spread = np.cov(np.array(errors).T) / 0.01
    np.testing.assert_allclose(np.diag(spread), np.diag(reversed_loop(loop).covariance), rtol=0.15)


def test_a_drifted_covisibility_edge_would_hold_the_drift():
    """The same loop is closed with and without the drifted edge."""
    T_wc, loops, true = simulate(3)
    graph = chain_graph(T_wc, loops, true, reach=3)
    alone = check_pose_graph(graph, optimise(graph, CONFIG), CONFIG)
    assert alone.consistent
    drifted = inverse(T_wc[loops[0][0]]) @ T_wc[loops[0][1]]
    both = replace(
        graph,
        edges=np.concatenate([graph.edges, [loops[0]]]),
        T_i_j=np.concatenate([graph.T_i_j, drifted[None]]),
        kind=np.concatenate([graph.kind, [COVISIBLE]]).astype(np.uint8),
        sigmas=np.concatenate([graph.sigmas, graph.sigmas[:1]]),
    )
    assert not check_pose_graph(both, optimise(both, CONFIG), CONFIG).consistent


def test_edges_that_fusing_would_add_are_not_in_the_graph_before_it():
    """Such an edge across the loop would contain the drift as if it were measured."""
    map_ = line_map()
    loop = closed(7, 0, np.eye(4))
    before = named(essential_graph(map_, [loop], CONFIG))
    views = [range(60 * k, 60 * k + 240) for k in range(8)]
    views[6] = views[0]  # after fusion, keyframe 6 observes the landmarks of keyframe 0
    fused = make_map(views, map_.arrays.T_cw[:8])
    after = named(essential_graph(fused, [loop], CONFIG))
    assert (0, 6) in after
    assert (0, 6) not in before
    assert before[0, 7] == LOOP


def test_edges_past_a_restart_are_weak():
    T_cw = inverses(np.array([translation(0, 0, k) for k in range(8)]))
    views = [range(60 * k, 60 * k + 240) for k in range(8)]
    views[4:] = [range(view.start + 1000, view.stop + 1000) for view in views[4:]]
    map_ = make_map(views, T_cw)
    map_.begin_submap(4, 3, predicted=True)
    edges = named(essential_graph(map_, [], CONFIG))
    assert edges[3, 4] == WEAK
    assert list(edges.values()).count(WEAK) == 1
    assert not any(low < 4 <= high for low, high in edges if (low, high) != (3, 4))
    # If a keyframe is culled, its child replaces it.
    map_.cull_keyframe(4)
    graph = essential_graph(map_, [], CONFIG)
    edges = named(graph)
    assert edges[3, 5] == WEAK
    assert list(edges.values()).count(WEAK) == 1
    e = list(edges).index((3, 5))
    weak = np.repeat([100.0, 1.0], 3)
    assert graph.sigmas[e].tolist() == weak.tolist()
    # The camera moved on by 2 m in the gap. The sigmas grow with this distance and with time.
    graph = essential_graph(map_, [], CONFIG, driven=True)
    assert named(graph)[3, 5] == GAP
    assert WEAK not in named(graph).values()
    elapsed = map_.timestamps[5] - map_.timestamps[3]
    expected = [
        max(0.5 * 2.0, 2.0 * elapsed),
        0.3 * max(elapsed, 0.3),
    ]
    assert graph.sigmas[e].tolist() == pytest.approx(np.repeat(expected, 3).tolist())
    # There is no such edge if the speed was unknown.
    map_.keyframes.restart[4] = UNPREDICTED
    graph = essential_graph(map_, [], CONFIG, driven=True)
    assert named(graph)[3, 5] == WEAK


def test_a_tree_edge_past_a_restart_with_landmarks_in_common_is_not_weak():
    map_ = line_map()
    map_.begin_submap(4, 3, predicted=True)
    edges = named(essential_graph(map_, [], CONFIG))
    assert WEAK not in edges.values()


@pytest.mark.parametrize(("focal_length", "factor"), [(350.0, 2.0), (700.0, 1.0), (1400.0, 1.0)])
def test_a_camera_with_a_short_focal_length_turns_less_exactly(focal_length, factor):
    config = drift_of_camera(CONFIG, focal_length)
    assert config.rotation_drift == pytest.approx(factor * CONFIG.rotation_drift)
    assert config.translation_drift == CONFIG.translation_drift


def test_each_unconnected_part_is_held():
    views = [range(0, 240), range(60, 300), range(600, 840), range(660, 900)]
    map_ = make_map(views, line_map(4).arrays.T_cw)
    map_.parents[2] = -1
    assert essential_graph(map_, [], CONFIG).fixed.tolist() == [True, False, True, False]


def test_a_loop_without_a_pose_is_refused():
    with pytest.raises(ValueError, match="keyframe 5 to 0 has no pose"):
        essential_graph(line_map(), [LoopEdge(5, 0, 1.0, False, "too few matches")], CONFIG)


# ------------------------------------------------------------------- which loops may be closed

SIDES = (70.0, 40.0)


def route(n: int, step: float = 1.2) -> np.ndarray:
    long, short = SIDES
    along = np.arange(n) * step % (2 * (long + short))
    corners = np.array([0.0, long, long + short, 2 * long + short])
    side = np.searchsorted(corners, along, side="right") - 1
    way = along - corners[side]
    T_wc = np.array([turn(0.5 * np.pi * s) for s in side])
    T_wc[:, 0, 3] = np.choose(side, [0 * way, way, 0 * way + short, short - way])
    T_wc[:, 2, 3] = np.choose(side, [way, 0 * way + long, long - way, 0 * way])
    return T_wc


def simulate(
    seed: int, n: int = 420, drift: float = 1.0, bias: bool = False
) -> tuple[np.ndarray, list[tuple[int, int]], np.ndarray]:
    """Simulate odometry ``T_wc`` and loops between poses that are one lap apart.

    The error of odometry is ``drift`` per cent over a hundred metres and more. It is a random walk
    of heading and position. With ``bias``, the error always turns and stretches the path in the
    same way. Loops are as verification would measure them.
    """
    rng = np.random.default_rng(seed)
    true = route(n)
    walk = np.array([0.01, 0.01, 0.02, 4e-4, 1e-3, 4e-4]) * drift
    always = rng.choice([-1, 1]) * np.array([0, 0, 4e-3, 0, 8e-5, 0]) * drift if bias else 0.0
    T_wc = true.copy()
    for k in range(1, n):
        error = se3_exp((0.4 if bias else 1.0) * walk * np.sqrt(1.2) * rng.normal(size=6) + always)
        step = T_wc[k - 1] @ inverse(true[k - 1]) @ true[k] @ error
        T_wc[k] = orthonormalised(step)
    lap = round(2 * sum(SIDES) / 1.2)
    loops = [(q, q - lap) for q in range(lap + 5, n, 60)]
    noise = rng.normal(size=(len(loops), 6)) * np.repeat([0.05, 0.0025], 3)
    measured = [
        inverse(true[q]) @ true[m] @ se3_exp(e) for (q, m), e in zip(loops, noise, strict=True)
    ]
    return T_wc, loops, np.array(measured)


def judge(graph: PoseGraph):
    T_cw = optimise(graph, CONFIG)
    return T_cw, check_pose_graph(graph, T_cw, CONFIG)


def position_error(T_cw: np.ndarray) -> float:
    true = route(len(T_cw))
    return float(np.sqrt(((inverses(T_cw) - true)[:, :3, 3] ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("drift", [0.5, 1.5])
def test_true_loops_pass_and_help(drift, bias):
    before, after = [], []
    for seed in range(4):
        T_wc, loops, measured = simulate(seed, drift=drift, bias=bias)
        graph = chain_graph(T_wc, loops, measured, reach=3)
        T_cw, verdict = judge(graph)
        assert verdict.consistent, verdict.reason
        half = CONFIG.model_copy(update={"max_strain": 0.5 * CONFIG.max_strain})
        assert check_pose_graph(graph, T_cw, half).consistent
        before.append(position_error(graph.T_cw))
        after.append(position_error(T_cw))
    assert np.mean(after) < 0.6 * np.mean(before)


def test_the_first_loop_alone_passes():
    for seed in range(4):
        T_wc, loops, measured = simulate(seed, n=250, drift=1.5, bias=seed % 2 == 1)
        _, verdict = judge(chain_graph(T_wc, loops[:1], measured[:1], reach=3))
        assert verdict.consistent, verdict.reason


@pytest.mark.parametrize("metres", [5.0, 50.0])
def test_a_wrong_loop_among_true_ones_is_recognised_and_ignored(metres):
    for seed in range(4):
        T_wc, loops, measured = simulate(seed)
        rng = np.random.default_rng(seed)
        a = rng.uniform(0, 2 * np.pi)
        off = translation(metres * np.sin(a), 0, metres * np.cos(a))
        query, match = loops[1]
        wrong = inverse(route(420)[query + 20]) @ route(420)[match + 20] @ off
        graph = chain_graph(T_wc, [*loops, (query + 20, match + 20)], [*measured, wrong], reach=3)
        T_cw, verdict = judge(graph)
        assert not verdict.consistent
        assert f"loop {match + 20}-{query + 20} is contradicted" in verdict.reason
        without, _ = judge(chain_graph(T_wc, loops, measured, reach=3))
        off_by = np.linalg.norm((inverses(T_cw) - inverses(without))[:, :3, 3], axis=1)
        assert off_by.max() < 0.3


def test_a_random_place_is_refused_though_nothing_else_speaks_against_it():
    for seed in range(6):
        T_wc, _, _ = simulate(seed, n=170)  # less than one lap
        rng = np.random.default_rng(seed)
        query, match = 160, int(rng.integers(20, 80))
        T = se3_exp(rng.normal(size=6) * np.repeat([0.5, 0.05], 3))
        _, verdict = judge(chain_graph(T_wc, [(query, match)], [T], reach=3))
        assert not verdict.consistent


def test_a_loop_off_by_ten_metres_after_two_hundred_is_refused():
    for seed in range(4):
        T_wc, loops, measured = simulate(seed, n=200)
        wrong = measured[0] @ translation(10.0, 0, 0)
        _, verdict = judge(chain_graph(T_wc, loops[:1], [wrong], reach=3))
        assert not verdict.consistent


@pytest.mark.parametrize(("metres", "yaw"), [(5.0, 0.3), (60.0, 1.6), (200.0, 3.0)])
def test_a_part_that_began_anew_is_joined_from_wherever_it_was(metres, yaw):
    """A loop across a weak edge moves the part after the restart without deforming it."""
    T_wc, loops, measured = simulate(1, n=260, drift=0.5)
    jump = T_wc[119] @ turn(yaw) @ translation(0.6 * metres, 0, 0.8 * metres) @ inverse(T_wc[119])
    lost = T_wc.copy()
    lost[120:] = jump @ lost[120:]
    graph = chain_graph(lost, loops[:1], measured[:1], reach=3, weak=[120])
    T_cw = optimise(graph, CONFIG)
    rigid = CONFIG.model_copy(update={"max_strain": 1.0})
    verdict = check_pose_graph(graph, T_cw, rigid)
    assert verdict.consistent, verdict.reason
    assert position_error(inverses(lost)) > 2.0
    assert position_error(T_cw) < 1.0


# ------------------------------------------------------------------------------ gravity

DOWN = np.array([0.0, 1.0, 0.0])


def sensed(T_wc: np.ndarray, sigma: float, seed: int = 0) -> dict[str, np.ndarray]:
    """Return what an IMU at true poses measures of gravity, as fields of a pose graph."""
    noise = np.random.default_rng(seed).normal(0.0, sigma, (len(T_wc), 3))
    gravity = T_wc[:, :3, :3].transpose(0, 2, 1) @ DOWN + noise
    gravity /= np.linalg.norm(gravity, axis=1)[:, None]
    return {"gravity": gravity, "gravity_sigma": np.full(len(T_wc), max(sigma, 1e-3))}


def tilts(T_cw: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the angles in degrees between estimated and true directions of gravity."""
    found, expected = T_cw[:, :3, :3] @ DOWN, true[:, :3, :3].transpose(0, 2, 1) @ DOWN
    return np.degrees(np.arccos(np.clip((found * expected).sum(axis=1), -1.0, 1.0)))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def test_a_map_with_an_imu_stays_level():
    """The path drifts in roll and pitch. Loops alone spread this error over the laps."""
    found = []
    for seed in range(6):
        T_wc, loops, measured = simulate(seed, drift=1.5)
        true = route(len(T_wc))
        graph = chain_graph(T_wc, loops, measured, reach=3)
        level = optimise_level(replace(graph, **sensed(true, 0.003, seed)), CONFIG)
        assert np.array_equal(level[0], graph.T_cw[0])
        loop_errors = edge_errors(level, graph.edges, graph.T_i_j, graph.sigmas)[graph.kind == LOOP]
        assert loop_errors.max() < CONFIG.max_loop_error
        three = graph.T_cw, optimise(graph, CONFIG), level
        heights = [rms((inverses(T_cw) - true)[:, 1, 3]) for T_cw in three]
        found.append([rms(tilts(T_cw, true)) for T_cw in three] + heights)
    drifted, closed, level, *heights = np.sqrt(np.mean(np.square(found), axis=0))
    assert level < 0.5 * closed < 0.5 * drifted
    assert level < 0.25
    assert heights[2] < 0.8 * heights[1] < 0.8 * heights[0]


def test_a_level_graph_stays_as_it_is():
    true = route(150)
    graph = replace(
        chain_graph(true, [(149, 3)], [inverse(true[149]) @ true[3]]), **sensed(true, 0)
    )
    np.testing.assert_allclose(optimise_level(graph, CONFIG), graph.T_cw, atol=1e-7)


def test_the_world_need_not_be_level():
    """The first camera looks down by 0.4 rad and is rolled by 0.3 rad, and so is the world."""
    T_wc, loops, measured = simulate(3, n=300)
    known = sensed(route(300), 0.003)
    graph = replace(chain_graph(T_wc, loops, measured), **known)
    T_camera = se3_exp(np.array([0, 0, 0, 0.4, 0, 0.3]))  # from the other camera to the first one
    R = T_camera[:3, :3]
    other = chain_graph(
        inverse(T_camera) @ T_wc @ T_camera, loops, inverse(T_camera) @ measured @ T_camera
    )
    other = replace(other, sigmas=graph.sigmas, **known | {"gravity": known["gravity"] @ R})
    expected = inverse(T_camera) @ optimise_level(graph, CONFIG) @ T_camera
    found = optimise_level(other, CONFIG)
    apart = np.array([se3_log(a @ inverse(b)) for a, b in zip(found, expected, strict=True)])
    assert np.abs(apart[:, :3]).max() < 0.02
    assert np.abs(apart[:, 3:]).max() < np.radians(0.02)


def test_measurements_of_gravity_within_the_memory_of_the_filter_count_as_one():
    map_ = Map(1.2 ** np.arange(8))
    for k in range(30):
        if k == 20:
            map_.begin_drive()
        gravity = GravityDirection(DOWN, 0.01) if k >= 5 else None
        map_.add_keyframe(Features.none(), np.eye(4), 0.1 * k, k, gravity=gravity)
        map_.parents[k] = k - 1
    graph = with_gravity(essential_graph(map_, [], CONFIG), map_)
    expected = 0.01 * np.sqrt(np.repeat([0, 15, 10], [5, 15, 10]))
    np.testing.assert_allclose(graph.gravity_sigma, expected)
    assert np.array_equal(graph.gravity[5:], np.tile(DOWN, (25, 1)))
    sparse = map_.copy()
    sparse.keyframes.timestamp[:] *= 1000.0
    graph = with_gravity(essential_graph(sparse, [], CONFIG), sparse)
    np.testing.assert_allclose(graph.gravity_sigma[5:], 0.01)
    assert map_.keyframes.gravity_sigma[10] == 0.01  # the map itself is not changed
