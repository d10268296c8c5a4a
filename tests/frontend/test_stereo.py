"""Stereo matching on a random texture that is shifted by known amounts."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vslam.config import OrbConfig
from vslam.frontend.orb import Extraction, extract
from vslam.frontend.stereo import inliers_only, match_stereo, rows_to_features, slide
from vslam.types.camera import Camera

HEIGHT, WIDTH = 200, 480
ORB = OrbConfig(n_features=600)


def texture(seed: int = 0) -> np.ndarray:
    """Make a texture that is so smooth that it can be shifted by fractions of a pixel."""
    rng = np.random.default_rng(seed)
    blocks = np.kron(rng.uniform(20, 235, (HEIGHT // 6 + 1, WIDTH // 6 + 1)), np.ones((6, 6)))
    return cv2.GaussianBlur(blocks[:HEIGHT, :WIDTH].astype(np.float32), (0, 0), 1.2)


def shifted(image: np.ndarray, dx: float, dy: float = 0.0) -> np.ndarray:
    """Move ``image`` left by ``dx`` and down by ``dy`` pixels, using the phase of its spectrum."""
    fy = np.fft.fftfreq(image.shape[0])[:, None]
    fx = np.fft.fftfreq(image.shape[1])[None, :]
    spectrum = np.fft.fft2(image) * np.exp(2j * np.pi * (fx * dx - fy * dy))
    return np.fft.ifft2(spectrum).real


def extracted(image: np.ndarray) -> Extraction:
    return extract(np.clip(np.rint(image), 0, 255).astype(np.uint8), ORB)


def match(
    dx: float, dy: float = 0.0, fx: float = 240.0, noise: float = 0.0
) -> tuple[Extraction, np.ndarray]:
    """Match a plane at disparity ``dx``. Return its left features and the disparities found."""
    image = texture()
    rng = np.random.default_rng(9)
    left = extracted(image + noise * rng.normal(size=image.shape))
    right = extracted(shifted(image, dx, dy) + noise * rng.normal(size=image.shape))
    camera = Camera(fx, fx, WIDTH / 2, HEIGHT / 2, 0.5, WIDTH, HEIGHT)
    u_right = inliers_only(match_stereo(left, right, camera), left.octave)
    assert u_right.dtype == np.float32
    return left, left.xy[:, 0] - u_right


def seen_by_both(left: Extraction, dx: float) -> np.ndarray:
    """Return which features have a match, with its search range, inside the right image."""
    return left.xy[:, 0] - dx > 30 * 1.2 ** left.octave.astype(float)


@pytest.mark.parametrize("disparity", [4.0, 12.0, 37.0])
def test_integer_disparity(disparity):
    left, found = match(disparity, noise=1.0)
    matched = np.isfinite(found)
    # Coarser levels are sampled at other phases. The median of the SAD rejects many of them.
    assert matched[(left.octave == 0) & seen_by_both(left, disparity)].mean() > 0.6
    error = np.abs(found[matched] - disparity)
    assert np.median(error[left.octave[matched] == 0]) < 0.05
    assert np.median(error) < 0.1
    assert (error < 1.0).mean() > 0.98


@pytest.mark.parametrize("disparity", [5.25, 9.5, 20.75])
def test_sub_pixel_disparity(disparity):
    left, found = match(disparity, noise=1.0)
    matched = np.isfinite(found)
    assert np.count_nonzero(matched) > 0.6 * np.count_nonzero(seen_by_both(left, disparity))
    finest = matched & (left.octave == 0)
    assert np.median(np.abs(found[finest] - disparity)) < 0.1
    assert np.median(np.abs(found[matched] - disparity)) < 0.15
    assert (np.abs(found[matched] - disparity) < 1.5).mean() > 0.97


def test_sub_pixel_offsets_follow_the_shift():
    """The shifts differ by a quarter of a pixel, which rounding to whole pixels would hide."""
    medians = []
    for dx in (8.0, 8.25, 8.5, 8.75):
        left, found = match(dx)
        medians.append(np.median(found[np.isfinite(found) & (left.octave == 0)]))
    np.testing.assert_allclose(np.diff(medians), 0.25, rtol=0, atol=0.1)


def test_infinitely_far_points_get_a_tiny_positive_disparity():
    _, found = match(0.0)
    matched = found[np.isfinite(found)]
    assert len(matched) > 300
    assert (matched > 0.0).all()
    assert np.median(matched) < 0.05


def test_nothing_beyond_the_greatest_disparity():
    """A disparity of fx pixels belongs to a point at a depth of one baseline."""
    left, found = match(60.0, fx=70.0)
    assert np.count_nonzero(np.isfinite(found)) > 0.5 * np.count_nonzero(seen_by_both(left, 60.0))
    _, beyond = match(60.0, fx=40.0)
    assert np.count_nonzero(np.isfinite(beyond)) < 0.02 * len(beyond)
    assert not (beyond >= 40.0).any()


def test_features_left_of_the_right_image_have_no_match():
    left, found = match(37.0)
    outside = left.xy[:, 0] < 37.0
    assert np.count_nonzero(outside) > 10
    assert np.isnan(found[outside]).all()


def test_rows_that_do_not_correspond_match_rarely():
    _, aligned = match(12.0)
    _, misaligned = match(12.0, dy=25.0)
    assert np.count_nonzero(np.isfinite(misaligned)) < 0.05 * np.count_nonzero(np.isfinite(aligned))


def test_strangers_match_rarely():
    left, right = extracted(texture(0)), extracted(texture(1))
    camera = Camera(240.0, 240.0, WIDTH / 2, HEIGHT / 2, 0.5, WIDTH, HEIGHT)
    matched = np.isfinite(match_stereo(left, right, camera).u_right)
    assert np.count_nonzero(matched) < 0.05 * len(matched)


def test_an_empty_image_matches_nothing():
    left, black = extracted(texture()), extracted(np.zeros((HEIGHT, WIDTH)))
    camera = Camera(240.0, 240.0, WIDTH / 2, HEIGHT / 2, 0.5, WIDTH, HEIGHT)
    assert np.isnan(match_stereo(left, black, camera).u_right).all()
    assert match_stereo(black, left, camera).u_right.shape == (0,)


def test_rows_to_features_lists_each_feature_in_its_band():
    scales = 1.2 ** np.arange(8)
    rng = np.random.default_rng(0)
    xy = rng.uniform([0, -3], [100, 63], (200, 2)).astype(np.float32)
    octave = rng.integers(0, 8, 200).astype(np.uint8)
    start, items = rows_to_features(xy, octave, scales, 60)
    for row in range(60):
        found = sorted(items[start[row] : start[row + 1]].tolist())
        band = np.ceil(2 * scales[octave])
        sure = np.flatnonzero(np.abs(xy[:, 1] - row) <= 2 * scales[octave])
        possible = np.flatnonzero(np.abs(xy[:, 1] - row) <= band + 1)
        assert set(sure.tolist()) <= set(found) <= set(possible.tolist())
        assert len(set(found)) == len(found)


def test_slide_finds_the_offset_and_refuses_the_end_of_its_search():
    image = np.random.default_rng(0).integers(0, 256, (40, 120), dtype=np.uint8)
    right = np.roll(image, -10, axis=1)
    shift, score = slide(image, right, 60, 20, 48, 5, 5)  # the match is at 50
    assert abs(shift - 2.0) < 0.5
    assert score == 0.0
    assert np.isnan(slide(image, right, 60, 20, 45, 5, 5)[0])  # at the end of the search
    assert np.isnan(slide(image, right, 60, 4, 50, 5, 5)[0])  # patch outside the image
    assert np.isnan(slide(image, right, 60, 20, 9, 5, 5)[0])
    flat = np.full((40, 120), 9, np.uint8)
    assert np.isnan(slide(flat, flat, 60, 20, 50, 5, 5)[0])
