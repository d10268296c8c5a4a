"""Trajectories with one pose for each frame, and their text formats.

Each line holds one pose:

- KITTI (Geiger et al., CVPR 2012): the upper 3x4 part of ``T_wc``, row by row, without time.
- TUM (Sturm et al., IROS 2012): ``t x y z qx qy qz qw``, with t in seconds and the position in
  metres.
- EuRoC (Burri et al., IJRR 2016): ``t,x,y,z,qw,qx,qy,qz``, with t in nanoseconds. This format is
  only written, not read.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vslam.errors import InputError
from vslam.geometry import compose, inverse, orthonormalised, se3_exp, se3_log

_FORMAT_OF_COLUMNS: dict[int, Literal["kitti", "tum"]] = {12: "kitti", 8: "tum"}

# Published poses are rounded to about 7 digits. A matrix with a larger error is not a rotation.
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Trajectory:
    """The poses of N frames.

    Attributes:
        timestamps: ``(N,)`` float64 seconds.
        T_wc: ``(N, 4, 4)`` float64 poses (camera to world).
    """

    timestamps: NDArray[np.float64]
    T_wc: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.T_wc)

    def select(self, indices: NDArray[np.int64]) -> Trajectory:
        """Return the poses at ``(M,)`` indices, in the order of the indices."""
        return Trajectory(self.timestamps[indices], self.T_wc[indices])


def bridge_gaps(trajectory: Trajectory, known: NDArray[np.bool_]) -> Trajectory:
    """Replace unknown poses by interpolating between known poses with constant velocity.

    Args:
        known: ``(N,)`` bool, True for the poses to keep. Poses before the first known pose become
            equal to it. Poses after the last known pose are kept as well.
    """
    T_wc, times = trajectory.T_wc.copy(), trajectory.timestamps
    anchors = np.flatnonzero(known)
    if len(anchors):
        T_wc[: anchors[0]] = T_wc[anchors[0]]
    for before, after in pairwise(anchors.tolist()):
        if after == before + 1:
            continue
        twist = se3_log(orthonormalised(compose(inverse(T_wc[before]), T_wc[after])))
        for k in range(before + 1, after):
            share = (times[k] - times[before]) / (times[after] - times[before])
            T_wc[k] = orthonormalised(compose(T_wc[before], se3_exp(twist * share)))
    return Trajectory(times, T_wc)


def read_table(
    path: Path | str, columns: tuple[int, ...], what: str, max_rows: int | None = None
) -> NDArray[np.float64]:
    """Read a text file of numbers. Blank lines and lines that begin with ``#`` are skipped.

    Args:
        columns: the allowed numbers of columns. All lines must have the same number of columns.
        what: the content of a line, for error messages, such as "a pose".

    Returns:
        ``(N, C)`` float64 with N >= 1, all finite.

    Raises:
        InputError: the file is missing, empty or malformed, or it holds NaN or infinity.
    """
    try:
        lines = Path(path).read_text().splitlines()
    except OSError as error:
        raise InputError(f"{path}: cannot read the file ({error.strerror}).") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file; give one with {what} on each line.") from error
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{path}: line {number}"
        try:
            row = [float(word) for word in words]
        except ValueError as error:
            raise InputError(
                f"{where} is not a row of numbers; repair the line or download the file again."
            ) from error
        wanted = (len(rows[0]),) if rows else columns
        if len(row) not in wanted:
            allowed = " or ".join(map(str, wanted))
            raise InputError(
                f"{where} has {len(row)} numbers where {what} takes {allowed}; "
                "repair the line or download the file again."
            )
        if not np.isfinite(row).all():
            raise InputError(
                f"{where} holds NaN or infinity; repair the line or download the file again."
            )
        rows.append(row)
        if len(rows) == max_rows:
            break
    if not rows:
        raise InputError(f"{path}: the file is empty; it must have {what} on each line.")
    return np.array(rows)


def trajectory_format(path: Path | str) -> Literal["kitti", "tum"]:
    """Determine the format of a trajectory file from the number of columns of its first pose.

    Raises:
        InputError: the file is missing, empty or malformed.
    """
    return _FORMAT_OF_COLUMNS[read_table(path, (12, 8), "a pose", max_rows=1).shape[1]]


def read_kitti_poses(path: Path | str) -> NDArray[np.float64]:
    """Read a KITTI pose file into ``(N, 4, 4)`` float64 ``T_wc``.

    Raises:
        InputError: the file is missing or malformed, or a 3x3 part is not a rotation.
    """
    return _poses_of_rows(path, read_table(path, (12,), "a KITTI pose"))


def read_trajectory(path: Path | str, timestamps: NDArray[np.float64] | None = None) -> Trajectory:
    """Read a KITTI (12 columns) or TUM (8 columns) trajectory.

    Args:
        timestamps: ``(N,)`` timestamps in seconds of the poses of a KITTI file. None uses the frame
            numbers. A TUM file contains timestamps, so this argument is ignored.

    Raises:
        InputError: the file is malformed, the numbers of poses and timestamps differ, a rotation is
            invalid, or the timestamps of a TUM file do not increase.
    """
    rows = read_table(path, (12, 8), "a pose")
    if _FORMAT_OF_COLUMNS[rows.shape[1]] == "kitti":
        if timestamps is None:
            timestamps = np.arange(len(rows), dtype=np.float64)
        elif len(timestamps) != len(rows):
            raise InputError(
                f"{path}: {len(rows)} poses but {len(timestamps)} timestamps; "
                "give the times of exactly these frames."
            )
        return Trajectory(np.asarray(timestamps, np.float64), _poses_of_rows(path, rows))

    from scipy.spatial.transform import Rotation

    if (bad := np.flatnonzero(np.diff(rows[:, 0]) <= 0)).size:
        raise InputError(
            f"{path}: the time of pose {bad[0] + 2} is not later than the one before it; "
            "sort the poses by time."
        )
    if not np.allclose(np.linalg.norm(rows[:, 4:], axis=1), 1.0, atol=_ROTATION_TOLERANCE):
        raise InputError(f"{path}: the length of a quaternion is not 1; normalise qx qy qz qw.")
    T_wc = np.tile(np.eye(4), (len(rows), 1, 1))
    T_wc[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    T_wc[:, :3, 3] = rows[:, 1:4]
    return Trajectory(rows[:, 0], T_wc)


def write_kitti(path: Path | str, T_wc: NDArray[np.float64]) -> None:
    """Write ``(N, 4, 4)`` poses in KITTI's format with 13 significant digits."""
    rows = T_wc[:, :3, :].reshape(-1, 12) + 0.0  # -0 becomes 0, so equal poses give equal bytes
    lines = (" ".join([f"{x:.12e}" for x in row]) + "\n" for row in rows.tolist())
    Path(path).write_text("".join(lines))


