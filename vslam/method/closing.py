"""Loop closing: verifies loop candidates and corrects the map (ORB-SLAM, section VII).

No other thread may write the map while a method of ``LoopClosing`` runs. The search for a loop only
reads the map and runs in parallel with tracking (``Mapper``). The global bundle adjustment after a
loop also runs in parallel, on a snapshot of the map. Its result is applied after a certain number
of keyframes. This number depends only on the size of the problem, so the same input always gives
the same map.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vslam.backend.bundle_adjustment import BundleSolution
from vslam.backend.fusion import fuse_loop
from vslam.backend.global_bundle_adjustment import adjust_globally
from vslam.backend.global_mapping import GlobalSnapshot, apply_solution, take_snapshot
from vslam.backend.local_mapping import adjust_locally, strong_neighbours
from vslam.backend.loop_correction import move_keyframes
from vslam.backend.pose_graph import drift_of_camera
from vslam.backend.similarity_graph import (
    loop_in_new_units,
    move_keyframes_similarly,
    similarity,
)
from vslam.loopclosure.consistency import LoopConsistency
from vslam.loopclosure.detector import LoopDetector
from vslam.loopclosure.verifier import Verifier
from vslam.method.hypotheses import Hypothesis, Solution, solve
from vslam.support.plugins import reason
from vslam.types.context import Context
from vslam.types.features import Features
from vslam.types.geometry import inverse, inverses
from vslam.types.loops import LoopCandidate, LoopCorrection, LoopEdge
from vslam.types.map import Map
from vslam.types.map_kernels import cut_path
from vslam.types.states import ClosingState

# The result of global bundle adjustment is applied `1 + n // _OBSERVATIONS_PER_KEYFRAME` keyframes
# after its loop, where n is the number of observations. With a smaller value, mapping waits for the
# result less often. [own]
_OBSERVATIONS_PER_KEYFRAME = 25000

_log = logging.getLogger(__name__)


class LoopClosing:
    """Finds, verifies and closes loops.

    Attributes:
        detector: proposes loop candidates.
        verifier: decides which candidates are loops.
        edges: the outcome of every loop candidate so far, in order.
        corrections: how each loop that was closed in this run corrected the map.
        closed: all closed loops, in the current unit of the map. The loops of a loaded map come
            first.
        problems: one sentence for each step of loop closing that failed. Such a failure leaves the
            map unchanged.
    """

    def __init__(
        self,
        detector: LoopDetector,
        verifier: Verifier,
        context: Context,
        *,
        threads: int,
        state: ClosingState | None = None,
    ) -> None:
        self.detector = detector
        self.verifier = verifier
        self.edges: list[LoopEdge] = []
        self.corrections: list[LoopCorrection] = []
        self.closed: list[LoopEdge] = []
        self.problems: list[str] = []
        self._context = context
        self._camera = context.camera
        self._config = context.config
        self._pose_graph = drift_of_camera(context.config.pose_graph, context.camera.fx)
        state = state or ClosingState()
        memory = verifier.verified_memory
        self._consistency = LoopConsistency(context, memory, state.consistency)
        self._executor = ThreadPoolExecutor(1, "global-adjustment") if threads > 1 else None
        self._global: _PendingAdjustment | None = None
        self._followed, self._new_revisits = state.followed, state.new_revisits

    def process(
        self, map_: Map, keyframe: int, features: Features, image: NDArray[np.uint8] | None
    ) -> None:
        """Search for loops at a keyframe. If a loop is found, close it."""
        self.apply_adjustment_if_due(map_, keyframe)
        self.close(map_, self.search(map_, keyframe, features, image))

    def search(
        self, map_: Map, keyframe: int, features: Features, image: NDArray[np.uint8] | None
    ) -> LoopSearch:
        """Search for a loop at a keyframe whose local mapping is complete. The map is only read."""
        with self._failure_reported("Looking for loops"):
            if self.verifier.is_image_redundant(map_, keyframe):
                image = None  # no network needs this image
            self.detector.add(keyframe, image, features)
            self.verifier.add(map_, keyframe, image)
            return self._find(map_, keyframe, self.detector.query(keyframe, map_))
        return LoopSearch()

    def close(self, map_: Map, search: LoopSearch) -> None:
        """Record the outcome of a search. If the search found a loop, close this loop."""
        self.edges += search.edges
        if search.loop is not None:
            self._close(map_, search.loop)

    def consider(self, map_: Map, keyframe: int, candidates: list[LoopCandidate]) -> None:
        """Verify the loop candidates of a keyframe, best first, and close the first loop found."""
        self.close(map_, self._find(map_, keyframe, candidates))

    def _find(self, map_: Map, keyframe: int, candidates: list[LoopCandidate]) -> LoopSearch:
        """Verify loop candidates, best first, until a candidate passes. The map is only read."""
        doubts = self._consistency.update(candidates, map_)
        trials, edges = self.verifier.order(map_, keyframe, candidates, doubts)
        for number, trial in enumerate(trials):
            edge = self._consistency.confirm(self.verifier.verify(map_, trial), map_)
            loop = None
            if edge.accepted:
                edge, loop = self._solve(map_, edge)
            edges.append(edge)
            if loop is not None:
                edges += [_superseded(other.candidate) for other in trials[number + 1 :]]
                return LoopSearch(edges, loop)
        return LoopSearch(edges)

    def state(self) -> ClosingState:
        """Return the state for a checkpoint, without the loop detector and the images."""
        return ClosingState(
            self._consistency.state, self.verifier.state, self._followed, self._new_revisits
        )

    @property
    def is_adjusting(self) -> bool:
        """Whether a global bundle adjustment is running, or its result has not been applied yet."""
        return self._global is not None

    def count_reused_keyframe(self, map_: Map, *, new: bool) -> bool:
        """Record that an old keyframe became the reference keyframe instead of a new keyframe.

        The result of the global bundle adjustment is applied after a certain number of keyframes. A
        reused keyframe also counts towards this number.

        Args:
            new: whether the map has a new revisit.

        Returns:
            Whether the result of the global bundle adjustment must be applied now.
        """
        self._followed += 1
        if new:
            self.count_revisit(map_)
        return self._is_due(map_.n_keyframes - 1)

    def count_revisit(self, map_: Map) -> None:
        """Record that a frame has measured an old place again. If there have been many such frames
        since the last global bundle adjustment began, another adjustment begins."""
        self._new_revisits += 1
        enough = self._config.loops.revisits_share * len(map_.living_keyframes())
        if self._new_revisits >= enough:
            self.adjust_after_revisits(map_)

    def adjust_after_revisits(self, map_: Map) -> None:
        """Start a global bundle adjustment if places were revisited since the last one began.

        Nothing is done if only few places were revisited, or while an adjustment is running. The
        map is only read.
        """
        if self._global is None and self._new_revisits >= self._config.loops.min_revisits:
            with self._failure_reported("Global bundle adjustment after a loop"):
                self._global = self._start_global(map_, map_.n_keyframes - 1)

    def apply_adjustment_if_due(self, map_: Map, keyframe: int) -> None:
        """Apply the result of the global bundle adjustment if it is due at this keyframe."""
        if self._is_due(keyframe):
            self.finish(map_)

    def _is_due(self, keyframe: int) -> bool:
        return self._global is not None and keyframe + self._followed >= self._global.due

    def conclude(self, map_: Map) -> None:
        """At the end of a drive, close a verified loop that has not been confirmed yet, and start a
        last global bundle adjustment if places were revisited.

        Normally, a later keyframe confirms such a loop. At the end of a drive, there is no later
        keyframe, and the loop is decided without it (``LoopConsistency.decided_at_end``).
        """
        found, edges = None, []
        with self._failure_reported("Looking for loops"):
            for edge in self._consistency.decided_at_end(map_):
                outcome, found = self._solve(map_, edge)
                edges.append(outcome)
                if found is not None:
                    break
        self.close(map_, LoopSearch(edges, found))
        self.finish(map_)
        self.adjust_after_revisits(map_)

    def finish(self, map_: Map) -> None:
        """Wait for the running global bundle adjustment, if there is one, and apply its result.

        The map is valid without this result. If the adjustment fails, a warning is logged and the
        map stays as it was.
        """
        pending, self._global = self._global, None
        if pending is None:
            return
        solution = None
        with self._failure_reported("Global bundle adjustment after a loop"):
            solution = pending.solution()
        if solution is not None:
            apply_solution(map_, pending.snapshot, solution)

    @contextmanager
    def _failure_reported(self, what: str) -> Iterator[None]:
        """Log an exception of the ``with`` block and add it to ``problems``, but do not raise it.

        The block must leave the map unchanged when it fails.
        """
        try:
            yield
        except Exception as error:
            problem = f"{what} failed ({reason(error)}); the map stays as it was."
            if problem not in self.problems:
                self.problems.append(problem)
                _log.warning(problem)

    def _solve(self, map_: Map, edge: LoopEdge) -> tuple[LoopEdge, _Loop | None]:
        """Solve the pose graph with a verified loop.

        Returns:
            The edge with its outcome, and the loop that can be closed. The loop is None if it
            contradicts the other edges of the graph.
        """
        start = time.perf_counter()
        solution = self._solution(map_, edge, Hypothesis.PREDICTED)
        carried = solution.has_gaps and edge.p_wrong <= self._config.loops.kidnapped
        if not solution.verdict.consistent and carried:
            solution = self._solution(map_, edge, Hypothesis.KIDNAPPED)
        refused, certain = solution.verdict.reason, self._config.loops.overwhelming
        against = not solution.verdict.consistent and edge.p_wrong <= certain
        if against:
            solution = self._solution(map_, edge, Hypothesis.MISTRACKED)
        if not solution.verdict.consistent:
            return replace(edge, accepted=False, reason=refused), None
        closed = replace(edge, reason="closed", against_odometry=against)
        return closed, _Loop(closed, solution, start)

    def _close(self, map_: Map, loop: _Loop) -> None:
        edge, solution = loop.edge, loop.solution
        if self._global is not None:  # its snapshot does not contain this loop
            self._global.cancel()
            self._global = None
        keyframes = solution.graph.keyframes
        before = map_.arrays.T_cw[keyframes]
        # Collected before fusion, which makes both sides of the loop covisible.
        query_side = [edge.query, *strong_neighbours(map_, edge.query)]
        match_side = [edge.match, *strong_neighbours(map_, edge.match)]
        self.closed.append(edge)
        for keyframe in solution.mistracked:  # its observations are as wrong as its pose
            cut_path(map_.arrays, keyframe, map_.n_keyframes)
        self._correct(map_, solution)
        fuse_loop(map_, edge, query_side, match_side, self._context)
        adjust_locally(map_, edge.query, self._context)
        seconds = time.perf_counter() - loop.start
        self.corrections.append(LoopCorrection(edge, keyframes, before, solution.T_cw, seconds))
        self._consistency.reset()  # the correction has moved the places that it remembers
        with self._failure_reported("Global bundle adjustment after a loop"):
            self._global = self._start_global(map_, edge.query)

    def _solution(self, map_: Map, edge: LoopEdge, hypothesis: Hypothesis) -> Solution:
        return solve(
            map_,
            self.closed,
            edge,
            hypothesis,
            self._pose_graph,
            monocular=self._camera.monocular,
        )

    def _correct(self, map_: Map, solution: Solution) -> None:
        keyframes = solution.graph.keyframes
        if self._camera.monocular:
            growth = move_keyframes_similarly(map_, keyframes, solution.S_wc)
            self.closed = [loop_in_new_units(closed, growth) for closed in self.closed]
        else:
            move_keyframes(map_, keyframes, solution.T_cw)

    def rescale(self, map_: Map, first: int, scale: float) -> None:
        """Multiply lengths by ``scale`` from a keyframe on, whose pose stays as it is. If it is the
        first one, the world frame stays as it is."""
        self.finish(map_)
        keyframes = map_.living_keyframes()
        keyframes = keyframes[keyframes >= first]
        T_wc = inverses(map_.arrays.T_cw[keyframes])
        centre = inverse(map_.keyframe_pose(first))[:3, 3] if first else np.zeros(3)
        T_wc[:, :3, 3] = centre + scale * (T_wc[:, :3, 3] - centre)
        growth = move_keyframes_similarly(map_, keyframes, similarity(T_wc, scale))
        self.closed = [loop_in_new_units(closed, growth) for closed in self.closed]
        self._consistency.reset()

    def _start_global(self, map_: Map, keyframe: int) -> _PendingAdjustment:
        config = self._config.loops
        snapshot, self._new_revisits = take_snapshot(map_, self._camera), 0
        wait = 1 + len(snapshot.problem.camera) // _OBSERVATIONS_PER_KEYFRAME
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
class _Loop:
    """A verified loop and its correction. ``start`` is when solving began (``perf_counter``)."""

    edge: LoopEdge
    solution: Solution
    start: float


@dataclass(frozen=True)
class LoopSearch:
    """The outcome of a search for a loop at a keyframe.

    Attributes:
        edges: the outcome of every loop candidate.
        loop: the verified loop, which has not been closed yet. None if no candidate is a loop.
    """

    edges: list[LoopEdge] = field(default_factory=list)
    loop: _Loop | None = None


@dataclass(frozen=True)
class _PendingAdjustment:
    snapshot: GlobalSnapshot
    solution: Callable[[], BundleSolution]
    due: int
    stop: threading.Event

    def cancel(self) -> None:
        self.stop.set()
