"""Reads EuRoC MAV data and other data in its ASL layout [Burri et al., IJRR 2016].

FOLDER/mav0/cam0/data.csv                  times (ns) and file names of the left camera's images
FOLDER/mav0/cam0/sensor.yaml               calibration of the left camera
FOLDER/mav0/cam0/data/                     images of the left camera
FOLDER/mav0/cam1/...                       the same for the right camera
FOLDER/mav0/state_groundtruth_estimate0/   optional: ground truth of the body
FOLDER/mav0/imu0/data.csv                  optional: inertial samples
FOLDER/mav0/imu0/sensor.yaml               optional: pose and noise of the IMU
"""

from __future__ import annotations

from collections.abc import Sequence as Several
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.documents import read_document
from vslam.calibration.files import read_calibration
from vslam.calibration.imu import read_imu
from vslam.datasets.association import Pairing, pair_clocks, read_ground_truth
from vslam.datasets.frames import RawSource, Source, selection
from vslam.datasets.image_files import (
    checked_files,
    find_sequence,
    read_image_list,
    split_line,
)
from vslam.datasets.imu import Imu
from vslam.datasets.imu_csv import read_imu_csv
from vslam.datasets.rectified import rectified
from vslam.datasets.times import (
    FIX_LIST,
    UNITS,
    Number,
    Timing,
    number_of,
    ordered_list,
    unit_of_list,
)
from vslam.support.errors import InputError
from vslam.support.file_kinds import what_is_in

_HOME = "https://projects.asl.ethz.ch/datasets/euroc-mav/"
_MOST_APART_NS = 5_000_000  # between the images of a pair, which are triggered together


def open_euroc(
    root: Path | str,
    name: str | None = None,
    *,
    start: int = 0,
    every: int = 1,
    max_frames: int | None = None,
    monocular: bool = False,
    calib: Several[Path | str] = (),
) -> Source:
    """Open a sequence of EuRoC. Its images are rectified when they are read.

    A frame consists of a left and a right image whose times differ by at most 5 ms, apart from a
    constant difference between the clocks of the cameras. Images without a partner are left out.
    `poses_at` gives the frames their ground truth.

    Args:
        root: folder of the sequence, or a folder that contains several sequences.
        name: name of the sequence in ``root``. None opens ``root`` itself or, if it is not a
            sequence, the only sequence in it.
        start, every, max_frames: read the frames ``start``, ``start + every`` and so on, at most
            ``max_frames`` frames.
        monocular: read only the left camera.
        calib: calibration files, which are used instead of the cameras' ``sensor.yaml``.

    Raises:
        InputError: data is missing or malformed, no images form a pair, or the calibration is
            unusable.
        UnreadableImageError: the first pair cannot be decoded.
    """
    base, found, stamps, files, pairing, timing = _select(
        root, name, start, every, max_frames, monocular
    )
    times = stamps.astype(np.float64) * 1e-9
    truth, warnings = _read_ground_truth(base, times)
    raw = checked_files("euroc", found, times, truth, files, None, pairing, timing)
    imu, why_not = _imu(base)
    raw = replace(raw, imu=imu)
    sensors = calib or [base / f"cam{side}" / "sensor.yaml" for side in range(len(files))]
    source = rectified(raw, read_calibration(sensors, raw.sizes[0]))
    return replace(source, warnings=(*warnings, *why_not))


def open_raw_euroc(
    root: Path | str,
    name: str | None = None,
    *,
    start: int = 0,
    every: int = 1,
    max_frames: int | None = None,
    monocular: bool = False,
) -> RawSource:
    """Open the unrectified images of a sequence of EuRoC, without its calibration and ground truth.

    The arguments have the same meaning as for `open_euroc`.
    """
    _, found, stamps, files, pairing, timing = _select(
        root, name, start, every, max_frames, monocular
    )
    times = stamps.astype(np.float64) * 1e-9
    return checked_files("euroc", found, times, None, files, None, pairing, timing)


def is_euroc(root: Path) -> bool:
    """Return whether a folder contains the left camera of a sequence in EuRoC's layout."""
    return any((base / "cam0" / "data.csv").is_file() for base in (root / "mav0", root))


def _select(
    root: Path | str,
    name: str | None,
    start: int,
    every: int,
    max_frames: int | None,
    monocular: bool,
) -> tuple[Path, str, NDArray[np.int64], list[tuple[Path, ...]], Pairing | None, Timing]:
    """Find a sequence and select frames of it.

    Returns:
        The folder that contains ``cam0``, the name of the sequence, the times (ns) and the files of
        the selected frames, the pairing of all frames, and how the times were read.
    """
    base, found = _find(Path(root), name)
    cameras = [base / f"cam{side}" for side in range(1 if monocular else 2)]
    listed = [_read_list(camera) for camera in cameras]
    times = [stamps for stamps, *_ in listed]
    timing, *others = (timing for *_, timing in listed)
    for other in others:
        timing.add(other)
    frames = _pair(cameras, times)
    pairing = None if monocular else _pairing(base, times, frames)
    chosen = frames[selection(base, len(frames), start, every, max_frames)]
    files = [
        tuple(camera / "data" / names[k] for k in rows)
        for camera, (_, names, _), rows in zip(cameras, listed, chosen.T, strict=True)
    ]
    return base, found, times[0][chosen[:, 0]], files, pairing, timing


