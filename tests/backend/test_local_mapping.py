"""Local mapping in a synthetic world of random points, each of which has its own descriptor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from stereo_noise import white_noise

from vslam.backend.fusion import fuse_into, fuse_neighbourhood
from vslam.backend.local_mapping import (
    adjust_locally,
    assemble,
    cull_keyframes,
    cull_recent_landmarks,
    extend_map,
    local_window,
    refine_map,
    refresh_keyframe,
    remove_observations,
)
from vslam.backend.triangulation import (
    SECTIONS,
    direction,
    map_stereo_points,
    perpendicular,
    sorted_about_epipole,
    triangulate_pair,
    triangulate_with_neighbours,
)
from vslam.config import Config, MappingConfig, StereoConfig
from vslam.types.camera import Camera
from vslam.types.context import Context
from vslam.types.features import Features
from vslam.types.geometry import inverse, se3_exp, se3_log, transform
from vslam.types.map import Map
from vslam.types.map_kernels import link_many

CAMERA = Camera(320.0, 320.0, 319.5, 119.5, 0.5, 640, 240)
CONFIG = Config()
CONTEXT = Context.create(CAMERA, CONFIG)
SCALES = 1.2 ** np.arange(8)
FLIPPED_BITS = 8


@dataclass
class World:
    """Random points, a map of what cameras see of them, and the true values.

    ``point_of_row`` is the point that each row of the map's observations shows. ``truth`` contains
    the true ``T_cw``.
    """

    points: np.ndarray
    descriptors: np.ndarray
    size: np.ndarray  # distance at which a point is seen on octave 0
    map: Map
    truth: list[np.ndarray]
    point_of_row: np.ndarray
    rng: np.random.Generator

    def add_keyframe(
        self, T_cw: np.ndarray, *, mono: bool = False, noise: float = 0.0, among=None
    ) -> int:
        """Add a keyframe that sees every point, or only those in ``among``, in random order."""
        in_camera = transform(T_cw, self.points)
        uvr = CAMERA.project(np.where(in_camera[:, 2:] > 0.5, in_camera, 1.0))
        uvr += noise * white_noise(self.rng, np.full(len(uvr), not mono))
        seen = in_camera[:, 2] > 0.5
        seen &= (uvr[:, :2] >= 0).all(axis=1) & (uvr[:, :2] < [CAMERA.width, CAMERA.height]).all(
            axis=1
        )
        if among is not None:
            seen &= np.isin(np.arange(len(self.points)), among)
        index = self.rng.permutation(np.flatnonzero(seen))
        distance = np.linalg.norm(in_camera[index], axis=1)
        octave = np.clip(np.rint(np.log(self.size[index] / distance) / np.log(1.2)), 0, 7)
        bits = np.unpackbits(self.descriptors[index], axis=1)
        for row in bits:
            row[self.rng.choice(256, self.rng.integers(0, FLIPPED_BITS + 1), replace=False)] ^= 1
        u_right = uvr[index, 2].astype(np.float32)
        if mono:
            u_right[:] = np.nan
        features = Features(
            xy=uvr[index, :2].astype(np.float32),
            octave=octave.astype(np.uint8),
            angle=np.zeros(len(index), np.float32),
            descriptors=np.packbits(bits, axis=1),
            u_right=u_right,
        )
        k = self.map.add_keyframe(features, T_cw, 0.1 * len(self.truth), len(self.truth))
        self.map.parents[k] = k - 1 if k else -1
        self.truth.append(T_cw.copy())
        self.point_of_row = np.concatenate([self.point_of_row, index])
        return k

    def link_truth(self, keyframes, chosen=None) -> np.ndarray:
        """Create one landmark for each point (or those in ``chosen``) that the keyframes see.

        Returns the ids by point.
        """
        a = self.map.arrays
        landmark_of = np.full(len(self.points), -1, np.int64)
        for k in keyframes:
            rows = np.arange(self.map.rows(k).start, self.map.rows(k).stop)
            shown = self.point_of_row[rows]
            wanted = np.ones(len(rows), bool) if chosen is None else np.isin(shown, chosen)
            new = wanted & (landmark_of[shown] < 0)
            landmark_of[shown[new]] = self.map.add_landmarks(
                self.points[shown[new]], a.descriptor[rows[new]], k
            )
            a = self.map.arrays
            link_many(a, rows[wanted], landmark_of[shown[wanted]])
        for k in keyframes:
            refresh_keyframe(self.map, k)
        return landmark_of

    def point_of_landmark(self, landmark: int) -> set[int]:
        """Return the points that a landmark observes. A correct landmark observes one point."""
        rows = np.flatnonzero(self.map.arrays.landmark[: self.map.n_rows] == landmark)
        return set(self.point_of_row[rows].tolist())


def make_world(n: int = 400, seed: int = 0, depth: tuple[float, float] = (6, 40)) -> World:
    rng = np.random.default_rng(seed)
    z = rng.uniform(*depth, n)
    x = rng.uniform(-0.95, 0.95, n) * z
    y = rng.uniform(-0.35, 0.35, n) * z
    return World(
        points=np.stack([x, y, z], axis=1),
        descriptors=rng.integers(0, 256, (n, 32), dtype=np.uint8),
        size=z * 1.2 ** rng.uniform(1, 5, n),
        map=Map(SCALES),
        truth=[],
        point_of_row=np.empty(0, np.int64),
        rng=rng,
    )


def sideways(metres: float, yaw: float = 0.0, forward: float = 0.0) -> np.ndarray:
    """Return ``T_cw`` of a camera that is to the right of the world's origin."""
    return inverse(se3_exp(np.array([metres, 0.0, forward, 0.0, yaw, 0.0])))


