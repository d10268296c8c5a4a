"""Computes precision, recall and derived measures from the scores of a loop detector.

Tests check that the curves are identical to those of scikit-learn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.support.errors import InputError


@dataclass(frozen=True)
class PrecisionRecall:
    """A precision-recall curve.

    There is one point for each of K thresholds on the score. The last point has precision 1 and
    recall 0, and belongs to no threshold.

    Attributes:
        precision, recall: ``(K + 1,)`` float64.
        thresholds: ``(K,)`` distinct scores, ascending. A pair is accepted if its score is at least
            the threshold.
    """

    precision: NDArray[np.float64]
    recall: NDArray[np.float64]
    thresholds: NDArray[np.float64]


def precision_recall(same: NDArray, score: NDArray) -> PrecisionRecall:
    """Compute the precision-recall curve of a loop detector, with one threshold at each distinct
    score.

    Args:
        same: ``(N,)`` bool, True for pairs of images that show the same place.
        score: ``(N,)`` similarity of each pair.

    Raises:
        InputError: no pair shows the same place, the lengths differ, or a score is NaN.
    """
    same, score = np.asarray(same, bool), np.asarray(score, np.float64)
    _require_scores_of(same, score, 1)
    return curve_of(same, score, int(same.sum()))


def _require_scores_of(same: NDArray, score: NDArray, dimensions: int) -> None:
    if same.shape != score.shape or same.ndim != dimensions:
        raise InputError(
            f"precision-recall: the labels have the shape {same.shape}, but the scores have the "
            f"shape {score.shape}."
        )
    if not same.any():
        raise InputError("precision-recall: empty ground truth; no pair shows the same place.")
    if np.isnan(score).any():
        raise InputError("precision-recall: a score is NaN; check the weights of the detector.")


def top_k_precision_recall(
    same: NDArray, score: NDArray, k: int, known: NDArray | None = None
) -> PrecisionRecall:
    """Compute the precision-recall curve of the K most similar gallery images of each query.

    These images are the candidates of the query. Of equally similar images, those with the lower
    index are chosen. At each threshold, the candidates of all queries whose score is at least the
    threshold are accepted.

    - Precision is the share of the accepted candidates that show the same place as their query. If
      the place of a query is not in the gallery, every accepted candidate of this query is wrong.
    - Recall is the number of accepted candidates that show the same place, divided by the number of
      true matches that could be found. For a query with m true matches, that is min(m, K). A query
      without a true match adds nothing to this number.

    A detector that ranks every true match before every other pair has an average precision of 1 for
    each K. If K is at least G, the curve is that of `precision_recall` over all pairs.

    Args:
        same: ``(Q, G)`` bool, True where a query and a gallery image show the same place.
        score: ``(Q, G)`` similarity of each query and each gallery image.
        k: largest number of candidates of a query, at least 1.
        known: ``(Q, G)`` bool, False for pairs that are left out because their ground truth is
            unknown. None stands for True everywhere.

    Raises:
        InputError: no pair shows the same place, the shapes differ, or a score is NaN.
    """
    same, score = np.asarray(same, bool), np.asarray(score, np.float64)
    known = np.ones(same.shape, bool) if known is None else np.asarray(known, bool)
    same = same & known
    _require_scores_of(same, score, 2)
    # Known pairs come first, in descending order of their scores.
    order = np.lexsort((-score, ~known), axis=1)[:, :k]
    right, ranked, kept = (np.take_along_axis(one, order, axis=1) for one in (same, score, known))
    return curve_of(right[kept], ranked[kept], int(np.minimum(same.sum(1), k).sum()))


def curve_of(right: NDArray[np.bool_], score: NDArray[np.float64], total: int) -> PrecisionRecall:
    """Compute the precision-recall curve of N scored items.

    Args:
        right: ``(N,)`` bool, True for items that should be accepted.
        score: ``(N,)`` float64 score of each item.
        total: number of items that should be accepted, which is the denominator of recall.
    """
    order = np.argsort(-score, kind="stable")
    ranked = score[order]
    # For each distinct score, the index of the last item with this score.
    last = np.flatnonzero(np.append(np.diff(ranked) != 0, len(ranked) > 0))
    correct = np.cumsum(right[order])[last]
    precision, recall = correct / (last + 1), correct / total
    return PrecisionRecall(
        np.append(precision[::-1], 1.0), np.append(recall[::-1], 0.0), ranked[last][::-1]
    )


def average_precision(curve: PrecisionRecall) -> float:
    """Compute the sum of the precisions, weighted by the steps in recall, without interpolation."""
    return float(-np.sum(np.diff(curve.recall) * curve.precision[:-1]))


def recall_at_full_precision(curve: PrecisionRecall) -> float:
    """Return the highest recall at which all accepted pairs are correct (Cummins and Newman, IJRR
    2008)."""
    return float(curve.recall[curve.precision == 1.0].max())


def precision_at_recall(curve: PrecisionRecall, recall: float) -> float:
    """Return the highest precision at the given recall or a higher recall."""
    return float(curve.precision[curve.recall >= recall].max())


def accepted_at(curve: PrecisionRecall, threshold: float) -> tuple[float, float]:
    """Return the precision and the recall at a threshold. If no pair is accepted, the precision is
    1."""
    k = int(np.searchsorted(curve.thresholds, threshold))
    return float(curve.precision[k]), float(curve.recall[k])


def max_f1(curve: PrecisionRecall) -> tuple[float, float]:
    """Return the highest F1 score (harmonic mean of precision and recall) and its threshold."""
    p, r = curve.precision[:-1], curve.recall[:-1]
    f1 = np.divide(2 * p * r, p + r, out=np.zeros_like(p), where=p + r > 0)
    best = int(np.argmax(f1))
    return float(f1[best]), float(curve.thresholds[best])


def balanced_accuracy(same: NDArray, score: NDArray, threshold: float) -> float:
    """Compute the mean of the true positive rate and the true negative rate at a threshold on the
    score.

    Args:
        same: ``(N,)`` bool, True for pairs of images that show the same place.
        score: ``(N,)`` similarity of each pair.

    Raises:
        InputError: all pairs show the same place, or no pair does.
    """
    same, accepted = np.asarray(same, bool), np.asarray(score) >= threshold
    if same.all() or not same.any():
        raise InputError(
            "accuracy: pairs of the same place and of different places are needed; add the missing "
            "kind."
        )
    return float((accepted[same].mean() + (~accepted[~same]).mean()) / 2)


def summary(same: NDArray, score: NDArray) -> dict[str, float]:
    """Compute all measures that a report shows for a loop detector.

    Args:
        same: ``(N,)`` bool, True for pairs of images that show the same place.
        score: ``(N,)`` similarity of each pair.
    """
    curve = precision_recall(same, score)
    f1, threshold = max_f1(curve)
    return {
        "pairs": float(len(same)),
        "same": float(np.sum(same)),
        "average_precision": average_precision(curve),
        "recall_at_100_precision": recall_at_full_precision(curve),
        "precision_at_70_recall": precision_at_recall(curve, 0.7),
        "max_f1": f1,
        "max_f1_threshold": threshold,
    }
