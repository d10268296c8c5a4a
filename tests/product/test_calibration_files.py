"""All calibration formats, written for the same pair of cameras, give the same calibration."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from vslam.calibration.files import read_calibration
from vslam.calibration.models import Calibration, CameraModel
from vslam.calibration.rectification import rectify
from vslam.support.errors import InputError
from vslam.types.geometry import inverse, se3_exp

SIZE = (752, 480)
LEFT = CameraModel(
    458.654, 457.296, 367.215, 248.375, *SIZE, "pinhole", (-0.28, 0.074, 0.0002, 1e-05)
)
RIGHT = CameraModel(
    457.587, 456.134, 379.999, 255.238, *SIZE, "pinhole", (-0.284, 0.0745, -1e-4, -4e-05)
)
ROUND = tuple(
    CameraModel(c.fx, c.fy, c.cx, c.cy, *SIZE, "fisheye", (0.01, -0.002, 3e-4, -1e-5))
    for c in (LEFT, RIGHT)
)
T_LEFT_RIGHT = se3_exp(np.array([0.11, 0.001, -0.0005, 0.001, 0.012, -0.014]))
T_BODY_LEFT = se3_exp(np.array([0.3, -0.2, 0.1, 0.1, 0.2, 1.5]))

Models = tuple[CameraModel, CameraModel]


def rows(array: np.ndarray) -> str:
    return ", ".join(repr(float(x)) for x in np.ravel(array))


def matrix(c: CameraModel) -> np.ndarray:
    return np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1.0]])


def opencv_matrix(array: np.ndarray, space: str = " ") -> str:
    height, width = np.atleast_2d(array).shape
    return (
        f"!!opencv-matrix\n   rows: {height}\n   cols: {width}\n   dt: d\n"
        f"   data:{space}[ {rows(array)} ]\n"
    )


def ros_matrix(array: np.ndarray) -> str:
    height, width = np.atleast_2d(array).shape
    return f"\n  rows: {height}\n  cols: {width}\n  data: [{rows(array)}]\n"


def rectifying(models: Models) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute R and P as OpenCV's stereo calibration does, for the files of ROS and ORB-SLAM2."""
    T_right_left = inverse(T_LEFT_RIGHT)
    D = [np.array(c.distortion) for c in models]
    R1, R2, _, P2, *_ = cv2.stereoRectify(
        matrix(models[0]), D[0], matrix(models[1]), D[1], SIZE,
        T_right_left[:3, :3].copy(), T_right_left[:3, 3:].copy(), alpha=0,
    )  # fmt: skip
    return R1, R2, P2


def own(folder: Path, models: Models) -> list[Path]:
    text = ""
    for side, c in zip(("left", "right"), models, strict=True):
        text += (
            f"{side}:\n  lens: {c.lens}\n  size: [{c.width}, {c.height}]\n"
            f"  focal: [{c.fx}, {c.fy}]\n  centre: [{c.cx}, {c.cy}]\n"
            f"  distortion: [{rows(c.distortion)}]\n"
        )
    lines = "".join(f"  - [{rows(row)}]\n" for row in T_LEFT_RIGHT)
    (folder / "own.yaml").write_text(f"# ours\n{text}T_left_right:\n{lines}")
    return [folder / "own.yaml"]


def kalibr(folder: Path, models: Models) -> list[Path]:
    text = ""
    for k, c in enumerate(models):
        text += (
            f"cam{k}:\n  camera_model: pinhole\n  intrinsics: [{c.fx}, {c.fy}, {c.cx}, {c.cy}]\n"
            f"  distortion_model: {'radtan' if c.lens == 'pinhole' else 'equidistant'}\n"
            f"  distortion_coeffs: [{rows(c.distortion)}]\n"
            f"  resolution: [{c.width}, {c.height}]\n  rostopic: /cam{k}/image_raw\n"
            "  cam_overlaps: [1]\n  timeshift_cam_imu: 0.0\n"
        )
    lines = "".join(f"  - [{rows(row)}]\n" for row in inverse(T_LEFT_RIGHT))
    (folder / "camchain.yaml").write_text(f"{text}  T_cn_cnm1:\n{lines}")
    return [folder]


