"""The interface of loop detectors: bag of words, learned networks, and plug-ins."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vslam.features import Features
from vslam.loops import DetectorMemory, LoopCandidate
from vslam.map import Map


class LoopDetector(Protocol):
    """Stores the appearance of keyframes and finds keyframes that look similar.

    The methods are called in the order of the keyframes, by one thread at a time.

    All detectors share the later stages: rating and verification of candidates, consistency, and
    correction. However, detectors differ in the descriptors that verify their candidates. The
    setting ``verification.descriptors`` selects these descriptors, and its default depends on the
    detector.

    For ``bow``, ``capsule-paper`` and plug-ins, candidates are verified only by ORB descriptors.
    For ``both`` and the other networks, candidates that ORB rejects are verified again by learned
    local descriptors. These detectors also use the local descriptors to rank the 20 most similar
    keyframes. The local descriptors always come from the feature extractor of the capsule network,
    regardless of the network that proposed the candidates.

    To compare detectors in isolation, set ``verification.descriptors`` to ``orb`` or ``both`` for
    all of them.
    """

    name: str

    def add(self, keyframe: int, image: NDArray[np.uint8] | None, features: Features) -> None:
        """Store the appearance of a keyframe. ``image`` is its ``(H, W)`` uint8 left image, or None
        if it was not stored."""
        ...

    def query(self, keyframe: int, map_: Map) -> list[LoopCandidate]:
        """Find candidates for a keyframe that has been added, best first. Candidates are similar
        keyframes in the map that are neither recent nor covisible with the keyframe."""
        ...

    def locate(
        self, image: NDArray[np.uint8] | None, features: Features, map_: Map
    ) -> list[LoopCandidate]:
        """Keyframes in the map that look similar to a frame outside the map, most similar first.
        ``LoopCandidate.query`` is -1, because the frame is not a keyframe."""
        ...

    def memory(self) -> DetectorMemory:
        """The data that the detector has stored for all keyframes, to be saved in a map file. Do
        not write to its arrays, because the detector still uses them."""
        ...

    def restore(self, memory: DetectorMemory) -> None:
        """Load the memory of an identical detector. This replaces calling ``add`` for each
        keyframe.

        Raises:
            ValueError: the memory is damaged or comes from another detector.
        """
        ...


def require_same(detector: DetectorMemory, memory: DetectorMemory) -> None:
    """Check that a memory was made by the same detector.

    Args:
        detector: the detector's own memory.
        memory: the memory to be restored.

    Raises:
        ValueError: the memory comes from another detector, or from the same detector with another
            vocabulary or other weights.
    """
    if memory.name != detector.name:
        raise ValueError(f"made with the detector {memory.name}, not {detector.name}")
    if memory.fingerprint != detector.fingerprint:
        raise ValueError(f"made with another vocabulary or other weights of {detector.name}")


class NoDetector:
    """A detector that never finds a loop. It is used for pure odometry."""

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
