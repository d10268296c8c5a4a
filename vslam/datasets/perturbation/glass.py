"""Perturbations by the lens, and by dirt on the glass in front of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.perturbation.kinds import (
    EachSide,
    Law,
    LawKind,
    PairLaw,
    RandomStream,
    Scene,
    to_8_bits,
)
from vslam.types.camera import Image

_DIRT_GREY, _DIRT_SOFTNESS_PX = 45.0, 3.0
_GHOSTS = 5


def _blur(strength: float, stream: RandomStream) -> Law:
    def law(frame: int, t: float, side: int, image: Image) -> Image:
        import cv2

        if strength == 0:
            return image
        return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.5 * strength), np.uint8)

    return law


def _occlusion(strength: float, stream: RandomStream) -> Law:
    area = min(0.15 * strength, 0.9)

    def law(frame: int, t: float, side: int, image: Image) -> Image:
        rng = np.random.default_rng([*stream, int(t)])
        height, width = image.shape
        across = rng.uniform(area, 1.0)  # fraction of the width; the height follows from the area
        box_w, box_h = round(across * width), round(area / across * height)
        x, y = rng.integers(width - box_w + 1), rng.integers(height - box_h + 1)
        covered = image.copy()
        covered[y : y + box_h, x : x + box_w] = rng.integers(256)
        return covered

    return law


def _vignetting(stops: float, stream: RandomStream, scene: Scene) -> PairLaw:
    width, height = scene.camera.width, scene.camera.height
    x, y = np.arange(width) - (width - 1) / 2.0, np.arange(height) - (height - 1) / 2.0
    corner = x[0] ** 2 + y[0] ** 2
    share = (x[None, :] ** 2 + y[:, None] ** 2) / corner
    gain = (2.0 ** (-stops * share)).astype(np.float32)
    return EachSide(lambda frame, t, side, image: to_8_bits(image * gain))


def _dirt(percent: float, stream: RandomStream, scene: Scene) -> PairLaw:
    """Cover the image with blobs of dirt, which differ between the cameras but do not move."""
    opacity = [_blobs(percent / 100.0, [*stream, side], scene) for side in range(2)]

    def law(frame: int, t: float, side: int, image: Image) -> Image:
        return to_8_bits(image + opacity[side] * (np.float32(_DIRT_GREY) - image))

    return EachSide(law)


def _blobs(share: float, seed: list[int], scene: Scene) -> NDArray[np.float32]:
    import cv2

    shape = scene.camera.height, scene.camera.width
    if share == 0:
        return np.zeros(shape, np.float32)
    rng = np.random.default_rng(seed)
    grain = rng.standard_normal(shape, dtype=np.float32)
    field = cv2.GaussianBlur(grain, (0, 0), 0.02 * shape[1])
    covered = (field > np.quantile(field, 1.0 - share)).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(covered, (0, 0), _DIRT_SOFTNESS_PX), np.float32)


def _flare(greys: float, stream: RandomStream, scene: Scene) -> PairLaw:
    """Add the glare of a distant sun that does not move in the images."""
    camera = scene.camera
    rng = np.random.default_rng(stream)
    sun = np.array([rng.uniform(0.15, 0.85) * camera.width, rng.uniform(0.05, 0.3) * camera.height])
    y, x = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float32)
    cosine = _cosine_to(sun, x, y, scene)
    degrees = np.maximum(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))), 0.5)
    veil = greys * (10.0 / degrees) ** 2
    axis = np.array([camera.cx, camera.cy])
    # Reflections between lens elements lie on the line through the sun and the optical axis.
    for _ in range(_GHOSTS):
        at = axis + (axis - sun) * rng.uniform(-0.6, 1.4)
        radius = camera.width * rng.uniform(0.01, 0.05)
        veil[(x - at[0]) ** 2 + (y - at[1]) ** 2 < radius**2] += 0.5 * greys
    stray = veil.astype(np.float32)
    return EachSide(lambda frame, t, side, image: to_8_bits(image + stray))


def _cosine_to(
    sun: NDArray[np.float64], x: NDArray[np.float32], y: NDArray[np.float32], scene: Scene
) -> NDArray[np.float64]:
    """Return the cosine of the angle between the viewing rays of all pixels and of ``sun``."""
    camera = scene.camera
    ray = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)])
    to_sun = np.array([(sun[0] - camera.cx) / camera.fx, (sun[1] - camera.cy) / camera.fy, 1.0])
    dot = np.tensordot(to_sun, ray, 1)
    return np.asarray(dot / (np.linalg.norm(ray, axis=0) * np.linalg.norm(to_sun)))


KINDS = {
    "blur": LawKind(
        _blur, "x", 1.0, 0.1, 10.0, "Gaussian blur of 1.5 pixels", logarithmic=True, drawn=False
    ),
    "occlusion": LawKind(
        _occlusion, "x", 1.0, 0.1, 6.0, "a grey rectangle over 15 % of the image", logarithmic=True
    ),
    "vignetting": LawKind(
        _vignetting, "stops", 2.0, 0.0, 16.0, "darker towards the corners", most=20.0,
        of_scene=True, drawn=False,
    ),
    "dirt": LawKind(
        _dirt, "%", 10.0, 0.0, 95.0, "share of the glass that blobs cover", most=99.0, of_scene=True
    ),
    "flare": LawKind(
        _flare, "grey levels", 20.0, 0.1, 255.0, "veiling glare at 10 degrees from the sun",
        most=1000.0, logarithmic=True, of_scene=True,
    ),
}  # fmt: skip
