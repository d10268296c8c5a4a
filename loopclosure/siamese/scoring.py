"""Similarities of images by a network, for benchmarks."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.loopclosure.siamese.images import Fit, to_size
from vslam.loopclosure.siamese.inference import open_network


class NetworkScorer:
    """Computes similarities of images by one of ``NETWORKS`` on one thread.

    Attributes:
        name: name of the network.
        parameters: number of learned parameters.
    """

    def __init__(self, name: str, weights: Path | None, fit: Fit) -> None:
        """Load the network.

        Args:
            name: one of ``NETWORKS``.
            weights: ONNX file; None takes the weights that vslam ships.
            fit: how images are resized, see ``to_size``.

        Raises:
            InputError: there are no weights, or those of another network.
        """
        self._network, self._fit = open_network(name, weights), fit
        self.name, self.parameters = name, int(self._network.about["parameters"])

    def scores(
        self, queries: NDArray[np.float32], gallery: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        """``(Q, G)`` probabilities that two images show the same place, from the ``(Q, D)`` and
        ``(G, D)`` descriptors of the queries and of the gallery."""
        return np.stack([self.compare(query, gallery) for query in queries]).astype(np.float64)

    def embed(self, images: Collection[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """``(N, D)`` descriptors of ``(H, W)`` uint8 images."""
        size = self._network.size
        return np.stack([self._network.embed(to_size(one, size, self._fit)) for one in images])

    def compare(
        self, descriptor: NDArray[np.float32], gallery: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """``(N,)`` probabilities that the image of a ``(D,)`` descriptor shows the same place as
        those of a gallery ``(N, D)``."""
        return self._network.compare(descriptor, gallery)
