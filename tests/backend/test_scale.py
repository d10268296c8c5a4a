"""The simulated map of tools/experiments/scale/growth.py."""

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
