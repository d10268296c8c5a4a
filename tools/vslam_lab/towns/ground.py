"""Makes the ground of a town: a mesh over the terrain, with a texture for each tile."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vslam.support.kernels import kernel
from vslam.support.machine import available_cores
from vslam_lab.towns.scene import AtlasBuilder, Surfaces, join, patches
from vslam_lab.towns.terrain import Roads, Terrain
from vslam_lab.towns.textures import Rng, detail, noise

TILE = 12.8  # m
_FINE, _COARSE = 512, 64  # texels along the side of a tile with a road, and of one without a road
_REACH = 75.0  # m; the ground ends at this distance from the roads


@dataclass(frozen=True)
class RoadStyle:
    """Cross-section of a road. Distances are in metres from its middle line.

    Attributes:
        lane: distance to the edge of the carriageway.
        parking: distance to the outer edge of the parking bays.
        walk: distance to the outer edge of the pavement, where the grass begins.
        dash: length of a lane mark in metres; 0 for a road without marks.
        gap: length of the gap between two lane marks in metres.
        edge_line: whether there is a solid line at the edge of the carriageway.
        wear: amount of patches and cracks in the asphalt, 0 to 1.
    """

    lane: float
    parking: float
    walk: float
    dash: float
    gap: float
    edge_line: bool
    wear: float


class _RoadArrays(NamedTuple):
    """M samples of the middle lines of all roads, and the cross-section of the roads.

    ``xz`` is (M, 2) f8, ``heading`` and ``along`` are (M,) f8, and ``junction`` is (M,) bool, as in
    `terrain.Roads`. ``marks`` is (M, 10) f8, see `_road_marks`. ``lane``, ``parking``, ``walk`` and
    ``dash`` are f8, and ``edge_line`` is bool, as in `RoadStyle`. ``period`` is the distance from
    one lane mark to the next in metres, f8.
    """

    xz: NDArray[np.float64]
    heading: NDArray[np.float64]
    along: NDArray[np.float64]
    junction: NDArray[np.bool_]
    marks: NDArray[np.float64]
    lane: float
    parking: float
    walk: float
    dash: float
    period: float
    edge_line: bool


class _TileGrid(NamedTuple):
    """Position and resolution of a tile.

    ``x`` and ``z`` are the coordinates of its corner in metres, f8. ``texel`` is the size of a
    texel in metres, f8. ``nearest`` is (N, N) i8: for each node of a coarse mesh, the index of the
    nearest sample of the roads. ``mesh`` is the distance between nodes in metres, f8.
    """

    x: float
    z: float
    texel: float
    nearest: NDArray[np.int64]
    mesh: float


def make_ground(
    rng: Rng, atlas: AtlasBuilder, roads: Roads, terrain: Terrain, style: RoadStyle
) -> Surfaces:
    """Make the tiles of the ground near the roads. Tiles with a road have finer textures."""
    tree = cKDTree(roads.xz)
    low = np.floor((roads.xz.min(axis=0) - _REACH) / TILE).astype(int)
    high = np.ceil((roads.xz.max(axis=0) + _REACH) / TILE).astype(int)
    columns, rows = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    corner = np.stack([columns.ravel(), rows.ravel()], axis=1) * TILE
    far = tree.query(corner + TILE / 2)[0]
    grain = np.stack([noise(rng, 1024, 1024, cell, 5) for cell in (300.0, 40.0)])
    marks = _road_marks(rng, roads, style)
    asphalt = atlas.add(detail(rng, 0.20, 2.5))
    meadow = atlas.add(detail(rng, 0.38, 5.0))
    road = _RoadArrays(
        roads.xz,
        roads.heading,
        roads.along,
        roads.junction,
        marks,
        float(style.lane),
        float(style.parking),
        float(style.walk),
        float(style.dash),
        float(style.dash + style.gap),
        style.edge_line,
    )

    def paint(at_corner: NDArray[np.float64], distance: float) -> NDArray[np.float32]:
        x, z = at_corner
        # Half the diagonal of a tile is 0.71 of its side.
        side = _COARSE
        if distance < style.walk + 0.71 * TILE:
            side = _FINE if distance < style.lane + 0.6 * TILE else _FINE // 2
        nodes = np.arange(0.0, TILE + 0.4, 0.4)
        at = np.stack(np.meshgrid(x + nodes, z + nodes), axis=-1)
        nearest = tree.query(at.reshape(-1, 2))[1].reshape(len(nodes), len(nodes))
        image = np.empty((side, side), np.float32)
        _paint(image, _TileGrid(x, z, TILE / side, nearest, 0.4), road, grain)
        return image

    parts = []
    corner, far = corner[far < _REACH], far[far < _REACH]
    with ThreadPoolExecutor(available_cores()) as pool:
        for (x, z), distance, image in zip(corner, far, pool.map(paint, corner, far), strict=True):
            fine = asphalt if distance < style.parking + 2.7 else meadow
            parts.append(_tile(x, z, terrain, atlas.add(image), fine))
    return join(parts)


def _tile(x: float, z: float, terrain: Terrain, texture: int, fine: int) -> Surfaces:
    cells = 2
    step = TILE / cells
    origin, s, t, uv = [], [], [], []
    at = np.stack(np.meshgrid(x + step * np.arange(3), z + step * np.arange(3)), -1).reshape(-1, 2)
    up = terrain.height(at).reshape(cells + 1, cells + 1)
    point = np.concatenate([at, up.reshape(-1, 1)], axis=1)[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    point = point.reshape(cells + 1, cells + 1, 3)
    part = 1.0 / cells
    for r in range(cells):
        for c in range(cells):
            for sign in (1, -1):
                i, j = (r, c) if sign == 1 else (r + 1, c + 1)
                origin.append(point[i, j])
                s.append(point[i, j + sign] - point[i, j])
                t.append(point[i + sign, j] - point[i, j])
                uv.append([j * part, sign * part, 0.0, i * part, 0.0, sign * part])
    return patches(
        np.array(origin),
        np.array(s),
        np.array(t),
        texture,
        uv=np.array(uv),
        detail=fine,
        detail_size=1.7,
        triangle=True,
    )


def _road_marks(rng: Rng, roads: Roads, style: RoadStyle) -> NDArray[np.float64]:
    """Draw the marks on the road at each sample of its middle line.

    Returns:
        ``(M, 10)`` float64. The columns are the lateral positions of two cracks, whether a crack
        runs across the road, a patch (from, to, tone), a manhole (along, across), the tone of the
        asphalt, and the tone of the pavement. Values are NaN where there is no crack, patch or
        manhole.
    """
    n = len(roads.xz)
    marks = np.full((n, 10), np.nan)
    for k in range(2):
        drift = np.cumsum(rng.normal(0, 0.035, n))
        lateral = rng.uniform(-0.9, 0.9, n // 120 + 2)[np.arange(n) // 120] * style.lane
        cracked = rng.random(n // 60 + 2)[np.arange(n) // 60] < 0.8 * style.wear
        marks[:, k] = np.where(cracked, lateral + drift % 1.1 + rng.normal(0, 0.012, n), np.nan)
    marks[:, 2] = np.where(rng.random(n) < 0.012 * style.wear, 1.0, 0.0)
    at = 0
    while at < n:
        length, gap = int(rng.integers(4, 40)), int(rng.integers(8, 140))
        if rng.random() < style.wear:
            a = float(rng.uniform(-style.lane, style.lane - 0.8))
            b = a + float(rng.uniform(0.5, 3.2))
            marks[at : at + length, 3:6] = a, b, float(rng.choice([0.72, 0.84, 1.14, 1.22]))
        at += length + gap
    for at in np.flatnonzero(rng.random(n) < 0.008).tolist():
        across = float(rng.uniform(-0.8, 0.8)) * style.lane
        marks[max(at - 3, 0) : at + 4, 6:8] = roads.along[at], across
    knots = np.arange(0, n + 200, 200)
    tone = np.interp(np.arange(n), knots, rng.uniform(0.85, 1.15, len(knots)))
    marks[:, 8] = tone
    marks[:, 9] = rng.choice([0.85, 1.0, 1.2], n // 300 + 1)[np.arange(n) // 300]
    return marks


@kernel
def _hash(a, b):
    """Return a pseudo-random number in [0, 1) from a pair of integers."""
    h = (np.uint64(a) * np.uint64(0x9E3779B97F4A7C15)) ^ (
        np.uint64(b) * np.uint64(0xC2B2AE3D27D4EB4F)
    )
    h ^= h >> np.uint64(29)
    h *= np.uint64(0xBF58476D1CE4E5B9)
    h ^= h >> np.uint64(32)
    return float(h & np.uint64(0xFFFFFF)) / float(0x1000000)


@kernel
def _paint(image, tile, road, grain):
    """Compute the albedo of a tile.

    Args:
        image: ``(S, S)`` float32, output.
        tile: `_TileGrid`.
        road: `_RoadArrays`.
        grain: ``(2, 1024, 1024)`` float32 coarse and fine noise.
    """
    x0, z0, texel, nearest, mesh = tile.x, tile.z, tile.texel, tile.nearest, tile.mesh
    xz, heading, along = road.xz, road.heading, road.along
    junction, marks = road.junction, road.marks
    lane, parking, walk = road.lane, road.parking, road.walk
    dash, period, edge_line = road.dash, road.period, road.edge_line
    rows, columns = image.shape
    for r in range(rows):
        z = z0 + (r + 0.5) * texel
        for c in range(columns):
            x = x0 + (c + 0.5) * texel
            i = nearest[
                min(int((z - z0) / mesh + 0.5), len(nearest) - 1),
                min(int((x - x0) / mesh + 0.5), len(nearest) - 1),
            ]
            # The mesh is coarser than the samples. Search along the road for the nearest sample.
            fs, fc = math.sin(heading[i]), math.cos(heading[i])
            ahead = (x - xz[i, 0]) * fs + (z - xz[i, 1]) * fc
            j = min(max(i + round(ahead / 0.25), 0), len(xz) - 1)
            if abs(along[j] - along[i]) < 2.0:
                i = j
            fs, fc = math.sin(heading[i]), math.cos(heading[i])
            dx, dz = x - xz[i, 0], z - xz[i, 1]
            ahead = dx * fs + dz * fc
            lateral = dx * fc - dz * fs
            off = math.sqrt(dx * dx + dz * dz)
            side = -1.0 if lateral < 0.0 else 1.0
            s = along[i] + ahead
            wide = grain[0, int(z / 0.06) & 1023, int(x / 0.06) & 1023]
            fine = grain[1, int(z / texel) & 1023, (int(x / texel) + 331) & 1023]
            edge = off + 0.02 * fine
            if edge < lane:
                grey = 66.0 * marks[i, 8] * (1.0 + 0.05 * wide + 0.06 * fine)
                # The wheel tracks are darker.
                track = abs(abs(lateral) - 0.45 * lane) - 0.75
                grey *= 1.0 - 0.06 * math.exp(-8.0 * track * track)
                if marks[i, 3] < lateral < marks[i, 4]:
                    grey *= marks[i, 5]
                    if min(lateral - marks[i, 3], marks[i, 4] - lateral) < 0.04:
                        grey *= 0.6
                for k in range(2):
                    if abs(lateral - marks[i, k]) < 0.03 + 0.014 * fine:
                        grey *= 0.4
                if marks[i, 2] > 0.0 and abs(ahead) < 0.03 + 0.02 * fine:
                    grey *= 0.55
                if marks[i, 6] > 0.0:
                    a, b = s - marks[i, 6], lateral - marks[i, 7]
                    ring = math.sqrt(a * a + b * b)
                    if ring < 0.36:
                        grey = 46.0 if ring > 0.29 or int(a * 14 + 99) % 2 == 0 else 78.0
                if not junction[i]:
                    if dash > 0.0 and abs(lateral) < 0.07 and s % period < dash:
                        grey = 175.0 + 22.0 * fine
                    if edge_line and abs(off - lane + 0.35) < 0.08:
                        grey = 180.0 + 20.0 * fine
            elif edge < parking:
                slab = math.floor(s / 0.22) * 4096 + math.floor(lateral / 0.22)
                tone = _hash(slab, 17)
                grey = (84.0 + 26.0 * tone) * (1.0 + 0.06 * wide + 0.06 * fine)
                if (s / 0.22) % 1.0 < 0.12 or (abs(lateral) / 0.22) % 1.0 < 0.12:
                    grey *= 0.72
                if edge < lane + 0.12:
                    grey = 118.0 + 9.0 * fine
            elif edge < parking + 0.16:
                grey = (150.0 + 9.0 * fine) * (0.7 if (s % 1.0) < 0.03 else 1.0)
                grey *= 0.55 if edge < parking + 0.035 else 1.0
            elif edge < walk:
                size = 0.5
                row, column = math.floor(s / size), math.floor((off - parking) / size)
                tone = _hash(row, column + (1000 if side > 0.0 else 0))
                grey = (108.0 + 24.0 * tone) * marks[i, 9] * (1.0 + 0.07 * wide + 0.05 * fine)
                if (s / size) % 1.0 < 0.05 or ((off - parking) / size) % 1.0 < 0.05:
                    grey *= 0.66
            else:
                # Gardens, driveways and paths alternate behind the pavement.
                lot = math.floor(s / 5.0)
                kind = _hash(lot, 7 if side > 0.0 else 8)
                grey = 58.0 * (1.0 + 0.25 * wide + 0.3 * fine)
                if kind < 0.22:
                    grey = 105.0 * (1.0 + 0.1 * wide + 0.12 * fine)
                elif kind > 0.8:
                    grey = 48.0 * (1.0 + 0.35 * wide + 0.3 * fine)
                if edge < walk + 0.12:
                    grey = 120.0 + 12.0 * fine
            image[r, c] = min(max(grey, 6.0), 245.0)
