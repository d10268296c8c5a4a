"""Reads images, calibrations and GPS fixes from the messages of ROS and Foxglove.

ROS defines the fields of these messages in ``sensor_msgs/Image``, ``CompressedImage``,
``CameraInfo`` and ``NavSatFix``. It defines the image encodings in
``sensor_msgs/image_encodings.hpp``. Foxglove's ``RawImage``, ``CompressedImage`` and
``CameraCalibration`` have the same content. They are converted to the messages of ROS.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.documents import Document
from vslam.datasets.grey_levels import Levels, decode, levels_of, upper_bits
from vslam.types.camera import DepthImage, Image

Message = Any  # classes that rosbags generates from the bag's message definitions

_COMPRESSED_DEPTH = "compressedDepth"  # format of image_transport: a 12-byte header, then a PNG
_MM_PER_M = 1000.0  # 16-bit depth is in millimetres, 32-bit depth in metres (REP 118)
_GAP = 20  # least distance in a depth image, in steps between its values; grey values begin near 1
_MOST_STRAY = 1e-3  # share of pixels with depth whose value may lie in this gap nevertheless
_FEWEST_HOLES = 1e-3  # share of pixels without depth that are surrounded by pixels with depth
_FEWEST_KNOWN = 1e-2  # share of pixels with a value by which a 16-bit image can be judged
_DEPTH_ENCODINGS = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}

_FOXGLOVE = ("foxglove.", "foxglove_msgs/msg/")  # before the name of a type, outside and in ROS
IMAGE_TYPES = frozenset(
    ["sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"]
    + [package + name for package in _FOXGLOVE for name in ("RawImage", "CompressedImage")]
)
CAMERA_INFO_TYPES = frozenset(
    ["sensor_msgs/msg/CameraInfo", *(package + "CameraCalibration" for package in _FOXGLOVE)]
)
FIX_TYPE = "sensor_msgs/msg/NavSatFix"
TRANSFORM_TYPE = "geometry_msgs/msg/Transform"
NUMBER_TYPE = "std_msgs/msg/Float32"
IMU_TYPE = "sensor_msgs/msg/Imu"
READ_TYPES = IMAGE_TYPES | CAMERA_INFO_TYPES | {FIX_TYPE, IMU_TYPE, TRANSFORM_TYPE, NUMBER_TYPE}
# The number of channels, and the name of the colour space in OpenCV's constants.
_ENCODINGS: dict[str, tuple[int, str | None]] = {
    "mono": (1, None),
    "bgr": (3, "BGR"),
    "rgb": (3, "RGB"),
    "bgra": (4, "BGRA"),
    "rgba": (4, "RGBA"),
    "bayer_rggb": (1, "BayerRGGB"),
    "bayer_bggr": (1, "BayerBGGR"),
    "bayer_gbrg": (1, "BayerGBRG"),
    "bayer_grbg": (1, "BayerGRBG"),
}
_LIBREALSENSE = {
    "None": "none",
    "Brown Conrady": "plumb_bob",
    "Inverse Brown Conrady": "plumb_bob",
    "Kannala Brandt4": "equidistant",
}
_ALIASES = {"8UC1": "mono8", "16UC1": "mono16", "8UC3": "bgr8", "8UC4": "bgra8"}


def stamp_of(message: Message) -> int:
    """Return the time stamp in the header of a message in nanoseconds; 0 if it is not set."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def from_foxglove(kind: str, message: Any) -> Message:
    """Convert a decoded message of Foxglove to the message of ROS with the same content.

    Args:
        kind: type of the message. Messages of other types are returned unchanged.
        message: object whose attributes are the fields of the message. In JSON, images are base64.

    Raises:
        AttributeError, TypeError, ValueError: a field is missing or of the wrong type.
    """
    if not kind.startswith(_FOXGLOVE):
        return message
    time = message.timestamp
    # The fields are sec and nsec in JSON, sec and nanosec in ROS, seconds and nanos in Protobuf.
    seconds, nanoseconds = (
        next(int(getattr(time, name)) for name in names if hasattr(time, name))
        for names in (("sec", "seconds"), ("nsec", "nanosec", "nanos"))
    )
    stamp = SimpleNamespace(sec=seconds, nanosec=nanoseconds)
    header = SimpleNamespace(stamp=stamp, frame_id=str(message.frame_id))
    if kind.endswith("CameraCalibration"):
        # The fields are K, D, R and P outside ROS and k, d, r and p in ROS 2.
        K, D, R, P = (
            np.array(getattr(message, name, getattr(message, name.lower(), ())), np.float64)
            for name in "KDRP"
        )
        return SimpleNamespace(
            header=header,
            width=int(message.width),
            height=int(message.height),
            distortion_model=str(message.distortion_model),
            K=K.reshape(9),
            D=D.reshape(-1),
            R=(R if R.size else np.zeros(9)).reshape(9),
            P=(P if P.size else np.zeros(12)).reshape(12),
        )
    data = message.data
    data = base64.b64decode(data) if isinstance(data, str) else data
    pixels = np.frombuffer(data, np.uint8)
    if kind.endswith("CompressedImage"):
        return SimpleNamespace(header=header, format=str(message.format), data=pixels)
    return SimpleNamespace(
        header=header,
        height=int(message.height),
        width=int(message.width),
        encoding=str(message.encoding),
        is_bigendian=0,
        step=int(message.step),
        data=pixels,
    )