def pose_error(map_: Map, world: World, k: int) -> float:
    return float(np.abs(se3_log(map_.arrays.T_cw[k] @ inverse(world.truth[k]))).max())


# -- new landmarks from stereo --------------------------------------------------------------------


def test_stereo_points_are_mapped_where_they_are(check_map):
    world = make_world()
    k = world.add_keyframe(sideways(1.5, yaw=0.1))
    ids = map_stereo_points(world.map, k, CONTEXT)
    a = world.map.arrays
    rows = np.arange(world.map.n_rows)
    depth = transform(world.truth[0], world.points)[world.point_of_row, 2]
    close = depth < 40 * CAMERA.baseline
    assert np.count_nonzero(close) > 100
    np.testing.assert_array_equal(a.landmark[rows] >= 0, close)
    assert len(ids) == np.count_nonzero(close)
    truth = world.points[world.point_of_row[close]]
    assert np.abs(a.xyz[a.landmark[rows[close]]] - truth).max() < 2e-3
    np.testing.assert_array_equal(
        a.landmark_descriptor[a.landmark[rows[close]]], a.descriptor[rows[close]]
    )
    check_map(world.map)


@pytest.mark.parametrize("least", [100, 60])
def test_the_nearest_are_mapped_if_too_few_are_close(check_map, least):
    world = make_world()
    k = world.add_keyframe(np.eye(4))
    depth = world.points[world.point_of_row, 2]
    close = StereoConfig(close_depth_baselines=2 * np.sort(depth)[30])
    config = Config(stereo=close, mapping=MappingConfig(min_stereo_points=least))
    map_stereo_points(world.map, k, Context.create(CAMERA, config))
    mapped = world.map.arrays.landmark[: world.map.n_rows] >= 0
    assert np.count_nonzero(mapped) == least
    assert depth[mapped].max() < depth[~mapped].min()
    check_map(world.map)


def test_features_with_a_landmark_or_without_stereo_are_not_mapped_again():
    world = make_world()
    k = world.add_keyframe(np.eye(4))
    a = world.map.arrays
    a.u_right[:50] = np.nan
    first = map_stereo_points(world.map, k, CONTEXT)
    assert len(first) > 100
    assert (world.map.arrays.landmark[:50] == -1).all()
    assert len(map_stereo_points(world.map, k, CONTEXT)) == 0


# -- triangulation --------------------------------------------------------------------------------


def triangulate(world: World, k1: int, k2: int):
    return triangulate_pair(
        world.map.arrays,
        k1,
        k2,
        CAMERA.intrinsics,
        SCALES,
        CAMERA.baseline,
        CONFIG.mapping.epipolar_distance,
        0.9998,
    )


