"""Reads drives of KITTI raw [Geiger et al., IJRR 2013].

DATE/calib_cam_to_cam.txt                     calibration of the four cameras
DATE/DRIVE/image_00/data/0000000000.png       images of the left grey camera
DATE/DRIVE/image_00/timestamps.txt            their dates and times
DATE/DRIVE/image_01/...                       the same for the right grey camera
DATE/DRIVE/image_02/..., image_03/...         the same for the colour cameras
DATE/DRIVE/oxts/...                           inertial unit, see `vslam.datasets.kitti_imu`

The names of synchronised drives end in ``_sync``, and their images are rectified. The names of
unsynchronised drives end in ``_extract``. Their images are rectified when they are read.
"""

from __future__ import annotations

from collections.abc import Sequence as Several
from dataclasses import replace
from pathlib import Path

import numpy as np

from vslam.calibration.documents import read_document
from vslam.calibration.files import read_calibration
from vslam.calibration.formats import Size, read_kitti_raw
from vslam.calibration.models import Calibration
from vslam.datasets.frames import RawSource, Source, selection
from vslam.datasets.image_files import checked_files, find_sequence
from vslam.datasets.kitti import files_of_frames, find_cameras, row_numbers
from vslam.datasets.kitti_imu import imu_of_drive
from vslam.datasets.rectified import rectified
from vslam.datasets.times import FIX_LIST, ordered_list, times_of_list
from vslam.support.errors import InputError
from vslam.support.file_kinds import what_is_in

_CALIBRATION = "calib_cam_to_cam.txt"


def open_kitti_raw(
    root: Path | str,
    name: str | None = None,
    *,
    start: int = 0,
    every: int = 1,
    max_frames: int | None = None,
    monocular: bool = False,
    calib: Several[Path | str] = (),
) -> Source:
    """Open a drive of KITTI raw. The grey images are read or, without these, the colour images.

    The times are those of the left camera, in seconds since 1970. Images of frames that are not
    selected may be missing.

    Args:
        root: folder of the drive, or a folder that contains drives or the folders of their dates.
        name: name of the drive in ``root``. None opens ``root`` itself or the only drive in it.
        start, every, max_frames: of the existing frames, read ``start``, ``start + every`` and so
            on, at most ``max_frames`` frames.
        monocular: read only the left camera.
        calib: calibration files, which are used instead of ``calib_cam_to_cam.txt`` in the folder
            of the date.

    Raises:
        InputError: data is missing, the left or the right image of a frame is missing, or the
            calibration or the times are unusable.
        UnreadableImageError: the first pair cannot be decoded.
    """
    folder = find_sequence(Path(root), name, is_kitti_raw)
    if folder is None:
        raise InputError(
            f"{root}: holds no drive of KITTI raw (no image_00/data or image_02/data); give the "
            "folder of a drive or of a date with --data."
        )
    cameras, places, listed = find_cameras(lambda k: folder / f"image_{k:02}" / "data", monocular)
    stems = sorted(set().union(*listed))
    if not stems:
        inside = what_is_in(places[0])
        raise InputError(f"{places[0]}: no images in this folder{inside}; add those of the drive.")
    path = places[0].parent / "timestamps.txt"
    rows, timing = times_of_list(path, FIX_LIST)
    of_images = [rows[k] for k in row_numbers(path, stems, len(rows))]
    times, kept = ordered_list(of_images, timing, FIX_LIST)
    selected = selection(folder, len(kept), start, every, max_frames)
    sides = files_of_frames(places, listed, [stems[k] for k in kept[selected]])
    name = folder.resolve().name
    images = checked_files("kitti_raw", name, np.array(times)[selected], None, sides, timing=timing)
    images, warnings = _with_imu(images, folder, cameras[0])
    source = rectified(images, _calibration(folder, calib, images.sizes[0], cameras))
    return replace(source, warnings=warnings)


def _with_imu(images: RawSource, folder: Path, camera: int) -> tuple[RawSource, tuple[str, ...]]:
    """Add the inertial unit of the drive. A warning says why its calibration cannot be used."""
    drive = folder.resolve()
    files = (path / _CALIBRATION for path in (drive.parent, drive))
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        return images, ()
    try:
        imu = imu_of_drive(drive, read_document(file), images.sizes[0], camera)
    except InputError as error:
        return images, (f"The IMU is not used: {error}",)
    return replace(images, imu=imu), ()


def is_kitti_raw(folder: Path) -> bool:
    """Return whether a folder is a drive of KITTI raw with images."""
    return any((folder / f"image_{k:02}" / "data").is_dir() for k in range(4))


def _calibration(
    folder: Path, calib: Several[Path | str], size: Size, cameras: tuple[int, ...]
) -> Calibration:
    drive = folder.resolve()
    own = [path / _CALIBRATION for path in (drive.parent, drive) if (path / _CALIBRATION).is_file()]
    if not calib and not own:
        raise InputError(
            f"{drive.parent / _CALIBRATION}: the calibration is missing; unpack the calibration "
            "of this date, or give another file with --calib."
        )
    files = [Path(file) for file in calib or own[:1]]
    if files[0].is_file() and f"P_rect_{cameras[0]:02}" in (document := read_document(files[0])):
        return read_kitti_raw(document, size, cameras)
    return read_calibration(files, size)
