"""Measures errors of odometry over short motions, and compares them with the covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.types.features import TrackingState, TrackResult
from vslam.types.geometry import Matrix, inverse, orthonormalised, se3_log
from vslam.types.odometry import PoseUncertainty, relative_covariance
from vslam.types.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class MotionErrors:
    """Errors of M estimated motions of the camera. All motions have about the same duration.

    Attributes:
        first: ``(M,)`` int64, index of the frame in which each motion begins.
        xi: ``(M, 6)`` errors in metres and radians, in the camera frame at the end of the motion.
            The true motion is ``exp(xi) T_last_first``.
        covariance: ``(M, 6, 6)`` predicted covariances of ``xi``, from ``relative_covariance``.
    """

    first: NDArray[np.int64]
    xi: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @property
    def nees(self) -> NDArray[np.float64]:
        """``(M,)`` normalised estimation errors squared (NEES), divided by 6 degrees of freedom.

        The mean of these values is 1 if the covariances are right (Bar-Shalom et al., Estimation
        with Applications to Tracking and Navigation, 2001, 5.4).
        """
        solved = np.linalg.solve(self.covariance, self.xi[:, :, None])[:, :, 0]
        return np.asarray((self.xi * solved).sum(axis=1) / 6.0, np.float64)

    @property
    def distance(self) -> NDArray[np.float64]:
        """``(M,)`` errors of the translation in metres."""
        return np.asarray(np.linalg.norm(self.xi[:, :3], axis=1), np.float64)

    @property
    def sigma(self) -> NDArray[np.float64]:
        """``(M,)`` predicted standard deviations of the translation in metres."""
        return np.asarray(np.sqrt(np.trace(self.covariance[:, :3, :3], axis1=1, axis2=2)))


def motion_errors(
    tracks: Sequence[TrackResult], truth: Trajectory, interval_s: float
) -> MotionErrors:
    """Compare the motions that odometry estimated with the true motions.

    Args:
        tracks: result of tracking each frame. Frames without an uncertainty or without a true pose
            are not used.
        truth: true poses at the times of some or all frames.
        interval_s: least duration of a motion in seconds. Each motion ends at the first frame that
            is at least ``interval_s`` later than its first frame.
    """
    usable = _usable(tracks, truth)
    times = np.array([track.timestamp for track, _, _ in usable])
    last = np.searchsorted(times, times + interval_s).tolist()
    pairs = [(usable[i], usable[j]) for i, j in enumerate(last) if j < len(usable)]
    return _errors(pairs, truth)


def carried_errors(tracks: Sequence[TrackResult], truth: Trajectory) -> MotionErrors:
    """Compare the motions through which an IMU has carried the camera with the true motions.

    There is a motion for each frame in the state ``INERTIAL``. It begins at the last frame that was
    tracked.

    Args:
        tracks, truth: as for ``motion_errors``.
    """
    pairs: list[tuple[_Pose, _Pose]] = []
    before: _Pose | None = None
    for pose in _usable(tracks, truth):
        state = pose[0].state
        if state != TrackingState.INERTIAL:
            before = pose if state in (TrackingState.OK, TrackingState.WEAK) else None
        elif before is not None:
            pairs.append((before, pose))
    return _errors(pairs, truth)


_Pose = tuple[TrackResult, Matrix, PoseUncertainty]  # with ``T_odom_camera``


def _usable(tracks: Sequence[TrackResult], truth: Trajectory) -> list[_Pose]:
    known = set(truth.timestamps.tolist())
    return [
        (track, track.T_odom_camera, track.uncertainty)
        for track in tracks
        if track.timestamp in known
        and track.T_odom_camera is not None
        and track.uncertainty is not None
    ]


def _errors(pairs: Sequence[tuple[_Pose, _Pose]], truth: Trajectory) -> MotionErrors:
    true_pose = dict(zip(truth.timestamps.tolist(), truth.T_wc, strict=True))
    first: list[int] = []
    xi: list[Matrix] = []
    covariance: list[Matrix] = []
    for (one, T_first, uncertainty_first), (other, T_last, uncertainty_last) in pairs:
        T_last_first = inverse(T_last) @ T_first
        T_true = inverse(true_pose[other.timestamp]) @ true_pose[one.timestamp]
        first.append(one.index)
        xi.append(se3_log(orthonormalised(T_true @ inverse(T_last_first))))
        covariance.append(relative_covariance(uncertainty_first, uncertainty_last, T_last_first))
    return MotionErrors(
        np.array(first, np.int64),
        np.array(xi, np.float64).reshape(-1, 6),
        np.array(covariance, np.float64).reshape(-1, 6, 6),
    )
