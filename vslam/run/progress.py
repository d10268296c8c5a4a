"""The progress of a run: the data that the report needs about the frames processed so far.

An interrupted run leaves this data in a file next to its map file. A resumed run continues from
both files.
"""

from __future__ import annotations

import json
import math
from array import array
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.maps.checkpoint import LOOP_SHAPES
from vslam.maps.codec import Codec
from vslam.maps.new_output import replaced_file
from vslam.support.errors import InputError
from vslam.support.untrusted import ARCHIVE_ERRORS, read_json, read_npz
from vslam.types.features import TrackingState, TrackResult
from vslam.types.loops import LoopCorrection, LoopEdge
from vslam.types.odometry import N_NUMBERS, PoseUncertainty

SCHEMA = 8
_STATES = tuple(TrackingState)
_POSE, _IMU = 16, 15  # columns of the pose, and of what is known from an IMU
_NUMBERS = 8 + 16 + N_NUMBERS + _IMU  # columns after the pose
_UNKNOWN = np.full(N_NUMBERS, np.nan)
PROGRESS = Codec(
    LOOP_SHAPES
    | {
        "TrackTable.rows": ("N", _POSE + _NUMBERS),
        "TrackTable.stage_ms": ("N", "S"),
        "LoopCorrection.keyframes": ("N",),
        "LoopCorrection.T_cw_before": ("N", 4, 4),
        "LoopCorrection.T_cw_after": ("N", 4, 4),
    }
)


@dataclass(frozen=True)
class TrackTable:
    """Tracking results of N frames, in order.

    Attributes:
        rows: ``(N, 125)`` float64, one row for each frame: ``T_wc`` row by row, the timestamp, the
            state, the numbers of features, stereo features, matches and inliers, the support, a sum
            (1 for a keyframe, 2 for a relocalised frame, 4 if the camera stands still, and 8 times
            the part), ``T_odom_camera`` row by
            row, ``PoseUncertainty.numbers``, gravity, the biases of the IMU and their standard
            deviations. Unknown numbers are NaN.
        stages: names of the timed stages.
        stage_ms: ``(N, S)`` float64 milliseconds. NaN for a stage that a frame skipped.
    """

    rows: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, _POSE + _NUMBERS)))
    stages: tuple[str, ...] = ()
    stage_ms: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def timestamps(self) -> NDArray[np.float64]:
        """``(N,)`` timestamps in seconds."""
        return self.rows[:, _POSE]

    def until(self, frames: int) -> TrackTable:
        """Return a table with the results of the first ``frames`` frames."""
        return replace(self, rows=self.rows[:frames], stage_ms=self.stage_ms[:frames])

    def results(self) -> list[TrackResult]:
        """Convert the rows of the table back to the tracking results of the frames."""
        return [
            _track(index, row, dict(zip(self.stages, ms, strict=True)))
            for index, (row, ms) in enumerate(zip(self.rows, self.stage_ms.tolist(), strict=True))
        ]


class TrackLog:
    """A table of tracking results to which frames can be appended."""

    def __init__(self, before: TrackTable) -> None:
        self._rows = array("d", before.rows.tobytes())
        self._stage_ms = {
            name: array("d", np.ascontiguousarray(before.stage_ms[:, k]).tobytes())
            for k, name in enumerate(before.stages)
        }
        self._n = len(before)

    def append(self, track: TrackResult) -> None:
        """Append the tracking result of the next frame to the table."""
        self._rows.extend(track.T_wc.ravel())
        self._rows.extend((
            track.timestamp, _STATES.index(track.state), track.n_features, track.n_stereo,
            track.n_matches, track.n_inliers,
            math.nan if track.support is None else track.support,
            track.is_keyframe + 2 * track.relocalised + 4 * track.stands_still + 8 * track.part,
        ))  # fmt: skip
        T_odom, uncertainty = track.T_odom_camera, track.uncertainty
        self._rows.extend(np.full(16, np.nan) if T_odom is None else T_odom.ravel())
        self._rows.extend(_UNKNOWN if uncertainty is None else uncertainty.numbers())
        for value, n in ((track.gravity, 3), (track.imu_bias, 6), (track.imu_bias_sigma, 6)):
            self._rows.extend([math.nan] * n if value is None else value)
        for name in track.stage_ms:
            if name not in self._stage_ms:
                self._stage_ms[name] = array("d", [np.nan] * self._n)
        for name, column in self._stage_ms.items():
            column.append(track.stage_ms.get(name, np.nan))
        self._n += 1

    def table(self) -> TrackTable:
        """Return a copy of the results of all frames."""
        columns = [np.array(column) for column in self._stage_ms.values()]
        return TrackTable(
            np.array(self._rows).reshape(self._n, _POSE + _NUMBERS),
            tuple(self._stage_ms),
            np.stack(columns, axis=1) if columns else np.empty((self._n, 0)),
        )


