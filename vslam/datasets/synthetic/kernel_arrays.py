"""Scene, light and camera as plain arrays, in the form that the renderer's kernels take."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.synthetic.scene import Surfaces


class SurfaceArrays(NamedTuple):
    """Q surfaces in the form for kernels; `scene.Surfaces` documents the fields.

    ``origin``, ``edge_s``, ``edge_t`` (Q, 3) f8; ``uv`` (Q, 6) f8; ``texture``, ``detail`` (Q,) i4;
    ``detail_size``, ``gain`` (Q,) f8; ``triangle`` (Q,) bool; ``layer``, ``material`` (Q,) u1.
    """

    origin: NDArray[np.float64]
    edge_s: NDArray[np.float64]
    edge_t: NDArray[np.float64]
    uv: NDArray[np.float64]
    texture: NDArray[np.int32]
    detail: NDArray[np.int32]
    detail_size: NDArray[np.float64]
    gain: NDArray[np.float64]
    triangle: NDArray[np.bool_]
    layer: NDArray[np.uint8]
    material: NDArray[np.uint8]

    @classmethod
    def of(cls, surfaces: Surfaces) -> SurfaceArrays:
        return cls(*(getattr(surfaces, name) for name in cls._fields))


class LightValues(NamedTuple):
    """Sun, sky and air in the form for kernels, all f8; `render.Light` documents the fields.

    ``sun_x``, ``sun_y``, ``sun_z``: unit vector towards the sun, world.
    """

    sun_x: float
    sun_y: float
    sun_z: float
    direct: float
    ambient: float
    glow: float
    haze: float
    visibility: float
    exposure: float
    headlight: float


class PosedCamera(NamedTuple):
    """A camera with its pose in the form for kernels.

    ``T_wc`` (4, 4) f8; ``fx``, ``fy``, ``cx``, ``cy`` f8 pixels; ``height``, ``width`` i8 pixels.
    """

    T_wc: NDArray[np.float64]
    fx: float
    fy: float
    cx: float
    cy: float
    height: int
    width: int


class SampleBand(NamedTuple):
    """The samples of a band of image rows, h rows of w samples.

    ``first_row`` i8 first row of the band, in pixels; ``samples`` i8 samples per pixel in each
    direction; ``inverse_depth`` (h, w) f4 1/z of the nearest surface, 0 if there is none; ``seen``
    (h, w) i4 the surface's row in the result of `find_visible`, -1 if there is none.
    """

    first_row: int
    samples: int
    inverse_depth: NDArray[np.float32]
    seen: NDArray[np.int32]
