"""Rendered drives with the images of two unrectified fisheye cameras, and their calibration.

The town is first rendered for a rectified pinhole pair with a sufficient field of view. The images
are then warped to two equidistant fisheye cameras, whose lenses and rotations differ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vslam.calibration.models import Array, CameraModel, unproject
from vslam.datasets.image_files import read_grey
from vslam.types.camera import Camera
from vslam_lab.towns.files import frame_files, write, write_png, writing
from vslam_lab.towns.routes import RATE, Route
from vslam_lab.towns.site import Variation
from vslam_lab.towns.store import OnFrame, render_sequence

# For each camera: the ratio of its focal length to that of the pinhole camera, the offset of the
# principal point from the image centre (px), the distortion coefficients k1 to k4, and the rotation
# vector from the rectified camera (rad).
_SIDES = (
    (0.970, (6.3, -3.1), (0.012, -0.006, 0.002, -0.0004), (0.011, -0.014, 0.009)),
    (0.962, (-4.7, 5.2), (0.009, -0.004, 0.001, -0.0002), (-0.008, 0.013, -0.012)),
)
_NS = 1_000_000_000


@dataclass(frozen=True)
class FisheyeRig:
    """Two fisheye cameras at the positions of the cameras of a rectified pair.

    Attributes:
        models: models of the left and of the right camera.
        R_own_rectified: for each camera, the ``(3, 3)`` float64 rotation from the frame of the
            rectified camera to the frame of the fisheye camera.
        T_left_right: ``(4, 4)`` float64. It maps points from the right camera's frame to the left
            camera's frame.
    """

    models: tuple[CameraModel, CameraModel]
    R_own_rectified: tuple[Array, Array]
    T_left_right: Array


def fisheye_rig(camera: Camera) -> FisheyeRig:
    """Return a fisheye pair at the positions of the cameras of a rectified pair."""
    models, rotations = [], []
    for scale, (dx, dy), distortion, turn in _SIDES:
        focal = scale * camera.fx
        centre = (camera.width - 1) / 2 + dx, (camera.height - 1) / 2 + dy
        size = camera.width, camera.height
        models.append(CameraModel(focal, focal, *centre, *size, "fisheye", distortion))
        rotations.append(np.asarray(cv2.Rodrigues(np.array(turn))[0], np.float64))
    T_left_right = np.eye(4)
    T_left_right[:3, :3] = rotations[0] @ rotations[1].T
    T_left_right[:3, 3] = rotations[0] @ [camera.baseline, 0.0, 0.0]
    return FisheyeRig((models[0], models[1]), (rotations[0], rotations[1]), T_left_right)


def wide_camera(camera: Camera) -> Camera:
    """Return the rectified pinhole pair that is rendered for a fisheye pair.

    Its focal length is that of ``camera``. Its images are just large enough to cover the view of
    the fisheye pair.
    """
    rig = fisheye_rig(camera)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for model, R_own_rectified in zip(rig.models, rig.R_own_rectified, strict=True):
        at = _seen_at(model, R_own_rectified, replace(camera, cx=0.0, cy=0.0))
        low = np.minimum(low, np.floor(at.min(axis=(0, 1))) - 2)
        high = np.maximum(high, np.ceil(at.max(axis=(0, 1))) + 2)
    width, height = (high - low + 1).astype(int).tolist()
    cx, cy = (-low).tolist()
    return replace(camera, cx=cx, cy=cy, width=width, height=height)


def render_fisheye(
    route: Route,
    variation: Variation,
    folder: Path,
    *,
    until: int | None = None,
    threads: int = 2,
    on_frame: OnFrame | None = None,
) -> Path:
    """Write a drive in EuRoC's layout, with the calibration in EuRoC's and in Kalibr's format.

    The rendered pinhole images stay in ``folder/pinhole``, so that another call can resume an
    interrupted rendering.

    Args:
        route, variation, until, threads, on_frame: same meaning as for `render_sequence`.
        folder: output folder, to which ``mav0``, ``camchain.yaml`` and ``pinhole`` are written.

    Returns:
        ``folder``.

    Raises:
        InputError: the folder cannot be written, the disk is too small, or another process is
            rendering the sequence.
    """
    rig = fisheye_rig(route.camera)
    wide = replace(route, camera=wide_camera(route.camera))
    tree = render_sequence(
        wide, variation, folder / "pinhole", until=until, threads=threads, on_frame=on_frame
    )
    rendered = tree / "sequences" / route.name
    n = min(until or len(route.T_wc), len(route.T_wc))
    stamps = [round(k * _NS / RATE) for k in range(n)]
    T_body = (np.eye(4), rig.T_left_right)
    with writing(folder):
        for side, model in enumerate(rig.models):
            base = folder / "mav0" / f"cam{side}"
            (base / "data").mkdir(parents=True, exist_ok=True)
            x, y = np.moveaxis(_seen_at(model, rig.R_own_rectified[side], wide.camera), 2, 0)
            for k, stamp in enumerate(stamps):
                image = read_grey(frame_files(rendered, k, depth=False)[side])
                warped = cv2.remap(image, x, y, cv2.INTER_LANCZOS4)
                write_png(base / "data" / f"{stamp}.png", warped, 1)
            listed = "".join(f"{stamp},{stamp}.png\n" for stamp in stamps)
            write(base / "data.csv", f"#timestamp [ns],filename\n{listed}".encode())
            write(base / "sensor.yaml", _sensor(model, T_body[side]).encode())
        truth = folder / "mav0" / "state_groundtruth_estimate0"
        truth.mkdir(exist_ok=True)
        T_wc = route.ground_truth[:n].copy()
        T_wc[:, :3, :3] = T_wc[:, :3, :3] @ rig.R_own_rectified[0].T
        write(truth / "data.csv", _states(stamps, T_wc).encode())
        write(folder / "camchain.yaml", _camchain(rig).encode())
    return folder


def _seen_at(model: CameraModel, R_own_rectified: Array, camera: Camera) -> NDArray[np.float32]:
    """Return the ``(H, W, 2)`` pinhole pixels with the viewing directions of the fisheye pixels."""
    u, v = np.meshgrid(np.arange(model.width), np.arange(model.height))
    own = unproject(model, np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    at = camera.project(own @ R_own_rectified)[:, :2]
    return at.reshape(*u.shape, 2).astype(np.float32)


def _sensor(model: CameraModel, T_body_camera: Array) -> str:
    return (
        "%YAML:1.0\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n"
        f"  data: [{_list(T_body_camera)}]\nrate_hz: {RATE:g}\n"
        f"resolution: [{model.width}, {model.height}]\ncamera_model: pinhole\n"
        f"intrinsics: [{_list([model.fx, model.fy, model.cx, model.cy])}]\n"
        f"distortion_model: equidistant\ndistortion_coefficients: [{_list(model.distortion)}]\n"
    )


def _camchain(rig: FisheyeRig) -> str:
    text = ""
    for side, model in enumerate(rig.models):
        text += (
            f"cam{side}:\n  camera_model: pinhole\n"
            f"  intrinsics: [{_list([model.fx, model.fy, model.cx, model.cy])}]\n"
            "  distortion_model: equidistant\n"
            f"  distortion_coeffs: [{_list(model.distortion)}]\n"
            f"  resolution: [{model.width}, {model.height}]\n  rostopic: /cam{side}/image_raw\n"
        )
    rows = "".join(f"  - [{_list(row)}]\n" for row in np.linalg.inv(rig.T_left_right))
    return f"{text}  T_cn_cnm1:\n{rows}"


def _states(stamps: list[int], T_wc: Array) -> str:
    turns = Rotation.from_matrix(T_wc[:, :3, :3]).as_quat(canonical=True, scalar_first=True)
    rows = np.column_stack([T_wc[:, :3, 3], turns])
    lines = [f"{stamp},{_list(row, ',')}\n" for stamp, row in zip(stamps, rows, strict=True)]
    return "#timestamp [ns],p_x [m],p_y,p_z,q_w,q_x,q_y,q_z\n" + "".join(lines)


def _list(numbers: object, separator: str = ", ") -> str:
    return separator.join(repr(float(x)) for x in np.ravel(np.asarray(numbers, np.float64)))