def nav_sat_fix(message: Message) -> tuple[float, ...]:
    """Convert a ``NavSatFix`` to seven numbers.

    Returns:
        Time (s), latitude and longitude (degrees), altitude (m), and the standard deviations east,
        north and up (m). The position is NaN if the receiver had no fix. Unknown standard
        deviations are NaN.
    """
    status, covariance = message.status.status, np.asarray(message.position_covariance)
    position = (message.latitude, message.longitude, message.altitude)
    if status < 0:  # STATUS_NO_FIX
        position = (np.nan, np.nan, np.nan)
    variances = covariance.reshape(3, 3).diagonal()
    known = message.position_covariance_type > 0 and (variances > 0.0).all()
    sigma = np.sqrt(variances) if known else np.full(3, np.nan)
    return (stamp_of(message) / 10**9, *map(float, position), *sigma.tolist())


def inertial_sample(message: Message) -> tuple[float, ...]:
    """Convert an ``Imu`` to time (s), angular rate xyz (rad/s) and specific force xyz (m/s^2)."""
    rate, force = message.angular_velocity, message.linear_acceleration
    return stamp_of(message) / 10**9, rate.x, rate.y, rate.z, force.x, force.y, force.z


def grey_of(message: Message, levels: Levels | None = None) -> Image:
    """Decode an ``Image`` or ``CompressedImage`` to ``(H, W)`` uint8 grey values.

    Args:
        levels: the grey level of each 16-bit value (`levels_of_messages`). None keeps the upper
            eight bits.

    Raises:
        ValueError: the image cannot be decoded.
    """
    return _decoded(message, "GRAY", levels)


def colour_of(message: Message, levels: Levels | None = None) -> NDArray[np.uint8]:
    """Decode an image to ``(H, W, 3)`` uint8 red, green, blue. A grey image becomes ``(H, W)``.

    ``levels`` has the same meaning as for `grey_of`.

    Raises:
        ValueError: the image cannot be decoded.
    """
    return _decoded(message, "RGB", levels)


def levels_of_messages(messages: Iterable[Message]) -> Levels | None:
    """Choose the grey levels for the images of a drive from samples of these images.

    Returns:
        The levels. None if no image has more than 8 bits. Images that cannot be decoded are
        ignored.
    """
    images = map(_of_any_depth, messages)
    return levels_of(image for image in images if image is not None)


def _of_any_depth(message: Message) -> NDArray[Any] | None:
    import cv2

    try:
        if hasattr(message, "encoding"):
            return _raw(message)[0]
        return _decompressed(message, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH, None)
    except ValueError:
        return None


def _decompressed(
    message: Message, flags: int, levels: Levels | None, skip: int = 0
) -> NDArray[Any]:
    """Decode the image file that a ``CompressedImage`` contains after ``skip`` bytes."""
    import cv2

    try:
        image = decode(np.asarray(message.data[skip:], np.uint8).tobytes(), flags, levels)
    except cv2.error:
        image = None
    if image is None:
        raise ValueError(f"a compressed image of format '{message.format}' cannot be decoded")
    return image


