"""RealSense cameras of the series D400, read by pyrealsense2.

RGB-D is the colour image with the depth that the device measures with its pattern projector,
registered to the colour image by librealsense. A stereo pair is the two infrared images, which the
device rectifies; the projector is then off, because its dots would move with the camera.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vslam.calibration.models import Calibration, CameraModel, without_zeros
from vslam.datasets.depth_cameras import FPS, TIMEOUT_S, DepthCamera, Grabbed, maker_package
from vslam.errors import InputError

_SIZE = 848, 480  # what Intel recommends for the depth of these cameras


def open_realsense(serial: str, sensor: str | None) -> DepthCamera:
    """Open a camera and read its calibration.

    Args:
        serial: serial number of the device; empty for the first one.
        sensor: ``stereo``, ``rgbd`` or ``mono``; None is ``rgbd``.

    Raises:
        InputError: pyrealsense2 cannot be imported, or there is no such device, it is busy, or it
            cannot deliver these images.
    """
    sensor = sensor or "rgbd"
    rs = maker_package("pyrealsense2", "realsense")
    device = _device(rs, serial)
    serial = device.get_info(rs.camera_info.serial_number)
    config = rs.config()
    config.enable_device(serial)
    if sensor == "stereo":
        for side in (1, 2):
            config.enable_stream(rs.stream.infrared, side, *_SIZE, rs.format.y8, FPS)
    else:
        config.enable_stream(rs.stream.color, *_SIZE, rs.format.rgb8, FPS)
    if sensor == "rgbd":
        config.enable_stream(rs.stream.depth, *_SIZE, rs.format.z16, FPS)
    pipeline = rs.pipeline()
    try:
        depth_sensor = device.first_depth_sensor()
        if depth_sensor.supports(rs.option.emitter_enabled):  # set first, so that no image has dots
            depth_sensor.set_option(rs.option.emitter_enabled, float(sensor == "rgbd"))
        profile = pipeline.start(config)
        calibration = _calibration(rs, profile, depth_sensor, sensor, serial)
    except RuntimeError as error:
        raise InputError(
            f"realsense {serial}: {error}; connect it to a USB 3 port, and end other programs that "
            "use it."
        ) from error
    align = rs.align(rs.stream.color)

    def grab() -> Grabbed | None:
        try:
            while True:
                came, frames = pipeline.try_wait_for_frames(1000 * TIMEOUT_S)
                if not came:
                    return None
                if sensor == "stereo":
                    images = [frames.get_infrared_frame(side) for side in (1, 2)]
                elif sensor == "rgbd":
                    frames = align.process(frames)
                    images = [frames.get_color_frame(), frames.get_depth_frame()]
                else:
                    images = [frames.get_color_frame()]
                if all(images):  # the first sets of frames may lack one
                    break
            left, *second = (np.array(image.get_data()) for image in images)
            return Grabbed(images[0].get_timestamp() / 1000, left, second[0] if second else None)
        except RuntimeError:  # the device is gone
            return None

    return DepthCamera("realsense", serial, calibration, grab, pipeline.stop)


def _device(rs: Any, serial: str) -> Any:
    devices = {d.get_info(rs.camera_info.serial_number): d for d in rs.context().query_devices()}
    if not devices:
        raise InputError("--dataset realsense: no RealSense camera is connected; connect one.")
    if serial and serial not in devices:
        raise InputError(
            f"--data {serial}: no RealSense camera has this serial number; there are "
            f"{', '.join(devices)}."
        )
    return devices[serial] if serial else next(iter(devices.values()))


def _calibration(rs: Any, profile: Any, depth_sensor: Any, sensor: str, serial: str) -> Calibration:
    source = f"the calibration in realsense {serial}"
    if sensor == "stereo":
        left, right = (
            profile.get_stream(rs.stream.infrared, side).as_video_stream_profile()
            for side in (1, 2)
        )
        extrinsics = right.get_extrinsics_to(left)
        T_left_right = np.eye(4)
        T_left_right[:3, :3] = np.reshape(extrinsics.rotation, (3, 3), order="F")
        T_left_right[:3, 3] = extrinsics.translation
        first, second = (_model(rs, side.get_intrinsics(), source) for side in (left, right))
        return Calibration(first, second, T_left_right, source=source)
    colour = profile.get_stream(rs.stream.color).as_video_stream_profile()
    model = _model(rs, colour.get_intrinsics(), source)
    if sensor == "mono":
        return Calibration(model, source=source)
    baseline = None
    if depth_sensor.supports(rs.option.stereo_baseline):  # millimetres
        baseline = depth_sensor.get_option(rs.option.stereo_baseline) / 1000
    scale = 1.0 / depth_sensor.get_depth_scale()
    return Calibration(model, depth_scale=scale, virtual_baseline=baseline, source=source)


def _model(rs: Any, intrinsics: Any, source: str) -> CameraModel:
    """The intrinsic parameters of a stream.

    librealsense projects by its two Brown-Conrady models as OpenCV does; the "inverse" one differs
    from it in terms of second order, 0.01 px for the lens of a D455.
    """
    i = intrinsics
    known = rs.distortion.brown_conrady, rs.distortion.inverse_brown_conrady
    if any(i.coeffs) and i.model not in known:
        raise InputError(
            f"{source}: the lens model {i.model} is not supported; give a calibration with --calib."
        )
    distortion = without_zeros("pinhole", tuple(i.coeffs))
    return CameraModel(i.fx, i.fy, i.ppx, i.ppy, i.width, i.height, distortion=distortion)
