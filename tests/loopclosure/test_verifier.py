"""The verifiers of loop closing: ORB descriptors, and learned descriptors where ORB fails."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from test_learned_verification import CAMERA, CONFIG, CONTEXT, T_1_0, World
from test_local_mapping import CAMERA as STREET_CAMERA
from test_verification import street

from vslam.config import VerificationConfig
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages, LocalDescriptors
from vslam.loopclosure.verifier import Trial, Verifier
from vslam.types.context import Context
from vslam.types.loops import LoopCandidate
from vslam.types.states import VerifierState

PLAIN = LoopCandidate(1, 0, 0.9, similarity=0.5)
DOUBT = "proposed for only 1 of the 3 consecutive keyframes needed"


@pytest.fixture(scope="module")
def network() -> LocalDescriptors:
    return LocalDescriptors()


@pytest.fixture(scope="module")
def by_night(network) -> World:
    """Make a map in which keyframe 1 shows the place of keyframe 0 at night.

    No ORB descriptor matches.
    """
    return World(network, T_1_0)


def configured(descriptors: str, **sections: Any) -> Context:
    sections["verification"] = VerificationConfig(descriptors=descriptors)
    return Context.create(CAMERA, CONFIG.model_copy(update=sections))


@pytest.mark.parametrize(
    ("descriptors", "expected"),
    [("auto", ("orb", "learned")), ("both", ("orb", "learned")), ("learned", ("learned",))],
)
def test_the_configuration_chooses_the_descriptors(network, descriptors, expected):
    images, context = KeyframeImages(network), configured(descriptors)
    verifier = Verifier(context, images)
    assert (verifier.descriptors, verifier.images) == (expected, images)
    alone = Verifier(context)
    assert (alone.descriptors, alone.images) == (("orb",), None)


def test_learned_descriptors_may_wait_longer_for_a_second_loop(network):
    alone, learned = Verifier(CONTEXT), Verifier(CONTEXT, KeyframeImages(network))
    assert alone.verified_memory == CONFIG.consistency.verified_memory
    assert learned.verified_memory == CONFIG.learned.verified_memory > alone.verified_memory


def test_without_images_orb_verifies_what_nothing_speaks_against():
    verifier, map_ = Verifier(Context.create(STREET_CAMERA, CONFIG)), street().map
    verifier.add(map_, 6, np.zeros((192, 640), np.uint8))
    assert not verifier.is_image_redundant(map_, 7)
    good, bad = LoopCandidate(6, 1, 0.5), LoopCandidate(6, 2, 0.5)
    (trial,), (rejected,) = verifier.order(map_, 6, [bad, good], {2: DOUBT})
    assert trial == Trial(good, ("orb",))
    assert (rejected.match, rejected.accepted, rejected.reason) == (2, False, DOUBT)
    edge = verifier.verify(map_, trial)
    assert (edge.accepted, edge.matched_by) == (True, "orb")
    assert verifier.state == VerifierState()


@pytest.mark.parametrize(
    ("descriptors", "doubt", "expected"),
    [
        ("learned", "", ("learned",)),
        ("both", "", ("orb", "learned")),
        ("both", DOUBT, ("learned",)),
    ],
)
def test_similar_images_are_verified_by_learned_descriptors_in_spite_of_a_doubt(
    by_night, descriptors, doubt, expected
):
    verifier = Verifier(configured(descriptors), by_night.images)
    (trial,), rejected = verifier.order(by_night.map, 1, [PLAIN], {0: doubt} if doubt else {})
    assert trial == Trial(PLAIN, expected, doubt)
    assert rejected == []
    edge = verifier.verify(by_night.map, trial)
    assert (edge.accepted, edge.matched_by) == (True, "learned")
    assert verifier.state.resting_until == 0


def test_images_that_are_not_similar_are_left_to_orb(by_night):
    unlike = replace(PLAIN, similarity=0.1)
    learned = Verifier(configured("learned"), by_night.images)
    trials, (rejected,) = learned.order(by_night.map, 1, [unlike], {})
    assert trials == []
    assert rejected.reason == "images not similar enough for learned verification"
    both = Verifier(configured("both"), by_night.images)
    ((_, descriptors, _),), _ = both.order(by_night.map, 1, [unlike], {})
    assert descriptors == ("orb",)


def test_orb_comes_first_where_both_verify(network):
    map_ = street().map
    images = KeyframeImages(network)  # empty, so that learned descriptors verify nothing
    verifier = Verifier(Context.create(STREET_CAMERA, CONFIG), images)
    candidate = LoopCandidate(6, 1, 0.5, similarity=0.9)
    edge = verifier.verify(map_, Trial(candidate, ("orb", "learned")))
    assert (edge.accepted, edge.matched_by) == (True, "orb")


@pytest.mark.parametrize(
    ("trial", "reason"),
    [
        (Trial(PLAIN, ("learned",)), "no image is stored"),
        (Trial(PLAIN, ("learned",), DOUBT), f"{DOUBT}; no image is stored"),
        (Trial(PLAIN, ("orb", "learned")), "only 0 descriptors match; no image is stored"),
    ],
)
def test_a_failed_attempt_says_all_that_spoke_against_it_and_is_remembered(
    network, by_night, trial, reason
):
    verifier = Verifier(CONTEXT, KeyframeImages(network))
    edge = verifier.verify(by_night.map, trial)
    assert (edge.accepted, edge.reason) == (False, reason)
    assert PLAIN.similarity is not None
    until = PLAIN.query + 1 + CONFIG.learned.retry_interval
    assert verifier.state == VerifierState(until, PLAIN.similarity)
    again = LoopCandidate(2, 0, 0.9, similarity=PLAIN.similarity)
    resting, _ = verifier.order(by_night.map, 2, [again], {0: DOUBT})
    assert resting == []
    fresh = Verifier(CONTEXT, KeyframeImages(network))
    (trial,), _ = fresh.order(by_night.map, 2, [again], {0: DOUBT})
    assert trial.descriptors == ("learned",)


def test_only_the_most_similar_are_tried_and_fewer_after_a_failed_attempt(by_night):
    least = {"min_similarity": 0.35, "retry_factor": 1.1, "retry_interval": 8, "max_candidates": 2}
    learned = CONFIG.learned.model_copy(update=least)
    verifier = Verifier(configured("learned", learned=learned), by_night.images)

    def tried(keyframe, *similarity):
        candidates = [LoopCandidate(keyframe, k, 0.9, one) for k, one in enumerate(similarity)]
        trials, _ = verifier.order(by_night.map, keyframe, candidates, {})
        return {trial.candidate.match for trial in trials}

    assert tried(50, 0.34, 0.1) == set()
    assert tried(50, 0.35, 0.1, 0.5, 0.6) == {2, 3}
    verifier.state = VerifierState(59, 0.4)
    assert tried(58, 0.43) == set()
    assert tried(58, 0.45) == tried(59, 0.43) == {0}
    verifier.state = VerifierState(59, 0.1)  # the limit never falls below the usual one
    assert tried(52, 0.3) == set()


def test_candidates_are_compared_by_their_images_within_reach(network, by_night):
    siamese = CONFIG.siamese.model_copy(update={"monocular_reach_share": 1.0})
    context = configured("learned", siamese=siamese)
    unrated = LoopCandidate(1, 0, 0.9)
    (trial,), _ = Verifier(context, by_night.images).order(by_night.map, 1, [unrated], {})
    assert trial.candidate.similarity >= CONFIG.learned.min_similarity
    # The map has one straight step. By default, the place is then out of reach.
    near = Verifier(configured("learned"), by_night.images)
    blind = Verifier(context, KeyframeImages(network))
    for verifier in (near, blind):
        assert verifier.order(by_night.map, 1, [unrated], {})[0] == []


def test_images_are_kept_while_their_keyframes_live(network):
    map_ = street().map
    verifier = Verifier(Context.create(STREET_CAMERA, CONFIG), KeyframeImages(network))
    image = cv2.GaussianBlur(
        np.random.default_rng(0).integers(0, 256, (192, 640), np.uint8), (0, 0), 2
    )
    verifier.add(map_, 0, None)
    assert 0 not in verifier.images
    verifier.add(map_, 0, image)
    assert 0 in verifier.images
    assert verifier.is_image_redundant(map_, 1)
    assert not verifier.is_image_redundant(map_, 6)  # of the second pass, which shares no landmarks
    map_.arrays.keyframe_alive[0] = False
    verifier.add(map_, 6, image)
    assert 0 not in verifier.images
    assert 6 in verifier.images
