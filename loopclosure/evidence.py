"""Weighs the evidence of a loop: how probable is it that the loop is wrong?

Two different places can look alike, for example because a facade is repeated. Their matches lie on
few objects, leave most of the place unmatched, and determine the pose poorly. None of this decides
alone, so a logistic model weighs it all. Its weights were fitted to pairs of keyframes of rendered
towns, many of them with repeated houses (``tools/experiments/loops/evidence.py``).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.frontend.matching import count_elsewhere
from vslam.types.geometry import Matrix, transform
from vslam.types.loops import Descriptors, LoopEdge, LoopEvidence


class Weights(NamedTuple):
    """The logarithm of the odds of a wrong loop is ``constant`` plus the sum of the other weights,
    each multiplied by the logarithm of the evidence of the same name."""

    constant: float
    seen: float
    seen_back: float
    elsewhere: float
    sigma_translation: float
    sigma_rotation: float


WEIGHTS: dict[Descriptors, Weights] = {
    "orb": Weights(-7.32, 0.0, -1.35, -1.56, 1.71, 1.67),
    "learned": Weights(-7.32, -3.14, -3.19, -1.78, 1.73, 1.54),
}


def evidence_of(
    uv: Matrix,
    seen: NDArray[np.bool_],
    xyz: Matrix,
    T_cw: Matrix,
    covariance: Matrix,
    focal: float,
    width: int,
    seen_of_match: tuple[int, int],
    seen_of_query: tuple[int, int],
) -> LoopEvidence:
    """Collect the evidence of a loop.

    Args:
        uv: ``(M, 2)`` projections of the landmarks of the place in the query image, pixels.
        seen: ``(M,)`` bool, True for the landmarks that were found there.
        xyz: ``(M, 3)`` positions of these landmarks.
        T_cw: ``(4, 4)`` pose of the query (world to camera), in the world frame of the landmarks.
        covariance: ``(6, 6)`` covariance of this pose, translation first.
        focal: focal length of the image in which descriptors were matched, pixels.
        width: width of the query image, in the unit of ``uv``.
        seen_of_match: number of landmarks of the match keyframe that were found, and number of
            those that should be visible.
        seen_of_query: the same for the landmarks of the query in the match image.
    """
    depth = float(np.median(transform(T_cw, xyz[seen])[:, 2]))
    elsewhere = count_elsewhere(uv[seen, 0], width), count_elsewhere(uv[:, 0], width)
    return LoopEvidence(
        _share(*seen_of_match),
        _share(*seen_of_query),
        _share(*elsewhere),
        float(np.sqrt(np.trace(covariance[:3, :3])) * focal / depth),
        float(np.sqrt(np.trace(covariance[3:, 3:])) * focal),
    )


def probability_wrong(evidence: LoopEvidence, matched_by: Descriptors) -> float:
    """Compute the probability that a loop is wrong.

    Args:
        matched_by: the kind of descriptors that were matched.
    """
    constant, *weights = WEIGHTS[matched_by]
    odds = np.exp(constant + np.dot(weights, np.log(evidence)))
    return float(odds / (1.0 + odds)) if np.isfinite(odds) else 1.0


def weighed(edge: LoopEdge, evidence: LoopEvidence) -> LoopEdge:
    """Accept or reject a loop edge according to its evidence.

    It is accepted with the reason "verified" if it is more probably right than wrong. How sure a
    loop must be to be closed is decided by ``vslam.loopclosure.consistency``.
    """
    p_wrong = probability_wrong(evidence, edge.matched_by)
    edge = replace(edge, evidence=evidence, p_wrong=p_wrong)
    if p_wrong < 0.5:
        return replace(edge, accepted=True, reason="verified")
    seen, back, elsewhere = (f"{share:.0%}" for share in evidence[:3])
    where = f"{seen} of the place is seen, {back} from the other side, {elsewhere} outside"
    return replace(edge, reason=f"probably another place: {where} one third of the image")


def _share(found: int, expected: int) -> float:
    """Estimate a fraction from two numbers (Laplace's rule of succession)."""
    return (found + 1) / (expected + 2)
