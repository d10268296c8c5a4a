"""The renderer of flat textured surfaces. It is written in Numba and needs no GPU.

A point of a surface is ``origin + s edge_s + t edge_t = z r`` with the ray ``r = K^-1 (u, v, 1)``.
Therefore, ``(s, t, 1) / z = [edge_s edge_t origin]^-1 r``. These are three affine functions of the
pixel. It follows that a surface covers a single interval of each image row, and that depth and
texture coordinates are exact at every pixel.

Visibility is determined at four samples per pixel. If different surfaces are visible at these
samples, the pixel is shaded once for each of the surfaces.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.types.camera import Camera
from vslam_lab.towns.rasterise import find_visible, rasterise
from vslam_lab.towns.scene import (
    Atlas,
    LightValues,
    PosedCamera,
    SampleBand,
    Surfaces,
)
from vslam_lab.towns.shade import shade
from vslam_lab.towns.shadows import NO_LAMPS, LampPools, ShadowMap

SAMPLES = 2  # visibility samples per pixel in each direction
_BANDS = 2  # bands of rows per image; each band is rendered by one thread
# Lens and sensor.
SHUTTER = 0.004  # s, exposure time by day
_BLUR = 0.55  # px, standard deviation of the lens blur
_VIGNETTE = 0.22  # share of the light lost in the corners
# Standard deviation of the read noise (grey levels), and variance of the shot noise per grey level.
_READ_NOISE, _SHOT_NOISE = 0.9, 0.022
_KNEE, _ROLL = 170.0, 0.5  # grey level at which the response bends, and its slope above

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Light:
    """Lighting and atmosphere at a given time.

    Attributes:
        sun: ``(3,)`` float64 unit vector towards the sun, in the world frame.
        direct: irradiance of the sun on a surface that faces it. It is 1 at noon under a clear sky.
        ambient: irradiance of the sky on a horizontal surface.
        glow: brightness of lamps and lit windows.
        haze: grey level of the air, 0 to 255.
        visibility: distance in metres at which the contrast falls to 1/e.
        exposure: grey levels per unit of radiance.
        headlight: brightness of the car's own headlights 10 m ahead.
    """

    sun: NDArray[np.float64]
    direct: float = 1.0
    ambient: float = 0.29
    glow: float = 0.0
    haze: float = 125.0
    visibility: float = 900.0
    exposure: float = 1.95
    headlight: float = 0.0

    def values(self) -> LightValues:
        sky = (self.direct, self.ambient, self.glow)
        air = (self.haze, self.visibility, self.exposure)
        return LightValues(*(float(x) for x in (*self.sun, *sky, *air, self.headlight)))


@dataclass(frozen=True)
class Moment:
    """The scene of one frame. The darkness ``night``, from 0 to 1, raises the sensor's gain."""

    surfaces: Surfaces
    shadows: ShadowMap
    light: Light
    night: float = 0.0
    pools: LampPools = NO_LAMPS


class RenderedView(NamedTuple):
    """A rendered view.

    ``image`` contains ``(H, W)`` float32 grey levels before the sensor is simulated. They may
    exceed 255. ``depth`` contains the ``(H, W)`` float32 depth along z in metres, which is 0 in the
    sky.
    """

    image: Float32
    depth: Float32


