"""Loop detection by bag of words: inverted index, direct index and choice of candidates.

The indices are those of Galvez-Lopez and Tardos (T-RO 2012, section IV); candidates are chosen as
in ORB-SLAM (Mur-Artal et al., T-RO 2015, sections III-E and VII-A): by shared words, by likeness
compared with the query's own neighbours, and by groups of covisible keyframes.

The L1 score of two bags is the sum of the lesser weights of the words they share (vocabulary.py).
So one pass over the postings of the query's words gives the shared words and the score of *every*
keyframe at once: those of its neighbours, which set the bar, and those of all candidates. The
price is a weight in each posting; the gain is work that does not depend on the number of
candidates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.config import BowConfig
from vslam.features import Features
from vslam.kernels import hamming, inner_kernel, kernel
from vslam.loopclosure.vocabulary import BowVector, Vocabulary, bow_vector
from vslam.loops import LoopCandidate
from vslam.map import Map
from vslam.observations import count_shared

FIRST_BLOCK = 8  # postings: one cache line
UNIT = 2**31 - 1  # weights are whole multiples of 1 / UNIT: sums are exact in any order
SHARED = 1 << 40  # counts shared words above the bits of a sum of weights


class NodeIndex(NamedTuple):
    """Direct index of an image: its features by the node of the tree under which their words lie.

    ``node`` (N,) i4 ascending; ``feature`` (N,) i4, index within the image.
    """

    node: NDArray[np.int32]
    feature: NDArray[np.int32]


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


class BowDetector:
    """Remembers the words of keyframes. See ``LoopDetector``; ids must come in ascending order."""

    name = "bow"

    def __init__(self, vocabulary: Vocabulary, config: BowConfig | None = None) -> None:
        self.vocabulary = vocabulary
        self.config = config or BowConfig()
        self._node_of_word = vocabulary.ancestors(self.config.direct_level)
        n = vocabulary.n_words
        self._postings = Postings(
            np.zeros(n, np.int64),
            np.zeros(n, np.int32),
            np.full(40, -1, np.int64),
            np.empty(65536, np.int64),
        )
        self._used = 0  # of the pool
        # Features of all keyframes, sorted by node within each: those of keyframe k are entries
        # start[k] to start[k + 1]. Keyframes that were never added have none.
        self._start = np.zeros(65, np.int64)
        self._feature = np.empty(65536, np.int32)
        self._word = np.empty(65536, np.int32)
        self._n_keyframes = 0  # one more than the newest id

    def add(self, keyframe: int, image: NDArray[np.uint8] | None, features: Features) -> None:
        """Remember the words of a keyframe; the image is not looked at.

        Raises:
            ValueError: the id is not greater than those before.
        """
        if keyframe < self._n_keyframes:
            raise ValueError(f"keyframe {keyframe} comes after {self._n_keyframes - 1}")
        words = self.vocabulary.words(features.descriptors)
        self._index_features(keyframe, words)
        bag = bow_vector(self.vocabulary, words)
        count = self._postings.size[bag.words].astype(np.int64)
        growing = np.where(count == 0, FIRST_BLOCK, 2 * count)[is_full(count)]
        needed, pool = self._used + int(growing.sum()), self._postings.pool
        if needed > len(pool):
            pool = _grown(pool, max(needed, len(pool) * 3 // 2))
            self._postings = self._postings._replace(pool=pool)
        self._used = post(self._postings, self._used, keyframe, bag.words, fixed(bag.weights))

    def query(self, keyframe: int, map_: Map) -> list[LoopCandidate]:
        """Living keyframes, not recent and not covisible, that look like a keyframe added before.

        Without a covisible neighbour that sets the least score, every score will do.
        """
        config = self.config
        entries = self._entries(keyframe)
        likeness = self.compare(bow_vector(self.vocabulary, self._word[entries]))
        n = len(likeness.score)
        eligible = map_.arrays.keyframe_alive[:n].copy()
        eligible[max(0, keyframe + 1 - config.exclude_recent) :] = False
        eligible[keyframe:] = False
        covisible, _ = map_.covisible(keyframe, config.min_shared)
        covisible = covisible[(covisible < n) & (covisible != keyframe)]
        eligible[covisible] = False
        known = covisible[np.diff(self._start[: n + 1])[covisible] > 0]
        least = float(likeness.score[known].min()) if len(known) else 0.0
        return self._candidates(keyframe, likeness, eligible, least, map_)

    def locate(
        self, image: NDArray[np.uint8] | None, features: Features, map_: Map
    ) -> list[LoopCandidate]:
        """Living keyframes that look like a frame outside the map, best first."""
        words = self.vocabulary.words(features.descriptors)
        likeness = self.compare(bow_vector(self.vocabulary, words))
        eligible = map_.arrays.keyframe_alive[: len(likeness.score)].copy()
        return self._candidates(-1, likeness, eligible, 0.0, map_)

    def compare(self, bag: BowVector) -> Likeness:
        """Shared words and score of an image with every keyframe id up to the newest."""
        sums = compare_with_all(self._postings, self._n_keyframes, bag.words, fixed(bag.weights))
        return Likeness((sums // SHARED).astype(np.int32), sums % SHARED / UNIT)

    def node_index(self, keyframe: int) -> NodeIndex:
        """Direct index of a keyframe added before."""
        entries = self._entries(keyframe)
        return NodeIndex(self._node_of_word[self._word[entries]], self._feature[entries])

    def node_index_of(self, features: Features) -> NodeIndex:
        """Direct index of a frame outside the map."""
        node = self._node_of_word[self.vocabulary.words(features.descriptors)]
        order = np.argsort(node, kind="stable").astype(np.int32)
        return NodeIndex(node[order], order)

    def _index_features(self, keyframe: int, words: NDArray[np.int32]) -> None:
        first = int(self._start[self._n_keyframes])
        last = first + len(words)
        if keyframe + 2 > len(self._start):
            self._start = _grown(self._start, max(keyframe + 2, len(self._start) * 3 // 2))
        if last > len(self._word):
            capacity = max(last, len(self._word) * 3 // 2)
            self._word = _grown(self._word, capacity)
            self._feature = _grown(self._feature, capacity)
        order = np.argsort(self._node_of_word[words], kind="stable")
        self._feature[first:last], self._word[first:last] = order, words[order]
        self._start[self._n_keyframes : keyframe + 1] = first
        self._start[keyframe + 1] = last
        self._n_keyframes = keyframe + 1

    def _entries(self, keyframe: int) -> slice:
        if not 0 <= keyframe < self._n_keyframes:
            raise ValueError(f"keyframe {keyframe} has not been added")
        return slice(int(self._start[keyframe]), int(self._start[keyframe + 1]))

    def _candidates(
        self,
        query: int,
        likeness: Likeness,
        eligible: NDArray[np.bool_],
        least_score: float,
        map_: Map,
    ) -> list[LoopCandidate]:
        config = self.config
        chosen = choose_candidates(
            map_.arrays,
            map_.n_keyframes,
            likeness.shared,
            likeness.score,
            eligible,
            least_score,
            config.common_words_ratio,
            config.group_size,
            config.min_shared,
            config.group_score_ratio,
            config.max_groups,
        )
        return [LoopCandidate(query, k, float(likeness.score[k])) for k in chosen.tolist()]


def _grown(array: NDArray, capacity: int) -> NDArray:
    bigger = np.empty((capacity, *array.shape[1:]), array.dtype)
    bigger[: len(array)] = array
    return bigger


def fixed(weights: NDArray[np.float32]) -> NDArray[np.int64]:
    """Weights of a bag, in [0, 1], in whole units."""
    return np.rint(weights.astype(np.float64) * UNIT).astype(np.int64)


def is_full(count: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether blocks with so many postings have no room, ``(N,)`` bool: as ``post`` fills them."""
    return (count & (count - 1) == 0) & ((count == 0) | (count >= FIRST_BLOCK))


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


