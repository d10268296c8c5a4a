"""A loop detector that merges the candidates of several others."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain, zip_longest

import numpy as np
from numpy.typing import NDArray

from vslam.features import Features
from vslam.loopclosure.detector import LoopDetector, require_same
from vslam.loops import DetectorMemory, LoopCandidate
from vslam.map import Map


class CombinedDetector:
    """Implements :class:`vslam.loopclosure.detector.LoopDetector`.

    The scores of different detectors are not comparable, so the candidates of all detectors are
    interleaved: first the best one of each, then the second best, and so on. Candidates at the same
    place are merged into the first of them.
    """

    def __init__(self, name: str, detectors: list[LoopDetector], min_shared: int) -> None:
        """``min_shared`` is the number of shared landmarks from which on two keyframes count as the
        same place."""
        self.name = name
        self._detectors, self._min_shared = detectors, min_shared

    def add(self, keyframe: int, image: NDArray[np.uint8] | None, features: Features) -> None:
        for one in self._detectors:
            one.add(keyframe, image, features)

    def query(self, keyframe: int, map_: Map) -> list[LoopCandidate]:
        return self._merged([one.query(keyframe, map_) for one in self._detectors], map_)

    def locate(
        self, image: NDArray[np.uint8] | None, features: Features, map_: Map
    ) -> list[LoopCandidate]:
        return self._merged([one.locate(image, features, map_) for one in self._detectors], map_)

    def memory(self) -> DetectorMemory:
        """See :class:`LoopDetector`; contains the memory of each detector under its name."""
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

    def _merged(self, found: list[list[LoopCandidate]], map_: Map) -> list[LoopCandidate]:
        merged: list[LoopCandidate] = []
        place: dict[int, int] = {}  # keyframe -> index of the merged candidate at the same place
        for candidate in chain.from_iterable(zip_longest(*found)):
            if candidate is None:
                continue
            known = place.get(candidate.match)
            if known is not None:
                merged[known] = _joined(merged[known], candidate)
                continue
            around, _ = map_.covisible(candidate.match, self._min_shared)
            for keyframe in (candidate.match, *around.tolist()):
                place.setdefault(keyframe, len(merged))
            merged.append(candidate)
        return merged


def _joined(first: LoopCandidate, second: LoopCandidate) -> LoopCandidate:
    """Join two candidates at the same place: the first one, with the names of both detectors and,
    if it has no ``alike``, that of the second one."""
    names = first.proposed_by.split("+")
    if second.proposed_by not in names:
        names.append(second.proposed_by)
    alike = second.alike if first.alike is None else first.alike
    return replace(first, alike=alike, proposed_by="+".join(names))
