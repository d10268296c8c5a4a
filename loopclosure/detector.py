"""What a loop detector is: the plug-in point of the learned detectors and of the bag of words."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vslam.features import Features
from vslam.loops import DetectorMemory, LoopCandidate
from vslam.map import Map


class LoopDetector(Protocol):
    """Remembers keyframes by their looks and finds those that look alike.

    Calls come in the order of the keyframes, from one thread at a time.

    What follows a detector is the same code for all: rating and verification of candidates,
    consistency, correction. Which descriptors verify is a threshold, ``verification.descriptors``.
    Its default differs between detectors: ORB alone for ``bow``, ``capsule-paper`` and plug-ins;
    ORB and, where that fails, the network's local descriptors for ``both`` and the networks, which
    then also reorder their 20 most similar keyframes by these descriptors (those of the capsule
    network's extractor, whichever network made the candidates). A comparison that is to isolate the
    detectors sets it to ``orb`` or ``both`` for all of them.
    """

    name: str

    def add(self, keyframe: int, image: NDArray[np.uint8] | None, features: Features) -> None:
        """Remember a keyframe. ``image`` is its ``(H, W)`` left image, None if it was not kept."""
        ...

    def query(self, keyframe: int, map_: Map) -> list[LoopCandidate]:
        """Places that look like a keyframe added before, best first: living keyframes that are
        neither recent nor covisible with it."""
        ...

    def locate(
        self, image: NDArray[np.uint8] | None, features: Features, map_: Map
    ) -> list[LoopCandidate]:
        """Living keyframes that look like a frame outside the map, best first, with query -1."""
        ...

    def memory(self) -> DetectorMemory:
        """What is known of all keyframes up to now, for a map file. Its arrays are not to be
        written to: they are the detector's own."""
        ...

    def restore(self, memory: DetectorMemory) -> None:
        """Remember what a detector like this one knew, in place of ``add`` for each keyframe.

        Raises:
            ValueError: in a few words: it was another detector, or the memory is damaged.
        """
        ...


def require_same(detector: DetectorMemory, memory: DetectorMemory) -> None:
    """Refuse the memory of another detector than this one, whose own memory is ``detector``.

    Raises:
        ValueError: it has another name, vocabulary or weights.
    """
    if memory.name != detector.name:
        raise ValueError(f"made with the detector {memory.name}, not {detector.name}")
    if memory.fingerprint != detector.fingerprint:
        raise ValueError(f"made with another vocabulary or other weights of {detector.name}")


class NoDetector:
    """Finds nothing: odometry only."""

    name = "none"

    def add(self, keyframe: int, image: NDArray[np.uint8] | None, features: Features) -> None:
        pass

    def query(self, keyframe: int, map_: Map) -> list[LoopCandidate]:
        return []

    def locate(
        self, image: NDArray[np.uint8] | None, features: Features, map_: Map
    ) -> list[LoopCandidate]:
        return []

    def memory(self) -> DetectorMemory:
        return DetectorMemory()

    def restore(self, memory: DetectorMemory) -> None:
        require_same(self.memory(), memory)
