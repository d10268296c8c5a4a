"""The usual protocol of the literature: one decision per image of a drive, in driving order.

An image is compared with all earlier images except those in a window just before it. The most
similar image is its match, and the score of the match is compared with a threshold. The ground
truth marks which images show the same place:

- a match is *right* if the ground truth marks it as the same place, otherwise *wrong*;
- precision is right / (right + wrong) over the images whose score reaches the threshold;
- recall is right / (images that have a marked image before the window).

Recall at 100 % precision is the highest recall over all thresholds without a wrong match (Cummins
and Newman, IJRR 2008; Galvez-Lopez and Tardos, T-RO 2012; Garcia-Fidalgo and Ortiz, RA-L 2018; An
et al., IROS 2019). If verification rejects a match, the image has no match at any threshold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.errors import InputError
from vslam.loopclosure.precision_recall import PrecisionRecall, curve_of
from vslam.loopclosure.siamese.image_source import DIFFERENT, SAME


@dataclass(frozen=True)
class Window:
    """The window of images just before a query, which are not compared with it: ``amount`` is a
    number of images, or of seconds if ``timed``."""

    amount: float
    timed: bool

    def __str__(self) -> str:
        return f"{self.amount:g} {'s' if self.timed else 'images'}"

    def searchable(self, n: int, times: NDArray[np.float64] | None) -> NDArray[np.int64]:
        """For each image, the number of images from the start of the drive that may be searched.

        Args:
            n: number of images in the drive.
            times: ``(n,)`` seconds, ascending; None assumes one image per second, as DLoopDetector
                does by default.

        Returns:
            ``(n,)`` int64.
        """
        clock = np.arange(n, dtype=np.float64) if times is None or not self.timed else times
        # The tolerance absorbs rounding of the times, which are multiples of the frame interval.
        return np.searchsorted(clock, clock - self.amount + 1e-6, side="right")


def parse_window(text: str) -> Window:
    """Parse ``20s`` (seconds) or ``200`` (images).

    Raises:
        InputError: the text has another form, or the number is not positive.
    """
    timed = text.endswith("s")
    try:
        amount = float(text.removesuffix("s")) if timed else float(int(text))
        if not 0.0 < amount < float("inf"):
            raise ValueError
    except ValueError as error:
        raise InputError(
            f"--window {text}: must be a positive number of seconds (20s) or of images (200)."
        ) from error
    return Window(amount, timed)


@dataclass(frozen=True)
class Decisions:
    """The decisions for N images.

    Attributes:
        match: ``(N,)`` int64 index of the image found; -1 if there is no match.
        score: ``(N,)`` float64 score of the match; -inf if there is no match.
    """

    match: NDArray[np.int64]
    score: NDArray[np.float64]

    def __post_init__(self) -> None:
        if np.isnan(self.score).any():
            raise InputError("loops bench: a score is NaN; check the weights of the detector.")

    def only(self, accepted: NDArray[np.bool_]) -> Decisions:
        """The decisions without those that the mask ``(N,)`` rejects: these images get no match."""
        return Decisions(
            np.where(accepted, self.match, -1), np.where(accepted, self.score, -np.inf)
        )


def decide(scores: NDArray[np.float64], searchable: NDArray[np.int64]) -> Decisions:
    """Find the most similar searchable image for each image of a drive.

    Args:
        scores: ``(N, N)`` similarities, with a row for each query.
        searchable: ``(N,)``, see :meth:`Window.searchable`.
    """
    match, score = np.full(len(scores), -1, np.int64), np.full(len(scores), -np.inf)
    for k in np.flatnonzero(searchable):
        match[k] = scores[k, : searchable[k]].argmax()
        score[k] = scores[k, match[k]]
    return Decisions(match, score)


@dataclass(frozen=True)
class Judged:
    """Decisions compared with the ground truth.

    Attributes:
        score: ``(N,)`` float64 score of the match; -inf if there is no match.
        right: ``(N,)`` bool, whether the match is marked as the same place.
        far: ``(N,)`` bool, whether the match shows another place. A match that is neither right
            nor far was taken near the place, but not near enough to be marked.
        answerable: ``(N,)`` bool, whether there is a marked image before the window, so that a
            right match is possible.
    """

    score: NDArray[np.float64]
    right: NDArray[np.bool_]
    far: NDArray[np.bool_]
    answerable: NDArray[np.bool_]

    @property
    def near(self) -> NDArray[np.bool_]:
        """``(N,)`` bool, whether the match was taken near the place but is not marked."""
        return np.isfinite(self.score) & ~self.right & ~self.far


def judge(
    decisions: Decisions, relation: NDArray[np.int8], searchable: NDArray[np.int64]
) -> Judged:
    """Compare decisions with the ground truth: ``relation`` ``(N, N)`` int8 tells which images show
    the same place (:class:`vslam.lab.loopbench.sets.QuerySet`).

    Raises:
        InputError: no image has a marked image before the window.
    """
    n = len(relation)
    before = np.arange(n)[None] < searchable[:, None]
    answerable = ((relation == SAME) & before).any(1)
    if not answerable.any():
        raise InputError(
            "--protocol online: no image has a true match before the window; give a longer drive "
            "or a shorter --window."
        )
    found = decisions.match >= 0
    truth = np.where(found, relation[np.arange(n), decisions.match], 0)
    return Judged(
        decisions.score, found & (truth == SAME), found & (truth == DIFFERENT), answerable
    )


def decision_curve(judged: Judged, *, near_is_wrong: bool = True) -> PrecisionRecall:
    """Precision and recall over images, with each distinct score as the threshold.

    Args:
        near_is_wrong: count unmarked matches near the place as wrong, as the literature does; False
            leaves them out.
    """
    wrong = judged.far | (judged.near & near_is_wrong)
    counted = judged.right | wrong
    return curve_of(judged.right[counted], judged.score[counted], int(judged.answerable.sum()))
