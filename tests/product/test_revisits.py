"""Frames at known places measure these places again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from test_global_mapping import pose, world_of
from test_local_mapping import CAMERA, make_world

from vslam.backend.global_bundle_adjustment import adjust_globally
from vslam.backend.global_mapping import apply_solution, take_snapshot
from vslam.maps.stored_map import StoredMap, appended, selected
from vslam.method.map_frames import sees_old_place
from vslam.types.geometry import inverse, se3_exp
from vslam.types.map import revisits_of_living
from vslam.types.map_kernels import link_many
from vslam.types.revisits import Revisits


def seen_from(world, keyframe: int, T_cw: np.ndarray, noise: float = 0.0) -> Revisits:
    """Return the revisit of a frame with the true pose ``T_cw``, relative to the map's keyframe."""
    landmarks = world.map.living_landmarks().astype(np.int32)
    points = world.map.arrays.xyz[landmarks] @ T_cw[:3, :3].T + T_cw[:3, 3]
    uvr = CAMERA.project(points)
    inside = (points[:, 2] > 1.0) & (uvr[:, :2] > 0).all(1)
    inside &= (uvr[:, :2] < [CAMERA.width, CAMERA.height]).all(1)
    n = int(inside.sum())
    uvr = uvr[inside] + noise * np.random.default_rng(5).normal(size=(n, 3))
    T = T_cw @ inverse(world.map.keyframe_pose(keyframe))
    return Revisits(
        np.array([keyframe]),
        T[None],
        np.array([0, n]),
        landmarks[inside],
        uvr.astype(np.float32),
        np.zeros(n, np.uint8),
        np.ones(n, np.uint8),
    )


def test_a_revisit_is_a_camera_of_global_bundle_adjustment():
    world = world_of(6)
    bare = take_snapshot(world.map, CAMERA).problem
    world.map.revisits = seen_from(world, 2, pose(2))
    snapshot = take_snapshot(world.map, CAMERA)
    n = len(world.map.revisits.landmark)
    assert snapshot.n_revisits == 1
    assert n > 50
    assert snapshot.problem.n_free == bare.n_free + 1
    assert np.count_nonzero(snapshot.problem.camera == 0) == n == np.sum(snapshot.rows < 0)
    assert (np.diff(snapshot.problem.first) - np.diff(bare.first)).sum() == n
    # Without the revisit's observations, the problem is the same as before.
    kept = snapshot.rows >= 0
    np.testing.assert_array_equal(snapshot.problem.camera[kept] - 1, bare.camera)
    np.testing.assert_array_equal(snapshot.problem.uvr[kept], bare.uvr)


def test_what_a_revisit_measured_moves_the_map():
    """If the features of the keyframes are noisy, exact revisits bring the landmarks closer to
    their true positions."""

    def error(*, revisited: bool) -> float:
        world = world_of(6, noise=1.0)
        truth = world.map.arrays.xyz[: world.map.n_landmarks].copy()
        if revisited:
            for k in range(1, 6):
                new = seen_from(world, k, pose(k))
                world.map.revisits = world.map.revisits.followed_by(new)
        snapshot = take_snapshot(world.map, CAMERA)
        apply_solution(world.map, snapshot, adjust_globally(snapshot.problem, iterations=30))
        error = world.map.arrays.xyz[: len(truth)] - truth
        return float(np.median(np.linalg.norm(error, axis=1)))

    assert error(revisited=True) < 0.7 * error(revisited=False)