def seen_twice(world: World) -> int:
    rows = world.map.rows(1).start
    return len(np.intersect1d(world.point_of_row[:rows], world.point_of_row[rows:]))


@pytest.mark.parametrize("mono", [True, False], ids=["mono", "stereo"])
@pytest.mark.parametrize(
    "T_2", [sideways(1.5), sideways(1.0, yaw=0.15, forward=0.5)], ids=["sideways", "turning"]
)
def test_triangulation_finds_the_right_pairs_and_positions(mono, T_2):
    world = make_world()
    world.add_keyframe(np.eye(4), mono=mono)
    world.add_keyframe(T_2, mono=mono)
    xyz, rows_1, rows_2 = triangulate(world, 0, 1)
    assert len(xyz) > 0.8 * seen_twice(world) > 150
    points = world.point_of_row[rows_1]
    np.testing.assert_array_equal(points, world.point_of_row[rows_2])
    assert len(np.unique(rows_1)) == len(np.unique(rows_2)) == len(xyz)
    error = np.linalg.norm(xyz - world.points[points], axis=1) / world.points[points, 2]
    assert error.max() < 1e-3


@pytest.mark.parametrize(
    "t",
    [[0.0, 0.0, 1.0], [0.1, -0.05, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.8, 0.1, -0.5]],
    ids=["ahead", "ahead and aside", "to the right", "up", "back"],
)
def test_features_near_an_epipolar_line_are_in_its_section(t):
    rng = np.random.default_rng(0)
    t, n = np.array(t), 1000
    x = rng.uniform(0, CAMERA.width, n).astype(np.float32)
    y = rng.uniform(0, CAMERA.height, n).astype(np.float32)
    x[:2], y[:2] = CAMERA.cx, CAMERA.cy  # the epipole of "ahead"
    gate = (3.84 * SCALES[rng.integers(0, 8, n)] ** 2).astype(np.float32)
    across = perpendicular(t)
    np.testing.assert_allclose(across @ t, 0.0, atol=1e-12)
    np.testing.assert_allclose(across @ across.T, np.eye(2), atol=1e-12)
    start, items = sorted_about_epipole(x, y, gate, CAMERA.intrinsics, across)
    assert len(items) < 20 * n  # of 512 bins, most features are in few
    pixels = np.column_stack([x, y, np.ones(n)])
    for d in np.column_stack([rng.uniform(-1, 1, (300, 2)), np.ones(300)]):
        normal = np.cross(t, d) / [CAMERA.fx, CAMERA.fy, 1.0]
        normal[2] -= normal[0] * CAMERA.cx + normal[1] * CAMERA.cy
        off = pixels @ normal / np.hypot(normal[0], normal[1])
        section = int(direction(*(across @ d)) * SECTIONS / 2) % SECTIONS
        found = items[start[section] : start[section + 1]]
        assert (np.diff(found) > 0).all()
        assert set(np.flatnonzero(off**2 < gate)) <= set(found.tolist())


def test_triangulation_along_the_axis_spares_the_epipole():
    world = make_world()
    world.points[0] = [0.0, 0.0, 20.0]  # straight ahead of the camera
    world.add_keyframe(inverse(sideways(0, forward=0.0)), mono=True)
    world.add_keyframe(sideways(0, forward=2.0), mono=True)
    xyz, rows_1, rows_2 = triangulate(world, 0, 1)
    points = world.point_of_row[rows_1]
    assert len(xyz) > 80
    np.testing.assert_array_equal(points, world.point_of_row[rows_2])
    assert 0 not in points
    error = np.linalg.norm(xyz - world.points[points], axis=1) / world.points[points, 2]
    assert error.max() < 1e-2


def test_triangulation_with_a_wrong_pose_finds_nothing():
    world = make_world()
    world.add_keyframe(np.eye(4), mono=True)
    world.add_keyframe(sideways(1.5), mono=True)
    assert len(triangulate(world, 0, 1)[0]) > 150
    nod = se3_exp(np.array([0, 0, 0, 0.15, 0, 0]))  # 48 px
    world.map.arrays.T_cw[1] = nod @ world.truth[1]
    assert len(triangulate(world, 0, 1)[0]) <= 1
    world.map.arrays.T_cw[1] = inverse(world.truth[1])  # points would lie behind the cameras
    assert len(triangulate(world, 0, 1)[0]) == 0


