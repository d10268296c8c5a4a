"""Reads the inertial unit of KITTI raw [Geiger et al., IJRR 2013].

DRIVE/oxts/timestamps.txt, DRIVE/oxts/data/*.txt   a packet of 30 numbers for each sample
DATE/calib_imu_to_velo.txt                         from the inertial unit to the laser
DATE/calib_velo_to_cam.txt                         from the laser to camera 0 before rectification

The drives whose names end in ``_extract`` have 100 samples per second. In those that end in
``_sync``, one sample for each image is left, which is too slow to be integrated. If the
unsynchronised drive is in the same folder, its samples are used for both.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.documents import Document, read_document
from vslam.calibration.formats import Size
from vslam.datasets.imu import Imu
from vslam.datasets.times import read_times
from vslam.support.errors import InputError
from vslam.types.geometry import Matrix
from vslam.types.imu import ImuCalibration
from vslam.types.trajectory import read_table

OXTS_COLUMNS = 30
"""Numbers in a packet: ``dataformat.txt`` of KITTI's development kit lists them."""

_FORCE, _RATE = slice(11, 14), slice(17, 20)  # ax ay az and wx wy wz: ahead, left, up
_CALIBRATIONS = ("calib_imu_to_velo.txt", "calib_velo_to_cam.txt")


def imu_of_drive(drive: Path, cameras: Document, size: Size, camera: int) -> Imu | None:
    """Return the inertial unit of a drive, calibrated for one of its cameras.

    Args:
        drive: folder of the drive.
        cameras: ``calib_cam_to_cam.txt``.
        size: width and height of the images, which tell whether they are rectified.
        camera: number of the left camera.

    Returns:
        None if the drive has no folder ``oxts``. The calibration is None without the two
        calibrations of the laser.

    Raises:
        InputError: a calibration is damaged.
    """
    drive = drive.resolve()
    faster = drive.with_name(drive.name.removesuffix("_sync") + "_extract")
    folder = next((one / "oxts" for one in (faster, drive) if (one / "oxts").is_dir()), None)
    if folder is None:
        return None
    imu = Imu(str(folder), partial(_samples, folder))
    files = [drive.parent / name for name in _CALIBRATIONS]
    if not all(file.is_file() for file in files):
        return imu
    T_velo_imu, T_cam0_velo = (_motion(read_document(file), "R", "T") for file in files)
    T_camera_imu = _camera_from_first(cameras, size, camera) @ T_cam0_velo @ T_velo_imu
    try:
        calibration = ImuCalibration(np.asarray(np.linalg.inv(T_camera_imu), np.float64))
    except (ValueError, np.linalg.LinAlgError) as error:
        raise InputError(f"{files[0]}: contains no valid rotation; restore the file.") from error
    return Imu(imu.name, imu.read, calibration)


def read_oxts(folder: Path, option: str = "") -> tuple[NDArray[np.float64], Matrix]:
    """Read all packets of a folder ``oxts``.

    Args:
        option: name of the option that gave the folder, for messages, such as ``--gps``.

    Returns:
        ``(M,)`` seconds since 1970, and ``(M, 30)`` numbers.

    Raises:
        InputError: files are missing or malformed.
    """
    where = f"{option} {folder}".lstrip()
    files = sorted((folder / "data").glob("*.txt"))
    if not files:
        raise InputError(f"{where}: no data/*.txt; give the folder oxts of KITTI raw.")
    times = read_times(folder / "timestamps.txt")
    if len(times) != len(files):
        raise InputError(
            f"{where}/timestamps.txt: {len(times)} times for {len(files)} packets; take both from "
            "one drive."
        )
    rows = [read_table(file, (OXTS_COLUMNS,), "an OXTS packet", 1)[0] for file in files]
    return np.asarray(times, np.float64), np.array(rows)


def _samples(folder: Path) -> Matrix:
    times, rows = read_oxts(folder)
    return np.column_stack([times, rows[:, _RATE], rows[:, _FORCE]])


def _camera_from_first(document: Document, size: Size, camera: int) -> Matrix:
    """Return the motion from camera 0 before rectification to the frame of a camera's images."""
    name = f"{camera:02}"
    if size != document.integers(f"S_rect_{name}", 2):
        return _motion(document, f"R_{name}", f"T_{name}")
    T = np.eye(4)
    T[:3, :3] = document.matrix("R_rect_00", 3, 3)
    P = document.matrix(f"P_rect_{name}", 3, 4)
    T[0, 3] = P[0, 3] / P[0, 0]
    return T


def _motion(document: Document, R: str, t: str) -> Matrix:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = document.matrix(R, 3, 3), document.numbers(t, 3)
    return T
