"""A lost frame of a simulated street is relocalised, or is not found."""

from __future__ import annotations

import numpy as np
import pytest
from parts import frame_of
from test_local_mapping import CAMERA, World, make_world
from test_verification import forward, in_strip, link_pass

from vslam.config import Config, RelocalizationConfig
from vslam.frontend.relocaliser import relocalised
from vslam.types.context import Context
from vslam.types.features import Extracted, Features
from vslam.types.geometry import inverse, se3_log
from vslam.types.map_view import NO_LANDMARKS, local_map
from vslam.types.track import Track

CONTEXT = Context.create(CAMERA, Config())
KEYFRAMES = 4


def mapped_street() -> World:
    world = make_world(700)
    for i in range(KEYFRAMES):
        world.add_keyframe(forward(0.8 * i), noise=0.4)
    link_pass(world, range(KEYFRAMES))
    return world


def lost_frame(world: World, T_cw: np.ndarray, *, mono: bool = False, among=None) -> Track:
    """Return what a camera sees of the street, where only the points in ``among`` look the same."""
    if among is not None:
        changed = ~np.isin(np.arange(len(world.points)), among)
        world.descriptors[changed] = world.rng.integers(
            0, 256, (np.count_nonzero(changed), 32), dtype=np.uint8
        )
    k = world.add_keyframe(T_cw, noise=0.4, mono=mono)
    a, rows = world.map.arrays, world.map.rows(k)
    features = Features(
        a.xy[rows].copy(),
        a.octave[rows].copy(),
        a.angle[rows].copy(),
        a.descriptor[rows].copy().view(np.uint8),
        a.u_right[rows].copy(),
    )
    return frame_of(features)


def find(world: World, frame: Track, seed: int = 0, context: Context = CONTEXT) -> Track | None:
    place, surroundings = local_map(world.map, 1, 1), local_map(world.map, 1, 80)
    return relocalised(frame, place, surroundings, context, seed=seed)


@pytest.mark.parametrize("mono", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_a_lost_frame_is_found(mono, seed):
    world = mapped_street()
    T_cw = forward(1.7, 0.6 - 0.5 * seed, 0.1 * seed)
    frame = find(world, lost_frame(world, T_cw, mono=mono), seed)
    assert frame.n_inliers == len(frame.tracked) >= 50
    twist = se3_log(frame.T_cw @ inverse(T_cw))
    assert np.linalg.norm(twist[:3]) < 0.03
    assert np.degrees(np.linalg.norm(twist[3:])) < 0.1
    tracked = np.flatnonzero(frame.landmark >= 0)
    a = world.map.arrays
    np.testing.assert_array_equal(frame.xyz[tracked], a.xyz[frame.landmark[tracked]])
    assert np.isnan(frame.xyz[frame.landmark < 0]).all()
    shown = world.point_of_row[a.first_row[KEYFRAMES] + tracked]
    meant = world.point_of_row[a.head[frame.landmark[tracked]]]
    assert np.mean(shown == meant) > 0.99


def test_a_frame_is_found_among_things_that_have_changed():
    world = mapped_street()
    frame = lost_frame(world, T_cw := forward(1.2, 0.3), among=np.arange(0, 700, 4))
    found = find(world, frame)
    assert found.n_inliers >= 50
    assert np.abs(se3_log(found.T_cw @ inverse(T_cw))).max() < 0.03


def test_the_same_seed_gives_the_same_pose():
    poses = []
    for _ in range(2):
        frame = lost_frame(world := mapped_street(), forward(1.2, 0.3))
        poses.append(find(world, frame, seed=3).T_cw.tobytes())
    assert poses[0] == poses[1]


@pytest.mark.parametrize("case", ["elsewhere", "too few", "no features", "no landmarks"])
def test_a_frame_is_not_found(case):
    world = mapped_street()
    among = {"elsewhere": [], "too few": in_strip(world, 250, 290)}.get(case)
    frame = lost_frame(world, forward(1.2, 0.3), among=among)
    if case == "no features":
        frame = frame_of(Extracted.nothing())
    if case == "no landmarks":
        nothing = NO_LANDMARKS
        assert relocalised(frame, nothing, nothing, CONTEXT, seed=0) is None
    else:
        assert find(world, frame) is None


def test_one_object_that_looks_the_same_brings_inliers_but_is_no_place():
    world = mapped_street()
    frame = lost_frame(world, forward(1.2, 0.3), among=in_strip(world, 200, 390))
    assert find(world, frame) is None
    config = Config(relocalization=RelocalizationConfig(min_elsewhere=0))
    assert find(world, frame, context=Context.create(CAMERA, config)).n_inliers >= 50