def euroc(folder: Path, models: Models) -> list[Path]:
    for k, (c, T) in enumerate(zip(models, (T_BODY_LEFT, T_BODY_LEFT @ T_LEFT_RIGHT), strict=True)):
        path = folder / f"mav0/cam{k}/sensor.yaml"
        path.parent.mkdir(parents=True)
        kind = "radial-tangential" if c.lens == "pinhole" else "equidistant"
        path.write_text(
            "%YAML:1.0\n# General sensor definitions.\nsensor_type: camera\n"
            f"comment: VI-Sensor cam0\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{rows(T)}]\n"
            f"rate_hz: 20\nresolution: [752, 480]\ncamera_model: pinhole\n"
            f"intrinsics: [{c.fx}, {c.fy}, {c.cx}, {c.cy}] #fu, fv, cu, cv\n"
            f"distortion_model: {kind}\ndistortion_coefficients: [{rows(c.distortion)}]\n"
        )
    return [folder]


def ros(folder: Path, models: Models) -> list[Path]:
    R1, R2, P2 = rectifying(models)
    P1 = P2.copy()
    P1[0, 3] = 0
    for name, c, R, P in zip(("left", "right"), models, (R1, R2), (P1, P2), strict=True):
        (folder / f"{name}.yaml").write_text(
            f"image_width: 752\nimage_height: 480\ncamera_name: {name}\n"
            f"camera_matrix:{ros_matrix(matrix(c))}distortion_model: plumb_bob\n"
            f"distortion_coefficients:{ros_matrix(np.append(c.distortion, 0.0))}"
            f"rectification_matrix:{ros_matrix(R)}projection_matrix:{ros_matrix(P)}"
        )
    return [folder / "left.yaml", folder / "right.yaml"]


def ros_message(folder: Path, models: Models) -> list[Path]:
    R1, R2, P2 = rectifying(models)
    paths = []
    for name, c, R in zip("lr", models, (R1, R2), strict=True):
        paths.append(folder / f"{name}.yaml")
        paths[-1].write_text(
            "header:\n  frame_id: cam\nheight: 480\nwidth: 752\ndistortion_model: plumb_bob\n"
            f"d: [{rows(np.append(c.distortion, 0.0))}]\nk: [{rows(matrix(c))}]\n"
            f"r: [{rows(R)}]\np: [{rows(P2)}]\nbinning_x: 0\n"
        )
    return paths


def opencv(folder: Path, models: Models) -> list[Path]:
    paths = [folder / "intrinsics.yml", folder / "extrinsics.yml"]
    first, second = (cv2.FileStorage(str(p), cv2.FILE_STORAGE_WRITE) for p in paths)
    for k, c in enumerate(models, start=1):
        first.write(f"M{k}", matrix(c))
        first.write(f"D{k}", np.array([c.distortion]))
    if models[0].lens == "fisheye":
        first.write("fisheye_model", 1)
    T_right_left = inverse(T_LEFT_RIGHT)
    second.write("R", T_right_left[:3, :3])
    second.write("T", T_right_left[:3, 3:])
    first.release()
    second.release()
    return paths


def orbslam2(folder: Path, models: Models) -> list[Path]:
    R1, R2, P2 = rectifying(models)
    text = f"%YAML:1.0\n\nCamera.fx: {P2[0, 0]}\nCamera.fy: {P2[1, 1]}\nCamera.cx: {P2[0, 2]}\n"
    text += f"Camera.cy: {P2[1, 2]}\nCamera.k1: 0.0\nCamera.bf: {-P2[0, 3]}\nThDepth: 35\n"
    for name, c, R in zip(("LEFT", "RIGHT"), models, (R1, R2), strict=True):
        five = np.append(c.distortion, 0.0)
        text += f"{name}.height: 480\n{name}.width: 752\n{name}.D: {opencv_matrix(five, '')}"
        text += f"{name}.K: {opencv_matrix(matrix(c))}{name}.R: {opencv_matrix(R)}"
        text += f"{name}.P: {opencv_matrix(P2)}"
    (folder / "EuRoC.yaml").write_text(text)
    return [folder / "EuRoC.yaml"]


def orbslam3(folder: Path, models: Models) -> list[Path]:
    kind = "PinHole" if models[0].lens == "pinhole" else "KannalaBrandt8"
    names = ("k1", "k2", "p1", "p2") if kind == "PinHole" else ("k1", "k2", "k3", "k4")
    text = f'%YAML:1.0\nFile.version: "1.0"\nCamera.type: "{kind}"\n'
    for k, c in enumerate(models, start=1):
        named = dict(
            fx=c.fx, fy=c.fy, cx=c.cx, cy=c.cy, **dict(zip(names, c.distortion, strict=True))
        )
        text += "".join(f"Camera{k}.{key}: {value}\n" for key, value in named.items())
    text += "Camera.width: 752\nCamera.height: 480\nCamera.fps: 20\nStereo.ThDepth: 60.0\n"
    (folder / "EuRoC.yaml").write_text(f"{text}Stereo.T_c1_c2: {opencv_matrix(T_LEFT_RIGHT)}")
    return [folder / "EuRoC.yaml"]


