"""Which keyframes have a word, and which features of an image lie under a node of the tree.

The inverted and the direct index of Galvez-Lopez and Tardos (T-RO 2012, section IV).

The L1 score of two bags is the sum of the lesser weights of the words they share (vocabulary.py).
So one pass over the postings of a query's words gives the shared words and the score of *every*
keyframe at once. The price is a weight in each posting; the gain is work that does not depend on
how many keyframes are to be scored.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.kernels import hamming, kernel
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


# -- inverted index -------------------------------------------------------------------------------


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


# -- direct index ---------------------------------------------------------------------------------


class NodeIndex(NamedTuple):
    """Direct index of an image: its features by the node of the tree under which their words lie.

    ``node`` (N,) i4 ascending; ``feature`` (N,) i4, index within the image.
    """

    node: NDArray[np.int32]
    feature: NDArray[np.int32]


def index_nodes(node: NDArray[np.int32]) -> NodeIndex:
    """Direct index of an image whose features lie under the nodes ``(N,)``."""
    order = np.argsort(node, kind="stable").astype(np.int32)
    return NodeIndex(node[order], order)


@kernel
def match_by_node(
    node_a,
    feature_a,
    descriptors_a,
    use_a,
    node_b,
    feature_b,
    descriptors_b,
    use_b,
    max_distance,
    ratio,
):
    """Match features of two images whose words lie under the same node of the vocabulary.

    Args:
        node_a, feature_a: direct index of image a (``NodeIndex``); likewise b.
        descriptors_a, descriptors_b: ``(M, 4)`` and ``(N, 4)`` uint64, of all features.
        use_a, use_b: ``(M,)`` and ``(N,)`` bool, features that may be matched.
        max_distance: bits; ratio: best over second best under the node (1 switches it off).

    Returns:
        ``(M,)`` int32 feature of b or -1, none twice (the closest keeps it).
    """
    matches = np.full(len(descriptors_a), -1, np.int32)
    distances = np.full(len(descriptors_a), 257, np.int64)
    owner = np.full(len(descriptors_b), -1, np.int64)
    first, n_a, n_b = 0, len(node_a), len(node_b)
    for i in range(n_a):
        while first < n_b and node_b[first] < node_a[i]:
            first += 1
        feature = feature_a[i]
        if not use_a[feature]:
            continue
        best, least, second = -1, 257, 257
        j = first
        while j < n_b and node_b[j] == node_a[i]:
            other = feature_b[j]
            j += 1
            if not use_b[other]:
                continue
            distance = hamming(descriptors_a[feature], descriptors_b[other])
            if distance < least:
                second = least
                best, least = other, distance
            elif distance < second:
                second = distance
        if best < 0 or least > max_distance or least > ratio * second:
            continue
        previous = owner[best]
        if previous >= 0:
            if distances[previous] <= least:
                continue
            matches[previous] = -1
        owner[best] = feature
        matches[feature], distances[feature] = best, least
    return matches
