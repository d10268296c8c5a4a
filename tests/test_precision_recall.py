"""Precision and recall, compared with scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.metrics import average_precision_score, balanced_accuracy_score, precision_recall_curve

from vslam.errors import InputError
from vslam.loopclosure.precision_recall import (
    accepted_at,
    average_precision,
    balanced_accuracy,
    max_f1,
    precision_at_recall,
    precision_recall,
    recall_at_full_precision,
    summary,
)

# 5 true pairs of 8; two scores tie.
SAME = np.array([1, 1, 0, 1, 1, 0, 0, 1], bool)
SCORE = np.array([0.9, 0.8, 0.7, 0.6, 0.5, 0.5, 0.2, 0.1])


@pytest.mark.parametrize("seed", range(6))
def test_curve_and_ap_are_scikit_learn_s(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 400))
    score = rng.standard_normal(n) if seed % 2 else rng.integers(0, 9, n) / 8  # with ties
    same = rng.random(n) < 0.2
    same[0] = True
    curve = precision_recall(same, score)
    precision, recall, thresholds = precision_recall_curve(same, score)
    assert np.allclose(curve.precision, precision)
    assert np.allclose(curve.recall, recall)
    assert np.allclose(curve.thresholds, thresholds)
    assert average_precision(curve) == pytest.approx(average_precision_score(same, score))
    if not same.all():
        wanted = balanced_accuracy_score(same, score >= 0.5)
        assert balanced_accuracy(same, score, 0.5) == pytest.approx(wanted)


def test_figures_by_hand():
    curve = precision_recall(SAME, SCORE)
    assert recall_at_full_precision(curve) == pytest.approx(2 / 5)
    assert precision_at_recall(curve, 0.7) == pytest.approx(4 / 6)
    assert precision_at_recall(curve, 0.6) == pytest.approx(3 / 4)
    best, threshold = max_f1(curve)
    assert best == pytest.approx(2 * 5 / (8 + 5))
    assert threshold == 0.1
    assert accepted_at(curve, 1.1 * SCORE.max()) == (1.0, 0.0)
    assert accepted_at(curve, threshold) == pytest.approx((5 / 8, 1.0))
    wanted = 0.2 * (1 + 1 + 3 / 4 + 4 / 6 + 5 / 8)
    assert average_precision(curve) == pytest.approx(wanted)
    assert summary(SAME, SCORE)["average_precision"] == pytest.approx(wanted)


def test_a_wrong_pair_on_top_leaves_no_recall_at_full_precision():
    curve = precision_recall(np.array([False, True]), np.array([0.9, 0.1]))
    assert recall_at_full_precision(curve) == 0.0


def test_bad_figures_are_refused():
    with pytest.raises(InputError, match="empty ground truth"):
        precision_recall(np.zeros(3, bool), np.zeros(3))
    with pytest.raises(InputError, match="NaN"):
        precision_recall(np.ones(2, bool), np.array([0.1, np.nan]))
    with pytest.raises(InputError, match="the labels have the shape"):
        precision_recall(np.ones(2, bool), np.zeros(3))
    with pytest.raises(InputError, match="same place and of different places"):
        balanced_accuracy(np.ones(2, bool), np.zeros(2), 0.5)
