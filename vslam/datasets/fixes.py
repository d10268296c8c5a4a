"""Reads GPS fixes of a drive, and converts them to a local east-north-up (ENU) frame.

Fixes are read from a CSV file, from the folder ``oxts`` of KITTI raw (Geiger et al., IJRR 2013), or
from the ``sensor_msgs/NavSatFix`` messages of a ROS bag.

The package pymap3d converts between WGS84 coordinates and metres. The extra ``gps`` of vslam
installs it.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.bag import read_fixes_of_bag
from vslam.datasets.detection import is_bag
from vslam.datasets.frames import Source
from vslam.datasets.kitti_imu import read_oxts
from vslam.support.errors import InputError
from vslam.support.file_kinds import read_text

# Standard deviation for receivers that do not state one. It is typical under an open sky.
DEFAULT_SIGMA_M = 2.0
_NAMES = {
    "time": ("time", "timestamp", "t"),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon"),
    "altitude": ("altitude", "alt"),
    "sigma": ("sigma",),
}
_SINCE_1970_S = 1e8  # smaller times are counted from another moment
_POS_ACCURACY = 23  # index of pos_accuracy in an OXTS packet


@dataclass(frozen=True)
class Fixes:
    """M GPS fixes in the order of their times.

    Attributes:
        times: ``(M,)`` times of the fixes in seconds, measured by the same clock as the times of
            the images.
        geodetic: ``(M, 3)`` latitude and longitude in degrees and altitude in metres.
        sigma: ``(M, 3)`` standard deviations east, north and up, in metres.
        antenna: ``(3,)`` position of the antenna in the frame of the left camera (x right, y down,
            z forward), in metres.
    """

    times: NDArray[np.float64]
    geodetic: NDArray[np.float64]
    sigma: NDArray[np.float64]
    antenna: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.times)

    def between(self, first: float, last: float) -> Fixes:
        """Return the fixes from time ``first`` to time ``last``, inclusive, in seconds."""
        return self.select((self.times >= first) & (self.times <= last))

    def select(self, chosen: NDArray[np.bool_]) -> Fixes:
        """Return the fixes at which the ``(M,)`` bool array ``chosen`` is True."""
        return replace(
            self,
            times=self.times[chosen],
            geodetic=self.geodetic[chosen],
            sigma=self.sigma[chosen],
        )


def read_fixes(
    path: Path, antenna: Sequence[float] | None = None, first_image: float = 0.0
) -> Fixes:
    """Read all fixes of a file or folder.

    Args:
        path: a CSV file, the folder ``oxts`` of KITTI raw, or a bag. The first line of a CSV file
            names its columns: ``time`` (s), ``latitude`` and ``longitude`` (degrees), ``altitude``
            (m) and optionally ``sigma`` (m).
        antenna: position of the antenna in the frame of the left camera (x right, y down, z
            forward), in metres. If it is None, the position is read from the calibration of KITTI
            raw. If there is no such calibration, the function assumes that the antenna is at the
            camera.
        first_image: time of the first image in seconds. If it is not a time since 1970, the times
            of KITTI raw's fixes are counted from the first fix, as in KITTI odometry.

    Raises:
        InputError: pymap3d is not installed, the file is missing or malformed, it contains no fix
            or no times, a latitude or longitude is out of range, or a calibration is damaged.
    """
    try:
        import pymap3d  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"--gps {path}: pymap3d is not installed; pip install 'vslam[gps]'."
        ) from error
    if not path.exists():
        raise InputError(f"--gps {path}: no such file or folder; give a CSV file, a bag or oxts.")
    if is_bag(path):
        rows = read_fixes_of_bag(path)
    elif path.is_dir():
        folder = path / "oxts" if (path / "oxts").is_dir() else path
        rows = _read_oxts(folder)
        if first_image < _SINCE_1970_S:
            rows[:, 0] -= rows[0, 0]
        if antenna is None:
            antenna = _antenna_of_kitti(folder.resolve().parent.parent)
    else:
        rows = _read_csv(path)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    latitude, longitude = rows[:, 1], rows[:, 2]
    bad = np.flatnonzero((np.abs(latitude) > 90.0) | (np.abs(longitude) > 180.0))
    if len(bad):
        time, *position = rows[bad[0], :3].tolist()
        raise InputError(
            f"--gps {path}: the fix at {time:g} s has latitude {position[0]:g} and longitude "
            f"{position[1]:g}; give degrees, from -90 to 90 and from -180 to 180."
        )
    sigma = rows[:, 4:]
    sigma = np.where((sigma > 0.0) & np.isfinite(sigma), sigma, DEFAULT_SIGMA_M)
    antenna = (0.0, 0.0, 0.0) if antenna is None else antenna
    return Fixes(rows[:, 0], rows[:, 1:4], sigma, np.array(antenna, np.float64))


def require_overlap(fixes: Fixes, source: Source, path: Path) -> None:
    """Check that at least one fix was recorded while the images were taken.

    The end of a stream is unknown. It is treated as infinitely late.

    Raises:
        InputError: the source is a live camera, or no fix was recorded while its images were taken.
    """
    if source.live:
        raise InputError(
            f"--gps {path}: fixes cannot be used with a live camera; record its images first."
        )
    if source.seekable:
        first, last = source.timestamps[[0, -1]].tolist()
    else:
        frame = next(source.frames(), None)  # only the first time of a stream is known
        first, last = -np.inf if frame is None else frame.timestamp, np.inf
    if not len(fixes.between(first, last)):
        until = f" to {last:.3f} s" if np.isfinite(last) else " s on"
        raise InputError(
            f"--gps {path}: the fixes are from {fixes.times[0]:.3f} to {fixes.times[-1]:.3f} s but "
            f"the images are from {first:.3f}{until}; both must have times of the same clock."
        )


def to_enu(geodetic: NDArray[np.float64], datum: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert WGS84 coordinates to metres in the east-north-up frame of a datum.

    Args:
        geodetic: ``(N, 3)`` latitude and longitude (degrees) and altitude (m).
        datum: ``(3,)`` latitude (degrees), longitude (degrees) and altitude (m) of the origin.

    Returns:
        ``(N, 3)`` metres east, north and up.
    """
    from pymap3d import geodetic2enu

    return np.column_stack(geodetic2enu(*geodetic.T, *datum))


