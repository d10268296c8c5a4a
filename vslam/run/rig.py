"""Detects problems of a stereo rig during a run, and warns about these problems in the report."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, calibration_doubts
from vslam.frontend.side_delay import SideDelay
from vslam.geometry import compose, inverse, orthonormalised, se3_log
from vslam.map import Map
from vslam.states import ComparedSides

_FEWEST = 3  # frames; fewer may be caused by a reflection or a hand in front of the lens
_FEWEST_OBSERVATIONS, _MOST_OBSERVATIONS = 3_000, 100_000
_LARGEST_RESIDUAL_PX = 3.0
_HUBER_PX = 0.3
_ROUNDS = 10
# Least standard deviation of the image speed, in pixels per second. Without motion, a delay cannot
# be observed.
_LEAST_IMAGE_SPEED = 50.0
_LONGEST_GAP_S = 2.0  # between keyframes; the motion over a longer time is not known
# For a correct rig, the estimated delay is at most 0.15 ms and the estimated offset at most 0.11
# pixels. Bundle adjustment absorbs a part of both errors. For a true delay of 10 ms, the estimate
# is 1.1 ms. For a rotation by 2 arc minutes, the estimated offset is 0.29 pixels
# (docs/research/stress.md).
_SUSPECT_DELAY_S, _SUSPECT_OFFSET_PX = 0.4e-3, 0.2


@dataclass(frozen=True)
class RigResiduals:
    """Systematic errors in the columns of features in right images, estimated from the final map.

    Attributes:
        delay_s: apparent delay of the right image relative to the left image, in seconds. It causes
            residuals that are proportional to the speed of a feature in the image. The value is NaN
            if the camera hardly moved.
        offset_px: constant error in all disparities, in pixels.
    """

    delay_s: float
    offset_px: float


def measure_rig(map_: Map, camera: Camera) -> RigResiduals | None:
    """Estimate the delay of the right image and the offset of the disparities from a map.

    The result is None if there are too few observations, or if the camera is not a stereo camera.
    """
    if camera.sensor != "stereo" or map_.n_keyframes < 3:
        return None
    arrays = map_.arrays
    stereo = (arrays.landmark[: map_.n_rows] >= 0) & np.isfinite(arrays.u_right[: map_.n_rows])
    rows = np.flatnonzero(stereo)
    if len(rows) < _FEWEST_OBSERVATIONS:
        return None
    rows = rows[:: -(-len(rows) // _MOST_OBSERVATIONS)]
    keyframe = arrays.keyframe[rows]
    T_cw = arrays.T_cw[keyframe]
    p = np.einsum("nij,nj->ni", T_cw[:, :3, :3], arrays.xyz[arrays.landmark[rows]]) + T_cw[:, :3, 3]
    twist = _twists(map_)[keyframe]
    moved = twist[:, :3] + np.cross(twist[:, 3:], p)
    z = p[:, 2]
    speed = camera.fx * (moved[:, 0] - p[:, 0] * moved[:, 2] / z) / z
    disparity = camera.bf / z
    measured = arrays.xy[rows, 0].astype(np.float64) - arrays.u_right[rows]
    residual = disparity - measured  # measured minus predicted column in the right image
    good = (np.abs(residual) < _LARGEST_RESIDUAL_PX) & (z > 0) & np.isfinite(speed)
    if good.sum() < _FEWEST_OBSERVATIONS:
        return None
    delay, offset, _ = fit(residual[good], speed[good], disparity[good])
    still = speed[good].std() < _LEAST_IMAGE_SPEED
    return RigResiduals(float("nan") if still else delay, offset)


def fit(
    residual: NDArray[np.float64], speed: NDArray[np.float64], disparity: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Fit a delay, an offset and a disparity error to residuals in right images (Huber loss).

    Args:
        residual: ``(N,)`` measured minus predicted columns of features in right images, in pixels.
        speed: ``(N,)`` horizontal speeds of these features in the image, in pixels per second.
        disparity: ``(N,)`` disparities of these features, in pixels.

    Returns:
        The delay in seconds, the offset in pixels, and the relative error in the disparity.
    """
    A = np.stack([speed, np.ones_like(speed), disparity], axis=1)
    x = np.zeros(3)
    for _ in range(_ROUNDS):
        weight = np.sqrt(1.0 / np.maximum(1.0, np.abs(residual - A @ x) / _HUBER_PX))
        x = np.linalg.lstsq(A * weight[:, None], residual * weight, rcond=None)[0]
    return float(x[0]), float(x[1]), float(x[2])


