"""Perturbations by the weather: fog, and rain in front of the camera and on the glass.

Grey values are assumed to be proportional to luminance, as in KITTI's images.
"""

from __future__ import annotations

from dataclasses import replace
from math import exp, log

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.perturbation.depth import dense_depths
from vslam.datasets.perturbation.kinds import (
    EachSide,
    LawKind,
    Pair,
    PairLaw,
    RandomStream,
    Scene,
    to_8_bits,
)
from vslam.datasets.perturbation.motion import forward_speed
from vslam.types.camera import Camera, Image

AIRLIGHT = 200.0  # grey value of the horizon in dense fog
_CONTRAST_AT_VISIBILITY = 0.05  # meteorological optical range, WMO Guide No. 8, I.9

_SHUTTER_S = 0.01
_NEAR_M, _FAR_M = 0.35, 3.0  # the streaks of drops farther away are fainter than a grey level
_LEAST_MM = 1.0  # the streaks of smaller drops are fainter than a grey level
_STREAK_GREY = 220.0
_OPACITY_STEPS = 1000.0  # opacities are drawn as uint8 in thousandths, so that they end at 0.255
_GLASS_WIDTH_M, _WIPED_EVERY_S, _GLASS_DROP_M = 0.03, 3.0, 0.002


def _fog(visibility_m: float, stream: RandomStream, scene: Scene) -> PairLaw:
    """Add fog by Koschmieder's law (Beitr. Phys. 1924): ``I = J e^(-b d) + A (1 - e^(-b d))``.

    d is the distance along the viewing ray.
    """
    extinction = np.float32(-log(_CONTRAST_AT_VISIBILITY) / visibility_m)
    camera = scene.camera
    y, x = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float32)
    ray = np.sqrt(1 + ((x - camera.cx) / camera.fx) ** 2 + ((y - camera.cy) / camera.fy) ** 2)

    def fogged(image: Image, depth: NDArray[np.float32]) -> Image:
        transmission = np.exp(-extinction * ray.astype(np.float32) * depth)
        return to_8_bits(np.float32(AIRLIGHT) + transmission * (image - np.float32(AIRLIGHT)))

    def law(pair: Pair) -> Pair:
        left, right = dense_depths(camera, *pair.clean)
        foggy = replace(pair, left=fogged(pair.left, left))
        if pair.right is None or right is None:
            return foggy
        return replace(foggy, second=fogged(pair.right, right))

    return law


def drops_per_m3(mm_per_h: float) -> tuple[float, float]:
    """Compute the density of raindrops at a rainfall rate [Marshall and Palmer, J. Met. 1948].

    Returns:
        The number of drops larger than 1 mm in a cubic metre of air, and the rate (1/mm) at which
        the number of drops decays exponentially with the diameter.
    """
    rate = 4.1 * mm_per_h**-0.21
    return 8000.0 / rate * exp(-rate * _LEAST_MM), rate