def test_triangulation_needs_a_baseline_and_parallax():
    world = make_world(depth=(60, 100))
    world.add_keyframe(np.eye(4), mono=True)
    world.add_keyframe(sideways(0.49), mono=True)
    assert len(triangulate(world, 0, 1)[0]) == 0
    # The baseline is long enough, but the parallax is half a degree.
    world.map.arrays.T_cw[1] = sideways(0.51)
    assert len(triangulate(world, 0, 1)[0]) == 0


def test_triangulation_refuses_octaves_that_contradict_the_distances():
    world = make_world()
    world.add_keyframe(np.eye(4), mono=True)
    world.add_keyframe(sideways(1.5), mono=True)
    octave, rows = world.map.arrays.octave, world.map.rows(1)
    octave[: rows.stop] = 3
    assert len(triangulate(world, 0, 1)[0]) > 150
    octave[rows] = 7
    assert len(triangulate(world, 0, 1)[0]) == 0
    octave[: rows.start], octave[rows] = 7, 3
    assert len(triangulate(world, 0, 1)[0]) == 0


def test_triangulation_with_neighbours_adds_landmarks_of_both_keyframes(check_map):
    world = make_world()
    for k in range(3):
        world.add_keyframe(sideways(0.8 * k), mono=True)
    shared = np.arange(60)
    world.link_truth(range(3), shared)
    before = world.map.n_landmarks
    triangulate_with_neighbours(world.map, 2, CONTEXT)
    created = np.arange(before, world.map.n_landmarks)
    assert len(created) > 150
    a = world.map.arrays
    assert (a.n_observations[created] == 2).all()
    for landmark in created[::10]:
        (point,) = world.point_of_landmark(landmark)
        assert point not in shared
        assert np.linalg.norm(a.xyz[landmark] - world.points[point]) < 0.05
    check_map(world.map)


# -- fusion ---------------------------------------------------------------------------------------


def two_keyframes_with_landmarks_of_their_own() -> World:
    world = make_world(depth=(6, 19))
    for k in range(2):
        world.add_keyframe(sideways(0.5 * k, yaw=0.05 * k))
        map_stereo_points(world.map, k, CONTEXT)
        refresh_keyframe(world.map, k)
    return world


def test_the_landmarks_that_two_keyframes_hold_of_a_point_are_fused(check_map):
    world = two_keyframes_with_landmarks_of_their_own()
    before, both = len(world.map.living_landmarks()), seen_twice(world)
    fused = fuse_into(world.map, world.map.landmarks_of(0), 1, CONTEXT)
    assert both > 200
    assert 0.97 * both < fused <= both
    assert len(world.map.living_landmarks()) == before - fused
    for landmark in world.map.living_landmarks():
        assert len(world.point_of_landmark(landmark)) == 1
    check_map(world.map)
    assert fuse_into(world.map, world.map.landmarks_of(0), 1, CONTEXT) == 0


def test_fusion_links_features_that_have_no_landmark(check_map):
    world = make_world(depth=(6, 19))
    for k in range(2):
        world.add_keyframe(sideways(0.5 * k))
    map_stereo_points(world.map, 0, CONTEXT)
    refresh_keyframe(world.map, 0)
    fused = fuse_into(world.map, world.map.landmarks_of(0), 1, CONTEXT)
    linked = world.map.landmarks_of(1)
    assert len(linked) == fused > 0.97 * seen_twice(world)
    assert all(len(world.point_of_landmark(x)) == 1 for x in linked)
    assert (world.map.arrays.n_observations[linked] == 4).all()
    check_map(world.map)


def test_fusion_keeps_the_landmark_with_more_observations():
    world = two_keyframes_with_landmarks_of_their_own()
    a = world.map.arrays
    rows = {int(p): i for i, p in enumerate(world.point_of_row[: world.map.rows(1).start])}
    second = {int(p): i + len(rows) for i, p in enumerate(world.point_of_row[len(rows) :])}
    point = next(p for p in rows if p in second)
    few, many = a.landmark[rows[point]], a.landmark[second[point]]
    third = world.add_keyframe(world.truth[1], among=[point])
    a = world.map.arrays
    link_many(a, np.array([world.map.rows(third).start]), np.array([many]))
    fuse_into(world.map, world.map.landmarks_of(0), 1, CONTEXT)
    assert (a.landmark_alive[few], a.landmark_alive[many]) == (False, True)
    assert a.fused_into[few] == many


