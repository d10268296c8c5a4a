"""Readers of the calibration formats that docs/howto/cameras.md describes.

The formats are documented in:

- Kalibr's wiki, page "yaml formats";
- OpenCV's samples ``stereo_calib.cpp`` and ``camera_calibration.cpp``;
- the ASL dataset format of EuRoC (Burri et al., IJRR 2016);
- ROS's ``sensor_msgs/CameraInfo``;
- the settings files of ORB-SLAM2, and ``Calibration_Tutorial.pdf`` of ORB-SLAM3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vslam.calibration.documents import Document
from vslam.calibration.models import (
    N_COEFFICIENTS,
    Array,
    Calibration,
    CameraModel,
    Lens,
    without_zeros,
)
from vslam.support.errors import InputError
from vslam.support.untrusted import MOST_PIXELS
from vslam.types.camera import principal_point_doubt

Size = tuple[int, int]
_LENSES: dict[str, Lens] = {
    "none": "pinhole",
    "radtan": "pinhole",
    "radial-tangential": "pinhole",
    "plumb_bob": "pinhole",
    "rational_polynomial": "pinhole",
    "equidistant": "fisheye",
}
_PAIR_KEYS = ("T_left_right", "baseline", "right_delay")
_DEPTH_KEYS = ("depth_scale", "virtual_baseline")
_OWN_KEYS = {"left", "right", "imu", *_PAIR_KEYS, *_DEPTH_KEYS}
_OWN_CAMERA_KEYS = {"lens", "size", "focal", "centre", "distortion"}
_ROUNDED = 1e-3  # tolerance for rotation matrices, whose numbers are rounded in files
_LONGEST_DELAY_S = 0.1  # longest delay between the two images of a pair


def read_own(documents: Sequence[Document], size: Size | None) -> Calibration:
    """Read vslam's own format, which docs/howto/cameras.md describes."""
    (document,) = documents
    _refuse_unknown(document, _OWN_KEYS)
    _refuse_contradictions(document)
    left, *rest = (
        _own_camera(document.section(side), size) for side in ("left", "right") if side in document
    )
    depth_scale, virtual = (
        _positive(document, key) if key in document else None
        for key in ("depth_scale", "virtual_baseline")
    )
    if not rest:
        return Calibration(
            left, depth_scale=depth_scale, virtual_baseline=virtual, source=document.source
        )
    if "T_left_right" in document:
        T_left_right = document.matrix("T_left_right", 4, 4)
    else:
        T_left_right = _shift(document.number("baseline"))
    pair = _pair(document.source, left, rest[0], T_left_right)
    return replace(pair, right_delay=_right_delay(document))


def _right_delay(document: Document) -> float:
    if "right_delay" not in document:
        return 0.0
    delay = document.number("right_delay")
    if not abs(delay) < _LONGEST_DELAY_S:
        raise InputError(
            f"{document.source}: right_delay is {delay:g} s but must be between "
            f"-{_LONGEST_DELAY_S} and {_LONGEST_DELAY_S} s; give the seconds by which the right "
            "image is taken later than the left one."
        )
    return delay


def _refuse_contradictions(document: Document) -> None:
    """Reject a file of vslam's own format whose keys contradict each other. For example, a stereo
    pair must not have both ``T_left_right`` and ``baseline``, or keys for depth."""
    of_pair, of_depth = ([k for k in keys if k in document] for keys in (_PAIR_KEYS, _DEPTH_KEYS))
    if {"T_left_right", "baseline"} <= set(of_pair):
        raise InputError(
            f"{document.source}: T_left_right and baseline both give the transformation; leave one "
            "out."
        )
    if of_pair and "right" not in document:
        raise InputError(
            f"{document.source}: {of_pair[0]} belongs to a stereo pair, but right is missing; add "
            f"right or leave {of_pair[0]} out."
        )
    if of_depth and "right" in document:
        raise InputError(
            f"{document.source}: {of_depth[0]} belongs to a camera with depth, but right to a "
            "stereo pair; leave one of them out."
        )


