"""Computes error metrics of a trajectory: ATE, RPE and KITTI's drift.

The metrics have their usual definitions. The package evo (Grupp, 2017) computes ATE and RPE.
Therefore, the command line of evo gives the same values. Only this module imports evo.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.association import (
    MAX_TIME_DIFFERENCE_S,
    common_units,
    poses_at,
    said_of_clocks,
    said_of_unit,
)
from vslam.datasets.times import read_times
from vslam.support.errors import InputError, counted
from vslam.types.trajectory import (
    Format,
    Trajectory,
    read_trajectory,
    trajectory_format,
)

_LENGTHS_M = np.arange(100.0, 801.0, 100.0)
_STEP_FRAMES = 10
_WRONG_SCALE = 1.2  # smallest factor that is reported; drift changes the scale by a few per cent
_LEFT_OVER = 0.3  # largest share of the error, and of the size of the path, after a correction
_LEAST_MIRRORED = 0.01  # smallest error of a mirrored path that is reported, in sizes of the path
# The turns of a path are compared in this many parts, if their root of squares reaches a limit, and
# if the path is this many times as wide as its error, so that the alignment is certain.
_PARTS, _LEAST_TURN_RAD, _CLEAR_OF_A_LINE = 50, 0.2, 5.0
_CHECK_SCALE = {
    "rgbd": "check the depth scale (--depth-scale)",
    "stereo": "check the baseline, and that the calibration is for images of this size",
    None: "check the calibration of the camera, or align with --align sim3 if it is monocular",
}
_EVO_FLAGS = {"se3": " --align", "sim3": " --align --correct_scale", "none": ""}


@dataclass(frozen=True)
class Evaluation:
    """Errors of an estimated trajectory relative to the ground truth, computed from N frames.

    Attributes:
        frames: number N of compared frames.
        alignment: ``se3``, ``sim3`` or ``none``, the kind of transformation that was fitted before
            the comparison.
        on_one_line: whether all positions lie on one line. Positions on a line do not determine the
            rotation about the line, so that this rotation was fitted to the orientations. evo
            rejects such trajectories.
        timestamps: ``(N,)`` timestamps of the estimate in seconds.
        ate_rmse_m, ate_mean_m, ate_max_m: RMSE, mean and maximum of ``errors_m``.
        errors_m: ``(N,)`` distance of each aligned position from the ground truth, in metres.
        T_wc_aligned: ``(N, 4, 4)`` poses of the estimate, aligned with the ground truth.
        distances_m: ``(N,)`` path length along the ground truth up to each frame, in metres.
        rpe_m, rpe_deg: RMSE of the translation (metres) and the rotation (degrees) from one frame
            to the next.
        t_rel_percent, r_rel_deg_per_100m: KITTI's drift over 100 to 800 m. None if the path is
            shorter than 100 m.
        interpolated: number of frames whose ground truth was interpolated.
        times_as_large: how many times as large as the ground truth the trajectory is, if another
            scale explains most of the error. None otherwise, and if the alignment fits a scale.
        warnings: sentences about the ground truth: that it is mirrored, or that its times are read
            in another unit.
    """

    frames: int
    alignment: str
    on_one_line: bool
    timestamps: NDArray[np.float64]
    ate_rmse_m: float
    ate_mean_m: float
    ate_max_m: float
    errors_m: NDArray[np.float64]
    T_wc_aligned: NDArray[np.float64]
    distances_m: NDArray[np.float64]
    rpe_m: float
    rpe_deg: float
    t_rel_percent: float | None
    r_rel_deg_per_100m: float | None
    interpolated: int
    times_as_large: float | None
    warnings: tuple[str, ...]

    def summary(self) -> dict[str, float | int | str | None]:
        """Return the fields that are not arrays, for JSON."""
        return {
            name: value for name, value in vars(self).items() if not isinstance(value, np.ndarray)
        }


def evaluate_trajectory(
    estimate: Trajectory, ground_truth: Trajectory, alignment: str = "se3"
) -> Evaluation:
    """Compare an estimated trajectory with the ground truth.

    Each frame of the estimate is compared with the ground truth that
    `vslam.datasets.association.poses_at` gives it, as in a run. If the times of the two
    trajectories agree only in other units than seconds, they are read in these units.

    ATE is the RMSE of the positions [Sturm et al., IROS 2012] after alignment by Umeyama's method
    (TPAMI 1991). RPE is computed from one frame to the next. KITTI's drift is computed by
    `kitti_drift`.

    Args:
        alignment: ``se3`` fits no scale, ``sim3`` fits a scale, and ``none`` fits nothing.

    Raises:
        InputError: the alignment is unknown, the trajectories have no common frames, or the camera
            hardly moves in them.
    """
    pair, aligned, reference, on_one_line = _aligned_pair(estimate, ground_truth, alignment)
    errors = _position_errors(aligned, reference)
    rpe_m, rpe_deg = _relative_errors(aligned, reference)
    T_wc_aligned, T_wc_true = np.array(aligned.poses_se3), np.array(reference.poses_se3)
    t_rel, r_rel = kitti_drift(T_wc_aligned, T_wc_true) or (None, None)
    return Evaluation(
        frames=len(errors),
        alignment=alignment,
        on_one_line=on_one_line,
        timestamps=pair.estimate.timestamps,
        ate_rmse_m=_rmse(errors),
        ate_mean_m=float(errors.mean()),
        ate_max_m=float(errors.max()),
        errors_m=errors,
        T_wc_aligned=T_wc_aligned,
        distances_m=path_length(T_wc_true),
        rpe_m=_rmse(rpe_m),
        rpe_deg=_rmse(rpe_deg),
        t_rel_percent=t_rel,
        r_rel_deg_per_100m=r_rel,
        interpolated=pair.interpolated,
        times_as_large=None if alignment == "sim3" else _wrong_scale(T_wc_aligned, T_wc_true),
        warnings=(*pair.warnings, *_mirrored(T_wc_aligned, T_wc_true)),
    )


def ate_rmse(estimate: Trajectory, ground_truth: Trajectory, alignment: str = "se3") -> float:
    """Compute only the ATE of ``evaluate_trajectory``, in metres.

    Raises:
        InputError: see ``evaluate_trajectory``.
    """
    _, aligned, reference, _ = _aligned_pair(estimate, ground_truth, alignment)
    return _rmse(_position_errors(aligned, reference))


def _aligned_pair(
    estimate: Trajectory, ground_truth: Trajectory, alignment: str
) -> tuple[_Pair, Any, Any, bool]:
    """Find the common frames of two trajectories, and align the estimate with the ground truth.

    Returns:
        The common frames, the aligned estimate and the ground truth at these frames as evo's
        trajectories, and whether the positions lie on one line.
    """
    from evo import EvoException
    from evo.core.trajectory import PoseTrajectory3D

    if alignment not in _EVO_FLAGS:
        raise InputError(
            f"--align {alignment}: unknown alignment; choose one of {', '.join(_EVO_FLAGS)}."
        )
    pair = _associate(estimate, ground_truth)
    aligned, reference = (
        PoseTrajectory3D(poses_se3=list(t.T_wc), timestamps=t.timestamps)
        for t in (pair.estimate, pair.ground_truth)
    )
    too_still = InputError(
        f"{counted(len(pair.estimate), 'frame')} with too little motion to compare; the camera "
        "must move between two frames."
    )
    if len(pair.estimate) < 2:
        raise too_still
    try:
        on_one_line = alignment != "none" and _align(aligned, reference, alignment == "sim3")
    except EvoException as error:
        raise too_still from error
    return pair, aligned, reference, on_one_line


def _position_errors(aligned: Any, reference: Any) -> NDArray[np.float64]:
    """Return the distances between the positions of two evo trajectories, ``(N,)`` metres."""
    from evo.core.metrics import APE, PoseRelation

    ape = APE(PoseRelation.translation_part)
    ape.process_data((reference, aligned))
    return np.asarray(ape.error)


def _relative_errors(
    aligned: Any, reference: Any
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the errors of the motion from one frame to the next.

    Returns:
        ``(N - 1,)`` metres and ``(N - 1,)`` degrees.
    """
    from evo.core.metrics import RPE, PoseRelation
    from scipy.spatial.transform import Rotation

    rpe = RPE(PoseRelation.translation_part)
    rpe.process_data((reference, aligned))
    # A second RPE of evo would compute the same motions again, and convert one rotation at a time.
    rotations = Rotation.from_matrix(np.array(rpe.E)[:, :3, :3])
    return np.asarray(rpe.error), np.degrees(rotations.magnitude())