class Renderer:
    """Renders views of a town. The result does not depend on the number of threads."""

    def __init__(self, camera: Camera, atlas: Atlas, sky: int, threads: int = 1) -> None:
        """Start the threads.

        Args:
            sky: number of the sky's texture in the atlas, see `textures.sky`.
        """
        self._camera = camera
        self._atlas = atlas
        self._sky = sky
        self._pool = ThreadPoolExecutor(threads)

    def close(self) -> None:
        self._pool.shutdown()

    def stereo(
        self, moment: Moment, T_wc: NDArray[np.float64]
    ) -> tuple[RenderedView, RenderedView]:
        """Render both views of a stereo rig whose left camera has the ``(4, 4)`` pose ``T_wc``."""
        right = T_wc.copy()
        right[:3, 3] += T_wc[:3, 0] * self._camera.baseline
        left_view, right_view = self.views(moment, T_wc, right)
        return left_view, right_view

    def views(self, moment: Moment, *T_wc: NDArray[np.float64]) -> list[RenderedView]:
        """Render a view from each of the ``(4, 4)`` poses ``T_wc``."""
        prepared = [self._pool.submit(self._prepare, moment, T) for T in T_wc]
        views, jobs = [], []
        for preparation in prepared:
            view, bands = preparation.result()
            views.append(view)
            jobs += [self._pool.submit(band) for band in bands]
        for job in jobs:
            job.result()
        return views

    def _prepare(
        self, moment: Moment, T_wc: NDArray[np.float64]
    ) -> tuple[RenderedView, list[Callable[[], None]]]:
        """Make an empty view, and the functions that render its bands."""
        fx, fy, cx, cy = (
            float(x) for x in (self._camera.fx, self._camera.fy, self._camera.cx, self._camera.cy)
        )
        height, width = self._camera.height, self._camera.width
        camera = PosedCamera(np.ascontiguousarray(T_wc), fx, fy, cx, cy, height, width)
        values = moment.light.values()
        visible = find_visible(moment.surfaces, self._atlas, camera, values)
        view = RenderedView(
            np.empty((height, width), np.float32), np.empty((height, width), np.float32)
        )
        edges = np.linspace(0, height, _BANDS + 1).astype(int)

        def band(first: int, end: int) -> None:
            shape = (SAMPLES * (end - first), SAMPLES * width)
            inverse_depth, seen = np.zeros(shape, np.float32), np.full(shape, -1, np.int32)
            samples = SampleBand(first, SAMPLES, inverse_depth, seen)
            rasterise(visible, self._atlas, samples)
            shade(visible, samples, self._atlas, self._sky, values, moment.shadows, moment.pools,
                  camera, view)  # fmt: skip

        return view, [partial(band, *ends) for ends in pairwise(edges.tolist())]


def sensor_image(
    radiance: NDArray[np.float32],
    camera: Camera,
    *,
    yaw_rate: float,
    night: float,
    key: tuple[int, int, int],
    pitch_rate: float = 0.0,
) -> NDArray[np.uint8]:
    """Simulate the lens and the sensor: blur, vignetting, response and noise.

    Args:
        radiance: ``(H, W)`` float32, from `RenderedView.image`.
        camera: calibration. The motion blur is proportional to its focal length.
        yaw_rate: yaw rate of the camera in rad/s, which causes motion blur.
        night: darkness from 0 to 1, which lengthens the exposure and raises the gain.
        key: seed, frame and side, which determine the noise.
        pitch_rate: pitch rate of the camera in rad/s, which causes motion blur.

    Returns:
        ``(H, W)`` uint8 image.
    """
    image = radiance
    exposed = SHUTTER * (1 + 2 * night)
    streak, fall = abs(yaw_rate) * exposed * camera.fx, pitch_rate * exposed * camera.fy
    if np.hypot(streak, fall) > 0.2:
        kernel = _streak(streak)[None, :]
        if fall:
            kernel = _slanted(streak, float(np.copysign(1.0, yaw_rate)) * fall)
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
    """Return the weights of a box filter. Its length in pixels need not be an integer."""
    half = int(np.ceil(length / 2 + 0.5))
    at = np.arange(-half, half + 1)
    weight = np.clip(length / 2 + 0.5 - np.abs(at), 0, 1)
    return np.asarray(weight / weight.sum(), np.float32)


def _slanted(run: float, rise: float) -> NDArray[np.float32]:
    """Return the weights of a box filter along a line of ``(run, rise)`` pixels."""
    half = int(np.ceil(np.hypot(run, rise) / 2 + 1.0))
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for at in np.linspace(-0.5, 0.5, 8 * half + 1):
        x, y = half + at * run, half + at * rise
        c, r = int(x), int(y)
        for dr, wr in ((0, 1 - (y - r)), (1, y - r)):
            for dc, wc in ((0, 1 - (x - c)), (1, x - c)):
                kernel[r + dr, c + dc] += wr * wc
    return np.asarray(kernel / kernel.sum(), np.float32)


def _vignette(camera: Camera) -> NDArray[np.float32]:
    u = (np.arange(camera.width) - camera.cx) / camera.fx
    v = (np.arange(camera.height) - camera.cy) / camera.fx
    square = (u[None, :] ** 2 + v[:, None] ** 2) / (u.max() ** 2 + v.max() ** 2)
    return np.asarray(1.0 - _VIGNETTE * square**1.5, np.float32)