@pytest.mark.parametrize(
    "spoil", ["descriptor", "position", "direction", "distance range"], ids=lambda name: name
)
def test_fusion_leaves_strangers_alone(spoil):
    world = two_keyframes_with_landmarks_of_their_own()
    a, ids = world.map.arrays, world.map.landmarks_of(0)
    if spoil == "descriptor":
        a.landmark_descriptor[ids] ^= np.uint64(0xAAAA_AAAA_AAAA_AAAA)  # 128 bits
    elif spoil == "position":
        a.xyz[ids, 1] += 0.05 * a.xyz[ids, 2]  # 16 px
    elif spoil == "direction":
        a.normal[ids] *= -1
    else:
        a.distance_range[ids] *= 4
    assert fuse_into(world.map, ids, 1, CONTEXT) <= 0.01 * len(ids)


def test_fusion_of_a_neighbourhood_goes_both_ways(check_map):
    world = make_world(depth=(6, 19))
    for k in range(3):
        world.add_keyframe(sideways(0.4 * k))
    world.link_truth(range(3), np.arange(50))
    for k in range(3):
        map_stereo_points(world.map, k, CONTEXT)
        refresh_keyframe(world.map, k)
    fuse_neighbourhood(world.map, 1, CONTEXT)
    check_map(world.map)
    a = world.map.arrays
    holders: dict[int, set[int]] = {}
    for row in range(world.map.rows(1).start, world.map.rows(1).stop):
        holders.setdefault(int(world.point_of_row[row]), set()).add(int(a.landmark[row]))
    in_both = doubled = 0
    for row in range(world.map.rows(1).start):
        point = int(world.point_of_row[row])
        if point in holders:
            in_both += 1
            doubled += int(a.landmark[row]) not in holders[point]
    assert in_both > 200
    assert doubled < 0.03 * in_both


# -- culling of landmarks -------------------------------------------------------------------------


def test_landmarks_on_probation_are_culled_by_the_letter():
    rng = np.random.default_rng(0)
    world = make_world()
    for k in range(8):
        world.add_keyframe(sideways(0.1 * k), mono=True)
    map_ = world.map
    # (first keyframe, keyframes that see it, visible, found) and whether it survives keyframe 6.
    cases = [
        ((6, 2, 100, 25), True),  # found in a quarter of the frames
        ((6, 2, 101, 25), False),
        ((6, 1, 1, 1), True),  # new
        ((5, 2, 1, 1), True),  # one keyframe old
        ((4, 3, 1, 1), False),  # two keyframes old and three observations
        ((4, 4, 1, 1), True),
        ((3, 4, 100, 10), False),
        ((2, 2, 100, 1), True),  # past its probation
    ]
    order = sorted(range(len(cases)), key=lambda i: cases[i][0][0])
    survivors = []
    for i in order:
        (first, observers, visible, found), survives = cases[i]
        (landmark,) = map_.add_landmarks(
            rng.normal(size=(1, 3)), np.zeros((1, 4), np.uint64), first
        )
        rows = [map_.rows(k).start + i for k in range(observers)]
        link_many(map_.arrays, np.array(rows), np.full(observers, landmark))
        map_.arrays.visible[landmark], map_.arrays.found[landmark] = visible, found
        survivors += [landmark] if survives else []
    cull_recent_landmarks(map_, 6, CAMERA)
    assert map_.living_landmarks().tolist() == survivors


# -- local bundle adjustment ----------------------------------------------------------------------


def disturbed(noise: float = 0.0) -> World:
    world = make_world(depth=(6, 25))
    for k in range(6):
        world.add_keyframe(sideways(0.3 * k, yaw=0.02 * k, forward=0.2 * k), noise=noise)
    world.link_truth(range(6))
    a = world.map.arrays
    a.xyz[: world.map.n_landmarks] += world.rng.normal(0, 0.03, (world.map.n_landmarks, 3))
    for k in (3, 4, 5):
        twist = world.rng.normal(size=6) * [0.05, 0.05, 0.05, 0.006, 0.006, 0.006]
        a.T_cw[k] = se3_exp(twist) @ a.T_cw[k]
    return world


