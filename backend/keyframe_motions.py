"""The motions that an IMU measured between consecutive keyframes, which the map keeps.

A motion is integrated once, when its keyframe is mapped. Other biases are taken into account to
first order. If a keyframe is culled, the motions before and after it are one motion.
"""

from __future__ import annotations

from functools import reduce

import numpy as np
from numpy.typing import NDArray

from vslam.backend.inertial_factor import Motions
from vslam.backend.preintegration import Preintegration, preintegrate
from vslam.types.imu import InertialWindow
from vslam.types.map import CARRIED, Map

LONGEST_S = 3.5  # s between two keyframes that a motion connects
# Standard deviation of the displacement, in m, besides the noise of the samples. Within one
# interval between two samples, this noise alone would tie the displacement to the velocity. [own]
SIGMA_M = 1e-5


def record_motion(map_: Map, keyframe: int, window: InertialWindow) -> None:
    """Integrate the samples since the keyframe before, and keep the motion with a keyframe.

    Nothing is kept if samples are missing, or if the keyframe begins a drive, or a sub-map to
    which the IMU did not carry the camera.
    """
    table, samples, before = map_.keyframes, window.samples, keyframe - 1
    begins = before < 0 or map_.sessions[before] != map_.sessions[keyframe]
    if begins or table.restart[keyframe] not in (0, CARRIED) or not len(samples):
        return
    start, end = map_.timestamps[[before, keyframe]].tolist()
    if start < samples[0, 0] or end - start > LONGEST_S:
        return
    noise = window.noise
    motion = preintegrate(samples, start, end, noise, window.state.bias)
    if motion.longest_gap > window.longest_gap:
        return
    table.motion_seconds[keyframe] = motion.seconds
    table.motion_rotation[keyframe] = motion.rotation
    table.motion_velocity[keyframe] = motion.velocity
    table.motion_position[keyframe] = motion.position
    table.motion_bias[keyframe] = motion.bias
    table.motion_by_bias[keyframe] = motion.by_bias
    table.motion_covariance[keyframe] = 0.5 * (motion.covariance + motion.covariance.T)
    table.motion_covariance[keyframe, range(6, 9), range(6, 9)] += SIGMA_M**2
    walks = np.square([noise.gyro_walk, noise.accel_walk])
    table.motion_walk[keyframe] = np.repeat(walks, 3) * motion.seconds
    table.T_imu_camera[keyframe] = window.T_imu_camera


def forget_motion(map_: Map, keyframe: int) -> None:
    """Forget the motion between a keyframe and the keyframe before."""
    map_.keyframes.motion_seconds[keyframe] = 0.0


def motions_between(map_: Map, keyframes: NDArray[np.int64]) -> Motions:
    """Return the motions between each of N + 1 living keyframes and the next one.

    Args:
        keyframes: ``(N + 1,)`` ascending ids. All keyframes between two of them are culled.

    Returns:
        N motions. ``seconds`` and ``information`` are zero where a motion is unknown.
    """
    table, ends = map_.keyframes, keyframes[1:]
    seconds, rotation = table.motion_seconds[ends], table.motion_rotation[ends]
    velocity, position = table.motion_velocity[ends], table.motion_position[ends]
    bias, by_bias = table.motion_bias[ends], table.motion_by_bias[ends]
    covariance, walk = table.motion_covariance[ends], table.motion_walk[ends]
    for k in np.flatnonzero(np.diff(keyframes) > 1).tolist():
        parts = np.arange(keyframes[k] + 1, keyframes[k + 1] + 1)
        t = table.motion_seconds[parts]
        seconds[k] = 0.0
        if not (t > 0.0).all() or t.sum() > LONGEST_S:
            continue
        motions = [_motion_of(map_, part).with_bias(bias[k]) for part in parts.tolist()]
        both = reduce(Preintegration.followed_by, motions)
        seconds[k], rotation[k], velocity[k] = both.seconds, both.rotation, both.velocity
        position[k], by_bias[k], covariance[k] = both.position, both.by_bias, both.covariance
        walk[k] = table.motion_walk[parts].sum(axis=0)
    known = np.flatnonzero(seconds > 0.0)
    information = np.zeros((len(ends), 15, 15))
    information[known, :9, :9] = np.linalg.inv(covariance[known])
    information[known[:, None], range(9, 15), range(9, 15)] = 1.0 / walk[known]
    T_imu_camera = table.T_imu_camera[ends]
    return Motions(seconds, rotation, velocity, position, bias, by_bias, information, T_imu_camera)


def _motion_of(map_: Map, keyframe: int) -> Preintegration:
    """Return the motion between a keyframe and the keyframe before."""
    table = map_.keyframes
    return Preintegration(
        float(table.motion_seconds[keyframe]),
        table.motion_rotation[keyframe],
        table.motion_velocity[keyframe],
        table.motion_position[keyframe],
        table.motion_bias[keyframe],
        table.motion_by_bias[keyframe],
        table.motion_covariance[keyframe],
        0.0,
    )
