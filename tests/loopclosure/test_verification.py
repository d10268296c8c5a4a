"""Loop candidates on a simulated street that is passed twice, with drift between the passes."""

from __future__ import annotations

import numpy as np
import pytest
from test_local_mapping import CAMERA, World, make_world

from vslam.config import Config, ConsistencyConfig, VerificationConfig
from vslam.loopclosure.verification import guided_match, reverse_match, verify
from vslam.types.context import Context
from vslam.types.geometry import inverse, se3_exp, se3_log
from vslam.types.loops import LoopCandidate
from vslam.types.map_kernels import link_many, refresh_landmarks

CONFIG = VerificationConfig()
CONTEXT = Context.create(CAMERA, Config())
PASS = 4  # keyframes of each pass
DRIFT = se3_exp(np.array([3.0, -0.4, 5.0, 0.02, 0.15, -0.01]))


def forward(metres: float, sideways: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    return inverse(se3_exp(np.array([sideways, 0.0, metres, 0.0, yaw, 0.0])))


def link_pass(world: World, keyframes: range) -> None:
    """Make the landmarks of one pass. Each landmark is seen by at least two of its keyframes."""
    a = world.map.arrays
    rows = np.concatenate([np.arange(a.first_row[k], a.first_row[k + 1]) for k in keyframes])
    shown = world.point_of_row[rows]
    for point in np.unique(shown):
        of_point = rows[shown == point]
        if len(of_point) < 2:
            continue
        ids = world.map.add_landmarks(
            world.points[[point]], world.map.arrays.descriptor[of_point[:1]], int(keyframes[0])
        )
        link_many(world.map.arrays, of_point, np.repeat(ids, len(of_point)))
    refresh_landmarks(
        world.map.arrays, world.map.living_landmarks().astype(np.int32), world.map.scales
    )


def let_drift(world: World, keyframes: range) -> None:
    """Move the keyframes of one pass, and their landmarks, as one rigid body."""
    a = world.map.arrays
    ids = np.unique(np.concatenate([world.map.landmarks_of(k) for k in keyframes]))
    for k in keyframes:
        a.T_cw[k] = a.T_cw[k] @ inverse(DRIFT)
    a.xyz[ids] = a.xyz[ids] @ DRIFT[:3, :3].T + DRIFT[:3, 3]
    refresh_landmarks(a, ids.astype(np.int32), world.map.scales)


def street(among=None, *, mono: bool = False, seed: int = 0, noise: float = 0.5) -> World:
    """Make a map of a street that was passed twice.

    In the second pass, the points that are not in ``among`` have new descriptors.
    """
    world = make_world(900, seed=seed)
    for i in range(PASS):
        world.add_keyframe(forward(0.8 * i), noise=noise)
    link_pass(world, range(PASS))
    if among is not None:
        changed = ~np.isin(np.arange(len(world.points)), among)
        world.descriptors[changed] = world.rng.integers(
            0, 256, (np.count_nonzero(changed), 32), dtype=np.uint8
        )
    for i in range(PASS):
        world.add_keyframe(forward(0.8 * i + 0.3, 0.5, 0.05), noise=noise, mono=mono)
    link_pass(world, range(PASS, 2 * PASS))
    let_drift(world, range(PASS, 2 * PASS))
    return world


def check(world: World, config: VerificationConfig = CONFIG, query: int = 6, match: int = 1):
    context = Context.create(CAMERA, Config(verification=config))
    return verify(world.map, LoopCandidate(query, match, 0.5), context)


def error(world: World, edge) -> tuple[float, float]:
    true = world.truth[edge.query] @ inverse(world.truth[edge.match])
    twist = se3_log(edge.T_query_match @ inverse(true))
    return float(np.linalg.norm(twist[:3])), float(np.degrees(np.linalg.norm(twist[3:])))


@pytest.mark.parametrize("seed", range(4))
def test_a_revisit_is_accepted_whatever_the_drift(seed, check_map):
    world = street(seed=seed)
    edge = check(world)
    assert edge.accepted, edge.reason
    assert edge.reason == "verified"
    metres, degrees = error(world, edge)
    assert metres < 0.02
    assert degrees < 0.06
    assert edge.n_inliers == len(edge.features) == len(edge.landmarks) > 150
    check_map(world.map)


def test_the_matches_of_an_edge_are_right_alive_and_unique():
    world = street()
    a = world.map.arrays
    edge = check(world)
    assert edge.features.dtype == edge.landmarks.dtype == np.int32
    assert len(set(edge.features.tolist())) == len(edge.features)
    assert len(set(edge.landmarks.tolist())) == len(edge.landmarks)
    assert a.landmark_alive[edge.landmarks].all()
    rows = a.first_row[edge.query] + edge.features
    assert (a.keyframe[rows] == edge.query).all()
    shown = world.point_of_row[rows]
    meant = world.point_of_row[a.head[edge.landmarks]]
    assert np.mean(shown == meant) > 0.99
    # The place has more landmarks than the match: those of its neighbours are used, too.
    edge = check(world, query=4, match=3)
    assert edge.accepted, edge.reason
    assert np.setdiff1d(edge.landmarks, world.map.landmarks_of(edge.match)).size > 0


def test_monocular_features_of_the_query_do_as_well():
    edge = check(world := street(mono=True))
    assert edge.accepted, edge.reason
    metres, degrees = error(world, edge)
    assert metres < 0.03
    assert degrees < 0.06


def test_the_map_is_only_read_and_the_answer_is_the_same_again():
    world = street()
    before = [array.tobytes() for array in world.map.arrays]
    first, again = check(world), check(world)
    assert [array.tobytes() for array in world.map.arrays] == before
    assert first.T_query_match.tobytes() == again.T_query_match.tobytes()
    np.testing.assert_array_equal(first.landmarks, again.landmarks)


def test_a_revisit_in_other_light_is_accepted():
    # Three of four points look different. The other points are distributed over the street.
    world = street(among=np.arange(0, 900, 4))
    edge = check(world)
    assert edge.accepted, edge.reason
    assert error(world, edge)[0] < 0.03


def test_another_place_has_no_matches():
    world = street(among=[])
    edge = check(world)
    assert not edge.accepted
    assert edge.reason.endswith("descriptors match")
    assert edge.T_query_match is None
    assert edge.features is None


def test_chance_matches_agree_on_no_motion():
    world = street(among=[])
    a = world.map.arrays
    rows_q = np.flatnonzero(a.landmark[world.map.rows(6)] >= 0)[:60] + a.first_row[6]
    rows_m = np.flatnonzero(a.landmark[world.map.rows(1)] >= 0)[:60] + a.first_row[1]
    a.descriptor[rows_q] = a.descriptor[rows_m]
    edge = check(world)
    assert edge.n_matches >= 55
    assert edge.reason == "no motion has 15 inliers among the matches"
    assert not edge.accepted


def in_strip(world: World, left: float, right: float) -> np.ndarray:
    """Return the points that appear between two columns of the first image."""
    u = CAMERA.project(world.points)[:, 0]
    return np.flatnonzero((u > left) & (u < right))


@pytest.mark.parametrize(("left", "right"), [(250, 390), (60, 180)])
def test_one_object_that_looks_the_same_is_no_revisit(left, right):
    points = in_strip(make_world(900), left, right)  # a parked car, a facade
    world = street(among=points)
    edge = check(world)
    assert edge.n_inliers >= CONFIG.min_inliers  # ORB-SLAM would accept this number
    assert error(world, edge)[0] < 0.5
    assert edge.p_wrong**2 > ConsistencyConfig().max_wrong  # not even if a neighbour agrees
    assert edge.accepted == (edge.p_wrong < 0.5)
    if not edge.accepted:
        assert edge.reason.startswith("probably another place")


def test_what_should_be_seen_and_is_not_speaks_against_a_loop():
    whole = check(street())
    changed = check(street(among=np.arange(0, 900, 4)))  # three of four points look different
    assert changed.evidence.seen < 0.5 < whole.evidence.seen
    assert changed.evidence.elsewhere < 0.5 < whole.evidence.elsewhere
    assert changed.p_wrong > whole.p_wrong
    # Now the query has many landmarks that the place does not have.
    world = street()
    new = np.flatnonzero(world.map.arrays.landmark[world.map.rows(1)] >= 0)
    rows = new + world.map.arrays.first_row[1]
    world.map.arrays.descriptor[rows[100:]] = 0
    edge = check(world)
    assert edge.evidence.seen_back < 0.5 < whole.evidence.seen_back
    assert edge.p_wrong > whole.p_wrong


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"min_inliers": 2000}, "landmarks of the place fit"),
        ({"max_distance": 0.1}, "m from the place"),
    ],
)
def test_every_gate_says_what_it_missed(change, reason):
    edge = check(street(), CONFIG.model_copy(update=change))
    assert not edge.accepted
    assert reason in edge.reason
    assert edge.features is not None  # kept for the report


def test_both_sides_of_a_revisit_see_each_other():
    world = street()
    edge = check(world)
    found = reverse_match(world.map, edge, CAMERA)
    assert np.mean(found.seen) > 0.7
    np.testing.assert_allclose(
        found.T_cw @ inverse(world.map.keyframe_pose(6)), inverse(edge.T_query_match), atol=0.03
    )


def test_a_keyframe_finds_the_landmarks_it_sees():
    world = street()
    landmarks = world.map.landmarks_of(1)
    start = se3_exp(np.array([0.05, 0.0, 0.05, 0.0, 0.004, 0.0])) @ world.map.keyframe_pose(1)
    found = guided_match(world.map, 1, landmarks, start, CAMERA)
    assert np.mean(found.seen) > 0.9
    assert np.abs(se3_log(found.T_cw @ inverse(world.truth[1]))).max() < 0.02
    rows = world.map.arrays.first_row[1] + found.feature[found.seen]
    assert np.mean(world.map.arrays.landmark[rows] == found.landmarks[found.seen]) > 0.99