RADIAL = (own, kalibr, euroc, ros, ros_message, opencv, orbslam2, orbslam3)
FISHEYE = (own, kalibr, euroc, opencv, orbslam3)


def same(found: Calibration, models: Models) -> None:
    assert (found.left, found.right) == models
    np.testing.assert_allclose(found.T_left_right, T_LEFT_RIGHT, atol=1e-9)
    assert (found.depth_scale, found.virtual_baseline) == (None, None)


@pytest.mark.parametrize("write", RADIAL, ids=lambda f: f.__name__)
def test_a_radial_tangential_pair(tmp_path, write):
    same(read_calibration(write(tmp_path, (LEFT, RIGHT)), SIZE), (LEFT, RIGHT))


@pytest.mark.parametrize("write", FISHEYE, ids=lambda f: f.__name__)
def test_a_fisheye_pair(tmp_path, write):
    same(read_calibration(write(tmp_path, ROUND), SIZE), ROUND)


@pytest.mark.parametrize("down", [0.11, -0.11])
@pytest.mark.parametrize("write", RADIAL, ids=lambda f: f.__name__)
def test_a_pair_of_cameras_one_above_the_other(tmp_path, monkeypatch, write, down):
    T = se3_exp(np.array([0.001, down, -0.0005, 0.001, 0.012, -0.014]))
    monkeypatch.setattr(sys.modules[__name__], "T_LEFT_RIGHT", T)
    found = read_calibration(write(tmp_path, (LEFT, RIGHT)), SIZE)
    same(found, (LEFT, RIGHT))
    assert rectify(found).camera.quarter_turns == np.sign(down)


def complaint(given: list[Path]) -> str:
    """Return the error message of the reader for these files; empty if it accepts them."""
    try:
        assert read_calibration(given, SIZE).left.fx > 0
    except InputError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("write", RADIAL, ids=lambda f: f.__name__)
def test_truncated_and_damaged_files(tmp_path, write):
    """If the reader accepts a damaged file, all numbers are possible for a camera."""
    given = write(tmp_path, (LEFT, RIGHT))
    files = [p for p in tmp_path.rglob("*") if p.is_file()]
    whole = {path: path.read_text() for path in files}
    rng = np.random.default_rng(1)
    refused = 0
    for turn in range(60):
        path = files[turn % len(files)]
        text = whole[path]
        at = int(rng.integers(len(text)))
        noise = "".join(chr(c) for c in rng.integers(32, 127, 3))
        path.write_text(text[:at] if turn % 3 else text[:at] + noise + text[at + 3 :])
        message = complaint(given)
        refused += bool(message)
        assert "\n" not in message
        assert not message or message.endswith(".")
        path.write_text(text)
    assert refused > 20


def edited(tmp_path: Path, write: Callable, pattern: str, by: str) -> list[Path]:
    given = write(tmp_path, (LEFT, RIGHT))
    path = next(p for p in sorted(tmp_path.rglob("*")) if p.is_file())
    text, n = re.subn(pattern, by, path.read_text(), count=1)
    assert n == 1
    path.write_text(text)
    return given


