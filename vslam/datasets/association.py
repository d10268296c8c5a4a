"""Association of images by their times."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def associate(
    first: NDArray[np.float64], second: NDArray[np.float64], max_difference: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pair times that are less than ``max_difference`` apart, the nearest first, each once.

    Args:
        first, second: ``(N,)`` and ``(M,)`` seconds, increasing.

    Returns:
        ``(P,)`` indices into each, those into ``first`` increasing.
    """
    low = np.searchsorted(second, first - max_difference, side="right")
    high = np.searchsorted(second, first + max_difference, side="left")
    near = [(i, j) for i in range(len(first)) for j in range(low[i], high[i])]
    near.sort(key=lambda pair: (abs(first[pair[0]] - second[pair[1]]), pair))
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for i, j in near:
        if i not in partner and j not in taken:
            partner[i] = j
            taken.add(j)
    pairs = np.array(sorted(partner.items()), np.int64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]
