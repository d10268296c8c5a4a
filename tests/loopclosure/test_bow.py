"""The bag-of-words detector: its indices, its candidates, and its results on real images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vslam.config import BowConfig
from vslam.loopclosure.bow import BowDetector
from vslam.loopclosure.bow_index import InvertedIndex
from vslam.loopclosure.detector import LoopDetector
from vslam.loopclosure.vocabulary import Vocabulary, bow_vector, from_children, score
from vslam.loopclosure.vocabulary_training import train
from vslam.types.features import Features
from vslam.types.map import Map
from vslam.types.map_kernels import link_many
from vslam_lab.loopbench.node_matching import index_nodes, match_by_node

WORDS = 400


def features_of(descriptors: np.ndarray) -> Features:
    n = len(descriptors)
    return replace(
        Features.none(),
        xy=np.zeros((n, 2), np.float32),
        octave=np.zeros(n, np.uint8),
        angle=np.zeros(n, np.float32),
        descriptors=descriptors,
        u_right=np.full(n, np.nan, np.float32),
    )


@pytest.fixture(scope="module")
def tree() -> Vocabulary:
    """Make a vocabulary of 20 x 20 words with equal weights. Word w is node 21 + w."""
    rng = np.random.default_rng(0)
    nodes = rng.integers(0, 256, (21 + WORDS, 32), dtype=np.uint8)
    for word in range(WORDS):  # near its parent, so that the descent finds it
        nodes[21 + word] = nodes[1 + word // 20]
        nodes[21 + word, :4] = rng.integers(0, 256, 4)
    n_children = np.array([20] * 21 + [0] * WORDS, np.uint8)
    return from_children(20, 2, nodes.view(np.uint64), n_children, np.ones(WORDS, np.float32))


def image_of(tree: Vocabulary, words: list[int] | np.ndarray) -> Features:
    return features_of(tree.descriptors[21 + np.asarray(words, np.int64)].view(np.uint8))


class World:
    """A map and a detector that get the same keyframes.

    The features of a keyframe have its words. The features in ``sees`` observe the landmarks with
    the given numbers.
    """

    def __init__(self, tree: Vocabulary, **config: float) -> None:
        self.tree, self.map = tree, Map(np.ones(8))
        self.detector = BowDetector(tree, BowConfig(**({"exclude_recent": 1} | config)))
        self.map.add_landmarks(np.zeros((1000, 3)), np.zeros((1000, 4), np.uint64), 0)

    def add(self, words, sees=()) -> int:
        features = image_of(self.tree, words)
        k = self.map.add_keyframe(features, np.eye(4), float(self.map.n_keyframes), 0)
        first = self.map.rows(k).start
        rows = np.arange(first, first + len(sees))
        link_many(self.map.arrays, rows, np.asarray(sees, np.int32))
        self.detector.add(k, None, features)
        return k

    def query(self, k: int) -> list[int]:
        return [candidate.match for candidate in self.detector.query(k, self.map)]


def test_the_detector_has_the_protocol(tree):
    detector: LoopDetector = BowDetector(tree)
    assert detector.name == "bow"


# -- inverted index -------------------------------------------------------------------------------


def test_the_inverted_index_scores_like_the_bags_one_by_one():
    rng = np.random.default_rng(1)
    images = [rng.integers(0, 256, (200, 32), dtype=np.uint8) for _ in range(90)]
    images[7] = images[7][:0]  # an image without features
    tree = train(images, 5, 3)
    bags = [bow_vector(tree, tree.words(image)) for image in images]
    index = InvertedIndex(tree.n_words)
    # There are enough images for words to move several times. Some ids are left out.
    ids = np.flatnonzero(np.arange(120) % 4 != 3)
    for k, bag in zip(ids, bags, strict=True):
        index.add(int(k), bag)
    query = bow_vector(tree, tree.words(np.concatenate([images[3][:100], images[40][:50]])))
    likeness = index.compare(query)
    assert len(likeness.score) == ids[-1] + 1
    shared = np.zeros(ids[-1] + 1, int)
    scores = np.zeros(ids[-1] + 1)
    shared[ids] = [len(np.intersect1d(query.words, bag.words)) for bag in bags]
    scores[ids] = [score(query, bag) for bag in bags]
    np.testing.assert_array_equal(likeness.shared, shared)
    np.testing.assert_allclose(likeness.score, scores, atol=1e-6)
    assert max(np.bincount(np.concatenate([b.words for b in bags]))) > 48, "few words move"
    assert likeness.score.argmax() == ids[3]


def test_ids_must_ascend(tree):
    detector = BowDetector(tree)
    detector.add(4, None, image_of(tree, [1, 2]))
    with pytest.raises(ValueError, match="keyframe 4 was added after 4; ids must ascend"):
        detector.add(4, None, image_of(tree, [1, 2]))
    with pytest.raises(ValueError, match="keyframe 5 has not been added"):
        detector.query(5, Map(np.ones(8)))


# -- candidates -----------------------------------------------------------------------------------

PLACE = np.arange(40)
ELSEWHERE = np.arange(100, 140)


def test_the_revisited_place_is_found_and_neighbours_are_not(tree):
    world = World(tree)
    first = world.add(PLACE)
    other = world.add(ELSEWHERE)
    neighbour = world.add(np.r_[PLACE[:20], 200:220], sees=range(20))
    query = world.add(PLACE, sees=range(20))
    assert world.query(query) == [first]
    (found,) = world.detector.query(query, world.map)
    assert (found.query, found.score) == (query, pytest.approx(1.0, abs=1e-6))
    assert other not in world.query(query)
    assert neighbour not in world.query(query)


def test_a_candidate_must_be_as_like_as_the_neighbours_of_the_query(tree):
    world = World(tree)
    first = world.add(PLACE[:24])  # 24 of 40 shared: 0.6
    world.add(np.r_[PLACE[:32], 300:308], sees=range(15))  # 0.8 is the threshold
    query = world.add(PLACE, sees=range(15))
    assert world.query(query) == []
    lower = World(tree)
    assert lower.add(PLACE[:24]) == first
    lower.add(np.r_[PLACE[:20], 300:320], sees=range(15))  # 0.5
    assert lower.query(lower.add(PLACE, sees=range(15))) == [first]
    # With one landmark fewer, it is no neighbour, so that it sets no threshold.
    loose = World(tree)
    assert loose.add(PLACE[:32]) == first
    loose.add(np.r_[PLACE[:36], 300:304], sees=range(14))
    assert loose.query(loose.add(PLACE, sees=range(14))) == [1, first]


def test_recent_and_culled_keyframes_are_left_out(tree):
    world = World(tree, exclude_recent=3)
    for _ in range(5):
        world.add(PLACE)
    assert sorted(world.query(4)) == [0, 1]
    world.map.parents[1] = 0
    world.map.cull_keyframe(1)
    assert world.query(4) == [0]
    found = world.detector.locate(None, image_of(tree, PLACE), world.map)
    assert sorted(candidate.match for candidate in found) == [0, 2, 3, 4]
    assert {candidate.query for candidate in found} == {-1}


def test_few_common_words_do_not_make_a_candidate(tree):
    world = World(tree)
    best = world.add(PLACE)
    world.add(PLACE[:31])  # 31 of 40: below 0.8
    enough = world.add(PLACE[:32])
    assert world.query(world.add(PLACE)) == [best, enough]


def test_a_group_counts_together_and_its_best_keyframe_stands_for_it(tree):
    world = World(tree)
    lonely = world.add(PLACE[:38])
    group = [
        world.add(np.r_[PLACE[:n], 300 : 300 + 40 - n], sees=range(100, 120)) for n in (34, 36, 35)
    ]
    query = world.add(PLACE)
    # The first image has the highest score, but the group has nearly three times this score.
    assert world.query(query) == [group[1]]
    # Without groups, the order is reversed.
    alone = World(tree, group_size=0)
    alone.add(PLACE[:38])
    for n in (34, 36, 35):
        alone.add(np.r_[PLACE[:n], 300 : 300 + 40 - n], sees=range(100, 120))
    assert alone.query(alone.add(PLACE))[0] == lonely


def test_the_number_of_groups_is_bounded(tree):
    world = World(tree, max_groups=5)
    for _ in range(30):
        world.add(PLACE)
    assert len(world.query(world.add(PLACE))) == 5


def test_nothing_is_found_where_nothing_is(tree):
    world = World(tree)
    assert world.query(world.add(PLACE)) == []
    world.add([])
    assert world.query(1) == []
    assert world.query(world.add(ELSEWHERE)) == []
    empty = BowDetector(tree)
    assert empty.locate(None, image_of(tree, PLACE), Map(np.ones(8))) == []
    assert world.detector.locate(None, Features.none(), world.map) == []


def test_a_keyframe_that_the_detector_was_not_told_of_sets_no_bar(tree):
    world = World(tree)
    untold = world.map.add_keyframe(image_of(tree, PLACE), np.eye(4), 0.0, 0)
    link_many(world.map.arrays, np.arange(20), np.arange(20, dtype=np.int32))
    world.add(PLACE[:32])
    world.add(np.r_[PLACE[:36], 300:304], sees=range(20))
    query = world.add(PLACE, sees=range(20))
    assert world.query(query) == [], "0.8 is less than the 0.9 of the neighbour"
    found = world.detector.locate(None, image_of(tree, PLACE), world.map)
    assert untold not in {candidate.match for candidate in found}
    # The map may be ahead of the detector.
    world.map.add_keyframe(image_of(tree, PLACE), np.eye(4), 9.0, 9)
    assert world.query(query) == []


# -- matching by node -----------------------------------------------------------------------------


def test_features_are_grouped_by_node(tree):
    words = np.random.default_rng(2).integers(0, WORDS, 300)
    image = image_of(tree, words)
    index = index_nodes(tree.ancestors(1)[tree.words(image.descriptors)])
    assert sorted(index.feature.tolist()) == list(range(300))
    np.testing.assert_array_equal(index.node, 1 + words[index.feature] // 20)
    assert (np.diff(index.node) >= 0).all()
    assert len(index_nodes(np.empty(0, np.int32)).node) == 0


def match_in_plain_python(a, b, node_a, node_b, max_distance, ratio):
    """Match each feature of a to the closest feature of b under the same node.

    Then, each feature of b keeps only the closest feature of a. If several are equally close, the
    one with the first node is kept.
    """
    bits_a, bits_b = (np.unpackbits(x.view(np.uint8), axis=1) for x in (a, b))
    table = (bits_a[:, None] != bits_b[None]).sum(axis=2)
    table[node_a[:, None] != node_b[None]] = 999
    wishes: dict[int, list[tuple[int, int, int]]] = {}
    for i in range(len(a)):
        order = np.sort(table[i])
        if order[0] <= max_distance and order[0] <= ratio * min(order[1], 257):
            j = int(table[i].argmin())
            wishes.setdefault(j, []).append((int(order[0]), int(node_a[i]), i))
    matches = np.full(len(a), -1)
    for j, who in wishes.items():
        matches[min(who)[2]] = j
    return matches


def test_matching_by_node_is_matching_within_nodes():
    rng = np.random.default_rng(3)
    a = rng.integers(0, 256, (300, 32), dtype=np.uint8)
    b = np.concatenate([a[::2], a[::3], rng.integers(0, 256, (50, 32), dtype=np.uint8)])
    noise = np.packbits(rng.random((len(b), 256)) < 0.04, axis=1)
    b = (b ^ noise)[rng.permutation(len(b))]
    tree = train([a], 4, 2)
    node = tree.ancestors(1)
    node_a, node_b = node[tree.words(a)], node[tree.words(b)]
    for max_distance, ratio in ((50, 0.75), (256, 1.0), (10, 0.9)):
        expected = match_in_plain_python(a, b, node_a, node_b, max_distance, ratio)
        got = match_by_node(
            *index_nodes(node_a), a.view(np.uint64), *index_nodes(node_b), b.view(np.uint64),
            max_distance, ratio,
        )  # fmt: skip
        np.testing.assert_array_equal(got, expected)
        assert max_distance < 50 or np.count_nonzero(got >= 0) > 60
