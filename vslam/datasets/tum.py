"""RGB-D sequences of TUM, and all data in their layout [Sturm et al., IROS 2012].

FOLDER/rgb.txt, depth.txt    on each line, a time in seconds and an image file
FOLDER/groundtruth.txt       optional: t tx ty tz qx qy qz qw
FOLDER/calibration.yaml      optional: the camera (docs/howto/cameras.md); the default is TUM's
                             camera freiburg1, freiburg2 or freiburg3 by the folder's name
"""

from __future__ import annotations

from collections.abc import Sequence as Several
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.files import read_calibration
from vslam.calibration.models import Calibration, CameraModel
from vslam.datasets.association import associate, poses_at, warn_of_unpaired
from vslam.datasets.frames import Source
from vslam.datasets.image_files import (
    checked_files,
    find_sequence,
    image_size,
    select_frames,
)
from vslam.datasets.rectified import rectified
from vslam.errors import InputError
from vslam.trajectory import read_trajectory

_HOME = "https://cvg.cit.tum.de/data/datasets/rgbd-dataset"
CALIBRATION = "calibration.yaml"
_NEAR_S = 0.02  # as TUM's associate.py
_DEPTH_SCALE = 5000.0  # TUM's "file formats"
# TUM's "intrinsic camera calibration"; the images of freiburg3 are undistorted already.
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
    """Open a sequence; its images are undistorted as they are read.

    A frame is a colour image with the depth image nearest in time, within 20 ms; each is used
    once, the nearest first, as by TUM's ``associate.py``. The ground truth is interpolated
    (`vslam.datasets.association.poses_at`).

    Args:
        root: folder of the sequence, or of several sequences.
        name: name of the sequence in ``root``; None for ``root`` itself, or its only sequence.
        start, every, max_frames: selects every N-th pair, from a first one on, up to a number.
        monocular: read the colour images alone; depth images need not exist.
        calib: calibration file, which replaces the folder's own and those of TUM's cameras.
        depth_scale: units of the depth images per metre; None takes the calibration's value, or
            5000.

    Raises:
        InputError: data is missing or malformed, there are no pairs, or the calibration or the
            ground truth is unusable.
        UnreadableImageError: a file is empty, or the first pair cannot be decoded or differs in
            size.
    """
    root = Path(root)
    folder = find_sequence(root, name, is_tum)
    if folder is None:
        raise InputError(
            f"{root}: holds no data in TUM's RGB-D layout (no rgb.txt); download a sequence from "
            f"{_HOME}, unpack it and name its folder with --data."
        )
    times, colour_files = _read_list(folder / "rgb.txt")
    frames = partners = np.arange(len(times))
    files_of_depth: list[Path] = []
    if not monocular:
        depth_times, files_of_depth = _read_list(folder / "depth.txt")
        frames, partners = associate(times, depth_times, _NEAR_S)
        if not len(frames):
            raise InputError(
                f"{folder}: no colour image has a depth image within 20 ms; take rgb.txt and "
                "depth.txt of one recording, or run on the colour images with --sensor mono."
            )
        warn_of_unpaired(folder, len(frames), len(times))
    chosen = select_frames(folder, len(frames), start, every, max_frames)
    times = times[frames[chosen]]
    colour = tuple(colour_files[k] for k in frames[chosen])
    calibration = _calibration(folder, calib, image_size(colour[0]))
    found, truth_file = folder.resolve().name, folder / "groundtruth.txt"
    truth = (
        poses_at(truth_file, read_trajectory(truth_file), times) if truth_file.is_file() else None
    )
    if monocular:
        raw = checked_files("tum", found, times, truth, [colour])
    else:
        depth = tuple(files_of_depth[k] for k in partners[chosen])
        scale = depth_scale or calibration.depth_scale or _DEPTH_SCALE
        raw = checked_files("tum", found, times, truth, [colour, depth], scale)
    return rectified(raw, calibration)


def is_tum(folder: Path) -> bool:
    """Whether a folder holds a sequence in this layout."""
    return (folder / "rgb.txt").is_file()


def _read_list(path: Path) -> tuple[NDArray[np.float64], list[Path]]:
    """Times (s, increasing) and image files."""
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        alone = ", or run on the colour images with --sensor mono"
        raise InputError(
            f"{path}: the list of images is missing or no text; unpack the sequence again"
            f"{alone if path.stem == 'depth' else ''}."
        ) from error
    times: list[float] = []
    files: list[Path] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        time, _, name = line.strip().partition(" ")
        try:
            times.append(float(time))
        except ValueError:
            name = ""
        if not name or not np.isfinite(times[-1]):
            raise InputError(
                f"{path}: line {number} is not a time in seconds and a file; repair it."
            )
        if len(times) > 1 and times[-1] <= times[-2]:
            raise InputError(
                f"{path}: line {number} is not later than the one before it; sort the list by time."
            )
        files.append(path.parent / name.strip())
    if not times:
        raise InputError(f"{path}: the list of images is empty; unpack the sequence again.")
    return np.array(times), files


def _calibration(folder: Path, calib: Several[Path | str], size: tuple[int, int]) -> Calibration:
    own = folder / CALIBRATION
    if calib or own.is_file():
        return read_calibration(calib or [own], size)
    return _known_camera(folder)


def _known_camera(folder: Path) -> Calibration:
    for name, model in _CAMERAS.items():
        if name in folder.resolve().name:
            return Calibration(model, source=f"TUM's camera {name}")
    raise InputError(
        f"{folder}: the camera is unknown (no {', '.join(_CAMERAS)} in its name, no {CALIBRATION});"
        " name a calibration with --calib."
    )
