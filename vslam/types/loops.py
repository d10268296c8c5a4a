"""Data types that loop detection, verification and correction exchange and store."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.types.geometry import adjoint, inverse

Descriptors = Literal["orb", "learned"]  # the kinds of descriptors that are matched


@dataclass(frozen=True)
class LoopCandidate:
    """A pair of keyframes that, according to a detector, show the same place.

    Attributes:
        query: the keyframe for which the detector searched the map. It is -1 for a frame that is
            not in the map.
        match: the keyframe of the map that shows the same place. It has not been culled.
        score: similarity in the detector's own measure. Higher scores mean greater similarity.
        similarity: similarity of the two images according to learned local descriptors.
            Verification using these descriptors is tried only for similar images. None if the
            similarity was not computed.
        proposed_by: name of the detector that proposed the candidate. Several names are joined by
            ``+``.
    """

    query: int
    match: int
    score: float
    similarity: float | None = None
    proposed_by: str = ""


class Localisation(NamedTuple):
    """The pose of a frame that is not in the map, and the landmarks of the map that it observes.

    Attributes:
        keyframe: the keyframe that the frame resembles.
        T_cw: ``(4, 4)`` pose of the frame.
        feature, landmark: ``(N,)`` features of the frame, and ``(N,)`` landmarks that they observe.
    """

    keyframe: int
    T_cw: NDArray[np.float64]
    feature: NDArray[np.int64]
    landmark: NDArray[np.int32]


class LoopEvidence(NamedTuple):
    """What geometric verification found at the pose of a loop.

    Attributes:
        seen: fraction of the landmarks of the match keyframe that were found at their projections
            in the image of the query keyframe.
        seen_back: fraction of the landmarks of the query keyframe that were found at their
            projections in the image of the match keyframe.
        elsewhere: the same fraction as ``seen``, of the landmarks outside a vertical strip of the
            image that is a third of its width. The strip is placed where most were found.
        sigma_translation: standard deviation of the translation of the pose, as the motion in the
            image of a landmark at the median depth of those that were found, pixels. These are
            pixels of the image in which descriptors were matched.
        sigma_rotation: standard deviation of the rotation of the pose, in the same way.
    """

    seen: float
    seen_back: float
    elsewhere: float
    sigma_translation: float
    sigma_rotation: float


class LastSeen(NamedTuple):
    """Where and when a camera was last tracked.

    Attributes:
        keyframe: the keyframe that it was tracked against.
        elapsed_s: time since then, seconds.
    """

    keyframe: int
    elapsed_s: float


@dataclass(frozen=True)
class LoopEdge:
    """The outcome of a loop candidate. Rejected candidates are kept for the report.

    Attributes:
        query: the keyframe for which the detector searched the map.
        match: the keyframe of the map that, according to the detector, shows the same place.
        score: similarity in the detector's own measure.
        proposed_by: name of the detector that proposed the candidate.
        accepted: whether the loop was closed.
        reason: "closed", or the reason in a few words why the candidate was rejected.
        n_matches: number of landmarks around the keyframe ``match`` that were matched to features
            of the keyframe ``query``.
        n_inliers: number of matches that agree with ``T_query_match``.
        T_query_match: ``(4, 4)`` float64, maps points from the camera of the keyframe ``match`` to
            the camera of the keyframe ``query``, in the unit of the map around ``match``. None if
            the candidate was rejected before this pose was computed.
        features: ``(N,)`` int32, indices of the inlier features within the query keyframe.
        landmarks: ``(N,)`` int32, the landmark that each of these features observes.
        covariance: ``(6, 6)`` float64 covariance of the error ``xi = [v, w]`` of ``T_query_match``,
            in radians and in the unit of its translation. ``exp(xi) T_query_match`` is the true
            relative pose. None if it is unknown.
        scale: number of map units around the keyframe ``query`` per map unit around the keyframe
            ``match``. It is 1 in metric maps. In monocular maps, it differs from 1 by the scale
            drift.
        matched_by: the kind of descriptors that were matched, "orb" or "learned".
        evidence: what verification found. None if it did not get as far as a pose with enough
            inliers.
        against_odometry: whether the loop was closed although it contradicts the odometry.
        p_wrong: probability that the edge is wrong, from the evidence of its verification and, once
            another keyframe confirms it, of the other edge. It is 1 without evidence.
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
    covariance: NDArray[np.float64] | None = None
    scale: float = 1.0
    matched_by: Descriptors = "orb"
    proposed_by: str = ""
    evidence: LoopEvidence | None = None
    against_odometry: bool = False
    p_wrong: float = 1.0

    @classmethod
    def of(
        cls,
        candidate: LoopCandidate,
        reason: str = "",
        matched_by: Descriptors = "orb",
    ) -> LoopEdge:
        """Create the edge, without a relative pose, of a candidate that was not accepted.

        Args:
            reason: why the candidate was rejected. Empty if it has not been verified yet.
        """
        return cls(
            candidate.query,
            candidate.match,
            candidate.score,
            accepted=False,
            reason=reason,
            matched_by=matched_by,
            proposed_by=candidate.proposed_by,
        )


