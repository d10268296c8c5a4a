"""The interactive explorer in the HTML report of a run.

The explorer shows the pose, state and error of every frame, and images of some keyframes.

A frame adds 47 bytes to the page. An image with keypoints adds about 10,000 bytes. ``explorer.js``
uses no plotting library, because a library such as Plotly (4.7 MB) would be larger than the rest of
the page.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Collection
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vslam.evaluation.trajectories import Evaluation
from vslam.report.page import Markup, Section
from vslam.report.render import fill_template
from vslam.run.outcome import RunOutcome

if TYPE_CHECKING:
    from vslam.run.moments import Moment


def explorer(
    outcome: RunOutcome, evaluation: Evaluation | None, moments: Collection[Moment]
) -> list[Section]:
    """Return the section of the report with the interactive explorer, or nothing if fewer than two
    frames were tracked.

    Args:
        evaluation: errors of ``outcome.trajectory`` relative to the ground truth. None if they
            cannot be computed.
        moments: images of keyframes, from a ``vslam.run.moments.MomentRecorder``.
    """
    data = explorer_data(outcome, evaluation, moments)
    if data is None:
        return []
    program = files("vslam.report").joinpath("explorer.js").read_text("utf-8")
    with_error = evaluation is not None
    markup = fill_template("explorer.html.jinja", data=data, program=program, with_error=with_error)
    return [Section("Explorer", [Markup(markup)])]


def explorer_data(
    outcome: RunOutcome, evaluation: Evaluation | None, moments: Collection[Moment]
) -> dict[str, Any] | None:
    """Return the data for ``explorer.js``, in a form that can be written as JSON. The result is
    None if fewer than two frames were tracked.

    ``floats`` contains times in seconds, positions in metres, headings in degrees (0 along z, 90
    along x) and errors in metres. Unknown numbers are NaN.

    Args:
        evaluation: errors of ``outcome.trajectory`` relative to the ground truth. None if they
            cannot be computed.
        moments: images of keyframes, from a ``vslam.run.moments.MomentRecorder``.
    """
    n = len(outcome.trajectory)
    if outcome.n_tracked < 2 or len(outcome.tracks) != n:
        return None
    times = outcome.trajectory.timestamps
    T_wc, errors = outcome.trajectory.T_wc, np.full(n, np.nan)
    truth = np.zeros((0, 3))
    if evaluation is not None and outcome.ground_truth is not None:
        at = np.searchsorted(times, evaluation.timestamps).clip(0, n - 1)
        errors[at] = evaluation.errors_m
        if evaluation.frames == n:  # otherwise only a part of the path has been aligned
            T_wc, truth = evaluation.T_wc_aligned, outcome.ground_truth.T_wc[:, :3, 3]
    states = sorted({str(track.state) for track in outcome.tracks})
    floats = {
        "t": times - times[0],
        **dict(zip("xyz", T_wc[:, :3, 3].T, strict=True)),
        "heading": np.rad2deg(np.arctan2(T_wc[:, 0, 2], T_wc[:, 2, 2])),
        "error": errors,
    }
    inliers = np.array([track.n_inliers for track in outcome.tracks]).clip(0, 65535)
    state = np.array([states.index(str(track.state)) for track in outcome.tracks])
    return {
        "unit": " m" if outcome.is_metric or evaluation is not None else "",
        "floats": {name: _packed(values, "<f4") for name, values in floats.items()},
        "truth": {"x": _packed(truth[:, 0], "<f4"), "z": _packed(truth[:, 2], "<f4")},
        "states": states,
        "state": _packed(state, "u1"),
        "inliers": _packed(inliers, "<u2"),
        "moments": [_encoded(moment) for moment in moments],
    }


def _encoded(moment: Moment) -> dict[str, Any]:
    return {
        "frame": moment.frame,
        "jpeg": b64encode(moment.jpeg).decode(),
        "points": b64encode(moment.points.tobytes()).decode(),
        "tracked": b64encode(np.packbits(moment.tracked).tobytes()).decode(),
        "n": len(moment.points),
    }


def _packed(values: NDArray[Any], kind: str) -> str:
    """Encode an array in base64, which is a third as long as JSON and may contain NaN."""
    return b64encode(values.astype(kind).tobytes()).decode()
