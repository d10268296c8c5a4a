"""Data types for the kernels of the renderer.

The types describe flat textured surfaces, textures with mipmaps, the light and the camera.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

# How a surface reacts to light. An opaque surface has a lit and a dark side. Foliage lets light
# through. A screen (a lamp or a lit window) emits light.
OPAQUE, FOLIAGE, SCREEN = 0, 1, 2


class Surfaces(NamedTuple):
    """Q flat surfaces, each of which is a parallelogram or a triangle.

    The points of a parallelogram are ``origin + s edge_s + t edge_t`` with s and t in [0, 1]. The
    points of a triangle are those with ``s + t <= 1``.

    Attributes:
        origin, edge_s, edge_t: ``(Q, 3)`` float64 metres, in the world frame (x right, y down, z
            forward).
        uv: ``(Q, 6)`` float64 coefficients ``u0 us ut v0 vs vt`` of the texture coordinates
            ``u = u0 + us s + ut t`` and ``v = v0 + vs s + vt t``. The width and the height of the
            texture are 1.
        texture: ``(Q,)`` int32 number of the texture in the atlas. If the texture has alpha, only
            its opaque part is visible (a cut-out).
        detail: ``(Q,)`` int32 number of a fine texture that multiplies the texture; -1 for none.
        detail_size: ``(Q,)`` float64 size in metres of one repeat of the fine texture.
        gain: ``(Q,)`` float64 factor by which the albedo is multiplied.
        triangle: ``(Q,)`` bool, whether the surface is a triangle.
        layer: ``(Q,)`` uint8. If two surfaces lie in one plane, the surface with the higher layer
            is visible.
        material: ``(Q,)`` uint8: ``OPAQUE``, ``FOLIAGE`` or ``SCREEN``.
        thing: ``(Q,)`` int32 number of the object to which the surface belongs; -1 for the ground.
    """

    origin: Float
    edge_s: Float
    edge_t: Float
    uv: Float
    texture: NDArray[np.int32]
    detail: NDArray[np.int32]
    detail_size: Float
    gain: Float
    triangle: NDArray[np.bool_]
    layer: NDArray[np.uint8]
    material: NDArray[np.uint8]
    thing: NDArray[np.int32]

    def select(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Surfaces:
        """Return some of the surfaces. ``rows`` is a mask or an array of indices."""
        return Surfaces._make(np.ascontiguousarray(column[rows]) for column in self)

    def moved(self, R: Float, t: Float) -> Surfaces:
        """Rotate the surfaces by ``R``, ``(3, 3)``, and then translate them by ``t``, ``(3,)``."""
        return self._replace(
            origin=self.origin @ R.T + t, edge_s=self.edge_s @ R.T, edge_t=self.edge_t @ R.T
        )


def join(parts: list[Surfaces]) -> Surfaces:
    """Join one or more sets of surfaces in the given order."""
    if len(parts) == 1:
        return parts[0]
    return Surfaces(*map(np.concatenate, zip(*parts, strict=True)))


def patches(
    origin: Float,
    edge_s: Float,
    edge_t: Float,
    texture: int,
    *,
    uv: tuple[float, ...] | Float = (0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
    detail: int = -1,
    detail_size: float = 1.0,
    gain: float = 1.0,
    triangle: bool = False,
    layer: int = 0,
    material: int = OPAQUE,
    thing: int = -1,
) -> Surfaces:
    """Make surfaces that differ only in their position and texture coordinates.

    The arguments have the same meaning as the attributes of `Surfaces`.
    """
    arrays = [np.asarray(x, np.float64) for x in (origin, edge_s, edge_t)]
    n = max(len(x) if x.ndim == 2 else 1 for x in arrays)
    o, s, t = (_rows(x, n) for x in arrays)
    return Surfaces(
        o,
        s,
        t,
        _rows(np.asarray(uv, np.float64), n),
        np.full(n, texture, np.int32),
        np.full(n, detail, np.int32),
        np.full(n, detail_size, np.float64),
        np.full(n, gain, np.float64),
        np.full(n, triangle, np.bool_),
        np.full(n, layer, np.uint8),
        np.full(n, material, np.uint8),
        np.full(n, thing, np.int32),
    )


def _rows(values: Float, n: int) -> Float:
    """Broadcast an array to a copy of shape ``(n, K)``, faster than NumPy does."""
    rows = np.empty((n, values.shape[-1]))
    rows[:] = values
    return rows


class Atlas(NamedTuple):
    """T textures with their mipmaps in flat arrays for kernels.

    Attributes:
        texels: uint8 grey levels of all mipmap levels of all textures.
        alpha: uint8 alpha of the textures that have alpha. Values of at least 128 are opaque.
        offset: ``(T, L)`` int64 start of each mipmap level in ``texels``.
        alpha_offset: ``(T, L)`` int64 start of each mipmap level in ``alpha``; -1 for an opaque
            texture.
        log_size: ``(T, 2)`` int64 binary logarithms of width and height of level 0.
    """

    texels: NDArray[np.uint8]
    alpha: NDArray[np.uint8]
    offset: NDArray[np.int64]
    alpha_offset: NDArray[np.int64]
    log_size: NDArray[np.int64]


class AtlasBuilder:
    """Collects textures and numbers them."""

    def __init__(self) -> None:
        self._grey: list[list[NDArray[np.uint8]]] = []
        self._alpha: list[list[NDArray[np.uint8]] | None] = []

    def add(self, grey: NDArray[np.floating], alpha: NDArray[np.floating] | None = None) -> int:
        """Add a texture, and return its number in the atlas.

        Args:
            grey: ``(H, W)`` albedo, 0 to 255. H and W are powers of two. Row 0 is at v = 0.
            alpha: ``(H, W)`` alpha, 0 to 255; None if the texture is opaque.
        """
        if any(n & (n - 1) for n in grey.shape):
            raise ValueError(f"texture of {grey.shape} texels: sides must be powers of two")
        self._grey.append(_pyramid(grey))
        self._alpha.append(None if alpha is None else _pyramid(alpha))
        return len(self._grey) - 1

    def build(self) -> Atlas:
        offset, texels = _flatten([*self._grey])
        alpha_offset, alpha = _flatten(self._alpha)
        log_size = [[int(n).bit_length() - 1 for n in p[0].shape[::-1]] for p in self._grey]
        return Atlas(texels, alpha, offset, alpha_offset, np.array(log_size, np.int64))


def _pyramid(image: NDArray[np.floating]) -> list[NDArray[np.uint8]]:
    level = np.asarray(image, np.float32)
    levels = [level]
    while max(level.shape) > 1:
        height, width = (max(1, n // 2) for n in level.shape)
        smaller = cv2.resize(level, (width, height), interpolation=cv2.INTER_AREA)
        level = np.asarray(smaller, np.float32)
        levels.append(level)
    return [np.clip(np.rint(x), 0, 255).astype(np.uint8) for x in levels]


def _flatten(
    pyramids: list[list[NDArray[np.uint8]] | None],
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    depth = max(len(p) for p in pyramids if p is not None) if any(pyramids) else 1
    offset = np.full((len(pyramids), depth), -1, np.int64)
    flat: list[NDArray[np.uint8]] = []
    end = 0
    for row, pyramid in zip(offset, pyramids, strict=True):
        for level, image in enumerate(pyramid or ()):
            row[level] = end
            flat.append(image.ravel())
            end += image.size
        if pyramid:
            row[len(pyramid) :] = row[len(pyramid) - 1]
    return offset, np.concatenate(flat) if flat else np.zeros(1, np.uint8)


class LightValues(NamedTuple):
    """The values of `render.Light` as f8, for kernels.

    ``sun_x``, ``sun_y`` and ``sun_z`` are the unit vector towards the sun, in the world frame.
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
    """A camera with its pose, for kernels.

    ``T_wc`` is (4, 4) f8. ``fx``, ``fy``, ``cx`` and ``cy`` are f8 in pixels. ``height`` and
    ``width`` are i8 in pixels.
    """

    T_wc: NDArray[np.float64]
    fx: float
    fy: float
    cx: float
    cy: float
    height: int
    width: int


class SampleBand(NamedTuple):
    """``(h, w)`` samples in a band of image rows.

    ``first_row`` is the first row of the band in pixels, i8. ``samples`` is the number of samples
    per pixel in each direction, i8. ``inverse_depth`` is 1/z of the nearest surface, (h, w) f4; it
    is 0 if there is no surface. ``seen`` is the index of the nearest surface in the result of
    `find_visible`, (h, w) i4; it is -1 if there is no surface.
    """

    first_row: int
    samples: int
    inverse_depth: NDArray[np.float32]
    seen: NDArray[np.int32]
