"""OAK-D cameras, read by depthai (version 3).

A stereo pair is the two grey images, whose distortion the device removes; vslam rectifies them by
the calibration in the device. RGB-D is the colour image with the depth of the device's own stereo
matching, registered to the colour image by the device.
"""

from __future__ import annotations

from datetime import timedelta
from typing import Any

import numpy as np

from vslam.calibration.models import Calibration, CameraModel
from vslam.datasets.depth_cameras import FPS, TIMEOUT_S, DepthCamera, Grabbed, maker_package
from vslam.errors import InputError

_SIZE = 640, 400
_UNITS_PER_METRE = 1000.0  # of the depth
_CM_PER_METRE = 100.0


def open_oakd(serial: str, sensor: str | None) -> DepthCamera:
    """Open a camera and read its calibration.

    Args:
        serial: serial number of the device; empty for the first one.
        sensor: ``stereo``, ``rgbd`` or ``mono``; None is ``stereo``.

    Raises:
        InputError: depthai cannot be imported, or there is no such device, it is busy, or it
            cannot deliver these images.
    """
    sensor = sensor or "stereo"
    dai = maker_package("depthai", "oakd")
    name = f"oakd {serial}".rstrip()
    try:
        device = dai.Device(serial) if serial else dai.Device()
        serial = device.getDeviceId()
        name = f"oakd {serial}"
        pipeline = dai.Pipeline(device)
        queue = _queue(dai, pipeline, sensor)
        pipeline.start()
        first = queue.get(timedelta(seconds=TIMEOUT_S))
        if first is None:
            raise RuntimeError("it gives no image")
        calibration = _calibration(dai, device, first, sensor)
    except RuntimeError as error:
        raise InputError(
            f"{name}: {error}; connect an OAK camera, and end other programs that use it."
        ) from error

    def grab() -> Grabbed | None:
        try:
            images = queue.get(timedelta(seconds=TIMEOUT_S))
        except (RuntimeError, dai.MessageQueue.QueueException):  # the device is gone
            return None
        if images is None:
            return None
        left = images["left"]
        second = None if sensor == "mono" else images["second"].getFrame()
        return Grabbed(left.getTimestamp().total_seconds(), left.getFrame(), second)

    def stop() -> None:
        pipeline.stop()
        device.close()

    return DepthCamera("oakd", serial, calibration, grab, stop)


def _queue(dai: Any, pipeline: Any, sensor: str) -> Any:
    """The queue of groups of images of one time, ``left`` and ``second``; the newest waits."""
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


def _calibration(dai: Any, device: Any, images: Any, sensor: str) -> Calibration:
    """What the first images and the memory of the device say."""
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
    return Calibration(left, depth_scale=_UNITS_PER_METRE, virtual_baseline=baseline, source=source)


def _model(image: Any, source: str) -> CameraModel:
    """The camera of an image whose distortion the device has removed."""
    seen = image.getTransformation()
    if any(seen.getDistortionCoefficients()):  # such a device has an old format in its memory
        raise InputError(
            f"{source}: it is too old for the device to remove the distortion; calibrate the "
            "device again with Luxonis' tool."
        )
    (fx, _, cx), (_, fy, cy), _ = seen.getIntrinsicMatrix()
    return CameraModel(fx, fy, cx, cy, image.getWidth(), image.getHeight())
