"""Visual words: a vocabulary tree of binary descriptors, and bags of words of images.

The tree is the hierarchical vocabulary of Nister and Stewenius (CVPR 2006), adapted to binary
descriptors (Galvez-Lopez and Tardos, T-RO 2012, section III). Each node splits its descriptors into
k clusters by Hamming distance. The centre of a cluster is the bitwise majority of its descriptors.
The leaves of the tree are the words.

Nodes are numbered breadth first, so that the children of a node are adjacent in memory. Each step
down the tree then reads one block of k descriptors.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.support.errors import InputError, write_file
from vslam.support.kernels import hamming, kernel
from vslam.support.untrusted import read_npz

SCHEMA = 1
SHIPPED = Path(__file__).with_name("vocabulary.npz")
MAX_BRANCHING, MAX_LEVELS = 20, 10  # the limits of DBoW2's text format


@dataclass(frozen=True)
class Vocabulary:
    """A vocabulary of visual words: a tree of N nodes whose W leaves are the words. Node 0 is the
    root and has no descriptor.

    Attributes:
        branching: maximum number of children of a node (k in the literature).
        levels: maximum depth of a leaf (L in the literature).
        descriptors: ``(N, 4)`` uint64 centre of each node; zero for the root.
        first_child: ``(N,)`` int32; the children of node i are
            ``first_child[i] ... first_child[i] + n_children[i] - 1``.
        n_children: ``(N,)`` uint8 number of children of each node; 0 for a leaf.
        parent: ``(N,)`` int32 parent of each node; -1 for the root.
        level: ``(N,)`` uint8 depth of each node; 0 for the root.
        word: ``(N,)`` int32 word of each leaf, numbered in the order of the nodes; -1 for inner
            nodes.
        weight: ``(W,)`` float32 inverse document frequency of each word: the logarithm of the
            number of images divided by the number of images with the word.
    """

    branching: int
    levels: int
    descriptors: NDArray[np.uint64]
    first_child: NDArray[np.int32]
    n_children: NDArray[np.uint8]
    parent: NDArray[np.int32]
    level: NDArray[np.uint8]
    word: NDArray[np.int32]
    weight: NDArray[np.float32]

    @property
    def n_words(self) -> int:
        return len(self.weight)

    def words(self, descriptors: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Find the ``(M,)`` int32 visual words of ``(M, 32)`` uint8 descriptors."""
        return descend(
            np.ascontiguousarray(descriptors).view(np.uint64),
            self.descriptors,
            self.first_child,
            self.n_children,
            self.word,
        )

    def ancestors(self, level: int) -> NDArray[np.int32]:
        """Find the ancestor of each word at a level of the tree, as ``(W,)`` int32 nodes. The root
        is at level 0. A word above the level is its own ancestor."""
        nodes = np.flatnonzero(self.word >= 0).astype(np.int32)
        while (deep := self.level[nodes] > level).any():
            nodes[deep] = self.parent[nodes[deep]]
        return nodes


class BowVector(NamedTuple):
    """The bag of words of an image.

    Attributes:
        words: ``(N,)`` int32 words, in ascending order.
        weights: ``(N,)`` float32 weights of the words, which sum to 1.
    """

    words: NDArray[np.int32]
    weights: NDArray[np.float32]


def bow_vector(vocabulary: Vocabulary, words: NDArray[np.int32]) -> BowVector:
    """Compute the bag of words of an image from the ``(M,)`` visual words of its features. The
    tf-idf weights are normalised to an L1 norm of 1 (Nister and Stewenius, section 4).

    Words that occur in every training image have weight 0 and are left out.
    """
    unique, count = np.unique(words, return_counts=True)
    weights = count * vocabulary.weight[unique].astype(np.float64)
    informative = weights > 0
    unique, weights = unique[informative], weights[informative]
    return BowVector(unique, (weights / max(weights.sum(), 1e-300)).astype(np.float32))


def score(a: BowVector, b: BowVector) -> float:
    """Compute the L1 score of two bags of words: 1 - |a - b| / 2, in [0, 1] (Galvez-Lopez and
    Tardos, T-RO 2012, equation 2).

    The weights are positive and sum to 1. Therefore, the score is the sum of the smaller weight of
    each shared word (Nister and Stewenius, section 4, equation 5, rearranged).
    """
    _, in_a, in_b = np.intersect1d(a.words, b.words, assume_unique=True, return_indices=True)
    return float(np.minimum(a.weights[in_a], b.weights[in_b]).sum(dtype=np.float64))


