"""Trajectories with one pose for each frame, and their text formats.

Each line holds one pose:

- KITTI (Geiger et al., CVPR 2012): the upper 3x4 part of ``T_wc``, row by row, without time.
- TUM (Sturm et al., IROS 2012): ``t x y z qx qy qz qw``, with t in seconds and the position in
  metres.
- EuRoC (Burri et al., IJRR 2016): ``t,x,y,z,qw,qx,qy,qz``, with t in nanoseconds. Three velocities,
  or nine velocities and biases, may follow.

The numbers are separated by spaces, tabs, commas or semicolons. The first line may name the
columns.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vslam.support.errors import InputError
from vslam.support.file_kinds import read_text
from vslam.types.geometry import compose, inverse, orthonormalised, se3_exp, se3_log

Format = Literal["kitti", "tum", "euroc"]

_POSE_COLUMNS = (12, 8, 11, 17)
# What a line with this number of numbers probably is, for messages.
_KINDS = {
    3: " (a position without time and orientation)",
    4: " (a time and a position without orientation)",
    7: " (a pose without time)",
    8: " (a time, a position and a quaternion, as in TUM's format)",
    12: " (a 3x4 matrix without time, as in KITTI's format)",
    16: " (a 4x4 matrix)",
    17: " (a state of EuRoC)",
}
_UNITS_S = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "sec": 1.0}
_UNIT_OF_COLUMN = re.compile(r"(?:^|[\[(_ ])(ns|us|ms|s|sec)[\])]?$")
# Seconds from one pose to the next, and seconds since 1970, that a trajectory can have. A file
# whose times exceed these limits uses another unit.
_STEPS_S = (5e-4, 10.0)
_LATEST_S = 1e10  # the year 2286

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


@dataclass(frozen=True)
class _Table:
    """The numbers of a text file.

    Attributes:
        rows: ``(N, C)`` float64, N >= 1, all finite.
        names: the names of the columns. Empty if no line before the first row names them.
        commas: whether the first row is separated by commas or semicolons.
        whole: whether the first number of the first row is written as a whole number.
    """

    rows: NDArray[np.float64]
    names: tuple[str, ...]
    commas: bool
    whole: bool


def read_table(
    path: Path | str, columns: tuple[int, ...], what: str, max_rows: int | None = None
) -> NDArray[np.float64]:
    """Read a text file of numbers, which are separated by spaces, tabs, commas or semicolons.

    Blank lines and lines that begin with ``#`` are skipped, and so is a first line without any
    number, which names the columns.

    Args:
        columns: the allowed numbers of columns. All lines must have the same number of columns.
        what: the content of a line, for error messages, such as "a pose".

    Returns:
        ``(N, C)`` float64 with N >= 1, all finite.

    Raises:
        InputError: the file is missing, empty, malformed or of another kind, or it holds NaN or
            infinity.
    """
    return _read_table(path, columns, what, max_rows).rows


def _read_table(
    path: Path | str, columns: tuple[int, ...], what: str, max_rows: int | None = None
) -> _Table:
    lines = read_text(Path(path), f"a file with {what} on each line").splitlines()
    rows: list[list[float]] = []
    names: list[str] = []
    first = ""
    again = "repair the line or download the file again"
    for number, line in enumerate(lines, start=1):
        words = _words(line)
        if not words:
            continue
        if line.lstrip().startswith("#"):
            names = names if rows else _column_names(line)
            continue
        first = first or line.strip()
        if first == line.strip() and not any(map(_is_number, words)):
            names = _column_names(line)
            continue
        where = f"{path}: line {number}"
        fix = again if rows else f"give a file with {what} on each line"
        if not all(map(_is_number, words)):
            raise InputError(f"{where} is not a row of numbers; {fix}.")
        row = [float(word) for word in words]
        if len(row) not in ((len(rows[0]),) if rows else columns):
            allowed = str(len(rows[0])) if rows else _any_of(columns)
            kind = _KINDS.get(len(row), "") if "pose" in what and not rows else ""
            raise InputError(
                f"{where} has {len(row)} numbers{kind} where {what} takes {allowed}; {fix}."
            )
        if not np.isfinite(row).all():
            raise InputError(f"{where} holds NaN or infinity; correct or remove the line.")
        if not rows:
            commas, whole = "," in line or ";" in line, words[0].isdecimal()
        rows.append(row)
        if len(rows) == max_rows:
            break
    if not rows:
        held = f'has no numbers (it begins with "{first[:40]}")' if first else "is empty"
        raise InputError(f"{path}: the file {held}; it must have {what} on each line.")
    return _Table(np.array(rows), tuple(names), commas, whole)


def _words(line: str) -> list[str]:
    """Split a line at spaces, commas and semicolons."""
    return re.sub("[,;]", " ", line).split()


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _any_of(numbers: tuple[int, ...]) -> str:
    *others, last = map(str, numbers)
    return f"{', '.join(others)} or {last}" if others else last


def _column_names(line: str) -> list[str]:
    """Return the names of the columns in lower case, or an empty list for another comment."""
    line = line.strip().lstrip("#").lower()
    names = re.split("[,;]", line) if re.search("[,;]", line) else line.split()
    return [name.strip() for name in names]


def trajectory_format(path: Path | str) -> Format:
    """Determine the format of a trajectory file from its first pose and the names of its columns.

    Raises:
        InputError: the file is missing, empty, malformed or of another kind.
    """
    return _format(_read_table(path, _POSE_COLUMNS, "a pose", max_rows=2))


def _format(table: _Table) -> Format:
    n = table.rows.shape[1]
    if n != 8:
        return "kitti" if n == 12 else "euroc"
    if len(table.names) == n:  # the part in brackets is the unit
        quaternion = [re.sub(r"[\[(].*", "", name).strip() for name in table.names[4:]]
        if quaternion[0].endswith("w"):
            return "euroc"
        if quaternion[3].endswith("w"):
            return "tum"
    nanoseconds = table.whole and could_be_seconds(1e-9 * table.rows[:2, 0])
    return "euroc" if table.commas and nanoseconds else "tum"


def read_kitti_poses(path: Path | str) -> NDArray[np.float64]:
    """Read a KITTI pose file into ``(N, 4, 4)`` float64 ``T_wc``.

    Raises:
        InputError: the file is missing or malformed, or a 3x3 part is not a rotation.
    """
    return _poses_of_rows(path, read_table(path, (12,), "a KITTI pose"))


def read_trajectory(path: Path | str, timestamps: NDArray[np.float64] | None = None) -> Trajectory:
    """Read a trajectory in the format of KITTI (12 columns), TUM (8) or EuRoC (8, 11 or 17).

    A file with 8 columns is EuRoC's if the names of its columns say that the quaternion begins with
    w. If no line names the columns, it is EuRoC's if its columns are separated by commas and its
    times are whole numbers of nanoseconds. The poses are returned as they are in the file: EuRoC's
    ground truth contains poses of the body (IMU), not of a camera.

    Args:
        timestamps: ``(N,)`` timestamps in seconds of the poses of a KITTI file. None uses the frame
            numbers. The other formats contain timestamps, so this argument is ignored.

    Raises:
        InputError: the file is malformed, the numbers of poses and timestamps differ, a rotation is
            invalid, or the timestamps do not increase.
    """
    table = _read_table(path, _POSE_COLUMNS, "a pose")
    rows, format_ = table.rows, _format(table)
    if format_ == "kitti":
        if timestamps is None:
            timestamps = np.arange(len(rows), dtype=np.float64)
        elif len(timestamps) != len(rows):
            raise InputError(
                f"{path}: {len(rows)} poses but {len(timestamps)} timestamps; "
                "give the times of exactly these frames."
            )
        return Trajectory(np.asarray(timestamps, np.float64), _poses_of_rows(path, rows))

    from scipy.spatial.transform import Rotation

    step = np.diff(rows[:, 0])
    if (bad := np.flatnonzero(step <= 0)).size:
        fix = "sort the poses by time" if (step < 0).any() else "remove one of them"
        raise InputError(
            f"{path}: the time of pose {bad[0] + 2} is not later than the one before it; {fix}."
        )
    if not np.allclose(np.linalg.norm(rows[:, 4:8], axis=1), 1.0, atol=_ROTATION_TOLERANCE):
        order = "qx qy qz qw" if format_ == "tum" else "qw qx qy qz"
        raise InputError(f"{path}: the length of a quaternion is not 1; normalise {order}.")
    T_wc = np.tile(np.eye(4), (len(rows), 1, 1))
    T_wc[:, :3, :3] = Rotation.from_quat(rows[:, 4:8], scalar_first=format_ == "euroc").as_matrix()
    T_wc[:, :3, 3] = rows[:, 1:4]
    return Trajectory(rows[:, 0] * _unit_s(table, format_), T_wc)


def could_be_seconds(times: NDArray[np.float64]) -> bool:
    """Return whether ``(N,)`` increasing times can be those of a trajectory in seconds.

    They cannot if they are after the year 2286, or if the median step is below 0.5 ms or above
    10 s.
    """
    if abs(times[-1]) > _LATEST_S:
        return False
    return len(times) < 2 or _STEPS_S[0] <= float(np.median(np.diff(times))) <= _STEPS_S[1]


def _unit_s(table: _Table, format_: Format) -> float:
    """Return the unit of the times in seconds: the unit in the name of the first column, or the
    unit of the format."""
    if len(table.names) == table.rows.shape[1] and (
        named := _UNIT_OF_COLUMN.search(table.names[0])
    ):
        return _UNITS_S[named[1]]
    nanoseconds = format_ == "euroc" and could_be_seconds(1e-9 * table.rows[:, 0])
    return 1e-9 if nanoseconds else 1.0


def write_kitti(path: Path | str, T_wc: NDArray[np.float64]) -> None:
    """Write ``(N, 4, 4)`` poses in KITTI's format with 13 significant digits."""
    rows = T_wc[:, :3, :].reshape(-1, 12) + 0.0  # -0 becomes 0, so equal poses give equal bytes
    lines = (" ".join([f"{x:.12e}" for x in row]) + "\n" for row in rows.tolist())
    Path(path).write_text("".join(lines))


def tum_line(timestamp: float, T_wc: NDArray[np.float64]) -> str:
    """Format a ``(4, 4)`` pose as a line of TUM's format."""
    return _tum_lines(np.array([timestamp]), T_wc[None])


def write_tum(path: Path | str, trajectory: Trajectory, remarks: Sequence[str] = ()) -> None:
    """Write a trajectory in TUM's format, with nine decimals and qw >= 0.

    Each of the remarks becomes a comment line at the top.
    """
    comments = "".join(f"# {remark}\n" for remark in remarks)
    Path(path).write_text(comments + _tum_lines(trajectory.timestamps, trajectory.T_wc))


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
    mirrored = np.linalg.det(R_wc) < 0
    bad = np.flatnonzero((error > _ROTATION_TOLERANCE) | mirrored)
    if bad.size and (error <= _ROTATION_TOLERANCE).all() and mirrored.all():
        raise InputError(
            f"{path}: the 3x3 part of pose 1 is not a rotation but a reflection; the poses are "
            "mirrored (left-handed), so convert them to right-handed coordinates."
        )
    if bad.size:
        raise InputError(
            f"{path}: the 3x3 part of pose {bad[0] + 1} is not a rotation; "
            "write the 3x4 rows of T_wc."
        )
    return T_wc
