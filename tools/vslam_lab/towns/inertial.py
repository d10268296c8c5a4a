"""The samples of an IMU on the camera of a route: exact, or with the noise of an ADIS16448.

Cubic splines connect the poses of the route. The camera is on them at each frame, so the samples
and the images belong to one motion.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from vslam.calibration.files import CALIBRATION, write_calibration
from vslam.calibration.models import Calibration
from vslam.datasets.imu import Imu
from vslam.datasets.imu_csv import HEADER, IMU_FILE
from vslam.types.imu import GRAVITY, ImuCalibration, ImuNoise
from vslam_lab.towns.files import write, writing
from vslam_lab.towns.routes import Route

Float = NDArray[np.float64]

ADIS16448 = ImuNoise(gyro=1.6968e-4, accel=2e-3, gyro_walk=1.9393e-5, accel_walk=3e-3)
"""EuRoC's IMU, with the densities in its ``sensor.yaml``."""

SAMPLE_RATE = 200.0  # samples per second
# Standard deviations of the biases at the first sample, about those of EuRoC's IMU.
_BIAS_GYRO, _BIAS_ACCEL = 0.03, 0.08  # rad/s, m/s^2
# The IMU looks ahead, left and up, apart from 2 degrees, and is 9 cm from the left camera.
_AHEAD_LEFT_UP = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def imu_on_camera() -> ImuCalibration:
    """Return where the IMU is, and the densities of its noise."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.02, -0.015, 0.03]).as_matrix() @ _AHEAD_LEFT_UP
    T[:3, 3] = [0.07, 0.05, -0.02]
    return ImuCalibration(T, ADIS16448)


def samples_along(
    timestamps: Float, T_wc: Float, T_imu_camera: Float, rate: float = SAMPLE_RATE
) -> Float:
    """Return the exact samples of an IMU on a camera, from the first pose to the last one.

    Args:
        timestamps: ``(N,)`` float64 increasing seconds.
        T_wc: ``(N, 4, 4)`` float64 poses of the camera, in a world frame whose y axis points down.
        T_imu_camera: ``(4, 4)`` float64, see `ImuCalibration`.
        rate: samples per second.

    Returns:
        ``(M, 7)`` float64, as described in `vslam.types.imu`.
    """
    count = int((timestamps[-1] - timestamps[0]) * rate + 1e-6) + 1
    at = timestamps[0] + np.arange(count) / rate
    turns = RotationSpline(timestamps, Rotation.from_matrix(T_wc[:, :3, :3]))
    acceleration = CubicSpline(timestamps, T_wc[:, :3, 3])(at, 2) - [0.0, GRAVITY, 0.0]
    turning, faster = turns(at, 1), turns(at, 2)  # in the frame of the camera
    R_imu_camera = T_imu_camera[:3, :3]
    arm = -R_imu_camera.T @ T_imu_camera[:3, 3]  # from the camera to the IMU
    swung = np.cross(faster, arm) + np.cross(turning, np.cross(turning, arm))
    force = np.einsum("nji,nj->ni", turns(at).as_matrix(), acceleration) + swung
    return np.column_stack([at, turning @ R_imu_camera.T, force @ R_imu_camera.T])


def with_noise(samples: Float, noise: ImuNoise, seed: int) -> Float:
    """Add white noise and biases that walk to ``(N, 7)`` samples at equal intervals."""
    rng = np.random.default_rng([seed, 31])
    step = (samples[-1, 0] - samples[0, 0]) / max(len(samples) - 1, 1)
    start = rng.standard_normal(6) * np.repeat([_BIAS_GYRO, _BIAS_ACCEL], 3)
    walk = np.repeat([noise.gyro_walk, noise.accel_walk], 3) * np.sqrt(step)
    white = np.repeat([noise.gyro, noise.accel], 3) / np.sqrt(step)
    steps = rng.standard_normal((2, len(samples), 6))
    noisy = samples.copy()
    noisy[:, 1:] += start + np.cumsum(walk * steps[0], axis=0) + white * steps[1]
    return noisy


def simulated_imu(route: Route, seed: int) -> Imu:
    """Return the IMU on the camera of a route. The seed determines its noise."""
    imu = imu_on_camera()

    def read() -> Float:
        samples = samples_along(route.timestamps, route.T_wc, imu.T_imu_camera)
        return with_noise(samples, imu.noise, seed)

    return Imu(f"the IMU of {route.name}", read, imu, imu.noise)


def write_imu(route: Route, seed: int, folder: Path) -> None:
    """Write ``imu.csv`` and ``calibration.yaml`` of a route into a folder.

    Raises:
        InputError: the folder cannot be written.
    """
    rows = simulated_imu(route, seed).read().tolist()
    lines = [",".join([f"{row[0]:.6f}", *(f"{x:.9f}" for x in row[1:])]) + "\n" for row in rows]
    with writing(folder):
        write(folder / IMU_FILE, f"{HEADER}\n{''.join(lines)}".encode())
        imu = imu_on_camera()
        calibration = Calibration.of_rectified(route.camera)
        write_calibration(folder / CALIBRATION, replace(calibration, imu=imu, imu_noise=imu.noise))
