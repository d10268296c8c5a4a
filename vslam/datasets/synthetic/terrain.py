"""Roads and heights of the ground, which a route and its town share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Terrain:
    """Heights on a square grid with bilinear interpolation.

    Attributes:
        corner: ``(2,)`` float64 x and z of node (0, 0), metres.
        cell: metres between nodes.
        up: ``(R, C)`` float64 height of the nodes, metres above y = 0; rows along z.
    """

    corner: Float
    cell: float
    up: Float

    def height(self, xz: Float) -> Float:
        """``(N,)`` metres above y = 0 at ``(N, 2)`` places; the grid's border extends outwards."""
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
        xz: ``(M, 2)`` float64 metres.
        heading: ``(M,)`` float64 radians, 0 along +z, positive towards +x.
        along: ``(M,)`` float64 metres since the beginning of the route.
        junction: ``(M,)`` bool, whether another road crosses or joins here.
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
    """The roads along polylines ``(K, 2)``, with each stretch of road only once.

    Args:
        lines: middle lines of the driven roads (m), in driving order.
        same_road: a later stretch counts as the same road as an earlier one if it is parallel and
            at most this far (m) from it.
    """
    from scipy.spatial import cKDTree

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