def _decoded(message: Message, wanted: str, levels: Levels | None) -> NDArray[np.uint8]:
    """Decode an image to ``GRAY`` or ``RGB``. A grey image stays grey."""
    import cv2

    if not hasattr(message, "encoding"):
        grey = wanted == "GRAY"
        flags = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_ANYCOLOR
        image = _decompressed(message, flags, levels)
        return np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
    image, colours = _raw(message)
    if image.dtype.itemsize == 2:
        image = (upper_bits() if levels is None else levels)[image]
    if colours not in (None, wanted):
        image = cv2.cvtColor(image, getattr(cv2, f"COLOR_{colours}2{wanted}"))
    return np.ascontiguousarray(image, np.uint8)


def _raw(message: Message) -> tuple[NDArray[Any], str | None]:
    """Return the pixels of an ``Image`` with 8 or 16 bits, and the name of their colour space."""
    encoding = _ALIASES.get(message.encoding, message.encoding)
    found = re.fullmatch(r"(.*\D)(8|10|12|14|16)", encoding)
    if found is None or found[1] not in _ENCODINGS:
        known = ", ".join(f"{known}8" for known in _ENCODINGS)
        raise ValueError(f"encoding '{message.encoding}' is unknown; known are {known}")
    channels, colours = _ENCODINGS[found[1]]
    return _pixels(message, channels, 8 if found[2] == "8" else 16), colours


def depth_in(message: Message, topic: str) -> bool | None:
    """Return whether an image message contains depth; None if hardly any pixel has a value.

    32-bit images and images in the format ``compressedDepth`` contain depth. A 16-bit image
    contains depth if its values look like distances: between pixels without a value, which are 0,
    and the nearest distance, there is a wide gap. Grey values have no such gap, except if the black
    margin of a rectified image is the only black in it. Zeros at the margin count only if the name
    of the topic contains ``depth``. It also decides about 16UC1, the encoding of depth in ROS.

    Raises:
        ValueError: the image cannot be decoded.
    """
    import cv2

    named = "depth" in topic.lower()
    if not hasattr(message, "encoding"):
        if _COMPRESSED_DEPTH in message.format:
            return True
        image = _decompressed(message, cv2.IMREAD_UNCHANGED, None)
    elif message.encoding in ("32FC1", "16UC1", "mono16"):
        if message.encoding == "32FC1" or (named and message.encoding == "16UC1"):
            return True
        image = _pixels(message, 1, 16)
    else:
        return False
    if image.dtype.itemsize != 2 or image.ndim != 2:
        return False
    known = image > 0
    if known.mean() < _FEWEST_KNOWN:
        return None
    values, counts = np.unique(image[known], return_counts=True)
    if len(values) < 2:
        return False
    in_the_gap = values < _GAP * np.diff(values).min()
    if counts[in_the_gap].sum() > _MOST_STRAY * counts.sum():
        return False
    between = ~known
    for axis in (0, 1):
        before = np.maximum.accumulate(known, axis)
        after = np.flip(np.maximum.accumulate(np.flip(known, axis), axis), axis)
        between &= before & after
    return named or bool(between.mean() > _FEWEST_HOLES)


def depth_of(message: Message, scale: float | None) -> DepthImage:
    """Decode a depth image to ``(H, W)`` float32 metres, 0 where the depth is unknown.

    The message is an ``Image``, or a ``CompressedImage`` that contains a 16-bit PNG file or was
    written by the plug-in ``compressed_depth`` of image_transport.

    Args:
        scale: image units per metre. None uses the units that REP 118 defines: 1000 for 16-bit
            images and 1 for 32-bit images.

    Raises:
        ValueError: the image cannot be decoded.
    """
    if not hasattr(message, "encoding"):
        return _compressed_depth(message, scale)
    kind = _DEPTH_ENCODINGS.get(message.encoding)
    if kind is None:
        known = ", ".join(_DEPTH_ENCODINGS)
        raise ValueError(f"encoding '{message.encoding}' is not depth; known are {known}")
    image = _pixels(message, 1, 8 * np.dtype(kind).itemsize, "f" if kind is np.float32 else "u")
    return _metres(image, scale)