def _align(estimate: Any, reference: Any, with_scale: bool) -> bool:
    """Align an evo trajectory in place, and return whether its positions lie on one line."""
    from evo import EvoException
    from evo.core.geometry import umeyama_alignment
    from evo.core.lie_algebra import se3

    try:
        estimate.align(reference, correct_scale=with_scale)
    except EvoException:
        # Positions on a line do not determine the rotation about the line.
        rotation, translation, scale = umeyama_alignment(
            _with_axes(estimate), _with_axes(reference), with_scale
        )
        if with_scale:
            estimate.scale(scale)
        estimate.transform(se3(rotation, translation))
        return True
    return False


def _with_axes(trajectory: Any) -> NDArray[np.float64]:
    """Return the positions of N poses, and two more points for each pose, as ``(3, 3N)``.

    One point lies to the right of the camera, and one point lies below the camera.
    """
    T_wc = np.array(trajectory.poses_se3)
    position = T_wc[:, :3, 3]
    short = 1e-3 * np.linalg.norm(position.std(axis=0))
    ends = [position + short * T_wc[:, :3, axis] for axis in range(2)]
    return np.concatenate([position, *ends]).T


def path_length(T_wc: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ``(N,)`` distances in metres along the path up to each ``(N, 4, 4)`` pose."""
    steps = np.linalg.norm(np.diff(T_wc[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def kitti_drift(
    T_wc: NDArray[np.float64], T_wc_ground_truth: NDArray[np.float64]
) -> tuple[float, float] | None:
    """Compute the average drift over segments of 100 to 800 m, as in the KITTI development kit.

    Segments of 100, 200, ..., 800 m start at every tenth frame. A segment ends at the first frame
    at which the true path is longer than the length of the segment. The error of the motion over a
    segment is divided by the length of the segment [Geiger et al., CVPR 2012].

    Args:
        T_wc: ``(N, 4, 4)`` estimate.
        T_wc_ground_truth: ``(N, 4, 4)`` ground truth of the same frames.

    Returns:
        ``t_rel`` in percent and ``r_rel`` in degrees per 100 m. None if the path is shorter than
        100 m.
    """
    distances = path_length(T_wc_ground_truth)
    starts = np.arange(0, len(distances), _STEP_FRAMES)
    first, length = (grid.ravel() for grid in np.meshgrid(starts, _LENGTHS_M, indexing="ij"))
    last = np.searchsorted(distances, distances[first] + length, side="right")
    inside = last < len(distances)
    if not inside.any():
        return None
    first, last, length = first[inside], last[inside], length[inside]
    motion = np.linalg.inv(T_wc[first]) @ T_wc[last]
    true_motion = np.linalg.inv(T_wc_ground_truth[first]) @ T_wc_ground_truth[last]
    error = np.linalg.inv(motion) @ true_motion
    cosine = (np.trace(error[:, :3, :3], axis1=1, axis2=2) - 1.0) / 2.0
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    shift = np.linalg.norm(error[:, :3, 3], axis=1)
    return float(100.0 * (shift / length).mean()), float(100.0 * (angle / length).mean())


def read_pair(
    estimate: Path | str, ground_truth: Path | str, times: Path | str | None = None
) -> tuple[Trajectory, Trajectory]:
    """Read an estimated trajectory and its ground truth, each in the format of KITTI, TUM or EuRoC.

    Args:
        times: file with the timestamp of each frame, one per line (``times.txt``). This
            file is needed for files in KITTI's format, which contain no timestamps.

    Raises:
        InputError: a file is malformed, or the files cannot be matched without timestamps.
    """
    timestamps = None if times is None else read_times(Path(times))
    if timestamps is not None and (np.diff(timestamps) <= 0).any():
        raise InputError(f"{times}: the times do not increase; give the times of the frames.")
    formats = {trajectory_format(estimate), trajectory_format(ground_truth)}
    if timestamps is None and "kitti" in formats and len(formats) == 2:
        raise InputError(
            f"{estimate} and {ground_truth}: one is a KITTI file, which has no times; "
            "give its times with --times, or give two KITTI files."
        )
    pair = read_trajectory(estimate, timestamps), read_trajectory(ground_truth, timestamps)
    if timestamps is None and formats == {"kitti"} and len(pair[0]) != len(pair[1]):
        raise InputError(
            f"{estimate}: {len(pair[0])} poses but {len(pair[1])} in {ground_truth}; use "
            "ground_truth_kitti.txt from the run folder, or the run's TUM file with --times."
        )
    return pair


def evo_command(
    estimate: Path | str, ground_truth: Path | str, alignment: str, format_: Format
) -> str:
    """Return the ``evo_ape`` command that computes the ATE of two files of the same format."""
    files = shlex.join([str(ground_truth), str(estimate)])
    return f"evo_ape {format_} {files}{_EVO_FLAGS[alignment]}"


def command_of_evo(
    estimate: Path | str, ground_truth: Path | str, evaluation: Evaluation
) -> str | None:
    """Return the ``evo_ape`` command that reproduces an evaluation of two files.

    None if evo cannot read or align the files, or would compare other poses.
    """
    files = estimate, ground_truth
    formats = {trajectory_format(path) for path in files}
    otherwise = evaluation.on_one_line or evaluation.interpolated or evaluation.warnings
    if otherwise or formats not in ({"kitti"}, {"tum"}) or not all(map(_is_plain, files)):
        return None
    return evo_command(*files, evaluation.alignment, formats.pop())


def _is_plain(path: Path | str) -> bool:
    """Return whether evo can read a trajectory: it is ASCII, its numbers are separated by spaces,
    and all other lines are comments."""
    data = Path(path).read_bytes()
    if not data.isascii():
        return False
    lines = data.decode("ascii").splitlines()
    first = next(line for line in lines if line.strip() and not line.startswith("#"))
    return "," not in first and ";" not in first and any(map(str.isdecimal, first.split()[0]))


@dataclass(frozen=True)
class _Pair:
    """The common frames of an estimate and its ground truth, at the times of the estimate."""

    estimate: Trajectory
    ground_truth: Trajectory
    interpolated: int
    warnings: tuple[str, ...]


def _associate(estimate: Trajectory, ground_truth: Trajectory) -> _Pair:
    names = "the trajectory", "the ground truth"
    units = common_units(estimate.timestamps, ground_truth.timestamps)
    warnings = tuple(
        said_of_unit(name, unit, other) + "."
        for name, unit, other in zip(names, units, names[::-1], strict=True)
        if unit != 1.0
    )
    times, true_times = units[0] * estimate.timestamps, units[1] * ground_truth.timestamps
    T_wc, between = poses_at(Trajectory(true_times, ground_truth.T_wc), times)
    known = np.flatnonzero(np.isfinite(T_wc).all((1, 2)))
    if not len(known):
        own, true = "the times of the trajectory", "those of the ground truth"
        raise InputError(
            f"none of the {len(estimate)} poses lies within {1000 * MAX_TIME_DIFFERENCE_S:.0f} ms "
            f"of any of the {len(ground_truth)} poses of the ground truth: "
            f"{said_of_clocks(own, times, true, true_times)}."
        )
    return _Pair(
        Trajectory(times, estimate.T_wc).select(known),
        Trajectory(times, T_wc).select(known),
        int(np.count_nonzero(between)),
        warnings,
    )


def evaluation_warnings(evaluation: Evaluation | None, sensor: str | None = None) -> list[str]:
    """Return all warnings about the comparison of a trajectory with its ground truth.

    Args:
        sensor: ``stereo``, ``rgbd`` or ``mono``. None if it is unknown.
    """
    if evaluation is None:
        return []
    factor, check = evaluation.times_as_large, _CHECK_SCALE.get(sensor, _CHECK_SCALE[None])
    if factor is None:
        return list(evaluation.warnings)
    scale = f"the trajectory is {factor:.2g} times as large as the ground truth: {check}"
    return [*evaluation.warnings, scale]


def _wrong_scale(aligned: NDArray[np.float64], true: NDArray[np.float64]) -> float | None:
    """Return how many times as large as the ground truth a trajectory is, or None if another scale
    does not explain most of the error. Both are ``(N, 4, 4)`` poses."""
    estimate, truth = (T_wc[:, :3, 3] - T_wc[:, :3, 3].mean(axis=0) for T_wc in (aligned, true))
    scale = float(np.sum(estimate * truth) / max(np.sum(estimate**2), 1e-12))
    error, size, left = (
        np.linalg.norm(x) for x in (truth - estimate, truth, truth - scale * estimate)
    )
    if 1.0 / _WRONG_SCALE < scale < _WRONG_SCALE or left > _LEFT_OVER * min(error, size):
        return None
    return 1.0 / scale


def _mirrored(aligned: NDArray[np.float64], true: NDArray[np.float64]) -> list[str]:
    """Return a warning if a trajectory fits the mirror image of its ground truth.

    A path in a plane is its own mirror image, because half a turn replaces the reflection. In this
    case, the turns of the camera tell whether only the positions are mirrored.
    """
    estimate, truth = (T_wc[:, :3, 3] - T_wc[:, :3, 3].mean(axis=0) for T_wc in (aligned, true))
    U, d, Vt = np.linalg.svd(truth.T @ estimate)
    proper = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    size, spread = np.sum(truth**2), max(np.sum(estimate**2), 1e-12)
    # Residuals, as RMS, of Umeyama's alignment with a scale: by a rotation, and by a reflection.
    error, left = (
        float(np.sqrt(max(size - (d @ signs) ** 2 / spread, 0.0) / len(truth)))
        for signs in (proper, proper * [1.0, 1.0, -1.0])
    )
    fix = "convert left-handed poses to right-handed ones, for example by negating y, qx and qz"
    if error > _LEAST_MIRRORED * np.sqrt(size / len(truth)) and left < _LEFT_OVER * error:
        return [
            f"the ground truth is a mirror image of the trajectory, with an error of {left:.2g} m "
            f"instead of {error:.2g} m after a reflection: {fix}"
        ]
    if d[1] < (_CLEAR_OF_A_LINE * error) ** 2 * len(truth):
        return []  # the rotation about the line is unknown
    step = max(len(true) // _PARTS, 1)
    turns, true_turns = (_turns(T_wc[::step, :3, :3]) for T_wc in (aligned, true))
    turns = turns @ (U * proper @ Vt).T
    strength = np.linalg.norm(turns), np.linalg.norm(true_turns)
    if min(strength) < _LEAST_TURN_RAD or np.sum(turns * true_turns) > -0.5 * np.prod(strength):
        return []
    return [
        "the ground truth turns against the trajectory on the same path, so its positions are "
        f"mirrored or its rotations inverted: {fix}, and write poses from camera to world"
    ]


def _turns(R_wc: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation vectors between successive ``(N, 3, 3)`` rotations in the world frame."""
    from scipy.spatial.transform import Rotation

    R = Rotation.from_matrix(R_wc)
    return np.asarray((R[1:] * R[:-1].inv()).as_rotvec())


def _rmse(errors: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(errors**2)))
