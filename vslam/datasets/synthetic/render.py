"""The renderer: exact perspective of flat textured surfaces, in Numba, without GPU.

A point of a surface is ``origin + s edge_s + t edge_t = z r`` with the ray ``r = K^-1 (u, v, 1)``,
so ``(s, t, 1) / z = [edge_s edge_t origin]^-1 r``: three functions affine in the pixel. The inside
of a surface on an image row is therefore one interval, and depth and texture coordinates are exact
at every pixel; nothing is ever snapped to a vertex. Visibility is found on a grid twice as fine as
the pixels, and a pixel is shaded once for each surface that its four samples see.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
from vslam.datasets.synthetic.kernel_arrays import (
    LightValues,
    PosedCamera,
    SampleBand,
    SurfaceArrays,
)
from vslam.datasets.synthetic.rasterise import find_visible, rasterise
from vslam.datasets.synthetic.scene import Atlas, Surfaces
from vslam.datasets.synthetic.shade import shade
from vslam.datasets.synthetic.shadows import NO_LAMPS, LampPools, ShadowMap

SAMPLES = 2  # visibility samples a pixel, in each direction
_BANDS = 2  # bands of rows of an image, the unit of work of a thread

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Light:
    """Sun, sky and air of a moment.

    Attributes:
        sun: ``(3,)`` unit vector towards the sun, world.
        direct: irradiance of the sun on a surface that faces it; 1 is a clear noon.
        ambient: irradiance from the sky on a horizontal surface.
        glow: brightness of lamps and lit windows.
        haze: grey of the air, 0 to 255.
        visibility: metres at which a contrast falls to 1/e.
        exposure: factor from radiance to grey levels.
        headlight: brightness of the car's own lamps 10 m ahead.
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
        """The form that the kernels take."""
        sky = (self.direct, self.ambient, self.glow)
        air = (self.haze, self.visibility, self.exposure)
        return LightValues(*(float(x) for x in (*self.sun, *sky, *air, self.headlight)))


class RenderedView(NamedTuple):
    """What a camera sees: ``image`` ``(H, W)`` float32 grey before the sensor (0 to 255 and above)
    and ``depth`` ``(H, W)`` float32 metres along z, 0 where there is sky."""

    image: Float32
    depth: Float32


class Renderer:
    """Draws stereo pairs. The bytes do not depend on the number of threads."""

    def __init__(self, camera: Camera, atlas: Atlas, sky: int, threads: int = 1) -> None:
        """``sky``: number of the panorama texture; see `textures.sky`."""
        self._camera = camera
        self._atlas = atlas
        self._sky = sky
        self._pool = ThreadPoolExecutor(threads)

    def close(self) -> None:
        self._pool.shutdown()

    def stereo(
        self,
        surfaces: Surfaces,
        shadows: ShadowMap,
        light: Light,
        T_wc: NDArray[np.float64],
        pools: LampPools = NO_LAMPS,
    ) -> tuple[RenderedView, RenderedView]:
        """Left and right view of a rig whose left camera stands at ``T_wc`` ``(4, 4)``."""
        right = T_wc.copy()
        right[:3, 3] += T_wc[:3, 0] * self._camera.baseline
        left_view, right_view = self.views(surfaces, shadows, light, (T_wc, right), pools)
        return left_view, right_view

    def views(
        self,
        surfaces: Surfaces,
        shadows: ShadowMap,
        light: Light,
        T_wc: Iterable[NDArray[np.float64]],
        pools: LampPools = NO_LAMPS,
    ) -> list[RenderedView]:
        """A view from each of the poses ``(4, 4)``."""
        prepared = [
            self._pool.submit(self._prepare, surfaces, shadows, light, T, pools) for T in T_wc
        ]
        views, jobs = [], []
        for preparation in prepared:
            view, bands = preparation.result()
            views.append(view)
            jobs += [self._pool.submit(band) for band in bands]
        for job in jobs:
            job.result()
        return views

    def _prepare(
        self,
        surfaces: Surfaces,
        shadows: ShadowMap,
        light: Light,
        T_wc: NDArray[np.float64],
        pools: LampPools,
    ) -> tuple[RenderedView, list[Callable[[], None]]]:
        fx, fy, cx, cy = (
            float(x) for x in (self._camera.fx, self._camera.fy, self._camera.cx, self._camera.cy)
        )
        height, width = self._camera.height, self._camera.width
        camera = PosedCamera(np.ascontiguousarray(T_wc), fx, fy, cx, cy, height, width)
        values = light.values()
        visible = find_visible(SurfaceArrays.of(surfaces), self._atlas, camera, values)
        view = RenderedView(
            np.empty((height, width), np.float32), np.empty((height, width), np.float32)
        )
        edges = np.linspace(0, height, _BANDS + 1).astype(int)

        def band(first: int, end: int) -> None:
            shape = (SAMPLES * (end - first), SAMPLES * width)
            inverse_depth, seen = np.zeros(shape, np.float32), np.full(shape, -1, np.int32)
            samples = SampleBand(first, SAMPLES, inverse_depth, seen)
            rasterise(visible, self._atlas, samples)
            shade(visible, samples, self._atlas, self._sky, values, shadows, pools, camera, view)

        # Defaults bind the loop's values.
        return (
            view,
            [
                lambda a=a, b=b: band(a, b)  # type: ignore[misc]
                for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
            ],
        )