def read_kalibr(documents: Sequence[Document], size: Size | None) -> Calibration:
    """Read Kalibr's ``camchain.yaml``. ``cam0`` is the left camera, and ``cam1``, which may be
    missing, is the right camera."""
    (document,) = documents
    sections = [document.section(key) for key in ("cam0", "cam1") if key in document]
    models = [_named_camera(section, "distortion_coeffs", size) for section in sections]
    if len(sections) == 1:
        return Calibration(models[0], source=document.source)
    first, second = sections
    if "T_cn_cnm1" not in second and "T_cam_imu" in first and "T_cam_imu" in second:
        T_right_left = second.matrix("T_cam_imu", 4, 4) @ _inverse(first.matrix("T_cam_imu", 4, 4))
    else:
        T_right_left = second.matrix("T_cn_cnm1", 4, 4)
    return _pair(document.source, models[0], models[1], _inverse(T_right_left))


def read_euroc(documents: Sequence[Document], size: Size | None) -> Calibration:
    """Read EuRoC's ``sensor.yaml`` of one or two cameras. ``T_BS`` maps points from the camera
    frame to the body frame."""
    models = [_named_camera(document, "distortion_coefficients", size) for document in documents]
    if len(models) == 1:
        return Calibration(models[0], source=documents[0].source)
    T_body_left, T_body_right = (document.matrix("T_BS", 4, 4) for document in documents)
    return _pair(_sources(documents), models[0], models[1], _inverse(T_body_left) @ T_body_right)


def read_ros(documents: Sequence[Document], size: Size | None) -> Calibration:
    """Read ROS's ``camera_info`` of one or two cameras: a printed message, or the output of ROS's
    package ``camera_calibration``."""
    found = [_ros_names(document) for document in documents]
    models = [_matrix_camera(d, d.source, "K", "D", _lens(d, "none"), size) for d in found]
    if len(models) == 1:
        return Calibration(models[0], source=documents[0].source)
    left, right = found
    P = right.matrix("P", 3, 4)
    if not P[:2, 3].any():
        if "P" not in left or not left.matrix("P", 3, 4)[:2, 3].any():
            raise InputError(
                f"{_sources(documents)}: the projection matrices contain no baseline, which is the "
                "negative fourth number of P divided by its first; give a calibration that "
                "contains the baseline with --calib."
            )
        raise InputError(
            f"{_sources(documents)}: the sides seem swapped, because the baseline is in the "
            "projection matrix of the first camera instead of the second; give the left camera "
            "first, with --topics or --calib."
        )
    T_left_right = _unrectified(left.matrix("R", 3, 3), right.matrix("R", 3, 3), P, right.source)
    return _pair(_sources(documents), models[0], models[1], T_left_right)


def read_opencv(documents: Sequence[Document], size: Size | None) -> Calibration:
    """Read the files that OpenCV's samples write.

    The key of a single camera is ``camera_matrix``. The keys of a stereo pair are ``M1 D1 M2 D2 R
    T``, which may be in one file or in two files. The key ``K1``, and the keys ``cameraMatrix1``
    and ``distCoeffs1`` of OpenCV's manual, are also accepted.
    """
    source = _sources(documents)
    document = Document(source, {k: v for each in documents for k, v in each.values.items()})
    lens: Lens = "fisheye" if _flag(document, "fisheye_model") else "pinhole"
    if "camera_matrix" in document:
        names = ("camera_matrix", "distortion_coefficients")
        return Calibration(_matrix_camera(document, source, *names, lens, size), source=source)
    kinds = (("M", "D"), ("K", "D"), ("cameraMatrix", "distCoeffs"))
    matrix, distortion = next((kind for kind in kinds if kind[0] + "1" in document), kinds[0])
    left, right = (
        _matrix_camera(document, source, matrix + n, distortion + n, lens, size) for n in "12"
    )
    T_right_left = _rigid(document.matrix("R", 3, 3), np.array(document.numbers("T", 3)))
    return _pair(source, left, right, _inverse(T_right_left))


