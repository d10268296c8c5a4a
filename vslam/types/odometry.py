"""Odometry: poses that drift but never jump, and the uncertainty of each pose.

The pose of the camera in the map jumps when a loop is closed or the camera is relocalised. The
controller of a robot needs poses that do not jump, in the frame that ROS calls ``odom`` (REP 105).

The error of a pose has two parts. The *local* error is the error of the camera pose relative to the
landmarks around the camera. It is independent in every frame. The *drift* is the error of these
landmarks relative to the start of the drive. The drift grows with every keyframe, because new
landmarks inherit the error of the keyframe from which they are mapped. Consecutive keyframes share
landmarks, so their errors are correlated. Therefore, the drift grows like a random walk with
correlated steps (a first-order autoregressive process).

A stereo camera adds a third part. The disparity offset of the camera is estimated during the drive
(``backend/disparity_offset.py``). Because of an error in this estimate, all estimated motions are
too long or too short by the same factor. Unlike the random steps of the drift, these errors do not
partly cancel each other.

While the camera is lost, its motion is only predicted. The odometry pose never catches up with the
true pose, even if the camera is relocalised in the map. Therefore, the error of the prediction is a
fourth part, which stays in the poses of all later frames.

A covariance describes the error ``xi = [v, w]`` of a pose, in metres and radians, in the frame of
the camera. If ``T_cw`` is the estimated pose, the true pose is ``exp(xi) T_cw``. The covariance
describes odometry alone. It does not take into account that loop closures reduce the drift, or that
the scale of a monocular map is unknown. It also ignores all errors of the calibration except the
disparity offset.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vslam.types.geometry import Matrix, adjoint, inverse, orthonormalised, se3_exp, se3_log

# DRIFT multiplies the computed covariance of the drift. CORRELATION is the correlation of
# consecutive steps of the drift. Both were tuned on three rendered drives so that the squared
# errors over intervals of 1 s and 10 s match the covariances. They were tested on other drives
# (docs/research/uncertainty.md).
DRIFT, CORRELATION = 1.4, 0.4
# The same for a sum over many keyframes, as a multiple of the covariance of one.
KEYFRAME_DRIFT = DRIFT * (1.0 + CORRELATION) / (1.0 - CORRELATION)
# Standard deviations, for each axis, of a motion that is predicted with constant velocity: the
# acceleration in m/s^2 and rad/s^2, the largest change of the turn rate in rad/s, the rotation in
# rad if nothing is known, and the speed in m/s if it is unknown. For predictions over 0.2 to 16 s
# along KITTI 00, 01, 06 and 07, rendered routes and a hand-held camera (TUM fr1/desk), the RMS
# error is 0.1 to 1.5 times the resulting deviation, except for the turns of the hand-held camera
# within 0.2 s (3 times). The errors of vehicles that begin to turn are about twice as large.
ACCELERATION, TURNING, TURN_RATE, ANY_ROTATION, ANY_SPEED = 1.0, 1.0, 0.3, 1.0, 10.0

N_NUMBERS = 70  # length of ``PoseUncertainty.numbers``
_STEPS = 32  # into which ``predicted_covariance`` divides a motion
_UPPER = np.triu_indices(6)


@dataclass(frozen=True, eq=False)
class PoseUncertainty:
    """The uncertainty of a pose.

    Attributes:
        local: ``(6, 6)`` covariance of the pose relative to the landmarks around the camera, from
            ``pose_covariance``.
        drift: ``(6, 6)`` sum of the covariances ``local`` of all keyframes since the start of the
            drive.
        n_keyframes: number of these keyframes.
        offset: ``(6,)`` error of the pose relative to the start of the drive, if the disparity
            offset is wrong by one standard deviation.
        gaps: ``(6, 6)`` sum of the covariances of the predicted motions since the start of the
            drive, during which the camera was lost. While the camera is lost, ``local`` contains
            the covariance of the present one.
    """

    local: Matrix
    drift: Matrix
    n_keyframes: int
    offset: Matrix = field(default_factory=lambda: np.zeros(6))
    gaps: Matrix = field(default_factory=lambda: np.zeros((6, 6)))

    def numbers(self) -> NDArray[np.float64]:
        """Return the attributes as a ``(70,)`` array.

        The array holds the upper triangles of ``gaps``, ``local`` and ``drift``, then ``offset``
        and ``n_keyframes``. ``of_numbers`` is the inverse.
        """
        three = (matrix[_UPPER] for matrix in (self.gaps, self.local, self.drift))
        return np.array([*np.concatenate([*three]), *self.offset, self.n_keyframes])

    @classmethod
    def of_numbers(cls, numbers: NDArray[np.float64]) -> PoseUncertainty:
        """Create an uncertainty from the ``(70,)`` array that ``numbers`` returned."""
        gaps, local, drift = three = np.zeros((3, 6, 6))
        for matrix, values in zip(three, numbers[:-7].reshape(3, -1), strict=True):
            matrix[_UPPER] = values
            matrix.T[_UPPER] = values
        return cls(local, drift, int(numbers[-1]), np.array(numbers[-7:-1]), gaps)

    def scaled(self, factor: float) -> PoseUncertainty:
        """Return the uncertainty in another unit, in which lengths are ``factor`` times as long."""
        D = np.repeat([factor, 1.0], 3)
        both = np.outer(D, D)
        return PoseUncertainty(
            both * self.local,
            both * self.drift,
            self.n_keyframes,
            D * self.offset,
            both * self.gaps,
        )

    @property
    def covariance(self) -> Matrix:
        """``(6, 6)`` covariance of the pose relative to the start of the drive."""
        drift = DRIFT * _growth(self.n_keyframes) * self.drift
        total: Matrix = self.local + drift + self.gaps + np.outer(self.offset, self.offset)
        return total


def relative_covariance(
    first: PoseUncertainty, last: PoseUncertainty, T_last_first: Matrix
) -> Matrix:
    """Return the covariance of the motion from an earlier frame to a later frame of a drive.

    The result is the ``(6, 6)`` covariance of the error ``xi``, in the frame of the later camera.
    The true motion is ``exp(xi) T_last_first``.

    Args:
        T_last_first: ``(4, 4)`` estimated motion, which maps points from the camera of the first
            frame to the camera of the last frame.
    """
    n = last.n_keyframes - first.n_keyframes
    A = adjoint(T_last_first)
    grown = last.drift - A @ first.drift @ A.T
    offset = last.offset - A @ first.offset
    local = last.local + A @ first.local @ A.T
    gaps = last.gaps - A @ first.gaps @ A.T
    total: Matrix = local + DRIFT * _growth(n) * grown + gaps + np.outer(offset, offset)
    return total


def predicted_covariance(T_last_first: Matrix, seconds: float) -> Matrix:
    """Return the ``(6, 6)`` covariance of a motion that was predicted with constant velocity.

    It describes the error ``xi`` in the frame of the later camera, as ``relative_covariance``.

    Args:
        T_last_first: ``(4, 4)`` predicted motion, which maps points from the camera of the first
            frame to the camera of the last frame.
        seconds: duration of the motion.
    """
    T_step, covariance = se3_exp(se3_log(T_last_first) / _STEPS), np.zeros((6, 6))
    for k in range(_STEPS):
        before, after = seconds * k / _STEPS, seconds * (k + 1) / _STEPS
        covariance = _predicted(covariance, adjoint(T_step), before, after)
    return covariance


def _predicted(
    covariance: Matrix, A: Matrix, before: float, after: float, speed: float = 0.0
) -> Matrix:
    """Advance the covariance of a predicted pose by a motion with the adjoint matrix ``A``.

    Args:
        before, after: seconds since tracking was lost, before and after the motion.
        speed: standard deviation of the speed at the time when tracking was lost, in m/s.
    """
    variances = []
    for time in (before, after):
        angle = min(0.5 * TURNING * time**2, TURN_RATE * time, ANY_ROTATION)
        distance = speed * time + 0.5 * ACCELERATION * time**2
        variances.append(np.repeat(np.square([distance, angle]), 3))
    return _symmetric(A @ covariance @ A.T) + np.diag(variances[1] - variances[0])


def _symmetric(matrix: Matrix) -> Matrix:
    result: Matrix = 0.5 * (matrix + matrix.T)
    return result


def _growth(n: int) -> float:
    """Return the factor by which correlation increases the variance of a sum of n steps.

    The steps are an AR(1) process (Hamilton, Time Series Analysis, 1994, 7.2).
    """
    if n == 0:
        return 1.0
    r = CORRELATION
    return 1.0 + 2.0 * r / (1.0 - r) * (1.0 - (1.0 - r**n) / (n * (1.0 - r)))


@dataclass(frozen=True, eq=False)
class OdometryState:
    """State of the odometry.

    Attributes:
        T_odom_camera: ``(4, 4)`` pose of the last frame. The first frame is the origin.
        now: the uncertainty of this pose.
        lost_s: seconds since tracking was lost; -1 before the first tracked frame.
    """

    T_odom_camera: Matrix = field(default_factory=lambda: np.eye(4))
    now: PoseUncertainty = field(
        default_factory=lambda: PoseUncertainty(np.zeros((6, 6)), np.zeros((6, 6)), 0)
    )
    lost_s: float = -1.0

    def scaled(self, factor: float) -> OdometryState:
        """Return the state in another unit, in which lengths are ``factor`` times as long."""
        T = self.T_odom_camera.copy()
        T[:3, 3] *= factor
        return OdometryState(T, self.now.scaled(factor), self.lost_s)


def moved(
    state: OdometryState,
    T_now_last: Matrix,
    elapsed: float,
    covariance: Matrix | None,
    of_offset: Matrix | None = None,
    *,
    found_again: bool = False,
    known_velocity: bool = True,
    carried: Matrix | None = None,
) -> OdometryState:
    """Advance to the next frame.

    Args:
        T_now_last: ``(4, 4)`` motion, which maps points from the camera of the last frame to the
            camera of the next frame.
        elapsed: seconds between the two frames.
        covariance: ``(6, 6)`` covariance of the optimised pose (``pose_covariance``). None if the
            pose was only predicted with constant velocity. The error of a predicted pose grows with
            the square of the time since tracking was lost.
        of_offset: ``(6, 3)`` error of the motion per unit of its translation, if the disparity
            offset is wrong by one standard deviation (``offset_effect``). None if the offset has no
            effect.
        found_again: whether ``T_now_last`` was predicted although the frame was tracked, because
            the camera was lost before or was relocalised.
        known_velocity: whether the velocity before the prediction was known. Otherwise, the
            prediction is that the camera does not move.
        carried: ``(6, 6)`` covariance of the pose since tracking was lost, if an IMU predicted it.
            None if the pose was predicted with constant velocity.
    """
    T_odom_camera = orthonormalised(state.T_odom_camera @ inverse(T_now_last))
    A, now, lost_s = adjoint(T_now_last), state.now, state.lost_s
    local, gaps = now.local, _symmetric(A @ now.gaps @ A.T)
    if covariance is not None and not np.isfinite(covariance).all():
        covariance = None
    if state.lost_s >= 0.0 and (found_again or covariance is None):
        lost_s += elapsed
        speed = 0.0 if known_velocity else ANY_SPEED
        local = _predicted(local, A, state.lost_s, lost_s, speed) if carried is None else carried
    if state.lost_s >= 0.0 and found_again:
        gaps, local = gaps + local, np.zeros((6, 6))
    if covariance is not None:
        local, lost_s = _symmetric(covariance), 0.0
    offset = A @ now.offset
    if of_offset is not None and np.isfinite(of_offset).all():
        offset += of_offset @ T_now_last[:3, 3]
    drift = _symmetric(A @ now.drift @ A.T)
    now = PoseUncertainty(local, drift, now.n_keyframes, offset, gaps)
    return OdometryState(T_odom_camera, now, lost_s)


def at_keyframe(state: OdometryState) -> OdometryState:
    """Return the state after the last frame became a keyframe.

    The error of the frame is added to the drift, because new landmarks inherit it. If the pose of
    the frame was predicted, the keyframe begins a sub-map, and the error is that of a gap.
    """
    now = replace(state.now, n_keyframes=state.now.n_keyframes + 1)
    if state.lost_s == 0.0:
        now = replace(now, drift=now.drift + now.local)
    else:
        now = replace(now, local=np.zeros((6, 6)), gaps=now.gaps + now.local)
    return replace(state, now=now, lost_s=0.0)
