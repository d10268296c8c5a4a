"""Noise is removed and low contrast is increased. Other images stay unchanged."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vslam.config import Config, OrbConfig, TrackingConfig, WeakImageConfig
from vslam.frontend import tracking
from vslam.frontend.extraction import FrameImages
from vslam.frontend.orb import extract
from vslam.frontend.stereo import inliers_only, match_stereo
from vslam.frontend.weak_images import (
    LEAST_SPIKE,
    ROW_STRIDE,
    contrast,
    extract_in_any_light,
    grain,
    is_faint,
    with_contrast,
    without_noise,
)
from vslam.slam import Slam
from vslam.types.camera import Camera
from vslam.types.context import Context

ORB = OrbConfig(n_features=800)
CONFIG = Config(orb=ORB)
# With these thresholds, no image counts as noisy or faint.
NEVER = WeakImageConfig(noise_from=1e9, spikes_from=1.0, low_contrast=0.0)
BEFORE = Config(orb=ORB, weak_images=NEVER)
CAMERA = Camera(300.0, 300.0, 200.0, 100.0, 0.5, 400, 200)
DISPARITY = 7


def scene(spread: float = 35.0, grain_px: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Return both images of a textured wall, as float64 grey values."""
    rough = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(200, 420)), (0, 0), grain_px)
    grey = 110.0 + spread * rough / rough.std()
    return grey[:, :400], grey[:, DISPARITY : 400 + DISPARITY]


def camera_image(light: np.ndarray, noise: float = 0.0, seed: int = 1) -> np.ndarray:
    seen = light + noise * np.random.default_rng(seed).standard_normal(light.shape)
    return np.clip(np.rint(seen), 0, 255).astype(np.uint8)


def spiked(image: np.ndarray, share: float, seed: int) -> np.ndarray:
    number = np.random.default_rng(seed).random(image.shape)
    white = np.where(number < share / 2, 255, 0).astype(np.uint8)
    return np.where(number < share, white, image)


def right_matches(left: np.ndarray, right: np.ndarray, config: Config) -> int:
    """Return which stereo matches are within a pixel of the true position."""
    ours, theirs = extract_in_any_light([left, right], config)
    u_right = inliers_only(match_stereo(ours, theirs, CAMERA), ours.octave)
    return int(np.count_nonzero(np.abs(ours.xy[:, 0] - u_right - DISPARITY) < 1.0))


def test_usual_images_stay_the_same_objects():
    pair = [camera_image(side, noise=2.0, seed=k) for k, side in enumerate(scene())]
    kept = without_noise(pair, CONFIG.weak_images)
    assert all(one is other for one, other in zip(pair, kept, strict=True))
    for image, found in zip(pair, extract_in_any_light(pair, CONFIG), strict=True):
        plain = extract(image, ORB)
        assert found.xy.tobytes() == plain.xy.tobytes()
        assert found.descriptors.tobytes() == plain.descriptors.tobytes()
        assert found.pyramid.pixels.tobytes() == plain.pyramid.pixels.tobytes()


