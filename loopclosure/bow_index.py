"""Inverted index from visual words to keyframes (Galvez-Lopez and Tardos, T-RO 2012, section IV).

The index stores one entry, called a posting, for each word of each keyframe. A posting contains the
id of the keyframe and the weight of the word in the keyframe.

The L1 score of two bags of words is a sum over their shared words. Each shared word contributes the
smaller of its two weights. Therefore, a single pass over the postings of the query's words gives
the scores of all keyframes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.loopclosure.vocabulary import BowVector
from vslam.support.kernels import kernel

FIRST_BLOCK = 8  # postings in the smallest block: one cache line
UNIT = 2**31 - 1  # weights are multiples of 1 / UNIT, so that the order of sums does not matter
SHARED = 1 << 40  # added for each shared word; larger than any sum of weights


def grown(array: NDArray, needed: int) -> NDArray:
    """Return an array with room for at least ``needed`` items: the given array if it is long
    enough, or else a longer copy."""
    if needed <= len(array):
        return array
    bigger = np.empty((max(needed, len(array) * 3 // 2), *array.shape[1:]), array.dtype)
    bigger[: len(array)] = array
    return bigger


class Likeness(NamedTuple):
    """Comparison of an image with each of K keyframes.

    Attributes:
        shared: ``(K,)`` number of words that the image shares with each keyframe.
        score: ``(K,)`` L1 score in [0, 1].
    """

    shared: NDArray[np.int32]
    score: NDArray[np.float64]


class Postings(NamedTuple):
    """Inverted index of W words. A posting records that a keyframe contains a word.

    The postings of a word lie in one block of memory. The size of a block is 8, 16, 32 or a higher
    power of two. When the block of a word is full, its postings are moved to a block of twice the
    size. The old block can then be reused for other words.

    Attributes:
        start: ``(W,)`` index of the first posting of each word.
        size: ``(W,)`` number of postings of each word.
        free: ``(40,)`` head of a linked list of the free blocks of each size, or -1 if the list is
            empty. The first entry of a free block is the index of the next free block.
        pool: ``(P,)`` postings. Each posting is ``keyframe << 32 | weight``.
    """

    start: NDArray[np.int64]
    size: NDArray[np.int32]
    free: NDArray[np.int64]
    pool: NDArray[np.int64]


class InvertedIndex:
    """Stores which keyframes contain each visual word, and the weight of each word in each
    keyframe."""

    def __init__(self, n_words: int) -> None:
        self.n_keyframes = 0  # newest id + 1
        self._postings = Postings(
            start=np.zeros(n_words, np.int64),
            size=np.zeros(n_words, np.int32),
            free=np.full(40, -1, np.int64),
            pool=np.empty(65536, np.int64),
        )
        self._used = 0  # entries of the pool that are in blocks

    def add(self, keyframe: int, bag: BowVector) -> None:
        size = self._postings.size[bag.words].astype(np.int64)
        growing = np.where(size == 0, FIRST_BLOCK, 2 * size)[is_full(size)]
        pool = grown(self._postings.pool, self._used + int(growing.sum()))
        self._postings = self._postings._replace(pool=pool)
        self._used = post(self._postings, self._used, keyframe, bag.words, fixed(bag.weights))
        self.n_keyframes = max(self.n_keyframes, keyframe + 1)

    def compare(self, bag: BowVector) -> Likeness:
        """Compare an image with all keyframes, from id 0 to the newest id."""
        sums = compare_with_all(self._postings, self.n_keyframes, bag.words, fixed(bag.weights))
        return Likeness((sums // SHARED).astype(np.int32), sums % SHARED / UNIT)


def fixed(weights: NDArray[np.float32]) -> NDArray[np.int64]:
    """Convert weights in [0, 1] to integer multiples of 1 / ``UNIT``."""
    return np.rint(weights.astype(np.float64) * UNIT).astype(np.int64)


def is_full(size):
    """Return whether the block of a word with ``size`` postings is full. ``size`` may be an array.

    The condition must be the same as in ``post``.
    """
    return (size & (size - 1) == 0) & ((size == 0) | (size >= FIRST_BLOCK))


@kernel
def post(postings, used, keyframe, words, weights):
    """Add the bag of words of a keyframe to the inverted index.

    The pool must have room for one new block for each word whose block is full.

    Args:
        words: ``(n,)`` int32 words.
        weights: ``(n,)`` int64 weights of the words, in units of 1 / ``UNIT``.
        used: number of entries of the pool that belong to blocks.

    Returns:
        The new value of ``used``.
    """
    start, sizes, free, pool = postings
    for i in range(len(words)):
        word = words[i]
        n = np.int64(sizes[word])
        if n == 0 or (n >= FIRST_BLOCK and n & (n - 1) == 0):  # the block is full
            exponent, capacity = 0, FIRST_BLOCK  # capacity = FIRST_BLOCK * 2^exponent
            while capacity <= n:
                exponent += 1
                capacity *= 2
            block = free[exponent]
            if block >= 0:
                free[exponent] = pool[block]
            else:
                block = used
                used += capacity
            for j in range(n):
                pool[block + j] = pool[start[word] + j]
            if n > 0:
                pool[start[word]] = free[exponent - 1]
                free[exponent - 1] = start[word]
            start[word] = block
        pool[start[word] + n] = keyframe << 32 | weights[i]
        sizes[word] = n + 1
    return used


@kernel
def compare_with_all(postings, n_keyframes, words, weights):
    """Compare the bag of words of an image with the bags of all keyframes.

    Args:
        words: ``(n,)`` int32 words.
        weights: ``(n,)`` int64 weights of the words, in units of 1 / ``UNIT``.

    Returns:
        ``(K,)`` int64: for each keyframe, the number of shared words times ``SHARED``, plus the sum
        of the smaller weight of each shared word. Both quantities are stored in one integer, so
        that each posting needs only one addition.
    """
    start, sizes, _, pool = postings
    sums = np.zeros(n_keyframes, np.int64)
    for i in range(len(words)):
        first = start[words[i]]
        for j in range(first, first + sizes[words[i]]):
            posting = pool[j]
            sums[posting >> 32] += SHARED + min(weights[i], posting & 0xFFFFFFFF)
    return sums
