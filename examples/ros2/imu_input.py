"""Reads an IMU from ``sensor_msgs/Imu``, and tells how long images wait for it, without ROS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vslam.calibration.files import read_calibration
from vslam.datasets.bag_messages import inertial_sample
from vslam.datasets.imu import Imu, ImuFeed, SplitSamples
from vslam.support.errors import InputError
from vslam.types.geometry import Matrix
from vslam.types.imu import ImuCalibration

# Seconds for which a pair waits for a sample that is not before it. vslam does not continue samples
# over a longer gap (``Slam.add_imu``), so that waiting longer would not help.
LONGEST_WAIT_S = 0.1


class ImuInput:
    """The samples of one topic, or those of a gyroscope and an accelerometer with two topics."""

    def __init__(self, topics: Sequence[str], files: Sequence[str]) -> None:
        """
        Args:
            topics: names of the topics, for messages.
            files: calibration files that contain ``T_imu_camera``.

        Raises:
            InputError: a file cannot be read, or does not tell where the IMU is.
        """
        if len(topics) > 2:
            raise InputError(
                f"imu_topics {','.join(topics)}: give one topic, or those of gyroscope and "
                "accelerometer."
            )
        found = read_calibration(files).imu if files else None
        if found is None:
            raise InputError(
                f"imu_topics {','.join(topics)}: the parameter calibration must name a file with "
                "T_imu_camera (docs/howto/imu.md)."
            )
        self._calibration, self._topics = found, topics
        self._samples = SplitSamples()
        self._feed = ImuFeed(Imu(" and ".join(topics), self._samples.read, found, live=True))
        # The newest sample when the wait of an image ended without a later one
        self._in_vain: float | None = None
        self._has_complained = False

    def calibration(self, left: Any) -> ImuCalibration:
        """Return the calibration for the rectified left camera.

        Args:
            left: ``sensor_msgs/CameraInfo`` of the left camera. Its matrix R maps directions from
                the camera before rectification, which the file describes, to the rectified camera.
        """
        T_rectified_left = np.eye(4)
        T_rectified_left[:3, :3] = np.reshape(left.r, (3, 3))
        T = self._calibration.T_imu_camera @ T_rectified_left.T
        return replace(self._calibration, T_imu_camera=T)

    def add(self, topic: str, message: Any) -> None:
        """Add a ``sensor_msgs/Imu`` message that has arrived on one of the topics."""
        time, *values = inertial_sample(message)
        if topic == self._topics[0]:
            self._samples.add_rate(time, *values[:3])
        if topic == self._topics[-1]:
            self._samples.add_force(time, *values[3:])

    def is_awaited(self, timestamp: float, waited_s: float) -> bool:
        """Return whether an image should wait for a sample that is not before it.

        If no sample comes while an image waits, later images do not wait until the next sample.

        Args:
            timestamp: time of the image in seconds.
            waited_s: for how long it has waited.
        """
        newest = self._feed.newest
        if newest < timestamp and waited_s >= LONGEST_WAIT_S:
            self._in_vain = newest
        return newest < timestamp and newest != self._in_vain

    def samples(self, timestamp: float) -> Matrix:
        """Return the ``(N, 7)`` samples that have arrived since the last call, for
        ``Slam.add_imu``. ``timestamp`` is that of the image."""
        return self._feed.until(timestamp)

    def complaint(self, timestamp: float) -> str | None:
        """Return one sentence if an image has no sample that is not before it. It is said once."""
        newest = self._feed.newest
        if newest >= timestamp or self._has_complained:
            return None
        self._has_complained = True
        names = " and ".join(self._topics)
        if not np.isfinite(newest):
            return f"No sample of the IMU has come from {names}; check the name of the topic."
        return (
            f"The newest sample of the IMU from {names} is {timestamp - newest:.3f} s earlier than "
            f"the image, although the image has waited for {LONGEST_WAIT_S} s; check that both "
            "have times of one clock."
        )
