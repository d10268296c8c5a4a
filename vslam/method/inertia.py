"""What is known about the motion of the camera from its IMU.

The state of the IMU is followed in the world frame of the odometry, which never jumps. Loops and
relocalisation move the pose of the camera in the map, but they do not change how fast the camera
moves, or where down is.

First, the poses of a short stretch of tracked frames are collected, until they give gravity, the
velocity and the biases (``backend/inertial_start.py``). Those of one camera must also give the
scale of the map. They are then taken from the map when a keyframe has been mapped, because bundle
adjustment has improved them, and the odometry has not. From then on, a filter follows them
(``backend/inertial_filter.py``). Samples predict the pose of the next frame, and the tracked pose
corrects the state. A camera that is lost is carried on by the samples alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from vslam.backend.inertial_filter import (
    SPEED,
    anchored,
    camera_covariance,
    camera_pose,
    corrected_by_pose,
    corrected_by_rest,
    drifted,
    fall_in_imu,
    in_another_world,
    moved,
    noise_in_motion,
)
from vslam.backend.inertial_start import MAX_MISFIT, GravityState, PoseStretch, find_gravity
from vslam.backend.preintegration import preintegrate, so3_log
from vslam.method.gyro import LONGEST_GAP, with_known_bias
from vslam.types.frame_poses import PoseRun
from vslam.types.geometry import Matrix, inverse
from vslam.types.imu import (
    GravityDirection,
    ImuCalibration,
    ImuNoise,
    Inertia,
    InertialState,
    tidied,
)
from vslam.types.odometry import KEYFRAME_DRIFT

CARRIED_S = 3.0  # s without images after which a pose counts as lost, not as carried by the IMU
# The start needs poses over START_S seconds. It is tried again when the share RETRY_SHARE of the
# time of these poses is new, at least after RETRY_S seconds, with the poses of the last STRETCH_S
# seconds, of which at most MOST_POSES are used. Of a slow camera, the last FEWEST_POSES poses are
# used, if they are at most LONGEST_S seconds old.
START_S, RETRY_S, STRETCH_S, MOST_POSES = 0.5, 0.25, 1.0, 20
FEWEST_POSES, LONGEST_S = 6, 4.0
KEPT_S = 5.0  # s for which samples are kept
# Stretches that give the first guess of the scale of one camera, in seconds. The first poses of a
# map are often so wrong that a shorter stretch agrees better with the samples. A guess whose
# standard deviation is at most GUESS_SIGMA is the start of a bundle adjustment, which decides. It
# is tried again when the map has grown by the share RETRY_SHARE of its time, at least after
# SCALE_RETRY_S[0] seconds and at most after SCALE_RETRY_S[1] seconds. [own]
SCALE_STRETCHES, GUESS_SIGMA = (8.0, 4.0, 2.0), 0.25
RETRY_SHARE, SCALE_RETRY_S = 0.25, (0.5, 2.0)
KEPT_WITHOUT_SCALE_S = 30.0  # s for which samples are kept while the scale is unknown
METRIC_S = 2.0  # s of poses in metres that give the first state of one camera
# Standard deviations of a feature in the image and of a rotation, in pixels and radians, as seen in
# the errors of the poses of one camera.
SIGMA_PX, SCALE_SIGMA_RAD = 0.15, 0.0005
# Errors of the covariances that the images give are not independent from frame to frame, so those
# covariances are multiplied by POSE_INFLATION, and are at least as large as these, in metres and
# radians along each axis.
POSE_INFLATION = 4.0
SIGMA_M, SIGMA_RAD = 0.001, 0.0002
SIGMA_PER_M = 0.005  # share of the distance between two frames, if that is larger, at the start
# Factor of the noise of the samples in bundle adjustment, and beside poses that it has improved.
# Gravity and the biases of the filter come from the same images, so their covariance is multiplied
# by BUNDLE_PRIOR there. Both were chosen from three drives in towns. With 1 and 1, one straight
# path got 0.3 % too long, and with 10, the samples improve little. On other drives, BUNDLE_PRIOR
# changes the length of the path by at most 0.05 %. [own]
BUNDLES, BUNDLE_PRIOR = 3.0, 10.0
REST_SIGMA = 0.01  # m/s, standard deviation of the velocity of a camera that stands still
MOVES = 16.3  # chi-square of three degrees of freedom, 0.001
# A camera that stood still has moved off if the samples of a frame show more than this, in m/s^2
# and rad/s. A car gains 1 m/s^2.
REST_ACCEL, REST_RATE = 0.1, 0.02
# A pose with a larger squared distance from its prediction contradicts it: 0.001 of six degrees of
# freedom. The motion of the prediction is then less certain than it claims, and its variances are
# multiplied by these factors, until the pose agrees. If none helps, the pose is not used. After so
# many such poses in a row, the state is found anew.
IMPLAUSIBLE, DOUBTS, MOST_REFUSED = 22.5, (1.0, 10.0, 100.0), 5
# After so many disagreements, the IMU is not used. A disagreement is a start at which poses and
# samples did not agree, or a state that had to be found anew. They are forgotten if a state has
# agreed with the poses for AGREED_S seconds.
MOST_DISAGREEMENTS, AGREED_S = 5, 3.0
STUCK = 10  # samples with the same number, after which a gyroscope is stuck
IMU_REFUSED = (
    "The IMU is not used, because its samples contradict the motion in the images: check "
    "T_imu_camera (it maps points of the left camera to the IMU), its time_offset, and the units "
    "rad/s and m/s^2."
)

SCALE_UNKNOWN = (
    "The unit of length is not the metre, because the camera did not accelerate enough for the IMU "
    "to tell the scale: begin with a few quick movements."
)
SCALE_LOST = (
    "The unit of length of the last sub-map is not the metre, because the camera did not "
    "accelerate enough after it had been lost: its distances are not those of the rest of the map."
)


def is_refused(inertia: Inertia) -> bool:
    """Return whether the IMU is not used, because it contradicts the images."""
    return inertia.disagreements >= MOST_DISAGREEMENTS


def is_stuck(samples: Matrix) -> bool:
    """Return whether an axis of the gyroscope has given the same number ``STUCK`` times in a row,
    which the noise of a sound one does not allow."""
    newest = samples[-STUCK:, 1:4]
    return len(newest) == STUCK and bool((np.ptp(newest, axis=0) == 0.0).any())


def with_samples(inertia: Inertia, samples: ArrayLike, kept_s: float = KEPT_S) -> Inertia:
    """Add ``(N, 7)`` samples in any order (``tidied``). Old samples are forgotten.

    Args:
        kept_s: for how many seconds samples are kept.

    Raises:
        ValueError: the shape is not ``(N, 7)``.
    """
    known, new = inertia.samples, tidied(samples).samples
    late = len(known) > 0 and len(new) > 0 and not new[0, 0] > known[-1, 0]
    known = np.concatenate([known, new])
    if late:
        known = tidied(known).samples
    if len(known):
        since = known[-1, 0] - kept_s
        if inertia.state is not None:
            since = min(since, inertia.state.timestamp)
        known = known[max(int(np.searchsorted(known[:, 0], since)) - 1, 0) :]
    return replace(inertia, samples=known)


def predicted_state(
    inertia: Inertia, timestamp: float, calibration: ImuCalibration
) -> InertialState | None:
    """Return the state at the time of the next frame; None if it is unknown."""
    state = inertia.state
    if state is None or not len(inertia.samples) or not timestamp > state.timestamp:
        return None
    noise = noise_in_motion(calibration.noise, inertia.samples)
    motion = preintegrate(inertia.samples, state.timestamp, timestamp, noise, state.bias)
    return moved(state, motion, noise) if motion.longest_gap <= LONGEST_GAP else None


def noise_for_bundles(inertia: Inertia, calibration: ImuCalibration) -> ImuNoise:
    """Return the noise of the samples for bundle adjustment."""
    noise = noise_in_motion(calibration.noise, inertia.samples)
    return replace(noise, gyro=BUNDLES * noise.gyro, accel=BUNDLES * noise.accel)


def tracked(
    inertia: Inertia,
    predicted: InertialState | None,
    timestamp: float,
    T_odom_camera: Matrix,
    covariance: Matrix,
    calibration: ImuCalibration,
    *,
    stands_still: bool,
) -> Inertia:
    """Return what is known after a frame that was tracked from the frame before.

    Args:
        predicted: the state that was predicted for this frame.
        T_odom_camera: ``(4, 4)`` pose of the frame.
        covariance: ``(6, 6)`` of this pose (``PoseUncertainty.local``).
    """
    if inertia.carried_s:
        inertia = replace(inertia, carried_s=0.0)
    if is_refused(inertia):
        return inertia
    if predicted is None:  # unknown, or samples are missing
        inertia = _collected(inertia, timestamp, T_odom_camera)
        return _started(inertia, _noise(covariance), calibration)
    state = _corrected(predicted, T_odom_camera, covariance, calibration)
    if state is None:
        if inertia.refused + 1 >= MOST_REFUSED:
            n = inertia.disagreements + 1
            return replace(_forgotten(inertia), refused=0, disagreements=n)
        return replace(inertia, state=predicted, refused=inertia.refused + 1)
    if stands_still:
        state = corrected_by_rest(state, REST_SIGMA).state
    agreed = timestamp - inertia.tried > AGREED_S
    n = 0 if agreed else inertia.disagreements
    return replace(inertia, state=state, refused=0, disagreements=n)


def at_keyframe(inertia: Inertia, covariance: Matrix, calibration: ImuCalibration) -> Inertia:
    """Return what is known after a frame became a keyframe, with which the odometry drifts.

    Args:
        covariance: ``(6, 6)`` of the pose of the frame (``PoseUncertainty.local``).
    """
    if inertia.state is None:
        return inertia
    drift = KEYFRAME_DRIFT * covariance
    return replace(inertia, state=drifted(inertia.state, drift, calibration.T_imu_camera))


def found_again(
    inertia: Inertia,
    predicted: InertialState | None,
    T_odom_camera: Matrix,
    covariance: Matrix,
    calibration: ImuCalibration,
    *,
    T_odom_seen: Matrix | None,
) -> Inertia:
    """Return what is known after a frame that was found in the map again.

    How far the camera has moved since it was lost corrects the velocity and the biases with which
    the IMU carried it. The odometry continues from the predicted pose, so its frame is then defined
    anew by this pose.

    Args:
        T_odom_camera: ``(4, 4)`` predicted pose of the frame.
        covariance: ``(6, 6)`` of the pose that the images gave.
        T_odom_seen: ``(4, 4)`` this pose, in the frame of the odometry before; None if the frame
            was found at another place than predicted, whose distance has errors of its own.
    """
    if predicted is None:
        return replace(_forgotten(inertia), carried_s=0.0)
    state = predicted
    if T_odom_seen is not None:
        state = _corrected(predicted, T_odom_seen, covariance, calibration) or predicted
    T_odom_imu = T_odom_camera @ inverse(calibration.T_imu_camera)
    return replace(inertia, state=anchored(state, T_odom_imu), carried_s=0.0, refused=0)


def lost(
    inertia: Inertia, predicted: InertialState | None, seconds: float, *, stood_still: bool
) -> Inertia:
    """Return what is known after a frame that was not tracked.

    A camera that stood still when it was last seen, and that the samples do not move, still stands.
    Then nothing drifts, and the time does not count. Samples alone cannot tell rest from even
    motion.

    Args:
        seconds: time since the frame before.
        stood_still: whether the camera stood still in the last frame that was tracked.
    """
    before = inertia.state
    if predicted is None or before is None:
        return _forgotten(inertia)
    if stood_still and _rests(before, predicted):
        return replace(inertia, state=corrected_by_rest(predicted, REST_SIGMA).state)
    return replace(inertia, state=predicted, carried_s=inertia.carried_s + seconds)


def moves(state: InertialState | None) -> bool:
    """Return whether it is certain that the camera moves. A slow flight high above the ground moves
    landmarks as little in the image as rest does."""
    if state is None:
        return False
    P = state.covariance[SPEED, SPEED] + REST_SIGMA**2 * np.eye(3)
    return float(state.velocity @ np.linalg.solve(P, state.velocity)) > MOVES


def _rests(before: InertialState, after: InertialState) -> bool:
    """Return whether samples show neither acceleration nor rotation between two states."""
    seconds = after.timestamp - before.timestamp
    turn = so3_log(np.ascontiguousarray(before.T_world_imu[:3, :3].T @ after.T_world_imu[:3, :3]))
    gained = np.linalg.norm(after.velocity - before.velocity)
    return bool(gained < REST_ACCEL * seconds and np.linalg.norm(turn) < REST_RATE * seconds)


def guessed_scale(
    inertia: Inertia,
    run: PoseRun,
    sigma: float,
    calibration: ImuCalibration,
    *,
    at_once: bool = False,
) -> tuple[Inertia, GravityState | None]:
    """Guess the scale of the map of one camera from the frames that were tracked last.

    Args:
        run: poses of the camera as it is mounted, in the map.
        sigma: standard deviation of these poses along each axis, in units of the map.
        at_once: whether it is never too early to try again.

    Returns:
        What is known, and the most certain guess, with the state of the IMU at the last pose. None
        if no guess is useful, or if it is too early to try again.
    """
    times, best = run.times, None
    if not len(times):
        return inertia, None
    now, since = float(times[-1]), float(times[0])
    pause = np.clip(RETRY_SHARE * (now - since), *SCALE_RETRY_S)
    if now - inertia.tried < pause and not at_once:
        return inertia, None
    doubted = replace(calibration, noise=noise_for_bundles(inertia, calibration))
    for seconds in SCALE_STRETCHES:
        if now - since < 0.5 * seconds:
            continue
        chosen = times >= now - seconds
        stretch = PoseStretch(times[chosen], run.T_wc[chosen], sigma, SCALE_SIGMA_RAD)
        found = find_gravity(stretch, inertia.samples, doubted, known_scale=False)
        if found is None or not found.scale_sigma <= GUESS_SIGMA:
            continue
        if best is None or found.scale_sigma < best.scale_sigma:
            best = found
    return replace(inertia, tried=now), best


def in_metres(
    inertia: Inertia,
    run: PoseRun,
    scale_sigma: float,
    sigma: float,
    T_odom_map: Matrix,
    calibration: ImuCalibration,
) -> Inertia:
    """Return what is known when the map of one camera has become metric.

    Args:
        run: poses of the frames that were tracked last, as the camera is mounted, in metres.
        scale_sigma: standard deviation of the logarithm of the scale.
        sigma: standard deviation of the poses along each axis, in metres.
        T_odom_map: ``(4, 4)``, maps points of the map to the frame of the odometry.
    """
    now = float(run.times[-1])
    chosen = run.times >= now - METRIC_S
    stretch = PoseStretch(run.times[chosen], run.T_wc[chosen], sigma, SCALE_SIGMA_RAD)
    doubted = replace(calibration, noise=noise_for_bundles(inertia, calibration))
    found = find_gravity(stretch, inertia.samples, doubted, known_scale=True)
    metric = replace(
        _forgotten(inertia),
        scale_sigma=scale_sigma,
        metric_since=now if inertia.metric_since < 0.0 else inertia.metric_since,
    )
    if found is None or found.doubt:  # it is found from the next frames
        return metric
    return replace(
        metric,
        state=in_another_world(found.state, T_odom_map),
        refused=0,
        known_since=now if inertia.known_since < 0.0 else inertia.known_since,
    )


def without_scale(inertia: Inertia) -> Inertia:
    """Return what is known when one camera begins a sub-map, whose scale is unknown."""
    return replace(_forgotten(inertia), scale_sigma=-1.0)


def predicted_motion(
    predicted: InertialState, T_odom_camera: Matrix, calibration: ImuCalibration
) -> Matrix:
    """Return the ``(4, 4)`` motion that maps points from the camera of the last frame to the camera
    of the next frame.

    Args:
        T_odom_camera: ``(4, 4)`` pose of the last frame.
    """
    return inverse(camera_pose(predicted, calibration.T_imu_camera)) @ T_odom_camera


def predicted_covariance(predicted: InertialState, calibration: ImuCalibration) -> Matrix:
    """Return the ``(6, 6)`` covariance of a predicted pose (``PoseUncertainty.local``)."""
    return camera_covariance(predicted, calibration.T_imu_camera)


def gravity_direction(state: InertialState, calibration: ImuCalibration) -> GravityDirection:
    """Return the direction of free fall in the frame of the camera."""
    gravity, variance = fall_in_imu(state.T_world_imu[:3, :3], state.gravity, state.covariance)
    direction: Matrix = calibration.T_imu_camera[:3, :3].T @ gravity
    return GravityDirection(direction, float(np.sqrt(variance)))


def _corrected(
    predicted: InertialState, T_odom_camera: Matrix, covariance: Matrix, calibration: ImuCalibration
) -> InertialState | None:
    """Return a predicted state, corrected by a pose of the images; None if they contradict each
    other."""
    noise = _noise(covariance)
    for doubt in DOUBTS:
        doubted = predicted
        if doubt > 1.0:
            D = np.ones(len(predicted.covariance))
            D[: SPEED.stop] = np.sqrt(doubt)  # what is known of gravity and the biases remains
            doubted = replace(predicted, covariance=predicted.covariance * np.outer(D, D))
        found = corrected_by_pose(doubted, T_odom_camera, noise, calibration.T_imu_camera)
        if found.chi2 <= IMPLAUSIBLE:
            return found.state
    return None


def _noise(covariance: Matrix) -> Matrix:
    """Return the ``(6, 6)`` covariance with which a pose of the images corrects the state."""
    noise: Matrix = POSE_INFLATION * covariance
    return noise + np.diag(np.repeat([SIGMA_M**2, SIGMA_RAD**2], 3))


def _forgotten(inertia: Inertia) -> Inertia:
    """Return what is left if the state is unknown."""
    nothing = Inertia()
    return replace(with_known_bias(inertia), state=None, times=nothing.times, poses=nothing.poses)


def _collected(inertia: Inertia, timestamp: float, T_odom_camera: Matrix) -> Inertia:
    """Add a pose to the stretch for the start."""
    times = np.append(inertia.times, timestamp)
    poses = np.concatenate([inertia.poses, T_odom_camera[None]])
    newest = np.arange(len(times)) >= len(times) - FEWEST_POSES
    recent = (times >= timestamp - STRETCH_S) | (newest & (times >= timestamp - LONGEST_S))
    return replace(inertia, state=None, times=times[recent], poses=poses[recent])


def _started(inertia: Inertia, noise: Matrix, calibration: ImuCalibration) -> Inertia:
    """Try to find the state from the stretch. The newest pose has the ``(6, 6)`` covariance
    ``noise``."""
    times = inertia.times
    now = float(times[-1])
    pause = max(RETRY_S, RETRY_SHARE * (now - times[0]))
    if now - times[0] < START_S or now - inertia.tried < pause:
        return inertia
    inertia = replace(inertia, tried=now)
    step = -(-len(times) // MOST_POSES)
    chosen = slice((len(times) - 1) % step, None, step)  # the newest pose belongs to them
    moved = np.linalg.norm(np.diff(inertia.poses[:, :3, 3], axis=0), axis=1)
    sigma_m, sigma_rad = np.sqrt(np.diag(noise).reshape(2, 3).mean(axis=1)).tolist()
    sigma_m = max(sigma_m, SIGMA_PER_M * float(np.median(moved)))
    stretch = PoseStretch(times[chosen], inertia.poses[chosen], sigma_m, sigma_rad)
    moving = replace(calibration, noise=noise_in_motion(calibration.noise, inertia.samples))
    found = find_gravity(stretch, inertia.samples, moving, known_scale=True)
    if found is None:
        return inertia
    if found.doubt:
        n = inertia.disagreements + (found.misfit > MAX_MISFIT)
        return replace(inertia, disagreements=n)
    since = now if inertia.known_since < 0.0 else inertia.known_since
    return replace(_forgotten(inertia), state=found.state, refused=0, known_since=since)
