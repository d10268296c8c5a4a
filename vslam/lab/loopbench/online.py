"""Evaluates loop detectors with one decision per image of a drive, as is usual in the literature.

The images are processed in driving order. Each image is compared with all earlier images, except
the images in a window just before it. The most similar image is its match. The match is accepted if
its score reaches a threshold.

The ground truth marks which images show the same place. The figures are defined as follows:

- A match is *right* if the ground truth marks it as the same place. Otherwise, it is *wrong*.
- Precision is right / (right + wrong). Only matches whose score reaches the threshold count.
- Recall is right / (number of images that have a marked image before the window).

Recall at 100 % precision is the highest recall that is reached without a wrong match, over all
thresholds (Cummins and Newman, IJRR 2008; Galvez-Lopez and Tardos, T-RO 2012; Garcia-Fidalgo and
Ortiz, RA-L 2018; An et al., IROS 2019). If geometric verification rejects a match, the image has no
match at any threshold.
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
    """The images just before a query image, which are not compared with the query.

    Attributes:
        amount: length of the window, as a number of images. If ``timed`` is set, it is in seconds.
        timed: whether ``amount`` is in seconds.
    """

    amount: float
    timed: bool

    def __str__(self) -> str:
        return f"{self.amount:g} {'s' if self.timed else 'images'}"

    def searchable(self, n: int, times: NDArray[np.float64] | None) -> NDArray[np.int64]:
        """For each image, count the images at the start of the drive that may be searched.

        Args:
            n: number of images in the drive.
            times: ``(n,)`` seconds, ascending. If it is None, one image per second is assumed. This
                is also the default of DLoopDetector.

        Returns:
            ``(n,)`` int64 numbers of images.
        """
        clock = np.arange(n, dtype=np.float64) if times is None or not self.timed else times
        # The times are rounded multiples of the frame interval, so that a tolerance is needed.
        return np.searchsorted(clock, clock - self.amount + 1e-6, side="right")


def parse_window(text: str) -> Window:
    """Parse the length of a window, such as ``20s`` (seconds) or ``200`` (images).

    Raises:
        InputError: the text does not have this form, or the number is not positive.
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
    """The decisions of a loop detector for N images: the match of each image, and its score.

    Attributes:
        match: ``(N,)`` int64 index of the matching image; -1 if there is no match.
        score: ``(N,)`` float64 score of the match; -inf if there is no match.
    """

    match: NDArray[np.int64]
    score: NDArray[np.float64]

    def __post_init__(self) -> None:
        if np.isnan(self.score).any():
            raise InputError("loops bench: a score is NaN; check the weights of the detector.")

    def only(self, accepted: NDArray[np.bool_]) -> Decisions:
        """Return the decisions, but remove each match at which the ``(N,)`` mask is False."""
        return Decisions(
            np.where(accepted, self.match, -1), np.where(accepted, self.score, -np.inf)
        )


def decide(scores: NDArray[np.float64], searchable: NDArray[np.int64]) -> Decisions:
    """For each image of a drive, find the most similar image that may be searched.

    Args:
        scores: ``(N, N)`` similarities of the images. Each row belongs to one query.
        searchable: ``(N,)`` number of images from the start of the drive that may be searched, for
            each image (`Window.searchable`).
    """
    match, score = np.full(len(scores), -1, np.int64), np.full(len(scores), -np.inf)
    for k in np.flatnonzero(searchable):
        match[k] = scores[k, : searchable[k]].argmax()
        score[k] = scores[k, match[k]]
    return Decisions(match, score)


@dataclass(frozen=True)
class Judged:
    """The decisions of a loop detector for N images, compared with the ground truth.

    Attributes:
        score: ``(N,)`` float64 score of the match; -inf if there is no match.
        right: ``(N,)`` bool, whether the match is marked as the same place.
        far: ``(N,)`` bool, whether the match shows another place. A match is neither right nor far
            if it was taken near the place of the query, but not near enough to be marked.
        answerable: ``(N,)`` bool, whether there is a marked image before the window, so that a
            right match is possible.
    """

    score: NDArray[np.float64]
    right: NDArray[np.bool_]
    far: NDArray[np.bool_]
    answerable: NDArray[np.bool_]

    @property
    def near(self) -> NDArray[np.bool_]:
        """``(N,)`` bool, whether a match was taken near the place but is not marked."""
        return np.isfinite(self.score) & ~self.right & ~self.far


def judge(
    decisions: Decisions, relation: NDArray[np.int8], searchable: NDArray[np.int64]
) -> Judged:
    """Compare the decisions of a loop detector for N images with the ground truth.

    Args:
        decisions: the decisions for N images.
        relation: ``(N, N)`` int8. 1 means that two images show the same place, -1 means another
            place, and pairs with 0 are unknown (`vslam.lab.loopbench.sets.QuerySet`).
        searchable: ``(N,)`` number of images from the start of the drive that may be searched, for
            each image (`Window.searchable`).

    Raises:
        InputError: no image has a marked image before its window.
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
    """Compute precision and recall over images, using each distinct score as a threshold.

    Args:
        near_is_wrong: whether a match counts as wrong if it was taken near the place of the query
            but is not marked as the same place. This is usual in the literature. If False, these
            matches are left out.
    """
    wrong = judged.far | (judged.near & near_is_wrong)
    counted = judged.right | wrong
    return curve_of(judged.right[counted], judged.score[counted], int(judged.answerable.sum()))
