"""Cylindrical images: a rotation of the camera moves their contents, but does not distort them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from vslam_lab.training.preprocessing import Unrolling

SIZE, HALF_ANGLE = (97, 217), 40.0


def walls(direction: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return the grey values of a cylinder around the camera.

    ``direction`` is in radians. ``height`` is 1 at the upper and lower border of the image, in the
    middle column.
    """
    stripes = np.sin(9 * direction) + np.cos(4 * direction + 2 * height)
    return 0.5 + 0.15 * stripes + 0.1 * np.sin(5 * height)


def flat_image(heading: float) -> torch.Tensor:
    """Return the image of a pinhole camera that has turned by ``heading`` radians."""
    y, x = (((np.arange(n) + 0.5) / n * 2 - 1) for n in SIZE)
    direction = np.arctan(x * math.tan(math.radians(HALF_ANGLE)))
    image = walls(direction + heading, y[:, None] * np.cos(direction))
    return torch.from_numpy(image).float()[None, None]


@pytest.mark.parametrize("middle", [math.cos(math.radians(HALF_ANGLE)), 0.9, 1.0])
@pytest.mark.parametrize("heading", [0.0, math.radians(30)])
def test_unrolled_images_show_the_cylinder_whatever_the_heading(heading, middle):
    seen = Unrolling(SIZE, HALF_ANGLE, middle)(flat_image(heading))[0, 0].numpy()
    y, x = (((np.arange(n) + 0.5) / n * 2 - 1) for n in SIZE)
    direction = x * math.radians(HALF_ANGLE)
    beyond = np.abs(middle * y[:, None] / np.cos(direction)) > 1 + 1 / SIZE[0]
    expected = walls(direction + heading, middle * np.repeat(y[:, None], SIZE[1], 1))
    within = np.abs(middle * y[:, None] / np.cos(direction)) < 1 - 1 / SIZE[0]
    # The outermost pixels are partly black.
    assert np.abs(seen - expected)[within].max() < 0.01
    assert np.all(seen[beyond] == 0)
    assert np.all(seen > 0) == (middle < 0.9)


def test_no_angle_leaves_images_as_they_are():
    image = flat_image(0.0)
    assert Unrolling(SIZE, 0.0, 1.0)(image) is image