@pytest.mark.parametrize(
    ("write", "pattern", "by", "words"),
    [
        (kalibr, "radtan", "fov", "cam0: distortion model fov is unknown; known are none, radtan"),
        (kalibr, "pinhole", "omni", "camera_model omni is unknown; known is pinhole"),
        (kalibr, "intrinsics", "x", "cam0: intrinsics is missing"),
        (kalibr, "T_cn_cnm1", "T", "cam1: T_cn_cnm1 is missing"),
        (kalibr, "458.654", "nan", "cam0: intrinsics must be 4 numbers, all finite"),
        (kalibr, "458.654", ".NaN", "cam0: intrinsics must be 4 numbers, all finite"),
        (kalibr, "458.654", "-458", "focal lengths -458, 457.296 must be positive"),
        (kalibr, "367.215", "1367", "principal point .* outside the 752x480 image"),
        (kalibr, "-0.28, ", "-0.28, 1, 1, ", "6 distortion coefficients; a pinhole"),
        (euroc, "radial-tangential", "spherical", "distortion model spherical is unknown"),
        (own, "lens: pinhole", "lens: wide", "left: lens wide is unknown"),
        (own, "focal:", "focus:", "left: focus is unknown; known are centre, distortion"),
        (own, "T_left_right:", "T_right_left:", "T_right_left is unknown"),
        (own, r"  - \[0\.99", "  - [0.39", "contains no valid rotation"),
        (own, "right:", "right: 3\nleft:", "right must be a section"),
        (orbslam3, "PinHole", "Fish", "Camera.type Fish is unknown"),
        (orbslam3, "Camera1.fy", "Camera1.f", "Camera1.fy is missing"),
        (ros, "plumb_bob", "fov", "distortion model fov is unknown"),
        (own, "left:", "links:", "the format of this calibration is unknown"),
        (own, "# ours", "[", "not valid YAML at line"),
        (own, "[\\s\\S]+", "words", "must be a list of keys with values"),
        (own, "[\\s\\S]+", "", "is empty"),
        (own, "left:", "links:", r"its keys are T_left_right, links, right"),
        (own, "[\\s\\S]+", "<?xml version='1.0'?>", "XML, which is not supported; .* .yml"),
    ],
)  # fmt: skip
def test_bad_files(tmp_path, write, pattern, by, words):
    with pytest.raises(InputError, match=words) as caught:
        read_calibration(edited(tmp_path, write, pattern, by))
    assert "\n" not in str(caught.value)


def test_missing_files_and_too_many(tmp_path):
    with pytest.raises(InputError, match=r"none\.yaml: the calibration is missing"):
        read_calibration([tmp_path / "none.yaml"])
    with pytest.raises(InputError, match="there is no calibration in this folder"):
        read_calibration([tmp_path])
    (path,) = own(tmp_path, (LEFT, RIGHT))
    with pytest.raises(InputError, match="is one file too many; this format has one"):
        read_calibration([path, path])


def test_a_size_that_neither_file_nor_image_tells(tmp_path):
    given = opencv(tmp_path, (LEFT, RIGHT))
    with pytest.raises(InputError, match="image_width is missing"):
        read_calibration(given)


def test_settings_of_an_rgbd_camera(tmp_path):
    """Like ORB-SLAM2's TUM1.yaml, the file states neither the image size nor the camera type."""
    path = tmp_path / "TUM1.yaml"
    path.write_text(
        "%YAML:1.0\nCamera.fx: 517.306408\nCamera.fy: 516.469215\nCamera.cx: 318.643040\n"
        "Camera.cy: 255.313989\nCamera.k1: 0.262383\nCamera.k2: -0.953104\n"
        "Camera.p1: -0.005358\nCamera.p2: 0.002628\nCamera.k3: 1.163314\n"
        "Camera.bf: 40.0\nDepthMapFactor: 5000.0\n"
    )
    found = read_calibration([path], (640, 480))
    assert found.right is None
    assert found.depth_scale == 5000
    assert found.virtual_baseline == pytest.approx(40 / 517.306408)
    assert found.left.distortion == (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)
    assert (found.left.width, found.left.height) == (640, 480)