def read_orbslam(documents: Sequence[Document], size: Size | None) -> Calibration:
    """Read the settings file of ORB-SLAM2 or ORB-SLAM3 for a monocular, stereo or RGB-D camera."""
    (document,) = documents
    source = document.source
    if "LEFT.K" in document:
        return _orbslam2_unrectified(document, size)
    kind = document.text("Camera.type") if "Camera.type" in document else "PinHole"
    if kind not in ("PinHole", "Rectified", "KannalaBrandt8"):
        raise InputError(
            f"{source}: Camera.type {kind} is unknown; known are PinHole, Rectified and "
            "KannalaBrandt8."
        )
    lens: Lens = "fisheye" if kind == "KannalaBrandt8" else "pinhole"
    first = "Camera1" if "Camera1.fx" in document else "Camera"
    left = _orbslam_camera(document, first, lens, size)
    factor = next((k for k in ("RGBD.DepthMapFactor", "DepthMapFactor") if k in document), None)
    baseline = None
    if "Stereo.b" in document:
        baseline = _positive(document, "Stereo.b")
    elif "Camera.bf" in document:
        baseline = _positive(document, "Camera.bf") / left.fx
    if factor is not None:
        scale = _positive(document, factor)
        return Calibration(left, depth_scale=scale, virtual_baseline=baseline, source=source)
    if "Camera2.fx" in document:
        right = _orbslam_camera(document, "Camera2", lens, size)
        if "Stereo.T_c1_c2" in document:
            return _pair(source, left, right, document.matrix("Stereo.T_c1_c2", 4, 4))
        T = np.vstack([document.matrix("Tlr", 3, 4), [0.0, 0.0, 0.0, 1.0]])
        return _pair(source, left, right, T)
    if baseline is None:
        return Calibration(left, source=source)
    return _pair(source, left, left, _shift(baseline))


def read_kitti_raw(
    document: Document, size: Size, cameras: tuple[int, ...] = (0, 1)
) -> Calibration:
    """Read ``calib_cam_to_cam.txt`` of KITTI raw, which describes four cameras.

    The size of the images tells whether they are rectified (``S_rect``) or not (``S``).

    Args:
        size: width and height of the images.
        cameras: numbers of the left and the right camera, or of the only camera.
    """
    source = document.source
    names = [f"{number:02}" for number in cameras]
    rectified, original = (document.integers(f"{key}_{names[0]}", 2) for key in ("S_rect", "S"))
    if size == rectified:
        P = [document.matrix(f"P_rect_{name}", 3, 4) for name in names]
        K = [one[:, :3] for one in P]
        distortions: list[tuple[float, ...]] = [()] * len(P)
    elif size == original:
        K = [document.matrix(f"K_{name}", 3, 3) for name in names]
        distortions = [document.numbers(f"D_{name}", 5) for name in names]
    else:
        raise InputError(
            f"{source}: made for images of {rectified[0]}x{rectified[1]} (rectified) or "
            f"{original[0]}x{original[1]} pixels but the images have {size[0]}x{size[1]}; take "
            "the original images, or give another calibration with --calib."
        )
    models = [
        _camera(source, "pinhole", (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), distortion, size)
        for k, distortion in zip(K, distortions, strict=True)
    ]
    if len(models) == 1:
        return Calibration(models[0], source=source)
    if size == rectified:
        # The last column is K t, and t is the camera's translation from camera 0.
        left, right = ((one[0, 3] - one[0, 2] * one[2, 3]) / one[0, 0] for one in P)
        return _pair(source, models[0], models[1], _shift(left - right))
    T_left_0, T_right_0 = (
        _rigid(document.matrix(f"R_{name}", 3, 3), np.array(document.numbers(f"T_{name}", 3)))
        for name in names
    )
    return _pair(source, models[0], models[1], T_left_0 @ _inverse(T_right_0))


