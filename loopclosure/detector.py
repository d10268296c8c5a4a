"""The interface that all loop detectors implement: bag of words, learned networks, and plug-ins."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vslam.types.features import Features
from vslam.types.loops import DetectorMemory, LoopCandidate
from vslam.types.map import Map


class LoopDetector(Protocol):
    """Interface of a loop detector. A detector stores the appearance of keyframes, and finds
    keyframes that look similar to an image.

    The methods are called in the order of the keyframes, by one thread at a time.

    The setting ``verification.descriptors`` selects the descriptors that verify candidates. Its
    default depends on the detector. For ``bow``, ``capsule-paper`` and plug-ins, the default is
    ``orb``. For the other detectors, the default is ``both``: candidates that fail the verification
    with ORB descriptors are verified again using learned local descriptors. The 20 most similar
    keyframes are also ranked using local descriptors.

    The local descriptors always come from the feature extractor of the capsule network.

    To compare detectors in isolation, set ``verification.descriptors`` to the same value for all
    detectors, either ``orb`` or ``both``.
    """

    name: str

    def add(self, keyframe: int, image: NDArray[np.uint8] | None, features: Features) -> None:
        """Store the appearance of a keyframe.

        Args:
            image: ``(H, W)`` uint8 left image, or None if the image was not stored.
        """
        ...

    def query(self, keyframe: int, map_: Map) -> list[LoopCandidate]:
        """Find candidates for a keyframe that has been added, best first. Candidates are similar
        keyframes in the map. Recent keyframes and keyframes that are covisible with the given
        keyframe are excluded."""
        ...

    def locate(
        self, image: NDArray[np.uint8] | None, features: Features, map_: Map
    ) -> list[LoopCandidate]:
        """Return the keyframes in the map that look similar to a frame outside the map, most
        similar first. ``LoopCandidate.query`` is -1, because the frame is not a keyframe."""
        ...

    def memory(self) -> DetectorMemory:
        """Return the data that the detector has stored for all keyframes, to be saved in a map
        file. Do not write to the returned arrays, because the detector still uses them."""
        ...

    def restore(self, memory: DetectorMemory) -> None:
        """Load the data that the method ``memory`` of an identical detector returned. This replaces
        the calls of ``add`` for the keyframes in the data.

        Raises:
            ValueError: the data is damaged or comes from a different detector.
        """
        ...


def require_same(detector: DetectorMemory, memory: DetectorMemory) -> None:
    """Check that stored data comes from the same detector, with the same vocabulary or weights, and
    that it has all tables.

    Args:
        detector: the result of the detector's method ``memory``.
        memory: the stored data.

    Raises:
        ValueError: the detector, its vocabulary or its weights differ, or a table is missing.
    """
    if memory.name != detector.name:
        raise ValueError(f"made with the detector {memory.name}, not {detector.name}")
    if memory.fingerprint != detector.fingerprint:
        raise ValueError(f"made with another vocabulary or other weights of {detector.name}")
    if missing := sorted(detector.tables.keys() - memory.tables.keys()):
        raise ValueError(f"the data of {detector.name} lacks {', '.join(missing)}")


class NoDetector:
    """A loop detector that never finds a loop. It is used for pure odometry."""

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
