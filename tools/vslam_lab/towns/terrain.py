"""The roads and the terrain that a route and its town share, and the plan of the town."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Float = NDArray[np.float64]

CLEARANCE = 2.5  # m, radius around every camera position in which no object may stand
_CELL = 0.5  # m
_BORDER = 150.0  # m of plan around the roads


@dataclass(frozen=True)
class Terrain:
    """The height of the ground, on a square grid with bilinear interpolation.

    Attributes:
        corner: ``(2,)`` float64 x and z of node (0, 0), in metres.
        cell: distance between nodes in metres.
        up: ``(R, C)`` float64 height of the nodes above y = 0, in metres. Rows run along z, columns
            along x.
    """

    corner: Float
    cell: float
    up: Float

    def height(self, xz: Float) -> Float:
        """Return the ``(N,)`` heights in metres above y = 0 of the ground at ``(N, 2)`` positions.

        For a position outside of the grid, the height of the nearest point of the grid is returned.
        """
        at = (np.asarray(xz, np.float64) - self.corner) / self.cell
        limit = np.array(self.up.shape[::-1]) - 1.001
        at = np.clip(at, 0.0, limit)
        c, r = np.floor(at).astype(int).T
        fc, fr = (at - np.floor(at)).T
        upper = self.up[r, c] * (1 - fc) + self.up[r, c + 1] * fc
        lower = self.up[r + 1, c] * (1 - fc) + self.up[r + 1, c + 1] * fc
        return upper * (1 - fr) + lower * fr


@dataclass(frozen=True)
class Roads:
    """M samples of the middle lines of all roads, about 0.25 m apart.

    Attributes:
        xz: ``(M, 2)`` float64 positions in metres.
        heading: ``(M,)`` float64 headings in radians, 0 along +z and positive towards +x.
        along: ``(M,)`` float64 distances from the beginning of the route in metres.
        junction: ``(M,)`` bool, whether another road crosses or joins at the sample.
    """

    xz: Float
    heading: Float
    along: Float
    junction: NDArray[np.bool_]

    @cached_property
    def forward(self) -> Float:
        return np.stack([np.sin(self.heading), np.cos(self.heading)], axis=1)

    @cached_property
    def right(self) -> Float:
        return np.stack([np.cos(self.heading), -np.sin(self.heading)], axis=1)


def roads_of(lines: list[Float], *, same_road: float = 3.0) -> Roads:
    """Make the roads along polylines. Each stretch of road occurs only once in the result.

    Args:
        lines: ``(K, 2)`` middle lines of the roads in metres, in driving order.
        same_road: a parallel stretch that is at most this many metres away from an earlier stretch
            is left out.
    """
    kept: list[NDArray[np.float64]] = []
    offset = 0.0
    for line in lines:
        steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
        keep = np.r_[True, steps > 1e-6]
        along = np.cumsum(np.r_[0.0, steps])[keep]
        at = np.arange(0.0, along[-1], 0.25)
        xz = np.stack([np.interp(at, along, line[keep, k]) for k in (0, 1)], axis=1)
        smooth = np.gradient(xz, axis=0)
        window = np.ones(9) / 9
        padded = np.pad(smooth, ((4, 4), (0, 0)), mode="edge")
        smooth = np.stack([np.convolve(padded[:, k], window, "valid") for k in (0, 1)], axis=1)
        heading = np.arctan2(smooth[:, 0], smooth[:, 1])
        kept.append(np.column_stack([xz, heading, at + offset]))
        offset += along[-1] + 50.0
    table = np.concatenate(kept)
    near = cKDTree(table[:, :2])
    first = np.ones(len(table), bool)
    for i, others in enumerate(near.query_ball_point(table[:, :2], same_road)):
        earlier = [
            j
            for j in others
            if table[i, 3] - table[j, 3] > 25.0
            and first[j]
            and abs(np.sin(table[i, 2] - table[j, 2])) < 0.35
        ]
        first[i] = not earlier
    table = table[first]
    near = cKDTree(table[:, :2])
    junction = np.zeros(len(table), bool)
    for i, others in enumerate(near.query_ball_point(table[:, :2], 9.0)):
        turn = np.abs(np.sin(table[others, 2] - table[i, 2]))
        away = np.abs(table[others, 3] - table[i, 3]) > 25.0
        junction[i] = bool((away & (turn > 0.3)).any())
    return Roads(table[:, :2], table[:, 2], table[:, 3], junction)


def rectangle(middle: Float, heading: float, width: float, depth: float) -> Float:
    """Return the ``(4, 2)`` corners (x, z) of a rectangle. Its width is across the heading."""
    ahead = np.array([np.sin(heading), np.cos(heading)])
    right = np.array([np.cos(heading), -np.sin(heading)])
    a, b = 0.5 * width * right, 0.5 * depth * ahead
    return np.array([middle - a - b, middle + a - b, middle + a + b, middle - a + b])


class Plan:
    """A raster map of the town: occupied ground, lines of sight and distances from roads."""

    def __init__(self, roads: Roads, cameras: Float) -> None:
        """Make a plan without objects. ``cameras`` are all ``(N, 2)`` camera positions (x, z)."""
        self._low = roads.xz.min(axis=0) - _BORDER
        columns, rows = np.ceil((roads.xz.max(axis=0) + _BORDER - self._low) / _CELL).astype(int)
        self._taken = np.zeros((rows, columns), np.uint8)
        self._tall = np.zeros((rows, columns), np.uint8)
        self._limit = np.array([columns - 1, rows - 1])
        self._road = self._distance(roads.xz)
        self._cameras = cKDTree(cameras)

    def _distance(self, xz: Float) -> NDArray[np.float32]:
        clear = np.ones(self._taken.shape, np.uint8)
        c, r = self._cell(xz).T
        clear[r, c] = 0
        return np.asarray(cv2.distanceTransform(clear, cv2.DIST_L2, 5) * _CELL, np.float32)

    def _cell(self, xz: Float) -> NDArray[np.int64]:
        cells = ((xz - self._low) / _CELL).astype(np.int64)
        return np.minimum(np.maximum(cells, 0, out=cells), self._limit, out=cells)

    def claim(self, corners: Float, *, road: float, tall: bool = False) -> bool:
        """Occupy the ground of a convex polygon if it is free.

        The ground counts as free if no other object stands there, and if it is at least ``road``
        metres from the middle of every road and `CLEARANCE` from every camera.

        Args:
            corners: ``(K, 2)`` corners of the polygon.
            road: smallest allowed distance from the middle of a road in metres.
            tall: whether the object blocks lines of sight.

        Returns:
            Whether the ground was free and is now occupied.
        """
        cells = self._cell(corners)
        low, high = cells.min(axis=0), cells.max(axis=0) + 1
        window = (slice(low[1], high[1]), slice(low[0], high[0]))
        mask = np.zeros(self._taken[window].shape, np.uint8)
        cv2.fillConvexPoly(mask, (cells - low).astype(np.int32), 1)
        inside = mask > 0
        if (
            (self._taken[window][inside] > 0).any()
            or (self._road[window][inside] < road).any()
            or self._is_near_camera(corners)
        ):
            return False
        self._taken[window][inside] = 1
        if tall:
            self._tall[window][inside] = 1
        return True

    def _is_near_camera(self, corners: Float) -> bool:
        middle = corners.mean(axis=0)
        reach = np.linalg.norm(corners - middle, axis=1).max() + CLEARANCE
        polygon = corners.astype(np.float32)[:, None]
        return any(
            cv2.pointPolygonTest(polygon, self._cameras.data[k].tolist(), True) > -CLEARANCE
            for k in self._cameras.query_ball_point(middle, reach)
        )

    def road_distance(self, xz: Float) -> NDArray[np.float32]:
        """Return the ``(N,)`` distances in metres from the middle of the nearest road."""
        c, r = self._cell(xz).T
        return self._road[r, c]

    def open_ray(self, start: Float, heading: float, reach: float) -> Float | None:
        """Return the ``(K, 2)`` positions along a line of sight, one metre apart.

        Returns None if a tall object blocks the line of sight.
        """
        distance = np.arange(2.0, reach, 1.0)[:, None]
        line = start + distance * np.array([np.sin(heading), np.cos(heading)])
        c, r = self._cell(line).T
        return None if self._tall[r, c].any() else line
