"""Revisits and correct loops on paths with known geometry."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vslam.evaluation.loops import judge_loops, metres_per_unit, revisits
from vslam.types.loops import LoopEdge

Poses = NDArray[np.float64]
STEP_M, FRAME_S = 1.0, 0.1
NO_EDGES: list[LoopEdge] = []


def along(*corners: tuple[float, float], step: float = STEP_M) -> Poses:
    """Return ``T_wc`` of a car that passes the corners (x, z) and looks ahead.

    There is a pose every ``step`` metres and one at each corner. A corner has the heading of the
    path that leads to it.
    """
    poses = []
    for (x0, z0), (x1, z1) in pairwise(corners):
        length = np.hypot(x1 - x0, z1 - z0)
        heading = np.arctan2(x1 - x0, z1 - z0)
        for share in np.arange(0.0, length, step) / length:
            poses.append(pose(x0 + share * (x1 - x0), z0 + share * (z1 - z0), heading))
    poses.append(pose(x1, z1, heading))
    return np.array(poses)


def pose(x: float, z: float, heading: float, y: float = 0.0) -> Poses:
    T_wc = np.eye(4)
    T_wc[:3, :3] = Rotation.from_rotvec([0.0, heading, 0.0]).as_matrix()
    T_wc[:3, 3] = x, y, z
    return T_wc


def laps(count: float, radius: float = 40.0, step: float = STEP_M) -> Poses:
    """Return the poses of circles to the right."""
    angles = np.arange(0.0, 2.0 * np.pi * count, step / radius)
    return np.array([pose(radius * (1 - np.cos(a)), radius * np.sin(a), a) for a in angles])


def block(*, offset: float = 0.0, overlap: float = 60.0) -> Poses:
    """Circle a block of 100 m once, then pass ``overlap`` metres of the first side again.

    The second time, the car is in a lane ``offset`` metres to the right.
    """
    corners = [(0, 0), (0, 100), (100, 100), (100, -20), (offset, -20)]
    return along(*corners, (offset, overlap))


def times(T_wc: Poses) -> NDArray[np.float64]:
    return FRAME_S * np.arange(len(T_wc))


def true_edge(T_wc: Poses, query: int, match: int) -> LoopEdge:
    T_query_match = np.linalg.inv(T_wc[query]) @ T_wc[match]
    return LoopEdge(query, match, 0.5, True, "closed", 60, 40, T_query_match)


def moved(edge: LoopEdge, *, metres: float = 0.0, degrees: float = 0.0) -> LoopEdge:
    error = np.eye(4)
    error[:3, :3] = Rotation.from_rotvec([0.0, np.radians(degrees), 0.0]).as_matrix()
    error[0, 3] = metres
    assert edge.T_query_match is not None
    return replace(edge, T_query_match=error @ edge.T_query_match)


def test_second_lap_is_one_revisit_of_the_first():
    T_wc, lap = laps(2.0), 2.0 * np.pi * 40.0
    found = revisits(T_wc, times(T_wc))
    assert len(found) == 1
    # The revisit begins 5 m (the lateral limit) before the start of the first lap.
    assert found.first[0] == pytest.approx(lap - 5.0, abs=1.5)
    assert found.last[0] == len(T_wc) - 1
    assert found.length_m[0] == pytest.approx(lap + 5.0, abs=2.0)
    assert found.first_match[0] == 0
    assert found.last_match[0] == pytest.approx(lap, abs=1.5)


def ramp() -> Poses:
    T_wc = block()
    T_wc[:, 1, 3] = -np.linspace(0.0, 20.0, len(T_wc))
    return T_wc


@pytest.mark.parametrize(
    ("T_wc", "expected"),
    [
        pytest.param(laps(0.97), 0, id="less than a lap"),
        *(pytest.param(block(offset=x), 1, id=f"lane {x} m beside") for x in (0.0, 3.5, 4.9)),
        *(pytest.param(block(offset=x), 0, id=f"lane {x} m beside") for x in (5.1, 8.0)),
        # The revisit is 5 m longer than the overlap.
        pytest.param(block(overlap=12.0), 0, id="short"),
        pytest.param(block(overlap=18.0), 1, id="long enough"),
        pytest.param(ramp(), 0, id="height counts as distance"),
        pytest.param(along((0, 0), (0, 150), (4, 150), (4, 0)), 0, id="way back"),
        pytest.param(along((0, 0), (0, 100), (80, 100), (80, 50), (-80, 50)), 0, id="crossing"),
    ],
)
def test_what_counts_as_a_revisit(T_wc, expected):
    assert len(revisits(T_wc, times(T_wc))) == expected


@pytest.mark.parametrize("every", [1, 2, 7])
def test_sparse_frames_find_the_same_stretch(every):
    T_wc = block(offset=4.0)[::every]
    found = revisits(T_wc, every * FRAME_S * np.arange(len(T_wc)))
    assert len(found) == 1
    assert found.length_m[0] == pytest.approx(63.0, abs=2.0 * every)


def test_acute_crossing_is_as_long_as_the_lanes_are_near():
    # At 15 degrees, the paths are within 5 m of each other for 10 / sin 15 = 38.6 m.
    turn = np.radians(15.0)
    ahead = np.array([np.sin(turn), np.cos(turn)])
    start, end = np.array([0.0, 60.0]) - 60.0 * ahead, np.array([0.0, 60.0]) + 60.0 * ahead
    T_wc = along((0, 0), (0, 120), (150, 120), (150, -60), tuple(start), tuple(end))
    assert revisits(T_wc, times(T_wc)).length_m == pytest.approx([10.0 / np.sin(turn)], abs=2.5)


@pytest.mark.parametrize(("interruption", "expected"), [(8, 1), (12, 2)])
def test_short_interruption_does_not_split(interruption, expected):
    """The camera looks in a different direction for a few metres of the revisit."""
    T_wc = block(overlap=80.0)
    away = slice(len(T_wc) - 45, len(T_wc) - 45 + interruption)
    T_wc[away, :3, :3] = pose(0.0, 0.0, np.radians(60.0))[:3, :3]
    assert len(revisits(T_wc, times(T_wc))) == expected


def test_time_must_have_passed():
    T_wc = block()
    assert len(revisits(T_wc, 0.01 * times(T_wc))) == 0


def test_standing_still_neither_splits_nor_lengthens():
    T_wc = block()
    stop = len(T_wc) - 30
    waiting = np.concatenate([T_wc[:stop], np.repeat(T_wc[stop : stop + 1], 300, 0), T_wc[stop:]])
    moving, stopped = revisits(T_wc, times(T_wc)), revisits(waiting, times(waiting))
    assert len(stopped) == 1
    assert stopped.length_m == pytest.approx(moving.length_m)
    assert stopped.last[0] == len(waiting) - 1


def test_standing_still_at_the_same_place_is_no_revisit():
    T_wc = np.repeat(np.eye(4)[None], 500, axis=0)
    assert len(revisits(T_wc, times(T_wc))) == 0


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_too_few_frames(frames):
    T_wc = np.repeat(np.eye(4)[None], frames, axis=0)
    assert len(revisits(T_wc, times(T_wc))) == 0


def test_kidnapping_is_no_path():
    """The camera jumps by 200 m between two frames, and later passes through the gap."""
    there = along((0, 0), (0, 60))
    far = along((0, 260), (0, 300), (100, 300), (100, 90), (0, 90), (0, 240))
    T_wc = np.concatenate([there, far])
    assert len(revisits(T_wc, times(T_wc))) == 0


def test_right_loop_finds_its_stretch_and_a_wrong_one_does_not():
    T_wc = block()
    query = len(T_wc) - 40
    edge = true_edge(T_wc, query, 20)
    frames = np.arange(len(T_wc))
    for metres, degrees, right in (
        (1.9, 0.0, True),
        (2.1, 0, False),
        (0, 4.9, True),
        (0, 5.1, False),
    ):
        verdict = judge_loops(
            [moved(edge, metres=metres, degrees=degrees)], frames, T_wc, times(T_wc)
        )
        assert verdict.right == (right,)
        assert verdict.n_wrong == (not right)
        assert (verdict.n_found, verdict.n_missed) == (right, not right)
        assert verdict.loop_frame.tolist() == [query if right else -1]


def test_keyframes_are_turned_into_frames():
    T_wc = block()
    frames = np.arange(0, len(T_wc), 5)
    query = len(frames) - 8
    edge = replace(true_edge(T_wc, frames[query], frames[4]), query=query, match=4)
    verdict = judge_loops([edge], frames, T_wc, times(T_wc))
    assert verdict.right == (True,)
    assert verdict.loop_frame.tolist() == [frames[query]]


def test_only_accepted_loops_find_and_only_accepted_ones_are_wrong():
    T_wc = block()
    edge = replace(true_edge(T_wc, len(T_wc) - 40, 20), accepted=False, reason="too few inliers")
    edges = [
        edge,
        moved(edge, metres=30.0),
        replace(edge, T_query_match=None),
        replace(edge, query=-1),
    ]
    verdict = judge_loops(edges, np.arange(len(T_wc)), T_wc, times(T_wc))
    assert verdict.right == (True, False, None, None)
    assert (verdict.n_found, verdict.n_missed, verdict.n_wrong) == (0, 1, 0)


def test_two_stretches_need_a_loop_each():
    corners = [(0, 0), (0, 100), (100, 100), (100, -20), (0, -20), (0, 40), (-30, 40), (-30, 140)]
    T_wc = along(*corners, (60, 140), (60, 100), (100, 100), (100, 20))
    assert len(revisits(T_wc, times(T_wc))) == 2
    frames, first = np.arange(len(T_wc)), revisits(T_wc, times(T_wc)).first
    loops = [true_edge(T_wc, int(first[0]) + 15, 5)]
    assert judge_loops(loops, frames, T_wc, times(T_wc)).n_missed == 1
    loops.append(true_edge(T_wc, int(first[1]) + 10, 170))
    assert judge_loops(loops, frames, T_wc, times(T_wc)).n_missed == 0


def test_edge_to_the_frames_just_before_finds_nothing():
    T_wc = block()
    query = len(T_wc) - 20
    verdict = judge_loops(
        [true_edge(T_wc, query, query - 15)], np.arange(len(T_wc)), T_wc, times(T_wc)
    )
    assert verdict.right == (True,)
    assert verdict.n_missed == 1


def test_loop_just_after_the_stretch_counts_for_it():
    T_wc = along((0, 0), (0, 100), (100, 100), (100, -20), (0, -20), (0, 60), (60, 60))
    found = revisits(T_wc, times(T_wc))
    frames = np.arange(len(T_wc))
    for beyond, expected in ((8, 1), (12, 0)):
        edge = true_edge(T_wc, int(found.last[0]) + beyond, 60)
        assert judge_loops([edge], frames, T_wc, times(T_wc)).n_found == expected


def test_loop_beyond_the_ground_truth_is_not_judged():
    T_wc = block()
    edge = true_edge(T_wc, len(T_wc) - 1, 60)
    verdict = judge_loops([edge], np.arange(len(T_wc)), T_wc[:-10], times(T_wc)[:-10])
    assert verdict.right == (None,)


def test_no_loops_and_no_revisits():
    T_wc = along((0, 0), (0, 100))
    verdict = judge_loops(NO_EDGES, np.zeros(0, np.int64), T_wc, times(T_wc))
    assert (verdict.n_found, verdict.n_missed, verdict.n_wrong, verdict.right) == (0, 0, 0, ())


def test_unit_of_a_monocular_map_is_told_from_the_steps_around_a_frame():
    T_wc = along((0, 0), (0, 200))
    drifted = T_wc.copy()
    unit = np.where(np.arange(len(T_wc)) < 100, 2.0, 0.5)  # metres
    steps = np.diff(T_wc[:, :3, 3], axis=0) / unit[1:, None]
    drifted[1:, :3, 3] = np.cumsum(steps, axis=0)
    metres = metres_per_unit(drifted, T_wc)
    np.testing.assert_allclose(metres[:75], 2.0)
    np.testing.assert_allclose(metres[125:], 0.5)
    np.testing.assert_allclose(metres_per_unit(T_wc[:1], T_wc[:1]), 1.0)
    standing = np.tile(np.eye(4), (5, 1, 1))
    np.testing.assert_allclose(metres_per_unit(standing, standing), 1.0)
