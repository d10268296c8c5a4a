"""ORB extraction is compared with OpenCV. Corners are identical, and nearly all descriptors are."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from vslam.config import OrbConfig
from vslam.frontend.corners import fast_scores, local_maxima, spread
from vslam.frontend.orb import (
    DISC,
    EVERYWHERE,
    MARGIN,
    PATTERN,
    build_pyramid,
    describe,
    detect_corners,
    extract,
    extract_at,
    features_per_level,
    orientations,
    smoothed,
)


def textured(height: int = 240, width: int = 320, seed: int = 0) -> np.ndarray:
    """Make slightly blurred blocks of random grey values, with corners of every strength."""
    rng = np.random.default_rng(seed)
    blocks = rng.uniform(0, 255, (height // 8 + 1, width // 8 + 1))
    image = np.kron(blocks, np.ones((8, 8)))[:height, :width]
    image += 10 * rng.normal(size=image.shape)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.8), 0, 255).astype(np.uint8)


def noise(seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (120, 170), dtype=np.uint8)


def extremes() -> np.ndarray:
    return np.random.default_rng(2).choice(np.array([0, 255], np.uint8), (90, 131))


def scores_of(image: np.ndarray) -> np.ndarray:
    return fast_scores(image.reshape(-1), *image.shape)


def bits_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.unpackbits(a ^ b, axis=1).sum(axis=1)


def grid_of_corners(image: np.ndarray, margin: int, step: int = 9) -> np.ndarray:
    height, width = image.shape
    x, y = np.meshgrid(
        np.arange(margin, width - margin, step), np.arange(margin, height - margin, step)
    )
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32)


# -- smoothing ------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(4, 4), (5, 70), (64, 7), (39, 41), (120, 170), (376, 1241)])
def test_smoothing_is_opencvs_bit_for_bit(size):
    rng = np.random.default_rng(sum(size))
    for image in (
        rng.integers(0, 256, size, np.uint8),
        rng.choice(np.array([0, 255], np.uint8), size),
        np.full(size, 255, np.uint8),
    ):
        wanted = cv2.GaussianBlur(image, (7, 7), 2, sigmaY=2, borderType=cv2.BORDER_REFLECT_101)
        assert np.array_equal(smoothed(image), wanted)


# -- corners --------------------------------------------------------------------------------------


@pytest.mark.parametrize("threshold", [0, 1, 7, 12, 20, 60, 150, 254])
@pytest.mark.parametrize("image", [textured(), noise(), extremes()], ids=["blocks", "noise", "0/1"])
def test_score_above_threshold_is_opencvs_corner_decision(image, threshold):
    detector = cv2.FastFeatureDetector_create(threshold, nonmaxSuppression=False)
    expected = np.zeros(image.shape, bool)
    for keypoint in detector.detect(image):
        expected[int(keypoint.pt[1]), int(keypoint.pt[0])] = True
    np.testing.assert_array_equal(scores_of(image) > threshold, expected)


def test_images_of_the_corner_test_have_corners_at_many_strengths():
    scores = scores_of(textured())
    assert [(scores > t).sum() > 50 for t in (0, 20, 60)] == [True] * 3
    assert (scores_of(noise()) > 20).sum() > 50


def local_maxima_by_hand(scores, margin, threshold, threshold_min, cell):
    height, width = scores.shape
    peaks, strong = [], set()
    for y in range(margin, height - margin):
        for x in range(margin, width - margin):
            s = int(scores[y, x])
            if s <= threshold_min:
                continue
            earlier = [(0, -1), (-1, -1), (-1, 0), (-1, 1)]
            later = [(0, 1), (1, -1), (1, 0), (1, 1)]
            if all(s > scores[y + i, x + j] for i, j in earlier) and all(
                s >= scores[y + i, x + j] for i, j in later
            ):
                peaks.append((x, y, s))
                if s > threshold:
                    strong.add((x // cell, y // cell))
    return [p for p in peaks if p[2] > threshold or (p[0] // cell, p[1] // cell) not in strong]


@pytest.mark.parametrize("levels", [3, 256], ids=["many ties", "few ties"])
def test_local_maxima_agree_with_a_plain_search(levels):
    rng = np.random.default_rng(4)
    scores = (rng.integers(0, levels, (83, 101)) * (255 // (levels - 1))).astype(np.uint8)
    x, y, score = local_maxima(scores, MARGIN, 200, 40, 20)
    expected = local_maxima_by_hand(scores, MARGIN, 200, 40, 20)
    assert list(zip(x.tolist(), y.tolist(), score.tolist(), strict=True)) == expected
    assert len(expected) > 100


def test_weak_corner_survives_only_in_a_cell_without_a_strong_one():
    scores = np.zeros((120, 120), np.uint8)
    scores[30, 30] = 9  # weak, beside a strong one in cell (0, 0)
    scores[25, 22] = 13  # strong
    scores[30, 50] = 9  # weak, alone in cell (1, 0)
    scores[50, 30] = 7  # not above the lower threshold
    scores[50, 50], scores[50, 60] = 12, 9  # 12 is not above 12: both weak, both stay
    x, y, score = local_maxima(scores, MARGIN, 12, 7, 40)
    found = sorted(zip(x.tolist(), y.tolist(), score.tolist(), strict=True))
    assert found == [(22, 25, 13), (50, 30, 9), (50, 50, 12), (60, 50, 9)]


def test_no_two_corners_touch_and_none_is_near_the_border():
    image = textured()
    corners = detect_corners(image, EVERYWHERE, 10_000, 12, 7, 35).astype(int)
    assert len(corners) > 300
    taken = np.zeros(image.shape, np.uint8)
    taken[corners[:, 1], corners[:, 0]] = 1
    assert cv2.boxFilter(taken, cv2.CV_32S, (2, 2), normalize=False).max() == 1
    assert corners.min() >= MARGIN
    assert (corners < np.array(image.shape[::-1]) - MARGIN).all()


# -- even spread ----------------------------------------------------------------------------------


def clustered(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make an image with 3,000 strong corners in a small area and 300 weak corners elsewhere.

    The strong corners are in a cluster of 60 x 60 px. The weak ones are spread over 640 x 240 px.
    """
    rng = np.random.default_rng(seed)
    dense = np.stack([rng.integers(300, 360, 3000), rng.integers(90, 150, 3000)], axis=1)
    sparse = np.stack([rng.integers(20, 620, 300), rng.integers(20, 220, 300)], axis=1)
    points = np.unique(np.concatenate([dense, sparse]), axis=0)
    points = points[np.lexsort((points[:, 0], points[:, 1]))].astype(np.int32)
    inside = (abs(points[:, 0] - 330) <= 30) & (abs(points[:, 1] - 120) <= 30)
    score = np.where(inside, rng.integers(100, 200, len(points)), 15).astype(np.uint8)
    return points[:, 0].copy(), points[:, 1].copy(), score


