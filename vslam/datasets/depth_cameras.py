"""Live depth cameras. Images and calibration are read using the manufacturers' packages."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.models import Calibration
from vslam.datasets.frames import Images, RawSource, TimedFrame
from vslam.datasets.imu import Imu
from vslam.support.errors import BrokenSourceError, InputError
from vslam.types.camera import DepthImage, Image, ImageMap
from vslam.types.imu import ImuCalibration

FPS = 30
IMU_HZ = 200
TIMEOUT_S = 10


@dataclass(frozen=True)
class Grabbed:
    """The images that a device took at one time, copied from the buffers of the device.

    Attributes:
        timestamp: seconds.
        left: left image, ``(H, W)`` uint8. For RGB-D, it is the colour image, ``(H, W, 3)`` uint8
            red, green, blue.
        second: right image, ``(H, W)`` uint8. For RGB-D, it is the depth image, ``(H, W)`` uint16.
            None if only the left camera is used.
    """

    timestamp: float
    left: NDArray[np.uint8]
    second: NDArray[Any] | None


@dataclass(frozen=True)
class DepthCamera:
    """A device that delivers images.

    Attributes:
        dataset: kind of source, for example ``realsense``.
        name: serial number of the device.
        calibration: calibration of the delivered images, read from the device. If it has a
            ``depth_scale``, the second image contains the depth of the pixels of the first image.
        grab: function that waits for the next images and returns them. It returns None after a
            timeout, or if the device was unplugged.
        stop: function that stops the device.
        imu: the live IMU of the device, calibrated for ``calibration.left``; None if it has none.
        warnings: what the report of a run must say about the device, in sentences.
    """

    dataset: str
    name: str
    calibration: Calibration
    grab: Callable[[], Grabbed | None]
    stop: Callable[[], None]
    imu: Imu | None = None
    warnings: tuple[str, ...] = ()


def frames_of(device: DepthCamera) -> RawSource:
    """Make a source of the frames that a device delivers. The frames can be read only once."""
    calibration = device.calibration
    models = [model for model in (calibration.left, calibration.right) if model is not None]
    return RawSource(
        dataset=device.dataset,
        name=device.name,
        sizes=tuple((model.width, model.height) for model in models),
        depth=calibration.depth_scale is not None,
        play=partial(_play, device),
        live=True,
        imu=device.imu,
        warnings=device.warnings,
    )


def calibration_of_imu(T_imu_camera: NDArray[np.float64]) -> ImuCalibration | None:
    """Return the calibration that a device stores for its IMU; None if it was never calibrated, as
    zeros show."""
    try:
        return ImuCalibration(T_imu_camera)
    except ValueError:
        return None


def maker_package(name: str, extra: str) -> Any:
    """Import the Python package of a device's manufacturer.

    Raises:
        InputError: the package, or a library that it needs, is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError)
        fix = f"pip install 'vslam[{extra}]'" if missing else "install the libraries that it needs"
        raise InputError(
            f"--dataset {extra}: the package {name} cannot be imported ({error}); {fix} "
            "(docs/howto/cameras.md)."
        ) from error


def _play(device: DepthCamera) -> Iterator[TimedFrame]:
    scale = device.calibration.depth_scale
    n = 0
    try:
        while (grabbed := device.grab()) is not None:
            colour = partial(np.asarray, grabbed.left) if grabbed.left.ndim == 3 else None
            yield TimedFrame(grabbed.timestamp, partial(_read, grabbed, scale), colour=colour)
            n += 1
    finally:
        with suppress(RuntimeError):  # the device may have been unplugged
            device.stop()
    raise BrokenSourceError(
        f"{device.dataset} {device.name}: stopped after {n} images; check its cable and its power."
    )


def _read(grabbed: Grabbed, depth_scale: float | None, image_map: ImageMap) -> Images:
    import cv2

    left: NDArray[Any] = grabbed.left
    if left.ndim == 3:
        left = cv2.cvtColor(left, cv2.COLOR_RGB2GRAY)
    second: Image | DepthImage | None = grabbed.second
    if second is not None and depth_scale is not None:
        second = second * np.float32(1.0 / depth_scale)
    return np.asarray(left, np.uint8), second
