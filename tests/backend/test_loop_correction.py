"""Landmarks move together with their keyframes."""

from __future__ import annotations

import numpy as np
import pytest
from test_local_mapping import CAMERA, World, make_world

from vslam.backend.loop_correction import move_keyframes
from vslam.types.geometry import inverse, se3_exp, transform
from vslam.types.map_kernels import refresh_landmarks

POSES = [se3_exp(np.array([0.1 * k, 0.0, -0.6 * k, 0.0, 0.01 * k, 0.0])) for k in range(5)]


def world_of_five() -> World:
    world = make_world(300)
    for T_cw in POSES:
        world.add_keyframe(T_cw, noise=0.3)
    for k in range(5):  # each keyframe creates a fifth of the landmarks
        world.link_truth(range(k, 5), chosen=np.arange(60 * k, 60 * k + 60))
    return world


def moved_poses(keyframes) -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.array([se3_exp(rng.normal(size=6)) @ POSES[k] for k in keyframes])


def reprojection(world: World, keyframe: int, landmarks: np.ndarray) -> np.ndarray:
    a = world.map.arrays
    return CAMERA.project(transform(a.T_cw[keyframe], a.xyz[landmarks]))


def test_nothing_changes_as_seen_from_the_anchor():
    world = world_of_five()
    a = world.map.arrays
    anchored = [np.flatnonzero(a.first_keyframe[: world.map.n_landmarks] == k) for k in range(5)]
    assert min(map(len, anchored)) > 30
    before = [reprojection(world, k, anchored[k]) for k in range(5)]
    distances = a.distance_range.copy()
    new = moved_poses(range(5))
    move_keyframes(world.map, np.arange(5), new)
    np.testing.assert_array_equal(a.T_cw[:5], new)
    for k in range(5):
        after = reprojection(world, k, anchored[k])
        np.testing.assert_allclose(after, before[k], rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(a.distance_range, distances)


def test_only_the_named_keyframes_and_what_is_anchored_in_them_move():
    world = world_of_five()
    a, n = world.map.arrays, world.map.n_landmarks
    T_cw, xyz = a.T_cw.copy(), a.xyz[:n].copy()
    move_keyframes(world.map, np.array([3, 0]), moved_poses([3, 0]))
    still = np.isin(a.first_keyframe[:n], [1, 2, 4])
    assert 0 < np.count_nonzero(still) < n
    np.testing.assert_array_equal(a.xyz[:n][still], xyz[still])
    assert (np.abs(a.xyz[:n][~still] - xyz[~still]).max(axis=1) > 1e-3).all()
    np.testing.assert_array_equal(a.T_cw[[1, 2, 4]], T_cw[[1, 2, 4]])


def test_a_common_motion_leaves_nothing_to_refresh():
    """If the whole map moves rigidly, the normals and distance ranges move with it."""
    world = world_of_five()
    a, n = world.map.arrays, world.map.n_landmarks
    motion = se3_exp(np.array([3.0, -1.0, 2.0, 0.3, -0.8, 0.5]))
    new = np.array([T_cw @ inverse(motion) for T_cw in a.T_cw[:5]])
    xyz = transform(motion, a.xyz[:n])
    move_keyframes(world.map, np.arange(5), new)
    np.testing.assert_allclose(a.xyz[:n], xyz, atol=1e-12)
    normal, distances = a.normal[:n].copy(), a.distance_range[:n].copy()
    refresh_landmarks(a, np.arange(n), world.map.scales)
    np.testing.assert_allclose(normal, a.normal[:n], atol=1e-12)
    np.testing.assert_allclose(distances, a.distance_range[:n], rtol=1e-12)


def test_landmarks_of_a_culled_anchor_move_with_the_next_that_sees_them(check_map):
    world = world_of_five()
    world.map.parents[2] = 1
    a, n = world.map.arrays, world.map.n_landmarks
    world.map.cull_keyframe(1)
    orphans = np.flatnonzero((a.first_keyframe[:n] == 1) & a.landmark_alive[:n])
    seen_by_2 = np.intersect1d(orphans, world.map.landmarks_of(2))
    assert len(seen_by_2) > 0
    before = reprojection(world, 2, seen_by_2)
    culled = world.map.keyframe_pose(1) @ inverse(a.T_cw[0])
    move_keyframes(world.map, np.array([0, 2, 3, 4]), moved_poses([0, 2, 3, 4]))
    np.testing.assert_allclose(reprojection(world, 2, seen_by_2), before, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        world.map.keyframe_pose(1) @ inverse(a.T_cw[0]), culled, atol=1e-12
    )  # placed relative to its parent, as before
    check_map(world.map)


def test_culled_landmarks_stay_where_they_were():
    world = world_of_five()
    a = world.map.arrays
    world.map.cull_keyframe(4)
    culled = np.flatnonzero(~a.landmark_alive[: world.map.n_landmarks])
    assert len(culled) > 0
    xyz = a.xyz[culled].copy()
    move_keyframes(world.map, np.arange(4), moved_poses(range(4)))
    np.testing.assert_array_equal(a.xyz[culled], xyz)


def test_a_culled_keyframe_cannot_be_moved():
    world = world_of_five()
    world.map.cull_keyframe(2)
    before = world.map.arrays.T_cw.copy()
    with pytest.raises(ValueError, match="culled"):
        move_keyframes(world.map, np.array([1, 2]), moved_poses([1, 2]))
    np.testing.assert_array_equal(world.map.arrays.T_cw, before)