@pytest.mark.parametrize("quota", [1, 7, 50, 200, 317, 1000])
def test_spread_returns_exactly_the_quota_without_repeats(quota):
    x, y, score = clustered()
    chosen = spread(x, y, score, 640, 240, quota)
    assert len(chosen) == quota
    assert (np.diff(chosen) > 0).all()
    assert 0 <= chosen[0] <= chosen[-1] < len(x)


def test_spread_keeps_everything_that_fits_the_quota():
    x, y, score = clustered()
    assert np.array_equal(spread(x, y, score, 640, 240, len(x)), np.arange(len(x)))


def test_spread_does_not_let_a_cluster_of_strong_corners_starve_the_rest():
    x, y, score = clustered()
    strong = score >= 100
    chosen = spread(x, y, score, 640, 240, 200)
    # By score alone, all 200 would be in the cluster, which is 2.3 % of the image.
    assert np.count_nonzero(strong[chosen]) < 25
    tiles = (y[chosen] // 60) * 10 + x[chosen] // 64
    assert len(np.unique(tiles)) == len(np.unique((y // 60) * 10 + x // 64))


def test_spread_prefers_the_stronger_of_two_neighbours():
    x = np.array([10, 12, 100, 102, 200, 202], np.int32)
    y = np.full(6, 10, np.int32)
    score = np.array([50, 90, 90, 50, 20, 21], np.uint8)
    assert spread(x, y, score, 220, 20, 3).tolist() == [1, 2, 5]


# -- orientation and descriptors ------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [-179, -135, -90, -30, 0, 17, 45, 90, 120, 175])
def test_orientation_points_up_the_gradient(degrees):
    angle = np.deg2rad(degrees)
    y, x = np.mgrid[-30:31, -30:31]
    image = np.rint(128 + 4 * (np.cos(angle) * x + np.sin(angle) * y)).clip(0, 255).astype(np.uint8)
    found = orientations(image, np.array([[30.0, 30.0]], np.float32), DISC)[0]
    assert abs(np.rad2deg(np.angle(np.exp(1j * (found - angle))))) < 0.5


def test_orientation_equals_the_moments_of_the_disc():
    image = noise()
    y, x = np.mgrid[-15:16, -15:16]
    disc = DISC[:, : len(DISC)] > 0
    corners = grid_of_corners(image, 20)
    for corner, angle in zip(corners, orientations(image, corners, DISC), strict=True):
        u, v = corner.astype(int)
        patch = image[v - 15 : v + 16, u - 15 : u + 16] * disc.astype(float)
        assert angle == pytest.approx(np.arctan2((y * patch).sum(), (x * patch).sum()), abs=1e-6)


def test_descriptors_are_opencvs_within_two_bits():
    image = textured()
    corners = grid_of_corners(image, 40)
    rng = np.random.default_rng(0)
    degrees = rng.uniform(0, 360, len(corners)).astype(np.float32)
    keypoints = [
        cv2.KeyPoint(float(x), float(y), 31.0, float(d), 1.0, 0, i)
        for i, ((x, y), d) in enumerate(zip(corners, degrees, strict=True))
    ]
    kept, expected = cv2.ORB_create(nlevels=1).compute(image, keypoints)
    index = np.array([k.class_id for k in kept])
    assert len(index) > 300
    smooth = cv2.GaussianBlur(image, (7, 7), 2, sigmaY=2, borderType=cv2.BORDER_REFLECT_101)
    ours = describe(smooth, corners[index], np.deg2rad(degrees[index]), PATTERN)
    difference = bits_between(ours, expected)
    assert difference.max() <= 2
    assert difference.mean() < 0.2


def test_descriptors_turn_with_the_image():
    image = textured()
    side = image.shape[1]
    turned = np.ascontiguousarray(np.rot90(image))  # pixel (x, y) goes to (y, side - 1 - x)
    corners = detect_corners(image, EVERYWHERE, 300, 12, 7, 35)
    moved = np.stack([corners[:, 1], side - 1 - corners[:, 0]], axis=1)
    described, angles = [], []
    for pixels, points in ((image, corners), (turned, moved)):
        smooth = cv2.GaussianBlur(pixels, (7, 7), 2)
        angles.append(orientations(pixels, points, DISC))
        described.append(describe(smooth, points, angles[-1], PATTERN))
    assert len(corners) == 300
    turn = np.angle(np.exp(1j * (angles[1] - angles[0])))
    np.testing.assert_allclose(turn, -np.pi / 2, rtol=0, atol=1e-5)
    assert bits_between(*described).max() <= 10
    # Without steering, the descriptors would not be similar.
    upright = describe(cv2.GaussianBlur(turned, (7, 7), 2), moved, angles[0], PATTERN)
    assert np.median(bits_between(described[0], upright)) > 60


# -- extraction -----------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [100, 101, 999, 1000, 2000, 5001])
@pytest.mark.parametrize(("levels", "factor"), [(2, 1.2), (4, 1.5), (8, 1.2), (16, 1.1)])
def test_features_per_level_sum_to_n_and_shrink_with_the_level(n, levels, factor):
    quota = features_per_level(OrbConfig(n_features=n, n_levels=levels, scale_factor=factor))
    assert quota.sum() == n
    assert (np.diff(quota[:-1]) <= 0).all()
    assert quota[-1] >= 0


@pytest.mark.parametrize(("n", "levels", "factor"), [(115, 8, 1.8), (128, 12, 1.5)])
def test_features_per_level_sum_to_n_when_the_last_level_has_nothing_to_give(n, levels, factor):
    config = OrbConfig(n_features=n, n_levels=levels, scale_factor=factor)
    assert features_per_level(config).sum() == n


def test_levels_smaller_than_a_pixel_hold_no_features():
    config = OrbConfig(n_levels=16, scale_factor=2.0)  # both have the largest allowed value
    assert len(extract(textured(376, 1241), config).xy) > 100


def test_pyramid_levels_are_views_of_the_shrunk_image():
    config = OrbConfig()
    image = textured()
    pyramid = build_pyramid(image, config)
    assert np.array_equal(pyramid.level(0), image)
    assert pyramid.level(3).shape == (round(240 / 1.2**3), round(320 / 1.2**3))
    small = cv2.resize(image, pyramid.level(7).shape[::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(small.astype(float) - pyramid.level(7)).mean() < 12


def test_extraction_fills_its_quota_over_all_levels():
    config = OrbConfig(n_features=500)
    image = textured()
    found = extract(image, config)
    quota = features_per_level(config)
    count = np.bincount(found.octave, minlength=8)
    assert (count <= quota).all()
    assert count[:5].tolist() == quota[:5].tolist()  # the corners at the top are few
    assert (np.diff(found.octave.astype(int)) >= 0).all()
    assert (found.xy >= 0).all()
    assert (found.xy < image.shape[::-1]).all()
    assert (np.abs(found.angle) <= np.float32(np.pi)).all()
    assert len(found.xy) == len(found.angle) == len(found.descriptors)
    assert (found.xy.dtype, found.angle.dtype) == (np.float32, np.float32)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((240, 320), np.uint8),
        np.full((240, 320), 255, np.uint8),
        np.full((100, 100), 77, np.uint8),
        noise()[:20, :20].copy(),
        noise()[:38, :].copy(),
        noise()[:4, :4].copy(),
    ],
    ids=["black", "white", "grey", "20x20", "38 rows", "4x4"],
)
def test_image_without_room_or_texture_gives_no_features(image):
    found = extract(image, OrbConfig())
    assert found.xy.shape == (0, 2)
    assert found.descriptors.shape == (0, 32)
    assert len(found.octave) == len(found.angle) == 0


def as_bytes(image: np.ndarray) -> bytes:
    found = extract(image, OrbConfig(n_features=500))
    return b"".join(x.tobytes() for x in (found.xy, found.octave, found.angle, found.descriptors))


def test_extraction_gives_the_same_bytes_again_and_from_several_threads():
    images = [textured(seed=s) for s in range(4)]
    once = [as_bytes(image) for image in images]
    assert len(set(once)) == 4
    assert [as_bytes(image) for image in images] == once
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(as_bytes, images * 3)) == once * 3


def test_extraction_leaves_its_image_alone():
    image = textured()
    before = image.copy()
    extract(image, OrbConfig())
    assert np.array_equal(image, before)


def test_features_are_added_where_there_are_none():
    rng = np.random.default_rng(5)
    image = cv2.GaussianBlur(rng.integers(0, 256, (160, 480), np.uint8), (0, 0), 2.0)
    config = OrbConfig(n_features=200)
    found = extract(image, config)
    corners = found.xy[found.octave <= 1]
    grid = np.stack(np.meshgrid(np.arange(25, 455), np.arange(25, 135)), axis=-1).reshape(-1, 2)
    apart = np.abs(grid[:, None] - corners[None]).max(axis=2).min(axis=1)
    free = grid[[apart.argmax()]].astype(np.float32)
    assert apart.max() > 5.0
    there = found.xy[:5] + np.float32(0.4)
    border = np.array([[2.0, 80.0]], np.float32)
    octave = np.concatenate([[0], found.octave[:5], [0]]).astype(np.uint8)
    more = extract_at(found, np.concatenate([free + 0.3, there, border]), octave)
    np.testing.assert_array_equal(more.xy, free)
    assert more.octave.tolist() == [0]
    assert more.descriptors.any()
    both, order = found.joined(more)
    assert (np.diff(both.octave.astype(int)) >= 0).all()
    np.testing.assert_array_equal(both.xy, np.concatenate([found.xy, more.xy])[order])
    again = extract_at(found, found.xy, found.octave)
    assert len(again.xy) == 0
