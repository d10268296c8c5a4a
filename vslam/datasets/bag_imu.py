"""Reads the inertial samples (``sensor_msgs/Imu``) of a bag.

A RealSense camera publishes gyroscope and accelerometer in two topics with different rates. The
specific force is then interpolated at the times of the angular rates.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from vslam.datasets.bag_files import Recording, messages, opened
from vslam.datasets.bag_messages import IMU_TYPE, inertial_sample
from vslam.datasets.imu import Imu, joined
from vslam.support.errors import BrokenSourceError, InputError
from vslam.types.geometry import Matrix

_GYRO, _ACCEL = ("gyro",), ("accel", "acc/", "_acc")  # parts of the names of topics


def find_imu(
    path: Path, recording: Recording, topics: Sequence[str]
) -> tuple[Imu | None, tuple[str, ...]]:
    """Choose the topic or the two topics of the IMU. The samples are read when they are needed.

    Args:
        topics: the topic of the IMU, or those of the gyroscope and of the accelerometer. If it is
            empty, the bag's only topic is chosen, or its only two if their names tell gyroscope and
            accelerometer.

    Returns:
        The IMU, without calibration. None if there are no topics, or if the user must choose, which
        the warnings say.

    Raises:
        InputError: a topic that the user has chosen does not exist.
    """
    there = sorted(topic for topic, kind in recording.types.items() if kind == IMU_TYPE)
    for topic in topics:
        if topic not in there:
            listed = ", ".join(there) or "none"
            raise InputError(
                f"--imu-topics {topic}: not in {path}; topics of sensor_msgs/Imu are {listed}."
            )
    if len(topics) > 2:
        raise InputError(
            f"--imu-topics {','.join(topics)}: give one topic, or those of gyroscope and "
            "accelerometer."
        )
    chosen = tuple(topics) or _only(there)
    if not chosen and there:
        return None, (
            f"{path}: the IMU is not used, because there are several ({', '.join(there)}); choose "
            "one with --imu-topics TOPIC or GYRO,ACCEL.",
        )
    if not chosen:
        return None, ()
    return Imu(f"{path}: {' and '.join(chosen)}", partial(read_imu_of_bag, path, chosen)), ()


def _only(there: list[str]) -> tuple[str, ...]:
    if len(there) == 1:
        return tuple(there)
    gyros, accels = (
        [topic for topic in there if any(word in topic.lower() for word in words)]
        for words in (_GYRO, _ACCEL)
    )
    if len(there) == len(gyros) + len(accels) == 2 and len(gyros) == 1:
        return gyros[0], accels[0]
    return ()


def read_imu_of_bag(path: Path, topics: Sequence[str]) -> Matrix:
    """Read the samples of one topic, or join those of gyroscope and accelerometer.

    If the bag is cut off, the samples before the damage are returned.

    Returns:
        ``(N, 7)`` float64, as described in `vslam.types.imu`, with the times of the headers.

    Raises:
        InputError: a library is not installed, the bag cannot be opened, or samples have no time
            stamps.
    """
    rows: dict[str, list[tuple[float, ...]]] = {topic: [] for topic in topics}
    with opened(path) as recording:
        try:
            for topic, message in messages(recording, path, tuple(topics)):
                rows[topic].append(inertial_sample(message))
        except BrokenSourceError:  # the reader of the images reports it
            pass
    tables = [np.array(rows[topic], np.float64).reshape(-1, 7) for topic in topics]
    for topic, table in zip(topics, tables, strict=True):
        if len(table) and not table[:, 0].any():
            raise InputError(
                f"{path}: the samples of {topic} have no time stamps (header.stamp is 0); record "
                "them again with a driver that sets it."
            )
    return tables[0] if len(tables) == 1 else joined(*tables)