@kernel
def descend(queries, descriptors, first_child, n_children, word):
    """Find the visual word of each query descriptor by descending the vocabulary tree from the root
    to a leaf.

    Each step goes to the nearest child. If several children are equally near, the first child is
    chosen.

    Args:
        queries: ``(M, 4)`` uint64 descriptors. The other arrays are attributes of ``Vocabulary``.

    Returns:
        ``(M,)`` int32 words.
    """
    out = np.empty(len(queries), np.int32)
    for i in range(len(queries)):
        query = queries[i]
        node = 0
        while n_children[node] > 0:
            first = first_child[node]
            nearest, least = first, hamming(query, descriptors[first])
            for child in range(first + 1, first + np.int64(n_children[node])):
                distance = hamming(query, descriptors[child])
                if distance < least:
                    nearest, least = child, distance
            node = nearest
        out[i] = word[node]
    return out


def from_children(
    branching: int,
    levels: int,
    descriptors: NDArray[np.uint64],
    n_children: NDArray[np.uint8],
    weight: NDArray[np.float32],
) -> Vocabulary:
    """Build a vocabulary from its nodes in breadth-first order. ``Vocabulary`` describes the
    arguments.

    Raises:
        ValueError: an argument is out of range, or the arguments do not describe a tree.
    """
    n = len(n_children)
    if not 2 <= branching <= MAX_BRANCHING:
        raise ValueError(f"branching is {branching}, but must be 2 to {MAX_BRANCHING}")
    if not 1 <= levels <= MAX_LEVELS:
        raise ValueError(f"levels is {levels}, but must be 1 to {MAX_LEVELS}")
    if n < 2 or descriptors.shape != (n, 4):
        raise ValueError(f"there are {n} nodes and descriptors of shape {descriptors.shape}")
    if n_children.max() > branching:
        raise ValueError(f"a node has {n_children.max()} children, more than {branching}")
    children = n_children.astype(np.int64)
    first_child = 1 + np.cumsum(children) - children
    inner = np.flatnonzero(children)
    if children.sum() != n - 1 or (first_child[inner] <= inner).any():
        raise ValueError("the numbers of children do not form a tree")
    parent = np.concatenate([[-1], np.repeat(np.arange(n), children)]).astype(np.int32)
    level = np.zeros(n, np.uint8)
    start, stop, depth = 1, 1 + int(children[0]), 1
    while start < stop:  # start:stop are the nodes at this depth
        if depth > levels:
            raise ValueError(f"the tree is deeper than {levels} levels")
        level[start:stop] = depth
        start, stop, depth = stop, stop + int(children[start:stop].sum()), depth + 1
    leaf = children == 0
    if weight.shape != (np.count_nonzero(leaf),):
        raise ValueError(f"{np.count_nonzero(leaf)} leaves have {len(weight)} weights")
    if not (np.isfinite(weight).all() and (weight >= 0).all()):
        raise ValueError("a weight is negative or not finite")
    word = np.full(n, -1, np.int32)
    word[leaf] = np.arange(len(weight), dtype=np.int32)
    return Vocabulary(
        branching=branching,
        levels=levels,
        descriptors=descriptors,
        first_child=first_child.astype(np.int32),
        n_children=n_children,
        parent=parent,
        level=level,
        word=word,
        weight=weight,
    )


def save(vocabulary: Vocabulary, path: Path) -> None:
    """Write a vocabulary as an npz file. It is not compressed, because descriptors hardly compress
    and an uncompressed file loads faster.

    Raises:
        ResultsError: the file cannot be written.
    """
    content = io.BytesIO()
    np.savez(
        content,
        schema=np.int64(SCHEMA),
        branching=np.int64(vocabulary.branching),
        levels=np.int64(vocabulary.levels),
        descriptors=vocabulary.descriptors,
        n_children=vocabulary.n_children,
        weight=vocabulary.weight,
    )
    write_file(path, content.getvalue())


def load(path: Path = SHIPPED) -> Vocabulary:
    """Read a vocabulary that ``save`` wrote. The default is the vocabulary that vslam ships.

    Raises:
        InputError: the file is missing, damaged or not a vocabulary, or it was written by a version
            of vslam with a different schema.
    """
    fix = "write it again with 'vslam vocabulary train' or 'convert'"
    parts = read_npz(path, "a vocabulary", fix)
    try:
        if "schema" not in parts or "n_children" not in parts:
            raise InputError(f"{path}: not a vocabulary; {fix}.")
        if (schema := int(parts["schema"])) != SCHEMA:
            raise InputError(
                f"{path}: has schema {schema}, but this version of vslam reads schema {SCHEMA}; "
                f"{fix}."
            )
        dtypes = (("descriptors", np.uint64), ("n_children", np.uint8), ("weight", np.float32))
        for name, dtype in dtypes:
            if parts[name].dtype != dtype:
                raise ValueError(f"{name} is {parts[name].dtype}")
        return from_children(
            int(parts["branching"]),
            int(parts["levels"]),
            parts["descriptors"],
            parts["n_children"],
            parts["weight"],
        )
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: damaged vocabulary ({error}); {fix}.") from error
