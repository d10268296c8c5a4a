"""Reads calibration files in several formats, and writes vslam's own format.

The format of a file is recognised by its keys.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from vslam.calibration.documents import Document, read_document
from vslam.calibration.formats import (
    Size,
    read_euroc,
    read_kalibr,
    read_opencv,
    read_orbslam,
    read_own,
    read_ros,
)
from vslam.calibration.imu import NOISE_KEYS, is_imu, read_imu
from vslam.calibration.models import Calibration, CameraModel
from vslam.support.errors import InputError, write_file

CALIBRATION = "calibration.yaml"
"""The name of the calibration file in a folder of images."""

NEEDED_CALIBRATION = (
    "give a file with the cameras' focal lengths, centres, distortion and, for two cameras, "
    "baseline (docs/howto/cameras.md), or --calib auto for one camera"
)
"""What to do if there is no calibration, for error messages."""

_Reader = Callable[[Sequence[Document], Size | None], Calibration]
# For each format: the keys by which it is recognised, its reader, and the largest number of files.
# The first format whose keys are all in one file is used.
_FORMATS: tuple[tuple[set[str], _Reader, int], ...] = (
    ({"left"}, read_own, 1),
    ({"cam0"}, read_kalibr, 1),
    ({"T_BS", "camera_model"}, read_euroc, 2),
    ({"camera_matrix", "distortion_model"}, read_ros, 2),
    ({"distortion_model", "K"}, read_ros, 2),
    ({"distortion_model", "k"}, read_ros, 2),
    ({"Camera.fx"}, read_orbslam, 1),
    ({"Camera1.fx"}, read_orbslam, 1),
    ({"camera_matrix"}, read_opencv, 1),
    ({"M1"}, read_opencv, 2),
    ({"K1"}, read_opencv, 2),
    ({"cameraMatrix1"}, read_opencv, 2),
)
_PAIRS = (  # file names in the order in which a folder is searched for them
    ("mav0/cam0/sensor.yaml", "mav0/cam1/sensor.yaml", "mav0/imu0/sensor.yaml"),
    ("cam0/sensor.yaml", "cam1/sensor.yaml", "imu0/sensor.yaml"),
    ("left.yaml", "right.yaml"),
    ("intrinsics.yml", "extrinsics.yml"),
    ("camchain-imucam.yaml", "imu.yaml"),
    ("camchain.yaml",),
    ("kalibr_imucam_chain.yaml", "kalibr_imu_chain.yaml"),
)


def read_calibration(files: Sequence[Path | str], size: Size | None = None) -> Calibration:
    """Read a calibration in any of the formats of docs/howto/cameras.md.

    Args:
        files: one file, one file for each camera (left first), or a folder that contains them. A
            further file may describe the IMU (`vslam.calibration.imu`).
        size: width and height of the images, for files without an image size.

    Raises:
        InputError: a file or key is missing, the format or the camera model is unknown, or a number
            is impossible for a camera.
    """
    paths = [
        found
        for given in map(Path, files)
        for found in (_in_folder(given) if given.is_dir() else [given])
    ]
    documents = [read_document(path) for path in paths]
    imus = [document for document in documents if is_imu(document)]
    documents = [document for document in documents if not is_imu(document)]
    if not documents:
        raise InputError(
            f"--calib {imus[0].source}: describes an IMU and no camera; also give the calibration "
            "of the camera."
        )
    for keys, reader, most in _FORMATS:
        if any(keys <= document.values.keys() for document in documents):
            if len(documents) > most:
                raise InputError(
                    f"--calib {documents[most].source}: is one file too many; this format has "
                    f"{'one file' if most == 1 else 'at most two files'}; leave the others out."
                )
            imu, noise = read_imu(documents, imus)
            return replace(reader(documents, size), imu=imu, imu_noise=noise)
    there = ", ".join(" ".join(key.split())[:20] for key in sorted(documents[0].values)[:6])
    raise InputError(
        f"{paths[0]}: the format of this calibration is unknown (its keys are {there}); give "
        "vslam's own format (docs/howto/cameras.md), Kalibr's camchain, OpenCV's YAML, EuRoC's "
        "sensor.yaml, ROS's camera_info or the settings of ORB-SLAM."
    )


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration in vslam's own format.

    Raises:
        ResultsError: the file cannot be written.
    """
    lines = ["left:", *_camera_lines(calibration.left)]
    if calibration.right is not None and calibration.T_left_right is not None:
        lines += ["right:", *_camera_lines(calibration.right)]
        lines += ["T_left_right:  # maps points of the right camera to the left one; metres"]
        lines += [f"  - {row}" for row in calibration.T_left_right.tolist()]
        if calibration.right_delay:
            lines.append(f"right_delay: {calibration.right_delay!r}  # seconds")
    for key in ("depth_scale", "virtual_baseline"):
        if (value := getattr(calibration, key)) is not None:
            lines.append(f"{key}: {value!r}")
    lines += _imu_lines(calibration)
    write_file(path, "\n".join(lines) + "\n", "give another file with --out")


def _camera_lines(model: CameraModel) -> list[str]:
    return [
        f"  lens: {model.lens}",
        f"  size: [{model.width}, {model.height}]",
        f"  focal: [{model.fx!r}, {model.fy!r}]",
        f"  centre: [{model.cx!r}, {model.cy!r}]",
        f"  distortion: {list(model.distortion)}",
    ]


def _imu_lines(calibration: Calibration) -> list[str]:
    imu, noise = calibration.imu, calibration.imu_noise
    lines = []
    if imu is not None:
        lines += ["  T_imu_camera:  # maps points of the left camera to the IMU; metres"]
        lines += [f"    - {row}" for row in imu.T_imu_camera.tolist()]
        lines += [f"  time_offset: {imu.time_offset!r}  # seconds; time of the IMU - of the camera"]
    if noise is not None:
        lines += [f"  {key}: {getattr(noise, name)!r}" for name, key in NOISE_KEYS.items()]
    return ["imu:", *lines] if lines else []


def _in_folder(folder: Path) -> list[Path]:
    for names in _PAIRS:
        found = [folder / name for name in names if (folder / name).is_file()]
        if found:
            return found
    raise InputError(
        f"{folder}: there is no calibration in this folder; give the file, or those of both "
        "cameras."
    )