def _own_camera(document: Document, size: Size | None) -> CameraModel:
    _refuse_unknown(document, _OWN_CAMERA_KEYS)
    lens = document.text("lens") if "lens" in document else "pinhole"
    if lens not in ("pinhole", "fisheye"):
        raise InputError(f"{document.source}: lens {lens} is unknown; write pinhole or fisheye.")
    return _camera(
        document.source,
        "fisheye" if lens == "fisheye" else "pinhole",
        document.numbers("focal", 2) + document.numbers("centre", 2),
        document.numbers("distortion") if "distortion" in document else (),
        _size_of(document, size, "size"),
    )


def _named_camera(document: Document, distortion: str, size: Size | None) -> CameraModel:
    """Read a camera from a Kalibr or EuRoC file, which names the camera and distortion models."""
    if (kind := document.text("camera_model")) != "pinhole":
        raise InputError(
            f"{document.source}: camera_model {kind} is unknown; known is pinhole, with one of "
            f"the distortion models {', '.join(_LENSES)}."
        )
    lens, distorted = _lens(document), document.text("distortion_model") != "none"
    return _camera(
        document.source,
        lens,
        document.numbers("intrinsics", 4),
        document.numbers(distortion) if distorted else (),
        _size_of(document, size, "resolution"),
    )


def _matrix_camera(
    document: Document, source: str, K: str, D: str, lens: Lens, size: Size | None
) -> CameraModel:
    """Read a camera that is given by a camera matrix and a vector of distortion coefficients."""
    matrix = document.matrix(K, 3, 3)
    numbers = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    if "image_width" in document or size is None:
        size = _size_of(document, size, "image_width", "image_height")
    elif doubt := principal_point_doubt((matrix[0, 2], matrix[1, 2]), size):
        raise InputError(
            f"{source}: {doubt}; give a calibration for this resolution and orientation, or, if "
            "this one is correct, add image_width and image_height to it."
        )
    return _camera(source, lens, tuple(map(float, numbers)), document.numbers(D), size)


def _orbslam_camera(document: Document, name: str, lens: Lens, size: Size | None) -> CameraModel:
    order = ("k1", "k2", "k3", "k4") if lens == "fisheye" else ("k1", "k2", "p1", "p2", "k3")
    keys = [f"{name}.{key}" for key in order]
    distortion = [document.number(key) if key in document else 0.0 for key in keys]
    numbers = tuple(document.number(f"{name}.{key}") for key in ("fx", "fy", "cx", "cy"))
    size = _size_of(document, size, "Camera.width", "Camera.height")
    return _camera(document.source, lens, numbers, tuple(distortion), size)


def _orbslam2_unrectified(document: Document, size: Size | None) -> Calibration:
    models, rotations = [], []
    for side in ("LEFT", "RIGHT"):
        found = _size_of(document, size, f"{side}.width", f"{side}.height")
        models.append(
            _matrix_camera(document, document.source, f"{side}.K", f"{side}.D", "pinhole", found)
        )
        rotations.append(document.matrix(f"{side}.R", 3, 3))
    P = document.matrix("RIGHT.P", 3, 4)
    T_left_right = _unrectified(rotations[0], rotations[1], P, f"{document.source}: RIGHT")
    return _pair(document.source, models[0], models[1], T_left_right)


def _ros_names(document: Document) -> Document:
    """Rename the keys of a ``camera_calibration`` file to those of a printed ``camera_info``."""
    names = {
        "camera_matrix": "K",
        "distortion_coefficients": "D",
        "rectification_matrix": "R",
        "projection_matrix": "P",
        "width": "image_width",
        "height": "image_height",
        "k": "K",
        "d": "D",
        "r": "R",
        "p": "P",
    }
    values = {names.get(key, key): value for key, value in document.values.items()}
    return Document(document.source, values)


def _lens(document: Document, unnamed: str = "") -> Lens:
    """Return the kind of lens of the distortion model that a file names. If the name is empty, the
    model ``unnamed`` is used."""
    word = document.text("distortion_model") or unnamed
    if word not in _LENSES:
        raise InputError(
            f"{document.source}: distortion model {word} is unknown; known are "
            f"{', '.join(_LENSES)}."
        )
    return _LENSES[word]


