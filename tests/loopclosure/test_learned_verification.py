"""Loops are verified by learned local descriptors, from other viewpoints and in other light."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vslam.config import Config
from vslam.loopclosure.learned_verification import (
    LearnedRelocalisation,
    is_image_redundant,
    joined,
    recognise,
    verify_learned,
    with_similarities,
)
from vslam.loopclosure.local_matching import DescriptorMaps
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages, LocalDescriptors
from vslam.types.camera import Camera
from vslam.types.context import Context
from vslam.types.features import Features
from vslam.types.geometry import inverse, se3_exp, transform
from vslam.types.loops import LastSeen, LoopCandidate
from vslam.types.map import Map
from vslam.types.map_kernels import link_many

CAMERA = Camera(400.0, 400.0, 320.0, 96.0, 0.5, 640, 192)
DEPTH = 8.0
CONFIG = Config()
CONTEXT = Context.create(CAMERA, CONFIG)


def wall(seed: int) -> np.ndarray:
    """Make a painted wall of 40 by 16 metres with 80 pixels per metre."""
    rng = np.random.default_rng(seed)
    image = np.full((1280, 3200), 128, np.uint8)
    for _ in range(900):
        x, y = rng.integers(0, 3200), rng.integers(0, 1280)
        w, h = rng.integers(10, 160, 2)
        grey = int(rng.integers(20, 236))
        if rng.random() < 0.6:
            cv2.rectangle(image, (x, y), (x + w, y + h), grey, -1)
        else:
            cv2.ellipse(image, (x, y), (int(w) // 2, int(h) // 2), 0, 0, 360, grey, -1)
    return cv2.GaussianBlur(image, (0, 0), 1.2)


def seen(painting: np.ndarray, T_cw: np.ndarray) -> np.ndarray:
    """Return the image of the wall from a camera. The wall is at z = 8."""
    K = np.array([[400.0, 0, 320], [0, 400, 96], [0, 0, 1]])
    to_wall = np.array([[1 / 80, 0, -20], [0, 1 / 80, -8], [0, 0, 0], [0, 0, 1.0]])
    to_wall[2, 2] = DEPTH
    H = K @ T_cw[:3] @ to_wall
    return np.asarray(cv2.warpPerspective(painting, H, (640, 192), flags=cv2.INTER_AREA), np.uint8)


def by_night(image: np.ndarray) -> np.ndarray:
    """Return a darker image with more noise and with a lamp at one side."""
    rng = np.random.default_rng(0)
    lamp = np.exp(-(((np.arange(640) - 150) / 200.0) ** 2))
    dark = 20 + image * (0.12 + 0.4 * lamp) + rng.normal(0, 4, image.shape)
    return np.clip(dark, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def network() -> LocalDescriptors:
    return LocalDescriptors()


class World:
    """Two keyframes: keyframe 0 is in front of a wall, and keyframe 1 is at a given place.

    They have different landmarks and no ORB features in common.
    """

    def __init__(
        self,
        network: LocalDescriptors,
        T_1_0: np.ndarray,
        *,
        same: bool = True,
        unit: float = 1.0,
    ) -> None:
        painting = wall(1)
        self.images = KeyframeImages(network)
        self.night = by_night(seen(painting if same else wall(2), T_1_0))
        self.images.add(0, seen(painting, np.eye(4)))
        self.images.add(1, self.night)
        self.map = Map(1.2 ** np.arange(8.0))
        drift = se3_exp(np.array([3.0, 0.0, -2.0, 0.0, 0.1, 0.0]))  # the map is wrong at keyframe 1
        rng = np.random.default_rng(0)
        for keyframe, (T_cw, image) in enumerate(
            [(np.eye(4), seen(painting, np.eye(4))), (T_1_0, self.night)]
        ):
            corners = cv2.goodFeaturesToTrack(image, 600, 0.01, 5)[:, 0]
            n = len(corners)
            features = Features(
                corners.astype(np.float32), np.zeros(n, np.uint8), np.zeros(n, np.float32),
                rng.integers(0, 256, (n, 32), np.uint8), np.full(n, np.nan, np.float32),
            )  # fmt: skip
            rays = np.c_[(corners - [320, 96]) / 400.0, np.ones(n)] @ T_cw[:3, :3]
            centre = inverse(T_cw)[:3, 3]
            xyz = centre + rays * ((DEPTH - centre[2]) / rays[:, 2])[:, None]
            pose = T_cw
            if keyframe == 1:
                # Keyframe 1 has its own landmarks and pose, with drift and with another scale.
                local = transform(T_cw, xyz) * unit
                pose = T_cw @ drift
                pose[:3, 3] *= unit
                xyz = transform(inverse(pose), local)
            self.map.add_keyframe(features, pose, float(keyframe), keyframe)
            ids = self.map.add_landmarks(xyz, features.descriptors.view(np.uint64), keyframe)
            rows = self.map.rows(keyframe)
            link_many(self.map.arrays, np.arange(rows.start, rows.stop), ids)

    def verify(self, camera: Camera = CAMERA):
        return verify_learned(
            self.map,
            LoopCandidate(1, 0, 0.9, similarity=0.5),
            self.images,
            Context.create(camera, CONFIG),
        )


T_1_0 = se3_exp(np.array([1.2, 0.1, 0.6, 0.0, 0.12, 0.01]))


def test_a_place_by_night_from_the_side_is_found_to_centimetres(network):
    edge = World(network, T_1_0).verify()
    assert (edge.accepted, edge.reason, edge.matched_by) == (True, "verified", "learned")
    error = inverse(edge.T_query_match) @ T_1_0
    assert np.linalg.norm(error[:3, 3]) < 0.03
    assert np.degrees(np.arccos((np.trace(error[:3, :3]) - 1) / 2)) < 0.2
    assert edge.n_inliers >= CONFIG.learned.min_inliers
    # Features of the query match the landmarks of the place that project onto them.
    assert len(edge.features) == len(set(edge.features)) == len(set(edge.landmarks)) > 30


def test_a_monocular_loop_has_the_scale_of_its_depths(network):
    world = World(network, T_1_0, unit=1.7)
    edge = world.verify(CAMERA.left_camera())
    assert edge.accepted, edge.reason
    assert edge.scale == pytest.approx(1.7, rel=0.03)
    assert np.linalg.norm((inverse(edge.T_query_match) @ T_1_0)[:3, 3]) < 0.1


def test_another_wall_is_refused(network):
    edge = World(network, T_1_0, same=False).verify()
    assert not edge.accepted
    assert edge.reason


def test_without_an_image_nothing_is_verified(network):
    world = World(network, T_1_0)
    world.images = KeyframeImages(network)
    edge = world.verify()
    assert (edge.accepted, edge.reason) == (False, "no image is stored")


def test_a_lost_frame_is_recognised(network):
    world = World(network, T_1_0)
    maps = network.describe(world.night)
    features = Features.none()
    given = (world.map, maps, features, 0, world.images, CONTEXT)
    assert recognise(*given) is None  # there are no keypoints
    rows = world.map.rows(1)
    a = world.map.arrays
    features = Features(a.xy[rows], a.octave[rows], a.angle[rows], np.zeros(0), a.u_right[rows])
    found = recognise(world.map, maps, features, 0, world.images, CONTEXT)
    assert np.linalg.norm((inverse(found.T_cw) @ T_1_0)[:3, 3]) < 0.1
    expected = transform(T_1_0, a.xyz[found.landmark])
    uv = expected[:, :2] / expected[:, 2:] * 400.0 + [320, 96]
    assert np.abs(uv - features.xy[found.feature]).max() < 5.0
    assert len(found.feature) >= CONFIG.tracking.min_inliers


def test_a_lost_frame_is_not_recognised_where_the_camera_cannot_be(network):
    world = World(network, T_1_0)
    a, rows = world.map.arrays, world.map.rows(1)
    features = Features(a.xy[rows], a.octave[rows], a.angle[rows], np.zeros(0), a.u_right[rows])
    find = LearnedRelocalisation(world.images, CONTEXT)
    given = world.map, world.night, features, [LoopCandidate(-1, 0, 1.0)]
    assert find(*given, None).keyframe == 0  # the camera may be anywhere
    assert find(*given, LastSeen(1, 10.0)).keyframe == 0
    assert find(*given, LastSeen(1, 0.01)) is None


def test_pairs_join_without_repeating_a_feature_or_a_landmark():
    first = np.array([1, 2], np.int32), np.array([10, 20], np.int32)
    second = np.array([2, 3, 4], np.int32), np.array([30, 10, 40], np.int32)
    feature, landmark = joined(first, second)
    assert (feature.tolist(), landmark.tolist()) == ([1, 2, 4], [10, 20, 40])


def test_candidates_that_no_detector_compared_are_compared_where_the_camera_may_be(network):
    images = KeyframeImages(network)
    rng = np.random.default_rng(3)
    view = cv2.GaussianBlur(rng.integers(0, 256, (192, 640), np.uint8), (0, 0), 2.0)
    other = cv2.GaussianBlur(rng.integers(0, 256, (192, 640), np.uint8), (0, 0), 9.0)
    for keyframe, image in enumerate((view, other, view, view)):
        images.add(keyframe, image)
    candidates = [
        LoopCandidate(9, 0, 0.5), LoopCandidate(9, 1, 0.4), LoopCandidate(9, 2, 0.3, 0.2),
        LoopCandidate(9, 3, 0.2), LoopCandidate(9, 8, 0.1),
    ]  # fmt: skip
    beyond = np.array([0.0, -1.0, 0.0, 5.0, 0, 0, 0, 0, 0])
    found = with_similarities(
        candidates, lambda: images.glance_at(view), images, CONFIG.learned, beyond
    )
    assert found[0].similarity > 0.9 > found[1].similarity
    # These candidates keep their order: rated by a detector, too far away, or without an image.
    assert found[2:] == candidates[2:]
    first = CONFIG.learned.model_copy(update={"max_compared": 1})
    found = with_similarities(candidates, lambda: images.glance_at(view), images, first, beyond)
    assert [one.similarity is not None for one in found] == [True, False, True, False, False]

    def never() -> DescriptorMaps:
        raise AssertionError("there is nothing to rate")

    assert with_similarities(candidates[2:3], never, images, CONFIG.learned) == candidates[2:3]


def test_no_network_sees_what_an_image_shows_already(network):
    """Keyframe 2 shares 40 of its 100 landmarks with keyframe 0. Keyframe 1 shares none."""
    map_ = Map(1.2 ** np.arange(8.0))
    features = Features(
        np.zeros((100, 2), np.float32), np.zeros(100, np.uint8), np.zeros(100, np.float32),
        np.zeros((100, 32), np.uint8), np.full(100, np.nan, np.float32),
    )  # fmt: skip
    for keyframe in (0, 1, 2):
        map_.add_keyframe(features, np.eye(4), float(keyframe), keyframe)
    ids = map_.add_landmarks(np.ones((160, 3)), np.zeros((160, 4), np.uint64), 0)
    for keyframe, seen_there in ((0, ids[:100]), (2, ids[60:])):
        rows = map_.rows(keyframe)
        link_many(map_.arrays, np.arange(rows.start, rows.stop), seen_there)
    images = KeyframeImages(network)
    config = CONFIG.learned.model_copy(update={"most_shared": 0.4})
    assert not is_image_redundant(map_, 2, images, config)  # no image is kept
    images.add(0, np.zeros((192, 640), np.uint8))
    assert is_image_redundant(map_, 2, images, config)
    higher = config.model_copy(update={"most_shared": 0.41})
    assert not is_image_redundant(map_, 2, images, higher)
    # The image of the previous keyframe is stored.
    assert is_image_redundant(map_, 1, images, config)
