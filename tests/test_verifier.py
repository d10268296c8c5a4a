"""The verifiers of loop closing: ORB descriptors, and learned descriptors where ORB fails."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_learned_verification import CAMERA, CONFIG, T_1_0, World
from test_local_mapping import CAMERA as STREET_CAMERA
from test_verification import street

from vslam.config import VerificationConfig
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages, LocalDescriptors
from vslam.loopclosure.verifier import (
    LearnedVerifier,
    OrbThenLearnedVerifier,
    Verifier,
    verifier_for,
)
from vslam.loops import LoopCandidate, LoopEdge
from vslam.states import VerifierState

PLAIN = LoopCandidate(1, 0, 0.9, similarity=0.5)
PROMISING = replace(PLAIN, promising=True)
REFUSAL = LoopEdge.of(PLAIN, "proposed for only 1 of the 3 consecutive keyframes needed")
BOTH = (LearnedVerifier, OrbThenLearnedVerifier)


@pytest.fixture(scope="module")
def network() -> LocalDescriptors:
    return LocalDescriptors()


@pytest.fixture(scope="module")
def by_night(network) -> World:
    """Make a map in which keyframe 1 shows the place of keyframe 0 at night.

    No ORB descriptor matches.
    """
    return World(network, T_1_0)


def configured(descriptors: str):
    return CONFIG.model_copy(update={"verification": VerificationConfig(descriptors=descriptors)})


@pytest.mark.parametrize(
    ("descriptors", "expected"),
    [
        ("auto", OrbThenLearnedVerifier),
        ("both", OrbThenLearnedVerifier),
        ("learned", LearnedVerifier),
    ],
)
def test_the_configuration_chooses_the_verifier(network, descriptors, expected):
    images, config = KeyframeImages(network), configured(descriptors)
    assert type(verifier_for(config, CAMERA, images)) is expected
    assert verifier_for(config, CAMERA, images).images is images
    alone = verifier_for(config, CAMERA)
    assert (type(alone), alone.images) == (Verifier, None)


def test_learned_descriptors_may_wait_longer_for_a_second_loop(network):
    alone, learned = (
        verifier_for(CONFIG, CAMERA),
        verifier_for(CONFIG, CAMERA, KeyframeImages(network)),
    )
    assert alone.verified_memory == CONFIG.consistency.verified_memory
    assert learned.verified_memory == CONFIG.learned.verified_memory > alone.verified_memory


def test_orb_verifies_a_candidate_unless_it_was_refused(by_night):
    verifier, map_ = Verifier(CONFIG, STREET_CAMERA), street().map
    candidate = LoopCandidate(6, 1, 0.5, promising=True)
    edge = verifier.verify(map_, candidate)
    assert (edge.accepted, edge.matched_by) == (True, "orb")
    assert verifier.verify(map_, candidate, REFUSAL) is REFUSAL
    assert "descriptors match" in Verifier(CONFIG, CAMERA).verify(by_night.map, PROMISING).reason


def test_orb_needs_no_image_and_rates_nothing():
    verifier, map_ = Verifier(CONFIG, STREET_CAMERA), street().map
    verifier.add(map_, 6, np.zeros((192, 640), np.uint8))
    assert not verifier.is_image_redundant(map_, 7)
    assert verifier.rate(map_, 6, [PLAIN]) == [PLAIN]
    verifier.restore(VerifierState(5, 0.5))
    assert verifier.state() == VerifierState()


@pytest.mark.parametrize("kind", BOTH)
@pytest.mark.parametrize("refusal", [None, REFUSAL])
def test_a_promising_candidate_is_verified_by_learned_descriptors(by_night, kind, refusal):
    verifier = kind(CONFIG, CAMERA, by_night.images)
    edge = verifier.verify(by_night.map, PROMISING, refusal)
    assert (edge.accepted, edge.matched_by) == (True, "learned")
    assert verifier.state().resting_until == 0


def test_learned_descriptors_alone_try_no_other_candidate(by_night):
    verifier = LearnedVerifier(CONFIG, CAMERA, by_night.images)
    edge = verifier.verify(by_night.map, PLAIN)
    assert (edge.accepted, edge.reason) == (
        False,
        "images not similar enough for learned verification",
    )
    assert verifier.verify(by_night.map, PLAIN, REFUSAL) is REFUSAL


def test_orb_comes_first_where_both_verify(network, by_night):
    map_ = street().map
    images = KeyframeImages(network)  # empty, so that learned descriptors verify nothing
    verifier = OrbThenLearnedVerifier(CONFIG, STREET_CAMERA, images)
    edge = verifier.verify(map_, LoopCandidate(6, 1, 0.5, promising=True))
    assert (edge.accepted, edge.matched_by) == (True, "orb")
    refused = OrbThenLearnedVerifier(CONFIG, CAMERA, by_night.images).verify(by_night.map, PLAIN)
    assert refused == Verifier(CONFIG, CAMERA).verify(by_night.map, PLAIN)


@pytest.mark.parametrize(
    ("kind", "refusal", "reason"),
    [
        (LearnedVerifier, None, "no image is stored"),
        (LearnedVerifier, REFUSAL, f"{REFUSAL.reason}; no image is stored"),
        (OrbThenLearnedVerifier, None, "only 0 descriptors match; no image is stored"),
        (OrbThenLearnedVerifier, REFUSAL, f"{REFUSAL.reason}; no image is stored"),
    ],
)
def test_a_failed_attempt_says_all_that_spoke_against_it_and_is_remembered(
    network, by_night, kind, refusal, reason
):
    verifier = kind(CONFIG, CAMERA, KeyframeImages(network))
    edge = verifier.verify(by_night.map, PROMISING, refusal)
    assert (edge.accepted, edge.reason) == (False, reason)
    expected = VerifierState(
        PROMISING.query + 1 + CONFIG.learned.retry_interval, PROMISING.similarity
    )
    assert verifier.state() == expected
    other = kind(CONFIG, CAMERA, KeyframeImages(network))
    assert other.state() != expected
    other.restore(verifier.state())
    assert other.state() == expected
    # It pauses, and so does the restored verifier.
    again = LoopCandidate(2, 0, 0.9, similarity=PROMISING.similarity)
    assert [one.rate(by_night.map, 2, [again]) for one in (verifier, other)] == [[again]] * 2
    fresh = kind(CONFIG, CAMERA, KeyframeImages(network))
    assert fresh.rate(by_night.map, 2, [again]) == [replace(again, promising=True)]


@pytest.mark.parametrize("kind", BOTH)
def test_candidates_are_rated_by_their_images_within_reach(network, by_night, kind):
    siamese = CONFIG.siamese.model_copy(update={"monocular_reach_share": 1.0})
    config = CONFIG.model_copy(update={"siamese": siamese})
    unrated = LoopCandidate(1, 0, 0.9)
    (rated,) = kind(config, CAMERA, by_night.images).rate(by_night.map, 1, [unrated])
    assert rated.promising
    assert rated.similarity >= CONFIG.learned.min_similarity
    # The map has one straight step. By default, the place is then out of reach.
    assert kind(CONFIG, CAMERA, by_night.images).rate(by_night.map, 1, [unrated]) == [unrated]
    blind = kind(config, CAMERA, KeyframeImages(network))
    assert blind.rate(by_night.map, 1, [unrated]) == [unrated]


@pytest.mark.parametrize("kind", BOTH)
def test_images_are_kept_while_their_keyframes_live(network, kind):
    map_ = street().map
    verifier = kind(CONFIG, STREET_CAMERA, KeyframeImages(network))
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