def _size_of(document: Document, size: Size | None, *keys: str) -> Size:
    """Read the width and height of the images, which are stored under one or two keys. If the file
    has no such key, ``size`` is returned."""
    if keys[0] not in document and size is not None:
        return size
    each = 2 // len(keys)
    width, height = (n for key in keys for n in document.integers(key, each))
    return width, height


def _positive(document: Document, key: str) -> float:
    number = document.number(key)
    if number <= 0.0:
        raise InputError(f"{document.source}: {key} is {number:g} but must be positive.")
    return number


def _flag(document: Document, key: str) -> bool:
    return key in document and document.number(key) != 0.0


def _camera(
    source: str,
    lens: Lens,
    intrinsics: tuple[float, ...],
    distortion: tuple[float, ...],
    size: Size,
) -> CameraModel:
    fx, fy, cx, cy = intrinsics
    width, height = size
    distortion = without_zeros(lens, distortion)
    if len(distortion) not in N_COEFFICIENTS[lens]:
        known = " or ".join(map(str, N_COEFFICIENTS[lens]))
        raise InputError(
            f"{source}: {len(distortion)} distortion coefficients; a {lens} camera has {known}."
        )
    if width < 1 or height < 1:
        raise InputError(f"{source}: the image size {width}x{height} must be positive.")
    if width * height > MOST_PIXELS:
        raise InputError(f"{source}: the image size {width}x{height} is too large; correct it.")
    if fx <= 0 or fy <= 0:
        raise InputError(f"{source}: the focal lengths {fx:g}, {fy:g} must be positive.")
    if not (0 < cx < width and 0 < cy < height):
        raise InputError(
            f"{source}: the principal point ({cx:.1f}, {cy:.1f}) lies outside the "
            f"{width}x{height} image; check the numbers and their order."
        )
    return CameraModel(fx, fy, cx, cy, width, height, lens, distortion)


def _pair(source: str, left: CameraModel, right: CameraModel, T_left_right: Array) -> Calibration:
    R = T_left_right[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=_ROUNDED) or np.linalg.det(R) < 0:
        raise InputError(
            f"{source}: the transformation between the cameras contains no valid rotation; check "
            "its numbers and their order."
        )
    U, _, Vt = np.linalg.svd(R)  # U Vt is the rotation nearest to the rounded one
    return Calibration(left, right, _rigid(U @ Vt, T_left_right[:3, 3]), source=source)


def _unrectified(R_left: Array, R_right: Array, P: Array, source: str) -> Array:
    """Compute ``T_left_right`` of the unrectified cameras from the matrices of the rectification.

    Args:
        R_left, R_right: ``(3, 3)`` rotations from each camera into the rectified frame.
        P: ``(3, 4)`` projection matrix of the rectified right camera. The baseline is in its first
            row, or in its second row if one camera is above the other.
    """
    if P[0, 0] <= 0 or P[1, 1] <= 0 or not P[:2, 3].any():
        raise InputError(
            f"{source}: the projection matrix contains no baseline; its fourth number must be the "
            "negative baseline in metres times the focal length."
        )
    baseline = np.array([-P[0, 3] / P[0, 0], -P[1, 3] / P[1, 1], 0.0])
    return _rigid(R_left.T @ R_right, R_left.T @ baseline)


def _rigid(R: Array, t: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def _shift(baseline: float) -> Array:
    return _rigid(np.eye(3), np.array([baseline, 0.0, 0.0]))


def _inverse(T: Array) -> Array:
    return _rigid(T[:3, :3].T, -T[:3, :3].T @ T[:3, 3])


def _sources(documents: Sequence[Document]) -> str:
    return " and ".join(document.source for document in documents)


def _refuse_unknown(document: Document, known: set[str]) -> None:
    for key in document.values:
        if key not in known:
            raise InputError(
                f"{document.source}: {key} is unknown; known are {', '.join(sorted(known))}."
            )
