"""Detects loops by comparing bags of visual words.

Loop candidates are chosen as in ORB-SLAM (Mur-Artal et al., T-RO 2015, sections III-E and VII-A).
Each candidate meets three conditions. It shares many visual words with the query. It belongs to one
of the groups of covisible keyframes with the highest total scores. Its score is at least the lowest
score among the keyframes that are covisible with the query. A single pass over the inverted index
gives the scores of all keyframes.
"""

from __future__ import annotations

from functools import cached_property
from hashlib import sha256

import numpy as np
from numpy.typing import NDArray

from vslam.config import BowConfig
from vslam.loopclosure.bow_index import InvertedIndex, Likeness, grown
from vslam.loopclosure.detector import require_same
from vslam.loopclosure.vocabulary import Vocabulary, bow_vector
from vslam.support.kernels import inner_kernel, kernel
from vslam.types.features import Features
from vslam.types.loops import DetectorMemory, LoopCandidate, PerKeyframe
from vslam.types.map import Map
from vslam.types.map_kernels import count_shared

# The number of words that a candidate shares with the query must be at least this fraction of the
# largest number that any keyframe shares with the query. [OS1 III-E, customary]
_COMMON_WORDS_RATIO = 0.8
# A group is kept if its score is at least this fraction of the score of the best group. [OS1
# III-E, printed]
_GROUP_SCORE_RATIO = 0.75
# Two keyframes are neighbours if they share at least this many landmarks. The neighbours of the
# query are never candidates. A candidate must have at least the lowest score of these neighbours.
# [OS1 III-D, printed]
_MIN_SHARED = 15


class BowDetector:
    """A ``LoopDetector`` that compares images using bags of visual words."""

    name = "bow"

    def __init__(self, vocabulary: Vocabulary, config: BowConfig | None = None) -> None:
        self.vocabulary = vocabulary
        self.config = config or BowConfig()
        self._index = InvertedIndex(vocabulary.n_words)
        # CSR layout: the words of keyframe k are word[start[k]:start[k + 1]]. For ids that were
        # never added, this range is empty.
        self._start = np.zeros(65, np.int64)
        self._word = np.empty(65536, np.int32)
        self._n_keyframes = 0  # newest id + 1

    def add(self, keyframe: int, image: NDArray[np.uint8] | None, features: Features) -> None:
        """Store the visual words of a keyframe. The image is ignored.

        Raises:
            ValueError: the id of the keyframe is not greater than the ids of all earlier keyframes.
        """
        if keyframe < self._n_keyframes:
            raise ValueError(
                f"keyframe {keyframe} was added after {self._n_keyframes - 1}; ids must ascend"
            )
        words = self.vocabulary.words(features.descriptors)
        self._store(keyframe, words)
        self._index.add(keyframe, bow_vector(self.vocabulary, words))

    def query(self, keyframe: int, map_: Map) -> list[LoopCandidate]:
        """Find candidates for a keyframe that has been added.

        Keyframes that are recent or covisible with the given keyframe are excluded. The score of a
        candidate is at least the lowest score among the covisible keyframes.
        """
        config = self.config
        entries = self._entries(keyframe)
        likeness = self._index.compare(bow_vector(self.vocabulary, self._word[entries]))
        n = len(likeness.score)
        eligible = map_.arrays.keyframe_alive[:n].copy()
        eligible[max(0, keyframe + 1 - config.exclude_recent) :] = False
        covisible, _ = map_.covisible(keyframe, _MIN_SHARED)
        covisible = covisible[(covisible < n) & (covisible != keyframe)]
        eligible[covisible] = False
        with_words = covisible[np.diff(self._start[: n + 1])[covisible] > 0]
        least_score = float(likeness.score[with_words].min()) if len(with_words) else 0.0
        return self._candidates(keyframe, likeness, eligible, least_score, map_)

    def locate(
        self, image: NDArray[np.uint8] | None, features: Features, map_: Map
    ) -> list[LoopCandidate]:
        words = self.vocabulary.words(features.descriptors)
        likeness = self._index.compare(bow_vector(self.vocabulary, words))
        eligible = map_.arrays.keyframe_alive[: len(likeness.score)].copy()
        return self._candidates(-1, likeness, eligible, 0.0, map_)

    def memory(self) -> DetectorMemory:
        first = self._start[: self._n_keyframes + 1]
        words = PerKeyframe(first, self._word[: first[-1]])
        return DetectorMemory(self.name, self._fingerprint, {"words": words})

    def restore(self, memory: DetectorMemory) -> None:
        require_same(self.memory(), memory)
        words = memory.tables["words"]
        valid = words.values.dtype == np.int32 and words.values.ndim == 1
        if not valid or ((words.values < 0) | (words.values >= self.vocabulary.n_words)).any():
            raise ValueError("the words of the keyframes do not belong to the vocabulary")
        for keyframe in range(len(words)):
            self._store(keyframe, words.of(keyframe))
            self._index.add(keyframe, bow_vector(self.vocabulary, words.of(keyframe)))

    @cached_property
    def _fingerprint(self) -> str:
        vocabulary = self.vocabulary
        digest = sha256(vocabulary.descriptors.tobytes() + vocabulary.weight.tobytes())
        return digest.hexdigest()[:16]

    def _store(self, keyframe: int, words: NDArray[np.int32]) -> None:
        first = int(self._start[self._n_keyframes])
        last = first + len(words)
        self._start = grown(self._start, keyframe + 2)
        self._word = grown(self._word, last)
        self._word[first:last] = words
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
            _COMMON_WORDS_RATIO,
            config.group_size,
            _MIN_SHARED,
            _GROUP_SCORE_RATIO,
            config.max_groups,
        )
        return [
            LoopCandidate(query, k, float(likeness.score[k]), proposed_by=self.name)
            for k in chosen.tolist()
        ]


@inner_kernel
def most_covisible(counts, minimum, keyframes, strength):
    """Select the G keyframes with the highest counts. Counts below ``minimum`` are ignored.

    Args:
        counts: ``(n,)`` number of landmarks that each keyframe shares with a given keyframe.
        keyframes, strength: ``(G,)`` int64, receive the ids and the counts of the selected
            keyframes. The highest count comes first. If counts are equal, the lower id comes first.

    Returns:
        Number of selected keyframes, at most G.
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
    """Choose loop candidates using shared words, scores, and groups of covisible keyframes.

    1. A keyframe passes if it shares enough words with the query: at least ``common_words_ratio``
       times as many as the keyframe that shares the most. Of the keyframes that pass and score at
       least ``least_score``, the ``max_groups`` keyframes with the highest scores are selected.
    2. Each selected keyframe forms a group with those of its ``group_size`` most covisible
       keyframes that pass. The score of a group is the sum of the scores of its members. The
       representative of a group is the member with the highest score.
    3. A group is kept if its score is at least ``group_score_ratio`` times the highest score of a
       group. The representatives of these groups are returned.

    Args:
        a, n_keyframes: arrays of the map, and number of keyframes in the map.
        shared: ``(K,)`` number of words that each keyframe shares with the query; K is at most
            ``n_keyframes``.
        score: ``(K,)`` score of each keyframe.
        eligible: ``(K,)`` bool, True for keyframes that may be candidates.

    Returns:
        ``(n,)`` int64 ids of the chosen keyframes, without duplicates, best group first.
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