def test_local_adjustment_repairs_disturbed_keyframes(check_map):
    world = disturbed()
    before = [pose_error(world.map, world, k) for k in range(6)]
    first = world.map.arrays.T_cw[0].tobytes()
    adjust_locally(world.map, 5, CONTEXT)
    after = [pose_error(world.map, world, k) for k in range(6)]
    assert min(before[3:]) > 0.03
    assert max(after) < 1e-3
    assert world.map.arrays.T_cw[0].tobytes() == first
    a = world.map.arrays
    points = [next(iter(world.point_of_landmark(i))) for i in range(0, 300, 7)]
    error = np.linalg.norm(a.xyz[:300:7] - world.points[points], axis=1)
    assert np.median(error) < 0.003
    check_map(world.map)


def test_local_adjustment_with_noise_reduces_the_error_tenfold():
    world = disturbed(noise=0.3)
    before = max(pose_error(world.map, world, k) for k in range(6))
    adjust_locally(world.map, 5, CONTEXT)
    assert max(pose_error(world.map, world, k) for k in range(6)) < 0.1 * before


def test_local_adjustment_removes_wrong_observations_and_only_those(check_map):
    world = disturbed()
    a = world.map.arrays
    observed = np.flatnonzero(a.landmark[: world.map.n_rows] >= 0)
    views = np.bincount(a.landmark[observed], minlength=world.map.n_landmarks)
    often = observed[views[a.landmark[observed]] >= 5]
    _, one_of_each = np.unique(a.landmark[often], return_index=True)
    wrong = often[one_of_each[::8]]
    assert len(wrong) > 20
    a.xy[wrong, 1] += 40.0
    adjust_locally(world.map, 5, CONTEXT)
    free = np.flatnonzero(a.landmark[: world.map.n_rows] < 0)
    assert set(wrong.tolist()) <= set(free.tolist())
    assert len(np.setdiff1d(np.intersect1d(observed, free), wrong)) < 0.01 * len(observed)
    assert max(pose_error(world.map, world, k) for k in range(6)) < 2e-3
    check_map(world.map)


def test_keyframes_outside_the_window_are_held():
    world = make_world(n=700, depth=(6, 25))
    for k in range(8):
        world.add_keyframe(sideways(0.1 * k))
    # Keyframes 0..3 share points, and so do 3..7. Keyframes 0..2 share only ten with 4..7.
    left, right, bridge = np.arange(300), np.arange(300, 690), np.arange(690, 700)
    landmarks = world.link_truth(range(4), left)
    assert (landmarks >= 0).any()
    world.link_truth(range(3, 8), right)
    world.link_truth([0, 1, 2, 4, 5, 6, 7], bridge)
    free, fixed, seen = local_window(world.map, 6, CONFIG)
    assert free.tolist() == [3, 4, 5, 6, 7]
    assert fixed.tolist() == [0, 1, 2]
    problem, rows = assemble(world.map, free, fixed, seen, CAMERA)
    assert problem.n_free == 5
    np.testing.assert_array_equal(np.diff(problem.first) > 0, True)
    a = world.map.arrays
    owner = np.repeat(seen, np.diff(problem.first))
    np.testing.assert_array_equal(a.landmark[rows], owner)
    np.testing.assert_array_equal(np.concatenate([free, fixed])[problem.camera], a.keyframe[rows])
    before = a.T_cw[:3].tobytes()
    a.T_cw[6] = se3_exp(np.array([0.03, 0, 0.02, 0, 0.004, 0])) @ a.T_cw[6]
    adjust_locally(world.map, 6, CONTEXT)
    assert a.T_cw[:3].tobytes() == before
    assert pose_error(world.map, world, 6) < 1e-3


def test_the_window_is_capped_at_the_most_covisible_keyframes():
    world = make_world()
    for k in range(6):
        world.add_keyframe(sideways(0.1 * k))
    world.link_truth(range(6))
    config = Config(mapping=MappingConfig(max_ba_keyframes=3))
    neighbours, _ = world.map.covisible(5)
    free, fixed, _ = local_window(world.map, 5, config)
    window = {5, *neighbours[:2].tolist()}
    assert set(free.tolist()) == window - {0}
    assert set(fixed.tolist()) == set(range(6)) - set(free.tolist())


