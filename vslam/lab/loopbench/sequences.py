"""Scores of queries that follow each other: a place is a stretch of the way, not an image.

After SeqSLAM (Milford and Wyeth, ICRA 2012): the scores of a query and of those before it are
added along lines through the gallery, one for each speed. Length and speeds are those of
OpenSeqSLAM (Sünderhauf et al., ICRA 2013 workshop), not chosen here.
"""

from __future__ import annotations

import numpy as np

from vslam.geometry import Matrix

LENGTH = 10  # queries
SPEEDS = (0.8, 0.9, 1.0, 1.1, 1.2)  # images of the gallery for each query
_LEAST_P = 1e-6  # probabilities nearer to 0 or 1 say no more than this


def sequence_scores(scores: Matrix) -> Matrix:
    """The mean score of each image and the way that led to it.

    Args:
        scores: ``(Q, G)`` of queries and images in the order of the way, greater is more alike.

    Returns:
        ``(Q, G)``. Where a line leaves the gallery, the mean score of the query stands for what is
        not there; the first queries have shorter lines.
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
    """Of probabilities: what adds up over independent looks."""
    p = np.clip(p, _LEAST_P, 1.0 - _LEAST_P)
    return np.asarray(np.log(p / (1.0 - p)))
