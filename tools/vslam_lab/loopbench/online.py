"""Evaluates loop detectors with one decision per image of a drive, as is usual in the literature.

The images are processed in driving order. Each image is compared with all earlier images, except
the images in a window just before it. The most similar image is the match of this image. The match
is accepted if its score reaches a threshold.

The ground truth says for each pair of images whether both show the same place. The metrics are
defined as follows:

- A match is *right* if both images show the same place according to the ground truth. Otherwise,
  the match is *wrong*.
- Precision is right / (right + wrong). Only matches whose score reaches the threshold are counted.
- Recall is right / answerable. An image is *answerable* if an image before its window shows the
  same place.

Recall at 100 % precision is the highest recall over all thresholds at which no match is wrong
(Cummins and Newman, IJRR 2008; Galvez-Lopez and Tardos, T-RO 2012; Garcia-Fidalgo and Ortiz, RA-L
2018; An et al., IROS 2019). If geometric verification rejects a match, the image has no match at
any threshold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.support.errors import InputError
from vslam_lab.precision_recall import PrecisionRecall, curve_of
from vslam_lab.sources.image_source import DIFFERENT, SAME


@dataclass(frozen=True)
class Window:
    """The images just before a query image, which are not compared with the query.

    Attributes:
        amount: length of the window, in images or in seconds.
        timed: whether ``amount`` is in seconds.
    """

    amount: float
    timed: bool

    def __str__(self) -> str:
        return f"{self.amount:g} {'s' if self.timed else 'images'}"

    def searchable(self, n: int, times: NDArray[np.float64] | None) -> NDArray[np.int64]:
        """For each image of a drive, count the images before its window.

        Args:
            n: number of images in the drive.
            times: ``(n,)`` times of the images in seconds, ascending. If it is None, one image per
                second is assumed, as in DLoopDetector.

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
        """Return the decisions without the matches at which the ``(N,)`` bool mask is False."""
        return Decisions(
            np.where(accepted, self.match, -1), np.where(accepted, self.score, -np.inf)
        )


def decide(scores: NDArray[np.float64], searchable: NDArray[np.int64]) -> Decisions:
    """For each image of a drive, find the most similar image before its window.

    Args:
        scores: ``(N, N)`` similarities of the images. Each row belongs to one query image.
        searchable: ``(N,)`` number of images before the window of each image (`Window.searchable`).
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
        right: ``(N,)`` bool, whether the match shows the same place as the image.
        far: ``(N,)`` bool, whether the match shows another place. A match is neither right nor far
            if it was taken near the image, but not near enough to count as the same place.
        answerable: ``(N,)`` bool, whether an image before the window shows the same place.
    """

    score: NDArray[np.float64]
    right: NDArray[np.bool_]
    far: NDArray[np.bool_]
    answerable: NDArray[np.bool_]

    @property
    def near(self) -> NDArray[np.bool_]:
        """Whether the match was taken near the image, but not at the same place; ``(N,)`` bool."""
        return np.isfinite(self.score) & ~self.right & ~self.far


def judge(
    decisions: Decisions, relation: NDArray[np.int8], searchable: NDArray[np.int64]
) -> Judged:
    """Compare the decisions of a loop detector for N images with the ground truth.

    Args:
        relation: ``(N, N)`` int8. For each pair of images, 1 means that both show the same place,
            -1 means that they show different places, and 0 means that it is unknown.
        searchable: ``(N,)`` number of images before the window of each image (`Window.searchable`).

    Raises:
        InputError: no image shows the same place as an image before its window.
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
    """Compute precision and recall for N images, using each distinct score as a threshold.

    Args:
        near_is_wrong: whether near matches count as wrong, as is usual in the literature. A near
            match was taken near the query, but the ground truth does not mark it as the same place.
            If False, near matches are left out.
    """
    wrong = judged.far | (judged.near & near_is_wrong)
    counted = judged.right | wrong
    return curve_of(judged.right[counted], judged.score[counted], int(judged.answerable.sum()))
