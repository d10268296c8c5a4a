"""What the page's explorer shows: the path, and image, keypoints and error at every moment.

The program is ``explorer.js``, written by hand: a library that draws (Plotly: 4.7 MB) would be
larger than all else in the page.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vslam.evaluation.trajectories import Evaluation
from vslam.run.outcome import RunOutcome
from vslam.trajectory import Trajectory

if TYPE_CHECKING:
    from vslam.run.moments import Moment

_MOST_FRAMES = 3000  # that the path is drawn of


def explorer_data(
    outcome: RunOutcome,
    evaluation: Evaluation | None,
    ground_truth: Trajectory | None,
    moments: Collection[Moment],
) -> dict[str, Any] | None:
    """Numbers and images for ``explorer.js``, as JSON takes them; None without two frames.

    Args:
        outcome: the run.
        evaluation: of ``outcome.trajectory``, or None.
        ground_truth: of the frames that are evaluated, or None.
        moments: of a `vslam.run.moments.MomentRecorder`.
    """
    n = len(outcome.trajectory)
    if n < 2 or len(outcome.tracks) != n:
        return None
    shown = np.unique(np.append(np.arange(0, n, -(-n // _MOST_FRAMES)), n - 1))
    times = outcome.trajectory.timestamps
    path, errors = outcome.trajectory.T_wc[:, :3, 3], np.full(n, np.nan)
    truth = np.zeros((0, 3))
    if evaluation is not None and ground_truth is not None:
        at = np.searchsorted(times, evaluation.timestamps).clip(0, n - 1)
        errors[at] = evaluation.errors_m
        truth = ground_truth.T_wc[:, :3, 3]
        if evaluation.frames == n:
            path = evaluation.T_wc_aligned[:, :3, 3]
        else:
            truth = np.zeros((0, 3))  # the whole path is in another frame than the evaluated part
        truth = truth[shown] if len(truth) == n else truth
    tracks = [outcome.tracks[k] for k in shown]
    return {
        "unit": "" if outcome.settings.sensor == "mono" and evaluation is None else " m",
        "frame": shown.tolist(),
        "t": _rounded(times[shown] - times[0], 2),
        "x": _rounded(path[shown, 0], 3),
        "z": _rounded(path[shown, 2], 3),
        "truth": {"x": _rounded(truth[:, 0], 3), "z": _rounded(truth[:, 2], 3)},
        "error": _rounded(errors[shown], 4),
        "state": [str(track.state) for track in tracks],
        "inliers": [track.n_inliers for track in tracks],
        "moments": [_shown(moment) for moment in moments],
    }


def _shown(moment: Moment) -> dict[str, Any]:
    return {
        "frame": moment.frame,
        "jpeg": b64encode(moment.jpeg).decode(),
        "points": b64encode(moment.points.tobytes()).decode(),
        "tracked": b64encode(np.packbits(moment.tracked).tobytes()).decode(),
        "n": len(moment.points),
    }


def _rounded(values: NDArray[np.float64], decimals: int) -> list[float | None]:
    """NaN and infinity become None: JSON has neither."""
    return [
        x if np.isfinite(x) else None for x in np.round(values.astype(float), decimals).tolist()
    ]