def test_the_pose_of_a_revisit_is_adjusted_and_follows_its_keyframe():
    world = world_of(6)
    revisit = seen_from(world, 2, pose(2.4))
    wrong = se3_exp(np.array([0.05, 0.0, 0.05, 0.0, 0.01, 0.0])) @ revisit.T_c_keyframe[0]
    world.map.revisits = revisit.moved(wrong[None])
    snapshot = take_snapshot(world.map, CAMERA)
    apply_solution(world.map, snapshot, adjust_globally(snapshot.problem, iterations=30))
    found = world.map.revisits.T_c_keyframe[0]
    np.testing.assert_allclose(found, revisit.T_c_keyframe[0], atol=1e-4)
    before = found @ world.map.keyframe_pose(2)
    world.map.cull_keyframe(2)
    living = revisits_of_living(world.map)
    assert living.keyframe.tolist() != [2]
    after = living.T_c_keyframe[0] @ world.map.keyframe_pose(int(living.keyframe[0]))
    np.testing.assert_allclose(after, before, atol=1e-9)


def test_landmarks_of_a_revisit_are_renumbered():
    revisits = Revisits(
        np.array([0, 3]),
        np.tile(np.eye(4), (2, 1, 1)),
        np.array([0, 3, 5]),
        np.array([4, 2, 7, 2, 5], np.int32),
        np.arange(15, dtype=np.float32).reshape(5, 3),
        np.zeros(5, np.uint8),
        np.ones(5, np.uint8),
    )
    # Landmarks 4 and 7 become one, and landmark 5 is culled.
    new = revisits.observing(np.array([1, 0, 1, 0, -1], np.int32))
    assert new.landmark.tolist() == [1, 0, -1, 0, -1]
    both = revisits.followed_by(revisits, keyframes=10, landmarks=100)
    assert both.keyframe.tolist() == [0, 3, 10, 13]
    assert both.landmark[5:].tolist() == [104, 102, 107, 102, 105]
    assert both.first.tolist() == [0, 3, 5, 8, 10]
    last = both.select(np.array([3, 1]))
    assert last.landmark.tolist() == [102, 105, 2, 5]
    np.testing.assert_array_equal(last.uvr[2:], revisits.uvr[3:])


def test_parts_and_sums_of_maps_keep_their_revisits():
    world = world_of(6)
    for k in (1, 4):
        world.map.revisits = world.map.revisits.followed_by(seen_from(world, k, pose(k)))
    map_ = world.map
    part = selected(map_, np.array([0, 3, 4, 5]))
    assert part.revisits.keyframe.tolist() == [2]
    seen = part.revisits.landmark >= 0
    old = map_.revisits.select(np.array([1]))
    np.testing.assert_array_equal(
        part.arrays.xyz[part.revisits.landmark[seen]], map_.arrays.xyz[old.landmark[seen]]
    )
    one = StoredMap(selected(map_, map_.living_keyframes()), CAMERA)
    both = appended(one, replace(one)).map
    n = one.map.n_landmarks
    assert both.revisits.keyframe.tolist() == [1, 4, 7, 10]
    np.testing.assert_array_equal(
        both.revisits.landmark[len(one.map.revisits.landmark) :], one.map.revisits.landmark + n
    )


def test_a_keyframe_returns_to_an_old_place_if_it_skips_a_stretch():
    """Keyframes 0 to 19 each share their landmarks with the next two. The last sees the first."""
    world = make_world(400)
    groups = np.array_split(np.arange(400), 20)
    for k in range(20):
        world.add_keyframe(np.eye(4), among=np.concatenate(groups[max(0, k - 2) : k + 1]))
    world.link_truth(range(20))
    assert not any(sees_old_place(world.map, k, 5) for k in range(20))
    back = world.add_keyframe(np.eye(4), among=np.concatenate([groups[19], groups[3]]))
    rows = np.arange(world.map.rows(back).start, world.map.n_rows)
    landmark_of = {
        int(world.point_of_row[row]): int(world.map.arrays.landmark[row]) for row in range(rows[0])
    }
    seen = np.array([landmark_of[int(point)] for point in world.point_of_row[rows]], np.int32)
    link_many(world.map.arrays, rows, seen)
    assert sees_old_place(world.map, back, 5)
    assert not sees_old_place(world.map, back, 30)
