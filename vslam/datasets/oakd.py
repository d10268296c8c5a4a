"""Reads OAK-D cameras, using depthai (version 3).

A stereo pair consists of the two grey images. The device undistorts the images. After that, vslam
rectifies the images using the calibration of the device.

An RGB-D frame consists of the colour image and the depth. The device computes the depth by stereo
matching, and registers it to the colour image.

Most models have an IMU. Its raw samples are in the frame of its chip, to which the calibration of
the device refers.
"""

from __future__ import annotations

from contextlib import ExitStack, suppress
from datetime import timedelta
from typing import Any

import numpy as np

from vslam.calibration.models import Calibration, CameraModel
from vslam.datasets.depth_cameras import (
    FPS,
    IMU_HZ,
    TIMEOUT_S,
    DepthCamera,
    Grabbed,
    calibration_of_imu,
    maker_package,
)
from vslam.datasets.imu import Imu, SplitSamples
from vslam.support.errors import InputError
from vslam.types.geometry import Matrix

_SIZE = 640, 400
_DEPTH_SCALE = 1000.0  # depth image units per metre
_CM_PER_METRE = 100.0
_IMU_MESSAGES = 2000  # that wait while a frame is processed


def open_oakd(serial: str, sensor: str | None) -> DepthCamera:
    """Open a camera and read its calibration.

    Args:
        serial: serial number of the device. If it is empty, the first device that is found is used.
        sensor: ``stereo``, ``rgbd`` or ``mono``; None means ``stereo``.

    Raises:
        InputError: depthai cannot be imported, or the device is missing, busy or unable to deliver
            these images.
    """
    sensor = sensor or "stereo"
    dai = maker_package("depthai", "oakd")
    name = f"oakd {serial}".rstrip()
    try:
        with ExitStack() as opened:
            device = dai.Device(serial) if serial else dai.Device()
            opened.callback(device.close)
            serial = device.getDeviceId()
            name = f"oakd {serial}"
            pipeline = dai.Pipeline(device)
            queue = _queue(dai, pipeline, sensor)
            imu = _imu(dai, pipeline, device, sensor, name)
            pipeline.start()
            opened.callback(pipeline.stop)
            first = queue.get(timedelta(seconds=TIMEOUT_S))
            if first is None:
                raise RuntimeError("it returns no image")
            calibration = _calibration(dai, device, first, sensor)
            stop = opened.pop_all().close  # from here on, DepthCamera stops the device
    except RuntimeError as error:
        raise InputError(
            f"{name}: {error}; connect an OAK camera, and close other programs that use it."
        ) from error

    def grab() -> Grabbed | None:
        try:
            images = queue.get(timedelta(seconds=TIMEOUT_S))
        except (RuntimeError, dai.MessageQueue.QueueException):  # the device was unplugged
            return None
        if images is None:
            return None
        left = images["left"]
        second = None if sensor == "mono" else images["second"].getFrame()
        return Grabbed(left.getTimestamp().total_seconds(), left.getFrame(), second)

    return DepthCamera("oakd", serial, calibration, grab, stop, imu)


def _queue(dai: Any, pipeline: Any, sensor: str) -> Any:
    """Make a queue that holds only the newest pair of images, ``left`` and ``second``."""
    create, node, socket = pipeline.create, dai.node, dai.CameraBoardSocket

    def output(side: Any, kind: Any = None, *, undistorted: bool = False) -> Any:
        camera = create(node.Camera).build(side)
        return camera.requestOutput(_SIZE, kind, fps=FPS, enableUndistortion=undistorted)

    grey, colour = dai.ImgFrame.Type.GRAY8, dai.ImgFrame.Type.RGB888i
    if sensor == "rgbd":
        outputs = [output(socket.CAM_A, colour, undistorted=True)]
        pair = [output(side) for side in (socket.CAM_B, socket.CAM_C)]
        stereo = create(node.StereoDepth).build(*pair)
        if pipeline.getDefaultDevice().getPlatform() == dai.Platform.RVC4:
            align = create(node.ImageAlign)
            stereo.depth.link(align.input)
            outputs[0].link(align.inputAlignTo)
            outputs.append(align.outputAligned)
        else:
            outputs[0].link(stereo.inputAlignTo)
            outputs.append(stereo.depth)
    else:
        sides = (socket.CAM_B, socket.CAM_C)[: 1 if sensor == "mono" else 2]
        outputs = [output(side, grey, undistorted=True) for side in sides]
    sync = create(node.Sync)
    sync.setSyncThreshold(timedelta(seconds=0.5 / FPS))
    for name, images in zip(("left", "second"), outputs, strict=False):
        images.link(sync.inputs[name])
    return sync.out.createOutputQueue(maxSize=1, blocking=False)


def _imu(dai: Any, pipeline: Any, device: Any, sensor: str, name: str) -> Imu | None:
    """Add the IMU to the pipeline, if the device has one."""
    if device.getConnectedIMU() in ("", "NONE"):
        return None
    node, raw = pipeline.create(dai.node.IMU), dai.IMUSensor
    node.enableIMUSensor([raw.ACCELEROMETER_RAW, raw.GYROSCOPE_RAW], IMU_HZ)
    node.setBatchReportThreshold(1)
    node.setMaxBatchReports(10)
    queue = node.out.createOutputQueue(maxSize=_IMU_MESSAGES, blocking=False)
    samples = SplitSamples()

    def read() -> Matrix:
        with suppress(RuntimeError, dai.MessageQueue.QueueException):  # it was unplugged
            for message in queue.tryGetAll():
                for packet in message.packets:
                    for add, report in (
                        (samples.add_rate, packet.gyroscope),
                        (samples.add_force, packet.acceleroMeter),
                    ):
                        time = report.getTimestamp().total_seconds()
                        add(time, report.x, report.y, report.z)
        return samples.read()

    socket = dai.CameraBoardSocket.CAM_A if sensor == "rgbd" else dai.CameraBoardSocket.CAM_B
    calibration = None
    with suppress(RuntimeError):  # the device stores no calibration of its IMU
        T_imu_camera = np.array(
            device.readCalibration().getCameraToImuExtrinsics(socket), np.float64
        )
        T_imu_camera[:3, 3] /= _CM_PER_METRE
        calibration = calibration_of_imu(T_imu_camera)
    return Imu(name, read, calibration, live=True)


def _calibration(dai: Any, device: Any, images: Any, sensor: str) -> Calibration:
    socket, memory = dai.CameraBoardSocket, device.readCalibration()
    source = f"the calibration in oakd {device.getDeviceId()}"
    left = _model(images["left"], source)
    if sensor == "mono":
        return Calibration(left, source=source)
    T_left_right = np.array(memory.getCameraExtrinsics(socket.CAM_C, socket.CAM_B), np.float64)
    T_left_right[:3, 3] /= _CM_PER_METRE
    if sensor == "stereo":
        return Calibration(left, _model(images["second"], source), T_left_right, source=source)
    baseline = float(np.linalg.norm(T_left_right[:3, 3]))
    return Calibration(left, depth_scale=_DEPTH_SCALE, virtual_baseline=baseline, source=source)


def _model(image: Any, source: str) -> CameraModel:
    """The device must have undistorted the image."""
    transformation = image.getTransformation()
    if any(transformation.getDistortionCoefficients()):
        raise InputError(
            f"{source}: the device cannot undistort images with a calibration of this old format; "
            "calibrate the device again with Luxonis' tool."
        )
    (fx, _, cx), (_, fy, cy), _ = transformation.getIntrinsicMatrix()
    return CameraModel(fx, fy, cx, cy, image.getWidth(), image.getHeight())
