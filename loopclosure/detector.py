"""The interface of loop detectors: bag of words, learned networks, and plug-ins."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vslam.features import Features
from vslam.loops import DetectorMemory, LoopCandidate
from vslam.map import Map


class LoopDetector(Protocol):
    """Remembers the appearance of keyframes and finds keyframes that look similar.

    Methods are called in the order of the keyframes, by one thread at a time.

    The later stages are the same for all detectors: rating and verification of candidates,
    consistency, and correction. The setting ``verification.descriptors`` selects the descriptors
    for verification, and its default depends on the detector. For ``bow``, ``capsule-paper`` and
    plug-ins, candidates are verified by ORB descriptors alone. For ``both`` and the other networks,
    candidates that ORB rejects are verified again by learned local descriptors; these detectors
    also use the local descriptors to rank the 20 most similar keyframes. The local descriptors
    always come from the feature extractor of the capsule network, whichever network proposed the
    candidates. To compare detectors in isolation, set ``verification.descriptors`` to ``orb`` or
    ``both`` for all of them.
    """

    name: str

    def add(self, keyframe: int, image: NDArray[np.uint8] | None, features: Features) -> None:
        """Remember a keyframe. ``image`` is its ``(H, W)`` uint8 left image, or None if it was not
        stored."""
        ...

    def query(self, keyframe: int, map_: Map) -> list[LoopCandidate]:
        """Candidates for a keyframe that was added, best first: similar keyframes in the map that
        are neither recent nor covisible with it."""
        ...

    def locate(
        self, image: NDArray[np.uint8] | None, features: Features, map_: Map
    ) -> list[LoopCandidate]:
        """Keyframes in the map that look similar to a frame outside the map, best first.
        ``LoopCandidate.query`` is -1, because the frame is no keyframe."""
        ...

    def memory(self) -> DetectorMemory:
        """What the detector remembers of all keyframes, for a map file. Do not write to its arrays,
        because the detector still uses them."""
        ...

    def restore(self, memory: DetectorMemory) -> None:
        """Load the memory of an identical detector, instead of calling ``add`` for each keyframe.

        Raises:
            ValueError: the memory is damaged or comes from another detector.
        """
        ...


def require_same(detector: DetectorMemory, memory: DetectorMemory) -> None:
    """Check that a memory belongs to a detector.

    Args:
        detector: the detector's own memory.
        memory: the memory to be restored.

    Raises:
        ValueError: the memory comes from another detector, or from the same one with another
            vocabulary or other weights.
    """
    if memory.name != detector.name:
        raise ValueError(f"made with the detector {memory.name}, not {detector.name}")
    if memory.fingerprint != detector.fingerprint:
        raise ValueError(f"made with another vocabulary or other weights of {detector.name}")


class NoDetector:
    """A detector that never finds a loop, for odometry only."""

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
