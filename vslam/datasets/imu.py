"""The IMU of a source of frames: its samples, and where it is on the camera.

`vslam.types.imu` defines samples and calibration. Readers deliver samples with times of the IMU's
own clock. `ImuFeed` passes them to a run, in times of the camera's clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vslam.types.geometry import Matrix
from vslam.types.imu import (
    ImuCalibration,
    ImuNoise,
    TidySamples,
    in_camera_time,
    no_samples,
    tidied,
)

_LONGEST_S = 0.1  # between specific forces that are interpolated
_MOST_WAITING = 10_000  # samples of a live device that nobody reads


@dataclass(frozen=True, eq=False)
class Imu:
    """The IMU of a source.

    Attributes:
        name: file, topic or device, for messages.
        read: function that returns ``(N, 7)`` float64 samples with times of the IMU's clock. Of a
            recording, it returns all samples. Of a live device, it returns the samples that have
            arrived since the last call, without waiting. It raises InputError if a file is
            malformed.
        calibration: where the IMU is on the left camera; None if this is unknown, so that a run
            cannot use the samples.
        noise: noise that a file states, even if ``calibration`` is None; None if no file does.
        live: whether samples arrive in real time.
    """

    name: str
    read: Callable[[], Matrix]
    calibration: ImuCalibration | None = None
    noise: ImuNoise | None = None
    live: bool = False

    @cached_property
    def recorded(self) -> TidySamples:
        """All samples of a recording in the order of their times, with times of the IMU's clock.

        Raises:
            InputError: the samples cannot be read.
            TypeError: the IMU is live.
        """
        if self.live:
            raise TypeError(f"{self.name}: the samples of a live device can only be read in order")
        return tidied(self.read())


class ImuFeed:
    """Passes the samples of an IMU to a run, frame by frame."""

    def __init__(self, imu: Imu) -> None:
        """
        Raises:
            ValueError: the IMU has no calibration.
            InputError: the samples of a recording cannot be read.
        """
        if imu.calibration is None:
            raise ValueError(f"{imu.name}: the place of the IMU on the camera is unknown")
        self._imu, self._offset = imu, imu.calibration.time_offset
        recorded = no_samples() if imu.live else imu.recorded.samples
        self._waiting = in_camera_time(recorded, self._offset)
        self._passed = 0
        self._newest = self._waiting[:, 0].max(initial=-np.inf)

    @property
    def newest(self) -> float:
        """Time of the latest sample that has arrived, in seconds of the camera's clock; minus
        infinity if there is none."""
        if self._imu.live:
            self._take_arrived()
        return float(self._newest)

    def until(self, timestamp: float) -> Matrix:
        """Return the samples that come after those of the last call, up to the first one that is
        not before ``timestamp``.

        That sample is needed to interpolate the rates at the time of the frame. The first call also
        returns all samples before the first frame.

        Args:
            timestamp: time of a frame in seconds of the camera's clock, not before that of the last
                call.

        Returns:
            ``(M, 7)`` float64 samples with times of the camera's clock. Those of a live device are
            in the order of their arrival, and end before ``timestamp`` if later ones have not
            arrived.
        """
        if self._imu.live:
            self._take_arrived()
            end = len(self._waiting)
        else:
            end = int(np.searchsorted(self._waiting[:, 0], timestamp)) + 1
        begin, self._passed = self._passed, max(self._passed, min(end, len(self._waiting)))
        return self._waiting[begin : self._passed]

    def _take_arrived(self) -> None:
        arrived = in_camera_time(self._imu.read(), self._offset)
        self._waiting = np.concatenate([self._waiting[self._passed :], arrived])
        self._passed = 0
        self._newest = arrived[:, 0].max(initial=self._newest)


def joined(gyro: Matrix, accel: Matrix) -> Matrix:
    """Interpolate specific forces linearly at the times of angular rates.

    Args:
        gyro: ``(N, 7)`` samples whose angular rates are used.
        accel: ``(M, 7)`` samples whose specific forces are used.

    Returns:
        ``(K, 7)`` samples: those of the gyroscope that lie between two samples of the accelerometer
        that are at most 0.1 s apart.
    """
    gyro, accel = tidied(gyro).samples, tidied(accel).samples
    if len(accel) < 2:
        return no_samples()
    times = accel[:, 0]
    after = np.searchsorted(times, gyro[:, 0], side="right").clip(1, len(times) - 1)
    step = times[after] - times[after - 1]
    near = (step <= _LONGEST_S) | (gyro[:, 0] == times[after - 1])
    inside = (gyro[:, 0] >= times[0]) & (gyro[:, 0] <= times[-1]) & near
    found = gyro[inside]
    forces = [np.interp(found[:, 0], times, accel[:, axis]) for axis in (4, 5, 6)]
    return np.column_stack([found[:, :4], *forces])


class SplitSamples:
    """Joins angular rates and specific forces that a live device delivers separately.

    Any thread may add them. If nobody reads them, the oldest ones are dropped.
    """

    def __init__(self) -> None:
        self._rates: deque[tuple[float, ...]] = deque(maxlen=_MOST_WAITING)
        self._forces: deque[tuple[float, ...]] = deque(maxlen=_MOST_WAITING)
        self._waiting = self._newest = no_samples()

    def add_rate(self, timestamp: float, x: float, y: float, z: float) -> None:
        """Add an angular rate in rad/s."""
        self._rates.append((timestamp, x, y, z, 0.0, 0.0, 0.0))

    def add_force(self, timestamp: float, x: float, y: float, z: float) -> None:
        """Add a specific force in m/s^2."""
        self._forces.append((timestamp, 0.0, 0.0, 0.0, x, y, z))

    def read(self) -> Matrix:
        """Return the new samples as `joined` does. Angular rates that are later than the newest
        specific force wait for the next one."""
        rates = np.concatenate([self._waiting, _taken(self._rates)])[-_MOST_WAITING:]
        forces = np.concatenate([self._newest, _taken(self._forces)])
        last = float(forces[:, 0].max()) if len(forces) else -np.inf
        ready = rates[:, 0] <= last
        self._waiting, self._newest = rates[~ready], forces[forces[:, 0] == last]
        return joined(rates[ready], forces)


def _taken(samples: deque[tuple[float, ...]]) -> Matrix:
    rows = [samples.popleft() for _ in range(len(samples))]
    return np.array(rows, np.float64).reshape(-1, 7)
