"""Global bundle adjustment optimises a snapshot. Its solution is applied to a changed map."""

from __future__ import annotations

import numpy as np
from test_local_mapping import CAMERA, World, make_world

from vslam.backend.bundle_adjustment import BundleSolution
from vslam.backend.global_bundle_adjustment import adjust_globally
from vslam.backend.global_mapping import apply_solution, connected_parts, take_snapshot
from vslam.types.geometry import inverse, se3_exp, transform
from vslam.types.map_kernels import fuse_landmarks, link_many


def pose(k: int) -> np.ndarray:
    return se3_exp(np.array([0.05 * k, 0.0, -0.5 * k, 0.0, 0.01 * k, 0.0]))


def world_of(n: int, noise: float = 0.0) -> World:
    world = make_world(250)
    for k in range(n):
        world.add_keyframe(pose(k), noise=noise)
    world.link_truth(range(n))
    return world


def shifted(snapshot, T: np.ndarray, *, inlier=None) -> BundleSolution:
    p = snapshot.problem
    return BundleSolution(
        T_cw=np.array([T_cw @ inverse(T) for T_cw in p.T_cw]),
        points=transform(T, p.points),
        cost=0.0,
        inlier=np.ones(len(p.camera), bool) if inlier is None else inlier,
        iterations=1,
    )


MOTION = se3_exp(np.array([2.0, -0.5, 1.0, 0.05, 0.3, -0.1]))


def test_snapshot_holds_the_first_keyframe_and_copies_everything():
    world = world_of(6)
    world.map.cull_keyframe(3)
    snapshot = take_snapshot(world.map, CAMERA)
    assert snapshot.keyframes.tolist() == [1, 2, 4, 5, 0]
    assert snapshot.problem.n_free == 4
    a = world.map.arrays
    assert len(snapshot.rows) == np.count_nonzero(a.landmark[: world.map.n_rows] >= 0)
    before = snapshot.problem.T_cw.copy(), snapshot.problem.points.copy()
    a.T_cw[:] += 1.0
    a.xyz[:] += 1.0
    np.testing.assert_array_equal(snapshot.problem.T_cw, before[0])
    np.testing.assert_array_equal(snapshot.problem.points, before[1])


def test_each_part_of_the_map_has_a_keyframe_held():
    world = make_world(250)
    for k in range(7):
        world.add_keyframe(pose(k))
    half = np.arange(125)
    world.link_truth([0, 2, 3], chosen=half)
    world.link_truth([1, 4, 5], chosen=half + 125)  # keyframe 6 observes nothing
    landmarks = world.map.living_landmarks().astype(np.int32)
    parts = connected_parts(world.map.arrays, landmarks, 7)
    assert parts.tolist() == [0, 1, 0, 0, 1, 1, 6]
    snapshot = take_snapshot(world.map, CAMERA)
    assert snapshot.keyframes.tolist() == [2, 3, 4, 5, 0, 1, 6]
    assert snapshot.problem.n_free == 4


def test_a_snapshot_knows_gravity_in_the_part_of_the_first_keyframe():
    world = make_world(250)
    for k in range(6):
        world.add_keyframe(pose(k))
    half = np.arange(125)
    world.link_truth([0, 2, 3], chosen=half)
    world.link_truth([1, 4, 5], chosen=half + 125)
    assert take_snapshot(world.map, CAMERA).problem.gravity is None
    table = world.map.keyframes
    table.gravity[[1, 2, 3]] = np.eye(3)
    table.gravity_sigma[[1, 2, 3]] = 0.01
    snapshot = take_snapshot(world.map, CAMERA)
    assert snapshot.keyframes.tolist() == [2, 3, 4, 5, 0, 1]
    assert np.array_equal(snapshot.problem.gravity[:2], np.eye(3)[1:])
    assert (snapshot.problem.gravity_sigma > 0).tolist() == [True, True, *[False] * 4]


def test_adjusting_a_snapshot_repairs_the_map(check_map):
    world = world_of(6)
    a, rng = world.map.arrays, np.random.default_rng(0)
    for k in range(1, 6):
        a.T_cw[k] = se3_exp(0.02 * rng.normal(size=6)) @ a.T_cw[k]
    n = world.map.n_landmarks
    a.xyz[:n] += 0.1 * rng.normal(size=(n, 3))
    snapshot = take_snapshot(world.map, CAMERA)
    apply_solution(world.map, snapshot, adjust_globally(snapshot.problem, iterations=30))
    assert np.abs(a.T_cw[:6] - world.truth).max() < 1e-4  # keypoints are float32
    check_map(world.map)


def test_what_was_made_since_moves_along(check_map):
    """The solution moves the whole world. Newer keyframes and landmarks move with it."""
    world = world_of(4)
    map_ = world.map
    snapshot = take_snapshot(map_, CAMERA)
    for k in (4, 5, 6):
        world.add_keyframe(pose(k))
    map_.parents[5] = 2  # not the previous keyframe
    new = world.link_truth([4, 5, 6])
    new = new[new >= 0]
    assert new.min() >= snapshot.n_landmarks
    xyz = map_.arrays.xyz[: map_.n_landmarks].copy()
    apply_solution(map_, snapshot, shifted(snapshot, MOTION))
    a = map_.arrays
    for k in range(7):
        np.testing.assert_allclose(a.T_cw[k], pose(k) @ inverse(MOTION), atol=1e-12)
    np.testing.assert_allclose(
        a.xyz[: map_.n_landmarks], transform(MOTION, xyz), rtol=1e-9, atol=1e-9
    )
    check_map(map_)