# -- culling of keyframes -------------------------------------------------------------------------


def redundant_world(own: int = 30) -> World:
    """Make a world in which six keyframes share 100 points.

    Each keyframe except keyframe 2 also sees ``own`` points that no other keyframe sees.
    """
    world = make_world(n=100 + 6 * own, depth=(8, 16))
    world.points[:, 0] *= 0.5
    for k in range(6):
        mine = [] if k == 2 else np.arange(100 + own * k, 100 + own * (k + 1))
        world.add_keyframe(sideways(0.1 * k), among=np.concatenate([np.arange(100), mine]))
    world.link_truth(range(6))
    return world


def test_the_redundant_keyframe_is_culled_and_no_other(check_map):
    world = redundant_world()
    assert world.map.rows(2).stop - world.map.rows(2).start > 80
    cull_keyframes(world.map, 5, CONTEXT)
    assert world.map.living_keyframes().tolist() == [0, 1, 3, 4, 5]
    assert world.map.parents[3] == 1
    assert len(world.map.landmarks_of(2)) == 0
    np.testing.assert_allclose(world.map.keyframe_pose(2), world.truth[2], rtol=0, atol=1e-12)
    check_map(world.map)


def test_two_observers_besides_are_not_enough():
    world = redundant_world()
    for k in (0, 1, 3):
        rows = np.arange(world.map.rows(k).start, world.map.rows(k).stop)
        shared = rows[world.point_of_row[rows] < 100]
        remove_observations(world.map.arrays, shared)
    cull_keyframes(world.map, 5, CONTEXT)
    assert world.map.living_keyframes().tolist() == list(range(6))


def test_observers_at_a_coarser_scale_do_not_make_a_keyframe_redundant():
    world = redundant_world()
    a = world.map.arrays
    a.octave[world.map.rows(2)] = 0
    for k in (0, 1, 3, 4, 5):
        a.octave[world.map.rows(k)] = 1
    a.octave[world.map.rows(0)] = a.octave[world.map.rows(1)] = a.octave[world.map.rows(3)] = 2
    cull_keyframes(world.map, 5, CONTEXT)
    assert 2 in world.map.living_keyframes()
    a.octave[world.map.rows(3)] = 1  # keyframes 3, 4 and 5 are at most one level coarser
    cull_keyframes(world.map, 5, CONTEXT)
    assert 2 not in world.map.living_keyframes()


def test_the_first_keyframe_is_never_culled():
    world = redundant_world(own=0)  # each is redundant if three others remain
    cull_keyframes(world.map, 5, CONTEXT)
    living = world.map.living_keyframes().tolist()
    assert len(living) == 3
    assert (living[0], living[-1]) == (0, 5)


# -- all steps together ---------------------------------------------------------------------------


def test_mapping_a_keyframe_keeps_the_map_sound_and_true(check_map):
    world = make_world(n=600)
    for k in range(6):
        world.add_keyframe(sideways(0.4 * k, yaw=0.02 * k, forward=0.3 * k), noise=0.2)
        map_stereo_points(world.map, k, CONTEXT)
        refresh_keyframe(world.map, k)
        if k:
            tracked = world.map.landmarks_of(k - 1)
            fuse_into(world.map, tracked, k, CONTEXT)
            extend_map(world.map, k, CONTEXT)
            refine_map(world.map, k, CONTEXT)
        check_map(world.map)
    a = world.map.arrays
    mixed = [i for i in world.map.living_landmarks() if len(world.point_of_landmark(i)) > 1]
    assert len(world.map.living_landmarks()) > 200
    assert len(mixed) == 0
    assert max(pose_error(world.map, world, int(k)) for k in world.map.living_keyframes()) < 0.02
    points = [next(iter(world.point_of_landmark(i))) for i in world.map.living_landmarks()]
    error = np.linalg.norm(a.xyz[world.map.living_landmarks()] - world.points[points], axis=1)
    assert np.median(error / world.points[points, 2]) < 0.01