def fall_speed(diameter_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the terminal velocity of raindrops in m/s [Atlas et al., Rev. Geophysics 1973]."""
    return 9.65 - 10.3 * np.exp(-0.6 * diameter_mm)


def _rain(mm_per_h: float, stream: RandomStream, scene: Scene) -> PairLaw:
    camera = scene.camera

    def law(frame: int, t: float, side: int, image: Image) -> Image:
        if mm_per_h == 0:
            return image
        opacity = _streaks(mm_per_h, np.random.default_rng([*stream, frame]), side, frame, scene)
        wet = image + opacity * (np.float32(_STREAK_GREY) - image)
        wiped = int(t // _WIPED_EVERY_S)
        rng = np.random.default_rng([*stream, side, wiped, 1])
        return _drops_on_glass(to_8_bits(wet), mm_per_h, rng, camera)

    return EachSide(law)


def _streaks(
    mm_per_h: float, rng: np.random.Generator, side: int, frame: int, scene: Scene
) -> NDArray[np.float32]:
    """Return the ``(H, W)`` opacity of the drops that fall during the exposure.

    The opacity is the share of the exposure during which a drop covers a pixel (Garg and Nayar,
    IJCV 2007). Both cameras see the same drops.
    """
    import cv2

    camera = scene.camera
    density, rate = drops_per_m3(mm_per_h)
    volume = 2.0 * camera.width * camera.height / (camera.fx * camera.fy)
    # The volume is twice as wide as the image, so that it also covers the right camera's view.
    volume *= (_FAR_M**3 - _NEAR_M**3) / 3.0
    n = rng.poisson(density * volume)
    diameter = np.minimum(_LEAST_MM + rng.exponential(1.0 / rate, n), 6.0)
    z = (rng.uniform(_NEAR_M**3, _FAR_M**3, n)) ** (1.0 / 3.0)
    u, v = rng.uniform(0, 2.0 * camera.width, n), rng.uniform(0, camera.height, n)
    u -= camera.bf / z if side else 0.0
    fall, ahead = fall_speed(diameter), forward_speed(scene, frame)
    z_end = np.maximum(z - ahead * _SHUTTER_S, 0.1)
    u_end = camera.cx + (u - camera.cx) * z / z_end
    v_end = camera.cy + ((v - camera.cy) * z + camera.fy * fall * _SHUTTER_S) / z_end
    length = np.maximum(np.hypot(u_end - u, v_end - v), 1e-6)
    width = camera.fx * 1e-3 * diameter / z
    opacity = np.minimum(width / length, 1.0) * np.minimum(width, 1.0)
    layer = np.zeros((camera.height, camera.width), np.uint8)
    levels = np.clip(np.rint(opacity * _OPACITY_STEPS), 1, 255).astype(int)
    thick = np.clip(np.rint(width), 1, 12).astype(int)
    # Bright drops are drawn last, so that faint ones do not cover them.
    key = 16 * np.unique(levels, return_inverse=True)[1].astype(int) + thick
    ends = np.rint(16.0 * np.stack([u, v, u_end, v_end], axis=1)).astype(np.int32)
    ends = np.clip(ends, -(1 << 18), 1 << 18).reshape(-1, 2, 2)
    for group in np.unique(key):
        at = key == group
        cv2.polylines(
            layer, list(ends[at]), False, int(levels[at][0]), int(thick[at][0]), cv2.LINE_AA, 4
        )
    return layer.astype(np.float32) / np.float32(_OPACITY_STEPS)


def glass_drops(mm_per_h: float, camera: Camera) -> float:
    """Return the mean number of drops on a glass that is 30 mm wide and wiped every 3 s.

    All water that falls on the glass is assumed to form drops of 2 mm.
    """
    area = _GLASS_WIDTH_M**2 * camera.height / camera.width
    fallen = mm_per_h / 3.6e6 * area * _WIPED_EVERY_S
    return fallen / (np.pi / 6.0 * _GLASS_DROP_M**3)


def _drops_on_glass(
    image: Image, mm_per_h: float, rng: np.random.Generator, camera: Camera
) -> Image:
    """Draw drops on the glass. Like a lens, each drop shows the scene small and upside down."""
    import cv2

    n = rng.poisson(glass_drops(mm_per_h, camera))
    if n == 0:
        return image
    out = image.astype(np.float32)
    y, x = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float32)
    for _ in range(min(n, 200)):
        radius = 0.5 * camera.width * _GLASS_DROP_M / _GLASS_WIDTH_M * rng.uniform(0.6, 1.4)
        at = rng.uniform(0, camera.width), rng.uniform(0, camera.height)
        top, bottom = max(0, int(at[1] - radius)), min(camera.height, int(at[1] + radius) + 1)
        first, last = max(0, int(at[0] - radius)), min(camera.width, int(at[0] + radius) + 1)
        size = (max(1, last - first), max(1, bottom - top))
        turned = cv2.resize(image[::-1, ::-1], size, interpolation=cv2.INTER_AREA)
        refracted = cv2.GaussianBlur(turned, (0, 0), 0.1 * radius).astype(np.float32)
        window = np.s_[top:bottom, first:last]
        r = np.hypot(x[window] - at[0], y[window] - at[1]) / radius
        opacity = np.clip((1.0 - r) / 0.2, 0.0, 1.0)
        if opacity.size:
            rows, columns = opacity.shape
            out[window] += opacity * (refracted[:rows, :columns] - out[window])
    return to_8_bits(out)


KINDS = {
    "fog": LawKind(
        _fog, "m", 60.0, 2000.0, 2.0, "meteorological visibility", least=0.5, most=1e5,
        logarithmic=True, drawn=False, needs=("depth",), of_scene=True,
    ),
    "rain": LawKind(
        _rain, "mm/h", 25.0, 1.0, 1000.0, "streaks and drops on the glass", most=2000.0,
        logarithmic=True, of_scene=True,
    ),
}  # fmt: skip
