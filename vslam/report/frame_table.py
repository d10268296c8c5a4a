"""Writes the tracking results of all frames to ``frames.csv`` and ``covariance.csv``."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.report.summary import stage_names
from vslam.support.errors import InputError
from vslam.types.features import TrackResult

_COUNTS = ("n_features", "n_stereo", "n_matches", "n_inliers")
_SIGMAS = ("sigma_m", "sigma_deg", "drift_m", "drift_deg")
_AXES = ("x", "y", "z", "rx", "ry", "rz")


def write_frames(path: Path, tracks: list[TrackResult]) -> None:
    """Write ``frames.csv``, which has a row for each frame.

    The columns are the timestamp (s), the tracking state, several counts, whether the frame became
    a keyframe, the part of the map (``TrackResult.part``), standard deviations of position (m) and
    orientation (degrees), and the milliseconds of each stage.

    The first two standard deviations are relative to the landmarks around the camera. The other two
    are relative to the start of the drive. A field is empty if a standard deviation is unknown, or
    if a frame did not go through a stage.
    """
    stages = stage_names(tracks)
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(
            ["frame", "timestamp", "state", *_COUNTS, "keyframe", "part", *_SIGMAS]
            + [f"{s}_ms" for s in stages]
        )
        for track in tracks:
            counts = [getattr(track, name) for name in _COUNTS]
            times = [f"{track.stage_ms[s]:.3f}" if s in track.stage_ms else "" for s in stages]
            row = [track.index, f"{track.timestamp:.6f}", track.state, *counts]
            row += [int(track.is_keyframe), track.part]
            table.writerow([*row, *_sigmas(track), *times])


def _sigmas(track: TrackResult) -> list[str]:
    if track.uncertainty is None:
        return [""] * len(_SIGMAS)
    deviations = []
    for covariance in (track.uncertainty.local, track.uncertainty.covariance):
        variances = np.diag(covariance)
        deviations += [np.sqrt(variances[:3].sum()), np.degrees(np.sqrt(variances[3:].sum()))]
    return [f"{deviation:.6f}" for deviation in deviations]


def write_covariances(path: Path, tracks: list[TrackResult]) -> None:
    """Write ``covariance.csv``, which has a row for each frame with known covariances.

    The columns are the timestamp (s) and the upper triangles of two covariances, row by row.

    The two matrices are covariances of ``[x, y, z, rx, ry, rz]`` in metres and radians, in the
    frame of the camera (``vslam.types.odometry``). The first covariance describes the pose relative
    to the landmarks around the camera (``local``). The second covariance describes the pose
    relative to the start of the drive (``drive``).
    """
    upper = np.triu_indices(6)
    pairs = [f"{_AXES[row]}_{_AXES[column]}" for row, column in zip(*upper, strict=True)]
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(
            ["timestamp", *(f"{of}_{pair}" for of in ("local", "drive") for pair in pairs)]
        )
        for track in tracks:
            if track.uncertainty is not None:
                both = track.uncertainty.local, track.uncertainty.covariance
                values = [f"{value:.6e}" for one in both for value in one[upper]]
                table.writerow([f"{track.timestamp:.6f}", *values])


def read_covariances(
    path: Path,
) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Read the two ``(6, 6)`` covariances of each frame from the file ``covariance.csv``. The keys
    are the timestamps, exactly as they are written in the file.

    Raises:
        InputError: the file is missing or damaged.
    """
    upper = np.triu_indices(6)
    found = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for time, *values in list(csv.reader(file))[1:]:
                both = np.zeros((2, 6, 6))
                numbers = np.array(values, np.float64).reshape(2, len(upper[0]))
                for matrix, triangle in zip(both, numbers, strict=True):
                    matrix[upper] = matrix.T[upper] = triangle
                found[time] = both[0], both[1]
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give the folder of a run, or repeat it."
        ) from error
    except (ValueError, csv.Error) as error:
        raise InputError(f"{path}: damaged ({error}); repeat the run.") from error
    return found
