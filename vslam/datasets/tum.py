"""Reads TUM's RGB-D sequences and other data in the same layout [Sturm et al., IROS 2012].

FOLDER/rgb.txt             a time in seconds and the file of a colour image on each line
FOLDER/depth.txt           the same for the depth images
FOLDER/groundtruth.txt     optional: t tx ty tz qx qy qz qw, or EuRoC's columns
FOLDER/calibration.yaml    optional: calibration of the camera (docs/howto/cameras.md)

If the folder has no calibration, its name must contain freiburg1, freiburg2 or freiburg3. This part
of the name tells which of TUM's cameras recorded the images.
"""

from __future__ import annotations

from collections.abc import Sequence as Several
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.files import CALIBRATION, read_calibration
from vslam.calibration.models import Calibration, CameraModel
from vslam.datasets.association import DEPTH_NEAR_S, Pairing, associate, read_ground_truth
from vslam.datasets.frames import Source, selection
from vslam.datasets.image_files import (
    checked_files,
    depth_scale_of,
    find_sequence,
    image_size,
    read_image_list,
    split_line,
)
from vslam.datasets.rectified import rectified
from vslam.datasets.times import FIX_LIST, UNITS, Timing, ordered_list, unit_of_list
from vslam.support.errors import InputError
from vslam.support.file_kinds import what_is_in

_HOME = "https://cvg.cit.tum.de/data/datasets/rgbd-dataset"
_DEPTH_SCALE = 5000.0  # from TUM's page "File Formats"
# From TUM's page "Intrinsic Camera Calibration"; the images of freiburg3 are already undistorted.
_CAMERAS = {
    "freiburg1": CameraModel(
        517.3, 516.5, 318.6, 255.3, 640, 480, "pinhole", (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    ),
    "freiburg2": CameraModel(
        520.9, 521.0, 325.1, 249.7, 640, 480, "pinhole", (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)
    ),
    "freiburg3": CameraModel(535.4, 539.2, 320.1, 247.6, 640, 480),
}


def open_tum(
    root: Path | str,
    name: str | None = None,
    *,
    start: int = 0,
    every: int = 1,
    max_frames: int | None = None,
    monocular: bool = False,
    calib: Several[Path | str] = (),
    depth_scale: float | None = None,
) -> Source:
    """Open a sequence of TUM. Its images are undistorted when they are read.

    A frame consists of a colour image and a depth image that are less than 20 ms apart, paired as
    TUM's ``associate.py`` does. `poses_at` gives them their ground truth.

    Args:
        root: folder of the sequence, or a folder that contains several sequences.
        name: name of the sequence in ``root``. None opens ``root`` itself or, if it is not a
            sequence, the only sequence in it.
        start, every, max_frames: read the frames ``start``, ``start + every`` and so on, at most
            ``max_frames`` frames.
        monocular: read only the colour images. Depth images need not exist.
        calib: calibration file. If it is given, it is used instead of the calibration in the folder
            and instead of the calibration of TUM's cameras.
        depth_scale: depth image units per metre. If it is None, the value in the calibration is
            used. If there is no such value, 5000 is used. If it is None, depth images of
            floating-point numbers are in metres.

    Raises:
        InputError: data is missing or malformed, no images form a pair, or the calibration or the
            ground truth is unusable.
        UnreadableImageError: a file is empty, the first pair cannot be decoded, or its two images
            differ in size.
    """
    root = Path(root)
    folder = find_sequence(root, name, is_tum)
    if folder is None:
        raise InputError(
            f"{root}: holds no data in TUM's RGB-D layout (no rgb.txt{what_is_in(root)}); give "
            f"the folder of a sequence with --data, or leave --dataset out; {_HOME} has sequences "
            "to download."
        )
    times, colour_files, timing = _read_list(folder / "rgb.txt")
    frames = partners = np.arange(len(times))
    depth_files: list[Path] = []
    pairing = None
    if not monocular:
        depth_times, depth_files, depth_timing = _read_list(folder / "depth.txt")
        timing.add(depth_timing)
        frames, partners = associate(times, depth_times, DEPTH_NEAR_S)
        if not len(frames):
            raise InputError(
                f"{folder}: no colour image has a depth image within 20 ms; take rgb.txt and "
                "depth.txt from one recording, or run on the colour images with --sensor mono."
            )
        fix = (
            "correct the times in rgb.txt or depth.txt if those of one list are late, or run on "
            "the colour images with --sensor mono"
        )
        pairing = Pairing(folder, "depth image", DEPTH_NEAR_S, fix)
        pairing.count(times, frames, depth_times)
    chosen = selection(folder, len(frames), start, every, max_frames)
    times = times[frames[chosen]]
    colour = tuple(colour_files[k] for k in frames[chosen])
    calibration = _calibration(folder, calib, image_size(colour[0]))
    found, truth_file = folder.resolve().name, folder / "groundtruth.txt"
    truth, warnings = read_ground_truth(truth_file, times)
    if monocular:
        raw = checked_files("tum", found, times, truth, [colour], timing=timing)
    else:
        depth = tuple(depth_files[k] for k in partners[chosen])
        scale = depth_scale_of(depth_scale, calibration.depth_scale or _DEPTH_SCALE)
        raw = checked_files("tum", found, times, truth, [colour, depth], scale, pairing, timing)
    return replace(rectified(raw, calibration), warnings=warnings)


def is_tum(folder: Path) -> bool:
    """Return whether a folder contains a sequence in TUM's layout."""
    return (folder / "rgb.txt").is_file()


def _read_list(path: Path) -> tuple[NDArray[np.float64], list[Path], Timing]:
    """Read the times in seconds and the files of images from ``rgb.txt`` or ``depth.txt``."""

    def parsed(line: str) -> tuple[float, str]:
        time, name = split_line(line)
        if not np.isfinite(float(time)):
            raise ValueError
        return float(time), name.replace("\\", "/")  # written on Windows

    instead = "run on the colour images with --sensor mono" if path.stem == "depth" else ""
    numbers, names = read_image_list(path, parsed, "a time in seconds", instead)
    unit, timing = unit_of_list(numbers, path, "seconds", FIX_LIST)
    times, kept = ordered_list([number / UNITS[unit] for number in numbers], timing, FIX_LIST)
    return np.array(times), [path.parent / names[k] for k in kept], timing


def _calibration(folder: Path, calib: Several[Path | str], size: tuple[int, int]) -> Calibration:
    own = folder / CALIBRATION
    if calib or own.is_file():
        return read_calibration(calib or [own], size)
    for name, model in _CAMERAS.items():
        if name in folder.resolve().name:
            return Calibration(model, source=f"TUM's camera {name}")
    raise InputError(
        f"{folder}: the camera is unknown (no {', '.join(_CAMERAS)} in its name, no {CALIBRATION});"
        " give a calibration with --calib."
    )
