"""Checks of an IMU: its samples, and its rotations against those of the camera.

The samples alone show a wrong rate, gaps, clipping, dead axes, wrong units and wrong noise
densities. The rotations of a few seconds of images show wrong extrinsics, mirrored axes, degrees,
biases and a time offset (`vslam.run.imu_alignment`).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vslam.backend.inertial_start import GYRO_BIAS
from vslam.run.imu_alignment import WIDEST_S, Alignment
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
_LEAST_OFFSET_S, _LEAST_TURN = 0.004, np.radians(3.0)  # smaller errors are not reported
_SIGMAS = 5.0
_UNEXPLAINED = 0.5  # share of the gyroscope's rates that no rotation of the camera explains
_SCALE = 0.1  # relative
_LARGEST_BIAS = 3.0 * GYRO_BIAS  # rad/s; the inertial start expects smaller ones


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
            f"the clocks differ by more than {WIDEST_S:g} s, an axis is missing, or the samples "
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
    error = found.turn_from(given)
    significant = float(error @ np.linalg.pinv(found.covariance, hermitian=True) @ error)
    angle = float(np.linalg.norm(error))
    wrong = bool(angle > _LEAST_TURN and significant > _SIGMAS**2)
    fix = (
        "T_imu_camera is given the other way round: use its inverse"
        if wrong and found.inverse_of(given)
        else f"write the rotation {rotation_text(found.R_imu_camera)} into T_imu_camera"
    )
    return Check(
        "IMU rotation",
        wrong,
        f"{np.degrees(angle):.2f} degrees from T_imu_camera (standard deviation "
        f"{np.degrees(found.rotation_sigma):.2f})",
        fix,
        harmful=wrong,
    )


def rotation_text(R: Matrix) -> str:
    """Format a rotation as rows, to be written into a calibration file."""
    return str([[round(x, 5) for x in row] for row in R.tolist()])
