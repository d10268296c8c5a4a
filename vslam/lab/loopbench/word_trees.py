"""Nearest-neighbour search among a changing set of binary words, by trees of random centres.

As in Muja and Lowe (Fast matching of binary features, CRV 2012), the inner nodes of several trees
have randomly chosen words as centres, and all trees are searched together, nearest branch first.
Their trees are built at once; these grow word by word, and a full leaf becomes an inner node.
iBoW-LCD also uses such trees (Garcia-Fidalgo and Ortiz, RA-L 2018, section III).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.kernels import hamming, inner_kernel, kernel
from vslam.ransac import random_index

_TREES, _BRANCHES, _LEAF = 4, 16, 150  # as in iBoW-LCD, section III
_COMPARED = 512  # most words compared with a descriptor
_WAITING = 2048  # most branches kept to be searched later
_FIRST_WORDS, _FIRST_NODES = 4096, 256


class WordTrees(NamedTuple):
    """Arrays for up to W words and, in each of T trees, M nodes.

    ``words`` (W, 4) u8; ``leaf_of`` (T, W) i4; ``centre`` (T, M, 4) u8; ``child`` (T, M) i4 first
    child of a node, -1 for a leaf; ``size`` (T, M) i4 and ``members`` (T, M, L) i4 of leaves;
    ``used`` (T,) i8 number of nodes; ``random`` (T, 1) u8 states of the generators.
    """

    words: NDArray[np.uint64]
    leaf_of: NDArray[np.int32]
    centre: NDArray[np.uint64]
    child: NDArray[np.int32]
    size: NDArray[np.int32]
    members: NDArray[np.int32]
    used: NDArray[np.int64]
    random: NDArray[np.uint64]


def empty_trees() -> WordTrees:
    """Trees without a word."""
    return WordTrees(
        np.zeros((_FIRST_WORDS, 4), np.uint64),
        np.full((_TREES, _FIRST_WORDS), -1, np.int32),
        np.zeros((_TREES, _FIRST_NODES, 4), np.uint64),
        np.full((_TREES, _FIRST_NODES), -1, np.int32),
        np.zeros((_TREES, _FIRST_NODES), np.int32),
        np.zeros((_TREES, _FIRST_NODES, _LEAF), np.int32),
        np.ones(_TREES, np.int64),
        np.arange(_TREES, dtype=np.uint64)[:, None].copy(),
    )


def insert(trees: WordTrees, word: NDArray[np.int32], descriptors: NDArray[np.uint64]) -> WordTrees:
    """Insert new words; the arrays are changed in place or replaced by larger ones.

    Args:
        word: ``(N,)`` int32 numbers of the words; they may lie beyond the end of ``trees.words``.
        descriptors: ``(N, 4)`` uint64.
    """
    while len(word) and word.max() >= len(trees.words):
        words, leaf_of = trees.words, trees.leaf_of
        trees = trees._replace(
            words=np.concatenate([words, np.zeros_like(words)]),
            leaf_of=np.concatenate([leaf_of, np.full_like(leaf_of, -1)], axis=1),
        )
    done = 0
    while (done := _insert(*trees, word, descriptors, done)) < len(word):
        trees = trees._replace(
            centre=np.concatenate([trees.centre, np.zeros_like(trees.centre)], axis=1),
            child=np.concatenate([trees.child, np.full_like(trees.child, -1)], axis=1),
            size=np.concatenate([trees.size, np.zeros_like(trees.size)], axis=1),
            members=np.concatenate([trees.members, np.zeros_like(trees.members)], axis=1),
        )
    return trees


def remove(trees: WordTrees, word: NDArray[np.int32]) -> None:
    """Remove words ``(N,)`` int32 from the trees."""
    _remove(trees.leaf_of, trees.size, trees.members, word)


def nearest_two(
    trees: WordTrees, descriptors: NDArray[np.uint64]
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """The nearest words found for each of N descriptors ``(N, 4)`` uint64.

    Returns:
        ``(N,)`` int32 nearest word, or -1, and ``(N, 2)`` distances in bits to the nearest and the
        second nearest word, or 257.
    """
    return _nearest_two(
        trees.words, trees.centre, trees.child, trees.size, trees.members, descriptors
    )


@kernel
def _insert(words, leaf_of, centre, child, size, members, used, random, word, descriptors, first):
    """Insert from ``first`` on; returns the first word for which there is no room, or N."""
    for i in range(first, len(word)):
        for t in range(len(used)):
            if used[t] + 4 * _BRANCHES > child.shape[1]:
                return i
        w = word[i]
        for k in range(4):
            words[w, k] = descriptors[i, k]
        for t in range(len(used)):
            node = _leaf(centre[t], child[t], words[w])
            while size[t, node] == members.shape[2]:
                _split(
                    words, leaf_of[t], centre[t], child[t], size[t], members[t],
                    node, used[t], random[t],
                )  # fmt: skip
                used[t] += _BRANCHES
                node = _leaf(centre[t], child[t], words[w])
            members[t, node, size[t, node]] = w
            size[t, node] += 1
            leaf_of[t, w] = node
    return len(word)


@inner_kernel
def _leaf(centre, child, descriptor):
    """The leaf of a descriptor, found by always descending to the nearest centre."""
    node = 0
    while child[node] >= 0:
        best, least = child[node], 257
        for other in range(child[node], child[node] + _BRANCHES):
            distance = hamming(centre[other], descriptor)
            if distance < least:
                best, least = other, distance
        node = best
    return node


@inner_kernel
def _split(words, leaf_of, centre, child, size, members, node, first, random):
    """Turn a full leaf into an inner node with children from ``first`` on, which take its words."""
    n = size[node]
    for k in range(_BRANCHES):
        drawn = k + random_index(random, n - k)
        members[node, k], members[node, drawn] = members[node, drawn], members[node, k]
        for j in range(4):
            centre[first + k, j] = words[members[node, k], j]
    for m in range(n):
        w = members[node, m]
        best, least = first, 257
        for other in range(first, first + _BRANCHES):
            distance = hamming(centre[other], words[w])
            # Equal centres share their words; otherwise a leaf of equal words could not be split.
            if distance < least or (distance == least and size[other] < size[best]):
                best, least = other, distance
        members[best, size[best]] = w
        size[best] += 1
        leaf_of[w] = best
    child[node], size[node] = first, 0


@kernel
def _remove(leaf_of, size, members, word):
    for w in word:
        for t in range(len(leaf_of)):
            node = leaf_of[t, w]
            last = size[t, node] - 1
            for k in range(last):
                if members[t, node, k] == w:
                    members[t, node, k] = members[t, node, last]
                    break
            size[t, node] = last
            leaf_of[t, w] = -1


@kernel
def _nearest_two(words, centre, child, size, members, descriptors):
    n = len(descriptors)
    nearest, bits = np.full(n, -1, np.int32), np.full((n, 2), 257, np.int64)
    seen = np.full(len(words), -1, np.int32)
    tree, branch = np.empty(_WAITING, np.int64), np.empty(_WAITING, np.int64)
    away = np.empty(_WAITING, np.int64)
    n_trees = len(child)
    for i in range(n):
        waiting, compared, roots = 0, 0, 0
        while True:
            if roots < n_trees:
                t, node = roots, 0
                roots += 1
            elif waiting and compared < _COMPARED:
                k = 0
                for other in range(1, waiting):
                    if away[other] < away[k]:
                        k = other
                t, node = tree[k], branch[k]
                waiting -= 1
                tree[k], branch[k], away[k] = tree[waiting], branch[waiting], away[waiting]
            else:
                break
            while child[t, node] >= 0:
                first = child[t, node]
                best, least = first, hamming(centre[t, first], descriptors[i])
                for other in range(first + 1, first + _BRANCHES):
                    distance = hamming(centre[t, other], descriptors[i])
                    later, far = other, distance
                    if distance < least:
                        later, far = best, least
                        best, least = other, distance
                    if waiting < _WAITING:
                        tree[waiting], branch[waiting], away[waiting] = t, later, far
                        waiting += 1
                node = best
            for m in range(size[t, node]):
                w = members[t, node, m]
                if seen[w] == i:
                    continue
                seen[w] = i
                compared += 1
                distance = hamming(words[w], descriptors[i])
                if distance < bits[i, 0]:
                    bits[i, 1] = bits[i, 0]
                    nearest[i], bits[i, 0] = w, distance
                elif distance < bits[i, 1]:
                    bits[i, 1] = distance
    return nearest, bits
