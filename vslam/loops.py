"""What passes between loop detection, verification and correction, and what is kept of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

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
            may verify what ORB's do not; None where they were not asked.
        promising: whether its verifier wants to try it even if the consistency test refuses it.
        proposed_by: name of the detector that found it; several are joined by ``+``.
    """

    query: int
    match: int
    score: float
    alike: float | None = None
    proposed_by: str = ""
    promising: bool = False


class Sighting(NamedTuple):
    """Where a frame outside the map was recognised: near ``keyframe``, at the pose ``T_cw``
    ``(4, 4)``. Feature ``feature[i]`` of the frame observes landmark ``landmark[i]``; ``(N,)``
    each."""

    keyframe: int
    T_cw: NDArray[np.float64]
    feature: NDArray[np.int64]
    landmark: NDArray[np.int32]


@dataclass(frozen=True)
class LoopEdge:
    """What became of a candidate, accepted or not: rejected ones are kept for the report.

    Attributes:
        query, match, score, proposed_by: as in the candidate.
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
    proposed_by: str = ""

    @classmethod
    def of(
        cls,
        candidate: LoopCandidate,
        reason: str = "",
        matched_by: Literal["orb", "learned"] = "orb",
    ) -> LoopEdge:
        """The edge of a candidate that is not accepted yet, or for this reason."""
        return cls(
            candidate.query,
            candidate.match,
            candidate.score,
            accepted=False,
            reason=reason,
            matched_by=matched_by,
            proposed_by=candidate.proposed_by,
        )


def loop_entry(loop: LoopEdge) -> dict[str, Any]:
    """An edge for JSON, without its features and landmarks."""
    entry = {name: value for name, value in vars(loop).items() if name not in _LEFT_OUT}
    T = loop.T_query_match
    return entry | {"T_query_match": None if T is None else T.tolist()}


_LEFT_OUT = ("features", "landmarks")


def loop_of(entry: dict[str, Any]) -> LoopEdge:
    """The edge of an entry.

    Raises:
        KeyError, TypeError, ValueError: it is none.
    """
    T = entry["T_query_match"]
    T_query_match = None if T is None else np.array(T, np.float64).reshape(4, 4)
    return LoopEdge(**{**entry, "T_query_match": T_query_match})


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


def ranges(first: NDArray[np.int64], count: NDArray[np.int64]) -> NDArray[np.int64]:
    """The numbers ``first[i] ... first[i] + count[i] - 1`` of each of N ranges, in one row."""
    before = np.cumsum(count) - count
    return np.arange(int(count.sum()), dtype=np.int64) + np.repeat(first - before, count)


@dataclass(frozen=True)
class PerKeyframe:
    """Something of each of K keyframes, of any length each: words, a descriptor, an image file.

    Attributes:
        first: ``(K + 1,)`` int64, where that of each keyframe begins.
        values: ``(N, ...)``; those of keyframe k are ``values[first[k]:first[k + 1]]``.
    """

    first: NDArray[np.int64]
    values: NDArray

    def __len__(self) -> int:
        return len(self.first) - 1

    def of(self, keyframe: int) -> NDArray:
        """What a keyframe has."""
        return self.values[self.first[keyframe] : self.first[keyframe + 1]]

    def select(self, keyframes: NDArray[np.int64]) -> PerKeyframe:
        """Those of ``(M,)`` keyframes, numbered anew; of keyframes not known here, nothing."""
        nothing = self.values[:0]
        parts = [self.of(k) if k < len(self) else nothing for k in keyframes.tolist()]
        first = np.cumsum([0, *map(len, parts)]).astype(np.int64)
        return PerKeyframe(first, np.concatenate([nothing, *parts]))

    def followed_by(self, other: PerKeyframe) -> PerKeyframe:
        """Those of another map's keyframes appended."""
        first = np.concatenate([self.first, self.first[-1] + other.first[1:]])
        return PerKeyframe(first, np.concatenate([self.values, other.values]))


@dataclass(frozen=True)
class DetectorMemory:
    """What a loop detector knows of keyframes, for a file.

    Attributes:
        name: of the detector.
        fingerprint: of the vocabulary or weights that it was made with.
        tables: by the detector's own names.
    """

    name: str = "none"
    fingerprint: str = ""
    tables: Mapping[str, PerKeyframe] = field(default_factory=dict)


@dataclass(frozen=True)
class ResembledPlace:
    """A place that resembled recent keyframes: a candidate with its covisible keyframes.

    ``length`` keyframes in a row resembled it, ``age`` keyframes ago the last of them.
    """

    keyframes: frozenset[int]
    length: int
    age: int = 0
