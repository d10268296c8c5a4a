"""Corners of an uncalibrated camera are found again in later images, however the images deform."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vslam.calibration.affine_patches import Patches
from vslam.calibration.chains import chains_of

SIZE = (384, 288)
CENTRE = (np.array(SIZE) - 1.0) / 2.0


@pytest.fixture(scope="module")
def texture() -> np.ndarray:
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (700, 700)).astype(np.float32), (0, 0), 2.0)
    return (image - image.mean()) / image.std() * 45.0 + 128.0


def motion(k: float) -> np.ndarray:
    """Return the ``(2, 3)`` map from the texture to image k, which is nearer and turned."""
    turn, scale = np.radians(1.5 * k), 0.9 * 1.025**k
    A = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return np.c_[A, CENTRE - A @ [350.0, 350.0] + [2.0 * k, 0.0]]


def seen(texture: np.ndarray, k: float) -> np.ndarray:
    image = cv2.warpAffine(texture, motion(k), SIZE, flags=cv2.INTER_CUBIC)
    noise = np.random.default_rng(int(10 * k)).normal(0.0, 2.0, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def moved(xy: np.ndarray, start: float, end: float) -> np.ndarray:
    """Map pixels of one image to another."""
    (A, a), (B, b) = ((M[:, :2], M[:, 2]) for M in (motion(start), motion(end)))
    return np.linalg.solve(A, (xy - a).T).T @ B.T + b


def test_corners_do_not_drift_while_the_scene_comes_nearer_and_turns(texture):
    (chain, *_) = chains_of((k, seen(texture, k)) for k in range(30))
    errors = [
        min(np.nanmedian(np.linalg.norm(moved(chain.xy[0], 0, k) - xy, axis=1)) for k in range(30))
        for xy in chain.xy
    ]
    assert max(errors) < 0.05  # 1.9 pixels if corners are only followed from image to image
    assert len(chain.xy[0]) > 100


def test_a_patch_is_found_with_its_deformation_under_another_light(texture):
    x, y = np.meshgrid(np.arange(120.0, 280.0, 30.0), np.arange(90.0, 210.0, 30.0))
    xy = np.stack([x.ravel(), y.ravel()], axis=-1)
    patches, rows = Patches.around(seen(texture, 0.0), xy), np.arange(len(xy))
    darker = np.rint(0.7 * seen(texture, 4.0) + 20.0).astype(np.uint8)
    exact = moved(xy, 0.0, 4.0)
    shifted = exact + np.array([0.8, -0.6])
    start = np.tile(np.eye(2), (len(xy), 1, 1))
    found, deformed, good = patches.aligned(darker, rows, shifted, start)
    assert good.mean() > 0.9
    assert np.abs(found - exact)[good].max() < 0.2
    relative = motion(4.0)[:, :2] @ np.linalg.inv(motion(0.0)[:, :2])
    assert np.abs(deformed[good] - relative).max() < 0.05


def test_a_patch_that_looks_otherwise_is_not_good(texture):
    xy = np.array([[150.0, 120.0], [200.0, 150.0], [0.0, 0.0], [383.0, 287.0]])
    image, rows, start = seen(texture, 0.0), np.arange(4), np.tile(np.eye(2), (4, 1, 1))
    patches = Patches.around(image, xy)
    assert patches.aligned(image, rows, xy, start)[2].all()
    other = np.ascontiguousarray(image[::-1, ::-1])
    assert not patches.aligned(other, rows, xy, start)[2].any()
    assert not patches.aligned(np.zeros_like(image), rows, xy, start)[2].any()
