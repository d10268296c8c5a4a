"""Checks the IMU of a source, also against the rotations of a few seconds of images."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from vslam.config import Config
from vslam.datasets.frames import Source
from vslam.doctor.findings import Finding
from vslam.run.imu_alignment import Alignment, align
from vslam.run.imu_checks import Check, check_alignment, check_samples
from vslam.slam import Slam
from vslam.support.errors import InputError, UnreadableImageError
from vslam.types.features import TrackingState
from vslam.types.geometry import Matrix

_LONGEST_S, _MOST_FRAMES = 8.0, 160  # images that are tracked
_PLACE = "measure T_imu_camera with vslam calibrate --imu, or add it (docs/howto/imu.md)"


def examine_imu(source: Source, config: Config) -> list[Finding]:
    """Check the samples and the calibration of the IMU. A source without an IMU has no findings.

    The source must be able to seek.
    """
    imu = source.imu
    if imu is None or imu.live:
        return []
    try:
        found = imu.recorded
    except InputError as error:
        measured, _, fix = str(error).rstrip(".").rpartition("; ")
        return [Finding("IMU", "fault", measured or fix, fix if measured else "")]
    checks = check_samples(found.samples, imu.noise)
    if found.notes:
        fix = "record each sample once, in order, with the time at which it was measured"
        checks.insert(0, Check("order of samples", True, "; ".join(found.notes), fix))
    calibration = imu.calibration
    if calibration is None:
        checks.append(Check("IMU calibration", True, "T_imu_camera is unknown", _PLACE))
    offset = 0.0 if calibration is None else calibration.time_offset
    R = None if calibration is None else calibration.T_imu_camera[:3, :3]
    checks += check_alignment(measure_alignment(source, config), R, offset)
    return [_finding(check) for check in checks]


def measure_alignment(
    source: Source, config: Config, longest_s: float = _LONGEST_S, most_frames: int = _MOST_FRAMES
) -> Alignment | None:
    """Track the part of a source in which its IMU turns most, and compare the rotations.

    Args:
        longest_s, most_frames: limits of the length of that part.

    Returns:
        None if the camera hardly turns or cannot be tracked.

    Raises:
        InputError: the samples cannot be read.
    """
    imu = source.imu
    if imu is None or len(imu.recorded.samples) < 2:
        return None
    samples = imu.recorded.samples
    offset = 0.0 if imu.calibration is None else imu.calibration.time_offset
    chosen = _liveliest(source.timestamps + offset, samples, longest_s, most_frames)
    return align(source.timestamps[chosen], track_rotations(source, chosen, config), samples)


def _liveliest(
    times: NDArray[np.float64], samples: Matrix, longest_s: float, most_frames: int
) -> slice:
    """Return the frames of a few seconds in which the rates of the gyroscope change most."""
    interval = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    n = min(len(times), most_frames, max(2, round(longest_s / interval)))
    best, begin = -1.0, 0
    for first in range(0, len(times) - n + 1, max(1, n // 4)):
        inside = (samples[:, 0] >= times[first]) & (samples[:, 0] <= times[first + n - 1])
        spread = np.sort(samples[inside, 1:4].std(axis=0)) if inside.any() else np.zeros(3)
        if spread[1] > best:  # a rotation is known only if the camera turns about two axes
            best, begin = float(spread[1]), first
    return slice(begin, begin + n)


def track_rotations(source: Source, chosen: slice, config: Config) -> Matrix:
    """Return ``(M, 3, 3)`` ``R_wc`` of the chosen frames, NaN where the camera is lost."""
    frames = source.stored[chosen]
    rotations = np.full((len(frames), 3, 3), np.nan)
    slam = Slam(source.camera, config, "none")
    for k, frame in enumerate(frames):
        with suppress(UnreadableImageError):
            left, second = frame.read(map)
            result = slam.step(left, second, frame.timestamp)
            if result.state in (TrackingState.OK, TrackingState.WEAK):
                rotations[k] = result.T_wc[:3, :3]
    return rotations


def _finding(check: Check) -> Finding:
    if check.wrong is None:
        return Finding(check.name, "unknown", check.measured)
    if check.wrong:
        return Finding(check.name, "fault", check.measured, check.fix)
    return Finding(check.name, "good", check.measured)
