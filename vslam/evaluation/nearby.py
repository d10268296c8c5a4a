"""Which positions of a path lie near one another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_SWEPT_AT_ONCE = 256  # positions: each may have all others beside it

Indices = NDArray[np.int64]


def near_pairs(position: NDArray[np.float64], radius: float) -> tuple[Indices, Indices]:
    """Pairs ``i < j`` of ``(S, 3)`` positions within a radius.

    A sweep along the longest side of the path. A tree would be as fast, but its import takes longer
    than a whole drive.
    """
    side = position[:, np.argmax(np.ptp(position, axis=0))] if len(position) else np.empty(0)
    order = np.argsort(side, kind="stable")
    swept = side[order]
    end = np.searchsorted(swept, swept + radius, side="right")
    found = [np.empty((0, 2), np.int64)]
    for first in range(0, len(order), _SWEPT_AT_ONCE):
        here = np.arange(first, min(first + _SWEPT_AT_ONCE, len(order)))
        count = end[here] - here - 1
        one = np.repeat(here, count)
        other = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + one + 1
        pairs = np.column_stack([order[one], order[other]])
        offset = position[pairs[:, 0]] - position[pairs[:, 1]]
        found.append(pairs[np.einsum("ni,ni->n", offset, offset) <= radius**2])
    pairs = np.sort(np.concatenate(found), axis=1)
    return pairs[:, 0], pairs[:, 1]
