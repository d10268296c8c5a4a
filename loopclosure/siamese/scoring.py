"""A network as a function of images, for benchmarks."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from vslam.loopclosure.siamese.detector import load_named
from vslam.loopclosure.siamese.images import Fit, to_size
from vslam.loopclosure.siamese.objective import embed_all, score_matrix
from vslam.loopclosure.siamese.runtime import one_thread
from vslam.loopclosure.siamese.siamese import for_inference

_CPU = torch.device("cpu")


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
        network = load_named(name, weights)
        self.name, self.parameters = name, network.n_parameters()
        self._network, self._fit = for_inference(network), fit

    def scores(
        self, queries: NDArray[np.float32], gallery: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        """p ``(Q, G)`` that two images show one place, from descriptors ``(Q, D)``, ``(G, D)``."""
        with one_thread():
            return score_matrix(self._network, queries, gallery, _CPU).astype(np.float64)

    def embed(self, images: Collection[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """Descriptors ``(N, D)`` of images ``(H, W)``."""
        small = [to_size(image, self._network.size, self._fit) for image in images]
        with one_thread():
            return embed_all(self._network, np.stack(small), _CPU)

    @torch.no_grad()
    def compare(
        self, descriptor: NDArray[np.float32], gallery: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """p ``(N,)`` of one descriptor ``(D,)`` with each of ``(N, D)``."""
        with one_thread():
            p = self._network.compare(torch.from_numpy(descriptor), torch.from_numpy(gallery))
            return np.asarray(p.numpy())
