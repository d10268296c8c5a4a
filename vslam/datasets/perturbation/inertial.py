"""Perturbations of the samples of an IMU."""

from __future__ import annotations

import numpy as np

from vslam.datasets.perturbation.kinds import ImuLaw, LawKind, RandomStream
from vslam.types.geometry import Matrix
from vslam.types.imu import ImuNoise

_BLOCK_S = 10.0  # a gap comes once in such a block
_PER_DEGREE = 0.1  # m/s^2 of the accelerometer's bias per degree/s of the gyroscope's


def _noise(times: float, stream: RandomStream) -> ImuLaw:
    def law(samples: Matrix, noise: ImuNoise) -> Matrix:
        steps = np.diff(samples[:, 0])
        deviation = times * np.repeat([noise.gyro, noise.accel], 3) / np.sqrt(np.median(steps))
        rng = np.random.default_rng(stream)
        return _changed(samples, deviation * rng.standard_normal((len(samples), 6)))

    return law


def _bias(degrees_per_s: float, stream: RandomStream) -> ImuLaw:
    def law(samples: Matrix, noise: ImuNoise) -> Matrix:
        rng = np.random.default_rng(stream)
        gyro, accel = (_direction(rng) for _ in range(2))
        return _changed(
            samples,
            np.r_[np.radians(degrees_per_s) * gyro, _PER_DEGREE * degrees_per_s * accel],
        )

    return law


def _gap(seconds: float, stream: RandomStream) -> ImuLaw:
    """Leave out all samples of one gap in every ten seconds. None begins in the first second."""

    def law(samples: Matrix, noise: ImuNoise) -> Matrix:
        t = samples[:, 0] - samples[0, 0]
        kept = np.ones(len(samples), np.bool_)
        for block in range(int(t[-1] // _BLOCK_S) + 1):
            first = max(1.0, _BLOCK_S * block)
            begin = np.random.default_rng([*stream, block]).uniform(
                first, max(first, _BLOCK_S * (block + 1) - seconds)
            )
            kept &= (t < begin) | (t >= begin + seconds)
        return samples[kept]

    return law


def _delay(milliseconds: float, stream: RandomStream) -> ImuLaw:
    def law(samples: Matrix, noise: ImuNoise) -> Matrix:
        late = samples.copy()
        late[:, 0] += 1e-3 * milliseconds
        return late

    return law


def _axes(degrees: float, stream: RandomStream) -> ImuLaw:
    def law(samples: Matrix, noise: ImuNoise) -> Matrix:
        from scipy.spatial.transform import Rotation

        axis = _direction(np.random.default_rng(stream))
        turn = Rotation.from_rotvec(np.radians(degrees) * axis)
        return np.column_stack(
            [samples[:, 0], turn.apply(samples[:, 1:4]), turn.apply(samples[:, 4:])]
        )

    return law


def _changed(samples: Matrix, change: Matrix) -> Matrix:
    return np.column_stack([samples[:, 0], samples[:, 1:] + change])


def _direction(rng: np.random.Generator) -> Matrix:
    v = rng.standard_normal(3)
    return np.asarray(v / np.linalg.norm(v))


KINDS = {
    "imu-noise": LawKind(
        _noise, "x", 10.0, 1.0, 300.0, "noise of the IMU, in its calibrated densities",
        most=1000.0, logarithmic=True, of_imu=True, needs=("imu",),
    ),
    "imu-bias": LawKind(
        _bias, "degrees/s", 1.0, 0.05, 20.0, "biases of the gyroscope and of the accelerometer",
        most=100.0, logarithmic=True, of_imu=True, needs=("imu",),
    ),
    "imu-gap": LawKind(
        _gap, "s", 1.0, 0.02, 9.0, "length of a gap in the samples in every ten seconds", most=9.0,
        logarithmic=True, of_imu=True, needs=("imu",),
    ),
    "imu-delay": LawKind(
        _delay, "ms", 10.0, 0.5, 200.0, "the samples are late", least=-200.0, most=200.0,
        logarithmic=True, drawn=False, of_imu=True, needs=("imu",),
    ),
    "imu-axes": LawKind(
        _axes, "degrees", 5.0, 0.1, 180.0, "the IMU is turned, compared with the calibration",
        most=180.0, logarithmic=True, of_imu=True, needs=("imu",),
    ),
}  # fmt: skip
