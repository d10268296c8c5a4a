"""Evaluates loop detectors on drives. A detector makes one decision for each image of a drive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vslam.loopclosure.vocabulary import Vocabulary
from vslam_lab.loopbench.detectors import LocalDescriptorCache, Scorer, describe
from vslam_lab.loopbench.measure import Verification, drawn_points
from vslam_lab.loopbench.online import Decisions, Window, decide, decision_curve, judge
from vslam_lab.loopbench.schema import DecisionCurve, OnlineScore
from vslam_lab.precision_recall import PrecisionRecall, max_f1, recall_at_full_precision
from vslam_lab.sources.image_source import ImageSource


def measure_drive(
    drive: ImageSource,
    scorers: Sequence[Scorer],
    window: Window,
    vocabulary: Vocabulary,
    *,
    threads: int,
) -> list[OnlineScore]:
    """Evaluate all loop detectors on one drive, before and after geometric verification.

    Args:
        drive: images in the order in which they were taken.
        window: the images just before a query, with which the query is not compared.
        vocabulary: vocabulary of the detector ``bow`` and of the verification by ORB.

    Raises:
        InputError: no image shows the same place as an image before its window.
        UnreadableImageError: an image is missing or damaged.
    """
    n = len(drive)
    searchable = window.searchable(n, drive.times)
    # Reject a drive without loops before the features are extracted.
    judge(Decisions(np.full(n, -1), np.full(n, -np.inf)), drive.relation, searchable)
    images = describe([drive.grey(k) for k in range(n)], vocabulary, threads)
    verify = Verification(images, images, LocalDescriptorCache())
    scores = []
    for scorer in scorers:
        found = decide(scorer.scores(images, scorer.store(images)), searchable)
        by_orb, by_learned = np.zeros((2, n), np.bool_)
        for k in np.flatnonzero(found.match >= 0):
            pair = int(k), int(found.match[k])
            by_orb[k], by_learned[k] = verify.by_orb(*pair), verify.by_learned(*pair)
        kept = {"nothing": found, "orb": found.only(by_orb), "learned": found.only(by_learned),
                "both": found.only(by_orb | by_learned)}  # fmt: skip
        scores += [
            _score(drive, scorer.name, window, by, decisions, searchable)
            for by, decisions in kept.items()
        ]
    return scores


def _score(
    drive: ImageSource,
    detector: str,
    window: Window,
    verified_by: str,
    decisions: Decisions,
    searchable: NDArray[np.int64],
) -> OnlineScore:
    judged = judge(decisions, drive.relation, searchable)
    strict, lenient = (decision_curve(judged, near_is_wrong=near) for near in (True, False))
    f1, threshold = _max_f1(strict)
    points = drawn_points(strict)
    return OnlineScore.model_validate({
        "data": drive.name, "detector": detector, "window": str(window),
        "verified_by": verified_by, "images": len(drive),
        "answerable": judged.answerable.sum(), "right": judged.right.sum(),
        "near": judged.near.sum(), "far": judged.far.sum(),
        "recall_at_100_precision": recall_at_full_precision(strict),
        "recall_at_100_precision_far": recall_at_full_precision(lenient),
        "max_f1": f1, "max_f1_far": _max_f1(lenient)[0], "max_f1_threshold": threshold,
        "curve": DecisionCurve(
            threshold=strict.thresholds[points[points < len(strict.thresholds)]].tolist(),
            precision=strict.precision[points].round(5).tolist(),
            recall=strict.recall[points].round(5).tolist(),
        ),
    })  # fmt: skip


def _max_f1(curve: PrecisionRecall) -> tuple[float, float | None]:
    return max_f1(curve) if len(curve.thresholds) else (0.0, None)
