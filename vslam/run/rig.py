"""Detects problems of a stereo rig during a run, and warns about these problems in the report."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.types.camera import Camera, calibration_doubts
from vslam.types.geometry import compose, inverse, orthonormalised, se3_log
from vslam.types.map import Map
from vslam.types.states import ComparedSides

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
# On KITTI 00 and 06 and four rendered drives, the size of the estimated delay plus two standard
# deviations is at most 0.14 ms for a correct rig, and at least 0.28 ms for a true delay of 2 ms.
# The measurement in the images, which costs a hundred times as much, warns from 3 ms on KITTI 00.
# [own]
_SOUND_DELAY_S, _STRETCHES = 0.2e-3, 10


def measure_offset(map_: Map, camera: Camera) -> float | None:
    """Estimate the constant error in all disparities of a map, in pixels.

    The result is None if there are too few observations, if the camera is not a stereo camera, or
    if a delay of the right image distorts the disparities.
    """
    seen = _right_images(map_, camera)
    if seen is None:
        return None
    delay, offset, _ = fit(seen.residual, seen.speed, seen.disparity)
    return None if seen.moves and abs(delay) > _SUSPECT_DELAY_S else offset


def is_synchronised(map_: Map, camera: Camera) -> bool:
    """Return whether the map shows that the right images of its last drive were taken when the
    calibration says.

    The result is False if there is any doubt, or if the map cannot tell. Then, the delay must be
    measured in the images (``side_delay``).
    """
    seen = _right_images(map_, camera, session=map_.scalars.session)
    if seen is None or not seen.moves:
        return False
    A = np.stack([seen.speed, np.ones_like(seen.speed), seen.disparity], axis=1)
    x = np.array(fit(seen.residual, seen.speed, seen.disparity))
    weight = np.minimum(1.0, _HUBER_PX / np.maximum(np.abs(seen.residual - A @ x), 1e-9))
    # Jackknife over stretches of the drive, because a delay that bundle adjustment has partly
    # absorbed differs from stretch to stretch.
    table = np.column_stack([A, seen.residual]) * np.sqrt(weight)[:, None]
    order = np.argsort(seen.keyframe, kind="stable")
    moments = np.array([part.T @ part for part in np.array_split(table[order], _STRETCHES)])
    rest = moments.sum(axis=0) - moments
    delays = [np.linalg.lstsq(one[:3, :3], one[:3, 3])[0][0] for one in rest]
    sigma = np.sqrt(_STRETCHES - 1) * np.std(delays)
    return bool(abs(x[0]) + 2.0 * sigma < _SOUND_DELAY_S)


@dataclass(frozen=True)
class _RightImages:
    """Features in the right images of a map.

    Attributes:
        residual, speed, disparity: ``(N,)``, see ``fit``.
        keyframe: ``(N,)`` ids of the keyframes.
    """

    residual: NDArray[np.float64]
    speed: NDArray[np.float64]
    disparity: NDArray[np.float64]
    keyframe: NDArray[np.int64]

    @property
    def moves(self) -> bool:
        """Whether features move enough for a delay to be observed."""
        return bool(self.speed.std() >= _LEAST_IMAGE_SPEED)


def _right_images(map_: Map, camera: Camera, session: int | None = None) -> _RightImages | None:
    """Return the features that a map has in right images. None if there are too few of them.

    Args:
        session: the only drive whose features are used; None uses those of all drives.
    """
    if camera.sensor != "stereo" or map_.n_keyframes < 3:
        return None
    arrays = map_.arrays
    stereo = (arrays.landmark[: map_.n_rows] >= 0) & np.isfinite(arrays.u_right[: map_.n_rows])
    if session is not None:
        stereo &= map_.sessions[arrays.keyframe[: map_.n_rows]] == session
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
    return _RightImages(
        residual[good], speed[good], disparity[good], keyframe[good].astype(np.int64)
    )


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


def offset_warnings(offset_px: float | None, camera: Camera) -> list[str]:
    """Return a warning if there is a constant error in the disparities."""
    if offset_px is None or abs(offset_px) <= _SUSPECT_OFFSET_PX:
        return []
    minutes = 60.0 * np.degrees(abs(offset_px) / camera.fx)
    return [
        f"All disparities are off by {abs(offset_px):.2f} pixels: the cameras are "
        f"rotated relative to their calibration by at least {minutes:.1f} arc minutes. "
        "Calibrate the rig again."
    ]


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
