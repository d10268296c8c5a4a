"""Loop closing: from a keyframe that looks familiar to a corrected map (ORB-SLAM, section VII).

Everything here happens in the mapping job of a keyframe, which owns the map. Only the global
bundle adjustment after a loop works beside it, on a snapshot; it is merged a number of keyframes
later that depends on the size of the problem alone, so that a run has one result.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vslam.backend.bundle_adjustment import BundleSolution
from vslam.backend.fusion import fuse_loop
from vslam.backend.global_bundle_adjustment import adjust_globally
from vslam.backend.global_mapping import GlobalSnapshot, merge_solution, take_snapshot
from vslam.backend.local_mapping import adjust_locally, strong_neighbours
from vslam.backend.loop_correction import move_keyframes
from vslam.backend.pose_graph import (
    GAP,
    WEAK,
    GraphCheck,
    PoseGraph,
    check_pose_graph,
    essential_graph,
    optimise,
)
from vslam.backend.similarity_graph import (
    check_similarity_graph,
    loop_in_new_units,
    move_keyframes_similarly,
    optimise_similarities,
    rigid,
)
from vslam.camera import Camera
from vslam.config import Config
from vslam.features import Features
from vslam.geometry import Matrix, compose, inverse, inverses, orthonormalised
from vslam.loopclosure.consistency import LoopConsistency
from vslam.loopclosure.detector import LoopDetector
from vslam.loopclosure.learned_verification import (
    LearnedTrials,
    rated,
    shows_known,
    verify_learned,
)
from vslam.loopclosure.reach import beyond_reach
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.loopclosure.verification import verify, verify_near
from vslam.loops import ClosingMemory, LoopCandidate, LoopCorrection, LoopEdge
from vslam.map import Map


class LoopClosing:
    """Finds, verifies and closes loops.

    Attributes:
        detector: what finds candidates.
        images: of the keyframes, for verification by learned descriptors; None for ORB alone.
        edges: every candidate and what became of it, in order.
        corrections: the loops that were closed.
        closed: their edges in the units of today, after those that the map came with.
    """

    def __init__(
        self,
        detector: LoopDetector,
        camera: Camera,
        config: Config,
        *,
        threads: int,
        images: KeyframeImages | None = None,
    ) -> None:
        self.detector = detector
        self.images = images
        self.edges: list[LoopEdge] = []
        self.corrections: list[LoopCorrection] = []
        self._trials = LearnedTrials(config.learned)
        self.closed: list[LoopEdge] = []
        self._camera = camera
        self._config = config
        consistency = config.consistency
        if images is not None:
            memory = max(consistency.verified_memory, config.learned.verified_memory)
            consistency = consistency.model_copy(update={"verified_memory": memory})
        self._consistency = LoopConsistency(consistency)
        self._executor = ThreadPoolExecutor(1, "global-adjustment") if threads > 1 else None
        self._global: _PendingAdjustment | None = None
        self._followed = 0  # times that an old keyframe served instead of a new one

    def process(
        self, map_: Map, keyframe: int, features: Features, image: NDArray[np.uint8] | None
    ) -> None:
        """Look for loops at a keyframe whose local mapping is done; close the first real one."""
        if self._is_due(keyframe):
            self.finish(map_)
        if self.images is not None and shows_known(
            map_, keyframe, self.images, self._config.learned
        ):
            image = None
        self.detector.add(keyframe, image, features)
        if self.images is not None and image is not None:
            self.images.add(keyframe, image)
            self.images.keep(map_.arrays.keyframe_alive)
        self.consider(map_, keyframe, self.detector.query(keyframe, map_))

    def consider(self, map_: Map, keyframe: int, candidates: list[LoopCandidate]) -> None:
        """Verify what a keyframe looks like, best first; close the first real loop."""
        candidates = self._rated(map_, keyframe, candidates)
        consistent, rejected = self._consistency.update(keyframe, candidates, map_)
        chosen = self._trials.choose(keyframe, candidates)
        self.edges += [edge for edge in rejected if edge.match not in chosen]
        refused = {edge.match: edge for edge in rejected}
        verified = [one for one in candidates if one in consistent or one.match in chosen]
        for number, candidate in enumerate(verified):
            edge = refused.get(candidate.match)
            if edge is None and self._config.verification.descriptors == "learned":
                edge = LoopEdge.of(candidate, "not alike enough for learned descriptors")
            elif edge is None:
                edge = verify(map_, candidate, self._camera, self._config.verification)
            if not edge.accepted and candidate.match in chosen:
                edge = self._verify_learned(map_, candidate, edge)
            edge = self._consistency.confirm(edge, map_)
            if edge.accepted:
                edge = self._close(map_, edge)
            self.edges.append(edge)
            if edge.accepted:
                self._consistency.reset()
                self.edges += [_superseded(other) for other in verified[number + 1 :]]
                break

    def memory(self) -> ClosingMemory:
        """What is remembered of recent keyframes, for a file."""
        return replace(
            self._consistency.memory(),
            resting_until=self._trials.resting_until,
            in_vain=self._trials.in_vain,
            followed=self._followed,
        )

    def restore(self, memory: ClosingMemory) -> None:
        """Remember what ``memory`` gave."""
        self._consistency.restore(memory)
        self._trials.resting_until, self._trials.in_vain = memory.resting_until, memory.in_vain
        self._followed = memory.followed

    @property
    def is_adjusting(self) -> bool:
        """Whether a global bundle adjustment is yet to be merged."""
        return self._global is not None

    def follow(self, keyframe: int) -> bool:
        """Note that an old keyframe serves where the newest one's, ``keyframe``, successor would
        be; returns whether ``finish`` is due."""
        self._followed += 1
        return self._is_due(keyframe)

    def _is_due(self, keyframe: int) -> bool:
        return self._global is not None and keyframe + self._followed >= self._global.due

    def _rated(
        self, map_: Map, keyframe: int, candidates: list[LoopCandidate]
    ) -> list[LoopCandidate]:
        """Candidates with their likeness, of those where the camera may be."""
        images, config = self.images, self._config
        if images is None or keyframe not in images or not candidates:
            return candidates
        beyond = beyond_reach(map_, keyframe, config.siamese)
        return rated(candidates, lambda: images.glance(keyframe), images, config.learned, beyond)

    def _verify_learned(self, map_: Map, candidate: LoopCandidate, by_orb: LoopEdge) -> LoopEdge:
        """What learned descriptors say of a candidate that ORB's did not verify."""
        assert self.images is not None
        config = self._config
        edge = verify_learned(
            map_, candidate, self.images, self._camera, config.learned, config.verification
        )
        self._trials.record(candidate, located=edge.T_query_match is not None)
        if edge.T_query_match is not None:
            return edge
        return replace(by_orb, reason=f"{by_orb.reason}; {edge.reason}")

    def conclude(self, map_: Map) -> None:
        """At the end of a drive, close a loop that waits for another keyframe to agree if one from
        before does: looked at from there with the same drift, the place must pass the same tests
        (ORB-SLAM3, section VI, asks covisible keyframes first and later ones then)."""
        for waiting in self._consistency.waiting():
            if not map_.arrays.keyframe_alive[[waiting.query, waiting.match]].all():
                continue
            edge = verify_near(map_, waiting, self._camera, self._config.verification)
            if not edge.accepted or not self._agrees_before(map_, edge):
                continue
            edge = self._close(map_, edge)
            self.edges.append(edge)
            if edge.accepted:
                self._consistency.reset()
                return

    def _agrees_before(self, map_: Map, edge: LoopEdge) -> bool:
        """Whether a keyframe that shares landmarks with the query, and is not where the query is,
        is verified with the drift of the edge."""
        assert edge.T_query_match is not None
        config = self._config
        T_w_query = inverse(map_.keyframe_pose(edge.query))
        for keyframe in map_.covisible(edge.query)[0].tolist():
            T_keyframe_query = map_.keyframe_pose(keyframe) @ T_w_query
            if np.linalg.norm(T_keyframe_query[:3, 3]) < config.consistency.min_moved:
                continue
            T_keyframe_query[:3, 3] /= edge.scale
            expected = replace(
                edge, query=keyframe, T_query_match=T_keyframe_query @ edge.T_query_match
            )
            other = verify_near(map_, expected, self._camera, config.verification)
            if other.accepted and self._consistency.agree(edge, other, map_):
                return True
        return False

    def finish(self, map_: Map) -> None:
        """Merge the global bundle adjustment that is under way, if there is one."""
        if self._global is not None:
            merge_solution(map_, self._global.snapshot, self._global.solution())
            self._global = None

    def _close(self, map_: Map, edge: LoopEdge) -> LoopEdge:
        """Correct the map by a verified loop; if it contradicts the rest, leave the map alone."""
        start = time.perf_counter()
        config = self._config
        solved = self._solve(map_, edge, driven=True)
        if not solved.verdict.consistent and np.isin(solved.graph.kind, (GAP, WEAK)).any():
            solved = self._solve(map_, edge, driven=False)
        if not solved.verdict.consistent:
            return replace(edge, accepted=False, reason=solved.verdict.reason)
        if self._global is not None:  # it knows nothing of this loop
            self._global.cancel()
            self._global = None
        keyframes = solved.graph.keyframes
        before = map_.arrays.T_cw[keyframes]
        query_side = [edge.query, *strong_neighbours(map_, edge.query, config)]
        match_side = [edge.match, *strong_neighbours(map_, edge.match, config)]
        self.closed.append(edge)
        if self._camera.monocular:
            growth = move_keyframes_similarly(map_, keyframes, solved.S_wc)
            self.closed = [loop_in_new_units(closed, growth) for closed in self.closed]
        else:
            move_keyframes(map_, keyframes, solved.T_cw)
        fuse_loop(map_, edge, query_side, match_side, self._camera, config)
        adjust_locally(map_, edge.query, self._camera, config)
        edge = replace(edge, reason="closed")
        correction = LoopCorrection(
            edge, keyframes, before, solved.T_cw, time.perf_counter() - start
        )
        self.corrections.append(correction)
        self._global = self._start_global(map_, edge.query)
        return edge

    def _solve(self, map_: Map, edge: LoopEdge, *, driven: bool) -> _Solution:
        """The pose graph with a new loop, under one of two hypotheses: where tracking was lost the
        camera drove on about as predicted, or it was carried to where the loop puts it."""
        config, loops = self._config.pose_graph, [*self.closed, edge]
        graph = essential_graph(
            map_,
            loops,
            config,
            weak=map_.restarts,
            unpredicted=map_.unpredicted_restarts,
            driven=driven,
        )
        now = map_.arrays.T_cw[: map_.n_keyframes]
        if self._camera.monocular:
            start = inverses(now) if driven else self._similarly_aligned(map_, edge)
            start = start[graph.keyframes]
            S_wc = optimise_similarities(graph, start, config)
            verdict = check_similarity_graph(graph, start, S_wc, config)
            return _Solution(graph, inverses(rigid(S_wc)), S_wc, verdict)
        start = now if driven else self._aligned(map_, edge)
        graph = replace(graph, T_cw=start[graph.keyframes])
        T_cw = optimise(graph, config)
        return _Solution(graph, T_cw, inverses(T_cw), check_pose_graph(graph, T_cw, config))

    def _aligned(self, map_: Map, edge: LoopEdge) -> Matrix:
        """Poses ``T_cw`` to start from: a sub-map that the loop joins is moved to where the loop
        puts it as a whole, since its own place was only a prediction."""
        T_cw = map_.arrays.T_cw[: map_.n_keyframes].copy()
        moving, keyframes = self._moving(map_, edge)
        assert edge.T_query_match is not None
        if moving == edge.query:
            T_new = compose(edge.T_query_match, T_cw[edge.match])
        else:
            T_new = compose(inverse(edge.T_query_match), T_cw[edge.query])
        T_old_new = compose(inverse(T_cw[moving]), T_new)  # new world to old world
        for keyframe in keyframes:
            T_cw[keyframe] = orthonormalised(compose(T_cw[keyframe], T_old_new))
        return T_cw

    def _similarly_aligned(self, map_: Map, edge: LoopEdge) -> Matrix:
        """``_aligned`` of a monocular map: similarities ``S_wc``, since a sub-map that is moved to
        where the loop puts it takes on the other's unit."""
        T_cw = map_.arrays.T_cw[: map_.n_keyframes]
        S_wc = inverses(T_cw)
        moving, keyframes = self._moving(map_, edge)
        assert edge.T_query_match is not None
        S_query_match = edge.T_query_match.copy()
        S_query_match[:3] *= edge.scale
        if moving == edge.query:
            S_new = S_wc[edge.match] @ np.linalg.inv(S_query_match)
        else:
            S_new = S_wc[edge.query] @ S_query_match
        S_wc[keyframes] = S_new @ T_cw[moving] @ S_wc[keyframes]
        return S_wc

    def _moving(self, map_: Map, edge: LoopEdge) -> tuple[int, NDArray[np.int64]]:
        """The end of a loop between two sub-maps that moves, and all keyframes that move with it;
        none for a loop within one."""
        submap = self.joined_submaps(map_)
        if submap[edge.query] == submap[edge.match]:
            return edge.query, np.empty(0, np.int64)
        # The part that holds the first keyframe is the world; of two others the query's moves.
        moving = edge.match if submap[edge.query] == submap[0] else edge.query
        return moving, np.flatnonzero(submap == submap[moving])

    def joined_submaps(self, map_: Map) -> NDArray[np.int64]:
        """``(n_keyframes,)`` sub-map of each keyframe; those joined by loops count as one."""
        submap = map_.submaps()
        for edge in self.closed:
            one, other = submap[edge.query], submap[edge.match]
            submap[submap == max(one, other)] = min(one, other)
        return submap

    def _start_global(self, map_: Map, keyframe: int) -> _PendingAdjustment:
        config = self._config.loops
        snapshot = take_snapshot(map_, self._camera)
        wait = 1 + len(snapshot.problem.camera) // config.observations_per_keyframe
        stop = threading.Event()

        def work() -> BundleSolution:
            return adjust_globally(
                snapshot.problem,
                iterations=config.global_iterations,
                tolerance=1e-4,
                stop=stop.is_set,
            )

        solution = work if self._executor is None else self._executor.submit(work).result
        return _PendingAdjustment(snapshot, solution, keyframe + self._followed + wait, stop)


def _superseded(candidate: LoopCandidate) -> LoopEdge:
    return LoopEdge.of(candidate, "another loop was closed at this keyframe")


@dataclass(frozen=True)
class _Solution:
    """A pose graph, the poses found, with and without scale, and whether they make sense."""

    graph: PoseGraph
    T_cw: Matrix
    S_wc: Matrix
    verdict: GraphCheck


@dataclass(frozen=True)
class _PendingAdjustment:
    snapshot: GlobalSnapshot
    solution: Callable[[], BundleSolution]
    due: int
    stop: threading.Event

    def cancel(self) -> None:
        self.stop.set()
