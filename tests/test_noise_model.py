"""Variance components against noise of known size."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from test_global_bundle_adjustment import loop_problem

sys.path.insert(0, str(Path(__file__).parents[1] / "tools" / "experiments" / "motorway"))
from noise_model import variance_components

PIXEL, TIMES_SURER = 0.5, 4.0  # px of noise in u and v; that of disparities is so much smaller


def test_the_noise_is_found_that_was_put_in_whatever_is_assumed_first():
    problem, _ = loop_problem(noise=0.0)
    rng = np.random.default_rng(0)
    error = PIXEL * rng.normal(size=problem.uvr.shape)
    error[:, 2] = error[:, 0] - error[:, 2] / TIMES_SURER
    problem.uvr[:] += error
    sigma = np.array([1.0, 1.0, 1.0])
    for _ in range(6):
        problem, sigma, count = variance_components(problem, sigma)
    assert count > 0.97 * np.isfinite(problem.uvr[:, 2]).sum()
    assert sigma == pytest.approx([PIXEL, PIXEL, PIXEL / TIMES_SURER], rel=0.1)
