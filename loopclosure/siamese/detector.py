"""A loop detector that compares images using the descriptors of a Siamese network."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.config import LearnedMatchingConfig, SiameseConfig
from vslam.loopclosure.bow_index import grown
from vslam.loopclosure.detector import require_same
from vslam.loopclosure.local_matching import MIN_COARSE_SIMILARITY, DescriptorMaps, likeness
from vslam.loopclosure.reach import beyond_reach
from vslam.loopclosure.siamese.images import to_size
from vslam.loopclosure.siamese.inference import LateNetwork, OnnxNetwork, open_network
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.types.features import Features
from vslam.types.loops import DetectorMemory, LoopCandidate, PerKeyframe
from vslam.types.map import Map

# This many of the most similar keyframes are ranked again using local descriptors. [own]
_RERANKED = 20
# Two keyframes show the same place if they share at least this many landmarks. Only the best
# candidate of each place is proposed. [OS1 III-D, printed]
_MIN_SHARED = 15


class SiameseDetector:
    """A :class:`vslam.loopclosure.detector.LoopDetector` that compares images using the descriptors
    of a Siamese network.

    If the images of keyframes are stored, descriptors can be computed on demand. The network then
    computes the descriptor of a keyframe only when the camera comes within reach of the keyframe
    (:func:`beyond_reach`), or when tracking is lost. On a drive that never returns to a place, the
    network does not run at all. In real time, this would let a lost frame wait for the descriptors
    of the whole map, so the descriptors of a keyframe are computed when loops are searched at it.
    """

    def __init__(
        self,
        network: OnnxNetwork | LateNetwork,
        config: SiameseConfig,
        learned: LearnedMatchingConfig | None = None,
        images: KeyframeImages | None = None,
        *,
        on_demand: bool = True,
    ) -> None:
        """Create an empty detector with the name of the network.

        Args:
            learned: thresholds for local descriptors; None uses the defaults.
            images: the store of keyframe images. With a store, candidates must reach the similarity
                ``config.offered``, and the most similar keyframes are ranked again using local
                descriptors. The reason is that at night, the correct place is often among these
                keyframes but not ranked first. If it is None, candidates must reach
                ``config.threshold``.
            on_demand: whether the descriptors of stored images are computed only when needed.
        """
        self.name = network.name
        self._network = network
        self._learned = learned or LearnedMatchingConfig()
        self._images = images
        self._config = config
        self._on_demand = on_demand
        self._descriptors = np.zeros((64, 0), np.float32)
        self._n_rows = 0  # number of rows in use
        self._row = np.full(64, -1, np.int64)  # row of each keyframe; -1 if it has no descriptor

    def add(self, keyframe: int, image: NDArray[np.uint8] | None, features: Features) -> None:
        """Add a keyframe to the detector. A keyframe without an image can never be a query or a
        match."""
        if keyframe >= len(self._row):
            more = max(keyframe + 1 - len(self._row), len(self._row) // 2)
            self._row = np.pad(self._row, (0, more), constant_values=-1)
        if image is not None and self._images is None:
            self._store_descriptor(keyframe, image)

    def query(self, keyframe: int, map_: Map) -> list[LoopCandidate]:
        if keyframe >= len(self._row) or not (self._described[keyframe] or self._stored(keyframe)):
            return []
        if self._images is not None and not self._on_demand and keyframe in self._images:
            self._describe([keyframe])
            self._images.glance(keyframe)
        eligible = self._searchable(map_)
        eligible[max(0, keyframe - self._config.recent_keyframes) :] = False
        covisible, _ = map_.covisible(keyframe)
        eligible[covisible[covisible < len(eligible)]] = False
        if self._images is not None:
            beyond = beyond_reach(map_, keyframe, self._config)[: len(eligible)]
            eligible &= beyond <= 0
            if not eligible.any():
                return []
            missing = self._without_descriptor(eligible)
            nearest = missing[np.argsort(beyond[missing], kind="stable")]
            self._describe([keyframe, *nearest[: self._config.embedded_at_once].tolist()])
            eligible &= self._described[: len(eligible)]
        threshold = self._config.threshold if self._images is None else self._config.offered
        p = self._similarities(self._descriptors[self._row[keyframe]], eligible)
        p[p < threshold] = -1.0
        rating = p
        if self._images is not None and keyframe in self._images and (p >= 0).any():
            rating = self._local_ratings(p, self._images.glance(keyframe))
        return self._best(keyframe, p, rating, map_)

    def locate(
        self, image: NDArray[np.uint8] | None, features: Features, map_: Map
    ) -> list[LoopCandidate]:
        """Return the keyframes in the map that are most similar to a frame outside the map, best
        first. No threshold is applied, because relocalisation verifies all candidates
        geometrically."""
        if image is None:
            return []
        eligible = self._searchable(map_)
        if self._images is not None:
            self._describe(self._without_descriptor(eligible))  # the camera may be anywhere
        p = self._similarities(self._embed(image), eligible)
        rating = p
        if self._images is not None:
            rating = self._local_ratings(p, self._images.glance_at(image))
        return self._best(-1, p, rating, map_)

    def memory(self) -> DetectorMemory:
        """Return the descriptors that have been computed so far, to be saved in a map file."""
        first = np.concatenate([[0], np.cumsum(self._described)]).astype(np.int64)
        table = PerKeyframe(first, self._descriptors[self._row[self._described]])
        return DetectorMemory(self.name, self._network.fingerprint, {"descriptors": table})

    def restore(self, memory: DetectorMemory) -> None:
        require_same(self.memory(), memory)
        table = memory.tables["descriptors"]
        counts, values = np.diff(table.first), table.values
        columns = (self._network.dimensions if len(values) else 0,)
        valid = values.dtype == np.float32 and (values.shape[1:] == columns or not len(values))
        if not valid or not np.isfinite(values).all() or (counts > 1).any():
            raise ValueError("the descriptors of the keyframes do not belong to the network")
        self._descriptors = values.reshape(len(values), *columns)
        self._n_rows = len(values)
        self._row = np.where(counts > 0, table.first[:-1], -1)

    @property
    def _described(self) -> NDArray[np.bool_]:
        """``(K,)`` bool, True for keyframes whose descriptor has been computed."""
        return self._row >= 0

    def _searchable(self, map_: Map) -> NDArray[np.bool_]:
        """Return ``(n,)`` bool, True for keyframes in the map whose descriptor or image is
        stored."""
        n = min(map_.n_keyframes, len(self._row))
        able = self._described[:n].copy()
        able[[k for k in np.flatnonzero(~able).tolist() if self._stored(k)]] = True
        return able & map_.arrays.keyframe_alive[:n]

    def _stored(self, keyframe: int) -> bool:
        return self._images is not None and keyframe in self._images

    def _without_descriptor(self, keyframes: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return the ids of the keyframes in an ``(n,)`` bool mask that have no descriptor yet."""
        return np.flatnonzero(keyframes & ~self._described[: len(keyframes)])

    def _describe(self, keyframes: Iterable[int]) -> None:
        assert self._images is not None
        for keyframe in keyframes:
            if not self._described[keyframe]:
                self._store_descriptor(keyframe, self._images.image(keyframe))

    def _store_descriptor(self, keyframe: int, image: NDArray[np.uint8]) -> None:
        descriptor = self._embed(image)
        if not self._descriptors.shape[1]:
            self._descriptors = np.zeros((len(self._descriptors), len(descriptor)), np.float32)
        self._descriptors = grown(self._descriptors, self._n_rows + 1)
        self._descriptors[self._n_rows] = descriptor
        self._row[keyframe] = self._n_rows
        self._n_rows += 1

    def _embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        return self._network.embed(to_size(image, self._network.size, self._config.fit))

    def _similarities(
        self, descriptor: NDArray[np.float32], eligible: NDArray[np.bool_]
    ) -> NDArray[np.float32]:
        """Return the ``(N,)`` similarity of each keyframe to a descriptor; -1 for keyframes that
        are not eligible."""
        p = np.full(len(eligible), -1.0, np.float32)
        rows = self._row[: len(eligible)][eligible]
        if len(rows):
            # Rows are passed in the order of the keyframes, not in the order in which they were
            # computed. The reason is that the last bits of a matrix product may depend on the
            # position of a row. Consecutive rows are passed as a view, without a copy.
            consecutive = (np.diff(rows) == 1).all()
            chosen = slice(rows[0], rows[-1] + 1) if consecutive else rows
            p[eligible] = self._network.compare(descriptor, self._descriptors[chosen])
        return p

    def _local_ratings(self, p: NDArray[np.float32], query: DescriptorMaps) -> NDArray[np.float32]:
        """Compare the query with the most similar keyframes again, using local descriptors.

        Args:
            p: ``(N,)`` similarity of the image descriptor of each keyframe.

        Returns:
            ``(N,)`` similarity of the local descriptors; -1 for keyframes that were not compared.
        """
        assert self._images is not None
        rating = np.full(len(p), -1.0, np.float32)
        for keyframe in np.argsort(-p, kind="stable")[:_RERANKED].tolist():
            if p[keyframe] >= 0 and keyframe in self._images:
                glance = self._images.glance(keyframe)
                rating[keyframe] = likeness(query, glance, MIN_COARSE_SIMILARITY)
        return rating

    def _best(
        self,
        query: int,
        p: NDArray[np.float32],
        rating: NDArray[np.float32],
        map_: Map,
    ) -> list[LoopCandidate]:
        """Choose the keyframes with the highest ratings as candidates. The rating is -1 for
        keyframes that cannot be candidates.

        Among several covisible keyframes, only the best one becomes a candidate. Otherwise,
        keyframes of the same place would displace candidates at other places.
        """
        rating = rating.copy()
        found: list[LoopCandidate] = []
        most = self._config.max_candidates
        if self._images is not None:
            most = min(most, self._learned.max_candidates)
        while len(rating) and len(found) < most:
            best = int(np.argmax(rating))
            if rating[best] < 0.0:
                break
            similarity = None if self._images is None else float(rating[best])
            found.append(LoopCandidate(query, best, float(p[best]), similarity, self.name))
            around, _ = map_.covisible(best, _MIN_SHARED)
            rating[around[around < len(rating)]] = -1.0
            rating[best] = -1.0
        return found


def open_detector(
    name: str,
    config: SiameseConfig,
    weights: Path | None = None,
    learned: LearnedMatchingConfig | None = None,
    images: KeyframeImages | None = None,
    *,
    on_demand: bool = False,
) -> SiameseDetector:
    """Create a loop detector and load its Siamese network.

    Args:
        name: one of ``NETWORKS``.
        weights: ONNX file; None uses the weights that vslam ships.
        config, learned, images: see :class:`SiameseDetector`.
        on_demand: whether the shipped weights are loaded at the first image, and the descriptors
            of stored images are computed when needed.

    Raises:
        InputError: the name is unknown, or the weights are missing or belong to a different
            network.
    """
    late = on_demand and weights is None
    network = LateNetwork(name) if late else open_network(name, weights)
    return SiameseDetector(network, config, learned, images, on_demand=on_demand)
