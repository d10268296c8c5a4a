"""Augments images with random changes in viewpoint, lighting, occlusion and sensor.

The augmented image still shows the same place.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from vslam_lab.sources.image_source import turn_homography

_TURNED, _ZOOMED = 0.5, 0.5  # shares of images that are rotated and zoomed, if enabled


class Augmentation(BaseModel):
    """Strengths of the random changes that are applied to training images. A strength of 0 disables
    a change.

    Zhou and Sun (Sci Rep 15, 7644, 2025), whose network is trained here, change perspective and
    luminance, and mask parts of the image.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    homography: float = Field(
        0.10,
        ge=0,
        le=0.4,
        description="Largest shift of a corner of the image, relative to each side.",
    )
    shift: float = Field(
        0.10, ge=0, le=0.5, description="Largest horizontal shift, relative to the width."
    )
    turn: float = Field(0.0, ge=0, le=45, description="Largest rotation of the camera, degrees.")
    zoom: float = Field(
        0.0,
        ge=0,
        le=1,
        description="Largest log of the zoom factor. A zoom imitates driving forwards.",
    )
    log_gain: float = Field(0.35, ge=0, description="Standard deviation of the log of the gain.")
    bias: float = Field(20.0, ge=0, description="Standard deviation of the bias, grey levels.")
    log_gamma: float = Field(0.25, ge=0, description="Standard deviation of the log of gamma.")
    masks: int = Field(3, ge=0, description="Largest number of masks.")
    mask_area: float = Field(
        0.10, ge=0, le=0.5, description="Largest share of the image that one mask covers."
    )
    noise: float = Field(6.0, ge=0, description="Largest standard deviation of noise, grey levels.")
    blur: float = Field(1.0, ge=0, description="Largest sigma of a Gaussian blur, pixels.")
    mirror: bool = Field(True, description="Mirror both images of every second pair.")


# Only changes in lighting and occlusion are stronger than by default. Rendered pairs already differ
# in viewpoint. The noise and blur of a camera average out at the resolution of the network.
STRONG = Augmentation(
    homography=0.08, shift=0.12, log_gain=0.5, bias=30.0, log_gamma=0.5, masks=3, mask_area=0.15,
)  # fmt: skip


def augment(
    image: NDArray[np.uint8], strength: Augmentation, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Apply random changes to an ``(H, W)`` uint8 image, in the order in which an image is formed:
    viewpoint, occlusion, lighting, lens, sensor, quantisation to 8 bits."""
    import cv2

    height, width = image.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    largest = np.array([width, height], np.float32) * np.float32(strength.homography)
    moved = corners + rng.uniform(-1, 1, (4, 2)).astype(np.float32) * largest
    moved[:, 0] += rng.uniform(-1, 1) * strength.shift * width
    H = cv2.getPerspectiveTransform(corners, moved)
    border = cv2.BORDER_REFLECT_101
    if strength.turn > 0 and rng.random() < _TURNED:
        H = H @ turn_homography(width, height, rng.uniform(-1, 1) * strength.turn)
        # The scene beyond the border is unknown, so it becomes black or a mirror image.
        border = cv2.BORDER_CONSTANT if rng.random() < 0.5 else border
    if strength.zoom > 0 and rng.random() < _ZOOMED:
        # Enlarging the image around its centre approximates driving forwards.
        factor = np.exp(rng.uniform(0, strength.zoom))
        x, y = (1.0 - factor) * width / 2, (1.0 - factor) * height / 2
        H = H @ np.array([[factor, 0, x], [0, factor, y], [0, 0, 1.0]])
    out = np.asarray(cv2.warpPerspective(image, H, (width, height), borderMode=border), np.uint8)
    for _ in range(int(rng.integers(strength.masks + 1))):
        _cover(out, strength.mask_area, rng)
    grey = np.arange(256) / 255.0
    curve = 255.0 * grey ** np.exp(strength.log_gamma * rng.standard_normal())
    curve = np.exp(strength.log_gain * rng.standard_normal()) * curve
    curve += strength.bias * rng.standard_normal()
    out = np.asarray(cv2.LUT(out, np.clip(np.rint(curve), 0, 255).astype(np.uint8)), np.uint8)
    # Negative draws have no effect. Half of the images therefore stay sharp, and half free of
    # noise.
    blur, noise = rng.uniform(-1, 1, 2) * (strength.blur, strength.noise)
    if blur > 0.2:
        out = np.asarray(cv2.GaussianBlur(out, (0, 0), float(blur)), np.uint8)
    if noise > 0.5:
        grain = rng.standard_normal(out.shape, dtype=np.float32)
        out = np.clip(np.rint(out + np.float32(noise) * grain), 0, 255).astype(np.uint8)
    return out


def _cover(image: NDArray[np.uint8], largest: float, rng: np.random.Generator) -> None:
    rows, columns = image.shape
    area = rng.uniform(0.0, largest)
    if area == 0.0:
        return
    stretch = np.exp(rng.uniform(-0.7, 0.7))
    width = min(columns, max(1, round(columns * float(np.sqrt(area) * stretch))))
    height = min(rows, max(1, round(rows * float(np.sqrt(area) / stretch))))
    x, y = rng.integers(columns - width + 1), rng.integers(rows - height + 1)
    image[y : y + height, x : x + width] = rng.integers(256)