def scaled_loop(loop: LoopEdge, factor: float) -> LoopEdge:
    """Convert the relative pose of a loop to another unit of length.

    Args:
        factor: number of new units per old unit.
    """
    assert loop.T_query_match is not None
    T, units = loop.T_query_match.copy(), np.repeat([factor, 1.0], 3)
    T[:3, 3] *= factor
    covariance = None if loop.covariance is None else loop.covariance * np.outer(units, units)
    return replace(loop, T_query_match=T, covariance=covariance)


def reversed_loop(loop: LoopEdge) -> LoopEdge:
    """Exchange the query and the match of a loop, without its features and landmarks."""
    loop = scaled_loop(loop, loop.scale)  # to the unit around the query
    assert loop.T_query_match is not None
    T_match_query, covariance = inverse(loop.T_query_match), loop.covariance
    if covariance is not None:
        A = adjoint(T_match_query)
        covariance = A @ covariance @ A.T
    return replace(
        loop,
        query=loop.match,
        match=loop.query,
        T_query_match=T_match_query,
        covariance=covariance,
        scale=1.0 / loop.scale,
        features=None,
        landmarks=None,
    )


@dataclass(frozen=True)
class LoopCorrection:
    """How one closed loop corrected the map.

    Attributes:
        edge: the loop.
        keyframes: ``(N,)`` ids of the keyframes in the pose graph.
        T_cw_before, T_cw_after: ``(N, 4, 4)`` poses of these keyframes before and after the
            optimisation of the pose graph.
        seconds: wall time of the correction in seconds, without the global bundle adjustment.
    """

    edge: LoopEdge
    keyframes: NDArray[np.int64]
    T_cw_before: NDArray[np.float64]
    T_cw_after: NDArray[np.float64]
    seconds: float


def ranges(first: NDArray[np.int64], count: NDArray[np.int64]) -> NDArray[np.int64]:
    """Concatenate N ranges of integers.

    Range i begins at ``first[i]`` and contains ``count[i]`` integers.
    """
    before = np.cumsum(count) - count
    return np.arange(int(count.sum()), dtype=np.int64) + np.repeat(first - before, count)


@dataclass(frozen=True)
class PerKeyframe:
    """An array of any length for each of K keyframes, such as visual words or an encoded image.

    Attributes:
        first: ``(K + 1,)`` int64 offsets into ``values``.
        values: ``(N, ...)`` values of all keyframes. Keyframe k has ``values[first[k]:first[k +
            1]]``.
    """

    first: NDArray[np.int64]
    values: NDArray

    def __len__(self) -> int:
        return len(self.first) - 1

    def of(self, keyframe: int) -> NDArray:
        """Return the values of a keyframe."""
        return self.values[self.first[keyframe] : self.first[keyframe + 1]]

    def select(self, keyframes: NDArray[np.int64]) -> PerKeyframe:
        """Return the values of ``(M,)`` keyframes, which are renumbered from 0.

        A keyframe that has no entry in this table gets an empty array.
        """
        nothing = self.values[:0]
        parts = [self.of(k) if k < len(self) else nothing for k in keyframes.tolist()]
        first = np.cumsum([0, *map(len, parts)]).astype(np.int64)
        return PerKeyframe(first, np.concatenate([nothing, *parts]))

    def followed_by(self, other: PerKeyframe) -> PerKeyframe:
        """Append the values of the keyframes of another map."""
        first = np.concatenate([self.first, self.first[-1] + other.first[1:]])
        return PerKeyframe(first, np.concatenate([self.values, other.values]))


@dataclass(frozen=True)
class DetectorMemory:
    """The data that a loop detector has stored about keyframes, in a form that can be saved.

    Attributes:
        name: name of the detector.
        fingerprint: checksum of the vocabulary or weights that the detector used.
        tables: the data for each keyframe, under names that the detector chooses.
    """

    name: str = "none"
    fingerprint: str = ""
    tables: Mapping[str, PerKeyframe] = field(default_factory=dict)


@dataclass(frozen=True)
class ResembledPlace:
    """A place that recent keyframes resembled.

    Attributes:
        keyframes: the keyframe that a loop candidate matched, and its covisible keyframes.
        length: number of consecutive keyframes that resembled the place.
        age: number of keyframes since the last of these keyframes.
    """

    keyframes: frozenset[int]
    length: int
    age: int = 0
