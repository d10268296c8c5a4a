"""The plan of a town: occupied ground and open lines of sight."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vslam.datasets.synthetic.terrain import Roads

CLEARANCE = 2.5  # m around every camera position that are kept free
_CELL = 0.5  # m
_BORDER = 150.0  # m of plan around the roads

Float = NDArray[np.float64]


def rectangle(middle: Float, heading: float, width: float, depth: float) -> Float:
    """Corners ``(4, 2)`` (x, z) of a rectangle; ``width`` runs across the heading."""
    ahead = np.array([np.sin(heading), np.cos(heading)])
    right = np.array([np.cos(heading), -np.sin(heading)])
    a, b = 0.5 * width * right, 0.5 * depth * ahead
    return np.array([middle - a - b, middle + a - b, middle + a + b, middle - a + b])


class Plan:
    """A raster of the town with occupied ground, sight lines and distances from roads."""

    def __init__(self, roads: Roads, cameras: Float) -> None:
        """``cameras``: ``(N, 2)`` float64 x and z of all possible camera positions."""
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
        """Occupy the ground of a convex polygon ``(K, 2)`` if it is free, at least ``road`` metres
        from the middle of every road, and clear of every camera; returns whether it was occupied.
        ``tall`` objects block lines of sight."""
        cells = self._cell(corners)
        low, high = cells.min(axis=0), cells.max(axis=0) + 1
        window = (slice(low[1], high[1]), slice(low[0], high[0]))
        mask = np.zeros(self._taken[window].shape, np.uint8)
        cv2.fillConvexPoly(mask, (cells - low).astype(np.int32), 1)
        inside = mask > 0
        if (
            (self._taken[window][inside] > 0).any()
            or (self._road[window][inside] < road).any()
            or self._near_camera(corners)
        ):
            return False
        self._taken[window][inside] = 1
        if tall:
            self._tall[window][inside] = 1
        return True

    def _near_camera(self, corners: Float) -> bool:
        """Whether a camera position is nearer than `CLEARANCE` to a convex polygon."""
        middle = corners.mean(axis=0)
        reach = np.linalg.norm(corners - middle, axis=1).max() + CLEARANCE
        polygon = corners.astype(np.float32)[:, None]
        return any(
            cv2.pointPolygonTest(polygon, self._cameras.data[k].tolist(), True) > -CLEARANCE
            for k in self._cameras.query_ball_point(middle, reach)
        )

    def road_distance(self, xz: Float) -> NDArray[np.float32]:
        """``(N,)`` metres from ``(N, 2)`` places to the middle of the nearest road."""
        c, r = self._cell(xz).T
        return self._road[r, c]

    def open_ray(self, start: Float, heading: float, reach: float) -> Float | None:
        """Places ``(K, 2)``, one per metre, along a line of sight; None if something tall blocks
        it."""
        distance = np.arange(2.0, reach, 1.0)[:, None]
        line = start + distance * np.array([np.sin(heading), np.cos(heading)])
        c, r = self._cell(line).T
        return None if self._tall[r, c].any() else line
