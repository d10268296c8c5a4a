"""Evaluates loop closures: which revisits were found, and which loops are wrong.

The ATE alone shows neither of these. If there is no drift, a missed loop causes no error. A wrong
loop may distort only a part of the map that contains few frames. Therefore, each loop and each
revisit is judged separately.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vslam.evaluation.trajectories import path_length
from vslam.run.outcome import RunOutcome, ground_truth_of
from vslam.types.geometry import inverses
from vslam.types.loops import LoopEdge

# Definition of a revisit.
MIN_LENGTH_M = 20.0  # least length of a stretch
MAX_LATERAL_M = 5.0  # distance from the earlier path; the next lane is 3 to 4 m away
MAX_HEADING_DEG = 30.0  # angle between the optical axes; a place looks different from behind
MIN_SECONDS, MIN_PATH_M = 10.0, 50.0  # time and distance since the earlier passage
# Two stretches with a shorter gap between them count as one stretch, because tracking continues in
# the old map across the gap.
MAX_INTERRUPTION_M = 10.0
# Largest error of the relative pose of a correct loop. It is well above the error of KITTI's ground
# truth between two passages, and well below the distance between similar houses in a row.
MAX_TRANSLATION_M, MAX_ROTATION_DEG = 2.0, 5.0
_SAMPLE_M = 1.0  # the path is sampled once per metre, so that a standing camera adds no samples
_UNIT_FRAMES = 20  # frames before and after a frame from which the unit of the map is estimated
_MAX_STEP_M = 20.0  # the path is unknown between two frames that are farther apart

Indices = NDArray[np.int64]
Poses = NDArray[np.float64]


@dataclass(frozen=True)
class Revisits:
    """M stretches on which the camera follows an earlier part of its path again, in order of time.

    Attributes:
        first, last: ``(M,)`` index of the first and of the last frame of each stretch.
        first_match, last_match: ``(M,)`` indices of the earlier frames that were taken nearest to
            the frames ``first`` and ``last``.
        length_m: ``(M,)`` length of each stretch in metres.
    """

    first: Indices
    last: Indices
    first_match: Indices
    last_match: Indices
    length_m: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.first)


@dataclass(frozen=True)
class LoopEvaluation:
    """The result of comparing the loops of a run with the ground truth.

    Attributes:
        revisits: the M stretches on which the camera follows an earlier part of its path again.
        loop_frame: ``(M,)`` query frame of the first correct loop that was closed on each stretch.
            It is -1 if no correct loop was closed there.
        right: for each loop edge, whether its relative pose agrees with the ground truth. Rejected
            edges are included. None if the edge has no pose or its frames have no ground truth.
        n_wrong: number of accepted edges whose relative pose disagrees with the ground truth.
    """

    revisits: Revisits
    loop_frame: Indices
    right: tuple[bool | None, ...]
    n_wrong: int

    @property
    def n_found(self) -> int:
        """Number of stretches of ``revisits`` on which a correct loop was closed.

        One loop per stretch is sufficient, because tracking then continues in the old part of the
        map.
        """
        return int(np.count_nonzero(self.loop_frame >= 0))

    @property
    def n_missed(self) -> int:
        """Number of stretches of ``revisits`` on which no correct loop was closed."""
        return len(self.revisits) - self.n_found


def evaluate_loops(outcome: RunOutcome) -> LoopEvaluation | None:
    """Compare the loops of a run with the ground truth of its frames.

    Returns None if a frame has no ground truth, because revisits cannot be found on a path with
    gaps.
    """
    truth = ground_truth_of(outcome.sequence)
    if truth is None or not len(outcome.trajectory):
        return None
    if not np.isin(outcome.trajectory.timestamps, truth.timestamps).all():
        return None
    # The poses of loops are relative to the images, which may have been turned.
    T_wc, times = truth.T_wc @ outcome.sequence.camera.T_mounted_camera, truth.timestamps
    done = int(np.searchsorted(times, outcome.trajectory.timestamps[-1], side="right"))
    loops = outcome.loops
    if outcome.sequence.camera.monocular:
        metres = metres_per_unit(np.array([track.T_wc for track in outcome.tracks]), T_wc[:done])
        frames = outcome.keyframe_frames
        loops = [_in_metres(edge, float(metres[frames[edge.match]])) for edge in loops]
    return judge_loops(loops, outcome.keyframe_frames, T_wc[:done], times[:done])


def metres_per_unit(T_wc: Poses, T_wc_true: Poses) -> NDArray[np.float64]:
    """Return how many metres one unit of a monocular map is long at each of N frames, ``(N,)``.

    The length is the median ratio of the true to the estimated distance between consecutive frames,
    over the 41 frames around each frame. It is 1 if the camera did not move.

    Args:
        T_wc: ``(N, 4, 4)`` poses at the time of tracking.
        T_wc_true: ``(N, 4, 4)`` ground truth.
    """
    true, estimated = (
        np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) for T in (T_wc_true, T_wc)
    )
    n = len(T_wc)
    metres = np.ones(n)
    for k in range(n):
        steps = slice(max(0, k - _UNIT_FRAMES), k + _UNIT_FRAMES)
        moved = (estimated[steps] > 0) & (true[steps] > 0)
        if moved.any():
            metres[k] = np.median(true[steps][moved] / estimated[steps][moved])
    return metres


def _in_metres(edge: LoopEdge, metres: float) -> LoopEdge:
    if edge.T_query_match is None:
        return edge
    T = edge.T_query_match.copy()
    T[:3, 3] *= metres
    return replace(edge, T_query_match=T)


def revisits(T_wc: Poses, timestamps: NDArray[np.float64]) -> Revisits:
    """Find the stretches of a path along which the camera had already travelled earlier.

    A frame is a revisit if the camera passed within ``MAX_LATERAL_M`` of the same position earlier,
    with a heading that differed by at most ``MAX_HEADING_DEG``. Between the two passages, there
    must be at least ``MIN_SECONDS`` and a path of at least ``MIN_PATH_M``. The camera is assumed to
    move on a straight line between two frames.

    Args:
        T_wc: ``(N, 4, 4)`` true poses.
        timestamps: ``(N,)`` seconds.
    """
    none = np.zeros(0, np.int64)
    no_revisits = Revisits(none, none, none, none, np.zeros(0))
    if len(T_wc) < 2:
        return no_revisits
    path = path_length(T_wc)
    sampled = np.searchsorted(path, np.arange(0.0, path[-1], _SAMPLE_M))
    sampled = np.unique(np.append(sampled, len(T_wc) - 1))
    match = _earlier_passage(T_wc[sampled], timestamps[sampled], path[sampled])

    revisiting = np.flatnonzero(match >= 0)
    if not len(revisiting):
        return no_revisits
    travelled = path[sampled]
    gap = np.diff(travelled[revisiting])
    interrupted = (np.diff(revisiting) > 1) & (gap >= MAX_INTERRUPTION_M)
    ends = np.flatnonzero(interrupted | (gap > _MAX_STEP_M))
    first = revisiting[np.append(0, ends + 1)]
    last = revisiting[np.append(ends, len(revisiting) - 1)]
    long_enough = travelled[last] - travelled[first] >= MIN_LENGTH_M
    first, last = first[long_enough], last[long_enough]
    return Revisits(
        first=sampled[first],
        last=sampled[last],
        first_match=sampled[match[first]],
        last_match=sampled[match[last]],
        length_m=travelled[last] - travelled[first],
    )


def judge_loops(
    edges: Collection[LoopEdge],
    frames: Indices,
    T_wc: Poses,
    timestamps: NDArray[np.float64],
) -> LoopEvaluation:
    """Determine which loop edges are right, and which revisits were found by a loop.

    An edge is right if ``T_query_match`` agrees with the ground truth within ``MAX_TRANSLATION_M``
    and ``MAX_ROTATION_DEG``. A revisit is found if an accepted and right edge connects one of its
    frames to an earlier passage. The query of the edge may also lie up to ``MAX_INTERRUPTION_M``
    before or after the revisit, because the camera sees a place from some distance.

    Args:
        edges: accepted and rejected loops.
        frames: ``(K,)`` index of the frame that became each keyframe. It is -1 if the keyframe
            belongs to a different drive.
        T_wc: ``(N, 4, 4)`` ground truth of the frames.
        timestamps: ``(N,)`` seconds.
    """
    found = revisits(T_wc, timestamps)
    right = tuple(is_right_loop(edge, frames, T_wc) for edge in edges)
    loop_frame = np.full(len(found), -1, np.int64)
    path = path_length(T_wc)
    slack = MAX_INTERRUPTION_M
    for edge, is_right in zip(edges, right, strict=True):
        if not (edge.accepted and is_right):
            continue
        query, match = sorted((int(frames[edge.query]), int(frames[edge.match])), reverse=True)
        if not _long_ago(path, timestamps, query, match):
            continue
        near = (path[found.first] - slack <= path[query]) & (
            path[query] <= path[found.last] + slack
        )
        earlier = near & ((loop_frame < 0) | (query < loop_frame))
        loop_frame[earlier] = query
    n_wrong = sum(
        edge.accepted and is_right is False for edge, is_right in zip(edges, right, strict=True)
    )
    return LoopEvaluation(found, loop_frame, right, n_wrong)


def is_right_loop(edge: LoopEdge, frames: Indices, T_wc: Poses) -> bool | None:
    """Return whether the relative pose of a loop agrees with the ground truth.

    The tolerances are ``MAX_TRANSLATION_M`` and ``MAX_ROTATION_DEG``. The result is None if the
    loop has no pose or if its frames have no ground truth.
    """
    if edge.T_query_match is None or edge.query < 0:
        return None
    query, match = frames[edge.query], frames[edge.match]
    if max(query, match) >= len(T_wc) or min(query, match) < 0:
        return None
    T_wq, T_wm = T_wc[query], T_wc[match]
    T_match_query = inverses(T_wm[None])[0] @ T_wq
    error = edge.T_query_match @ T_match_query  # it is the identity if the edge is right
    cosine = np.clip((np.trace(error[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)
    return bool(
        np.linalg.norm(error[:3, 3]) <= MAX_TRANSLATION_M
        and np.degrees(np.arccos(cosine)) <= MAX_ROTATION_DEG
    )


def _earlier_passage(
    T_wc: Poses, timestamps: NDArray[np.float64], path: NDArray[np.float64]
) -> Indices:
    """For each of S samples of the path, find the nearest sample of an earlier passage.

    Returns:
        ``(S,)`` index of the nearest earlier sample, or -1 if there was no earlier passage.
    """
    from scipy.spatial import cKDTree

    position, axis = T_wc[:, :3, 3], T_wc[:, :3, 2]
    forward = np.diff(position, axis=0, append=position[-1:])  # vector to the next sample
    length = np.linalg.norm(forward, axis=1)
    forward[length > _MAX_STEP_M] = 0.0
    length[length > _MAX_STEP_M] = 0.0

    # A step that passes within MAX_LATERAL_M of a sample starts at most this far from the sample.
    radius = float(np.hypot(MAX_LATERAL_M, length.max()))
    pairs = cKDTree(position).query_pairs(radius, output_type="ndarray")
    start, query = pairs[:, 0], pairs[:, 1]
    kept = _long_ago(path, timestamps, query, start)
    start, query = start[kept], query[kept]

    offset = position[query] - position[start]
    along = np.einsum("ni,ni->n", offset, forward[start]) / np.maximum(length[start], 1e-9) ** 2
    along = np.clip(along, 0.0, 1.0)
    distance = np.linalg.norm(offset - along[:, None] * forward[start], axis=1)
    nearest = start + (along > 0.5)
    cosine = np.einsum("ni,ni->n", axis[query], axis[nearest])
    same = (distance <= MAX_LATERAL_M) & (cosine >= np.cos(np.radians(MAX_HEADING_DEG)))
    query, nearest, distance = query[same], nearest[same], distance[same]

    match = np.full(len(T_wc), -1, np.int64)
    order = np.lexsort((nearest, -distance, query))  # the nearest match is written last
    match[query[order]] = nearest[order]
    return match


def _long_ago(
    path: NDArray[np.float64],
    timestamps: NDArray[np.float64],
    query: Indices | int,
    match: Indices | int,
) -> NDArray[np.bool_]:
    """Return whether a match is old enough to belong to an earlier passage than its query."""
    apart = path[query] - path[match] >= MIN_PATH_M
    return apart & (timestamps[query] - timestamps[match] >= MIN_SECONDS)
