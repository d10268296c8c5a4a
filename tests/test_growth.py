"""The simulated town of tools/experiments/scale/growth.py, and the laws that are fitted to it."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "tools" / "experiments" / "scale"))
from growth import AHEAD, NEW, SHARED, law, mapped, table, town


def test_every_observation_is_in_front_of_its_camera_and_none_is_twice():
    t = town(300)
    keyframe, landmark = t.observed.T
    p = np.einsum("nij,nj->ni", t.T_cw[keyframe, :3, :3], t.points[landmark])
    p += t.T_cw[keyframe, :3, 3]
    assert p[:, 2].min() > 2.0
    assert np.abs(p[:, 0] / p[:, 2]).max() < 3.0
    assert len(np.unique(t.observed, axis=0)) == len(t.observed)
    assert 0.9 * NEW * (AHEAD + 1) < len(t.observed) / 300 <= NEW * (AHEAD + 1)


def test_streets_meet_at_crossings(check_map):
    t = town(300)
    assert len(t.crossing) >= 4
    positions = -np.einsum("nji,nj->ni", t.T_cw[:, :3, :3], t.T_cw[:, :3, 3])
    np.testing.assert_allclose(positions[t.crossing[:, 0]], positions[t.crossing[:, 1]], atol=1e-9)
    map_ = mapped(t)
    check_map(map_)
    for one, other in t.crossing.tolist():
        neighbours, shared = map_.covisible(one)
        assert shared[neighbours == other].tolist() == [SHARED]


def test_a_power_is_found_and_what_was_not_measured_stands_in_parentheses():
    found = {n: dict.fromkeys(["query_ms", "mb"], 3.0 * n**1.5) for n in (10, 100, 1000)}
    found[10000] = {}
    assert law(found, "mb").exponent == pytest.approx(1.5)
    assert law(found, "mb").at(10000) == pytest.approx(3e6)
    (row,) = [line for line in table(found, ["mb"]).splitlines() if "memory" in line]
    assert row.endswith("| 94,868 | (3,000,000) | n^1.50 |")
