"""Matches features using the direct index of a vocabulary.

Two features are compared only if their visual words lie under the same node of the vocabulary tree
(Galvez-Lopez and Tardos, T-RO 2012, section IV). Comparing all pairs of descriptors, as loop
closing does, finds a quarter more matches. However, this is too slow for thousands of image pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import hamming, kernel


class NodeIndex(NamedTuple):
    """The features of an image, sorted by node of the vocabulary tree.

    The visual word of a feature lies under the node of the feature.

    Attributes:
        node: ``(N,)`` int32 node of each feature, ascending.
        feature: ``(N,)`` int32 index of each feature in the image.
    """

    node: NDArray[np.int32]
    feature: NDArray[np.int32]


def index_nodes(node: NDArray[np.int32]) -> NodeIndex:
    """Sort the features of an image by node of the vocabulary tree.

    Args:
        node: ``(N,)`` node under which the visual word of each feature lies.
    """
    order = np.argsort(node, kind="stable").astype(np.int32)
    return NodeIndex(node[order], order)


@kernel
def match_by_node(
    node_a, feature_a, descriptors_a, node_b, feature_b, descriptors_b, max_distance, ratio
):
    """Match features of two images whose visual words lie under the same node of the vocabulary.

    Args:
        node_a, feature_a: direct index of image a (`NodeIndex`).
        descriptors_a: ``(M, 4)`` uint64 descriptors of all features of image a.
        node_b, feature_b: direct index of image b.
        descriptors_b: ``(N, 4)`` uint64 descriptors of all features of image b.
        max_distance: largest Hamming distance in bits.
        ratio: largest ratio of the distances of the best and the second best match under the same
            node. 1 disables this test.

    Returns:
        ``(M,)`` int32. For each feature of image a, the index of the matching feature of image b,
        or -1. A feature of image b is matched at most once, with the most similar feature.
    """
    matches = np.full(len(descriptors_a), -1, np.int32)
    distances = np.full(len(descriptors_a), 257, np.int64)
    owner = np.full(len(descriptors_b), -1, np.int64)
    first, n_a, n_b = 0, len(node_a), len(node_b)
    for i in range(n_a):
        while first < n_b and node_b[first] < node_a[i]:
            first += 1
        feature = feature_a[i]
        best, least, second = -1, 257, 257
        j = first
        while j < n_b and node_b[j] == node_a[i]:
            other = feature_b[j]
            j += 1
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
