"""Computes shadows of the sun, and the light of street lamps."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import kernel
from vslam_lab.towns.scene import Atlas, Surfaces

_MAX_CELLS = 30e6
_FINEST = 0.08  # m
_POOL_CELL, _POOL_REACH = 0.5, 16.0  # m


class ShadowMap(NamedTuple):
    """The highest occluder on each sun ray.

    A sun ray belongs to the cell in which it reaches the height 0.

    Attributes:
        height_cm: ``(R, C)`` uint16 height of the highest occluder above the reference height in
            centimetres; 0 if there is no occluder. Rows run along z, columns along x.
        frame: ``(4,)`` float64: x and z of the corner of cell (0, 0), the cell size and the
            reference height, in metres.
    """

    height_cm: NDArray[np.uint16]
    frame: NDArray[np.float64]


class LampPools(NamedTuple):
    """The light of street lamps on the ground plane.

    It does not depend on the height, because the cone of a lamp is approximated by a cylinder.

    Attributes:
        light: ``(R, C)`` float32, which is 1 under a lamp. Rows run along z, columns along x.
        frame: ``(3,)`` float64: x and z of node (0, 0), and the distance between nodes, in metres.
    """

    light: NDArray[np.float32]
    frame: NDArray[np.float64]


NO_LAMPS = LampPools(np.zeros((1, 1), np.float32), np.array([0.0, 0.0, 1.0]))


def lamp_pools(lamps: NDArray[np.float64]) -> LampPools:
    """Return the light of street lamps at ``(L, 2)`` positions (x, z)."""
    if len(lamps) == 0:
        return NO_LAMPS
    low = np.floor(lamps.min(axis=0) - _POOL_REACH)
    columns, rows = np.ceil((lamps.max(axis=0) + _POOL_REACH - low) / _POOL_CELL).astype(int) + 1
    light = np.zeros((rows, columns), np.float32)
    reach = int(_POOL_REACH / _POOL_CELL)
    for xz in lamps:
        c, r = np.rint((xz - low) / _POOL_CELL).astype(int)
        window = slice(max(r - reach, 0), r + reach + 1), slice(max(c - reach, 0), c + reach + 1)
        y, x = np.mgrid[window]
        away = (x * _POOL_CELL + low[0] - xz[0]) ** 2 + (y * _POOL_CELL + low[1] - xz[1]) ** 2
        # A lamp 6 m above the ground: inverse square law and two cosines, 0 at the border.
        fall = (1.0 + away / 36.0) ** -2 - (1.0 + _POOL_REACH**2 / 36.0) ** -2
        light[window] += np.maximum(fall, 0.0).astype(np.float32)
    return LampPools(light, np.array([low[0], low[1], _POOL_CELL]))


def cast_shadows(surfaces: Surfaces, atlas: Atlas, sun: NDArray[np.float64]) -> ShadowMap:
    """Compute the shadows of all surfaces except the ground (``thing`` -1).

    Args:
        sun: ``(3,)`` unit vector towards the sun, in the world frame.
    """
    occluders = surfaces.select(surfaces.thing >= 0)
    if not len(occluders.origin):
        return ShadowMap(np.zeros((1, 1), np.uint16), np.array([0.0, 0.0, 1.0, 0.0]))
    corners = np.stack(
        [
            occluders.origin + a * occluders.edge_s + b * occluders.edge_t
            for a, b in ((0, 0), (1, 0), (0, 1), (1, 1))
        ]
    )
    slope = sun[[0, 2]] / max(-sun[1], 0.05)
    up = -corners[..., 1]
    shadow_xz = corners[..., [0, 2]] - up[..., None] * slope
    low, high = shadow_xz.min(axis=(0, 1)) - 1.0, shadow_xz.max(axis=(0, 1)) + 1.0
    cell = max(_FINEST, math.sqrt(float(np.prod(high - low)) / _MAX_CELLS))
    columns, rows = np.ceil((high - low) / cell).astype(int) + 1
    frame = np.array([low[0], low[1], cell, float(up.min()) - 1.0])
    shadows = ShadowMap(np.zeros((rows, columns), np.uint16), frame)
    _cast(occluders, atlas, slope, shadows)
    return shadows


@kernel
def _cast(surfaces, atlas, slope, shadows):
    """Raise the heights of a shadow map to the heights of the occluders.

    Args:
        surfaces: `scene.Surfaces` of the occluders.
        atlas: `scene.Atlas`.
        slope: ``(2,)`` float64 distance along x and z that a sun ray travels per metre of height.
        shadows: `ShadowMap`, updated.
    """
    origin, edge_s, edge_t = surfaces.origin, surfaces.edge_s, surfaces.edge_t
    uv, texture, triangle = surfaces.uv, surfaces.texture, surfaces.triangle
    alpha, alpha_offset, log_size = atlas.alpha, atlas.alpha_offset, atlas.log_size
    height_cm, frame = shadows.height_cm, shadows.frame
    rows, columns = height_cm.shape
    for q in range(len(origin)):
        up = -origin[q, 1]
        x = (origin[q, 0] - slope[0] * up - frame[0]) / frame[2]
        z = (origin[q, 2] - slope[1] * up - frame[1]) / frame[2]
        sx = (edge_s[q, 0] + slope[0] * edge_s[q, 1]) / frame[2]
        sz = (edge_s[q, 2] + slope[1] * edge_s[q, 1]) / frame[2]
        tx = (edge_t[q, 0] + slope[0] * edge_t[q, 1]) / frame[2]
        tz = (edge_t[q, 2] + slope[1] * edge_t[q, 1]) / frame[2]
        det = sx * tz - sz * tx
        if abs(det) < 1e-6:
            continue
        number = texture[q]
        cut_out = alpha_offset[number, 0] >= 0
        log_w, log_h = log_size[number, 0], log_size[number, 1]
        first_row = max(int(z + min(0.0, sz) + min(0.0, tz)), 0)
        last_row = min(int(z + max(0.0, sz) + max(0.0, tz)) + 1, rows - 1)
        first = max(int(x + min(0.0, sx) + min(0.0, tx)), 0)
        last = min(int(x + max(0.0, sx) + max(0.0, tx)) + 1, columns - 1)
        for r in range(first_row, last_row + 1):
            for c in range(first, last + 1):
                dx, dz = c + 0.5 - x, r + 0.5 - z
                s = (dx * tz - dz * tx) / det
                t = (sx * dz - sz * dx) / det
                if s < 0.0 or t < 0.0 or s > 1.0 or t > 1.0 or (triangle[q] and s + t > 1.0):
                    continue
                if cut_out:
                    u = int((uv[q, 0] + uv[q, 1] * s + uv[q, 2] * t) * (1 << log_w))
                    v = int((uv[q, 3] + uv[q, 4] * s + uv[q, 5] * t) * (1 << log_h))
                    u &= (1 << log_w) - 1
                    v &= (1 << log_h) - 1
                    if alpha[alpha_offset[number, 0] + (v << log_w) + u] < 128:
                        continue
                height = up - s * edge_s[q, 1] - t * edge_t[q, 1] - frame[3]
                height_cm[r, c] = max(height_cm[r, c], np.uint16(max(height, 0.0) * 100.0))
