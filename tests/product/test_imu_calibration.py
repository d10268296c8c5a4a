"""Calibrations of an IMU: vslam's own format, Kalibr's, EuRoC's and OpenVINS'."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vslam.calibration.files import read_calibration, write_calibration
from vslam.support.errors import InputError
from vslam.types.geometry import se3_exp
from vslam.types.imu import ImuNoise

T = se3_exp(np.array([0.05, -0.02, 0.01, 0.3, -1.2, 0.7]))  # T_imu_camera
NOISE = ImuNoise(1.7e-4, 2e-3, 1.9e-5, 3e-3)
DENSITIES = (
    "gyroscope_noise_density: 1.7e-04\ngyroscope_random_walk: 1.9e-05\n"
    "accelerometer_noise_density: 2.0e-03\naccelerometer_random_walk: 3.0e-03\n"
)
OWN_CAMERA = "left:\n  size: [64, 48]\n  focal: [50.0, 50.0]\n  centre: [32.0, 24.0]\n"
KALIBR_CAMERA = (
    "  camera_model: pinhole\n  distortion_model: radtan\n  distortion_coeffs: [0, 0, 0, 0]\n"
    "  intrinsics: [50, 50, 32, 24]\n  resolution: [64, 48]\n"
)


def rows(T: np.ndarray) -> str:
    return "".join(f"  - {row}\n" for row in T.tolist())


def own(section: str) -> str:
    return OWN_CAMERA + "imu:\n" + "".join(f"  {line}\n" for line in section.splitlines())


def read(tmp_path: Path, *texts: str):
    files = []
    for k, text in enumerate(texts):
        files.append(tmp_path / f"file{k}.yaml")
        files[-1].write_text(text)
    return read_calibration(files)


FORMATS = {
    "vslam": [own(f"T_imu_camera: {T.tolist()}\ntime_offset: 0.004\n{DENSITIES}")],
    "kalibr": [
        f"cam0:\n  T_cam_imu:\n{rows(np.linalg.inv(T))}  timeshift_cam_imu: 0.004\n{KALIBR_CAMERA}",
        f"{DENSITIES}rostopic: /imu0\nupdate_rate: 200.0\n",
    ],
    "openvins": [
        f"%YAML:1.0\ncam0:\n  T_imu_cam:\n{rows(T)}  timeshift_cam_imu: 0.004\n{KALIBR_CAMERA}",
        "%YAML:1.0\nimu0:\n  T_i_b:\n" + rows(np.eye(4))
        + "".join(f"  {line}\n" for line in DENSITIES.splitlines()),
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("turned", [False, True])
def test_all_formats_give_the_same_calibration(tmp_path, name, turned):
    texts = FORMATS[name][::-1] if turned else FORMATS[name]  # the order of the files is free
    found = read(tmp_path, *texts)
    assert found.imu is not None
    assert found.imu_noise == NOISE
    assert found.imu.noise == NOISE
    np.testing.assert_allclose(found.imu.T_imu_camera, T, atol=1e-12)
    assert found.imu.time_offset == 0.004


def test_written_calibration_is_read_again(tmp_path):
    found = read(tmp_path, *FORMATS["vslam"])
    write_calibration(tmp_path / "new.yaml", found)
    again = read_calibration([tmp_path / "new.yaml"])
    assert again.imu is not None
    assert again.imu_noise == NOISE
    assert again.left == found.left
    T_imu_camera = again.imu.T_imu_camera  # the nearest rotation is found anew
    np.testing.assert_allclose(T_imu_camera, found.imu.T_imu_camera, rtol=0, atol=1e-15)


def test_noise_alone_says_nothing_about_the_place(tmp_path):
    found = read(tmp_path, own("gyroscope_noise_density: 1.7e-4"))
    assert found.imu is None
    assert found.imu_noise == ImuNoise(gyro=1.7e-4)
    assert read(tmp_path, OWN_CAMERA).imu_noise is None


MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])
FAR = se3_exp(np.array([50.0, 0, 0, 0, 0, 0]))


@pytest.mark.parametrize(
    ("section", "said"),
    [
        (f"T_imu_camera: {np.zeros((4, 4)).tolist()}", "all zeros"),
        (f"T_imu_camera: {MIRROR.tolist()}", "not a rigid motion"),
        (f"T_imu_camera: {(2 * T).tolist()}", "not a rigid motion"),
        (f"T_imu_camera: {T.T.tolist()}", "transpose it"),
        (f"T_imu_camera: {FAR.tolist()}", "write the translation in metres"),
        (f"T_imu_camera: {T[:3].tolist()}", "4x4 numbers"),
        ("gyroscope_noise_density: 1.7", "1e-07 to 0.3 rad/s/sqrt(Hz)"),
        ("gyroscope_noise_density: 0", "rad/s/sqrt(Hz)"),
        ("gyroscope_noise_density: 2e-3\naccelerometer_noise_density: 1.7e-4", "seem swapped"),
        (f"T_imu_camera: {T.tolist()}\ntime_offset: 4e6", "in seconds"),
        ("gyro_noise: 1e-3", "gyro_noise is unknown"),
    ],
)
def test_impossible_numbers_are_named(tmp_path, section, said):
    with pytest.raises(InputError, match=r"file0.yaml: imu: ?") as error:
        read(tmp_path, own(section))
    assert said in str(error.value)
    assert str(error.value).endswith(".")


def test_an_imu_without_a_camera_is_refused(tmp_path):
    with pytest.raises(InputError, match="describes an IMU and no camera"):
        read(tmp_path, DENSITIES)
