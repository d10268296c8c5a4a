"""Checks of an IMU: its samples, and its rotations against those of the camera.

The samples alone show a wrong rate, gaps, clipping, dead axes, wrong units and wrong noise
densities. The rotations of a few seconds of images show wrong extrinsics, mirrored axes, degrees,
biases and a time offset. The rotation and the offset are found as by Furgale et al. (IROS 2013),
but directly by least squares: for each offset, the rotation that maps the camera's angular rates to
the gyroscope's has a closed form (Kabsch, Acta Crystallographica 1976).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vslam.types.geometry import Matrix
from vslam.types.imu import GRAVITY, ImuNoise

Array = NDArray[np.float64]

SLOWEST_HZ = 50.0
"""A slower IMU misses rotations of hand-held and flying cameras between two samples."""

_GAP, _GAP_S = 3.5, 0.03  # a longer step, in intervals and in seconds, is a gap
_MISSING = 0.01  # largest share of the time in gaps
_LONGEST_GAP_S = 0.1  # one gap of this length loses the velocity
_CLIPPED = 3  # samples in a row at the limit of the sensor
_LEAST_LIMIT = (1.5, 14.0)  # smallest limits of sensors, in rad/s and m/s^2
_FASTEST = 40.0  # rad/s; the widest range of a gyroscope is 2,000 degrees/s
_REST_S = 0.5  # length of the windows in which rest is sought
_REST_TURN, _REST_FORCE = 0.02, 0.15  # largest standard deviations at rest, in rad/s and m/s^2
_REST_RATE = 0.1  # rad/s; largest mean rate at rest, which a bias may reach
_GRAVITY_AT_REST, _GRAVITY_MOVING = 0.05, 0.15  # largest relative errors of its length
# Largest ratios of measured and given density. The idling motors of EuRoC's V1_01 make the noise of
# a standing vehicle 2.2 and 4.1 times as large. Densities are often enlarged tenfold on purpose.
_NOISIER, _QUIETER = 10.0, 100.0
_WIDEST_S, _STEP_S = 0.3, 0.01  # search for the time offset
_LEAST_OFFSET_S, _LEAST_TURN = 0.004, np.radians(3.0)  # smaller errors are not reported
_SIGMAS = 5.0
_LEAST_RATE = 0.05  # rad/s; root mean square of the camera's rotation that allows a verdict
_FEWEST = 20  # intervals between frames
_MIRRORED = 0.5  # ratio of the residuals with and without a mirrored axis
_UNEXPLAINED = 0.5  # share of the gyroscope's rates that no rotation of the camera explains
_SCALE = 0.1  # relative
_LARGEST_BIAS = 0.1  # rad/s
_MEDIAN_OF_CHI = 1.538  # median length of three standard normal numbers


@dataclass(frozen=True)
class Check:
    """The result of one check.

    Attributes:
        name: name of the check.
        wrong: whether there is a fault; None if the data allow no verdict.
        measured: the measurement with its unit.
        fix: what to change if there is a fault.
        harmful: whether a run with this fault would be worse than one without the IMU.
    """

    name: str
    wrong: bool | None
    measured: str
    fix: str = ""
    harmful: bool = False


def check_samples(samples: Matrix, noise: ImuNoise | None = None) -> list[Check]:
    """Check the samples of an IMU alone.

    Args:
        samples: ``(N, 7)``, as described in `vslam.types.imu`.
        noise: densities that a file states; None if there are none.
    """
    if len(samples) < 10:
        few = f"{len(samples)} samples"
        return [Check("IMU rate", True, few, "record the IMU during the whole drive", True)]
    steps = np.diff(samples[:, 0])
    step = float(np.median(steps))
    found = [
        Check(
            "IMU rate",
            1.0 / step < SLOWEST_HZ,
            f"{1.0 / step:.4g} samples per second",
            f"record at least {SLOWEST_HZ:g}, better 200 samples per second",
            harmful=True,
        ),
        _check_gaps(steps, step),
        _check_clipping(samples),
        _check_axes(samples),
    ]
    fastest = float(np.abs(samples[:, 1:4]).max())
    if fastest > _FASTEST:
        found.append(
            Check(
                "gyroscope",
                True,
                f"up to {fastest:.0f} rad/s, which is more than any gyroscope measures",
                "the rates are in degrees per second: multiply them by 0.0174533",
                harmful=True,
            )
        )
    rest = at_rest(samples)
    found.append(_check_gravity(samples, rest))
    if noise is not None:
        found.append(_check_noise(samples, rest, noise, step))
    return found


def at_rest(samples: Matrix) -> NDArray[np.bool_]:
    """Return which of ``(N, 7)`` samples belong to half seconds in which the IMU stands still."""
    times = samples[:, 0]
    still = np.zeros(len(samples), np.bool_)
    edges = np.searchsorted(times, np.arange(times[0], times[-1], _REST_S))
    for begin, end in pairwise(edges.tolist()):
        window = samples[begin:end]
        if len(window) < 10:
            continue
        spread, rate = window.std(axis=0), np.linalg.norm(window[:, 1:4].mean(axis=0))
        quiet = spread[1:4].max() < _REST_TURN and spread[4:].max() < _REST_FORCE
        still[begin:end] = quiet and rate < _REST_RATE
    return still


def _check_gaps(steps: Array, step: float) -> Check:
    gaps = steps > max(_GAP * step, _GAP_S)
    longest = float(steps.max())
    missing = float(steps[gaps].sum() / steps.sum())
    return Check(
        "IMU gaps",
        missing > _MISSING or longest > max(_LONGEST_GAP_S, _GAP * step),
        f"{int(gaps.sum())} gaps, the longest {longest:.3f} s, {100 * missing:.1f} % of the time",
        "samples were lost during recording: use a faster disk or a larger queue",
        harmful=missing > 10 * _MISSING,
    )


def _check_clipping(samples: Matrix) -> Check:
    worst, where = 0, ""
    for axis in range(6):
        values = np.abs(samples[:, 1 + axis])
        limit = float(values.max())
        if limit < _LEAST_LIMIT[axis // 3]:
            continue
        at_limit = np.concatenate([[False], values >= limit * (1.0 - 1e-6), [False]])
        changes = np.flatnonzero(np.diff(at_limit.astype(np.int8)))
        runs = changes[1::2] - changes[::2]
        n = int(runs[runs >= _CLIPPED].sum())
        if n > worst:
            sensor, unit = (("gyroscope", "rad/s"), ("accelerometer", "m/s^2"))[axis // 3]
            worst, where = n, f" of the {sensor}'s {'xyz'[axis % 3]} axis at {limit:.4g} {unit}"
    return Check(
        "clipping",
        worst > 0,
        f"{worst} samples in rows{where}" if worst else "no samples at the limit of the sensor",
        "set a wider range of the sensor",
    )


def _check_axes(samples: Matrix) -> Check:
    dead = [
        f"{name} {'xyz'[axis]}"
        for k, name in enumerate(("gyroscope", "accelerometer"))
        for axis in range(3)
        if np.ptp(samples[:, 1 + 3 * k + axis]) == 0.0
    ]
    return Check(
        "IMU axes",
        bool(dead),
        f"{', '.join(dead)} never changes" if dead else "all six axes measure",
        "record all axes of gyroscope and accelerometer, or choose the topics of both",
        harmful=True,
    )


def _check_gravity(samples: Matrix, rest: NDArray[np.bool_]) -> Check:
    still = bool(rest.any())
    length = float(np.median(np.linalg.norm(samples[rest if still else slice(None), 4:], axis=1)))
    error = length / GRAVITY - 1.0
    in_g = abs(length - 1.0) < 0.3
    return Check(
        "gravity",
        abs(error) > (_GRAVITY_AT_REST if still else _GRAVITY_MOVING),
        f"{length:.4g} m/s^2 {'at rest' if still else 'in the middle'}, {100 * error:+.1f} %",
        f"the specific forces are in g: multiply them by {GRAVITY}"
        if in_g
        else "calibrate the accelerometer, and check the unit of the specific forces",
        harmful=abs(error) > 2.0 * _GRAVITY_MOVING,
    )


def _check_noise(samples: Matrix, rest: NDArray[np.bool_], noise: ImuNoise, step: float) -> Check:
    """Compare the noise at rest with the given densities. Differences of neighbouring samples are
    used, because slow motions of a standing vehicle are not noise."""
    pairs = rest[1:] & rest[:-1]
    if pairs.sum() < 100:
        return Check("IMU noise", None, "the camera never stands still, so noise is not measured")
    spread = np.diff(samples, axis=0)[pairs].std(axis=0) * np.sqrt(0.5 * step)
    measured = {"gyro": float(spread[1:4].max()), "accel": float(spread[4:].max())}
    ratios = {name: value / getattr(noise, name) for name, value in measured.items()}
    name = max(ratios, key=lambda one: abs(np.log(max(ratios[one], 1e-9))))
    ratio = ratios[name]
    key = {"gyro": "gyroscope", "accel": "accelerometer"}[name] + "_noise_density"
    return Check(
        "IMU noise",
        ratio > _NOISIER or ratio < 1.0 / _QUIETER,
        f"gyroscope {measured['gyro']:.2g} rad/s/sqrt(Hz) at rest, {ratios['gyro']:.2g} times the "
        f"given density; accelerometer {measured['accel']:.2g} m/s^2/sqrt(Hz), "
        f"{ratios['accel']:.2g} times",
        f"write {key}: {measured[name]:.2g}",
    )


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
    offsets = np.arange(-_WIDEST_S, _WIDEST_S + 0.5 * _STEP_S, _STEP_S)
    costs = [fit(offset).cost for offset in offsets.tolist()]
    best = int(np.argmin(costs))
    if not np.isfinite(costs[best]):
        return None
    offset = _minimum(lambda at: fit(at).cost, float(offsets[best]), _STEP_S)
    found = fit(offset)
    rate = float(np.sqrt(np.mean(np.sum(found.camera**2, axis=1))))
    if rate < _LEAST_RATE:
        return None
    # How the rates at the frames change with the offset, for its standard deviation.
    h = 0.5 * _STEP_S
    slope = (fit(offset + h).gyro - fit(offset - h).gyro) / (2.0 * h)
    size = float(np.median(np.linalg.norm(found.residual, axis=1)))
    variance = (size / _MEDIAN_OF_CHI) ** 2 + 1e-12
    sigma = float(np.sqrt(variance / max(float(np.sum(slope**2)), 1e-12)))
    turned = found.camera @ found.R.T * found.scale
    information = np.sum(turned**2) * np.eye(3) - turned.T @ turned
    inverse = np.linalg.pinv(information, hermitian=True, rcond=1e-9)
    covariance: Matrix = variance * np.asarray(inverse, np.float64)
    unexplained = size / max(float(np.median(np.linalg.norm(found.gyro, axis=1))), 1e-12)
    return Alignment(
        found.R, covariance, offset, sigma, found.bias, found.scale,
        found.mirrored < _MIRRORED, unexplained, rate,
    )  # fmt: skip


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


def check_alignment(
    found: Alignment | None, R_imu_camera: Matrix | None, time_offset: float = 0.0
) -> list[Check]:
    """Compare the rotations of the camera and of the gyroscope with a calibration.

    Args:
        R_imu_camera: ``(3, 3)`` rotation of ``T_imu_camera``; None if it is unknown.
        time_offset: that of the calibration.
    """
    name = "IMU rotation"
    if found is None:
        few = "the camera hardly turns, or is not tracked while the IMU measures"
        return [Check(name, None, f"{few}; turn it about all axes")]
    if abs(np.log(max(found.scale, 1e-9) * np.pi / 180.0)) < 0.3:
        fix = "the rates are in degrees per second: multiply them by 0.0174533"
        measured = f"the gyroscope turns {found.scale:.1f} times as fast as the camera"
        return [Check("gyroscope", True, measured, fix, harmful=True)]
    if found.mirrored:
        measured = f"one axis is reversed: it explains {_percent(found)} of the rates otherwise"
        fix = "the axes are left-handed: reverse the sign of one axis, or swap two axes back"
        return [Check("gyroscope", True, measured, fix, harmful=True)]
    if found.unexplained > _UNEXPLAINED:
        measured = f"the camera explains {_percent(found)} of the gyroscope's rates"
        fix = (
            f"the clocks differ by more than {_WIDEST_S:g} s, an axis is missing, or the samples "
            "belong to another drive"
        )
        return [Check("gyroscope", True, measured, fix, harmful=True)]
    bias = float(np.linalg.norm(found.bias))
    checks = [
        Check(
            "gyroscope",
            abs(found.scale - 1.0) > _SCALE,
            f"turns {found.scale:.3f} times as fast as the camera",
            "check the focal length of the camera and the unit of the gyroscope",
            harmful=abs(found.scale - 1.0) > _SCALE,
        ),
        Check(
            "gyroscope bias",
            bias > _LARGEST_BIAS,
            f"({', '.join(f'{b:+.4f}' for b in found.bias)}) rad/s",
            "subtract the mean rate at rest from the samples",
        ),
        _check_offset(found, time_offset),
    ]
    if R_imu_camera is None:
        return [*checks, Check(name, None, f"measured {rotation_text(found.R_imu_camera)}")]
    return [*checks, _check_rotation(found, R_imu_camera)]


def _percent(found: Alignment) -> str:
    return f"{100.0 * max(0.0, 1.0 - found.unexplained):.0f} %"


def _check_offset(found: Alignment, given: float) -> Check:
    error = found.time_offset - given
    least = max(_LEAST_OFFSET_S, _SIGMAS * found.sigma)
    return Check(
        "IMU time",
        abs(error) > least,
        f"offset {1e3 * found.time_offset:+.1f} ms (standard deviation {1e3 * found.sigma:.1f}), "
        f"given {1e3 * given:+.1f} ms",
        f"write time_offset: {found.time_offset:.4f}",
        harmful=abs(error) > 3.0 * least,
    )


def _check_rotation(found: Alignment, given: Matrix) -> Check:
    error = _error(found, given)
    inverse = _error(found, given.T)
    significant = float(error @ np.linalg.pinv(found.covariance, hermitian=True) @ error)
    angle = float(np.linalg.norm(error))
    wrong = bool(angle > _LEAST_TURN and significant > _SIGMAS**2)
    reversed_ = wrong and float(np.linalg.norm(inverse)) < 0.3 * angle
    fix = (
        "T_imu_camera is given the other way round: use its inverse"
        if reversed_
        else f"write the rotation {rotation_text(found.R_imu_camera)} into T_imu_camera"
    )
    sigma = float(np.sqrt(max(np.trace(found.covariance), 0.0)))
    return Check(
        "IMU rotation",
        wrong,
        f"{np.degrees(angle):.2f} degrees from T_imu_camera (standard deviation "
        f"{np.degrees(sigma):.2f})",
        fix,
        harmful=wrong,
    )


def _error(found: Alignment, given: Matrix) -> Array:
    return _logarithms((found.R_imu_camera @ given.T)[None])[0]


def rotation_text(R: Matrix) -> str:
    """Format a rotation as rows, to be written into a calibration file."""
    return str([[round(x, 5) for x in row] for row in R.tolist()])


def _logarithms(R: Matrix) -> Array:
    """Return ``(M, 3)`` rotation vectors of ``(M, 3, 3)`` rotations."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(R).as_rotvec(), np.float64)
