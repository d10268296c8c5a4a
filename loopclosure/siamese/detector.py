"""Loop detectors that compare descriptors of a Siamese network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.config import SiameseConfig
from vslam.features import Features
from vslam.loopclosure.siamese.images import to_size
from vslam.loopclosure.siamese.inference import OnnxNetwork, open_network
from vslam.loops import LoopCandidate
from vslam.map import Map


class SiameseDetector:
    """Implements :class:`vslam.loopclosure.detector.LoopDetector`.

    Descriptors are kept in one matrix that grows by half: a query is one product with it.
    """

    def __init__(self, network: OnnxNetwork, config: SiameseConfig) -> None:
        """The network's name becomes the detector's."""
        self.name = network.name
        self._network = network
        self._config = config
        self._descriptors = np.zeros((64, network.dimensions), np.float32)
        self._known = np.zeros(64, np.bool_)  # keyframes added with an image

    def add(self, keyframe: int, image: NDArray[np.uint8] | None, features: Features) -> None:
        """Embed and remember a keyframe. Without its image it can be neither query nor match."""
        while keyframe >= len(self._known):
            more = len(self._known) // 2
            self._descriptors = np.pad(self._descriptors, ((0, more), (0, 0)))
            self._known = np.pad(self._known, (0, more))
        if image is not None:
            self._descriptors[keyframe] = self._embed(image)
            self._known[keyframe] = True

    def query(self, keyframe: int, map_: Map) -> list[LoopCandidate]:
        """Best first: alive, neither recent nor covisible, similarity at or above the threshold."""
        if keyframe >= len(self._known) or not self._known[keyframe]:
            return []
        eligible = self._alive(map_)
        eligible[max(0, keyframe - self._config.recent_keyframes) :] = False
        covisible, _ = map_.covisible(keyframe)
        eligible[covisible[covisible < len(eligible)]] = False
        return self._best(keyframe, self._descriptors[keyframe], eligible, map_)

    def locate(
        self, image: NDArray[np.uint8] | None, features: Features, map_: Map
    ) -> list[LoopCandidate]:
        """The living keyframes most like a frame outside the map, whatever their similarity.

        Relocalisation verifies them by geometry and has nothing to lose: no threshold.
        """
        if image is None:
            return []
        return self._best(-1, self._embed(image), self._alive(map_), map_, threshold=0.0)

    def _alive(self, map_: Map) -> NDArray[np.bool_]:
        n = min(map_.n_keyframes, len(self._known))
        return self._known[:n] & map_.arrays.keyframe_alive[:n]

    def _embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        return self._network.embed(to_size(image, self._network.size, self._config.fit))

    def _best(
        self,
        query: int,
        descriptor: NDArray[np.float32],
        eligible: NDArray[np.bool_],
        map_: Map,
        threshold: float | None = None,
    ) -> list[LoopCandidate]:
        threshold = self._config.threshold if threshold is None else threshold
        n = len(eligible)
        if not eligible.any():
            return []
        p = self._network.compare(descriptor, self._descriptors[:n])
        p[~eligible] = -1.0
        found: list[LoopCandidate] = []
        # Neighbours of a good match match well, too: they would crowd out the other places.
        while len(found) < self._config.max_candidates:
            best = int(np.argmax(p))
            if p[best] < max(threshold, 0.0):
                break
            found.append(LoopCandidate(query, best, float(p[best]), learned=True))
            around, _ = map_.covisible(best, self._config.min_shared)
            p[around[around < n]] = -1.0
            p[best] = -1.0
        return found


def open_detector(name: str, config: SiameseConfig, weights: Path | None = None) -> SiameseDetector:
    """A detector with its weights.

    Args:
        name: one of ``NETWORKS``.
        config: see there.
        weights: ONNX file; None for the ones that vslam ships.

    Raises:
        InputError: unknown name, no weights, or weights of another network.
    """
    return SiameseDetector(open_network(name, weights), config)