ONE = "{focal: [458, 457], centre: [367, 248], size: [752, 480]}"
PAIR = f"left: {ONE}\nright: {ONE}\n"
SETTINGS = "Camera.fx: 517\nCamera.fy: 516\nCamera.cx: 318\nCamera.cy: 255\n"
TURNED = "T_left_right: [0.9998, 0, 0.02, 0.5, 0, 1, 0, 0, -0.02, 0, 0.9998, 0, 0, 0, 0, 1]\n"
IDENTITY = "T_left_right: [1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"left: {ONE}\ndepth_scale: 0\n", "depth_scale is 0 but must be positive"),
        (f"left: {ONE}\nvirtual_baseline: -0.1\n", "virtual_baseline is -0.1 but must be"),
        (
            f"{PAIR}{IDENTITY}baseline: 0.1\n",
            "T_left_right and baseline both give the transformation",
        ),
        (
            f"left: {ONE}\nbaseline: 0.1\n",
            "baseline belongs to a stereo pair, but right is missing",
        ),
        (f"left: {ONE}\n{IDENTITY}", "T_left_right belongs to a stereo pair, but right is missing"),
        (f"left: {ONE}\nright_delay: 0.01\n", "right_delay belongs to a stereo pair, but right is"),
        (f"{PAIR}{IDENTITY}right_delay: 4.7\n", "right_delay is 4.7 s but must be between"),
        (f"{PAIR}{IDENTITY}right_delay: -0.1\n", "right_delay is -0.1 s but must be between"),
        (f"{PAIR}baseline: 0.1\ndepth_scale: 5000\n", "depth_scale belongs to a camera with depth"),
        (f"{SETTINGS}DepthMapFactor: 0\n", "DepthMapFactor is 0 but must be positive"),
        (f"{SETTINGS}Camera.bf: -40\nDepthMapFactor: 5000\n", "Camera.bf is -40 but must be"),
        (f"{SETTINGS}Camera.bf: 0\n", "Camera.bf is 0 but must be positive"),
        (f"left: {ONE.replace('752', '752.9')}\n", "left: size must be 2 integers"),
        (f"{SETTINGS}Camera.width: 640.5\nCamera.height: 480\n", "width must be one integer"),
    ],
)
def test_contradictions_and_numbers_that_cannot_be(tmp_path, text, words):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        read_calibration([path], SIZE)
    assert "\n" not in str(caught.value)


def test_a_rectified_pair_by_its_baseline(tmp_path):
    path = tmp_path / "kitti.yaml"
    path.write_text(
        "left: &one {focal: [718.9, 718.9], centre: [607.2, 185.2], size: [1241, 376]}\n"
        "right: *one\nbaseline: 0.54\n"
    )
    found = read_calibration([path])
    assert found.left == found.right
    assert found.T_left_right[0, 3] == 0.54
    assert rectify(found).camera.right_delay == 0.0
    path.write_text(
        "Camera.fx: 718.9\nCamera.fy: 718.9\nCamera.cx: 607.2\nCamera.cy: 185.2\n"
        f"Camera.bf: {718.9 * 0.54}\nCamera.width: 1241\nCamera.height: 376\n"
    )
    settings = read_calibration([path])
    assert settings.left == found.left
    np.testing.assert_allclose(settings.T_left_right, found.T_left_right)


@pytest.mark.parametrize("transformation", ["baseline: 0.54\n", TURNED])
def test_a_delay_of_the_right_side_reaches_the_rectified_camera(tmp_path, transformation):
    path = tmp_path / "late.yaml"
    path.write_text(f"{PAIR}{transformation}right_delay: -4.7e-3\n")
    found = read_calibration([path])
    assert rectify(found).camera.right_delay == -0.0047
    assert rectify(found.left_alone()).camera.right_delay == 0.0


def test_the_names_of_the_manual_of_opencv(tmp_path):
    given = opencv(tmp_path, (LEFT, RIGHT))
    wanted, file = read_calibration(given, SIZE), given[0]
    text = re.sub(r"^[MK]([12]):", r"cameraMatrix\1:", file.read_text(), flags=re.MULTILINE)
    file.write_text(re.sub(r"^D([12]):", r"distCoeffs\1:", text, flags=re.MULTILINE))
    assert "cameraMatrix2" in file.read_text()
    assert "distCoeffs1" in file.read_text()
    found = read_calibration(given, SIZE)
    assert (found.left, found.right) == (wanted.left, wanted.right)


def test_a_file_without_a_size_of_another_resolution(tmp_path):
    given = opencv(tmp_path, (LEFT, RIGHT))
    for size in ((376, 240), (480, 752), (1504, 960)):
        with pytest.raises(InputError, match=r"far from the middle of the \d+x\d+ images; "):
            read_calibration(given, size)


def test_one_camera_of_opencv(tmp_path):
    path = tmp_path / "out.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 752)
    storage.write("image_height", 480)
    storage.write("camera_matrix", matrix(LEFT))
    storage.write("distortion_coefficients", np.array((*LEFT.distortion, 0.0)))
    storage.release()
    found = read_calibration([path])
    assert (found.left, found.right) == (LEFT, None)


def test_the_example_of_the_manual(tmp_path):
    text = (Path(__file__).parents[2] / "docs/howto/cameras.md").read_text()
    (example,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    (tmp_path / "mine.yaml").write_text(example)
    found = read_calibration([tmp_path / "mine.yaml"])
    assert found.left.distortion[0] == -0.28340811
    assert found.T_left_right[0, 3] == 0.1100741
