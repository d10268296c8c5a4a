"""Measures the rotation and the time offset of an IMU from a drive, for its calibration file."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vslam.calibration.models import Calibration
from vslam.calibration.rectification import rectify
from vslam.config import Config
from vslam.datasets.frames import Source
from vslam.doctor.imu import measure_alignment
from vslam.run.imu_alignment import Alignment
from vslam.run.imu_checks import check_alignment, check_samples
from vslam.support.errors import InputError
from vslam.types.geometry import inverse
from vslam.types.imu import ImuCalibration

LONGEST_S, MOST_FRAMES = 20.0, 400  # images that are tracked
_ROTATION, _OFFSET_S = np.radians(0.5), 1e-3  # largest standard deviations that are written


@dataclass(frozen=True)
class MeasuredImu:
    """The calibration of an IMU, as measured from a drive.

    Attributes:
        alignment: the measurement; its rotation is that of the left camera before rectification.
        old: what the calibration says about the IMU; None if it does not tell where the IMU is.
        new: the calibration in which what contradicts the measurement is replaced. Values that
            agree with it are kept, because those of Kalibr are more accurate.
        replaced: the keys of the calibration file whose values are new.
    """

    alignment: Alignment
    old: ImuCalibration | None
    new: Calibration
    replaced: tuple[str, ...]


def measure_imu(source: Source, config: Config) -> MeasuredImu:
    """Measure where the IMU of a source is turned to, and how its clock differs.

    The translation is kept, or 0 if there is none, because rotations do not show it.

    Args:
        source: a source that can seek, with a recorded IMU.

    Raises:
        InputError: there is no IMU, its samples are unusable, or the camera turns too little.
    """
    imu, calibration = source.imu, source.calibration or Calibration.of_rectified(source.camera)
    if imu is None:
        raise InputError(
            f"{source.name}: there is no IMU; put its samples into imu.csv (docs/howto/imu.md)."
        )
    for check in check_samples(imu.recorded.samples):
        if check.wrong and check.harmful:
            raise InputError(f"{imu.name}: {check.name}: {check.measured}; {check.fix}.")
    found = measure_alignment(source, config, LONGEST_S, MOST_FRAMES)
    R_left_rectified = np.eye(3)
    if source.camera.sensor == "stereo":
        R_left_rectified = rectify(calibration).R_left_rectified
    if found is None:
        raise InputError(
            f"{source.name}: the camera hardly turns, or is not tracked while the IMU measures; "
            "turn it about all axes for ten seconds, in view of near and far objects."
        )
    found = replace(found, R_imu_camera=found.R_imu_camera @ R_left_rectified.T)
    old, T = None, np.eye(4)
    if imu.calibration is not None:
        T = imu.calibration.T_imu_camera.copy()
        T[:3, :3] @= R_left_rectified.T
        old = replace(imu.calibration, T_imu_camera=T)
    given = (None, 0.0) if old is None else (T[:3, :3], old.time_offset)
    checks = {check.name: check for check in check_alignment(found, *given)}
    gyroscope = checks["gyroscope"]
    if gyroscope.wrong:
        raise InputError(f"{imu.name}: {gyroscope.measured}; {gyroscope.fix}.")
    turn = found.rotation_sigma
    if turn > _ROTATION or found.sigma > _OFFSET_S:
        raise InputError(
            f"{source.name}: the camera turns too little or about one axis only, so that the "
            f"rotation is uncertain by {np.degrees(turn):.1f} degrees and time_offset by "
            f"{1e3 * found.sigma:.1f} ms; turn it quickly about all axes for ten seconds."
        )
    turned = old is None or bool(checks["IMU rotation"].wrong)
    late = old is None or bool(checks["IMU time"].wrong)
    if turned and old is not None and found.inverse_of(T[:3, :3]):
        T = inverse(T)
    elif turned:
        T[:3, :3] = found.R_imu_camera
    offset = round(found.time_offset, 6) if late or old is None else old.time_offset
    one = ImuCalibration(T) if old is None else old
    one = replace(one, T_imu_camera=T, time_offset=offset)
    return MeasuredImu(
        found, old, replace(calibration, imu=one, imu_noise=imu.noise),
        ("T_imu_camera",) * turned + ("time_offset",) * late,
    )  # fmt: skip
