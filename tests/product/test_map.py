"""The map under random operations, its growth, and the data derived from its observations."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from vslam.types.features import Features
from vslam.types.geometry import se3_exp
from vslam.types.map import KEYFRAME_FIELDS, LANDMARK_FIELDS, PREDICTED, ROW_FIELDS, Map
from vslam.types.map_kernels import (
    collect_landmarks,
    count_seen_by,
    erase_landmark,
    fuse_landmarks,
    link,
    link_many,
    observed_by,
    predict_octave,
    refresh_landmarks,
    resolve,
    unlink,
)
from vslam.types.map_view import NO_LANDMARKS, local_map

SCALES = 1.2 ** np.arange(8)


def random_features(rng: np.random.Generator, n: int) -> Features:
    u_right = rng.uniform(0, 600, n).astype(np.float32)
    u_right[rng.random(n) < 0.4] = np.nan
    return Features(
        xy=rng.uniform(0, 200, (n, 2)).astype(np.float32),
        octave=rng.integers(0, 8, n).astype(np.uint8),
        angle=rng.uniform(-3, 3, n).astype(np.float32),
        descriptors=rng.integers(0, 256, (n, 32), dtype=np.uint8),
        u_right=u_right,
    )


def add_keyframe(map_: Map, rng: np.random.Generator, n: int = 20) -> int:
    T_cw = se3_exp(0.3 * rng.normal(size=6))
    k = map_.add_keyframe(random_features(rng, n), T_cw, 0.1 * map_.n_keyframes, map_.n_keyframes)
    map_.parents[k] = k - 1 if k else -1
    return k


def add_landmark(map_: Map, rng: np.random.Generator, keyframe: int = 0) -> int:
    xyz = rng.uniform([-5, -5, 5], [5, 5, 30], (1, 3))
    descriptor = rng.integers(0, 2**63, (1, 4)).astype(np.uint64)
    return int(map_.add_landmarks(xyz, descriptor, keyframe)[0])


def random_map(seed: int, operations: int, each=lambda map_: None) -> Map:
    """Make a map by random sequences of all operations that change observations."""
    rng = np.random.default_rng(seed)
    map_ = Map(SCALES)
    for _ in range(3):
        add_keyframe(map_, rng)
    for _ in range(operations):
        a = map_.arrays
        choice = rng.choice(
            ["keyframe", "create", "link", "unlink", "fuse", "erase", "cull"],
            p=[0.06, 0.16, 0.66, 0.05, 0.04, 0.015, 0.015],
        )
        landmarks, keyframes = map_.living_landmarks(), map_.living_keyframes()
        rows = np.concatenate([np.arange(map_.rows(k).start, map_.rows(k).stop) for k in keyframes])
        free = rows[a.landmark[rows] < 0]
        if choice == "keyframe":
            add_keyframe(map_, rng, int(rng.integers(0, 30)))
        elif choice == "create" and len(free):
            row = int(rng.choice(free))
            link(map_.arrays, row, add_landmark(map_, rng, int(a.keyframe[row])))
        elif choice == "link" and len(free) and len(landmarks):
            row, landmark = int(rng.choice(free)), int(rng.choice(landmarks))
            if observed_by(a, landmark, a.keyframe[row]) < 0:
                link(a, row, landmark)
        elif choice == "unlink" and len(free) < len(rows):
            unlink(a, int(rng.choice(rows[a.landmark[rows] >= 0])))
        elif choice == "fuse" and len(landmarks) > 1:
            fuse_landmarks(a, *(int(x) for x in rng.choice(landmarks, 2, replace=False)))
        elif choice == "erase" and len(landmarks):
            erase_landmark(a, int(rng.choice(landmarks)))
        elif choice == "cull" and len(keyframes) > 3:
            map_.cull_keyframe(int(rng.choice(keyframes[1:])))
        each(map_)
    return map_


@pytest.mark.parametrize("seed", range(3))
def test_invariants_hold_after_each_random_operation(seed, check_map):
    map_ = random_map(seed, 400, check_map)
    assert len(map_.living_landmarks()) > 10
    assert (map_.arrays.fused_into[: map_.n_landmarks] >= 0).any()
    assert len(map_.living_keyframes()) < map_.n_keyframes


def test_the_checker_finds_damage(check_map):
    for damage in ("next_row", "landmark", "n_observations", "head", "twice"):
        map_ = random_map(0, 200)
        a = map_.arrays
        row = int(np.flatnonzero(a.landmark[: map_.n_rows] >= 0)[0])
        if damage == "n_observations":
            a.n_observations[a.landmark[row]] += 1
        elif damage == "head":
            a.head[a.landmark[row]] = -1
        elif damage == "twice":
            rows = np.arange(map_.n_rows)
            same = rows[(a.keyframe[rows] == a.keyframe[row]) & (a.landmark[rows] < 0)]
            link(a, int(same[0]), int(a.landmark[row]))
        elif damage == "landmark":
            a.landmark[row] = -1
        else:
            chained = np.flatnonzero(a.next_row[: map_.n_rows] >= 0)
            a.next_row[chained[0]] = -1
        with pytest.raises(AssertionError):
            check_map(map_)


def seen_landmarks(map_: Map, k: int) -> set[int]:
    return {int(x) for x in map_.arrays.landmark[map_.rows(k)] if x >= 0}


@pytest.mark.parametrize("seed", range(3))
def test_covisibility_counts_shared_landmarks(seed):
    map_ = random_map(seed, 600)
    for k in map_.living_keyframes():
        shared = {
            int(o): len(seen_landmarks(map_, k) & seen_landmarks(map_, o))
            for o in map_.living_keyframes()
            if o != k
        }
        for minimum in (1, 3):
            others, counts = map_.covisible(int(k), minimum)
            expected = {o: n for o, n in shared.items() if n >= minimum}
            assert dict(zip(others.tolist(), counts.tolist(), strict=True)) == expected
            assert (np.diff(counts) <= 0).all()


def test_observers_are_counted():
    map_ = random_map(1, 600)
    observers = [
        sum(i in seen_landmarks(map_, k) for k in map_.living_keyframes())
        for i in range(map_.n_landmarks)
    ]
    for k in map_.living_keyframes():
        for needed in (1, 2, 3):
            expected = sum(observers[i] >= needed for i in seen_landmarks(map_, k))
            assert count_seen_by(map_.arrays, int(k), needed) == expected


def test_merging_keeps_one_row_of_a_keyframe_that_sees_both():
    rng = np.random.default_rng(0)
    map_ = Map(SCALES)
    for _ in range(3):
        add_keyframe(map_, rng, 4)
    a = map_.arrays
    a.u_right[:12] = [1, np.nan, 1, 1, np.nan, np.nan, 1, 1, 1, 1, 1, 1]
    loser, winner = add_landmark(map_, rng), add_landmark(map_, rng)
    link_many(a, np.array([0, 4, 8]), np.array([loser] * 3))
    link_many(a, np.array([1]), np.array([winner]))
    a.visible[[loser, winner]], a.found[[loser, winner]] = [10, 5], [7, 3]
    fuse_landmarks(a, loser, winner)
    assert a.landmark[[0, 1, 4, 8]].tolist() == [-1, winner, winner, winner]
    assert a.n_observations[[loser, winner]].tolist() == [0, 1 + 1 + 2]
    assert (a.visible[winner], a.found[winner]) == (15, 10)
    assert a.landmark_alive[[loser, winner]].tolist() == [False, True]


def test_resolve_follows_chains_of_fusions_and_forgets_the_erased():
    rng = np.random.default_rng(0)
    map_ = Map(SCALES)
    add_keyframe(map_, rng, 8)
    ids = [add_landmark(map_, rng) for _ in range(6)]
    link_many(map_.arrays, np.arange(6), np.array(ids))
    a = map_.arrays
    for loser, winner in ((0, 1), (1, 2), (2, 3)):
        fuse_landmarks(a, loser, winner)
    erase_landmark(a, 4)
    assert resolve(a, np.array([0, 1, 2, 3, 4, 5, -1], np.int32)).tolist() == [
        3,
        3,
        3,
        3,
        -1,
        5,
        -1,
    ]
    erase_landmark(a, 3)
    assert resolve(a, np.array([0, 1, 2, 3], np.int32)).tolist() == [-1] * 4


@pytest.mark.parametrize("seed", range(4))
def test_dropping_culled_landmarks_keeps_the_others_in_order(seed, check_map):
    map_ = random_map(seed, 300)
    before = map_.arrays.xyz[map_.living_landmarks()]
    ids = np.arange(map_.n_landmarks, dtype=np.int32)
    stood_for = resolve(map_.arrays, ids)
    places = map_.arrays.xyz[np.maximum(stood_for, 0)]
    observed = {k: map_.arrays.xyz[map_.landmarks_of(k)] for k in map_.living_keyframes()}
    new_id = map_.drop_culled_landmarks()
    check_map(map_)
    assert map_.n_landmarks == len(before) < len(ids)
    assert np.array_equal(map_.arrays.xyz[: map_.n_landmarks], before)
    assert np.array_equal(new_id >= 0, stood_for >= 0)
    known = new_id >= 0
    assert np.array_equal(map_.arrays.xyz[new_id[known]], places[known])
    for k, xyz in observed.items():
        assert np.array_equal(map_.arrays.xyz[map_.landmarks_of(k)], xyz)
    assert not map_.many_culled_landmarks


def test_a_landmark_without_observations_is_culled():
    rng = np.random.default_rng(0)
    map_ = Map(SCALES)
    add_keyframe(map_, rng, 8)
    landmark = add_landmark(map_, rng)
    link_many(map_.arrays, np.array([2]), np.array([landmark]))
    assert map_.living_landmarks().tolist() == [0]
    unlink(map_.arrays, 2)
    assert map_.living_landmarks().tolist() == []


# -- culled keyframes -----------------------------------------------------------------------------


def test_a_culled_keyframe_follows_its_parent(check_map):
    rng = np.random.default_rng(0)
    map_ = Map(SCALES)
    for _ in range(6):
        add_keyframe(map_, rng)
    a = map_.arrays
    poses = a.T_cw[:6].copy()
    map_.cull_keyframe(3)
    map_.cull_keyframe(2)  # the parent of a culled keyframe, so that 3 depends on 1 through 2
    np.testing.assert_allclose(map_.keyframe_pose(3), poses[3], rtol=0, atol=1e-12)
    assert map_.parents[4] == 1
    assert map_.living_keyframes().tolist() == [0, 1, 4, 5]
    check_map(map_)
    moved = se3_exp(rng.normal(size=6))
    a.T_cw[1] = moved
    relative = [poses[k] @ np.linalg.inv(poses[1]) for k in (2, 3)]
    np.testing.assert_allclose(map_.keyframe_pose(2), relative[0] @ moved, rtol=0, atol=1e-12)
    np.testing.assert_allclose(map_.keyframe_pose(3), relative[1] @ moved, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(map_.keyframe_pose(4), poses[4])


def test_pose_of_a_keyframe_is_a_copy():
    map_ = Map(SCALES)
    add_keyframe(map_, np.random.default_rng(0))
    before = map_.arrays.T_cw[0].copy()
    map_.keyframe_pose(0)[:] = 0.0
    np.testing.assert_array_equal(map_.arrays.T_cw[0], before)


@pytest.mark.slow
def test_a_long_chain_of_culled_keyframes_still_has_poses():
    """If the camera stands still, thousands of keyframes are culled."""
    rng = np.random.default_rng(0)
    map_ = Map(SCALES)
    for _ in range(1500):
        add_keyframe(map_, rng, 0)
    expected = map_.arrays.T_cw[1499].copy()
    for k in range(1499, 0, -1):
        map_.cull_keyframe(k)
    np.testing.assert_allclose(map_.keyframe_pose(1499), expected, rtol=0, atol=1e-9)


# -- derived values -------------------------------------------------------------------------------


def test_refresh_takes_the_descriptor_of_least_median_distance():
    map_ = random_map(2, 500)
    a = map_.arrays
    landmarks = map_.living_landmarks().astype(np.int32)
    refresh_landmarks(a, landmarks, SCALES)
    crowds = 0
    for i in landmarks:
        rows = [r for r in range(map_.n_rows) if a.landmark[r] == i]
        crowds += len(rows) >= 3
        bits = np.unpackbits(a.descriptor[rows].view(np.uint8), axis=1).astype(int)
        distance = np.abs(bits[:, None] - bits[None]).sum(axis=2)
        medians = np.sort(distance, axis=1)[:, (len(rows) - 1) // 2]
        best = [a.descriptor[r].tobytes() for r, m in zip(rows, medians, strict=True)
                if m == medians.min()]  # fmt: skip
        assert a.landmark_descriptor[i].tobytes() in best
    assert crowds > 10


def test_refresh_computes_mean_direction_and_distance_range():
    map_ = random_map(3, 500)
    a = map_.arrays
    landmarks = map_.living_landmarks().astype(np.int32)
    refresh_landmarks(a, landmarks, SCALES)
    centres = np.linalg.inv(a.T_cw[: map_.n_keyframes])[:, :3, 3]
    for i in landmarks:
        rows = np.array([r for r in range(map_.n_rows) if a.landmark[r] == i])
        rays = a.xyz[i] - centres[a.keyframe[rows]]
        distance = np.linalg.norm(rays, axis=1)
        mean = (rays / distance[:, None]).sum(axis=0)
        np.testing.assert_allclose(a.normal[i], mean / np.linalg.norm(mean), rtol=0, atol=1e-12)
        reference = a.keyframe[rows].argmin()
        farthest = distance[reference] * SCALES[a.octave[rows[reference]]]
        np.testing.assert_allclose(
            a.distance_range[i], [farthest / SCALES[-1], farthest], rtol=1e-12
        )


def test_predicted_octave_is_the_one_the_reach_was_computed_from():
    log_scale = np.log(1.2)
    for octave in range(8):
        farthest = 13.0 * SCALES[octave]
        assert predict_octave(13.0 * 1.0001, farthest, log_scale, 8) == octave
    assert predict_octave(1e-3, 13.0, log_scale, 8) == 7
    assert predict_octave(1e3, 13.0, log_scale, 8) == 0


def test_local_map_holds_the_landmarks_around_a_keyframe_and_is_a_copy():
    map_ = random_map(4, 600)
    current = int(map_.living_keyframes()[-2])
    neighbours, _ = map_.covisible(current)
    assert len(neighbours) > 2
    alone = local_map(map_, current, 1)
    assert set(alone.ids.tolist()) == seen_landmarks(map_, current)
    three = local_map(map_, current, 3)
    chosen = [current, *neighbours[:2].tolist()]
    expected = set.union(*(seen_landmarks(map_, k) for k in chosen))
    assert three.ids.tolist() == sorted(expected)
    np.testing.assert_array_equal(three.xyz, map_.arrays.xyz[three.ids])
    map_.arrays.xyz[:] = np.nan
    map_.arrays.landmark_descriptor[:] = 0
    assert np.isfinite(three.xyz).all()
    assert three.descriptor.any()


def test_a_landmark_that_two_keyframes_observe_is_confirmed():
    map_ = random_map(4, 600)
    local = local_map(map_, int(map_.living_keyframes()[-2]), 3)
    seen = [seen_landmarks(map_, k) for k in map_.living_keyframes().tolist()]
    twice = np.array([sum(i in one for one in seen) >= 2 for i in local.ids.tolist()])
    np.testing.assert_array_equal(local.confirmed, twice)
    assert 0 < np.count_nonzero(twice) < len(twice)
    ids = np.array([-1, local.ids[~twice][0], local.ids[twice][0], local.ids[-1] + 1], np.int32)
    assert local.confirms(ids).tolist() == [False, False, True, False]
    assert NO_LANDMARKS.confirms(ids).tolist() == [False] * 4


def test_collected_landmarks_are_those_of_any_of_the_keyframes():
    map_ = random_map(5, 600)
    some = map_.living_keyframes()[::2]
    expected = set.union(*(seen_landmarks(map_, k) for k in some))
    found = collect_landmarks(map_.arrays, some, map_.n_landmarks)
    assert found.tolist() == sorted(expected)


# -- growth ---------------------------------------------------------------------------------------


def test_content_survives_growth(check_map):
    rng = np.random.default_rng(0)
    map_ = Map(SCALES)
    small = len(map_.arrays.keyframe_alive), len(map_.arrays.head), len(map_.arrays.keyframe)
    kept = []
    for k in range(small[0] + 10):
        n = small[2] // 60
        features = random_features(rng, n)
        assert map_.add_keyframe(features, se3_exp(rng.normal(size=6)), 0.1 * k, k) == k
        ids = map_.add_landmarks(rng.normal(size=(n // 6, 3)), np.zeros((n // 6, 4), np.uint64), k)
        link_many(map_.arrays, map_.rows(k).start + np.arange(len(ids)), ids)
        kept.append((features, map_.arrays.T_cw[k].copy(), map_.arrays.xyz[ids].copy(), ids))
    assert map_.n_keyframes > small[0]
    assert map_.n_landmarks > small[1]
    assert map_.n_rows > small[2]
    a = map_.arrays
    for k, (features, T_cw, xyz, ids) in enumerate(kept):
        rows = map_.rows(k)
        np.testing.assert_array_equal(a.xy[rows], features.xy)
        np.testing.assert_array_equal(a.u_right[rows], features.u_right)
        np.testing.assert_array_equal(a.descriptor[rows].view(np.uint8), features.descriptors)
        np.testing.assert_array_equal(a.T_cw[k], T_cw)
        np.testing.assert_array_equal(a.xyz[ids], xyz)
        assert map_.landmarks_of(k).tolist() == ids.tolist()
    check_map(map_)


@pytest.mark.slow
def test_grows_to_5000_keyframes_and_a_million_landmarks_in_bounded_memory():
    rng = np.random.default_rng(0)
    features = random_features(rng, 200)
    xyz, descriptors = np.ones((200, 3)), np.ones((200, 4), np.uint64)
    seen_arrays = set()
    tracemalloc.start()
    map_ = Map(SCALES)
    for k in range(5000):
        map_.add_keyframe(features, np.eye(4), float(k), k)
        ids = map_.add_landmarks(xyz, descriptors, k)
        link_many(map_.arrays, map_.rows(k).start + np.arange(200), ids)
        seen_arrays.add(len(map_.arrays.head))
    held, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert (map_.n_keyframes, map_.n_landmarks, map_.n_rows) == (5000, 1_000_000, 1_000_000)
    assert len(map_.living_landmarks()) == 1_000_000
    assert map_.landmarks_of(4999).tolist() == list(range(999_800, 1_000_000))
    sizes = {name: getattr(map_.arrays, name).nbytes for name in map_.arrays._fields}
    capacity_rows, capacity_landmarks = len(map_.arrays.keyframe), len(map_.arrays.head)
    assert sum(sizes[f] for f in ROW_FIELDS) / capacity_rows <= 64  # bytes a keypoint
    assert sum(sizes[f] for f in LANDMARK_FIELDS) / capacity_landmarks <= 128
    assert capacity_rows <= 1.5 * 1_000_000 + 200
    assert capacity_landmarks <= 1.5 * 1_000_000 + 200
    assert held < 1.1 * sum(sizes.values()) + 5e6
    assert peak < 2.0 * held
    # The number of copies grows with the logarithm of the size, not with each keyframe.
    assert len(seen_arrays) <= 1 + np.ceil(np.log(1_000_000 / 8192) / np.log(1.5))


def test_submaps_begin_at_restarts_and_pass_to_children():
    rng = np.random.default_rng(0)
    map_ = Map(1.2 ** np.arange(8.0))
    for keyframe in range(6):
        add_keyframe(map_, rng)
        map_.parents[keyframe] = keyframe - 1
    map_.keyframes.restart[3] = PREDICTED
    map_.parents[5] = 1
    assert map_.submaps().tolist() == [0, 0, 0, 3, 3, 0]


def test_a_copy_is_without_spare_capacity():
    map_, rng = Map(SCALES), np.random.default_rng(5)
    keyframe = map_.add_keyframe(random_features(rng, 7), np.eye(4), 0.0, 0)
    map_.add_landmarks(rng.uniform(1, 9, (3, 3)), np.zeros((3, 4), np.uint64), keyframe)
    used = map_.copy().arrays
    lengths = {name: len(getattr(used, name)) for name in used._fields}
    assert lengths == {
        name: 1 if name in KEYFRAME_FIELDS else 3 if name in LANDMARK_FIELDS else 7
        for name in used._fields
    } | {"first_row": 2}
    map_.arrays.xyz[:] = 0.0
    assert (used.xyz >= 1.0).all()
