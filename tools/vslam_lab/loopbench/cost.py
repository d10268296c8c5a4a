"""Measures the CPU time and the memory of one loop detector in a separate process.

Unlike wall time, CPU time hardly depends on the load of the machine.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from vslam_lab.loopbench.schema import Cost

KEYFRAMES = (1000, 5000)
_REPEATS = 60


def cost(name: str, weights: Path | None) -> Cost:
    command = [sys.executable, "-m", "vslam_lab.loopbench.cost", name, str(weights or "")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return Cost.model_validate_json(done.stdout)


def _median_ms(call: Callable[[], object]) -> float:
    taken = []
    for _ in range(_REPEATS):
        began = time.process_time()
        call()
        taken.append(time.process_time() - began)
    return 1e3 * float(np.median(taken[_REPEATS // 10 :]))


def _bow(file: Path | None) -> Cost:
    from vslam.support.machine import peak_memory_mb

    began = time.process_time()
    from vslam.loopclosure.bow_index import InvertedIndex
    from vslam.loopclosure.vocabulary import SHIPPED, bow_vector
    from vslam.loopclosure.vocabulary_text import read_vocabulary

    vocabulary = read_vocabulary(file or SHIPPED)
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
    from vslam.support.machine import peak_memory_mb

    began = time.process_time()
    from vslam_lab.loopbench.detectors import NetworkScorer

    network = NetworkScorer(name, weights)
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


if __name__ == "__main__":
    name, file = sys.argv[1:3]
    found = (_bow if name == "bow" else partial(_network, name))(Path(file) if file else None)
    sys.stdout.write(found.model_dump_json())
