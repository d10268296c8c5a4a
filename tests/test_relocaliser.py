"""The relocaliser in isolation: what it finds and moves, and that it changes nothing else."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import pytest
from test_local_mapping import CAMERA, World
from test_relocalization import KEYFRAMES, lost_frame, mapped_street
from test_verification import forward

from vslam.config import Config
from vslam.context import Context
from vslam.features import TrackingState
from vslam.frontend.frame import Frame
from vslam.frontend.relocaliser import Relocaliser
from vslam.frontend.tracker import Found
from vslam.geometry import inverse, se3_exp, se3_log
from vslam.loops import LastSeen, Localisation, LoopCandidate
from vslam.map import Map

HERE, NOT_HERE = 1, KEYFRAMES  # keyframes: one near the frame, and one without landmarks
T_TRUE = forward(1.2, 0.3)
LAST = LastSeen(2, 0.1)


class Recognise:
    """A verifier that recognises a frame by ``n`` of its features, or not at all.

    It records its calls.
    """

    def __init__(self, n: int = 0) -> None:
        self.asked: list[tuple] = []
        self.localised = Localisation(
            keyframe=2,
            T_cw=forward(0.5),
            feature=np.arange(10, 10 + n),
            landmark=np.arange(20, 20 + n, dtype=np.int32),
        )

    def __call__(self, map_, image, features, candidates, last):
        self.asked.append((map_, image, features, candidates, last))
        return self.localised if len(self.localised.feature) else None


@dataclass(frozen=True)
class Place:
    """A frame in a mapped street, and a relocaliser that gets some keyframes to compare."""

    world: World
    frame: Frame
    relocaliser: Relocaliser
    candidates: list[LoopCandidate]

    @classmethod
    def create(cls, matches: list[int], recognise: Recognise, **thresholds: float) -> Place:
        world = mapped_street()
        frame = lost_frame(world, T_TRUE)
        frame.image = np.zeros((2, 2), np.uint8)
        config = Config.model_validate({"relocalization": thresholds})
        candidates = [LoopCandidate(-1, match, 1.0) for match in matches]

        def locate(image, features, map_):
            assert image is frame.image
            assert features is frame.features
            assert map_ is world.map
            return candidates

        context = Context.create(CAMERA, config)
        return cls(world, frame, Relocaliser(context, locate, recognise), candidates)

    def check(self, found: Found) -> Found:
        """Return what the relocaliser decides about the frame while no keyframe is being mapped."""
        return self.relocaliser.relocalise_if_needed(
            self.frame, found, Owner(self.world.map, is_merged=True), LAST
        )

    def find(self) -> Found:
        return self.check(LOST)

    def find_better(self, n_inliers: int) -> Found:
        """Return where a doubtful frame is found that was tracked with this number of inliers."""
        return self.check(doubtful(n_inliers))


class Owner:
    """The owner of a map. It may have to wait for a keyframe before it provides the map."""

    def __init__(self, map_: Map, is_merged: bool) -> None:
        self.is_merged = is_merged
        self._map = map_

    def merge(self) -> Map:
        self.is_merged = True
        return self._map


LOST = Found(TrackingState.LOST)


def doubtful(n_inliers: int) -> Found:
    return Found(TrackingState.OK, n_inliers, n_inliers, is_doubtful=True)


def track_elsewhere(frame: Frame) -> None:
    frame.T_cw = se3_exp(np.full(6, 0.1))
    frame.landmark[:40] = np.arange(100, 140)
    frame.xyz[:40] = 7.0
    frame.shift = np.full((len(frame.features), 2), 0.25, np.float32)
    frame.twist = np.arange(6.0)
    frame.disparity_offset = 0.125


def everything(frame: Frame) -> list[bytes]:
    return [
        value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
        for value in (getattr(frame, field.name) for field in fields(frame))
    ]


def map_bytes(world: World) -> bytes:
    return b"".join(array.tobytes() for array in world.map.copy().arrays)


def offset(frame: Frame) -> float:
    return float(np.abs(se3_log(frame.T_cw @ inverse(T_TRUE))).max())


def test_a_lost_frame_is_found_near_the_first_candidate_that_shows_it():
    recognise = Recognise(30)
    place = Place.create([NOT_HERE, HERE, 0], recognise)
    before = map_bytes(place.world)
    found = place.find()
    assert (found.state, found.keyframe) == (TrackingState.OK, HERE)
    assert found.n_inliers == np.count_nonzero(place.frame.landmark >= 0) > 100
    assert offset(place.frame) < 0.03
    assert not recognise.asked  # ORB descriptors were enough
    assert map_bytes(place.world) == before


@pytest.mark.parametrize(("max_candidates", "found"), [(3, True), (2, False)])
def test_only_so_many_candidates_are_tried(max_candidates, found):
    matches = [NOT_HERE, NOT_HERE, HERE]
    place = Place.create(matches, Recognise(), max_candidates=max_candidates)
    assert place.find().keyframe == (HERE if found else -1)


@pytest.mark.parametrize("matches", [[], [NOT_HERE]])
def test_where_orb_finds_nothing_the_frame_may_be_recognised_in_another_way(matches):
    recognise = Recognise(30)
    place = Place.create(matches, recognise)
    before = map_bytes(place.world)
    frame, localised = place.frame, recognise.localised
    # Shifts of matches that are removed.
    frame.shift = np.zeros((len(frame.features), 2), np.float32)
    found = place.find()
    assert (found.state, found.n_inliers, found.keyframe) == (TrackingState.OK, 30, 2)
    assert len(recognise.asked) == 1
    for given, expected in zip(
        recognise.asked[0],
        (place.world.map, frame.image, frame.features, place.candidates, LAST),
        strict=True,
    ):
        assert given is expected
    np.testing.assert_array_equal(frame.T_cw, localised.T_cw)
    np.testing.assert_array_equal(np.flatnonzero(frame.landmark >= 0), localised.feature)
    np.testing.assert_array_equal(frame.landmark[localised.feature], localised.landmark)
    np.testing.assert_array_equal(
        frame.xyz[localised.feature], place.world.map.arrays.xyz[localised.landmark]
    )
    assert frame.shift is None
    assert map_bytes(place.world) == before


def test_a_frame_that_nothing_recognises_is_found_nowhere():
    recognise = Recognise()
    found = Place.create([NOT_HERE], recognise).find()
    assert found.is_lost
    assert (found.n_inliers, found.keyframe) == (0, -1)
    assert len(recognise.asked) == 1


def by_orb(**thresholds: float) -> tuple[Place, int]:
    """Make a place where ORB descriptors find the frame, and return the number of inliers."""
    n = Place.create([HERE], Recognise()).find().n_inliers
    return Place.create([HERE], Recognise(), **thresholds), n


def by_others(**thresholds: float) -> tuple[Place, int]:
    """Make a place where other descriptors find the frame, and return the number of inliers."""
    return Place.create([NOT_HERE], Recognise(30), **thresholds), 30


@pytest.mark.parametrize("found_by", [by_orb, by_others])
@pytest.mark.parametrize(
    ("thresholds", "better"), [({}, 1.5), ({"better": 3.0}, 3.0)], ids=["usual", "configured"]
)
def test_a_doubtful_frame_stays_exactly_as_it_is_unless_it_is_clearly_better_elsewhere(
    found_by, thresholds, better
):
    place, n_there = found_by(**thresholds)
    track_elsewhere(place.frame)
    tracked, before = everything(place.frame), map_bytes(place.world)
    enough = int(np.ceil(n_there / better))
    stays = doubtful(enough)
    assert place.check(stays) is stays
    assert everything(place.frame) == tracked
    found = place.find_better(enough - 1)
    assert (found.n_inliers, found.keyframe) == (n_there, 2 if found_by is by_others else HERE)
    assert found.state is TrackingState.OK
    assert everything(place.frame) != tracked
    assert place.frame.shift is None
    assert map_bytes(place.world) == before


def test_a_doubtful_frame_that_is_found_nowhere_stays_exactly_as_it_is():
    place = Place.create([NOT_HERE], Recognise())
    track_elsewhere(place.frame)
    tracked = everything(place.frame)
    stays = doubtful(0)
    assert place.check(stays) is stays
    assert everything(place.frame) == tracked


def test_what_a_frame_tracked_before_is_gone_where_it_is_found():
    """The previous matches of the frame are not mixed with those at the new place."""
    place, n_there = by_orb()
    track_elsewhere(place.frame)
    place.find_better(10)
    assert np.count_nonzero(place.frame.landmark >= 0) == n_there
    assert offset(place.frame) < 0.03


@pytest.mark.parametrize(("n", "state", "keyframe"), [
    (30, TrackingState.OK, 2),
    (29, TrackingState.WEAK, 2),
    (15, TrackingState.WEAK, 2),
    (14, TrackingState.LOST, -1),
])  # fmt: skip
def test_few_inliers_make_a_frame_that_is_found_weak_or_lost(n, state, keyframe):
    found = Place.create([], Recognise(n)).find()
    assert (found.state, found.keyframe, found.n_inliers) == (state, keyframe, n)
    assert found.relocalised == (keyframe >= 0)


def test_a_frame_that_is_not_doubtful_is_not_looked_for():
    place, _ = by_orb()
    track_elsewhere(place.frame)
    tracked = everything(place.frame)
    good = Found(TrackingState.OK, 20, 20)
    assert place.check(good) is good
    assert everything(place.frame) == tracked


def test_a_lost_frame_does_not_wait_for_a_keyframe_that_is_being_mapped():
    place, _ = by_orb()
    owner = Owner(place.world.map, is_merged=False)
    assert place.relocaliser.relocalise_if_needed(place.frame, LOST, owner) is LOST
    assert not owner.is_merged


def test_a_doubtful_frame_waits_for_a_keyframe_that_is_being_mapped():
    place, n_there = by_orb()
    owner = Owner(place.world.map, is_merged=False)
    assert (
        place.relocaliser.relocalise_if_needed(place.frame, doubtful(20), owner).n_inliers
        == n_there
    )
    assert owner.is_merged
