"""One look-alike keyframe is no loop: candidates must persist, and verified loops must agree.

ORB-SLAM (T-RO 2015, VII-A) asks that the places which resemble consecutive keyframes overlap.
That is evidence by looks. Two verified loops of neighbouring keyframes give a stronger one: both
say by how much the map has drifted, and must say the same (ORB-SLAM3, T-RO 2021, section VI, has
the same idea: verify first, then ask other keyframes to confirm).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
from vslam.config import ConsistencyConfig, VerificationConfig
from vslam.geometry import inverse, se3_log
from vslam.loopclosure.verification import verify_near
from vslam.loops import LoopCandidate, LoopEdge, ResembledPlace
from vslam.map import Map
from vslam.states import ConsistencyState


class LoopConsistency:
    """Memory of what recent keyframes resembled, and of the loops verified for them.

    Call ``update`` once for every keyframe, with or without candidates, ``confirm`` for every
    verified edge, and ``reset`` once a loop was closed.
    """

    def __init__(self, config: ConsistencyConfig) -> None:
        self.config = config
        self._groups: list[ResembledPlace] = []
        self._verified: list[tuple[int, LoopEdge]] = []  # turn, edge
        self._turn = 0

    @property
    def n_groups(self) -> int:
        """Groups remembered: never more than the candidates of ``max_gap + 1`` keyframes."""
        return len(self._groups)

    def update(
        self, keyframe: int, candidates: list[LoopCandidate], map_: Map
    ) -> tuple[list[LoopCandidate], list[LoopEdge]]:
        """Candidates whose place resembled enough keyframes in a row, and edges for the others.

        Each candidate continues the longest group that it overlaps and leaves exactly one group:
        the number of groups is the number of candidates, however often they overlap. Candidates
        with one and the same group count once.
        """
        self._turn += 1
        groups: dict[frozenset[int], ResembledPlace] = {}
        consistent, rejected = [], []
        continued: set[int] = set()
        for candidate in candidates:
            around = map_.covisible(candidate.match, self.config.min_shared)[0].tolist()
            place = frozenset({candidate.match, *around})
            before = [i for i, g in enumerate(self._groups) if not place.isdisjoint(g.keyframes)]
            continued.update(before)
            length = 1 + max((self._groups[i].length for i in before), default=0)
            groups[place] = ResembledPlace(place, length)
            if length >= self.config.min_keyframes:
                consistent.append(candidate)
            else:
                reason = f"resembled {length} of {self.config.min_keyframes} keyframes in a row"
                rejected.append(LoopEdge.of(candidate, reason))
        waiting = [
            replace(g, age=g.age + 1)
            for i, g in enumerate(self._groups)
            if i not in continued and g.age < self.config.max_gap
        ]
        self._groups = [*groups.values(), *waiting]
        return consistent, rejected

    def confirm(self, edge: LoopEdge, map_: Map) -> LoopEdge:
        """A verified edge, once enough recent keyframes were verified with the same drift.

        The drift that an edge implies is the motion of the world that would bring the query to
        where the edge puts it. Odometry between neighbouring keyframes is exact compared with the
        tolerances, so that true loops imply one drift and chance ones do not.

        Returns:
            The edge as it was, or not accepted, waiting for others. The best edge that agrees
            counts once for each keyframe.
        """
        if not edge.accepted:
            return edge
        oldest = self._turn - self.config.verified_memory
        self._verified = [(turn, e) for turn, e in self._verified if turn >= oldest]
        agreeing = {
            other.query
            for _, other in self._verified
            if other.query != edge.query and self.agree(edge, other, map_)
        }
        votes = 1 + len(agreeing)  # that of the edge's own keyframe included
        self._verified.append((self._turn, edge))
        if votes >= self.config.min_verified:
            return edge
        reason = f"verified by {votes} of {self.config.min_verified} keyframes"
        return replace(edge, accepted=False, reason=reason)

    def confirmed_by_earlier(
        self, map_: Map, camera: Camera, config: VerificationConfig
    ) -> Iterator[LoopEdge]:
        """Verified loops that wait for a second keyframe, the newest first, of which an earlier
        keyframe confirms the drift: seen from there, the place passes the same tests.

        ORB-SLAM3 (section VI) asks covisible keyframes first, too, and later ones after them.
        """
        oldest = self._turn + 1 - self.config.verified_memory
        for waiting in [edge for turn, edge in reversed(self._verified) if turn >= oldest]:
            if not map_.arrays.keyframe_alive[[waiting.query, waiting.match]].all():
                continue
            edge = verify_near(map_, waiting, camera, config)
            if edge.accepted and self._is_confirmed(edge, map_, camera, config):
                yield edge

    def _is_confirmed(
        self, edge: LoopEdge, map_: Map, camera: Camera, config: VerificationConfig
    ) -> bool:
        """Whether a keyframe that shares landmarks with the query of an edge, and is some way off,
        is verified with the same drift."""
        assert edge.T_query_match is not None
        T_w_query = inverse(map_.keyframe_pose(edge.query))
        for keyframe in map_.covisible(edge.query)[0].tolist():
            T_keyframe_query = map_.keyframe_pose(keyframe) @ T_w_query
            if np.linalg.norm(T_keyframe_query[:3, 3]) < self.config.min_moved:
                continue
            T_keyframe_query[:3, 3] /= edge.scale
            expected = replace(
                edge, query=keyframe, T_query_match=T_keyframe_query @ edge.T_query_match
            )
            other = verify_near(map_, expected, camera, config)
            if other.accepted and self.agree(edge, other, map_):
                return True
        return False

    def agree(self, edge: LoopEdge, other: LoopEdge, map_: Map) -> bool:
        """Whether two edges imply the same drift at the query of the first."""
        where = inverse(map_.keyframe_pose(edge.query))[:3, 3]
        a, b = implied_drift(edge, map_), implied_drift(other, map_)
        twist = se3_log(inverse(_rigid(a)) @ _rigid(b))
        apart = (a[:3, :3] - b[:3, :3]) @ where + a[:3, 3] - b[:3, 3]
        return bool(
            np.linalg.norm(apart) <= self.config.max_apart
            and np.degrees(np.linalg.norm(twist[3:])) <= self.config.max_turn
        )

    def state(self) -> ConsistencyState:
        """What ``restore`` needs to continue from here."""
        return ConsistencyState(tuple(self._groups), tuple(self._verified), self._turn)

    def restore(self, state: ConsistencyState) -> None:
        """Continue from what ``state`` returned."""
        self._groups, self._verified = list(state.places), list(state.verified)
        self._turn = state.turn

    def reset(self) -> None:
        """Forget everything: closing a loop has moved the map."""
        self._groups.clear()
        self._verified.clear()


def implied_drift(edge: LoopEdge, map_: Map) -> NDArray[np.float64]:
    """``(4, 4)`` motion of the world that takes the query to where an edge puts it: a similarity,
    its scale in the upper left 3x3 block, where the edge has a scale.

    Raises:
        ValueError: the edge has no pose.
    """
    if edge.T_query_match is None:
        raise ValueError(f"the edge from {edge.query} to {edge.match} has no pose")
    S_wq = inverse(map_.keyframe_pose(edge.match)) @ inverse(edge.T_query_match)
    S_wq[:3, :3] /= edge.scale
    return S_wq @ map_.keyframe_pose(edge.query)


def _rigid(S: NDArray[np.float64]) -> NDArray[np.float64]:
    """A similarity without its scale; a motion as it is."""
    T, cube = S.copy(), np.linalg.det(S[:3, :3])
    if abs(cube - 1.0) > 1e-9:
        T[:3, :3] /= np.cbrt(cube)
    return T
