"""Motions with exact inertial samples, and the inertial recordings of EuRoC."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from vslam.backend.preintegration import right_jacobian, so3_exp
from vslam.types.imu import GRAVITY, ImuNoise

EUROC = Path(__file__).parents[2] / "shared/data/euroc"
DOWN = np.array([0.0, 0.0, -GRAVITY])  # gravity in a world whose z axis points up
# EuRoC's IMU, from its sensor.yaml
ADIS16448 = ImuNoise(1.6968e-4, 2e-3, 1.9393e-5, 3e-3)


@dataclass(frozen=True)
class Flight:
    """A smooth motion of an IMU: sums of three sines, for the position and for the rotation vector.

    Its rates and forces are derivatives in closed form. ``speed`` 0 stands still.
    """

    seed: int = 0
    speed: float = 1.0
    turning: float = 0.6
    gravity: tuple[float, ...] = tuple(DOWN)

    def _sines(self, t, order: int, which: int) -> np.ndarray:
        rng = np.random.default_rng([self.seed, which])
        size = (self.speed, self.turning)[which] * rng.uniform(0.3, 1.0, (3, 3))
        rate, phase = rng.uniform(0.5, 3.0, (3, 3)), rng.uniform(0.0, 6.0, (3, 3))
        angle = rate * np.asarray(t, float)[..., None, None] + phase + order * np.pi / 2
        return (size * rate ** (order - 1) * np.sin(angle)).sum(axis=-1)

    def position(self, t) -> np.ndarray:
        return self._sines(t, 0, 0)

    def velocity(self, t) -> np.ndarray:
        return self._sines(t, 1, 0)

    def rotation(self, t: float) -> np.ndarray:
        """Return ``R_world_imu``."""
        return so3_exp(self._sines(t, 0, 1))

    def pose(self, t: float) -> np.ndarray:
        """Return ``T_world_imu``."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.rotation(t), self.position(t)
        return T

    def samples(self, times, bias=None, noise: ImuNoise | None = None, seed: int = 0) -> np.ndarray:
        """Return ``(N, 7)`` samples at given times, exact or with noise and constant biases."""
        times = np.asarray(times, float)
        rows = np.empty((len(times), 7))
        rows[:, 0] = times
        acceleration = self._sines(times, 2, 0) - np.array(self.gravity)
        angles, rates = self._sines(times, 0, 1), self._sines(times, 1, 1)
        for k in range(len(times)):
            rows[k, 1:4] = right_jacobian(angles[k]) @ rates[k]
            rows[k, 4:] = so3_exp(angles[k]).T @ acceleration[k]
        rows[:, 1:] += np.zeros(6) if bias is None else bias
        if noise is not None:
            step = np.median(np.diff(times))
            rng = np.random.default_rng(seed)
            rows[:, 1:4] += rng.standard_normal((len(times), 3)) * noise.gyro / np.sqrt(step)
            rows[:, 4:] += rng.standard_normal((len(times), 3)) * noise.accel / np.sqrt(step)
        return rows


@dataclass(frozen=True)
class Recording:
    """A recording of EuRoC: samples, and the true states of its IMU at other times.

    Times are seconds since the first sample. ``position`` and ``velocity`` are ``(N, 3)``,
    ``rotation`` is ``(N, 3, 3)`` ``R_world_imu``, ``bias`` is ``(N, 6)``. Gravity is ``DOWN``.
    """

    samples: np.ndarray
    times: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    bias: np.ndarray

    def pose(self, t: float) -> np.ndarray:
        """Return ``T_world_imu`` at a time, interpolated."""
        k = int(np.clip(np.searchsorted(self.times, t), 1, len(self.times) - 1))
        pair, T = slice(k - 1, k + 1), np.eye(4)
        T[:3, :3] = Slerp(self.times[pair], Rotation.from_matrix(self.rotation[pair]))(
            t
        ).as_matrix()
        share = (t - self.times[k - 1]) / (self.times[k] - self.times[k - 1])
        T[:3, 3] = (1.0 - share) * self.position[k - 1] + share * self.position[k]
        return T


def recording(name: str) -> Recording:
    """Read V1_01 or V1_03."""
    imu, truth = {
        "V1_01": ("V1_01_start/mav0/imu0/data.csv", "inertial_only/V1_01_truth_20hz.csv"),
        "V1_03": ("inertial_only/V1_03_imu_200hz.csv", "inertial_only/V1_03_truth_200hz.csv"),
    }[name]
    raw, states = (np.loadtxt(EUROC / file, delimiter=",") for file in (imu, truth))
    first = np.loadtxt(EUROC / imu, delimiter=",", usecols=0, dtype=np.int64)
    stamps = np.loadtxt(EUROC / truth, delimiter=",", usecols=0, dtype=np.int64)
    samples = np.column_stack([(first - first[0]) * 1e-9, raw[:, 1:]])
    return Recording(
        samples,
        (stamps - first[0]) * 1e-9,
        states[:, 1:4],
        Rotation.from_quat(states[:, [5, 6, 7, 4]]).as_matrix(),
        states[:, 8:11],
        states[:, 11:17],
    )


@dataclass(frozen=True)
class Walk(Flight):
    """A hand-held walk along z of a world whose y axis points down, like that of a camera.

    The pose is that of the camera, which sways. ``velocity`` and ``position`` hold it too.
    """

    speed: float = 0.06
    turning: float = 0.06
    gravity: tuple[float, ...] = (0.0, GRAVITY, 0.0)
    along: float = 1.4  # m/s

    def position(self, t) -> np.ndarray:
        t = np.asarray(t, float)
        return super().position(t) + t[..., None] * np.array([0.0, 0.0, self.along])

    def velocity(self, t) -> np.ndarray:
        return super().velocity(t) + np.array([0.0, 0.0, self.along])


def seen_by(samples: np.ndarray, T_imu_camera: np.ndarray, flight: Flight) -> np.ndarray:
    """Return the samples of an IMU that is mounted elsewhere on the body whose samples are given.

    Args:
        T_imu_camera: ``(4, 4)``, maps points of the body to the IMU.
    """
    R, arm = T_imu_camera[:3, :3], np.linalg.inv(T_imu_camera)[:3, 3]
    times, rates, moved = samples[:, 0], samples[:, 1:4], samples.copy()
    step = 1e-4
    for k, t in enumerate(times):
        ends = [flight._sines(np.array(t + s), 0, 1) for s in (-step, step)]
        slopes = [flight._sines(np.array(t + s), 1, 1) for s in (-step, step)]
        w0, w1 = (right_jacobian(a) @ b for a, b in zip(ends, slopes, strict=True))
        turning = (w1 - w0) / (2 * step)
        w = rates[k]
        force = samples[k, 4:] + np.cross(turning, arm) + np.cross(w, np.cross(w, arm))
        moved[k, 1:4], moved[k, 4:] = R @ w, R @ force
    return moved


@dataclass(frozen=True)
class SuddenTurn(Walk):
    """A walk with a sudden turn about the vertical axis by ``angle`` rad, at the time ``at``."""

    angle: float = 1.2
    at: float = 1.5
    seconds: float = 0.2

    def _sines(self, t, order: int, which: int) -> np.ndarray:
        waves = super()._sines(t, order, which)
        if which == 0 or order > 1:
            return waves
        u = (np.asarray(t, float) - self.at) / self.seconds
        turn = [1.0 + np.tanh(u), np.cosh(u) ** -2 / self.seconds][order]
        return waves + 0.5 * self.angle * turn[..., None] * np.array([0.0, 1.0, 0.0])
