"""An incremental bag of binary words, whose vocabulary grows during the drive without training.

This follows iBoW-LCD (Garcia-Fidalgo and Ortiz, RA-L 2018), section III. A descriptor that is
clearly nearest to one word is merged into it by bitwise AND; any other becomes a new word. Words
that no further image sees are dropped. An inverted index scores images by tf-idf; neighbouring
images with high scores form islands, and the best island gives the decision. All detectors here use
the same features. There are two differences: the threshold applies to the tf-idf score instead of
the number of inliers, which verification counts; and the island of the previous image has priority
even if it was not verified.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.kernels import kernel
from vslam.lab.loopbench.detectors import DescribedImage
from vslam.lab.loopbench.online import Detection
from vslam.lab.loopbench.word_trees import empty_trees, insert, nearest_two, remove

_RATIO = 0.8  # of the distances to the nearest and second nearest word (section III)
_SEEN = 2  # a word is kept if this many images, including its first,
_AFTER = 2  # have seen it this many images later (both as in the authors' libraries)
_MIN_SCORE = 0.3  # lowest score in an island, after scaling the scores of a query to 0..1
_REACH = 3  # images to either side: islands of 7 (default of the authors' library)


class Island(NamedTuple):
    """Images ``first`` to ``last``, their mean ``score``, and the ``best`` image."""

    first: int
    last: int
    best: int
    score: float


class IncrementalBow:
    """Words and images of one drive; see the module's docstring."""

    name = "ibow"

    def __init__(self) -> None:
        self._trees = empty_trees()
        self._last: Island | None = None
        self._sizes: list[int] = []
        self._young: list[NDArray[np.int32]] = []  # words of the last images
        self._free = np.empty(0, np.int32)
        self._n_numbers = 0
        # For each word: the number of images that saw it, and its latest posting. For each posting:
        # its image and the previous posting.
        self._seen = np.zeros(0, np.int32)
        self._latest = np.zeros(0, np.int32)
        self._posted = np.empty(0, np.int32)
        self._before = np.empty(0, np.int32)
        self._n_postings = 0

    @property
    def n_words(self) -> int:
        """Number of words in the vocabulary."""
        return self._n_numbers - len(self._free)

    def add(self, image: DescribedImage) -> None:
        """See :class:`vslam.lab.loopbench.online.OnlineDetector`."""
        descriptors = np.ascontiguousarray(image.descriptors).view(np.uint64)
        word = self._matched(descriptors)
        known = word >= 0
        np.bitwise_and.at(self._trees.words, word[known], descriptors[known])
        made = self._numbers(int((~known).sum()))
        word[~known] = made
        self._trees = insert(self._trees, made, descriptors[~known])
        self._post(np.unique(word), len(self._sizes))
        self._sizes.append(len(descriptors))
        self._young.append(made)
        if len(self._young) > _AFTER:
            judged = self._young.pop(0)
            dropped = judged[self._seen[judged] < _SEEN]
            remove(self._trees, dropped)
            self._free = np.concatenate([self._free, dropped])

    def find(self, image: DescribedImage) -> Detection | None:
        """See :class:`vslam.lab.loopbench.online.OnlineDetector`."""
        score = self.scores(image)
        found = islands(score)
        if not found:
            self._last = None
            return None
        before = self._last
        close = [
            island for island in found
            if before and island.first <= before.last and before.first <= island.last
        ]  # fmt: skip
        self._last = max(close or found, key=lambda island: island.score)
        return Detection(self._last.best, float(score[self._last.best]))

    def scores(self, image: DescribedImage) -> NDArray[np.float64]:
        """``(G,)`` tf-idf scores over the words that the image shares with each added image."""
        score = np.zeros(len(self._sizes))
        word = self._matched(np.ascontiguousarray(image.descriptors).view(np.uint64))
        word, count = np.unique(word[word >= 0], return_counts=True)
        if len(word):
            weight = count / len(image.descriptors) * np.log(len(score) / self._seen[word])
            _add_weights(score, word, weight, self._latest, self._posted, self._before)
        return score

    def _matched(self, descriptors: NDArray[np.uint64]) -> NDArray[np.int32]:
        """The word to which each descriptor is clearly nearest, or -1."""
        word, bits = nearest_two(self._trees, descriptors)
        return np.where(bits[:, 0] < _RATIO * bits[:, 1], word, -1).astype(np.int32)

    def _numbers(self, n: int) -> NDArray[np.int32]:
        """Numbers for ``n`` words; the numbers of dropped words are used first."""
        again, self._free = np.split(self._free, [min(n, len(self._free))])
        more = self._n_numbers + np.arange(n - len(again), dtype=np.int32)
        self._n_numbers += len(more)
        if self._n_numbers > len(self._seen):
            room = np.zeros(self._n_numbers, np.int32)
            self._seen = np.concatenate([self._seen, room])
            self._latest = np.concatenate([self._latest, room])
        made = np.concatenate([again, more])
        self._seen[made], self._latest[made] = 0, -1
        return made

    def _post(self, word: NDArray[np.int32], image: int) -> None:
        n = self._n_postings + len(word)
        if n > len(self._posted):
            room = np.empty(n, np.int32)
            self._posted = np.concatenate([self._posted, room])
            self._before = np.concatenate([self._before, room])
        self._posted[self._n_postings : n] = image
        self._before[self._n_postings : n] = self._latest[word]
        self._latest[word] = np.arange(self._n_postings, n, dtype=np.int32)
        self._seen[word] += 1
        self._n_postings = n


def islands(score: NDArray[np.float64]) -> list[Island]:
    """Group similar neighbouring images into islands, from the best image down (section III).

    The scores ``(G,)`` of one query are scaled to 0..1. Each image with a score of at least 0.3
    joins an island or starts a new one of up to seven images. The score of an island is the mean
    over its images, in which scores below 0.3 count as 0.
    """
    if not len(score) or score.max() <= score.min():
        return []
    stretched = (score - score.min()) / (score.max() - score.min())
    found: list[Island] = []
    for k in np.argsort(-stretched, kind="stable")[: int((stretched >= _MIN_SCORE).sum())]:
        image, value = int(k), float(stretched[k])
        home = next((n for n, i in enumerate(found) if i.first <= image <= i.last), None)
        if home is not None:
            found[home] = found[home]._replace(score=found[home].score + value)
            continue
        first = max([image - _REACH, 0, *(i.last + 1 for i in found if i.last < image)])
        last = min(
            [image + _REACH, len(score) - 1, *(i.first - 1 for i in found if i.first > image)]
        )
        found.append(Island(first, last, image, value))
    return [i._replace(score=i.score / (i.last - i.first + 1)) for i in found]


@kernel
def _add_weights(score, word, weight, latest, posted, before):
    """Add the weight of each word to every image in its postings."""
    for k in range(len(word)):
        posting = latest[word[k]]
        while posting >= 0:
            score[posted[posting]] += weight[k]
            posting = before[posting]
