"""Verifiers: they decide geometrically whether a loop candidate is a loop.

There are three verifiers. The first uses ORB descriptors. The second uses learned descriptors. The
third uses ORB descriptors first, and learned descriptors if ORB descriptors fail.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
from vslam.config import Config
from vslam.loopclosure import verification
from vslam.loopclosure.learned_verification import (
    LearnedTrials,
    is_image_redundant,
    verify_learned,
    with_similarities,
)
from vslam.loopclosure.reach import beyond_reach
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.loops import LoopCandidate, LoopEdge
from vslam.map import Map
from vslam.states import VerifierState


class Verifier:
    """Decides geometrically whether a keyframe shows the place that a loop detector proposes. This
    class uses only ORB descriptors.

    The methods are called in the order of the keyframes, by one thread at a time.

    Attributes:
        images: the store of keyframe images that verification needs; None if it needs no images.
        verified_memory: number of further keyframes during which a verified loop is kept while it
            waits for other loops that agree with it.
    """

    images: KeyframeImages | None = None

    def __init__(self, config: Config, camera: Camera) -> None:
        self.verified_memory = config.consistency.verified_memory
        self._config = config
        self._camera = camera

    def is_image_redundant(self, map_: Map, keyframe: int) -> bool:
        """Return whether the image of a keyframe is not needed, because other stored images show
        nearly the same view."""
        return False

    def add(self, map_: Map, keyframe: int, image: NDArray[np.uint8] | None) -> None:
        """Store the image of a new keyframe, if verification needs images.

        Args:
            image: ``(H, W)`` uint8 left image; None if it is missing or not needed.
        """

    def rate(
        self, map_: Map, keyframe: int, candidates: list[LoopCandidate]
    ) -> list[LoopCandidate]:
        """Set the fields ``similarity`` and ``promising`` of a keyframe's candidates, if this
        verifier uses these fields. The order of the candidates is not changed."""
        return candidates

    def verify(
        self, map_: Map, candidate: LoopCandidate, refusal: LoopEdge | None = None
    ) -> LoopEdge:
        """Decide whether a candidate is a loop. The map is not changed.

        Args:
            refusal: the rejected loop edge if the candidate has failed an earlier test, or else
                None. Verification with ORB descriptors skips such a candidate.

        Returns:
            An accepted loop edge with a pose, or a rejected loop edge with the reason.
        """
        if refusal is not None:
            return refusal
        return verification.verify(map_, candidate, self._camera, self._config.verification)

    def state(self) -> VerifierState:
        """Return the state of the verifier without the images, to store it in a map file or a
        checkpoint."""
        return VerifierState()

    def restore(self, state: VerifierState) -> None:
        """Restore a state that the method ``state`` returned."""


def verifier_for(config: Config, camera: Camera, images: KeyframeImages | None = None) -> Verifier:
    """Create the verifier that ``config.verification.descriptors`` selects.

    Args:
        images: the store of keyframe images, from ``vslam.loopclosure.registry.create_images``.
            None selects verification with only ORB descriptors, regardless of the configuration.
    """
    if images is None:
        return Verifier(config, camera)
    if config.verification.descriptors == "learned":
        return LearnedVerifier(config, camera, images)
    return OrbThenLearnedVerifier(config, camera, images)


class LearnedVerifier(Verifier):
    """A verifier that uses only learned local descriptors.

    :class:`LearnedTrials` selects the promising candidates. A promising candidate is tried even if
    only one keyframe resembled the place, because a camera that crosses a place at night may get
    only one good view of the place.
    """

    images: KeyframeImages

    def __init__(self, config: Config, camera: Camera, images: KeyframeImages) -> None:
        super().__init__(config, camera)
        self.images = images
        self.verified_memory = max(self.verified_memory, config.learned.verified_memory)
        self._trials = LearnedTrials(config.learned)

    def is_image_redundant(self, map_: Map, keyframe: int) -> bool:
        return is_image_redundant(map_, keyframe, self.images, self._config.learned)

    def add(self, map_: Map, keyframe: int, image: NDArray[np.uint8] | None) -> None:
        """Store the image of a new keyframe, and remove the images of keyframes that were
        culled."""
        if image is not None:
            self.images.add(keyframe, image)
            self.images.keep(map_.arrays.keyframe_alive)

    def rate(
        self, map_: Map, keyframe: int, candidates: list[LoopCandidate]
    ) -> list[LoopCandidate]:
        images, config = self.images, self._config
        if keyframe in images and any(one.similarity is None for one in candidates):
            beyond = beyond_reach(map_, keyframe, config.siamese)
            glance = images.glance
            candidates = with_similarities(
                candidates, lambda: glance(keyframe), images, config.learned, beyond
            )
        chosen = self._trials.choose(keyframe, candidates)
        return [replace(one, promising=one.match in chosen) for one in candidates]

    def verify(
        self, map_: Map, candidate: LoopCandidate, refusal: LoopEdge | None = None
    ) -> LoopEdge:
        """Decide whether a candidate is a loop. Promising candidates are tried even if they have
        failed an earlier test. Other candidates are never tried."""
        if not candidate.promising:
            reason = "images not similar enough for learned verification"
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
        return self._trials.state

    def restore(self, state: VerifierState) -> None:
        self._trials.state = state


class OrbThenLearnedVerifier(LearnedVerifier):
    """A verifier that uses ORB descriptors first, and learned descriptors if ORB fails."""

    def verify(
        self, map_: Map, candidate: LoopCandidate, refusal: LoopEdge | None = None
    ) -> LoopEdge:
        edge = Verifier.verify(self, map_, candidate, refusal)
        return edge if edge.accepted else super().verify(map_, candidate, edge)
