"""Explains why a run tracked no frame."""

from __future__ import annotations

from vslam.run.outcome import RunOutcome
from vslam.support.errors import counted


def why_nothing_was_tracked(outcome: RunOutcome) -> str | None:
    """Explain in one sentence why no frame of a run was tracked, and what the user can do.

    The result is None if a frame was tracked.
    """
    n, options = len(outcome.tracks), outcome.settings
    if n == 0 or outcome.n_tracked:
        return None
    problem = f"nothing was tracked in {counted(n, 'frame')}"
    if len(outcome.skipped) == n:
        return f"{problem}: no image could be read ({outcome.skipped[0].rstrip('.')})"
    if options.localize:
        return f"{problem}: no frame was recognised in the map {options.map_file}"
    if options.perturb != "none":
        return f"{problem} under --perturb {options.perturb}; a weaker perturbation may work"
    if outcome.sequence.camera.monocular:
        return (
            f"{problem}: a single camera must move sideways to begin a map; if it did, vslam "
            "doctor checks images, calibration and times"
        )
    return f"{problem}: vslam doctor checks images, calibration and times"
