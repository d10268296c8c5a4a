"""What verifies loop candidates: ORB descriptors, learned ones, or these where ORB fails.

Loop closing sees the :class:`Verifier` alone, so that it works alike for all of them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
from vslam.config import Config
from vslam.loopclosure import verification
from vslam.loopclosure.learned_verification import (
    LearnedTrials,
    is_image_redundant,
    rated,
    verify_learned,
)
from vslam.loopclosure.reach import beyond_reach
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.loops import LoopCandidate, LoopEdge
from vslam.map import Map
from vslam.states import VerifierState


class Verifier(Protocol):
    """Decides by geometry whether a keyframe shows the place that a detector takes it for.

    Calls come in the order of the keyframes, from one thread at a time.
    """

    @property
    def images(self) -> KeyframeImages | None:
        """The images of keyframes that verification needs; None if it needs none."""
        ...

    @property
    def verified_memory(self) -> int:
        """For how many keyframes a verified loop waits for a second one that agrees with it."""
        ...

    def is_image_redundant(self, map_: Map, keyframe: int) -> bool:
        """Whether a keyframe shows so much of what other images show that its own is not needed."""
        ...

    def add(self, map_: Map, keyframe: int, image: NDArray[np.uint8] | None) -> None:
        """Keep what verification needs of a new keyframe.

        Args:
            image: its ``(H, W)`` left image; None if there is none or it is not needed.
        """
        ...

    def rate(
        self, map_: Map, keyframe: int, candidates: list[LoopCandidate]
    ) -> list[LoopCandidate]:
        """The candidates of a keyframe, in the same order, with ``alike`` and ``promising`` set
        where this verifier has an opinion."""
        ...

    def verify(
        self, map_: Map, candidate: LoopCandidate, refusal: LoopEdge | None = None
    ) -> LoopEdge:
        """Decide whether a rated candidate is a loop. Only reads the map.

        Args:
            refusal: the edge of an earlier test that the candidate failed; None if it failed none.

        Returns:
            An accepted edge with a pose, or one that is not accepted and says why.
        """
        ...

    def state(self) -> VerifierState:
        """What ``restore`` needs to continue from here; the images are not part of it."""
        ...

    def restore(self, state: VerifierState) -> None:
        """Continue from what ``state`` returned."""
        ...


def verifier_for(config: Config, camera: Camera, images: KeyframeImages | None = None) -> Verifier:
    """The verifier that ``config.verification.descriptors`` asks for.

    Args:
        images: where learned verification keeps the images of keyframes; None for ORB alone,
            whatever the configuration says (``vslam.loopclosure.registry`` decides which).
    """
    if images is None:
        return OrbVerifier(config, camera)
    if config.verification.descriptors == "learned":
        return LearnedVerifier(config, camera, images)
    return OrbThenLearnedVerifier(config, camera, images)


class OrbVerifier:
    """Implements :class:`Verifier` by ORB descriptors alone."""

    images = None

    def __init__(self, config: Config, camera: Camera) -> None:
        self.verified_memory = config.consistency.verified_memory
        self._config = config.verification
        self._camera = camera

    def is_image_redundant(self, map_: Map, keyframe: int) -> bool:
        """False: ORB descriptors need no images."""
        return False

    def add(self, map_: Map, keyframe: int, image: NDArray[np.uint8] | None) -> None:
        """Nothing to keep: the map has the descriptors."""

    def rate(
        self, map_: Map, keyframe: int, candidates: list[LoopCandidate]
    ) -> list[LoopCandidate]:
        """The candidates as they are."""
        return candidates

    def verify(
        self, map_: Map, candidate: LoopCandidate, refusal: LoopEdge | None = None
    ) -> LoopEdge:
        """See :class:`Verifier`; a candidate that failed an earlier test is not tried."""
        if refusal is not None:
            return refusal
        return verification.verify(map_, candidate, self._camera, self._config)

    def state(self) -> VerifierState:
        """The default: nothing is remembered."""
        return VerifierState()

    def restore(self, state: VerifierState) -> None:
        """Nothing to restore."""


class LearnedVerifier:
    """Implements :class:`Verifier` by learned local descriptors alone.

    They cost forty times as much as ORB's, so that :class:`LearnedTrials` chooses which candidates
    are worth it. These are tried even if the detector found the place for one keyframe only: a
    camera that crosses a place by night may get one good view of it.
    """

    def __init__(self, config: Config, camera: Camera, images: KeyframeImages) -> None:
        self.images = images
        self.verified_memory = max(
            config.consistency.verified_memory, config.learned.verified_memory
        )
        self._config = config
        self._camera = camera
        self._trials = LearnedTrials(config.learned)

    def is_image_redundant(self, map_: Map, keyframe: int) -> bool:
        """See :class:`Verifier`."""
        return is_image_redundant(map_, keyframe, self.images, self._config.learned)

    def add(self, map_: Map, keyframe: int, image: NDArray[np.uint8] | None) -> None:
        """Keep the image, and forget those of keyframes that were culled."""
        if image is not None:
            self.images.add(keyframe, image)
            self.images.keep(map_.arrays.keyframe_alive)

    def rate(
        self, map_: Map, keyframe: int, candidates: list[LoopCandidate]
    ) -> list[LoopCandidate]:
        """See :class:`Verifier`: compare the images of candidates that the detector did not rate,
        and choose the promising ones."""
        images, config = self.images, self._config
        if keyframe in images and any(one.alike is None for one in candidates):
            beyond = beyond_reach(map_, keyframe, config.siamese)
            glance = images.glance
            candidates = rated(candidates, lambda: glance(keyframe), images, config.learned, beyond)
        chosen = self._trials.choose(keyframe, candidates)
        return [replace(one, promising=one.match in chosen) for one in candidates]

    def verify(
        self, map_: Map, candidate: LoopCandidate, refusal: LoopEdge | None = None
    ) -> LoopEdge:
        """See :class:`Verifier`; only promising candidates are tried, whether refused or not."""
        if not candidate.promising:
            reason = "not alike enough for learned descriptors"
            return refusal or LoopEdge.of(candidate, reason, matched_by="learned")
        config = self._config
        edge = verify_learned(
            map_, candidate, self.images, self._camera, config.learned, config.verification
        )
        located = edge.T_query_match is not None
        self._trials.record(candidate, located=located)
        if located or refusal is None:
            return edge
        return replace(refusal, reason=f"{refusal.reason}; {edge.reason}")

    def state(self) -> VerifierState:
        """See :class:`Verifier`."""
        return self._trials.state

    def restore(self, state: VerifierState) -> None:
        """See :class:`Verifier`."""
        self._trials.state = state


class OrbThenLearnedVerifier(LearnedVerifier):
    """Implements :class:`Verifier` by ORB descriptors, and by learned ones where ORB fails."""

    def __init__(self, config: Config, camera: Camera, images: KeyframeImages) -> None:
        super().__init__(config, camera, images)
        self._orb = OrbVerifier(config, camera)

    def verify(
        self, map_: Map, candidate: LoopCandidate, refusal: LoopEdge | None = None
    ) -> LoopEdge:
        """See :class:`Verifier`; a promising candidate that ORB refuses is tried once more."""
        edge = self._orb.verify(map_, candidate, refusal)
        return edge if edge.accepted else super().verify(map_, candidate, edge)