def test_newer_keyframes_keep_their_pose_relative_to_their_parent():
    """The keyframes in the solution move differently. Newer keyframes form a chain."""
    world = world_of(4)
    map_ = world.map
    snapshot = take_snapshot(map_, CAMERA)
    for k in (4, 5):
        world.add_keyframe(pose(k))
    map_.parents[4], map_.parents[5] = 1, 4
    rng = np.random.default_rng(3)
    solution = shifted(snapshot, np.eye(4))
    poses = np.array([se3_exp(0.1 * rng.normal(size=6)) @ T for T in snapshot.problem.T_cw])
    apply_solution(map_, snapshot, BundleSolution(poses, solution.points, 0.0, solution.inlier, 1))
    a = map_.arrays
    index = snapshot.keyframes.tolist()
    for k in range(4):
        np.testing.assert_array_equal(a.T_cw[k], poses[index.index(k)])
    for k, parent in ((4, 1), (5, 4)):
        before, after = pose(k) @ inverse(pose(parent)), a.T_cw[k] @ inverse(a.T_cw[parent])
        np.testing.assert_allclose(after, before, atol=1e-12)


def test_what_was_culled_or_fused_since_is_respected(check_map):
    world = world_of(5)
    map_ = world.map
    a = map_.arrays
    snapshot = take_snapshot(map_, CAMERA)
    map_.cull_keyframe(2)
    relative = map_.keyframe_pose(2) @ inverse(map_.keyframe_pose(1))
    loser, winner = snapshot.landmarks[[3, 40]]
    fuse_landmarks(a, loser, winner)
    apply_solution(map_, snapshot, shifted(snapshot, MOTION))
    assert not a.keyframe_alive[2]
    assert not a.landmark_alive[loser]
    np.testing.assert_allclose(
        a.xyz[winner], transform(MOTION, snapshot.problem.points[[40]])[0], atol=1e-12
    )
    np.testing.assert_allclose(
        map_.keyframe_pose(2) @ inverse(map_.keyframe_pose(1)), relative, atol=1e-12
    )
    check_map(map_)


def test_outliers_go_unless_the_row_observes_something_else_by_now(check_map):
    world = world_of(4)
    map_ = world.map
    a = map_.arrays
    snapshot = take_snapshot(map_, CAMERA)
    observed = np.repeat(snapshot.landmarks, np.diff(snapshot.problem.first))
    many = np.flatnonzero(np.isin(observed, np.flatnonzero(np.bincount(observed) == 4)))
    gone, rewired, freed = many[[0, 9, 18]]
    loser = a.landmark[snapshot.rows[rewired]]
    other = map_.add_landmarks(a.xyz[[loser]], a.landmark_descriptor[[loser]], 0)
    a = map_.arrays
    fuse_landmarks(a, loser, other[0])
    fuse_landmarks(a, observed[freed], other[0])
    assert a.landmark[snapshot.rows[freed]] == -1
    inlier = np.ones(len(observed), bool)
    inlier[[gone, rewired, freed]] = False
    apply_solution(map_, snapshot, shifted(snapshot, MOTION, inlier=inlier))
    assert a.landmark[snapshot.rows[gone]] == -1
    assert a.landmark[snapshot.rows[rewired]] == other[0]
    assert a.landmark[snapshot.rows[freed]] == -1
    kept = np.setdiff1d(np.arange(len(observed)), [gone, rewired, freed])
    unchanged = a.landmark[snapshot.rows[kept]] == observed[kept]
    assert np.count_nonzero(~unchanged) <= 8  # observations of the two landmarks that were fused
    check_map(map_)
    link_many(a, snapshot.rows[[gone]], observed[[gone]])  # the row is free and usable
    check_map(map_)


def test_a_snapshot_links_consecutive_keyframes_by_the_motions_of_the_imu():
    world = world_of(7)
    map_, table = world.map, world.map.keyframes
    assert take_snapshot(map_, CAMERA).problem.links is None
    table.gravity[:7], table.gravity_sigma[:7] = [0.0, 0.8, 0.6], 0.01
    known = np.array([1, 2, 3, 5, 6])
    table.motion_seconds[known] = 0.1 * known
    table.motion_rotation[:7] = np.eye(3)
    table.motion_covariance[:7], table.motion_walk[:7] = np.eye(9), 1.0
    map_.cull_keyframe(2)
    snapshot = take_snapshot(map_, CAMERA)
    links = snapshot.problem.links
    assert snapshot.keyframes[links.first].tolist() == [0, 1, 4, 5]
    assert snapshot.keyframes[links.last].tolist() == [1, 3, 5, 6]
    np.testing.assert_allclose(links.motions.seconds, [0.1, 0.5, 0.5, 0.6])
    map_.cull_keyframe(4)  # the motion before it is unknown
    snapshot = take_snapshot(map_, CAMERA)
    assert snapshot.keyframes[snapshot.problem.links.last].tolist() == [1, 3, 6]
