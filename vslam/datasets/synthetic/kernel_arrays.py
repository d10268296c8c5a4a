"""What the kernels of the renderer read and write: scene, light and camera as plain arrays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.synthetic.scene import Surfaces


class SurfaceArrays(NamedTuple):
    """Q surfaces as kernels see them; `scene.Surfaces` says what each field means.

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
    """Sun, sky and air as kernels see them, all f8; `render.Light` says what each field means.

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
    """A camera at a place, as kernels see it.

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
    """The samples of some rows of an image, h rows of w samples.

    ``first_row`` i8 first of these rows in the image, in pixels; ``samples`` i8 samples a pixel in
    each direction; ``inverse_depth`` (h, w) f4 1/z of the nearest surface, 0 without one; ``seen``
    (h, w) i4 its row in the result of `find_visible`, -1 without one.
    """

    first_row: int
    samples: int
    inverse_depth: NDArray[np.float32]
    seen: NDArray[np.int32]
