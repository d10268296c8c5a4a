"""Decides which loop candidates are verified, in which order and with which descriptors, and
verifies them geometrically."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.loopclosure import verification
from vslam.loopclosure.learned_verification import (
    is_image_redundant,
    verify_learned,
    with_similarities,
)
from vslam.loopclosure.reach import beyond_reach
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.types.context import Context
from vslam.types.loops import Descriptors, LoopCandidate, LoopEdge
from vslam.types.map import Map
from vslam.types.states import VerifierState


class Trial(NamedTuple):
    """A loop candidate that is verified.

    Attributes:
        descriptors: the kinds of descriptors that are tried until one of them verifies the
            candidate.
        doubt: what already speaks against the candidate; empty if nothing does.
    """

    candidate: LoopCandidate
    descriptors: tuple[Descriptors, ...]
    doubt: str = ""


class Verifier:
    """Verifies loop candidates using ORB descriptors, learned descriptors, or both.

    The methods are called in the order of the keyframes, by one thread at a time.

    Attributes:
        images: the store of keyframe images that learned descriptors need; None if only ORB
            descriptors are used.
        descriptors: the kinds of descriptors, in the order in which they are tried.
        verified_memory: number of further keyframes during which a verified loop is kept while it
            waits for other loops that agree with it.
        state: the last attempt with learned descriptors.
    """

    def __init__(
        self,
        context: Context,
        images: KeyframeImages | None = None,
        state: VerifierState | None = None,
    ) -> None:
        """Create the verifier that ``context.config.verification.descriptors`` selects.

        Args:
            images: the result of ``vslam.loopclosure.registry.create_images``. With None, only ORB
                descriptors are used, regardless of the configuration.
        """
        config = context.config
        self.images = images
        self.descriptors: tuple[Descriptors, ...] = ("orb",)
        self.verified_memory = config.consistency.verified_memory
        self.state = state or VerifierState()
        self._context = context
        if images is not None:
            only = config.verification.descriptors == "learned"
            self.descriptors = ("learned",) if only else ("orb", "learned")
            self.verified_memory = max(self.verified_memory, config.learned.verified_memory)

    def is_image_redundant(self, map_: Map, keyframe: int) -> bool:
        """Return whether the image of a keyframe is not needed, because other stored images show
        nearly the same view."""
        learned = self._context.config.learned
        return self.images is not None and is_image_redundant(map_, keyframe, self.images, learned)

    def add(self, map_: Map, keyframe: int, image: NDArray[np.uint8] | None) -> None:
        """Store the image of a new keyframe if it is needed, and remove the images of keyframes
        that were culled.

        Args:
            image: ``(H, W)`` uint8 left image; None if it is missing or not needed.
        """
        if self.images is not None and image is not None:
            self.images.add(keyframe, image)
            self.images.keep(map_.arrays.keyframe_alive)

    def order(
        self,
        map_: Map,
        keyframe: int,
        candidates: list[LoopCandidate],
        doubts: Mapping[int, str],
    ) -> tuple[list[Trial], list[LoopEdge]]:
        """Decide which candidates of a keyframe are verified, and how, in the order given.

        ORB descriptors are tried where nothing speaks against a candidate. Learned descriptors are
        tried where the images are most similar. This is enough even if something speaks against
        the candidate, because a camera that crosses a place at night may get only one good view.

        Args:
            candidates: the loop candidates, best first.
            doubts: what speaks against some of them, by the id of their ``match``.

        Returns:
            The trials, and a rejected loop edge for each other candidate.
        """
        similar = self._most_similar(map_, keyframe, candidates)
        trials, rejected = [], []
        for one in candidates:
            doubt, likeness = doubts.get(one.match, ""), similar.get(one.match)
            fits = {"orb": not doubt, "learned": likeness is not None}
            descriptors = tuple(kind for kind in self.descriptors if fits[kind])
            if descriptors:
                trials.append(Trial(replace(one, similarity=likeness), descriptors, doubt))
            else:
                unlike = "images not similar enough for learned verification"
                rejected.append(LoopEdge.of(one, doubt or unlike))
        return trials, rejected

    def verify(self, map_: Map, trial: Trial) -> LoopEdge:
        """Decide whether a candidate is a loop. The map is not changed.

        Returns:
            An accepted loop edge with a pose, or a rejected loop edge with all reasons.
        """
        edges: list[LoopEdge] = []
        for kind in trial.descriptors:
            edges.append(self._verified(map_, trial.candidate, kind))
            if edges[-1].accepted:
                return edges[-1]
        reasons = [trial.doubt, *(edge.reason for edge in edges)]
        best = max(edges, key=lambda edge: edge.n_inliers)
        return replace(best, reason="; ".join(filter(None, reasons)))

    def _verified(self, map_: Map, candidate: LoopCandidate, kind: Descriptors) -> LoopEdge:
        if kind == "orb":
            return verification.verify(map_, candidate, self._context)
        assert self.images is not None
        edge = verify_learned(map_, candidate, self.images, self._context)
        if edge.T_query_match is not None:
            self.state = replace(self.state, resting_until=0)
        else:
            until = candidate.query + 1 + self._context.config.learned.retry_interval
            self.state = VerifierState(until, candidate.similarity or 0.0)
        return edge

    def _most_similar(
        self, map_: Map, keyframe: int, candidates: list[LoopCandidate]
    ) -> dict[int, float]:
        """Choose the candidates for which learned descriptors are tried, by their ``match``, and
        return their similarities.

        Learned descriptors take forty times as long as ORB descriptors. Therefore, only the most
        similar candidates are tried, and only if their similarity exceeds a limit. After a failed
        attempt, the limit is higher for the next ``learned.retry_interval`` keyframes.
        """
        images, config = self.images, self._context.config.learned
        if images is None:
            return {}
        if keyframe in images and any(one.similarity is None for one in candidates):
            beyond = beyond_reach(map_, keyframe, self._context.config.siamese)
            glance = images.glance
            candidates = with_similarities(
                candidates, lambda: glance(keyframe), images, config, beyond
            )
        least = config.min_similarity
        if keyframe < self.state.resting_until:
            least = max(least, config.retry_factor * self.state.failed_similarity)
        known = {one.match: one.similarity for one in candidates if one.similarity is not None}
        best = sorted(known, key=lambda match: (known[match], match), reverse=True)
        return {match: known[match] for match in best[: config.max_candidates]
                if known[match] >= least}  # fmt: skip
