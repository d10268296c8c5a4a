"""Pictures of closed loops show the right pixels of the right frames, and their files are small."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import vslam.run.moments
from vslam.run.loop_pictures import LoopPicture, draw_picture, loop_matches, spread
from vslam.run.moments import LoopPictureRecorder
from vslam.types.camera import Camera
from vslam.types.features import Features, TrackingState, TrackResult
from vslam.types.loops import LoopEdge
from vslam.types.map import Map
from vslam.types.map_kernels import fuse_landmarks, link, link_many

CAMERA = Camera(100.0, 100.0, 100.0, 50.0, 0.5, 200, 100)
MATCH, NEIGHBOUR, QUERY = 0, 1, 2
FRAMES = [3, 10, 40]  # of these keyframes


def features(n: int) -> Features:
    """Make features at different pixels. The k-th feature is at (10 + k, 20 + 2 k)."""
    k = np.arange(n)
    xy = np.stack([10 + k, 20 + 2 * k], axis=1).astype(np.float32)
    nothing = np.zeros(n, np.float32)
    descriptors = np.zeros((n, 32), np.uint8)
    return Features(xy, nothing.astype(np.uint8), nothing, descriptors, nothing)


@pytest.fixture
def closed_map() -> Map:
    """Make a map of three keyframes of one place after a loop was closed, and the landmarks 0 to 5.

    When the loop was verified, the features 0 to 5 of the query observed these landmarks. The
    matched keyframe observes the landmarks 0 and 1. Its neighbour observes all of them.
    """
    map_ = Map(1.2 ** np.arange(8))
    T_cw = np.eye(4)
    T_cw[0, 3] = -1.0  # the neighbour and the query are 1 m to the right of the match
    for frame, pose in zip(FRAMES, (np.eye(4), T_cw, T_cw), strict=True):
        map_.add_keyframe(features(8), pose, 0.1 * frame, frame)
    points = [[1, 0, 10], [2, 1, 10], [3, 1, 10], [0, 0, 10], [0, 0, -5], [30, 0, 10]]
    place = map_.add_landmarks(np.array(points, float), np.zeros((6, 4), np.uint64), MATCH)
    a = map_.arrays
    link_many(a, map_.rows(MATCH).start + np.array([6, 7]), place[[0, 1]])
    link_many(a, map_.rows(NEIGHBOUR).start + np.arange(6), place)
    link_many(a, map_.rows(QUERY).start + np.array([0, 2, 4, 5]), place[[0, 2, 4, 5]])
    # Feature 1 observed a landmark of the query, which was fused with a landmark of the place.
    own = map_.add_landmarks(np.array([[2.0, 1.0, 10.1]]), np.zeros((1, 4), np.uint64), QUERY)
    link(a, map_.rows(QUERY).start + 1, int(own[0]))
    fuse_landmarks(a, int(own[0]), int(place[1]))
    return map_


LOOP = LoopEdge(
    QUERY, MATCH, 0.5, True, "closed", 8, 6, np.eye(4), np.arange(6, dtype=np.int32),
    np.arange(6, dtype=np.int32),
)  # fmt: skip


def test_matches_are_pixels_of_the_same_landmarks(closed_map: Map) -> None:
    query_xy, match_xy = loop_matches(closed_map, LOOP, CAMERA)
    # Feature 3 has lost its landmark. Landmark 4 is behind the match, and 5 is outside its image.
    np.testing.assert_array_equal(query_xy, [[10, 20], [11, 22], [12, 24]])
    observed = [[16, 32], [17, 34]]  # features 6 and 7 of the match
    projected = [100 + 100 * 3 / 10, 50 + 100 * 1 / 10]
    np.testing.assert_allclose(match_xy, [*observed, projected])


def test_matches_of_a_match_that_was_culled_are_projected(closed_map: Map) -> None:
    closed_map.parents[MATCH] = NEIGHBOUR
    closed_map.cull_keyframe(MATCH)
    query_xy, match_xy = loop_matches(closed_map, LOOP, CAMERA)
    np.testing.assert_array_equal(query_xy, [[10, 20], [11, 22], [12, 24]])
    np.testing.assert_allclose(match_xy, [[110, 50], [120, 60], [130, 60]])


def test_few_matches_cover_what_many_do() -> None:
    rng = np.random.default_rng(0)
    crowd = rng.normal([50, 50], 2.0, (500, 2))
    corners = np.array([[0, 0], [0, 100], [100, 0], [100, 100]], float)
    points = np.concatenate([crowd, corners])
    chosen = spread(points, 20)
    assert len(set(chosen.tolist())) == 20
    assert {500, 501, 502, 503} <= set(chosen.tolist())
    np.testing.assert_array_equal(spread(points[:20], 20), np.arange(20))


def result(frame: int) -> TrackResult:
    return TrackResult(frame, 0.1 * frame, np.eye(4), TrackingState.OK, 9, 9, 9, 9, True)


def told(frames: list[int]) -> LoopPictureRecorder:
    """Make a recorder that has seen these keyframes. The brightness of an image is its number."""
    pictures = LoopPictureRecorder()
    pictures.begin(CAMERA, None)
    for frame in frames:
        image = np.full((CAMERA.height, CAMERA.width), frame, np.uint8)
        pictures.keyframe(result(frame), image, features(8).xy, np.ones(8, np.bool_))
    return pictures


def decoded(jpeg: bytes) -> NDArray[np.uint8]:
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image.astype(np.uint8, copy=False)


def test_a_picture_has_the_images_of_its_two_frames(closed_map: Map) -> None:
    pictures = told(FRAMES)
    rejected = replace(LOOP, accepted=False)
    pictures.loops([rejected, LOOP], closed_map)
    (picture,) = pictures.pictures
    assert (picture.match_frame, picture.query_frame) == (3, 40)
    for jpeg, brightness in ((picture.match_jpeg, 3), (picture.query_jpeg, 40)):
        assert decoded(jpeg).shape == (50, 100)
        assert abs(float(decoded(jpeg).mean()) - brightness) < 2
    # The centre of the first pixel is at 0. Therefore, pixel 10 is at 4.75 at half resolution.
    np.testing.assert_allclose(picture.query_xy[0], [4.75, 9.75])
    assert len(picture.query_xy) == len(picture.match_xy) == 3


def test_there_is_no_picture_without_both_images(closed_map: Map) -> None:
    without_match = told([40])
    without_match.loops([LOOP], closed_map)
    assert not without_match.pictures
    closed_map.sessions[MATCH] = -1  # its frame counts the images of another drive
    of_another_drive = told(FRAMES)
    of_another_drive.loops([LOOP], closed_map)
    assert not of_another_drive.pictures


def test_a_long_run_keeps_new_images_and_some_of_the_old(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vslam.run.moments, "_MOST_LOOP_IMAGES", 8)
    pictures = told(list(range(41)))
    assert len(pictures._jpegs) <= 8
    assert {0, 40} <= set(pictures._jpegs)


def picture_of(xy: list[list[float]]) -> LoopPicture:
    grey = cv2.imencode(".jpg", np.full((160, 320), 90, np.uint8))[1].tobytes()
    positions, shift = np.array(xy, np.float64).reshape(-1, 2), np.array([100.0, 30.0])
    return LoopPicture(612, 40, grey, grey, positions + shift, positions)


def greenness(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    blue, green, red = image.astype(float).transpose(2, 0, 1)
    return green - np.maximum(blue, red)


def test_a_match_is_a_dot_in_either_image_and_a_line() -> None:
    green = greenness(decoded(draw_picture(picture_of([[50.0, 60.0]]))))
    assert green.shape == (320, 1288)  # two images of 640 columns at twice the size, and a gap
    left, right = (101, 121), (2 * 150 + 1 + 648, 2 * 90 + 1)
    middle = ((left[0] + right[0]) // 2, (left[1] + right[1]) // 2)
    for x, y in (left, right):
        assert green[y, x] > 40
    x, y = middle
    assert green[y - 2 : y + 3, x].max() > 10
    green[min(left[1], right[1]) - 8 : max(left[1], right[1]) + 9] = 0
    assert green.max() < 10  # nothing else is drawn


def test_a_loop_without_matches_is_drawn_too() -> None:
    assert greenness(decoded(draw_picture(picture_of([])))).max() < 10
