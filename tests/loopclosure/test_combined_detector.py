"""Two combined detectors propose candidates in turn, and each place only once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_siamese_detector import a_map

from vslam.config import Config, VerificationConfig
from vslam.loopclosure.combined import CombinedDetector
from vslam.loopclosure.registry import create_detector, create_images, require_detector
from vslam.support.errors import InputError
from vslam.types.features import Features
from vslam.types.loops import LoopCandidate


class Told:
    def __init__(self, name: str, matches: list[int], *, similarity: float | None) -> None:
        self.name, self.added = name, []
        self._found = [LoopCandidate(9, m, 1.0 / (1 + m), similarity, name) for m in matches]

    def add(self, keyframe, image, features):
        self.added.append(keyframe)

    def query(self, keyframe, map_):
        return self._found

    def locate(self, image, features, map_):
        return self._found[:1]


def test_candidates_come_in_turn_and_one_for_each_keyframe():
    words, network = Told("bow", [1, 4, 6], similarity=None), Told("net", [2, 4, 5], similarity=0.5)
    both = CombinedDetector("both", [words, network])
    map_ = a_map(10, covisible=((1, 2), (1, 6)))  # 1, 2 and 6 show one place
    found = both.query(9, map_)
    assert [(c.match, c.similarity) for c in found] == [
        (1, None),
        (2, 0.5),
        (4, 0.5),
        (6, None),
        (5, 0.5),
    ]
    assert [c.proposed_by for c in found] == ["bow", "net", "bow+net", "bow", "net"]
    assert [c.match for c in both.locate(None, Features.none(), map_)] == [1, 2]
    both.add(9, None, Features.none())
    assert words.added == network.added == [9]


def test_both_remembers_by_words_and_by_looks():
    both = create_detector("both", Config())
    image = np.random.default_rng(0).integers(0, 256, (96, 320), np.uint8)
    both.add(0, image, Features.none())
    (found,) = both.locate(image, Features.none(), a_map(1))
    assert (found.match, found.score) == (0, pytest.approx(1.0, abs=0.1))


@pytest.mark.parametrize("name", ["bow", "capsule", "both"])
def test_a_memory_without_tables_is_refused(name):
    detector = create_detector(name, Config())
    with pytest.raises(ValueError, match=f"the data of {name} lacks "):
        detector.restore(replace(detector.memory(), tables={}))


def test_only_detectors_with_a_network_keep_images():
    assert create_images("bow", Config()) is None
    assert create_images("none", Config()) is None
    assert create_images("both", Config()) is not None


@pytest.mark.parametrize("name", ["bow", "capsule", "both"])
def test_one_option_says_what_verifies_the_candidates_of_every_detector(name):
    for descriptors, kept in (("orb", False), ("learned", True), ("both", True)):
        config = Config(verification=VerificationConfig(descriptors=descriptors))
        assert (create_images(name, config) is not None) == kept
    assert create_images("none", config) is None


def test_weights_of_both_are_those_of_its_network(tmp_path):
    require_detector("both")
    with pytest.raises(InputError, match="no such file"):
        require_detector("both", tmp_path / "missing.onnx")
