"""Tests the temporal consistency of loops.

A loop is accepted if it is sufficiently improbable that it is wrong. If its own evidence is not
overwhelming, a loop of another keyframe must agree with it.

ORB-SLAM (T-RO 2015, section VII-A) requires that the candidates of consecutive keyframes belong to
overlapping places. This evidence comes from appearance only. Geometry gives stronger evidence. Each
verified loop implies how much the map has drifted, and the loops of neighbouring keyframes must
imply the same drift. ORB-SLAM3 (T-RO 2021, section VI) also verifies a loop first and then confirms
it with other keyframes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vslam.loopclosure.verification import verify_near
from vslam.types.context import Context
from vslam.types.geometry import inverse, se3_log, transform
from vslam.types.loops import LoopCandidate, LoopEdge, ResembledPlace
from vslam.types.map import Map
from vslam.types.states import ConsistencyState

# Each verified loop implies a pose of the query. Two loops agree if these positions are at most
# this far apart, in metres. [own]
_MAX_APART = 0.5
# Two loops agree only if the orientations of the query that they imply differ by at most this
# value, in degrees. [own]
_MAX_TURN = 1.0
# Keyframes that share at least this many landmarks with a candidate belong to the same place.
# [own]
MIN_SHARED = 30


class LoopConsistency:
    """Tests the temporal consistency of loops.

    Call ``update`` once for every keyframe, even if the keyframe has no candidates. Call
    ``confirm`` for every loop edge that was verified. Call ``reset`` after a loop has been closed.

    Attributes:
        state: what recent keyframes showed.
    """

    def __init__(
        self, context: Context, verified_memory: int, state: ConsistencyState | None = None
    ) -> None:
        """
        Args:
            verified_memory: number of further keyframes during which a verified loop is kept while
                it waits for other loops that agree with it.
        """
        self.state = state or ConsistencyState()
        self._context = context
        self._config = context.config.consistency
        self._verified_memory = verified_memory

    def update(self, candidates: list[LoopCandidate], map_: Map) -> dict[int, str]:
        """Check whether enough consecutive keyframes resembled the place of each candidate.

        The place of a candidate consists of its match and the keyframes that are covisible with the
        match. Two places are considered the same if they share a keyframe.

        Returns:
            The reason to doubt each candidate that does not pass, by its ``match``.
        """
        needed, before = self._config.min_keyframes, self.state.places
        series: dict[frozenset[int], ResembledPlace] = {}
        doubts: dict[int, str] = {}
        continued: set[int] = set()
        for candidate in candidates:
            around = map_.covisible(candidate.match, MIN_SHARED)[0].tolist()
            place = frozenset({candidate.match, *around})
            overlapping = [i for i, one in enumerate(before) if not place.isdisjoint(one.keyframes)]
            continued.update(overlapping)
            length = 1 + max((before[i].length for i in overlapping), default=0)
            series[place] = ResembledPlace(place, length)
            if length < needed:
                doubts[candidate.match] = (
                    f"proposed for only {length} of the {needed} consecutive keyframes needed"
                )
        waiting = [
            replace(one, age=one.age + 1)
            for i, one in enumerate(before)
            if i not in continued and one.age < self._config.max_gap
        ]
        self.state = ConsistencyState(
            (*series.values(), *waiting), self.state.verified, self.state.turn + 1
        )
        return doubts

    def confirm(self, edge: LoopEdge, map_: Map) -> LoopEdge:
        """Accept a verified loop edge only if it is sufficiently improbable that it is wrong.

        A recent loop of another keyframe confirms the edge if both imply the same drift. Then, the
        edge is wrong only if both are wrong, so their probabilities are multiplied. Neighbouring
        keyframes see similar things, so only one other loop counts.

        The drift that an edge implies is a motion of the world. This motion would move the query
        keyframe to where the edge places it. Odometry between neighbouring keyframes is accurate
        compared with the tolerances. True loops therefore imply the same drift, and false loops do
        not.

        Returns:
            The loop edge with the resulting probability. It is marked as not accepted if this
            probability is too large.
        """
        if not edge.accepted:
            return edge
        turn = self.state.turn
        verified = self._verified_since(turn - self._verified_memory)
        self.state = replace(self.state, verified=verified)
        p_other = self._p_agreeing(edge, map_)
        self.state = replace(self.state, verified=(*verified, (turn, edge)))
        return self._decided(edge, p_other, self._config.max_wrong)

    def _verified_since(self, turn: int) -> tuple[tuple[int, LoopEdge], ...]:
        return tuple(one for one in self.state.verified if one[0] >= turn)

    def decided_at_end(self, map_: Map) -> Iterator[LoopEdge]:
        """Decide at the end of a drive about the verified loops that wait for another loop that
        agrees with them. Yield those that are accepted, newest first.

        A loop is verified once more in the corrected map, using ORB descriptors. If this succeeds,
        an earlier keyframe may confirm it. Three conditions must be met. The keyframe is covisible
        with the query of the loop. The keyframe can be verified at the same place as the query.
        Both loops imply the same drift. ORB-SLAM3 (section VI) also tries covisible keyframes
        before it waits for later keyframes.

        If this does not suffice, for example because ORB descriptors do not match, the loop is
        decided on its own evidence. Since no further evidence will come, a larger probability that
        it is wrong is allowed.
        """
        nothing = np.empty(0, np.int32)
        verified = self._verified_since(self.state.turn + 1 - self._verified_memory)
        for _, waiting in reversed(verified):
            if not map_.arrays.keyframe_alive[[waiting.query, waiting.match]].all():
                continue
            p_other, limit = self._p_agreeing(waiting, map_), self._config.max_wrong_at_end
            edge = verify_near(map_, waiting, self._context)
            if edge.accepted:
                p_earlier = self._p_earlier(edge, map_)
                edge = self._decided(edge, min(p_other, p_earlier), limit)
            if not edge.accepted:  # the matches that it had may have been culled
                edge = replace(waiting, features=nothing, landmarks=nothing)
                edge = self._decided(edge, p_other, limit)
            if edge.accepted:
                yield edge

    def _decided(self, edge: LoopEdge, p_other: float, max_wrong: float) -> LoopEdge:
        """Accept a verified edge, or not, given the probability that the loop that confirms it is
        wrong."""
        p_wrong = edge.p_wrong * p_other
        edge = replace(edge, p_wrong=p_wrong)
        if p_wrong <= max_wrong:
            return edge
        reason = f"verified, but wrong with probability {p_wrong:.2g}"
        return replace(edge, accepted=False, reason=reason)

    def _p_agreeing(self, edge: LoopEdge, map_: Map) -> float:
        """Return the probability that the best recent loop of another keyframe that agrees with
        ``edge`` is wrong. It is 1 if no loop agrees."""
        agreeing = [
            other.p_wrong
            for _, other in self.state.verified
            if other.query != edge.query and self.agree(edge, other, map_)
        ]
        return min(agreeing, default=1.0)

    def _p_earlier(self, edge: LoopEdge, map_: Map) -> float:
        """Return the probability that the loop of an earlier keyframe that confirms ``edge`` is
        wrong. It is 1 if no keyframe confirms it."""
        assert edge.T_query_match is not None
        assert edge.landmarks is not None
        T_query_w = edge.T_query_match @ map_.keyframe_pose(edge.match)
        depth = float(np.median(transform(T_query_w, map_.arrays.xyz[edge.landmarks])[:, 2]))
        T_w_query = inverse(map_.keyframe_pose(edge.query))
        for keyframe in map_.covisible(edge.query)[0].tolist():
            T_keyframe_query = map_.keyframe_pose(keyframe) @ T_w_query
            T_keyframe_query[:3, 3] /= edge.scale  # to the unit around the match
            if np.linalg.norm(T_keyframe_query[:3, 3]) < self._config.min_moved * depth:
                continue
            expected = replace(
                edge, query=keyframe, T_query_match=T_keyframe_query @ edge.T_query_match
            )
            other = verify_near(map_, expected, self._context)
            if other.accepted and self.agree(edge, other, map_):
                return other.p_wrong
        return 1.0

    def agree(self, edge: LoopEdge, other: LoopEdge, map_: Map) -> bool:
        """Return whether two loop edges imply the same drift at the query of the first edge."""
        position = inverse(map_.keyframe_pose(edge.query))[:3, 3]
        a, b = implied_drift(edge, map_), implied_drift(other, map_)
        twist = se3_log(inverse(_rigid(a)) @ _rigid(b))
        difference = (a[:3, :3] - b[:3, :3]) @ position + a[:3, 3] - b[:3, 3]
        return bool(
            np.linalg.norm(difference) <= _MAX_APART
            and np.degrees(np.linalg.norm(twist[3:])) <= _MAX_TURN
        )

    def reset(self) -> None:
        """Discard everything that was stored about recent keyframes. This is necessary after a loop
        has been closed, because the map has moved."""
        self.state = ConsistencyState(turn=self.state.turn)


def implied_drift(edge: LoopEdge, map_: Map) -> NDArray[np.float64]:
    """Compute the ``(4, 4)`` motion of the world that moves the query keyframe to where a loop edge
    places it. The motion is a similarity if the edge has a scale.

    Raises:
        ValueError: the edge has no pose.
    """
    if edge.T_query_match is None:
        raise ValueError(f"the edge from {edge.query} to {edge.match} has no pose")
    S_wq = inverse(map_.keyframe_pose(edge.match)) @ inverse(edge.T_query_match)
    S_wq[:3, :3] /= edge.scale
    return S_wq @ map_.keyframe_pose(edge.query)


def _rigid(S: NDArray[np.float64]) -> NDArray[np.float64]:
    """Set the scale of a similarity to 1. A rigid motion keeps its exact values."""
    T, scale_cubed = S.copy(), np.linalg.det(S[:3, :3])
    if abs(scale_cubed - 1.0) > 1e-9:
        T[:3, :3] /= np.cbrt(scale_cubed)
    return T
