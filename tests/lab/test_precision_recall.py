"""Precision and recall, compared with scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.metrics import average_precision_score, balanced_accuracy_score, precision_recall_curve

from vslam.support.errors import InputError
from vslam_lab.precision_recall import (
    accepted_at,
    average_precision,
    balanced_accuracy,
    max_f1,
    precision_at_recall,
    precision_recall,
    recall_at_full_precision,
    summary,
    top_k_precision_recall,
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


def counted_by_hand(same, score, known, k, threshold):
    """Return the numbers of accepted, right and findable candidates, pair by pair."""
    accepted = right = findable = 0
    for q in range(len(score)):
        images = [g for g in range(score.shape[1]) if known[q, g]]
        candidates = sorted(images, key=lambda g: (-score[q, g], g))[:k]
        findable += min(k, sum(bool(same[q, g]) for g in images))
        for g in candidates:
            if score[q, g] >= threshold:
                accepted += 1
                right += bool(same[q, g])
    return accepted, right, findable


@pytest.mark.parametrize("k", [1, 2, 5, 40])
@pytest.mark.parametrize("ties", [False, True])
def test_curve_over_the_top_candidates_counts_every_query_and_match(k, ties):
    rng = np.random.default_rng(k)
    score = rng.integers(0, 7, (12, 9)) / 6 if ties else rng.standard_normal((12, 9))
    same = rng.random((12, 9)) < np.linspace(0.0, 0.9, 12)[:, None]  # from none to nearly all
    known = rng.random((12, 9)) < 0.8
    score[~known] = 9.0  # must not matter
    known[5] = False  # a query without any candidate
    assert not same[0].any()
    assert same[-1].sum() > 5
    curve = top_k_precision_recall(same, score, k, known)
    for n, threshold in enumerate(curve.thresholds):
        accepted, right, findable = counted_by_hand(same, score, known, k, threshold)
        assert curve.precision[n] == pytest.approx(right / accepted)
        assert curve.recall[n] == pytest.approx(right / findable)
    lowest = counted_by_hand(same, score, known, k, -np.inf)
    assert curve.recall[0] == pytest.approx(lowest[1] / lowest[2])
    if k >= 9:
        usual = precision_recall(same[known], score[known])
        assert np.array_equal(curve.precision, usual.precision)
        assert np.array_equal(curve.recall, usual.recall)


def test_curve_over_the_top_candidates_by_hand():
    """Query 0 has two true matches, query 1 has one, and the place of query 2 is new."""
    same = np.array([[1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]], bool)
    score = np.array([[0.9, 0.6, 0.5, 0.1], [0.2, 0.7, 0.4, 0.3], [0.1, 0.2, 0.3, 0.8]])
    one = top_k_precision_recall(same, score, 1)
    # Ranked: 0.9 right, 0.8 of the new place, 0.7 of query 1. Two matches could be found.
    assert one.precision.tolist() == pytest.approx([1 / 3, 1 / 2, 1, 1])
    assert one.recall.tolist() == pytest.approx([1 / 2, 1 / 2, 1 / 2, 0])
    # With two candidates, also 0.6 right, 0.4 right, 0.3 of the new place. Three could be found.
    two = top_k_precision_recall(same, score, 2)
    assert average_precision(two) == pytest.approx((1 + 2 / 4 + 3 / 5) / 3)
    assert two.recall[0] == 1.0
    # Nothing is lost by a detector that ranks all true matches first.
    for k in (1, 2, 3):
        assert average_precision(top_k_precision_recall(same, same + 0.1 * score, k)) == 1.0


def test_bad_figures_are_refused():
    with pytest.raises(InputError, match="empty ground truth"):
        precision_recall(np.zeros(3, bool), np.zeros(3))
    with pytest.raises(InputError, match="NaN"):
        precision_recall(np.ones(2, bool), np.array([0.1, np.nan]))
    with pytest.raises(InputError, match="the labels have the shape"):
        precision_recall(np.ones(2, bool), np.zeros(3))
    with pytest.raises(InputError, match="empty ground truth"):
        top_k_precision_recall(np.eye(2), np.zeros((2, 2)), 1, known=1 - np.eye(2))
    with pytest.raises(InputError, match="NaN"):
        top_k_precision_recall(np.eye(2), np.full((2, 2), np.nan), 1)
    with pytest.raises(InputError, match="the labels have the shape"):
        top_k_precision_recall(np.eye(2), np.zeros((2, 3)), 1)
    with pytest.raises(InputError, match="same place and of different places"):
        balanced_accuracy(np.ones(2, bool), np.zeros(2), 0.5)
