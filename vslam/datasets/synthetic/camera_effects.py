"""Lens and sensor of the rendered camera: blur, vignetting, response and noise.

The result depends only on the radiance and on seed, frame and side.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera

SHUTTER = 0.004  # s, exposure time by day
_BLUR = 0.55  # px, standard deviation of the lens blur
_VIGNETTE = 0.22  # share of the light lost in the corners
_READ_NOISE, _SHOT_NOISE = 0.9, 0.022  # standard deviation (grey levels); variance per grey level
_KNEE, _ROLL = 170.0, 0.5  # grey level at which the response bends, and its slope above


def sensor_image(
    radiance: NDArray[np.float32],
    camera: Camera,
    *,
    yaw_rate: float,
    night: float,
    key: tuple[int, int, int],
) -> NDArray[np.uint8]:
    """Turn radiance into the ``(H, W)`` uint8 image of the camera.

    Args:
        radiance: ``(H, W)`` float32, from `render.RenderedView.image`.
        camera: its focal length scales the motion blur.
        yaw_rate: rad/s, causes motion blur.
        night: 0 to 1, lengthens the exposure and raises the gain.
        key: seed, frame and side, which determine the noise.
    """
    image = radiance
    streak = abs(yaw_rate) * SHUTTER * (1 + 2 * night) * camera.fx
    if streak > 0.2:
        kernel = _streak(streak)[None, :]
        blurred = cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE)
        image = np.asarray(blurred, np.float32)
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), _BLUR), np.float32)
    image = image * _vignette(camera)
    image = np.minimum(image, _KNEE + _ROLL * (image - _KNEE))
    image = np.minimum(image, 255.0)
    rng = np.random.default_rng(key)
    gain = 1.0 + 5.0 * night
    deviation = np.sqrt(_READ_NOISE**2 + _SHOT_NOISE * np.maximum(image, 0)) * np.float32(gain)
    image = image + deviation * rng.standard_normal(image.shape, np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _streak(length: float) -> NDArray[np.float32]:
    """Box filter ``length`` pixels wide, whose outer pixels are weighted by their covered part."""
    half = int(np.ceil(length / 2 + 0.5))
    at = np.arange(-half, half + 1)
    weight = np.clip(length / 2 + 0.5 - np.abs(at), 0, 1)
    return np.asarray(weight / weight.sum(), np.float32)


def _vignette(camera: Camera) -> NDArray[np.float32]:
    u = (np.arange(camera.width) - camera.cx) / camera.fx
    v = (np.arange(camera.height) - camera.cy) / camera.fx
    square = (u[None, :] ** 2 + v[:, None] ** 2) / (u.max() ** 2 + v.max() ** 2)
    return np.asarray(1.0 - _VIGNETTE * square**1.5, np.float32)