@inner_kernel
def most_covisible(counts, minimum, keyframes, strength):
    """Fill ``keyframes`` and ``strength``, ``(G,)`` int64, with those of the greatest counts.

    Greatest first, the lower id first of equals, none below ``minimum``. Returns how many.
    """
    n = 0
    for k in range(len(counts)):
        count = counts[k]
        if count < minimum or (n == len(keyframes) and (n == 0 or count <= strength[n - 1])):
            continue
        i = n if n < len(keyframes) else n - 1
        while i > 0 and strength[i - 1] < count:
            keyframes[i], strength[i] = keyframes[i - 1], strength[i - 1]
            i -= 1
        keyframes[i], strength[i] = k, count
        n = min(n + 1, len(keyframes))
    return n


@kernel
def choose_candidates(
    a,
    n_keyframes,
    shared,
    score,
    eligible,
    least_score,
    common_words_ratio,
    group_size,
    min_shared,
    group_score_ratio,
    max_groups,
):
    """Candidates by shared words, score and groups, each once, best group first.

    1. Those that share more than ``common_words_ratio`` of the most words that any shares, with
       at least ``least_score``; of these the ``max_groups`` best.
    2. Each gathers those of its ``group_size`` best covisible keyframes that also pass the first
       test of 1; the group has the sum of their scores and stands for its best keyframe.
    3. Groups with ``group_score_ratio`` of the best group's score.

    Args:
        a, n_keyframes: of the map.
        shared, score, eligible: ``(K,)``, K at most ``n_keyframes``.

    Returns:
        ``(n,)`` int64 keyframes.
    """
    n = len(shared)
    most = 0
    for k in range(n):
        if eligible[k]:
            most = max(most, shared[k])
    passed = np.zeros(n, np.bool_)
    rank = np.full(n, -1.0)
    for k in range(n):
        if eligible[k] and shared[k] > 0 and shared[k] >= common_words_ratio * most:
            passed[k] = True
            if score[k] >= least_score:
                rank[k] = score[k]
    representative = np.empty(max_groups, np.int64)
    group_score = np.empty(max_groups)
    covisible, strength = np.empty(group_size, np.int64), np.empty(group_size, np.int64)
    groups, best_group = 0, 0.0
    while groups < max_groups and n > 0:
        member = int(np.argmax(rank))
        if rank[member] < 0.0:
            break
        rank[member] = -1.0
        n_covisible = most_covisible(
            count_shared(a, member, n_keyframes), min_shared, covisible, strength
        )
        total, best = score[member], member
        for i in range(n_covisible):
            neighbour = covisible[i]
            if neighbour < n and passed[neighbour]:
                total += score[neighbour]
                if score[neighbour] > score[best]:
                    best = neighbour
        representative[groups] = best
        group_score[groups] = total
        groups += 1
        best_group = max(best_group, total)
    chosen = np.empty(groups, np.int64)
    taken = np.zeros(n, np.bool_)
    m = 0
    for _ in range(groups):
        g = int(np.argmax(group_score[:groups]))
        if group_score[g] < group_score_ratio * best_group:
            break
        group_score[g] = -1.0
        if not taken[representative[g]]:
            taken[representative[g]] = True
            chosen[m] = representative[g]
            m += 1
    return chosen[:m].copy()


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
