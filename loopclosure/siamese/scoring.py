"""A network as a function of images, for benchmarks."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.loopclosure.siamese.images import Fit, to_size
from vslam.loopclosure.siamese.inference import open_network


class NetworkScorer:
    """Similarities of images by one of ``NETWORKS``, on one thread.

    Attributes:
        name: of the network.
        parameters: numbers learned.
    """

    def __init__(self, name: str, weights: Path | None, fit: Fit) -> None:
        """Load it; ``weights`` None for those that vslam ships.

        Raises:
            InputError: no weights, or those of another network.
        """
        self._network, self._fit = open_network(name, weights), fit
        self.name, self.parameters = name, int(self._network.about["parameters"])

    def scores(
        self, queries: NDArray[np.float32], gallery: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        """p ``(Q, G)`` that two images show one place, from descriptors ``(Q, D)``, ``(G, D)``."""
        return np.stack([self.compare(query, gallery) for query in queries]).astype(np.float64)

    def embed(self, images: Collection[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """Descriptors ``(N, D)`` of images ``(H, W)``."""
        size = self._network.size
        return np.stack([self._network.embed(to_size(one, size, self._fit)) for one in images])

    def compare(
        self, descriptor: NDArray[np.float32], gallery: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """p ``(N,)`` of one descriptor ``(D,)`` with each of ``(N, D)``."""
        return self._network.compare(descriptor, gallery)