@dataclass(frozen=True)
class Progress:
    """The data that a report needs about the frames that a run has processed so far.

    Attributes:
        tracks: results of the frames.
        skipped: a message for each frame whose images could not be read.
        latency_ms: milliseconds from the arrival of each tracked frame until its pose is known, in
            a real-time run.
        wall_s, cpu_s: wall and CPU time in which the frames were processed, in seconds.
        loops: loop candidates, with frame numbers in place of keyframe ids. The number -1 stands
            for a keyframe of an earlier drive.
        corrections: corrections of the map by the accepted loops, with frame numbers in place of
            keyframe ids.
    """

    tracks: TrackTable = field(default_factory=TrackTable)
    skipped: list[str] = field(default_factory=list)
    latency_ms: list[float] = field(default_factory=list)
    wall_s: float = 0.0
    cpu_s: float = 0.0
    loops: list[LoopEdge] = field(default_factory=list)
    corrections: list[LoopCorrection] = field(default_factory=list)

    def until(self, frames: int) -> Progress:
        """Return the part of the progress that covers the first ``frames`` frames."""
        return replace(
            self,
            tracks=self.tracks.until(frames),
            skipped=[line for line in self.skipped if _frame_of(line) < frames],
            loops=[loop for loop in self.loops if loop.query < frames],
            corrections=[one for one in self.corrections if one.edge.query < frames],
        )


def _frame_of(message: str) -> int:
    return int(message.removeprefix("frame ").partition(":")[0])


def frames_of(loops: list[LoopEdge], frames: NDArray[np.int64]) -> list[LoopEdge]:
    """Replace the keyframe ids of loops with frame numbers, and remove features and landmarks.

    Args:
        frames: ``(K,)`` frame number of each keyframe.
    """
    return [
        replace(
            loop,
            query=int(frames[loop.query]) if loop.query >= 0 else -1,
            match=int(frames[loop.match]),
            features=None,
            landmarks=None,
        )
        for loop in loops
    ]


def in_frames(
    loops: list[LoopEdge], corrections: list[LoopCorrection], frames: NDArray[np.int64]
) -> tuple[list[LoopEdge], list[LoopCorrection]]:
    """Replace the keyframe ids of loops and of their corrections with frame numbers.

    Args:
        frames: ``(K,)`` frame number of each keyframe.
    """
    edges = frames_of([one.edge for one in corrections], frames)
    moved = [
        replace(one, edge=edge, keyframes=frames[one.keyframes])
        for one, edge in zip(corrections, edges, strict=True)
    ]
    return frames_of(loops, frames), moved


def write_progress(path: Path, progress: Progress) -> None:
    """Write the progress as an ``.npz`` file. An existing file is replaced.

    Raises:
        OSError: the file cannot be written.
    """
    entry, arrays = PROGRESS.encode(progress, "progress")
    header = json.dumps({"kind": "vslam progress", "schema": SCHEMA, "progress": entry})
    with replaced_file(path) as file:
        np.savez(
            file, allow_pickle=False, header=np.frombuffer(header.encode(), np.uint8), **arrays
        )


def read_progress(path: Path) -> Progress:
    """Read the progress of a run from a file that ``write_progress`` wrote.

    Raises:
        InputError: the file is missing, damaged or from another version.
    """
    arrays = read_npz(path, "the progress of a run", "there is nothing to resume")
    try:
        header = read_json(arrays["header"])
        if header["kind"] != "vslam progress" or header["schema"] != SCHEMA:
            raise InputError(f"{path}: written by another version of vslam; resume with that one.")
        progress = PROGRESS.decode(Progress, header["progress"], arrays)
        if progress.tracks.stage_ms.shape[1] != len(progress.tracks.stages):
            raise ValueError("the stages do not match the frames")
        progress.tracks.results()  # raises an error for an unknown state
        return progress
    except (*ARCHIVE_ERRORS, TypeError, AttributeError, IndexError) as error:
        raise InputError(f"{path}: damaged ({error}); there is nothing to resume.") from error


def _track(index: int, row: NDArray[np.float64], stage_ms: dict[str, float]) -> TrackResult:
    basic, T_odom, numbers, gravity, bias, bias_sigma = np.split(
        row[_POSE:], np.cumsum([8, 16, N_NUMBERS, 3, 6])
    )
    timestamp, state, *counts, support, flags = basic.tolist()
    n_features, n_stereo, n_matches, n_inliers = map(int, counts)
    return TrackResult(
        index=index,
        timestamp=timestamp,
        T_wc=row[:_POSE].reshape(4, 4),
        state=_STATES[int(state)],
        n_features=n_features,
        n_stereo=n_stereo,
        n_matches=n_matches,
        n_inliers=n_inliers,
        is_keyframe=bool(int(flags) & 1),
        relocalised=bool(int(flags) & 2),
        part=int(flags) >> 3,
        support=support if math.isfinite(support) else None,
        stands_still=bool(int(flags) & 4),
        stage_ms={name: ms for name, ms in stage_ms.items() if np.isfinite(ms)},
        T_odom_camera=_known(T_odom.reshape(4, 4)),
        uncertainty=PoseUncertainty.of_numbers(numbers) if np.isfinite(numbers).all() else None,
        gravity=_known(gravity),
        imu_bias=_known(bias),
        imu_bias_sigma=_known(bias_sigma),
    )


def _known(values: NDArray[np.float64]) -> NDArray[np.float64] | None:
    return values if np.isfinite(values).all() else None
