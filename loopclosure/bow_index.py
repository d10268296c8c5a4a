"""Which keyframes have a word: the inverted index of Galvez-Lopez and Tardos (T-RO 2012, IV).

The L1 score of two bags is the sum of the lesser weights of the words they share (vocabulary.py).
So one pass over the postings of a query's words gives the shared words and the score of *every*
keyframe at once. The price is a weight in each posting; the gain is work that does not depend on
how many keyframes are to be scored.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.kernels import kernel
from vslam.loopclosure.vocabulary import BowVector

FIRST_BLOCK = 8  # postings: one cache line
UNIT = 2**31 - 1  # weights are whole multiples of 1 / UNIT: sums are exact in any order
SHARED = 1 << 40  # counts shared words above the bits of a sum of weights


def grown(array: NDArray, needed: int) -> NDArray:
    """The array itself if it has room for ``needed``, else a copy greater by half at least."""
    if needed <= len(array):
        return array
    bigger = np.empty((max(needed, len(array) * 3 // 2), *array.shape[1:]), array.dtype)
    bigger[: len(array)] = array
    return bigger


class Likeness(NamedTuple):
    """An image against each keyframe: ``shared`` (K,) i4 words; ``score`` (K,) f8 in [0, 1]."""

    shared: NDArray[np.int32]
    score: NDArray[np.float64]


class Postings(NamedTuple):
    """Inverted index of W words: those of a word lie in one block, read as one stream.

    A block has room for 8, 16, 32 ... postings. A word that outgrows its block moves to one of
    twice the size and leaves the old one to other words.

    ``start`` (W,) i8 first posting of each word; ``size`` (W,) i4; ``free`` (40,) i8 first
    free block of each size, -1 for none, whose first entry names the next; ``pool`` (P,) i8
    postings, ``keyframe << 32 | weight``.
    """

    start: NDArray[np.int64]
    size: NDArray[np.int32]
    free: NDArray[np.int64]
    pool: NDArray[np.int64]


class InvertedIndex:
    """The keyframes of each word, with the weight that the word has there."""

    def __init__(self, n_words: int) -> None:
        self.n_keyframes = 0  # one more than the newest id
        self._postings = Postings(
            start=np.zeros(n_words, np.int64),
            size=np.zeros(n_words, np.int32),
            free=np.full(40, -1, np.int64),
            pool=np.empty(65536, np.int64),
        )
        self._used = 0  # of the pool

    def add(self, keyframe: int, bag: BowVector) -> None:
        """Remember the bag of a keyframe that has none yet."""
        size = self._postings.size[bag.words].astype(np.int64)
        growing = np.where(size == 0, FIRST_BLOCK, 2 * size)[is_full(size)]
        pool = grown(self._postings.pool, self._used + int(growing.sum()))
        self._postings = self._postings._replace(pool=pool)
        self._used = post(self._postings, self._used, keyframe, bag.words, fixed(bag.weights))
        self.n_keyframes = max(self.n_keyframes, keyframe + 1)

    def compare(self, bag: BowVector) -> Likeness:
        """Shared words and score of an image with every keyframe id up to the newest."""
        sums = compare_with_all(self._postings, self.n_keyframes, bag.words, fixed(bag.weights))
        return Likeness((sums // SHARED).astype(np.int32), sums % SHARED / UNIT)


def fixed(weights: NDArray[np.float32]) -> NDArray[np.int64]:
    """Weights of a bag, in [0, 1], in whole units."""
    return np.rint(weights.astype(np.float64) * UNIT).astype(np.int64)


def is_full(size):
    """Whether a block with so many postings, or each of an array, has no room (as in ``post``)."""
    return (size & (size - 1) == 0) & ((size == 0) | (size >= FIRST_BLOCK))


@kernel
def post(postings, used, keyframe, words, weights):
    """Add a keyframe's bag to the inverted index; returns how much of the pool is in use.

    The pool must have room for a new block of each word whose block is full.
    """
    start, sizes, free, pool = postings
    for i in range(len(words)):
        word = words[i]
        n = np.int64(sizes[word])
        if n == 0 or (n >= FIRST_BLOCK and n & (n - 1) == 0):  # full
            kind, room = 0, FIRST_BLOCK  # room = FIRST_BLOCK * 2^kind
            while room <= n:
                kind += 1
                room *= 2
            block = free[kind]
            if block >= 0:
                free[kind] = pool[block]
            else:
                block = used
                used += room
            for j in range(n):
                pool[block + j] = pool[start[word] + j]
            if n > 0:
                pool[start[word]] = free[kind - 1]
                free[kind - 1] = start[word]
            start[word] = block
        pool[start[word] + n] = keyframe << 32 | weights[i]
        sizes[word] = n + 1
    return used


@kernel
def compare_with_all(postings, n_keyframes, words, weights):
    """For each keyframe ``SHARED`` times the words in common, plus the sum of lesser weights.

    One sum for both: a posting costs one addition. Returns ``(K,)`` int64.
    """
    start, sizes, _, pool = postings
    sums = np.zeros(n_keyframes, np.int64)
    for i in range(len(words)):
        first = start[words[i]]
        for j in range(first, first + sizes[words[i]]):
            posting = pool[j]
            sums[posting >> 32] += SHARED + min(weights[i], posting & 0xFFFFFFFF)
    return sums