def tum_line(timestamp: float, T_wc: NDArray[np.float64]) -> str:
    """Format a ``(4, 4)`` pose as a line of TUM's format."""
    return _tum_lines(np.array([timestamp]), T_wc[None])


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write a trajectory in TUM's format, with nine decimals and qw >= 0."""
    Path(path).write_text(_tum_lines(trajectory.timestamps, trajectory.T_wc))


def _tum_lines(timestamps: NDArray[np.float64], T_wc: NDArray[np.float64]) -> str:
    rows = np.column_stack([timestamps, T_wc[:, :3, 3], quaternions(T_wc[:, :3, :3])]).tolist()
    # Twelve digits keep the norm of the quaternion at 1 within the rounding of the poses.
    digits = (9, 9, 9, 9, 12, 12, 12, 12)
    words = ([f"{x:.{n}f}" for x, n in zip(row, digits, strict=True)] for row in rows)
    return "".join(" ".join(line) + "\n" for line in words)


def write_euroc(path: Path | str, trajectory: Trajectory) -> None:
    """Write a trajectory in the format of EuRoC's ground truth, without velocities and biases.

    Timestamps are written in nanoseconds. If the timestamps are Unix times, their resolution is
    only 0.2 us, because they are stored as float64 seconds.
    """
    names = ("x [m]", "y [m]", "z [m]"), ("w []", "x []", "y []", "z []")
    columns = [*(f"p_RS_R_{name}" for name in names[0]), *(f"q_RS_{name}" for name in names[1])]
    lines = [",".join(["#timestamp [ns]", *columns]) + "\n"]
    q = quaternions(trajectory.T_wc[:, :3, :3])
    rows = np.column_stack([trajectory.T_wc[:, :3, 3], q[:, 3], q[:, :3]])
    for seconds, row in zip(trajectory.timestamps.tolist(), rows.tolist(), strict=True):
        lines.append(",".join([str(round(seconds * 1e9)), *(f"{x:.12f}" for x in row)]) + "\n")
    Path(path).write_text("".join(lines))


def quaternions(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert ``(N, 3, 3)`` rotations to ``(N, 4)`` float64 quaternions x, y, z, w with w >= 0.

    The results are bit-identical to those of SciPy's ``Rotation``. SciPy is not used, because
    importing it takes longer than writing all files of a run. A matrix that deviates from a
    rotation by more than 1e-12 is replaced by the nearest rotation.
    """
    error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3))
    off = (error > 1e-12 + 1e-5 * np.eye(3)).any(axis=(1, 2))
    if off.any():
        U, _, Vt = np.linalg.svd(R[off])
        R = R.copy()
        R[off] = U @ Vt
    return np.array([_quaternion(one) for one in R.tolist()]).reshape(-1, 4)


def _quaternion(R: list[list[float]]) -> list[float]:
    """Convert a rotation. A run converts each pose on its own, so this is no array operation.

    Dividing by the largest of the four components preserves precision (Markley, Journal of
    Guidance, Control and Dynamics, 2008).
    """
    diagonal = [R[0][0], R[1][1], R[2][2]]
    trace = diagonal[0] + diagonal[1] + diagonal[2]
    largest = max(range(4), key=[*diagonal, trace].__getitem__)
    q = [R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1], 1.0 + trace]
    if largest < 3:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        q[3] = R[k][j] - R[j][k]
        q[i] = 1.0 - trace + 2.0 * R[i][i]
        q[j] = R[j][i] + R[i][j]
        q[k] = R[k][i] + R[i][k]
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    # Two quaternions describe a half turn. The quaternion whose first non-zero number is positive
    # is chosen.
    sign = next((x for x in (q[3], *q[:3]) if x), 1.0)
    return [-x / norm if sign < 0 else x / norm for x in q]


def _poses_of_rows(path: Path | str, rows: NDArray[np.float64]) -> NDArray[np.float64]:
    T_wc = np.tile(np.eye(4), (len(rows), 1, 1))
    T_wc[:, :3, :] = rows.reshape(-1, 3, 4)
    R_wc = T_wc[:, :3, :3]
    error = np.abs(R_wc @ R_wc.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((error > _ROTATION_TOLERANCE) | (np.linalg.det(R_wc) < 0))
    if bad.size:
        raise InputError(
            f"{path}: the 3x3 part of pose {bad[0] + 1} is not a rotation; "
            "write the 3x4 rows of T_wc."
        )
    return T_wc
