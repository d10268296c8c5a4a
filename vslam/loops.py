"""What passes between loop detection, verification and correction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class LoopCandidate:
    """A keyframe that a detector takes for the place of another.

    Attributes:
        query: keyframe whose place is looked for; -1 for a frame that is not in the map.
        match: keyframe of the same place, alive in the map.
        score: the detector's own measure, greater is more alike.
        alike: how much of the two images local descriptors of a network find alike, so that they
            may verify what ORB's do not; None for the candidate of a detector without.
    """

    query: int
    match: int
    score: float
    alike: float | None = None


@dataclass(frozen=True)
class LoopEdge:
    """What became of a candidate, accepted or not: rejected ones are kept for the report.

    Attributes:
        query, match, score: as in the candidate.
        accepted: whether the loop was closed.
        reason: "closed", or in a few words what spoke against it.
        n_matches: landmarks of the place matched to features of the query.
        n_inliers: of these, how many agree with ``T_query_match``.
        T_query_match: ``(4, 4)`` float64, maps the match's camera to the query's, in the unit of
            the map around the match; None if the candidate fell before geometry was looked at.
        features: ``(N,)`` int32, inlier features of the query (index within the keyframe).
        landmarks: ``(N,)`` int32, the landmark of the place that each of them observes.
        scale: length around the query, in its unit, of what is 1 around the match: 1 in metric
            maps, whatever drift made of it in monocular ones.
        matched_by: "orb" or "learned", the descriptors that the geometry comes from.
    """

    query: int
    match: int
    score: float
    accepted: bool
    reason: str
    n_matches: int = 0
    n_inliers: int = 0
    T_query_match: NDArray[np.float64] | None = None
    features: NDArray[np.int32] | None = None
    landmarks: NDArray[np.int32] | None = None
    scale: float = 1.0
    matched_by: Literal["orb", "learned"] = "orb"


@dataclass(frozen=True)
class LoopCorrection:
    """What one closed loop did to the map.

    Attributes:
        edge: the loop.
        keyframes: ``(N,)`` living keyframes at the time.
        T_cw_before, T_cw_after: ``(N, 4, 4)`` their poses before and after the pose graph.
        seconds: wall time of the correction, global bundle adjustment not included.
    """

    edge: LoopEdge
    keyframes: NDArray[np.int64]
    T_cw_before: NDArray[np.float64]
    T_cw_after: NDArray[np.float64]
    seconds: float
