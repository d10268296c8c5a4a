"""Trains a vocabulary tree by k-majority clustering, level by level.

The method is that of Galvez-Lopez and Tardos (T-RO 2012, section III) for binary descriptors, which
is based on Nister and Stewenius (CVPR 2006). In each node, every descriptor is assigned to the
nearest of k centres. Each centre then becomes the bitwise majority of its descriptors. Both steps
are repeated until nothing changes.

All arithmetic is on integers, and this module generates the random numbers itself. Therefore, a
seed gives the same tree on every machine.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from vslam.loopclosure.vocabulary import MAX_BRANCHING, MAX_LEVELS, Vocabulary, from_children
from vslam.support.kernels import hamming, inner_kernel, kernel

TRIALS = 4  # candidates per centre in greedy k-means++: about 2 + ln k
ITERATIONS = 12  # maximum number of majority votes in a node; most nodes converge earlier


def train(
    descriptors_of_images: list[NDArray[np.uint8]],
    branching: int = 10,
    levels: int = 5,
    seed: int = 0,
    on_level: Callable[[int, int], None] | None = None,
) -> Vocabulary:
    """Train a vocabulary of visual words. The same input and seed give the same tree.

    Args:
        descriptors_of_images: ``(n, 32)`` uint8 descriptors of each image.
        branching: maximum number of children of a node.
        levels: maximum depth of a leaf.
        on_level: called after each level of the tree, with the number of levels and the number of
            nodes that exist so far.

    Raises:
        ValueError: branching or levels is out of range, or there are fewer than two different
            descriptors.
    """
    if not (2 <= branching <= MAX_BRANCHING and 1 <= levels <= MAX_LEVELS):
        raise ValueError(
            f"branching is {branching} and levels is {levels}, but they must be 2 to "
            f"{MAX_BRANCHING} and 1 to {MAX_LEVELS}"
        )
    counts = [len(one) for one in descriptors_of_images]
    if sum(counts) == 0:
        raise ValueError("there are no descriptors to train on")
    data = np.ascontiguousarray(np.concatenate(descriptors_of_images)).view(np.uint64)
    order = np.arange(len(data), dtype=np.int64)
    centres, n_children = [np.zeros((1, 4), np.uint64)], []
    starts = np.array([0, len(data)], np.int64)  # CSR offsets of the level's nodes into ``order``
    for level in range(levels):
        stream = np.uint64((seed * MAX_LEVELS + level) % 2**64)
        new, split, starts = split_level(data, order, starts, branching, stream, ITERATIONS)
        centres.append(new)
        n_children.append(split)
        if on_level is not None:
            on_level(level + 1, sum(map(len, centres)))
    if len(centres[1]) < 2:
        raise ValueError("all descriptors are the same")
    n_children.append(np.zeros(len(centres[-1]), np.uint8))
    nodes, children = np.concatenate(centres), np.concatenate(n_children)
    n_leaves = int(np.count_nonzero(children == 0))
    tree = from_children(branching, levels, nodes, children, np.ones(n_leaves, np.float32))
    seen_in = np.zeros(n_leaves, np.int64)
    for one in descriptors_of_images:
        seen_in[np.unique(tree.words(one))] += 1
    # Every leaf should be the word of some training descriptor. np.maximum only prevents a division
    # by 0.
    weight = np.log(len(counts) / np.maximum(seen_in, 1)).astype(np.float32)
    return from_children(branching, levels, nodes, children, weight)


@inner_kernel
def uniform(state):
    """Generate a random number in [0, 1) using splitmix64 (Steele et al., OOPSLA 2014). Returns the
    number and the next state of the generator, uint64."""
    state = state + np.uint64(0x9E3779B97F4A7C15)
    z = state
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return np.float64(z >> np.uint64(11)) / 9007199254740992.0, state


@inner_kernel
def seed_centres(data, members, branching, state, nearest, centres):
    """Choose up to ``branching`` different members of a node as the initial cluster centres.

    The method is the greedy variant of k-means++ (Arthur and Vassilvitskii, SODA 2007, section 7),
    with the Hamming distance as the squared distance of bit vectors.

    Args:
        data: ``(M, 4)`` uint64 descriptors.
        members: ``(n,)`` indices of the members of the node in ``data``.
        nearest: ``(n,)`` int64 workspace.
        centres: ``(branching, 4)`` uint64, receives the centres.

    Returns:
        Number of centres that were chosen. It is below ``branching`` only if there are fewer
        different descriptors.
    """
    n = len(members)
    draw, state = uniform(state)
    chosen = members[min(int(draw * n), n - 1)]
    for i in range(n):
        nearest[i] = 257
    for k in range(branching):
        for w in range(4):
            centres[k, w] = data[chosen, w]
        total = 0
        for i in range(n):
            distance = hamming(data[members[i]], centres[k])
            if distance < nearest[i]:
                nearest[i] = distance
            total += nearest[i]
        if total == 0 or k == branching - 1:
            return k + 1
        least_left = total + 1
        for _ in range(TRIALS):
            draw, state = uniform(state)
            target, drawn = int(draw * total), 0
            while target >= nearest[drawn] and drawn < n - 1:
                target -= nearest[drawn]
                drawn += 1
            left = 0
            for i in range(n):
                left += min(nearest[i], hamming(data[members[i]], data[members[drawn]]))
            if left < least_left:
                least_left = left
                chosen = members[drawn]
    return branching


@inner_kernel
def assign(data, members, centres, n_centres, label):
    """Write the nearest centre of each member of a node into ``label``, ``(n,)`` int64. If several
    centres are equally near, the first centre is chosen. Returns the number of labels that have
    changed."""
    changed = 0
    for i in range(len(members)):
        nearest, least = 0, 257
        for k in range(n_centres):
            distance = hamming(data[members[i]], centres[k])
            if distance < least:
                nearest, least = k, distance
        if label[i] != nearest:
            label[i] = nearest
            changed += 1
    return changed


@inner_kernel
def vote(data, members, label, n_centres, ones, size, centres):
    """Set each cluster centre to the bitwise majority of its members. A centre without members is
    not changed.

    Args:
        ones: ``(branching, 256)`` int64 workspace.
        size: ``(branching,)`` int64 workspace.
    """
    for k in range(n_centres):
        size[k] = 0
        for bit in range(256):
            ones[k, bit] = 0
    for i in range(len(members)):
        k = label[i]
        size[k] += 1
        for w in range(4):
            value = data[members[i], w]
            for bit in range(64):
                ones[k, 64 * w + bit] += np.int64((value >> np.uint64(bit)) & np.uint64(1))
    for k in range(n_centres):
        if size[k] == 0:
            continue
        for w in range(4):
            value = np.uint64(0)
            for bit in range(64):
                if 2 * ones[k, 64 * w + bit] > size[k]:
                    value |= np.uint64(1) << np.uint64(bit)
            centres[k, w] = value


@kernel
def split_level(data, order, starts, branching, stream, iterations):
    """Split each node of a level of the tree into clusters, and sort ``order`` by cluster.

    Args:
        data: ``(M, 4)`` uint64 descriptors.
        order: ``(M,)`` int64 indices into ``data``, grouped by node. The array is overwritten.
        starts: ``(n + 1,)`` int64 start of the group of each node in ``order``.
        stream: uint64 seed of the random numbers of this level.

    Returns:
        centres: ``(c, 4)`` uint64 centres of all children, node by node.
        n_children: ``(n,)`` uint8 number of children of each node; 0 if all its descriptors are the
            same.
        child_starts: ``(c + 1,)`` int64 start of the group of each child in ``order``.
    """
    n_nodes = len(starts) - 1
    centres = np.zeros((n_nodes * branching, 4), np.uint64)
    n_children = np.zeros(n_nodes, np.uint8)
    child_starts = np.zeros(n_nodes * branching + 1, np.int64)
    largest = 0
    for node in range(n_nodes):
        largest = max(largest, starts[node + 1] - starts[node])
    label, nearest = np.empty(largest, np.int64), np.empty(largest, np.int64)
    sorted_members = np.empty(largest, np.int64)
    own = np.empty((branching, 4), np.uint64)
    ones = np.empty((branching, 256), np.int64)
    size, cursor = np.empty(branching, np.int64), np.empty(branching, np.int64)
    total, filled = 0, 0
    for node in range(n_nodes):
        members = order[starts[node] : starts[node + 1]]
        n = len(members)
        # The states of different nodes are far apart, so that their random sequences do not
        # overlap.
        state = stream * np.uint64(0xD1342543DE82EF95) + np.uint64(node) * np.uint64(1 << 40)
        n_centres = seed_centres(data, members, branching, state, nearest, own)
        if n_centres == 1:
            continue  # all descriptors are the same: the node is a leaf
        for i in range(n):
            label[i] = -1
        changed = assign(data, members, own, n_centres, label)
        iteration = 0
        # The last step is an assignment, so that a descent of the tree leads to the same clusters.
        while changed > 0 and iteration < iterations:
            vote(data, members, label, n_centres, ones, size, own)
            changed = assign(data, members, own, n_centres, label)
            iteration += 1
        for k in range(n_centres):
            size[k] = 0
        for i in range(n):
            size[label[i]] += 1
        position = 0
        for k in range(n_centres):
            cursor[k] = position
            position += size[k]
        for i in range(n):
            sorted_members[cursor[label[i]]] = members[i]
            cursor[label[i]] += 1
        # Nodes that became leaves are skipped. The groups of the other nodes are therefore moved to
        # the left.
        for i in range(n):
            order[filled + i] = sorted_members[i]
        for k in range(n_centres):
            if size[k] == 0:
                continue
            for w in range(4):
                centres[total, w] = own[k, w]
            child_starts[total] = filled
            filled += size[k]
            total += 1
            n_children[node] += 1
        child_starts[total] = filled
    return centres[:total].copy(), n_children, child_starts[: total + 1].copy()
