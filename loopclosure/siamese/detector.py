"""Loop detectors that compare descriptors of a Siamese network."""

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

    Where images are kept, the network sees a keyframe only once the camera is near enough to it
    that it may be there again (:func:`beyond_reach`), or lost: on a drive that never returns, none.

    Descriptors of the keyframes that the network has seen are rows of one matrix that grows by
    half. It has no columns before the network was asked.
    """

    def __init__(
        self,
        network: OnnxNetwork | LateNetwork,
        config: SiameseConfig,
        learned: LearnedMatchingConfig | None = None,
        images: KeyframeImages | None = None,
    ) -> None:
        """The network's name becomes the detector's.

        Args:
            learned: how candidates are matched.
            images: where they are kept, local descriptors put the most similar keyframes in order:
                by night the place is among these more often than the first. Then the threshold is
                ``offered``. None for the similarity alone.
        """
        self.name = network.name
        self._network = network
        self._learned = learned or LearnedMatchingConfig()
        self._images = images
        self._config = config
        self._descriptors = np.zeros((64, 0), np.float32)
        self._n_seen = 0  # rows in use
        self._row = np.full(64, -1, np.int64)  # of each keyframe, -1 for those not seen

    def add(self, keyframe: int, image: NDArray[np.uint8] | None, features: Features) -> None:
        """Remember a keyframe. Without its image it can be neither query nor match."""
        if keyframe >= len(self._row):
            more = max(keyframe + 1 - len(self._row), len(self._row) // 2)
            self._row = np.pad(self._row, (0, more), constant_values=-1)
        if image is not None and self._images is None:
            self._remember(keyframe, image)

    def query(self, keyframe: int, map_: Map) -> list[LoopCandidate]:
        """Best first: alive, neither recent nor covisible, similarity at or above the threshold."""
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
        """The living keyframes most like a frame outside the map, whatever their similarity.

        Relocalisation verifies them by geometry and has nothing to lose: no threshold.
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
        """See :class:`LoopDetector`: the descriptors of the keyframes with an image."""
        first = np.concatenate([[0], np.cumsum(self._known)]).astype(np.int64)
        table = PerKeyframe(first, self._descriptors[self._row[self._known]])
        return DetectorMemory(self.name, self._network.fingerprint, {"descriptors": table})

    def restore(self, memory: DetectorMemory) -> None:
        """See :class:`LoopDetector`."""
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
        """``(K,)`` keyframes that the network has seen."""
        return self._row >= 0

    def _alive(self, map_: Map) -> NDArray[np.bool_]:
        """``(n,)`` living keyframes with a descriptor, or with an image for one."""
        n = min(map_.n_keyframes, len(self._row))
        able = self._known[:n].copy()
        able[[k for k in np.flatnonzero(~able).tolist() if self._pending(k)]] = True
        return able & map_.arrays.keyframe_alive[:n]

    def _pending(self, keyframe: int) -> bool:
        return self._images is not None and keyframe in self._images

    def _unseen(self, keyframes: NDArray[np.bool_]) -> NDArray[np.int64]:
        return np.flatnonzero(keyframes & ~self._known[: len(keyframes)])

    def _see(self, keyframes: Iterable[int]) -> None:
        """Embed keyframes that are not yet."""
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
        """``(N,)``, -1 for keyframes that are not eligible."""
        p = np.full(len(eligible), -1.0, np.float32)
        rows = self._row[: len(eligible)][eligible]
        if len(rows):
            # In the order of the keyframes, in whichever order they were seen: the last bits of a
            # product of matrices may depend on where a row stands. Without gaps, nothing is copied.
            in_a_row = (np.diff(rows) == 1).all()
            gallery = (
                self._descriptors[rows[0] : rows[-1] + 1] if in_a_row else self._descriptors[rows]
            )
            p[eligible] = self._network.compare(descriptor, gallery)
        return p

    def _reranked(self, p: NDArray[np.float32], query: DescriptorMaps) -> NDArray[np.float32]:
        """``(N,)``: how much of the image looks alike, of the most similar keyframes; -1 of the
        others."""
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
        """Candidates by descending ``order`` ``(N,)``, which is -1 for those that are none."""
        order = order.copy()
        found: list[LoopCandidate] = []
        most = self._config.max_candidates
        if self._images is not None:
            most = min(most, self._learned.max_candidates)
        # Neighbours of a good match match well, too: they would crowd out the other places.
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
    """A detector with its weights.

    Args:
        name: one of ``NETWORKS``.
        weights: ONNX file; None for the ones that vslam ships.
        config, learned, images: as :class:`SiameseDetector` takes them.
        late: load the weights that vslam ships when the first image comes.

    Raises:
        InputError: unknown name, no weights, or weights of another network.
    """
    late = late and weights is None
    network = LateNetwork(name) if late else open_network(name, weights)
    return SiameseDetector(network, config, learned, images)
