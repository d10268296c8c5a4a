"""How good a loop detector's scores are: precision, recall and what follows from them.

Definitions as in the field's benchmarks (Cummins and Newman, IJRR 2008: recall at 100 % precision)
and, point for point, as in scikit-learn, which the tests compare with.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.errors import InputError


@dataclass(frozen=True)
class PrecisionRecall:
    """A curve of K + 1 points, from the lowest threshold to the end point (1, 0).

    Attributes:
        precision, recall: ``(K + 1,)`` float64.
        thresholds: ``(K,)``, the distinct scores, increasing: accepted is what is not below.
    """

    precision: NDArray[np.float64]
    recall: NDArray[np.float64]
    thresholds: NDArray[np.float64]


def precision_recall(same: NDArray, score: NDArray) -> PrecisionRecall:
    """Precision and recall at each distinct score.

    Args:
        same: ``(N,)`` bool, whether a pair truly shows one place.
        score: ``(N,)`` greater is more alike.

    Raises:
        InputError: no true pair, unequal lengths, or a score that is NaN.
    """
    same, score = np.asarray(same, bool), np.asarray(score, np.float64)
    if same.shape != score.shape or same.ndim != 1:
        raise InputError(f"precision-recall: {same.shape} labels do not fit {score.shape} scores.")
    if not same.any():
        raise InputError("precision-recall: empty ground truth, no pair shows one place.")
    if np.isnan(score).any():
        raise InputError("precision-recall: a score is NaN; look at the weights of the detector.")
    order = np.argsort(-score, kind="stable")
    ranked = score[order]
    last = np.append(np.flatnonzero(np.diff(ranked)), len(ranked) - 1)  # of each distinct score
    right = np.cumsum(same[order])[last]
    precision, recall = right / (last + 1), right / right[-1]
    return PrecisionRecall(
        np.append(precision[::-1], 1.0), np.append(recall[::-1], 0.0), ranked[last][::-1]
    )


def average_precision(curve: PrecisionRecall) -> float:
    """AP: precision weighted by the steps of recall, without interpolation."""
    return float(-np.sum(np.diff(curve.recall) * curve.precision[:-1]))


def recall_at_full_precision(curve: PrecisionRecall) -> float:
    """The highest recall without a single wrong pair."""
    return float(curve.recall[curve.precision == 1.0].max())


def precision_at_recall(curve: PrecisionRecall, recall: float = 0.7) -> float:
    """The highest precision of any threshold that reaches this recall."""
    return float(curve.precision[curve.recall >= recall].max())


def accepted_at(curve: PrecisionRecall, threshold: float) -> tuple[float, float]:
    """Precision and recall of the pairs that a threshold accepts; 1 and 0 if it accepts none."""
    k = int(np.searchsorted(curve.thresholds, threshold))
    return float(curve.precision[k]), float(curve.recall[k])


def max_f1(curve: PrecisionRecall) -> tuple[float, float]:
    """The highest harmonic mean of precision and recall, and its threshold."""
    p, r = curve.precision[:-1], curve.recall[:-1]
    f1 = np.divide(2 * p * r, p + r, out=np.zeros_like(p), where=p + r > 0)
    best = int(np.argmax(f1))
    return float(f1[best]), float(curve.thresholds[best])


def balanced_accuracy(same: NDArray, score: NDArray, threshold: float) -> float:
    """Mean of the shares of true and of false pairs judged rightly.

    What accuracy is on as many true as false pairs.

    Raises:
        InputError: true or false pairs missing.
    """
    same, accepted = np.asarray(same, bool), np.asarray(score) >= threshold
    if same.all() or not same.any():
        raise InputError("accuracy: both true and false pairs are needed.")
    return float((accepted[same].mean() + (~accepted[~same]).mean()) / 2)


def summary(same: NDArray, score: NDArray) -> dict[str, float]:
    """Every figure that a report gives of one detector on one set of pairs."""
    curve = precision_recall(same, score)
    f1, threshold = max_f1(curve)
    return {
        "pairs": float(len(same)),
        "same": float(np.sum(same)),
        "average_precision": average_precision(curve),
        "recall_at_100_precision": recall_at_full_precision(curve),
        "precision_at_70_recall": precision_at_recall(curve),
        "max_f1": f1,
        "max_f1_threshold": threshold,
    }