def _twists(map_: Map) -> NDArray[np.float64]:
    """Return ``(K, 6)`` twists of the points relative to the camera at each keyframe, per second.

    A twist is NaN if the neighbouring keyframes are too far apart in time. Drives are treated
    separately, because each drive has its own clock.
    """
    T_cw, times = map_.arrays.T_cw, map_.timestamps
    twists = np.full((map_.n_keyframes, 6), np.nan)
    living = map_.living_keyframes()
    sessions = map_.sessions[living]
    for session in np.unique(sessions):
        drive = living[sessions == session]
        for k, keyframe in enumerate(drive):
            before, after = drive[max(0, k - 1)], drive[min(len(drive) - 1, k + 1)]
            elapsed = times[after] - times[before]
            if 0 < elapsed < _LONGEST_GAP_S:
                step = compose(T_cw[after], inverse(T_cw[before]))
                twists[keyframe] = se3_log(orthonormalised(step)) / elapsed
    return twists


def calibration_warnings(camera: Camera, calib: Sequence[Path], name: str) -> list[str]:
    """Return warnings about an implausible calibration.

    Args:
        calib: the files that ``--calib`` names. If there are none, the calibration belongs to the
            sequence with the name ``name``.
    """
    source = ", ".join(map(str, calib)) or f"the calibration of {name}"
    return [f"{source}: {doubt}." for doubt in calibration_doubts(camera)]


def delay_warnings(delay: SideDelay, camera: Camera) -> list[str]:
    """Return a warning if the measured delay of the right camera is not the calibrated delay."""
    if not delay.is_wrong:
        return []
    known = camera.right_delay
    side = "right" if delay.seconds > 0 else "left"
    instead = f" instead of {1e3 * known:.1f} ms (right_delay)" if known else ""
    return [
        f"The cameras are not synchronised: the rows of stereo matches show that the {side} "
        f"camera is {1e3 * abs(delay.seconds):.1f} ms late{instead}. Trigger both by one signal, "
        f"or write right_delay: {delay.seconds:.4f} (seconds) into the file that --calib names "
        "and run again; see docs/howto/cameras.md."
    ]


def residual_warnings(found: RigResiduals | None, camera: Camera) -> list[str]:
    """Return a warning if stereo residuals show a delay or a constant error in the disparities."""
    if found is None:
        return []
    warnings = []
    if abs(found.delay_s) > _SUSPECT_DELAY_S:
        side = "right" if found.delay_s > 0 else "left"
        warnings.append(
            f"The cameras seem not to be synchronised: the {side} camera is at least "
            f"{1e3 * abs(found.delay_s):.1f} ms late, and usually much more, because bundle "
            "adjustment absorbs most of a delay. Trigger both by one signal."
        )
    elif abs(found.offset_px) > _SUSPECT_OFFSET_PX:
        minutes = 60.0 * np.degrees(abs(found.offset_px) / camera.fx)
        warnings.append(
            f"All disparities are off by {abs(found.offset_px):.2f} pixels: the cameras are "
            f"rotated relative to their calibration by at least {minutes:.1f} arc minutes. "
            "Calibrate the rig again."
        )
    return warnings


def rig_warnings(sides: ComparedSides) -> list[str]:
    """Return warnings about a camera whose images are black or darker than the other camera's."""
    warnings = []
    for side, other, black, what in (
        ("left", "right", sides.n_black_left, "are lost"),
        ("right", "left", sides.n_black_right, "were tracked with the left image alone"),
    ):
        if black >= _FEWEST:
            warnings.append(
                f"The {side} image was black in {black} of {sides.n} frames while the {other} "
                f"image was not: these frames {what}. Check the cable, shutter and lens cap of the "
                f"{side} camera."
            )
    darker = sides.darker_stops
    if len(darker) >= _FEWEST:
        stops = statistics.median(darker)
        side, other = ("right", "left") if stops > 0 else ("left", "right")
        warnings.append(
            f"The {side} image was {abs(stops):.1f} stops darker than the {other} image in "
            f"{len(darker)} of {sides.n} frames: the {side} image was brightened to match. Check "
            "exposure, gain and aperture of both cameras."
        )
    return warnings
