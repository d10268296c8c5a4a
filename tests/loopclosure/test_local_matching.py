"""Coarse-to-fine matching of local descriptors, on synthetic grids of descriptors."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vslam.loopclosure.local_matching import (
    CoarseMatches,
    DescriptorMaps,
    fine_agreement,
    homography_inliers,
    locate,
    locate_near,
    match_coarse,
    positions,
)


def unit(x: np.ndarray) -> np.ndarray:
    return np.float32(x / np.linalg.norm(x, axis=2, keepdims=True))


def field(seed: int, rows: int = 12, columns: int = 40) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.standard_normal((rows, columns, 32)).astype(np.float32)
    size = columns * 16, rows * 16
    return np.stack([cv2.resize(coarse[..., c], size, interpolation=cv2.INTER_CUBIC)
                     for c in range(32)], 2)  # fmt: skip


def maps(pixels: np.ndarray, scale: float = 1.0) -> DescriptorMaps:
    """Make maps of descriptors. Coarse ones depend on a larger part of the image than fine ones."""
    wide = np.stack([cv2.GaussianBlur(pixels[..., c], (0, 0), 12.0)
                     for c in range(pixels.shape[2])], 2)  # fmt: skip
    return DescriptorMaps(unit(wide[::16, ::16]), unit(pixels[::4, ::4]), scale)


def moved(pixels: np.ndarray, dx: float, dy: float) -> np.ndarray:
    M = np.array([[1, 0, dx], [0, 1, dy]], np.float64)
    size = pixels.shape[1], pixels.shape[0]
    return np.stack([cv2.warpAffine(pixels[..., c], M, size, flags=cv2.INTER_CUBIC,
                                    borderMode=cv2.BORDER_REFLECT)
                     for c in range(pixels.shape[2])], 2)  # fmt: skip


def test_coarse_matches_are_each_others_nearest():
    a, b = maps(field(0)), maps(field(0)[:, ::-1].copy() + 0.3 * field(1))
    found = match_coarse(a, b, 0.3)
    similarity = a.coarse.reshape(-1, 32) @ b.coarse.reshape(-1, 32).T
    best = similarity.argmax(1)
    mutual = (similarity.argmax(0)[best] == np.arange(len(best))) & (similarity.max(1) >= 0.3)
    assert found.a.tolist() == np.flatnonzero(mutual).tolist()
    assert found.b.tolist() == best[mutual].tolist()
    np.testing.assert_allclose(found.similarity, similarity.max(1)[mutual], atol=1e-5)
    assert 0 < len(found.a) < len(best)


def test_cells_lie_at_pixels_of_the_camera():
    a = maps(field(0), scale=0.5)
    assert positions(np.array([0, 1, 40, 83]), a).tolist() == [[0, 0], [32, 0], [0, 32], [96, 64]]


@pytest.mark.parametrize("shift", [(16.0, 0.0), (33.0, -5.0), (-9.5, 6.25)])
def test_points_are_found_to_a_fraction_of_a_pixel(shift):
    pixels = field(2)
    a, b = maps(pixels, 0.5), maps(moved(pixels, *shift), 0.5)
    rng = np.random.default_rng(0)
    xy = rng.uniform([120, 60], [1100, 320], (300, 2)).astype(np.float32)
    found = locate(xy, a, b, match_coarse(a, b, 0.3), 5, 0.5)
    assert found.found.mean() > 0.9
    error = np.linalg.norm(found.xy - xy - 2 * np.array(shift), axis=1)[found.found]
    assert np.median(error) < 2.0  # pixels of the camera; a cell has 8
    near = locate_near(xy, xy + 2.0 * np.array(shift) + 6.0, a, b, 3, 0.5)
    assert near.found.mean() > 0.9
    assert np.nanmedian(np.linalg.norm(near.xy - xy - 2 * np.array(shift), axis=1)) < 2.0


def test_nothing_is_found_where_nothing_leads_or_nothing_is_alike():
    pixels = field(3)
    a, b = maps(pixels), maps(field(4))
    xy = np.array([[100.0, 50.0], [300.0, 90.0], [-5.0, 20.0], [900.0, 20.0]], np.float32)
    none = CoarseMatches(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32))
    assert not locate(xy, a, a, none, 5, 0.5).found.any()
    there = match_coarse(a, a, 0.3)
    assert locate(xy, a, a, there, 5, 0.5).found.tolist() == [True, True, False, False]
    assert not locate(xy, a, b, there, 5, 0.95).found.any()
    far = np.full((4, 2), np.nan)
    assert not locate_near(xy, far, a, a, 3, 0.5).found.any()


def test_a_point_must_lead_back():
    """Two places in image a look like one place in image b.

    The match of the wrong place leads back to the other place.
    """
    pixels = field(5)
    twice = pixels.copy()
    twice[:, 320:328] = pixels[:, 304:312] * 0.9 + 0.1 * field(6)[:, 304:312]
    a, b = maps(twice), maps(pixels)
    place = np.array([[308.0, 90.0], [324.0, 90.0]], np.float32)
    expected = np.array([[308.0, 90.0], [308.0, 90.0]])
    assert locate_near(place, expected, a, b, 2, 0.3).found.tolist() == [True, True]
    # If the window contains both places, only the true one is matched in both directions.
    assert locate_near(place, expected, a, b, 5, 0.3).found.tolist() == [True, False]


def test_fine_matches_confirm_a_scene_seen_again_and_not_one_that_is_alike_in_part_or_coarsely():
    pixels, other = field(6), field(7)
    keypoints = np.random.default_rng(0).uniform([40, 20], [560, 170], (400, 2)).astype(np.float32)
    a, again, another = (maps(one) for one in (pixels, moved(pixels, 32.0, 5.0), other))
    part = pixels.copy()
    part[:, 120:] = other[:, 120:]

    def agreement(b: DescriptorMaps, guides: DescriptorMaps, xy: np.ndarray = keypoints) -> float:
        located = locate(xy, a, b, match_coarse(a, guides, 0.3), 5, 0.5)
        return fine_agreement(xy, located, a, b)

    assert agreement(again, again) > 0.9
    assert 0.1 < agreement(maps(part), maps(part)) < 0.6
    # The coarse cells agree everywhere, as in another town with the same facades.
    alike = another._replace(coarse=again.coarse)
    assert homography_inliers(match_coarse(a, alike, 0.5), a, alike) > 300
    assert agreement(alike, alike) < 0.3
    assert agreement(again, again, keypoints[:2]) == 0.0