def to_geodetic(enu: NDArray[np.float64], datum: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert coordinates in the east-north-up frame of a datum to WGS84 coordinates.

    Args:
        enu: ``(N, 3)`` metres east, north and up.
        datum: ``(3,)`` latitude (degrees), longitude (degrees) and altitude (m) of the origin.

    Returns:
        ``(N, 3)`` latitude and longitude (degrees) and altitude (m).
    """
    from pymap3d import enu2geodetic

    return np.column_stack(enu2geodetic(*enu.T, *datum))


def _read_csv(path: Path) -> NDArray[np.float64]:
    """Return ``(M, 7)`` fixes in the format of `vslam.datasets.bag.read_fixes_of_bag`."""
    try:
        lines = list(csv.reader(read_text(path, "a CSV file of fixes").splitlines()))
    except csv.Error as error:
        raise InputError(f"--gps {path}: not a CSV file ({error}); check the file.") from error
    head = [name.strip().lower().lstrip("# ") for name in lines[0]] if lines else []
    column = {
        name: next((head.index(word) for word in words if word in head), None)
        for name, words in _NAMES.items()
    }
    sigma_at = column.pop("sigma")
    required = {name: at for name, at in column.items() if at is not None}
    missing = [name for name in column if name not in required]
    if missing:
        raise InputError(
            f"--gps {path}: the first line names no {' and no '.join(missing)}; begin the file "
            "with the line time,latitude,longitude,altitude (seconds, degrees, degrees, metres)."
        )
    rows = []
    for number, words in enumerate(lines[1:], start=2):
        if not any(word.strip() for word in words):
            continue
        try:
            row = [float(words[at]) for at in required.values()]
            stated = "" if sigma_at is None else words[sigma_at].strip()
            sigma = float(stated) if stated else np.nan
        except (ValueError, IndexError):
            row = [np.nan]
        if not np.isfinite(row).all():
            raise InputError(
                f"--gps {path}: line {number} is not a fix of {len(head)} numbers; correct or "
                "remove it."
            )
        rows.append([*row, sigma, sigma, sigma])
    if not rows:
        raise InputError(f"--gps {path}: holds no fix; give a file with one fix per line.")
    return np.array(rows)


def _read_oxts(folder: Path) -> NDArray[np.float64]:
    """Return ``(M, 7)`` fixes in the format of `vslam.datasets.bag.read_fixes_of_bag`.

    The times are in seconds since 1970.
    """
    times, rows = read_oxts(folder, "--gps")
    sigma = np.repeat(rows[:, [_POS_ACCURACY]], 3, axis=1)
    return np.column_stack([times, rows[:, :3], sigma])


def _antenna_of_kitti(folder: Path) -> Sequence[float] | None:
    """Read the position of KITTI's inertial unit in the frame of the left grey camera.

    The fixes of KITTI raw are the positions of this unit. ``folder`` is the drive's date folder,
    which contains the calibration. The rectifying rotation of the camera is ignored, because its
    angle is less than a degree.
    """
    paths = [folder / name for name in ("calib_imu_to_velo.txt", "calib_velo_to_cam.txt")]
    if not all(path.is_file() for path in paths):
        return None
    point = np.zeros(3)
    for path in paths:
        try:
            text = read_text(path, "a calibration of KITTI raw")
            lines = dict(line.split(":", 1) for line in text.splitlines() if line.strip())
            R, t = (np.array(lines[name].split(), np.float64) for name in "RT")
            point = R.reshape(3, 3) @ point + t.reshape(3)
        except (ValueError, KeyError) as error:
            raise InputError(
                f"{path}: not a calibration of KITTI raw; restore it, or give the position "
                "of the antenna with --gps-antenna."
            ) from error
    x, y, z = point.tolist()
    return x, y, z
