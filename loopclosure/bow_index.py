"""The inverted index from words to keyframes of Galvez-Lopez and Tardos (T-RO 2012, IV).

The L1 score of two bags of words is the sum, over their shared words, of the smaller of the two
weights (vocabulary.py). So one pass over the postings of a query's words gives the number of shared
words and the score of every keyframe. For this, each posting also stores a weight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.kernels import kernel
from vslam.loopclosure.vocabulary import BowVector

FIRST_BLOCK = 8  # postings in the smallest block: one cache line
UNIT = 2**31 - 1  # weights are multiples of 1 / UNIT, so that sums are exact in any order
SHARED = 1 << 40  # one shared word, counted above the bits of a sum of weights


def grown(array: NDArray, needed: int) -> NDArray:
    """The array itself if it has room for ``needed`` items, else a copy that is larger by at least
    half."""
    if needed <= len(array):
        return array
    bigger = np.empty((max(needed, len(array) * 3 // 2), *array.shape[1:]), array.dtype)
    bigger[: len(array)] = array
    return bigger


class Likeness(NamedTuple):
    """Comparison of an image with each of K keyframes.

    Attributes:
        shared: ``(K,)`` number of shared words.
        score: ``(K,)`` L1 score in [0, 1].
    """

    shared: NDArray[np.int32]
    score: NDArray[np.float64]


class Postings(NamedTuple):
    """Inverted index of W words. The postings of a word are contiguous, in one block.

    A block has room for 8, 16, 32 ... postings. If the block of a word is full, its postings move
    to a block of twice the size, and the old block becomes free for other words.

    Attributes:
        start: ``(W,)`` index of the first posting of each word.
        size: ``(W,)`` number of postings of each word.
        free: ``(40,)`` first free block of each size, -1 for none; the first entry of a free block
            is the index of the next one.
        pool: ``(P,)`` postings, ``keyframe << 32 | weight``.
    """

    start: NDArray[np.int64]
    size: NDArray[np.int32]
    free: NDArray[np.int64]
    pool: NDArray[np.int64]


class InvertedIndex:
    """The keyframes that contain each word, and the weight of the word in each of them."""

    def __init__(self, n_words: int) -> None:
        self.n_keyframes = 0  # one more than the newest id
        self._postings = Postings(
            start=np.zeros(n_words, np.int64),
            size=np.zeros(n_words, np.int32),
            free=np.full(40, -1, np.int64),
            pool=np.empty(65536, np.int64),
        )
        self._used = 0  # entries of the pool that are in blocks

    def add(self, keyframe: int, bag: BowVector) -> None:
        """Add the bag of words of a keyframe that has not been added before."""
        size = self._postings.size[bag.words].astype(np.int64)
        growing = np.where(size == 0, FIRST_BLOCK, 2 * size)[is_full(size)]
        pool = grown(self._postings.pool, self._used + int(growing.sum()))
        self._postings = self._postings._replace(pool=pool)
        self._used = post(self._postings, self._used, keyframe, bag.words, fixed(bag.weights))
        self.n_keyframes = max(self.n_keyframes, keyframe + 1)

    def compare(self, bag: BowVector) -> Likeness:
        """Compare an image with all keyframes, from id 0 to the newest one."""
        sums = compare_with_all(self._postings, self.n_keyframes, bag.words, fixed(bag.weights))
        return Likeness((sums // SHARED).astype(np.int32), sums % SHARED / UNIT)


def fixed(weights: NDArray[np.float32]) -> NDArray[np.int64]:
    """Weights in [0, 1] as multiples of 1 / ``UNIT``."""
    return np.rint(weights.astype(np.float64) * UNIT).astype(np.int64)


def is_full(size):
    """Whether the block of a word with ``size`` postings is full; ``size`` may be an array. The
    condition is the same as in ``post``."""
    return (size & (size - 1) == 0) & ((size == 0) | (size >= FIRST_BLOCK))


@kernel
def post(postings, used, keyframe, words, weights):
    """Add the bag of words of a keyframe to the inverted index.

    The pool must have room for a new block for each word whose block is full.

    Args:
        used: number of entries of the pool that are in blocks.

    Returns:
        The new value of ``used``.
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
    """``(K,)`` int64, for each keyframe ``SHARED`` times the number of shared words plus the sum of
    the smaller weights. Both are accumulated in one integer, so a posting costs one addition."""
    start, sizes, _, pool = postings
    sums = np.zeros(n_keyframes, np.int64)
    for i in range(len(words)):
        first = start[words[i]]
        for j in range(first, first + sizes[words[i]]):
            posting = pool[j]
            sums[posting >> 32] += SHARED + min(weights[i], posting & 0xFFFFFFFF)
    return sums
