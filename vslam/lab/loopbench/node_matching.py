"""Match features by the direct index of a vocabulary (Galvez-Lopez and Tardos, T-RO 2012, IV).

Only features whose words lie under the same node of the tree are compared. Loop closing compares
all pairs of descriptors instead, which finds a quarter more matches but is too slow for thousands
of image pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.kernels import hamming, kernel


class NodeIndex(NamedTuple):
    """Direct index of an image: its features, sorted by the node under which their words lie.

    ``node``: ``(N,)`` int32, ascending. ``feature``: ``(N,)`` int32, index within the image.
    """

    node: NDArray[np.int32]
    feature: NDArray[np.int32]


def index_nodes(node: NDArray[np.int32]) -> NodeIndex:
    """Direct index of an image whose features lie under the nodes ``(N,)``."""
    order = np.argsort(node, kind="stable").astype(np.int32)
    return NodeIndex(node[order], order)


@kernel
def match_by_node(
    node_a, feature_a, descriptors_a, node_b, feature_b, descriptors_b, max_distance, ratio
):
    """Match features of two images whose words lie under the same node of the vocabulary.

    Args:
        node_a, feature_a: direct index of image a (``NodeIndex``); likewise for image b.
        descriptors_a, descriptors_b: ``(M, 4)`` and ``(N, 4)`` uint64, of all features.
        max_distance: largest Hamming distance in bits.
        ratio: largest ratio of the best to the second best distance under the node; 1 disables it.

    Returns:
        ``(M,)`` int32 feature of b for each feature of a, or -1. A feature of b is matched at most
        once, with the closest feature of a.
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
