"""The relocaliser in isolation: what it finds and moves, and that it changes nothing else."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from test_local_mapping import CAMERA, World
from test_relocalization import KEYFRAMES, lost_frame, mapped_street
from test_verification import forward

from vslam.config import Config
from vslam.frontend.images import GivenFeatures
from vslam.frontend.relocaliser import Relocaliser
from vslam.types.context import Context
from vslam.types.features import TrackingState
from vslam.types.geometry import inverse, se3_exp, se3_log
from vslam.types.loops import LastSeen, Localisation, LoopCandidate
from vslam.types.track import By, Track

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
    frame: Track
    image: np.ndarray
    relocaliser: Relocaliser
    candidates: list[LoopCandidate]

    @classmethod
    def create(cls, matches: list[int], recognise: Recognise, **thresholds: float) -> Place:
        world = mapped_street()
        frame = lost_frame(world, T_TRUE)
        image = np.zeros((2, 2), np.uint8)
        config = Config.model_validate({"relocalization": thresholds})
        candidates = [LoopCandidate(-1, match, 1.0) for match in matches]

        def locate(given, features, map_):
            assert given is image
            assert features is frame.features
            assert map_ is world.map
            return candidates

        context = Context.create(CAMERA, config)
        return cls(world, frame, image, Relocaliser(context, locate, recognise), candidates)

    def check(self, track: Track) -> Track:
        images = GivenFeatures(self.frame.extracted, self.image)
        return self.relocaliser.check(track, images, self.world.map, LAST)

    def find(self) -> Track:
        return self.check(self.frame)

    def doubtful(self, n_inliers: int) -> Track:
        """Return the frame as it was tracked elsewhere with this number of inliers."""
        tracked = self.frame.matching(np.arange(40), np.arange(100, 140, dtype=np.int32), 7.0)
        return replace(
            tracked,
            T_cw=se3_exp(np.full(6, 0.1)),
            shift=np.full((len(self.frame.features), 2), 0.25, np.float32),
            state=TrackingState.OK,
            by=By.FEATURES,
            n_inliers=n_inliers,
            visible=np.arange(40, dtype=np.int32),
            is_doubtful=True,
        )


def map_bytes(world: World) -> bytes:
    return b"".join(array.tobytes() for array in world.map.copy().arrays)


def offset(frame: Track) -> float:
    return float(np.abs(se3_log(frame.T_cw @ inverse(T_TRUE))).max())


def test_a_lost_frame_is_found_near_the_first_candidate_that_shows_it():
    recognise = Recognise(30)
    place = Place.create([NOT_HERE, HERE, 0], recognise)
    before = map_bytes(place.world)
    found = place.find()
    assert (found.state, found.by, found.near) == (TrackingState.OK, By.PLACE, HERE)
    assert found.n_inliers == len(found.tracked) > 100
    assert offset(found) < 0.03
    assert not recognise.asked  # ORB descriptors were enough
    assert map_bytes(place.world) == before


@pytest.mark.parametrize(("max_candidates", "found"), [(3, True), (2, False)])
def test_only_so_many_candidates_are_tried(max_candidates, found):
    matches = [NOT_HERE, NOT_HERE, HERE]
    place = Place.create(matches, Recognise(), max_candidates=max_candidates)
    assert place.find().near == (HERE if found else -1)


@pytest.mark.parametrize("matches", [[], [NOT_HERE]])
def test_where_orb_finds_nothing_the_frame_may_be_recognised_in_another_way(matches):
    recognise = Recognise(30)
    place = Place.create(matches, recognise)
    before = map_bytes(place.world)
    frame, localised = place.frame, recognise.localised
    found = place.find()
    assert (found.state, found.n_inliers, found.near) == (TrackingState.OK, 30, 2)
    assert len(recognise.asked) == 1
    for given, expected in zip(
        recognise.asked[0],
        (place.world.map, place.image, frame.features, place.candidates, LAST),
        strict=True,
    ):
        assert given is expected
    np.testing.assert_array_equal(found.T_cw, localised.T_cw)
    np.testing.assert_array_equal(np.flatnonzero(found.landmark >= 0), localised.feature)
    np.testing.assert_array_equal(found.landmark[localised.feature], localised.landmark)
    np.testing.assert_array_equal(
        found.xyz[localised.feature], place.world.map.arrays.xyz[localised.landmark]
    )
    assert map_bytes(place.world) == before


def test_a_frame_that_nothing_recognises_is_found_nowhere():
    recognise = Recognise()
    found = Place.create([NOT_HERE], recognise).find()
    assert found.is_lost
    assert (found.n_inliers, found.near) == (0, -1)
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
def test_a_doubtful_frame_stays_as_it_is_unless_it_is_clearly_better_elsewhere(
    found_by, thresholds, better
):
    place, n_there = found_by(**thresholds)
    before = map_bytes(place.world)
    enough = int(np.ceil(n_there / better))
    stays = place.doubtful(enough)
    assert place.check(stays) is stays
    found = place.check(place.doubtful(enough - 1))
    assert (found.n_inliers, found.near) == (n_there, 2 if found_by is by_others else HERE)
    assert found.state is TrackingState.OK
    # Nothing is left of what the frame tracked before.
    assert len(found.tracked) == n_there
    assert found.shift is None
    assert not len(found.visible)
    assert map_bytes(place.world) == before


def test_a_doubtful_frame_that_is_found_nowhere_stays_as_it_is():
    place = Place.create([NOT_HERE], Recognise())
    stays = place.doubtful(0)
    assert place.check(stays) is stays


@pytest.mark.parametrize(("n", "state", "keyframe"), [
    (30, TrackingState.OK, 2),
    (29, TrackingState.WEAK, 2),
    (15, TrackingState.WEAK, 2),
    (14, TrackingState.LOST, -1),
])  # fmt: skip
def test_few_inliers_make_a_frame_that_is_found_weak_or_lost(n, state, keyframe):
    found = Place.create([], Recognise(n)).find()
    assert (found.state, found.near, found.n_inliers) == (state, keyframe, n)
    assert (found.by is By.PLACE) == (keyframe >= 0)
