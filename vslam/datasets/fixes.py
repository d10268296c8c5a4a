"""GPS fixes beside the images of a drive, and their local east-north-up frame.

They come from a CSV file, from the folder ``oxts`` of KITTI raw (Geiger et al., IJRR 2013), or from
the ``sensor_msgs/NavSatFix`` messages of a ROS bag. Conversions between latitude and longitude
(WGS84) and metres are those of pymap3d, in the extra ``gps``.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.bag import read_fixes_of_bag
from vslam.datasets.frames import Source
from vslam.errors import InputError
from vslam.trajectory import read_table

DEFAULT_SIGMA_M = 2.0  # of a receiver that does not state its error: usual under an open sky
_NAMES = {
    "time": ("time", "timestamp", "t"),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon"),
    "altitude": ("altitude", "alt"),
    "sigma": ("sigma",),
}
_OXTS_COLUMNS, _OXTS_ACCURACY = 30, 23
_BAGS = (".bag", ".mcap", ".db3")


@dataclass(frozen=True)
class Fixes:
    """M GPS fixes in the order of their times.

    Attributes:
        times: ``(M,)`` seconds, by the clock of the images.
        geodetic: ``(M, 3)`` latitude and longitude in degrees and altitude in metres.
        sigma: ``(M, 3)`` standard deviations to the east, to the north and up, in metres.
    """

    times: NDArray[np.float64]
    geodetic: NDArray[np.float64]
    sigma: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.times)

    def between(self, first: float, last: float) -> Fixes:
        """The fixes from one time to another, both included."""
        at = (self.times >= first) & (self.times <= last)
        return Fixes(self.times[at], self.geodetic[at], self.sigma[at])


def read_fixes(path: Path) -> Fixes:
    """Read all fixes of a file or folder.

    Args:
        path: CSV file whose header names ``time``, ``latitude``, ``longitude``, ``altitude`` and
            optionally ``sigma`` (m); KITTI's folder ``oxts``, whose times begin at 0; or a bag.

    Raises:
        InputError: pymap3d is not installed, the file is missing or malformed, it holds no fix or
            no times, or a latitude or longitude is out of range.
    """
    try:
        import pymap3d  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"--gps {path}: pymap3d is not installed; pip install 'vslam[gps]'."
        ) from error
    if not path.exists():
        raise InputError(f"--gps {path}: no such file or folder; name a CSV file, a bag or oxts.")
    if path.suffix in _BAGS or (path / "metadata.yaml").is_file():
        rows = read_fixes_of_bag(path)
    elif path.is_dir():
        rows = _read_oxts(path)
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
    sigma = np.where(rows[:, 4:] > 0.0, rows[:, 4:], DEFAULT_SIGMA_M)
    return Fixes(rows[:, 0], rows[:, 1:4], sigma)


def require_overlap(fixes: Fixes, source: Source, path: Path) -> None:
    """Refuse fixes of another time than that of the images. Of a stream, only the first frame's
    time is known in advance.

    Raises:
        InputError: the images are those of a live camera, or no fix is of their time.
    """
    if source.live:
        raise InputError(
            f"--gps {path}: a live camera is not yet where the file says; record the drive first."
        )
    if source.seekable:
        first, last = source.timestamps[[0, -1]].tolist()
    else:
        frame = next(source.frames(), None)
        first, last = -np.inf if frame is None else frame.timestamp, np.inf
    if not len(fixes.between(first, last)):
        images = f"from {first:.3f}" + (f" to {last:.3f} s" if np.isfinite(last) else " s on")
        raise InputError(
            f"--gps {path}: its fixes are from {fixes.times[0]:.3f} to {fixes.times[-1]:.3f} s, "
            f"the images {images}; give the times of both by one clock."
        )


def to_enu(geodetic: NDArray[np.float64], datum: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(N, 3)`` metres east, north and up of the datum ``(3,)``, from ``(N, 3)`` degrees and
    metres."""
    from pymap3d import geodetic2enu

    return np.column_stack(geodetic2enu(*geodetic.T, *datum))


def to_geodetic(enu: NDArray[np.float64], datum: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverse of ``to_enu``."""
    from pymap3d import enu2geodetic

    return np.column_stack(enu2geodetic(*enu.T, *datum))


def _read_csv(path: Path) -> NDArray[np.float64]:
    """``(M, 7)`` time, latitude, longitude, altitude and three standard deviations, NaN where
    unknown."""
    try:
        lines = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"--gps {path}: cannot be read as a CSV file; check the file.") from error
    head = [name.strip().lower().lstrip("# ") for name in lines[0]] if lines else []
    column = {
        name: next((head.index(word) for word in words if word in head), None)
        for name, words in _NAMES.items()
    }
    missing = [name for name, at in column.items() if at is None and name != "sigma"]
    if missing:
        raise InputError(
            f"--gps {path}: the first line names no {' and no '.join(missing)}; begin the file "
            "with time,latitude,longitude,altitude (seconds, degrees, degrees, metres)."
        )
    rows = []
    for number, words in enumerate(lines[1:], start=2):
        if not any(word.strip() for word in words):
            continue
        try:
            row = [
                float(words[at])
                for name, at in column.items()
                if at is not None and name != "sigma"
            ]
            at = column["sigma"]
            sigma = np.nan if at is None or not words[at].strip() else float(words[at])
        except (ValueError, IndexError):
            row = [np.nan]
        if not np.isfinite(row).all():
            raise InputError(
                f"--gps {path}: line {number} is not a fix of {len(head)} numbers; repair or "
                "remove it."
            )
        rows.append([*row, sigma, sigma, sigma])
    if not rows:
        raise InputError(f"--gps {path}: holds no fix; give a file with one on each line.")
    return np.array(rows)


def _read_oxts(folder: Path) -> NDArray[np.float64]:
    """As `_read_csv`; times are seconds since the first packet, like those of KITTI odometry."""
    if (folder / "oxts").is_dir():
        folder = folder / "oxts"
    files = sorted((folder / "data").glob("*.txt"))
    if not files:
        raise InputError(f"--gps {folder}: no data/*.txt; name the folder oxts of KITTI raw.")
    path = folder / "timestamps.txt"
    try:
        stamps = [line.strip().replace(" ", "T") for line in path.read_text().splitlines()]
        times = np.array([stamp for stamp in stamps if stamp], "datetime64[ns]")
    except (OSError, ValueError) as error:
        raise InputError(
            f"--gps {path}: the times of the fixes are missing or damaged; unpack the drive again."
        ) from error
    if len(times) != len(files):
        raise InputError(
            f"--gps {path}: {len(times)} times for {len(files)} fixes; unpack the drive again."
        )
    seconds = (times - times[0]) / np.timedelta64(1, "s")
    packets = [read_table(file, (_OXTS_COLUMNS,), "a packet of OXTS", 1)[0] for file in files]
    rows = np.array(packets)
    sigma = np.repeat(rows[:, [_OXTS_ACCURACY]], 3, axis=1)
    return np.column_stack([seconds, rows[:, :3], sigma])
