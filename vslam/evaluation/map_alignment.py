"""The transformation from a map to its ground truth, and the error of localisation in the map.

A trajectory is usually aligned with its ground truth before both are compared. Frames that were
localised in an existing map are not aligned in this way. Their positions are transformed by the
alignment of the map. Therefore, their error includes the error of the map.
"""

from __future__ import annotations

import numpy as np

from vslam.evaluation.trajectories import Evaluation
from vslam.maps.stored_map import TruthAlignment
from vslam.run.outcome import RunOutcome
from vslam.types.geometry import Matrix


def name_of_world(outcome: RunOutcome) -> str:
    """Return the name of the world frame of a run's ground truth.

    It contains the name of the sequence, or ``Source.world`` if the sequence shares its world frame
    with others.
    """
    sequence = outcome.sequence
    return f"{sequence.dataset} {sequence.world or sequence.name}"


def truth_alignment_of(outcome: RunOutcome, evaluation: Evaluation) -> TruthAlignment:
    """Return the transformation from the map of a run to the ground truth.

    It is the transformation that aligns the trajectory of the run.
    """
    truth = outcome.ground_truth
    assert truth is not None
    kept = np.isin(outcome.trajectory.timestamps, truth.timestamps)
    T_wc, aligned = outcome.trajectory.T_wc[kept], evaluation.T_wc_aligned
    return TruthAlignment(name_of_world(outcome), _similarity(T_wc, aligned))


def error_in_map(outcome: RunOutcome) -> float | None:
    """Compute the error of localisation in the existing map that a run continued.

    The error is the position RMSE in metres of the frames that were localised in this map. None if
    the transformation from this map to the ground truth of the run is unknown.
    """
    alignment, truth = outcome.truth_alignment, outcome.ground_truth
    if alignment is None or truth is None or outcome.in_map is None:
        return None
    frames = np.isin(outcome.trajectory.timestamps, truth.timestamps) & outcome.in_map
    if alignment.name != name_of_world(outcome) or not frames.any():
        return None
    true = truth.T_wc[np.isin(truth.timestamps, outcome.trajectory.timestamps[frames]), :3, 3]
    S, position = alignment.S_truth_world, outcome.trajectory.T_wc[frames, :3, 3]
    return float(np.sqrt(((position @ S[:3, :3].T + S[:3, 3] - true) ** 2).sum(axis=1).mean()))


def _similarity(T_wc: Matrix, aligned: Matrix) -> Matrix:
    """Fit the ``(4, 4)`` similarity that maps ``(N, 4, 4)`` poses to aligned poses."""
    spread, aligned_spread = (
        np.linalg.norm(T[:, :3, 3] - T[:, :3, 3].mean(axis=0)) for T in (T_wc, aligned)
    )
    S = np.eye(4)
    S[:3, :3] = aligned[0, :3, :3] @ T_wc[0, :3, :3].T
    if spread > 0:
        S[:3, :3] *= aligned_spread / spread
    S[:3, 3] = aligned[0, :3, 3] - S[:3, :3] @ T_wc[0, :3, 3]
    return S
