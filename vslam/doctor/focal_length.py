"""Estimates the focal length from the motion of the camera.

With a wrong focal length, a stereo pair reconstructs a scene that is stretched along the optical
axis. A pure translation of the camera is consistent with such a scene, but a rotation about any
axis other than the optical axis is not. For each tested focal length, the motion between two frames
is optimised. The estimate is the focal length with the smallest reprojection error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.types.camera import Camera

Vectors = NDArray[np.float64]

_PIXEL, _DISPARITY = 0.35, 0.3  # px, standard deviations of refined matches
# Squared error, divided by its variance, at which the weight of a point is one half. For 95 % of
# the inliers, the squared error is less than 6 times the variance.
_CAUCHY = 5.0
_ITERATIONS = 12
_FACTORS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.4, 1.6, 1.8, 2.0)  # of the coarse search
_PRECISION = 1e-3  # precision of the logarithm of the factor
_STEP = 0.02  # step of the logarithm of the factor, to measure the curvature at the minimum


@dataclass(frozen=True)
class Moved:
    """Image positions of N points that were seen in two frames.

    Attributes:
        before, after: ``(N, 2)`` positions in pixels in the left images of the first and the second
            frame.
        disparity: ``(N,)`` disparities in the first frame, in pixels.
    """

    before: Vectors
    disparity: Vectors
    after: Vectors


@dataclass(frozen=True)
class FocalFit:
    """The focal length that best explains how points move when the camera moves.

    Attributes:
        factor: ratio of this focal length to the calibrated focal length.
        sigma: standard deviation of the logarithm of ``factor``.
        turned: largest rotation of the camera between two frames about an axis perpendicular to the
            optical axis, in degrees. Only frames whose points agree with ``factor`` are considered.
    """

    factor: float
    sigma: float
    turned: float


def fit_focal_length(several: Sequence[Moved], camera: Camera) -> FocalFit:
    """Find the focal length that best explains how points move when the camera moves.

    The search covers 0.5 to 2 times the calibrated focal length.

    Args:
        several: points that were seen in two frames, for at least one pair of frames. Each pair has
            at least three points.
        camera: stereo or RGB-D camera. The disparities of an RGB-D camera are computed with its
            virtual baseline.
    """
    from scipy.optimize import minimize_scalar

    poses = [np.zeros(6) for _ in several]

    def cost(log: float) -> float:
        total = 0.0
        for k, moved in enumerate(several):
            poses[k], error = _best_pose(moved, camera, float(np.exp(log)), poses[k])
            total += error
        return total

    logs = np.log(_FACTORS)
    best = int(np.argmin([cost(log) for log in logs]))
    bracket = logs[max(best - 1, 0)], logs[min(best + 1, len(logs) - 1)]
    log = float(minimize_scalar(cost, bounds=bracket, options={"xatol": _PRECISION}).x)
    around = cost(log + _STEP), cost(log - _STEP)
    least = cost(log)
    curvature = (sum(around) - 2.0 * least) / _STEP**2
    variance = least / (2.0 * sum(len(moved.before) for moved in several))  # of one residual
    turned = [
        float(np.linalg.norm(pose[:2]))
        for moved, pose in zip(several, poses, strict=True)
        if _fits(moved, camera, float(np.exp(log)), pose)
    ]
    return FocalFit(
        float(np.exp(log)),
        float(np.sqrt(2.0 * variance / max(curvature, 1e-12))),
        float(np.degrees(max(turned, default=0.0))),
    )


def _best_pose(
    moved: Moved, camera: Camera, factor: float, start: Vectors
) -> tuple[Vectors, float]:
    """Optimise the motion between two frames by Gauss-Newton with a Cauchy loss.

    Returns:
        The motion as ``(6,)`` rotation vector and translation, and its loss.
    """
    pose = start
    for _ in range(_ITERATIONS):
        error, variance, points = _errors(moved, camera, factor, pose)
        weight = 1.0 / variance / (1.0 + (error**2).sum(axis=1) / variance / _CAUCHY)
        J = _jacobian(points, camera, factor, pose)
        A = np.einsum("nij,n,nik->jk", J, weight, J) + 1e-9 * np.eye(6)
        step = np.linalg.solve(A, np.einsum("nij,n,ni->j", J, weight, error))
        R = cv2.Rodrigues(step[:3])[0] @ cv2.Rodrigues(pose[:3])[0]
        pose = np.concatenate([cv2.Rodrigues(R)[0].ravel(), pose[3:] + step[3:]])
        if np.abs(step).max() < 1e-6:
            break
    error, variance, _ = _errors(moved, camera, factor, pose)
    loss = _CAUCHY * np.log1p((error**2).sum(axis=1) / variance / _CAUCHY).sum()
    return (pose, float(loss)) if np.isfinite(loss) else (np.zeros(6), 1e12)


def _fits(moved: Moved, camera: Camera, factor: float, pose: Vectors) -> bool:
    error, variance, _ = _errors(moved, camera, factor, pose)
    return float(np.median((error**2).sum(axis=1) / variance)) < _CAUCHY


def _errors(
    moved: Moved, camera: Camera, factor: float, pose: Vectors
) -> tuple[Vectors, Vectors, Vectors]:
    """Compute the reprojection errors of points for a motion between two frames.

    Returns:
        ``(N, 2)`` reprojection errors, their ``(N,)`` variances, and ``(N, 3)`` points in the later
        frame. The variances include the uncertainty of the depths of the points.
    """
    projected, points = _project(moved.before, moved.disparity, camera, factor, pose)
    nearer, _ = _project(moved.before, moved.disparity + _DISPARITY, camera, factor, pose)
    return moved.after - projected, _PIXEL**2 + ((nearer - projected) ** 2).sum(axis=1), points


def _project(
    xy: Vectors, disparity: Vectors, camera: Camera, factor: float, pose: Vectors
) -> tuple[Vectors, Vectors]:
    f, centre = factor * np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    z = f[0] * camera.baseline / disparity
    points = np.column_stack([(xy - centre) / f * z[:, None], z])
    points = points @ cv2.Rodrigues(pose[:3])[0].T + pose[3:]
    ahead = np.maximum(points[:, 2:], 1e-3 * camera.baseline)  # points behind it get large errors
    return points[:, :2] / ahead * f + centre, points


def _jacobian(points: Vectors, camera: Camera, factor: float, pose: Vectors) -> Vectors:
    """Return the ``(N, 2, 6)`` derivatives of pixel positions by rotation and translation."""
    x, y, z = points.T
    z = np.maximum(z, 1e-3 * camera.baseline)
    zero = np.zeros_like(z)
    u = factor * camera.fx * np.column_stack([1.0 / z, zero, -x / z**2])
    v = factor * camera.fy * np.column_stack([zero, 1.0 / z, -y / z**2])
    by_translation = np.stack([u, v], axis=1)
    rotated = (points - pose[3:])[:, None, :]
    return np.concatenate([np.cross(rotated, by_translation), by_translation], axis=2)
