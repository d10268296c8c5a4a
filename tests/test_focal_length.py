"""What tools/experiments/results/focal_length.py reads from a trajectory whose scale drifts."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "tools" / "experiments" / "results"))
from focal_length import scale_drift

BY_TURN, BY_METRE = 0.06, -2e-4


def test_drift_by_turns_is_told_from_drift_by_metres():
    """Straight on and round corners, either way: the scale grows with what was turned."""
    n = 600
    yaw_rate = np.where(np.arange(n) % 150 < 60, 0.025, 0.0) * np.where(np.arange(n) < 300, 1, -1)
    yaw = np.cumsum(yaw_rate)
    T_true = np.tile(np.eye(4), (n, 1, 1))
    T_true[:, 0, 0] = T_true[:, 2, 2] = np.cos(yaw)
    T_true[:, 0, 2], T_true[:, 2, 0] = np.sin(yaw), -np.sin(yaw)
    step = 0.8 * T_true[:, :3, 2]
    T_true[:, :3, 3] = np.cumsum(step, axis=0)
    turned, driven = np.cumsum(np.abs(yaw_rate)), 0.8 * np.arange(n)
    scale = np.exp(BY_TURN * turned + BY_METRE * driven)
    T_wc = T_true.copy()
    T_wc[:, :3, 3] = np.cumsum(scale[:, None] * step, axis=0)
    by_turn, by_metre = scale_drift(T_wc, T_true, 10)
    assert by_turn == pytest.approx(BY_TURN, rel=0.02)
    assert by_metre == pytest.approx(BY_METRE, rel=0.02)