def _compressed_depth(message: Message, scale: float | None) -> DepthImage:
    """Decode a message of ``compressed_depth_image_transport``, or a 16-bit PNG file.

    For 32-bit depth, the PNG file holds the quantised inverse depth. The header of the message
    (``ConfigHeader``) contains the two parameters of this quantisation.
    """
    import cv2

    header = np.dtype([("kind", "<i4"), ("a", "<f4"), ("b", "<f4")])
    packed = _COMPRESSED_DEPTH in message.format
    skip = header.itemsize if packed else 0
    image = _decompressed(message, cv2.IMREAD_UNCHANGED, None, skip)
    if image.dtype.itemsize != 2 or image.ndim != 2:
        raise ValueError(f"compressed depth of format '{message.format}' cannot be decoded")
    if not packed or "32FC1" not in message.format:
        return _metres(image, scale)
    data = np.asarray(message.data[: header.itemsize], np.uint8)
    (numbers,) = np.frombuffer(data.tobytes(), header)
    with np.errstate(divide="ignore", invalid="ignore"):
        metres = numbers["a"] / (image.astype(np.float32) - numbers["b"])
    return _metres(np.where(image > 0, metres, np.float32(0.0)).astype(np.float32), scale)


def _metres(image: NDArray[Any], scale: float | None) -> DepthImage:
    scale = scale or (_MM_PER_M if image.dtype.kind == "u" else 1.0)
    metres = np.asarray(image, np.float32) * np.float32(1.0 / scale)
    return np.where(np.isfinite(metres), metres, np.float32(0.0))


def _pixels(message: Message, channels: int, bits: int, kind: str = "u") -> NDArray[Any]:
    """Return the pixels of an image without the padding of its rows."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, np.uint8)
    row = width * channels * bits // 8
    if step < row or data.size < height * step or not row * height:
        raise ValueError(
            f"{data.size} bytes do not fit an image of {width}x{height} {message.encoding}"
        )
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row])
    order = ">" if message.is_bigendian else "<"
    pixels = rows.view(f"{order}{kind}{bits // 8}")
    return pixels.reshape(height, width, channels) if channels > 1 else pixels


def camera_info(
    message: Message, source: str, rectified: bool, size: tuple[int, int]
) -> Document | None:
    """Convert a ``CameraInfo`` to the input of `vslam.calibration.formats.read_ros`.

    Returns None if the camera is not calibrated, which ROS defines as a camera matrix K of zeros.

    A ``CameraInfo`` describes the whole image of the sensor. If the images are smaller because of
    binning or a region of interest, the matrices are shifted and scaled to fit them.

    Args:
        source: bag and topic, for error messages.
        rectified: whether the images are rectified. The projection matrix P describes rectified
            images.
        size: width and height of the images.
    """
    # The fields are K, D, R and P in ROS 1 and k, d, r and p in ROS 2.
    K, D, R, P = (
        np.array(getattr(message, name, getattr(message, name.lower(), ())), np.float64)
        for name in "KDRP"
    )
    K, P = K.reshape(3, 3), P.reshape(3, 4)
    if not (P if rectified else K).any():
        return None
    width, height = int(message.width), int(message.height)
    if size != (width, height) and hasattr(message, "roi"):
        roi, shrink = message.roi, [max(int(n), 1) for n in (message.binning_x, message.binning_y)]
        for matrix in (K, P):
            matrix[:2, 2] -= roi.x_offset, roi.y_offset
            matrix[:2] /= np.reshape(shrink, (2, 1))
        width = (int(roi.width) or width) // shrink[0]
        height = (int(roi.height) or height) // shrink[1]
    if rectified:
        K, D, R = P[:, :3], np.zeros(0), np.eye(3)
    numbers = {"K": K, "D": D, "R": R, "P": P}
    return Document(
        source,
        {
            "distortion_model": "plumb_bob" if rectified else _lens_of(message, D),
            "image_width": str(width),
            "image_height": str(height),
            **{key: [repr(float(x)) for x in value.ravel()] for key, value in numbers.items()},
        },
    )


def _lens_of(message: Message, distortion: NDArray[np.float64]) -> str:
    """Return ROS's name of the distortion model, for which librealsense has names of its own.

    Its inverse Brown-Conrady model is treated as OpenCV's model (`vslam.datasets.realsense`).
    """
    name = str(message.distortion_model)
    if name.endswith("Brown Conrady") and not distortion.any():
        return "plumb_bob"
    return _LIBREALSENSE.get(name, name)
