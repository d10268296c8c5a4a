"""Scores of sequences of queries, which recognise a stretch of the way instead of one image.

As in SeqSLAM (Milford and Wyeth, ICRA 2012), the scores of a query and its predecessors are added
along lines through the gallery, one for each speed. Length and speeds are those of OpenSeqSLAM
(Sünderhauf et al., ICRA 2013 workshop).
"""

from __future__ import annotations

import numpy as np

from vslam.geometry import Matrix

LENGTH = 10  # queries
SPEEDS = (0.8, 0.9, 1.0, 1.1, 1.2)  # images of the gallery for each query
_LEAST_P = 1e-6  # probabilities nearer to 0 or 1 are clipped


def sequence_scores(scores: Matrix) -> Matrix:
    """The mean score along the best line that ends at each query and image.

    Args:
        scores: ``(Q, G)`` of queries and images in driving order; higher is more similar.

    Returns:
        ``(Q, G)``. Outside the gallery, a line takes the mean score of the query; the first queries
        have shorter lines.
    """
    n_queries, n_images = scores.shape
    usual = scores.mean(1)
    found = np.full(scores.shape, -np.inf)
    for speed in SPEEDS:
        along = np.zeros(scores.shape)
        for back in range(min(LENGTH, n_queries)):
            shift = min(round(speed * back), n_images)
            along[back:, shift:] += scores[: n_queries - back, : n_images - shift]
            along[back:, :shift] += usual[: n_queries - back, None]
        np.maximum(found, along, out=found)
    return np.asarray(found / np.minimum(np.arange(n_queries) + 1, LENGTH)[:, None])


def log_odds(p: Matrix) -> Matrix:
    """Log odds of probabilities, which can be added over independent observations."""
    p = np.clip(p, _LEAST_P, 1.0 - _LEAST_P)
    return np.asarray(np.log(p / (1.0 - p)))
