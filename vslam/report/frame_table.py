"""``frames.csv``: the result of tracking for every frame, for scripts and spreadsheets."""

from __future__ import annotations

import csv
from pathlib import Path

from vslam.features import TrackResult
from vslam.report.summary import stage_names

_COUNTS = ("n_features", "n_stereo", "n_matches", "n_inliers")


def write_frames(path: Path, tracks: list[TrackResult]) -> None:
    """Write a row per frame: time (s), state, counts, keyframe or not, milliseconds of each stage.

    The cell of a stage that a frame did not go through is empty.
    """
    stages = stage_names(tracks)
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(
            ["frame", "timestamp", "state", *_COUNTS, "keyframe", *(f"{s}_ms" for s in stages)]
        )
        for track in tracks:
            counts = [getattr(track, name) for name in _COUNTS]
            times = [f"{track.stage_ms[s]:.3f}" if s in track.stage_ms else "" for s in stages]
            row = [track.index, f"{track.timestamp:.6f}", track.state, *counts]
            table.writerow([*row, int(track.is_keyframe), *times])
