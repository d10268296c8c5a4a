"""The loop detector that compares image descriptors of a Siamese network."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.config import LearnedMatchingConfig, SiameseConfig
from vslam.features import Features
from vslam.loopclosure.bow_index import grown
from vslam.loopclosure.detector import require_same
from vslam.loopclosure.local_matching import DescriptorMaps, likeness
from vslam.loopclosure.reach import beyond_reach
from vslam.loopclosure.siamese.images import to_size
from vslam.loopclosure.siamese.inference import LateNetwork, OnnxNetwork, open_network
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.loops import DetectorMemory, LoopCandidate, PerKeyframe
from vslam.map import Map


class SiameseDetector:
    """Implements :class:`vslam.loopclosure.detector.LoopDetector`.

    If the images of keyframes are stored (``images``), the network computes the descriptor of a
    keyframe only when the camera comes within reach of it (:func:`beyond_reach`) or is lost. So on
    a drive that never returns the network is not run at all.

    Descriptors are rows of a matrix that grows by half when it is full. The matrix has no columns
    until the network has computed the first descriptor.
    """

    def __init__(
        self,
        network: OnnxNetwork | LateNetwork,
        config: SiameseConfig,
        learned: LearnedMatchingConfig | None = None,
        images: KeyframeImages | None = None,
    ) -> None:
        """The detector takes the name of the network.

        Args:
            learned: thresholds for local descriptors; None takes the defaults.
            images: the store of keyframe images. If it is given, the most similar keyframes are
                ranked again by local descriptors, because by night the right place is often among
                them but not first; and the threshold on the similarity is ``offered``. None ranks
                by the similarity alone, with ``threshold``.
        """
        self.name = network.name
        self._network = network
        self._learned = learned or LearnedMatchingConfig()
        self._images = images
        self._config = config
        self._descriptors = np.zeros((64, 0), np.float32)
        self._n_seen = 0  # number of rows in use
        self._row = np.full(64, -1, np.int64)  # row of each keyframe, -1 without a descriptor

    def add(self, keyframe: int, image: NDArray[np.uint8] | None, features: Features) -> None:
        """Remember a keyframe. A keyframe without an image is never a query and never a match."""
        if keyframe >= len(self._row):
            more = max(keyframe + 1 - len(self._row), len(self._row) // 2)
            self._row = np.pad(self._row, (0, more), constant_values=-1)
        if image is not None and self._images is None:
            self._remember(keyframe, image)

    def query(self, keyframe: int, map_: Map) -> list[LoopCandidate]:
        """See :class:`LoopDetector`; candidates have at least the threshold's similarity."""
        if keyframe >= len(self._row) or not (self._known[keyframe] or self._pending(keyframe)):
            return []
        eligible = self._alive(map_)
        eligible[max(0, keyframe - self._config.recent_keyframes) :] = False
        covisible, _ = map_.covisible(keyframe)
        eligible[covisible[covisible < len(eligible)]] = False
        if self._images is not None:
            away = beyond_reach(map_, keyframe, self._config)[: len(eligible)]
            eligible &= away <= 0
            if not eligible.any():
                return []
            unseen = self._unseen(eligible)
            nearest = unseen[np.argsort(away[unseen], kind="stable")]
            self._see([keyframe, *nearest[: self._config.embedded_at_once].tolist()])
            eligible &= self._known[: len(eligible)]
        threshold = self._config.threshold if self._images is None else self._config.offered
        p = self._similarities(self._descriptors[self._row[keyframe]], eligible)
        p[p < threshold] = -1.0
        order = p
        if self._images is not None and keyframe in self._images and (p >= 0).any():
            order = self._reranked(p, self._images.glance(keyframe))
        return self._best(keyframe, p, order, map_)

    def locate(
        self, image: NDArray[np.uint8] | None, features: Features, map_: Map
    ) -> list[LoopCandidate]:
        """The living keyframes that are most similar to a frame outside the map, best first.

        There is no threshold, because relocalisation verifies candidates by geometry anyway.
        """
        if image is None:
            return []
        alive = self._alive(map_)
        if self._images is not None:
            self._see(self._unseen(alive))  # the camera may be anywhere
        p = self._similarities(self._embed(image), alive)
        order = p
        if self._images is not None:
            order = self._reranked(p, self._images.glance_at(image))
        return self._best(-1, p, order, map_)

    def memory(self) -> DetectorMemory:
        """See :class:`LoopDetector`; contains the descriptors that were computed."""
        first = np.concatenate([[0], np.cumsum(self._known)]).astype(np.int64)
        table = PerKeyframe(first, self._descriptors[self._row[self._known]])
        return DetectorMemory(self.name, self._network.fingerprint, {"descriptors": table})

    def restore(self, memory: DetectorMemory) -> None:
        require_same(self.memory(), memory)
        table = memory.tables["descriptors"]
        known, values = np.diff(table.first), table.values
        columns = (self._network.dimensions if len(values) else 0,)
        right = values.dtype == np.float32 and (values.shape[1:] == columns or not len(values))
        if not right or not np.isfinite(values).all() or (known > 1).any():
            raise ValueError("the descriptors of the keyframes are not those of the network")
        self._descriptors = values.reshape(len(values), *columns)
        self._n_seen = len(values)
        self._row = np.where(known > 0, table.first[:-1], -1)

    @property
    def _known(self) -> NDArray[np.bool_]:
        """``(K,)`` bool, keyframes with a descriptor."""
        return self._row >= 0

    def _alive(self, map_: Map) -> NDArray[np.bool_]:
        """``(n,)`` bool, living keyframes with a descriptor, or with an image to compute it
        from."""
        n = min(map_.n_keyframes, len(self._row))
        able = self._known[:n].copy()
        able[[k for k in np.flatnonzero(~able).tolist() if self._pending(k)]] = True
        return able & map_.arrays.keyframe_alive[:n]

    def _pending(self, keyframe: int) -> bool:
        return self._images is not None and keyframe in self._images

    def _unseen(self, keyframes: NDArray[np.bool_]) -> NDArray[np.int64]:
        return np.flatnonzero(keyframes & ~self._known[: len(keyframes)])

    def _see(self, keyframes: Iterable[int]) -> None:
        """Compute the descriptors of keyframes that have none yet."""
        assert self._images is not None
        for keyframe in keyframes:
            if not self._known[keyframe]:
                self._remember(keyframe, self._images.image(keyframe))

    def _remember(self, keyframe: int, image: NDArray[np.uint8]) -> None:
        descriptor = self._embed(image)
        if not self._descriptors.shape[1]:
            self._descriptors = np.zeros((len(self._descriptors), len(descriptor)), np.float32)
        self._descriptors = grown(self._descriptors, self._n_seen + 1)
        self._descriptors[self._n_seen] = descriptor
        self._row[keyframe] = self._n_seen
        self._n_seen += 1

    def _embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        return self._network.embed(to_size(image, self._network.size, self._config.fit))

    def _similarities(
        self, descriptor: NDArray[np.float32], eligible: NDArray[np.bool_]
    ) -> NDArray[np.float32]:
        """``(N,)`` similarity of each keyframe, -1 for keyframes that are not eligible."""
        p = np.full(len(eligible), -1.0, np.float32)
        rows = self._row[: len(eligible)][eligible]
        if len(rows):
            # Rows are passed in the order of the keyframes, not in that of their computation,
            # because the last bits of a matrix product may depend on the position of a row.
            # Consecutive rows are passed as a view, without a copy.
            in_a_row = (np.diff(rows) == 1).all()
            gallery = (
                self._descriptors[rows[0] : rows[-1] + 1] if in_a_row else self._descriptors[rows]
            )
            p[eligible] = self._network.compare(descriptor, gallery)
        return p

    def _reranked(self, p: NDArray[np.float32], query: DescriptorMaps) -> NDArray[np.float32]:
        """``(N,)`` similarity of the images by local descriptors for the most similar keyframes, -1
        for the others."""
        assert self._images is not None
        order = np.full(len(p), -1.0, np.float32)
        for keyframe in np.argsort(-p, kind="stable")[: self._config.reranked].tolist():
            if p[keyframe] >= 0 and keyframe in self._images:
                glance = self._images.glance(keyframe)
                order[keyframe] = likeness(query, glance, self._learned.coarse_alike)
        return order

    def _best(
        self,
        query: int,
        p: NDArray[np.float32],
        order: NDArray[np.float32],
        map_: Map,
    ) -> list[LoopCandidate]:
        """Candidates in descending ``order`` ``(N,)``; it is -1 for keyframes that are not
        candidates."""
        order = order.copy()
        found: list[LoopCandidate] = []
        most = self._config.max_candidates
        if self._images is not None:
            most = min(most, self._learned.max_candidates)
        # The neighbours of a good match are similar as well and would crowd out other places.
        while len(order) and len(found) < most:
            best = int(np.argmax(order))
            if order[best] < 0.0:
                break
            alike = None if self._images is None else float(order[best])
            found.append(LoopCandidate(query, best, float(p[best]), alike, self.name))
            around, _ = map_.covisible(best, self._config.min_shared)
            order[around[around < len(order)]] = -1.0
            order[best] = -1.0
        return found


def open_detector(
    name: str,
    config: SiameseConfig,
    weights: Path | None = None,
    learned: LearnedMatchingConfig | None = None,
    images: KeyframeImages | None = None,
    *,
    late: bool = False,
) -> SiameseDetector:
    """Create a detector and load its network.

    Args:
        name: one of ``NETWORKS``.
        weights: ONNX file; None takes the weights that vslam ships.
        config, learned, images: as in :class:`SiameseDetector`.
        late: whether to load weights that vslam ships only when the first image comes.

    Raises:
        InputError: the name is unknown, or there are no weights, or those of another network.
    """
    late = late and weights is None
    network = LateNetwork(name) if late else open_network(name, weights)
    return SiameseDetector(network, config, learned, images)
