"""Reads where the IMU is on the camera, how noisy it is, and how its clock differs.

The keys of the noise are those of Kalibr's ``imu.yaml``, which EuRoC's ``sensor.yaml``, OpenVINS'
``kalibr_imu_chain.yaml`` and vslam's own format share. ``T_imu_camera`` is read from the section
``imu`` of vslam's own format, from ``T_cam_imu`` in Kalibr's ``camchain-imucam.yaml``, from
``T_imu_cam`` in OpenVINS' ``kalibr_imucam_chain.yaml``, or from ``T_BS`` of the IMU and of the left
camera in EuRoC's layout.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vslam.calibration.documents import Document
from vslam.calibration.models import Array
from vslam.support.errors import InputError
from vslam.types.geometry import inverse
from vslam.types.imu import ImuCalibration, ImuNoise

NOISE_KEYS = {
    "gyro": "gyroscope_noise_density",
    "accel": "accelerometer_noise_density",
    "gyro_walk": "gyroscope_random_walk",
    "accel_walk": "accelerometer_random_walk",
}
"""Kalibr's key of each field of `ImuNoise`."""

_OWN_KEYS = {"T_imu_camera", "time_offset", *NOISE_KEYS.values()}
_UNITS = {
    "gyro": "rad/s/sqrt(Hz)",
    "accel": "m/s^2/sqrt(Hz)",
    "gyro_walk": "rad/s^2/sqrt(Hz)",
    "accel_walk": "m/s^3/sqrt(Hz)",
}
# Densities of IMUs from navigation grade to toys, with room for values that were enlarged on
# purpose. A forgotten exponent ("1.7" for "1.7e-4") or degrees are outside.
_PLAUSIBLE = {
    "gyro": (1e-7, 0.3),
    "accel": (1e-6, 3.0),
    "gyro_walk": (1e-9, 0.3),
    "accel_walk": (1e-8, 3.0),
}
_SWAPPED = 5.0  # the gyroscope's density in rad/s is below that of the accelerometer in m/s^2
_FARTHEST_M = 10.0  # from the camera to the IMU, on any vehicle
_LONGEST_OFFSET_S = 10.0  # a larger difference is another clock, not an offset


def is_imu(document: Document) -> bool:
    """Return whether a file describes an IMU and no camera."""
    keys = set(NOISE_KEYS.values()) | {"imu0"}
    return bool(keys & document.values.keys()) and "cam0" not in document


def read_imu(
    cameras: Sequence[Document], imus: Sequence[Document]
) -> tuple[ImuCalibration | None, ImuNoise | None]:
    """Read the calibration of the IMU from the files of the cameras and of the IMU.

    Args:
        cameras: the files of the cameras, the left one first.
        imus: files for which `is_imu` is True.

    Returns:
        The calibration, whose ``T_imu_camera`` is that of the left camera before rectification. It
        is None if the files do not tell where the IMU is. The noise; None if the files do not
        contain it.

    Raises:
        InputError: a number is missing or impossible.
    """
    if len(imus) > 1:
        raise InputError(f"--calib {imus[1].source}: vslam reads one IMU; leave this file out.")
    noise = None
    if imus:
        section = imus[0].section("imu0") if "imu0" in imus[0] else imus[0]
        noise = _noise(section)
    first = cameras[0]
    if "left" in first and "imu" in first:
        return _own(first.section("imu"), noise)
    T, section = None, first
    if "cam0" in first:
        section = first.section("cam0")
        if "T_cam_imu" in section:
            T = inverse(_checked(section.matrix("T_cam_imu", 4, 4), section.source, "T_cam_imu"))
        elif "T_imu_cam" in section:
            T = _checked(section.matrix("T_imu_cam", 4, 4), section.source, "T_imu_cam")
    elif imus and "T_BS" in first and "T_BS" in imus[0]:
        T_body_imu = _checked(imus[0].matrix("T_BS", 4, 4), imus[0].source, "T_BS")
        T = inverse(T_body_imu) @ _checked(first.matrix("T_BS", 4, 4), first.source, "T_BS")
    if T is None:
        return None, noise
    offset = _offset(section, "timeshift_cam_imu")
    return ImuCalibration(T, noise or ImuNoise(), offset), noise


def _own(
    section: Document, noise: ImuNoise | None
) -> tuple[ImuCalibration | None, ImuNoise | None]:
    for key in section.values:
        if key not in _OWN_KEYS:
            raise InputError(
                f"{section.source}: {key} is unknown; known are {', '.join(sorted(_OWN_KEYS))}."
            )
    noise = _noise(section) or noise
    offset = _offset(section, "time_offset")
    if "T_imu_camera" not in section:
        return None, noise
    T = _checked(section.matrix("T_imu_camera", 4, 4), section.source, "T_imu_camera")
    return ImuCalibration(T, noise or ImuNoise(), offset), noise


def _noise(section: Document) -> ImuNoise | None:
    """Read the densities. Those that are missing keep the values of an unknown IMU."""
    values = {}
    for name, key in NOISE_KEYS.items():
        if key not in section:
            continue
        value = values[name] = section.number(key)
        least, most = _PLAUSIBLE[name]
        if not least <= value <= most:
            raise InputError(
                f"{section.source}: {key} is {value:g}, but IMUs have {least:g} to {most:g} "
                f"{_UNITS[name]}; give the density in this unit."
            )
    if {"gyro", "accel"} <= values.keys() and values["gyro"] > _SWAPPED * values["accel"]:
        raise InputError(
            f"{section.source}: the noise densities of gyroscope ({values['gyro']:g}) and "
            f"accelerometer ({values['accel']:g}) seem swapped; swap them, and the random walks."
        )
    return ImuNoise(**values) if values else None


def _offset(section: Document, key: str) -> float:
    offset = section.number(key) if key in section else 0.0
    if abs(offset) > _LONGEST_OFFSET_S:
        raise InputError(
            f"{section.source}: {key} is {offset:g}, but it is in seconds and at most "
            f"{_LONGEST_OFFSET_S:g}; give the seconds that are added to times of the camera to "
            "get times of the IMU."
        )
    return offset


def _checked(T: Array, source: str, key: str) -> Array:
    """Return the rigid motion nearest to the numbers in a file.

    Raises:
        InputError: the numbers are no rigid motion, or the translation is not in metres.
    """
    where = f"{source}: {key}"
    if not T[:3].any():
        raise InputError(
            f"{where} is all zeros, as in devices that were never calibrated; measure it with "
            "vslam calibrate --imu (docs/howto/imu.md), or leave the IMU out with --no-imu."
        )
    try:
        rigid = ImuCalibration(T).T_imu_camera
    except ValueError:
        turned = bool(np.abs(T[3, :3]).max() > 1e-9 and not T[:3, 3].any())
        raise InputError(
            f"{where} is not a rigid motion; "
            + (
                "the translation is in its last row, so transpose it."
                if turned
                else "its first three columns must be a rotation, and its last row 0 0 0 1."
            )
        ) from None
    far = float(np.linalg.norm(rigid[:3, 3]))
    if far > _FARTHEST_M:
        raise InputError(
            f"{where} places the IMU {far:.4g} m from the camera; write the translation in metres."
        )
    return np.array(rigid)
