"""Reads RealSense cameras of the D400 series, using pyrealsense2.

An RGB-D frame consists of the colour image and the depth that the device measures with its pattern
projector. librealsense registers the depth to the colour image.

A stereo pair consists of the two infrared images, which the device rectifies. The projector is
switched off for stereo, because its dots would move with the camera.

Models whose names end in i, such as the D435i, and the D455 have an IMU, whose gyroscope and
accelerometer have different rates.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np

from vslam.calibration.models import Array, Calibration, CameraModel, without_zeros
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

_SIZE = 848, 480  # recommended by Intel for the depth of these cameras


def open_realsense(serial: str, sensor: str | None) -> DepthCamera:
    """Open a camera and read its calibration.

    Args:
        serial: serial number of the device. If it is empty, the first device that is found is used.
        sensor: ``stereo``, ``rgbd`` or ``mono``; None means ``rgbd``.

    Raises:
        InputError: pyrealsense2 cannot be imported, or the device is missing, busy or unable to
            deliver these images.
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
        # The projector is set before the stream starts, so that no stereo image shows its dots.
        if depth_sensor.supports(rs.option.emitter_enabled):
            depth_sensor.set_option(rs.option.emitter_enabled, float(sensor == "rgbd"))
        profile = pipeline.start(config)
        with ExitStack() as opened:
            opened.callback(pipeline.stop)
            calibration = _calibration(rs, profile, depth_sensor, sensor, serial)
            imu, warnings = _start_imu(rs, profile, sensor, serial, opened.callback)
            stop = opened.pop_all().close  # from here on, DepthCamera stops the device
    except RuntimeError as error:
        raise InputError(
            f"realsense {serial}: {error}; connect it to a USB 3 port, and close other programs "
            "that use it."
        ) from error
    align = rs.align(rs.stream.color)

    def grab() -> Grabbed | None:
        try:
            while True:
                arrived, frames = pipeline.try_wait_for_frames(1000 * TIMEOUT_S)
                if not arrived:
                    return None
                if sensor == "stereo":
                    images = [frames.get_infrared_frame(side) for side in (1, 2)]
                elif sensor == "rgbd":
                    frames = align.process(frames)
                    images = [frames.get_color_frame(), frames.get_depth_frame()]
                else:
                    images = [frames.get_color_frame()]
                if all(images):  # the first sets may lack an image
                    break
            left, *second = (np.array(image.get_data()) for image in images)
            return Grabbed(images[0].get_timestamp() / 1000, left, second[0] if second else None)
        except RuntimeError:  # the device was unplugged
            return None

    return DepthCamera("realsense", serial, calibration, grab, stop, imu, warnings)


def _device(rs: Any, serial: str) -> Any:
    devices = {d.get_info(rs.camera_info.serial_number): d for d in rs.context().query_devices()}
    if not devices:
        raise InputError("--dataset realsense: no RealSense camera is connected; connect one.")
    if serial and serial not in devices:
        raise InputError(
            f"--data {serial}: no RealSense camera has this serial number; connected are "
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
        T_left_right = _transformation(right.get_extrinsics_to(left))
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


def _transformation(extrinsics: Any) -> Array:
    """Return the ``(4, 4)`` matrix that maps points of the first stream to the second one."""
    T = np.eye(4)
    T[:3, :3] = np.reshape(extrinsics.rotation, (3, 3), order="F")
    T[:3, 3] = extrinsics.translation
    return T


def _start_imu(
    rs: Any, profile: Any, sensor: str, serial: str, on_stop: Callable[[Callable[[], None]], object]
) -> tuple[Imu | None, tuple[str, ...]]:
    """Start the IMU if the device has one. If it cannot be started, a warning says why."""
    name = f"realsense {serial}"
    motion = next((s for s in profile.get_device().query_sensors() if s.is_motion_sensor()), None)
    if motion is None:
        return None, ()
    chosen, samples = [], SplitSamples()
    for stream in (rs.stream.gyro, rs.stream.accel):
        offered = [p for p in motion.get_stream_profiles() if p.stream_type() == stream]
        if not offered:
            return None, ()
        chosen.append(min(offered, key=lambda one: abs(one.fps() - IMU_HZ)))

    def take(frame: Any) -> None:  # called in a thread of librealsense
        data = frame.as_motion_frame().get_motion_data()
        turns = frame.get_profile().stream_type() == rs.stream.gyro
        add = samples.add_rate if turns else samples.add_force
        add(frame.get_timestamp() / 1000, data.x, data.y, data.z)

    left = (rs.stream.infrared, 1) if sensor == "stereo" else (rs.stream.color,)
    try:
        if motion.supports(rs.option.global_time_enabled):  # the clock of the images
            motion.set_option(rs.option.global_time_enabled, 1.0)
        T_imu_camera = _transformation(profile.get_stream(*left).get_extrinsics_to(chosen[0]))
        motion.open(chosen)
        on_stop(motion.close)
        motion.start(take)
        on_stop(motion.stop)
    except RuntimeError as error:
        return None, (f"{name}: the IMU is not used, because it cannot be started ({error}).",)
    calibration = calibration_of_imu(T_imu_camera)
    return Imu(name, samples.read, calibration, live=True), ()


def _model(rs: Any, intrinsics: Any, source: str) -> CameraModel:
    """Both Brown-Conrady models of librealsense are treated as OpenCV's distortion model.

    The model named "inverse" differs from OpenCV's model by second-order terms. For the lens of a
    D455, this difference amounts to 0.01 px.
    """
    i = intrinsics
    known = rs.distortion.brown_conrady, rs.distortion.inverse_brown_conrady
    if any(i.coeffs) and i.model not in known:
        raise InputError(
            f"{source}: the lens model {i.model} is not supported; give a calibration with --calib."
        )
    distortion = without_zeros("pinhole", tuple(i.coeffs))
    return CameraModel(i.fx, i.fy, i.ppx, i.ppy, i.width, i.height, distortion=distortion)