def _find(root: Path, name: str | None) -> tuple[Path, str]:
    """Return the folder that contains ``cam0``, and the name of the sequence."""
    if root.resolve().name == "mav0":  # the parent folder has the name of the sequence
        root = root.resolve().parent
    folder = find_sequence(root, name, is_euroc)
    if folder is None:
        raise InputError(
            f"{root}: holds no data in EuRoC's layout (no mav0/cam0/data.csv{what_is_in(root)}); "
            "give the folder of a sequence with --data, or leave --dataset out; "
            f"{_HOME} has sequences in ASL format to download."
        )
    base = folder / "mav0" if (folder / "mav0").is_dir() else folder
    return base, folder.resolve().name


def _read_list(camera: Path) -> tuple[NDArray[np.int64], list[str], Timing]:
    """Read the times (ns, increasing) and the file names of the images of a camera."""

    def parsed(line: str) -> tuple[Number, str]:
        stamp, name = split_line(line)
        number = number_of(stamp)
        if number is None or "/" in name or number > np.iinfo(np.int64).max:
            raise ValueError
        return number, name

    instead = "run on the left camera alone with --sensor mono" if camera.name == "cam1" else ""
    path = camera / "data.csv"
    numbers, names = read_image_list(path, parsed, "a time in nanoseconds", instead)
    unit, timing = unit_of_list(numbers, path, "nanoseconds", FIX_LIST)
    to_ns = UNITS["nanoseconds"] // UNITS[unit]
    stamps, kept = ordered_list([int(n * to_ns) for n in numbers], timing, FIX_LIST, 10**9)
    return np.array(stamps, np.int64), [names[k] for k in kept], timing


def _pair(cameras: list[Path], times: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Return the ``(N, cameras)`` indices of the images of each frame. ``times`` are in ns."""
    if len(times) == 1:
        return np.arange(len(times[0]))[:, None]
    left, right = ((side - times[0][0]).astype(np.float64) for side in times)  # exact nanoseconds
    pairs = pair_clocks(left, right, _MOST_APART_NS + 1)
    if pairs is None:
        raise InputError(
            f"{cameras[1]}: none of its {len(right)} images has the time of an image in "
            f"{cameras[0]}, and the clocks of the cameras do not differ by a clear constant; take "
            "both cameras from one sequence, or run with --sensor mono."
        )
    return np.column_stack((pairs.first, pairs.second))


def _imu(base: Path) -> tuple[Imu | None, tuple[str, ...]]:
    """Return the IMU in ``base/imu0``, calibrated for the left camera before rectification, and a
    warning if its calibration cannot be used."""
    path = base / "imu0" / "data.csv"
    if not path.is_file():
        return None, ()
    imu = Imu(str(path), partial(read_imu_csv, path))
    files = [base / name / "sensor.yaml" for name in ("cam0", "imu0")]
    if not all(file.is_file() for file in files):
        return imu, ()
    try:
        camera, sensor = map(read_document, files)
        calibration, noise = read_imu([camera], [sensor])
    except InputError as error:
        return imu, (f"The IMU is not used: {error}",)
    return replace(imu, calibration=calibration, noise=noise), ()


def _pairing(base: Path, times: list[NDArray[np.int64]], frames: NDArray[np.int64]) -> Pairing:
    fix = "restore the missing images, or run on the left camera alone with --sensor mono"
    left, right = (1e-9 * (side - times[0][0]) for side in times)
    late_s = float(np.median(right[frames[:, 1]] - left[frames[:, 0]]))
    alone = len(right) - len(frames)
    apart = _MOST_APART_NS * 1e-9
    pairing = Pairing(base, "right image", apart, fix, n_alone=alone, late_s=late_s)
    pairing.count(left, frames[:, 0], right - late_s)
    return pairing


def _read_ground_truth(
    base: Path, times: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """Return the ``(N, 4, 4)`` poses of the left camera at ``(N,)`` seconds, and warnings."""
    folder = base / "state_groundtruth_estimate0"
    path = folder / "data.csv"
    T_w_sensor, warnings = read_ground_truth(path, times)
    if T_w_sensor is None:
        return None, warnings
    sensor = base / "cam0" / "sensor.yaml"
    if not sensor.is_file():
        unused = (
            f"{path}: the ground truth is not used because there is no {sensor} with the pose of "
            "the camera."
        )
        return None, (*warnings, unused)
    T_body_camera = read_document(sensor).matrix("T_BS", 4, 4)
    T_body_sensor = np.eye(4)
    if (folder / "sensor.yaml").is_file():
        T_body_sensor = read_document(folder / "sensor.yaml").matrix("T_BS", 4, 4)
    return T_w_sensor @ np.linalg.inv(T_body_sensor) @ T_body_camera, warnings