def test_a_textureless_image_of_good_light_is_not_touched():
    """Few corners do not mean low contrast. The contrast in blocks of the image decides."""
    stripes = np.tile(np.where(np.arange(400) // 12 % 2, 180, 60).astype(np.uint8), (200, 1))
    (found,) = extract_in_any_light([stripes], CONFIG)
    assert len(found.xy) < 0.5 * ORB.n_features
    assert contrast(stripes) > CONFIG.weak_images.low_contrast
    assert found.pyramid.level(0).tobytes() == stripes.tobytes()


def test_an_image_out_of_focus_is_not_faint():
    """The image has as few corners and as little contrast as a faint image, but no detail."""
    sharp, blurred = scene(spread=2.0)[0], scene(spread=2.0, grain_px=12.0)[0]
    assert contrast(camera_image(sharp)) < CONFIG.weak_images.low_contrast
    assert contrast(camera_image(blurred)) < CONFIG.weak_images.low_contrast
    assert is_faint([camera_image(sharp)], [0], CONFIG)
    (found,) = extract_in_any_light([camera_image(3.0 * blurred - 220.0)], CONFIG)
    assert found.pyramid.level(0).tobytes() == camera_image(3.0 * blurred - 220.0).tobytes()


@pytest.mark.parametrize("noise", [5.0, 10.0, 20.0, 40.0])
def test_noise_is_measured_in_grey_levels(noise):
    image = camera_image(scene(spread=15.0, grain_px=4.0)[0], noise)
    sigma, spikes = grain(image, ROW_STRIDE, LEAST_SPIKE)
    assert sigma == pytest.approx(noise, rel=0.1)
    assert spikes < CONFIG.weak_images.spikes_from


def test_texture_is_no_noise():
    sigma, spikes = grain(camera_image(scene()[0]), ROW_STRIDE, LEAST_SPIKE)
    assert sigma < 0.5 * 35.0
    assert spikes == 0.0


@pytest.mark.parametrize("share", [0.08, 0.12, 0.16])
def test_spikes_are_counted_and_taken_out(share):
    clean = camera_image(scene(grain_px=4.0)[0])
    image = spiked(clean, share, seed=3)
    _, spikes = grain(image, ROW_STRIDE, LEAST_SPIKE)
    # A spike next to one of the same colour, or one that resembles the scene, does not stand out.
    assert 0.4 * share < spikes < share
    (mended,) = without_noise([image], CONFIG.weak_images)
    error = [float(np.abs(one.astype(float) - clean).mean()) for one in (image, mended)]
    assert error[1] < 0.5 * error[0]


def test_images_of_one_moment_are_treated_alike():
    left, right = scene()
    one, two = without_noise(
        [camera_image(left), camera_image(right, noise=30.0)], CONFIG.weak_images
    )
    assert one.tobytes() != camera_image(left).tobytes()
    assert grain(two, ROW_STRIDE, LEAST_SPIKE)[0] < CONFIG.weak_images.noise_from


@pytest.mark.parametrize("stops", [4.0, 5.0, 6.0])
def test_a_faint_pair_is_matched_where_nothing_was_found(stops):
    """The contrast of 35 grey levels is reduced to between 0.5 and 2.

    Noise of half a grey level keeps details that rounding would remove.
    """
    pair = [camera_image(side * 2.0**-stops, 0.5, k) for k, side in enumerate(scene())]
    before, after = right_matches(*pair, BEFORE), right_matches(*pair, CONFIG)
    assert before < 20
    assert after > 150


@pytest.mark.parametrize("noise", [50.0, 70.0])
def test_a_noisy_pair_is_matched(noise):
    """The texture has a size of 4 pixels, as in a scene that is near the camera."""
    pair = [camera_image(side, noise, k) for k, side in enumerate(scene(grain_px=4.0))]
    before, after = right_matches(*pair, BEFORE), right_matches(*pair, CONFIG)
    assert after > 2.5 * before
    assert after > 250


def test_contrast_is_raised_to_that_of_a_clear_image():
    faint = camera_image(scene()[0] * 2.0**-5, 0.5)
    assert contrast(faint) < 2.0
    raised = contrast(with_contrast(faint))
    assert raised == pytest.approx(12.0, rel=0.3)


def test_a_black_right_side_leaves_the_left_one_as_it_is():
    left = camera_image(scene()[0])
    context = Context.create(CAMERA, CONFIG)
    features = FrameImages(left, lambda: np.zeros_like(left), context).extracted.features
    plain = extract(left, ORB)
    assert features.xy.tobytes() == plain.xy.tobytes()
    assert features.descriptors.tobytes() == plain.descriptors.tobytes()


def test_nothing_is_made_of_nothing():
    black = np.zeros((200, 400), np.uint8)
    assert all(len(one.xy) == 0 for one in extract_in_any_light([black, black], CONFIG))
    tiny = np.zeros((8, 8), np.uint8)
    assert contrast(tiny) == 0.0
    assert grain(np.zeros((2, 2), np.uint8), ROW_STRIDE, LEAST_SPIKE) == (0.0, 0.0)


def drive(corridor, change, config: Config) -> tuple[str, float]:
    """Return the state of each frame as one letter, and the largest error in metres."""
    slam = Slam(corridor.camera, config, "none", threads=1)
    states = ""
    for k, (left, right) in enumerate(zip(corridor.left, corridor.right, strict=True)):
        sides = (change(image, 2 * k + side) for side, image in enumerate((left, right)))
        states += slam.step(*sides, corridor.timestamps[k]).state[0]
    slam.finish()
    errors = slam.trajectory().T_wc[:, :3, 3] - corridor.T_wc[:, :3, 3]
    return states, float(np.linalg.norm(errors, axis=1).max())


@pytest.mark.parametrize(
    ("change", "lost"),
    [
        (lambda image, seed: camera_image(image * 2.0**-5, 0.45, seed), 0),
        (lambda image, seed: camera_image(image, 50.0, seed), 1),
        (lambda image, seed: spiked(image, 0.2, seed), 0),
    ],
    ids=["5 stops of night", "noise of 50 grey levels", "20 % spikes"],
)
def test_a_drive_that_was_lost_is_tracked(corridor, change, lost):
    before, _ = drive(corridor, change, BEFORE)
    after, error = drive(corridor, change, CONFIG)
    assert before.count("L") > 20, before
    assert after.count("L") <= lost, after
    assert error < 0.1 + 0.7 * lost


@pytest.mark.parametrize("window", [7.0, 0.01])
def test_what_the_frame_before_did_not_see_is_matched_around_the_prediction(
    corridor, window, monkeypatch
):
    """One half of a frame is dark, and the other half of the next frame.

    The two frames have no landmarks in common, but the map contains those of both. Without a search
    around the prediction, the second frame would be lost.
    """
    monkeypatch.setattr(tracking, "_PREDICTED_WINDOW", window)
    by_features = Config(orb=ORB, tracking=TrackingConfig(method="orb"))
    slam = Slam(corridor.camera, by_features, threads=1)
    half = corridor.camera.width // 2
    states = ""
    for k in range(14):
        left, right = corridor.left[k].copy(), corridor.right[k].copy()
        for image in (left, right):
            if k == 12:
                image[:, half:] = 0
            if k == 13:
                image[:, :half] = 0
        states += slam.step(left, right, corridor.timestamps[k]).state[0]
    assert states == "O" * 13 + ("O" if window > 1 else "L")
