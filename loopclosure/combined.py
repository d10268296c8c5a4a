"""A loop detector that combines the candidates of several loop detectors."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain, zip_longest

import numpy as np
from numpy.typing import NDArray

from vslam.loopclosure.detector import LoopDetector, require_same
from vslam.types.features import Features
from vslam.types.loops import DetectorMemory, LoopCandidate
from vslam.types.map import Map


class CombinedDetector:
    """A :class:`vslam.loopclosure.detector.LoopDetector` that combines the candidates of several
    detectors.

    The scores of different detectors are not comparable. Therefore, the best candidate of each
    detector comes first, then the second best of each, and so on. Two candidates for the same
    keyframe become one.

    Several keyframes of the same place may all remain candidates, because after a change in
    lighting, only one of these keyframes may be recognisable.
    """

    def __init__(self, name: str, detectors: list[LoopDetector]) -> None:
        self.name = name
        self._detectors = detectors

    def add(self, keyframe: int, image: NDArray[np.uint8] | None, features: Features) -> None:
        for one in self._detectors:
            one.add(keyframe, image, features)

    def query(self, keyframe: int, map_: Map) -> list[LoopCandidate]:
        return _interleaved([one.query(keyframe, map_) for one in self._detectors])

    def locate(
        self, image: NDArray[np.uint8] | None, features: Features, map_: Map
    ) -> list[LoopCandidate]:
        return _interleaved([one.locate(image, features, map_) for one in self._detectors])

    def memory(self) -> DetectorMemory:
        memories = [one.memory() for one in self._detectors]
        tables = {
            f"{memory.name}/{name}": table
            for memory in memories
            for name, table in memory.tables.items()
        }
        fingerprint = "/".join(memory.fingerprint for memory in memories)
        return DetectorMemory(self.name, fingerprint, tables)

    def restore(self, memory: DetectorMemory) -> None:
        require_same(self.memory(), memory)
        for one in self._detectors:
            own = one.memory()
            tables = {name: memory.tables[f"{own.name}/{name}"] for name in own.tables}
            one.restore(replace(own, tables=tables))


def _interleaved(found: list[list[LoopCandidate]]) -> list[LoopCandidate]:
    """Return the first candidate of each detector, then the second of each, and so on."""
    by_match: dict[int, LoopCandidate] = {}
    for candidate in chain.from_iterable(zip_longest(*found)):
        if candidate is not None:
            known = by_match.get(candidate.match)
            by_match[candidate.match] = _joined(known, candidate) if known else candidate
    return list(by_match.values())


def _joined(first: LoopCandidate, second: LoopCandidate) -> LoopCandidate:
    """Combine two candidates for the same keyframe. The result has the score of the first
    candidate."""
    similarity = second.similarity if first.similarity is None else first.similarity
    names = f"{first.proposed_by}+{second.proposed_by}"
    return replace(first, similarity=similarity, proposed_by=names)
