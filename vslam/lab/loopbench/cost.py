"""CPU time and memory of one detector, measured in a separate process.

CPU time hardly depends on what else the machine does.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vslam.lab.loopbench.schema import Cost

if TYPE_CHECKING:
    from vslam.lab.loopbench.detectors import DescribedImage

KEYFRAMES = (1000, 5000)
_DRIVE = (100, 500)  # sizes of the drives for `ibow`, which must process all images first
_REPEATS = 60


def cost(name: str, weights: Path | None) -> Cost:
    """Measure a detector in a new process."""
    command = [sys.executable, "-m", "vslam.lab.loopbench.cost", name, str(weights or "")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return Cost.model_validate_json(done.stdout)


def _median_ms(call: Callable[[], object]) -> float:
    taken = []
    for _ in range(_REPEATS):
        began = time.process_time()
        call()
        taken.append(time.process_time() - began)
    return 1e3 * float(np.median(taken[_REPEATS // 10 :]))


def _bow() -> Cost:
    from vslam.machine import peak_memory_mb

    began = time.process_time()
    from vslam.loopclosure.bow_index import InvertedIndex
    from vslam.loopclosure.vocabulary import bow_vector, load

    vocabulary = load()
    loading = time.process_time() - began
    rng = np.random.default_rng(0)
    nodes = np.flatnonzero(vocabulary.word >= 0)
    bags = [
        vocabulary.descriptors[rng.choice(nodes, 2000)].view(np.uint8).reshape(2000, 32)
        for _ in range(50)
    ]
    image = _median_ms(lambda: bow_vector(vocabulary, vocabulary.words(bags[0])))
    vectors = [bow_vector(vocabulary, vocabulary.words(bag)) for bag in bags]
    query, index = {}, InvertedIndex(vocabulary.n_words)
    for k in range(max(KEYFRAMES)):
        index.add(k, vectors[k % len(vectors)])
        if k + 1 in KEYFRAMES:
            query[str(k + 1)] = _median_ms(lambda: index.compare(vectors[0]))
    return Cost(
        detector="bow", load_s=loading, image_ms=image, query_ms=query,
        parameters=vocabulary.n_words, memory_mb=peak_memory_mb(),
    )  # fmt: skip


def _network(name: str, weights: Path | None) -> Cost:
    from vslam.machine import peak_memory_mb

    began = time.process_time()
    from vslam.config import SiameseConfig
    from vslam.loopclosure.siamese.scoring import NetworkScorer

    network = NetworkScorer(name, weights, SiameseConfig().fit)
    loading = time.process_time() - began
    image = np.random.default_rng(0).integers(0, 256, (376, 1241), dtype=np.uint8)
    query = {}
    embedding = _median_ms(lambda: network.embed([image]))
    one = network.embed([image])[0]
    for n in KEYFRAMES:
        gallery = np.random.default_rng(1).standard_normal((n, len(one))).astype(np.float32)
        query[str(n)] = _median_ms(partial(network.compare, one, gallery))
    return Cost(
        detector=name, load_s=loading, image_ms=embedding, query_ms=query,
        parameters=network.parameters, memory_mb=peak_memory_mb(),
    )  # fmt: skip


def _thumbnail() -> Cost:
    from vslam.machine import peak_memory_mb

    began = time.process_time()
    from vslam.lab.loopbench.thumbnail import correlations, remember, thumbnail

    loading = time.process_time() - began
    image = np.random.default_rng(0).integers(0, 256, (376, 1241), dtype=np.uint8)
    one = thumbnail(image)[None]
    query = {
        str(n): _median_ms(partial(correlations, one, remember(np.repeat(one, n, axis=0))))
        for n in KEYFRAMES
    }
    return Cost(
        detector="thumbnail", load_s=loading, image_ms=_median_ms(lambda: thumbnail(image)),
        query_ms=query, parameters=0, memory_mb=peak_memory_mb(),
    )  # fmt: skip


def _lsgd() -> Cost:
    from vslam.machine import peak_memory_mb

    began = time.process_time()
    from vslam.lab.loopbench.lsgd import lsgd, similarities

    loading = time.process_time() - began
    image = np.random.default_rng(0).integers(0, 256, (376, 1241), dtype=np.uint8)
    one = lsgd(image)[None]
    query = {
        str(n): _median_ms(partial(similarities, one, np.repeat(one, n, 0))) for n in KEYFRAMES
    }
    return Cost(
        detector="lsgd", load_s=loading, image_ms=_median_ms(lambda: lsgd(image)),
        query_ms=query, parameters=0, memory_mb=peak_memory_mb(),
    )  # fmt: skip


def _ibow() -> Cost:
    """Cost for a simulated drive, whose own words form the vocabulary. As in a video, each image
    shares two thirds of its features with the previous one, with a few bits changed."""
    from vslam.machine import peak_memory_mb

    began = time.process_time()
    from vslam.lab.loopbench.incremental_bow import IncrementalBow

    loading = time.process_time() - began
    detector, images = IncrementalBow(), _made_up_drive(max(_DRIVE))
    adding, query = [], {}
    for k, image in enumerate(images):
        began = time.process_time()
        detector.add(image)
        adding.append(time.process_time() - began)
        if k + 1 in _DRIVE:
            query[str(k + 1)] = _median_ms(partial(detector.find, image))
    return Cost(
        detector="ibow", load_s=loading, image_ms=1e3 * float(np.median(adding[-100:])),
        query_ms=query, parameters=detector.n_words, memory_mb=peak_memory_mb(),
    )  # fmt: skip


def _made_up_drive(n: int) -> Iterator[DescribedImage]:
    from vslam.lab.loopbench.detectors import DescribedImage
    from vslam.lab.loopbench.node_matching import index_nodes

    rng = np.random.default_rng(0)
    no_image, no_words = np.empty((0, 0), np.uint8), np.empty(0, np.int32)
    descriptors = rng.integers(0, 256, (2000, 32), np.uint8)
    for _ in range(n):
        fresh = rng.random(len(descriptors)) < 1 / 3
        descriptors[fresh] = rng.integers(0, 256, (int(fresh.sum()), 32), np.uint8)
        for _ in range(8):  # bits
            bit = np.uint8(1) << rng.integers(0, 8, len(descriptors)).astype(np.uint8)
            descriptors[np.arange(len(descriptors)), rng.integers(0, 32, len(descriptors))] ^= bit
        xy = np.zeros((len(descriptors), 2), np.float32)
        yield DescribedImage(no_image, xy, descriptors.copy(), no_words, index_nodes(no_words))


if __name__ == "__main__":
    name, file = sys.argv[1:3]
    untrained = {"bow": _bow, "thumbnail": _thumbnail, "lsgd": _lsgd, "ibow": _ibow}
    found = untrained[name]() if name in untrained else _network(name, Path(file) if file else None)
    sys.stdout.write(found.model_dump_json())
