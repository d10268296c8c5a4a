"""Loop detectors that compute the similarity of images without a map."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from vslam.config import OrbConfig, SiameseConfig
from vslam.frontend.orb import extract
from vslam.loopclosure.bow_index import InvertedIndex
from vslam.loopclosure.local_matching import DescriptorMaps
from vslam.loopclosure.names import DETECTORS
from vslam.loopclosure.registry import require_detector
from vslam.loopclosure.siamese.images import to_size
from vslam.loopclosure.siamese.inference import open_network
from vslam.loopclosure.vocabulary import Vocabulary, bow_vector
from vslam.support.errors import InputError, did_you_mean
from vslam_lab.loopbench.conditions import Image
from vslam_lab.loopbench.node_matching import NodeIndex, index_nodes

if TYPE_CHECKING:
    from vslam.loopclosure.siamese.local_descriptors import LocalDescriptors


_MATCHING_LEVEL = 2  # vocabulary level with about 100 nodes; features are matched within a node
_KEPT_FINE = 8  # images whose fine local descriptors are cached
_KEPT_GALLERIES = 3  # galleries that are cached: the unchanged town, and those of two strengths


@dataclass(frozen=True, eq=False)
class DescribedImage:
    """An image with its ORB features.

    Attributes:
        image: ``(H, W)`` uint8.
        xy: ``(N, 2)`` float32 positions of the features in pixels.
        descriptors: ``(N, 32)`` uint8.
        words: ``(N,)`` int32 visual word of each feature.
        nodes: direct index of the image, which lists the features under each node of the
            vocabulary.
    """

    image: Image
    xy: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    words: NDArray[np.int32]
    nodes: NodeIndex


def describe(images: list[Image], vocabulary: Vocabulary, threads: int) -> list[DescribedImage]:
    """Extract the ORB features of images with the same settings as ``vslam run``."""
    node_of_word = vocabulary.ancestors(_MATCHING_LEVEL)

    def one(image: Image) -> DescribedImage:
        found = extract(image, OrbConfig())
        words = vocabulary.words(found.descriptors)
        return DescribedImage(
            image, found.xy, found.descriptors, words, index_nodes(node_of_word[words])
        )

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(one, images))


class Scorer(Protocol):
    """A loop detector that compares query images with gallery images and does not need a map."""

    name: str
    probability: bool
    """Whether the scores are probabilities, so that the accuracy at p = 0.5 and 0.9 is defined."""

    def store(self, gallery: list[DescribedImage]) -> Any:
        """Compute the data that the detector needs to compare query images with a gallery."""

    def scores(self, queries: list[DescribedImage], stored: Any) -> NDArray[np.float64]:
        """Compute the ``(Q, G)`` similarities of Q query images and G gallery images.

        A higher value means that two images are more similar.
        """


class BowScorer:
    """A bag-of-words detector that does not need a map.

    It has the weights (tf-idf) and the score (L1) of `vslam.loopclosure.bow.BowDetector`.
    """

    name = "bow"
    probability = False

    def __init__(self, vocabulary: Vocabulary) -> None:
        self._vocabulary = vocabulary

    def store(self, gallery: list[DescribedImage]) -> InvertedIndex:
        index = InvertedIndex(self._vocabulary.n_words)
        for number, one in enumerate(gallery):
            index.add(number, bow_vector(self._vocabulary, one.words))
        return index

    def scores(self, queries: list[DescribedImage], stored: InvertedIndex) -> NDArray[np.float64]:
        return np.stack(
            [stored.compare(bow_vector(self._vocabulary, one.words)).score for one in queries]
        ).astype(np.float64)


def require_comparable(name: str, weights: Path | None) -> None:
    """Check that a loop detector can be compared, without importing large packages.

    Raises:
        InputError: the detector is unknown, or there are no weights for it.
    """
    if name == "none":
        raise InputError("--detectors none: finds no loops; leave it out.")
    if name == "both":
        raise InputError("--detectors both: has no score of its own; give bow,capsule.")
    if name not in DETECTORS:
        known = [one for one in DETECTORS if one not in ("none", "both")]
        raise InputError(
            f"--detectors {name}: unknown{did_you_mean(name, known)}; choose from "
            f"{', '.join(known)}."
        )
    require_detector(name, weights, "--detectors")


def open_scorer(name: str, weights: Path | None, vocabulary: Vocabulary) -> Scorer:
    """Open the loop detector ``bow`` or one of ``NETWORKS``.

    Raises:
        InputError: the weights are missing or belong to a different network.
    """
    return BowScorer(vocabulary) if name == "bow" else NetworkScorer(name, weights)


class NetworkScorer:
    """A loop detector that runs one of ``NETWORKS`` on one thread.

    ``parameters`` is the number of learned parameters.
    """

    probability = True

    def __init__(self, name: str, weights: Path | None = None) -> None:
        self._network = open_network(name, weights)
        self.name, self.parameters = name, int(self._network.about["parameters"])
        self.compare = self._network.compare

    def store(self, gallery: list[DescribedImage]) -> NDArray[np.float32]:
        """Compute the ``(G, D)`` descriptors of G gallery images."""
        return self.embed([one.image for one in gallery])

    def scores(
        self, queries: list[DescribedImage], stored: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        embedded = self.store(queries)
        return np.stack([self.compare(one, stored) for one in embedded]).astype(np.float64)

    def embed(self, images: list[Image]) -> NDArray[np.float32]:
        """Compute the ``(N, D)`` descriptors of N images, each ``(H, W)`` uint8."""
        size, fit = self._network.size, SiameseConfig().fit
        return np.stack([self._network.embed(to_size(one, size, fit)) for one in images])


class LocalDescriptorCache:
    """The local descriptors of images.

    Coarse descriptors are computed once per image, and are kept as long as the image is used. Fine
    descriptors take eight times as much memory, so only those of the last few images are kept.
    """

    def __init__(self) -> None:
        self._network: LocalDescriptors | None = None
        self._kept: WeakKeyDictionary[DescribedImage, DescriptorMaps] = WeakKeyDictionary()
        self._fine: OrderedDict[DescribedImage, DescriptorMaps] = OrderedDict()

    def of(self, described: DescribedImage) -> DescriptorMaps:
        """Return the coarse local descriptors of an image.

        Raises:
            InputError: the local-descriptor network cannot be read.
        """
        if described not in self._kept:
            self._kept[described] = self._describe(described).coarse_alone()
        return self._kept[described]

    def with_fine(self, described: DescribedImage) -> DescriptorMaps:
        """Return the coarse and the fine local descriptors of an image.

        Raises:
            InputError: the local-descriptor network cannot be read.
        """
        if described not in self._fine:
            self._fine[described] = self._describe(described)
            while len(self._fine) > _KEPT_FINE:
                self._fine.popitem(last=False)
        self._fine.move_to_end(described)
        return self._fine[described]

    def _describe(self, described: DescribedImage) -> DescriptorMaps:
        if self._network is None:
            from vslam.loopclosure.siamese.local_descriptors import LocalDescriptors

            self._network = LocalDescriptors()
        return self._network.describe(described.image)


class DetectorSet:
    """The loop detectors that are compared. The first detector is the baseline.

    Most conditions (changes of the query images) are measured on the same gallery images.
    Therefore, the features of the last few galleries are cached.
    """

    def __init__(self, scorers: list[Scorer], vocabulary: Vocabulary, threads: int) -> None:
        self.scorers = tuple(scorers)
        self._vocabulary, self._threads = vocabulary, threads
        self.local = LocalDescriptorCache()
        self._kept: OrderedDict[bytes, tuple[list[DescribedImage], dict[str, Any]]] = OrderedDict()

    def gallery(self, images: list[Image]) -> tuple[list[DescribedImage], dict[str, Any]]:
        """Return the features of gallery images, and the result of `Scorer.store` by detector."""
        hashed = hashlib.blake2b()
        for image in images:
            hashed.update(f"{image.shape}".encode())
            hashed.update(image.tobytes())
        digest = hashed.digest()
        if digest not in self._kept:
            described = self.describe(images)
            self._kept[digest] = described, {one.name: one.store(described) for one in self.scorers}
            while len(self._kept) > _KEPT_GALLERIES:
                self._kept.popitem(last=False)
        self._kept.move_to_end(digest)
        return self._kept[digest]

    def describe(self, images: list[Image]) -> list[DescribedImage]:
        return describe(images, self._vocabulary, self._threads)
