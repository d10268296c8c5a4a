"""Finds the rotation and the clock of an IMU from rotations of the camera.

The rotation and the time offset are found as by Furgale et al. (IROS 2013), but by least squares.
For each offset, the rotation that maps the camera's angular rates to the gyroscope's has a closed
form (Kabsch, Acta Crystallographica 1976). Rates between neighbouring frames are noisy, because
errors of two poses are divided by a short time. Therefore, rotations over a fifth of a second then
refine the result. Their errors depend on each other, which the covariance takes into account (Newey
and West, Econometrica 1987).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vslam.types.geometry import Matrix

Array = NDArray[np.float64]

WIDEST_S = 0.3
"""Largest time offset that is searched for."""

_STEP_S = 0.01  # of the search
_LEAST_RATE = 0.05  # rad/s; root mean square of the camera's rotation that allows a verdict
_FEWEST = 20  # intervals between frames
_MIRRORED = 0.5  # ratio of the residuals with and without a mirrored axis
_MEDIAN_OF_CHI = 1.538  # median length of three standard normal numbers
_SPAN_S, _ROUNDS = 0.2, 4  # of the refinement
_REFINED = 0.2  # largest error of the scale and share of unexplained rates with which it converges


@dataclass(frozen=True)
class Alignment:
    """The rotation and the clock of an IMU, found from rotations of the camera.

    Attributes:
        R_imu_camera: ``(3, 3)`` rotation, from the camera to the IMU.
        covariance: ``(3, 3)`` of its error, a rotation vector in the frame of the IMU.
        time_offset: seconds that are added to times of the camera to get times of the IMU.
        sigma: standard deviation of ``time_offset``.
        bias: ``(3,)`` of the gyroscope, in its own unit per second.
        scale: rate of the gyroscope divided by the rate of the camera.
        mirrored: whether rates agree much better if one axis of the gyroscope is reversed.
        unexplained: median of the gyroscope's rates that the camera does not explain, relative to
            the median of its rates about their mean.
        rate: root mean square of the camera's angular rate about its mean, in rad/s.
    """

    R_imu_camera: Matrix
    covariance: Matrix
    time_offset: float
    sigma: float
    bias: Array
    scale: float
    mirrored: bool
    unexplained: float
    rate: float

    def turn_from(self, R_imu_camera: Matrix) -> Array:
        """Return the ``(3,)`` rotation vector from another rotation to the measured one, in the
        frame of the IMU."""
        return _logarithms((self.R_imu_camera @ R_imu_camera.T)[None])[0]

    def inverse_of(self, R_imu_camera: Matrix) -> bool:
        """Return whether the inverse of another rotation agrees much better with the measured one
        than that rotation itself."""
        angle, other = (
            float(np.linalg.norm(self.turn_from(R))) for R in (R_imu_camera, R_imu_camera.T)
        )
        return other < 0.3 * angle

    @property
    def rotation_sigma(self) -> float:
        """Standard deviation of the angle of the rotation, in radians."""
        return float(np.sqrt(max(np.trace(self.covariance), 0.0)))


def align(times: Array, rotations: Matrix, samples: Matrix) -> Alignment | None:
    """Find the rotation and the time offset between a camera and an IMU, and the gyroscope's bias.

    Args:
        times: ``(M,)`` times of frames in seconds of the camera's clock.
        rotations: ``(M, 3, 3)`` ``R_wc`` of the frames, from the camera to any fixed frame. Those
            of lost frames are NaN.
        samples: ``(N, 7)``, with times of the IMU's clock.

    Returns:
        None if fewer than 20 intervals between frames have samples, or the camera hardly turns.
    """
    relative = rotations[:-1].transpose(0, 2, 1) @ rotations[1:]
    known = np.asarray(np.isfinite(relative).all(axis=(1, 2)), np.bool_)
    relative = np.where(known[:, None, None], relative, np.eye(3))
    steps = np.diff(times)
    camera = _logarithms(relative) / steps[:, None]
    used = known & np.asarray(steps < 4.0 * np.median(steps))
    if used.sum() < _FEWEST or len(samples) < 2:
        return None
    begins, ends, camera = times[:-1][used], times[1:][used], camera[used]
    integral = np.zeros((len(samples), 3))
    widths = np.diff(samples[:, 0])[:, None]
    np.cumsum(0.5 * widths * (samples[1:, 1:4] + samples[:-1, 1:4]), axis=0, out=integral[1:])
    fit = partial(_fit, begins, ends, camera, samples[:, 0], integral)
    offsets = np.arange(-WIDEST_S, WIDEST_S + 0.5 * _STEP_S, _STEP_S)
    costs = [fit(offset).cost for offset in offsets.tolist()]
    best = int(np.argmin(costs))
    if not np.isfinite(costs[best]):
        return None
    offset = _minimum(lambda at: fit(at).cost, float(offsets[best]), _STEP_S)
    # How the rates at the frames change with the offset, for its standard deviation.
    h = 0.5 * _STEP_S
    kept = (begins + offset - h >= samples[0, 0]) & (ends + offset + h <= samples[-1, 0])
    if kept.sum() < _FEWEST:
        return None
    fit = partial(_fit, begins[kept], ends[kept], camera[kept], samples[:, 0], integral)
    found = fit(offset)
    rate = float(np.sqrt(np.mean(np.sum(found.camera**2, axis=1))))
    if rate < _LEAST_RATE:
        return None
    slope = (fit(offset + h).gyro - fit(offset - h).gyro) / (2.0 * h)
    size = float(np.median(np.linalg.norm(found.residual, axis=1)))
    variance = (size / _MEDIAN_OF_CHI) ** 2 + 1e-12
    sigma = float(np.sqrt(variance / max(float(np.sum(slope**2)), 1e-12)))
    turned = found.camera @ found.R.T * found.scale
    information = np.sum(turned**2) * np.eye(3) - turned.T @ turned
    # Without noise, nothing is known about turns around the only axis; this must not divide by 0.
    information += 1e-12 * np.trace(information) * np.eye(3)
    covariance = np.asarray(variance * np.linalg.inv(information), np.float64)
    unexplained = size / max(float(np.median(np.linalg.norm(found.gyro, axis=1))), 1e-12)
    coarse = Alignment(
        found.R, covariance, offset, sigma, found.bias, found.scale,
        found.mirrored < _MIRRORED, unexplained, rate,
    )  # fmt: skip
    if coarse.mirrored or unexplained > _REFINED or abs(coarse.scale - 1.0) > _REFINED:
        return coarse
    return _refined(coarse, times, rotations, samples)


@dataclass(frozen=True)
class _Fit:
    """The rotation for one time offset. ``camera`` and ``gyro`` are ``(K, 3)`` rates about their
    means. ``mirrored`` is the residual with a reversed axis, relative to that without."""

    R: Matrix
    scale: float
    bias: Array
    camera: Array
    gyro: Array
    residual: Array
    cost: float
    mirrored: float


def _fit(
    begins: Array, ends: Array, camera: Array, times: Array, integral: Array, offset: float
) -> _Fit:
    inside = (begins + offset >= times[0]) & (ends + offset <= times[-1])
    if inside.sum() < _FEWEST:
        nothing = np.zeros((0, 3))
        return _Fit(np.eye(3), 1.0, np.zeros(3), nothing, nothing, nothing, np.inf, 1.0)
    b, e = begins[inside] + offset, ends[inside] + offset
    rates = [
        (np.interp(e, times, integral[:, k]) - np.interp(b, times, integral[:, k])) / (e - b)
        for k in range(3)
    ]
    gyro, camera = np.column_stack(rates), camera[inside]
    size = np.linalg.norm(camera, axis=1)  # a relocalised camera seems to turn by any angle
    weight = _weights(size, 4.0)
    for _ in range(3):  # reweighted, because a camera may be lost for some frames
        share = (weight / weight.sum())[:, None]
        mean_camera, mean_gyro = (share * camera).sum(axis=0), (share * gyro).sum(axis=0)
        c, g = camera - mean_camera, gyro - mean_gyro
        U, S, Vt = np.linalg.svd((share * g).T @ c)
        sign = float(np.sign(np.linalg.det(U @ Vt))) or 1.0
        R = U @ np.diag([1.0, 1.0, sign]) @ Vt
        power = max(float((share * c**2).sum()), 1e-12)
        scale = float(S @ (1.0, 1.0, sign)) / power
        residual = g - scale * c @ R.T
        size = np.linalg.norm(residual, axis=1)
        weight = _weights(size, 2.0)
    total = float((share * g**2).sum())
    plain = max(total - scale**2 * power, 1e-12)
    other = max(total - float(S @ (1.0, 1.0, -sign)) ** 2 / power, 1e-12)
    bias = mean_gyro - scale * R @ mean_camera
    return _Fit(R, scale, bias, c, g, residual, plain / max(total, 1e-12), other / plain)


def _weights(size: Array, medians: float) -> Array:
    """Return the weights of errors with ``(K,)`` sizes, which fall from that many medians on."""
    least = max(medians * float(np.median(size)), 1e-12)
    return np.asarray(np.minimum(1.0, least / np.maximum(size, 1e-12)) ** 2)


def _refined(coarse: Alignment, times: Array, rotations: Matrix, samples: Matrix) -> Alignment:
    """Refine the rotation, the offset and the bias by Gauss-Newton steps, from rotations over
    `_SPAN_S`."""
    span = max(1, round(_SPAN_S / float(np.median(np.diff(times)))))
    relative = rotations[:-span].transpose(0, 2, 1) @ rotations[span:]
    starts, ends = times[:-span], times[span:]
    used = np.isfinite(relative).all(axis=(1, 2)) & (ends - starts < 2.0 * _SPAN_S)
    used &= (starts + coarse.time_offset > samples[0, 0] + _STEP_S) & (
        ends + coarse.time_offset < samples[-1, 0] - _STEP_S
    )
    if used.sum() < _FEWEST:
        return coarse
    starts, ends, camera = starts[used], ends[used], _logarithms(relative[used])
    R, offset, bias, h = coarse.R_imu_camera, coarse.time_offset, coarse.bias, 0.25 * _STEP_S
    for _ in range(_ROUNDS):
        turned = partial(_turned, *_integrated(samples, bias), samples[:, 0])
        expected = camera @ R.T
        residual = turned(starts + offset, ends + offset) - expected
        slope = turned(starts + offset + h, ends + offset + h)
        slope = (slope - turned(starts + offset - h, ends + offset - h)) / (2.0 * h)
        J = np.empty((len(residual), 3, 7))  # of the rotation, the bias and the offset
        J[:, :, :3] = np.cross(expected[:, None], np.eye(3)).transpose(0, 2, 1)
        J[:, :, 3:6] = (starts - ends)[:, None, None] * np.eye(3)
        J[:, :, 6] = slope
        weight = _weights(np.linalg.norm(residual, axis=1), 2.0)
        H = np.einsum("k,kia,kib->ab", weight, J, J)
        H += 1e-12 * np.diag(np.diag(H))
        scores = weight[:, None] * np.einsum("kia,ki->ka", J, residual)
        step = -np.linalg.solve(H, scores.sum(axis=0))
        R, bias, offset = _exponentials(step[None, :3])[0] @ R, bias + step[3:6], offset + step[6]
    if not abs(offset - coarse.time_offset) < _STEP_S:  # or NaN: it has not converged
        return coarse
    middle = scores.T @ scores
    for lag in range(1, 2 * span + 1):
        products = scores[lag:].T @ scores[:-lag]
        middle += (1.0 - lag / (2 * span + 1)) * (products + products.T)
    inverse = np.linalg.inv(H)
    covariance = inverse @ middle @ inverse
    return replace(
        coarse, R_imu_camera=R, covariance=covariance[:3, :3], time_offset=float(offset),
        sigma=float(np.sqrt(covariance[6, 6])), bias=bias,
    )  # fmt: skip


def _integrated(samples: Matrix, bias: Array) -> tuple[Matrix, Array]:
    """Integrate the rates of ``(N, 7)`` samples by the midpoint rule.

    Returns:
        ``(N, 3, 3)`` rotations from the IMU at each sample to the IMU at the first one, and the
        ``(N - 1, 3)`` rates between the samples.
    """
    rates = 0.5 * (samples[1:, 1:4] + samples[:-1, 1:4]) - bias
    steps = _exponentials(rates * np.diff(samples[:, 0])[:, None])
    found = np.empty((len(samples), 3, 3))
    found[0] = np.eye(3)
    for k, step in enumerate(steps):
        found[k + 1] = found[k] @ step
    return found, rates


def _turned(rotations: Matrix, rates: Array, times: Array, starts: Array, ends: Array) -> Array:
    """Return the ``(K, 3)`` rotation vectors by which the IMU turns from ``starts`` to ``ends``."""

    def at(t: Array) -> Matrix:
        k = (np.searchsorted(times, t, side="right") - 1).clip(0, len(rates) - 1)
        return rotations[k] @ _exponentials(rates[k] * (t - times[k])[:, None])

    return _logarithms(at(starts).transpose(0, 2, 1) @ at(ends))


def _minimum(cost: Callable[[float], float], middle: float, reach: float) -> float:
    """Find the minimum of a function near a value by two parabolas."""
    for _ in range(3):
        left, centre, right = (cost(middle + k * reach) for k in (-1, 0, 1))
        bend = left - 2.0 * centre + right
        if not (np.isfinite(bend) and bend > 0.0):
            return middle
        middle += float(np.clip(0.5 * (left - right) / bend, -1.0, 1.0)) * reach
        reach *= 0.5
    return middle


def _exponentials(turns: Array) -> Matrix:
    """Return the ``(M, 3, 3)`` rotations of ``(M, 3)`` rotation vectors."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(turns).as_matrix(), np.float64)


def _logarithms(R: Matrix) -> Array:
    """Return ``(M, 3)`` rotation vectors of ``(M, 3, 3)`` rotations."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(R).as_rotvec(), np.float64)
