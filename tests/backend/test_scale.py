"""The simulated map and the drawn streets of tools/experiments/scale."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
import pytest

from vslam.backend.global_bundle_adjustment import adjust_globally
from vslam.types.map import NONE

N = 200


@pytest.fixture
def growth(monkeypatch):
    folder = Path(__file__).parents[2] / "tools" / "experiments" / "scale"
    monkeypatch.syspath_prepend(str(folder))
    import growth

    return growth


def test_landmarks_are_before_the_cameras_that_observe_them(growth):
    town = growth.build_town(N)
    keyframe, landmark = town.observed.T
    T = town.T_cw[keyframe]
    depth = np.einsum("nj,nj->n", T[:, 2, :3], town.points[landmark]) + T[:, 2, 3]
    assert depth.min() > 4.0
    assert depth.max() < 50.0
    assert len(np.unique(town.observed, axis=0)) == len(town.observed)


def test_streets_share_landmarks_only_at_crossings(growth):
    town = growth.build_town(N)
    map_ = growth.build_map(town)
    first, second = town.crossings[0]
    others, shared = map_.covisible(int(second))
    assert shared[others == first] == growth.SHARED
    a = map_.arrays
    assert np.count_nonzero(a.landmark[: map_.n_rows] != NONE) == len(town.observed)
    length = np.flatnonzero(town.starts_street)[1]
    streets = np.arange(N) // length
    met = {(int(i), int(j)) for i, j in town.crossings}
    for k in range(N):
        for other in map_.covisible(k)[0].tolist():
            pair = (min(k, other), max(k, other))
            assert streets[k] == streets[other] or pair in met


def test_bundle_adjustment_removes_the_simulated_noise(growth):
    problem = growth.bundle_problem(N)
    start = adjust_globally(problem, iterations=0)
    solved = adjust_globally(problem, iterations=4)
    assert solved.cost < 0.3 * start.cost
    assert solved.inlier.mean() > 0.9


@pytest.mark.slow
def test_it_writes_a_row_for_each_size(growth, tmp_path, monkeypatch):
    words = ["growth.py", "--sizes", "200", "400", "--out", str(tmp_path / "scale.csv")]
    monkeypatch.setattr(sys, "argv", words)
    growth.main()
    small, large = csv.DictReader((tmp_path / "scale.csv").open())
    assert (small["keyframes"], large["keyframes"]) == ("200", "400")
    assert all(float(value) > 0 for row in (small, large) for value in row.values())
    assert 1.5 < float(large["map_gb"]) / float(small["map_gb"]) < 3.0


@pytest.fixture
def drive(growth):
    import drive

    return drive


def test_a_drive_through_new_streets_never_leaves_them_and_returns(drive):
    streets = drive.plan(4)
    x, z = streets.T_wc[:, 0, 3], streets.T_wc[:, 2, 3]
    from_street = np.abs(z - drive.APART * np.round(z / drive.APART))
    from_side = np.minimum(np.abs(x), np.abs(x - drive.STREET))
    assert np.all(np.minimum(from_street, from_side) < drive.HALF - 1.0)
    steps = np.hypot(np.diff(x), np.diff(z))
    turns = np.diff(np.unwrap(np.arctan2(streets.T_wc[:, 0, 2], streets.T_wc[:, 2, 2])))
    assert steps.max() <= drive.STEP + 1e-6
    assert np.abs(turns).max() <= drive.TURN + 1e-6
    assert np.round(z.max()) == 3 * drive.APART
    again = streets.T_wc[-1, :3, 3]
    assert np.linalg.norm(streets.T_wc[:100, :3, 3] - again, axis=1).min() < drive.STEP
    assert np.linalg.norm(streets.T_wc[streets.returns, :3, 3]) < drive.CURVE


@pytest.mark.slow
def test_both_cameras_see_the_same_walls(drive):
    streets, camera = drive.plan(2), drive.CAMERA
    left, right = drive.stereo_pair(streets, 20)
    T_wc, v = streets.T_wc[20], 50
    for u in (80, 110, 210, 250, 300):
        ray = T_wc[:3, 0] * (u - camera.cx) / camera.fx + T_wc[:3, 2]
        depth = drive.wall_ahead(T_wc[0, 3], T_wc[2, 3], ray[0], ray[2], 2)[0]
        seen = np.interp(u - camera.bf / depth, np.arange(camera.width), right[v])
        assert abs(seen - left[v, u]) < 12.0, (u, seen, left[v, u])
    assert left[v].std() > 20.0
