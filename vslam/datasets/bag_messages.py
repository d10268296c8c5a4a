"""Reads images, calibrations and GPS fixes from ROS messages.

ROS defines the fields of these messages in ``sensor_msgs/Image``, ``CompressedImage``,
``CameraInfo`` and ``NavSatFix``. It defines the image encodings in
``sensor_msgs/image_encodings.hpp``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.documents import Document
from vslam.camera import DepthImage, Image
from vslam.datasets.grey_levels import Levels, decode, levels_of, upper_bits

Message = Any  # classes that rosbags generates from the bag's message definitions

_COMPRESSED_DEPTH = "compressedDepth"  # format of image_transport: a 12-byte header, then a PNG
_MM_PER_M = 1000.0  # 16-bit depth is in millimetres, 32-bit depth in metres (REP 118)
_DEPTH_ENCODINGS = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO_TYPE = "sensor_msgs/msg/CameraInfo"
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
_ALIASES = {"8UC1": "mono8", "16UC1": "mono16", "8UC3": "bgr8", "8UC4": "bgra8"}


def stamp_of(message: Message) -> int:
    """Return the time stamp in the header of a message in nanoseconds; 0 if it is not set."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


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


def _decompressed(message: Message, flags: int, levels: Levels | None) -> NDArray[Any]:
    import cv2

    try:
        image = decode(np.asarray(message.data, np.uint8).tobytes(), flags, levels)
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


def is_depth(message: Message, topic: str) -> bool:
    """Return whether an image message contains depth.

    A 16-bit image counts as depth only if the name of its topic contains ``depth``.
    """
    if not hasattr(message, "encoding"):
        return _COMPRESSED_DEPTH in message.format
    is_16_bit_depth = message.encoding == "16UC1" and "depth" in topic.lower()
    return is_16_bit_depth or message.encoding == "32FC1"


def depth_of(message: Message, scale: float | None) -> DepthImage:
    """Decode a depth image to ``(H, W)`` float32 metres, 0 where the depth is unknown.

    The message is an ``Image``, or a ``CompressedImage`` that was written by the plug-in
    ``compressed_depth`` of image_transport.

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
    """Decode a message of ``compressed_depth_image_transport``, which contains a PNG file.

    For 32-bit depth, the PNG file holds the quantised inverse depth. The header of the message
    (``ConfigHeader``) contains the two parameters of this quantisation.
    """
    import cv2

    from vslam.datasets.png import decode_with_opencv

    data = np.asarray(message.data, np.uint8)
    header = np.dtype([("kind", "<i4"), ("a", "<f4"), ("b", "<f4")])
    try:
        image = decode_with_opencv(data[header.itemsize :].tobytes(), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if _COMPRESSED_DEPTH not in message.format or image is None or image.dtype != np.uint16:
        raise ValueError(f"compressed depth of format '{message.format}' cannot be decoded")
    if "32FC1" not in message.format:
        return _metres(np.asarray(image), scale)
    (numbers,) = np.frombuffer(data[: header.itemsize].tobytes(), header)
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


def camera_info(message: Message, source: str, rectified: bool) -> Document | None:
    """Convert a ``CameraInfo`` to the input of `vslam.calibration.formats.read_ros`.

    Returns None if the camera is not calibrated, which ROS defines as a camera matrix K of zeros.

    Args:
        source: bag and topic, for error messages.
        rectified: whether the images are rectified. The projection matrix P describes rectified
            images.
    """
    # The fields are K, D, R and P in ROS 1 and k, d, r and p in ROS 2.
    K, D, R, P = (
        np.asarray(getattr(message, name, getattr(message, name.lower(), None)), np.float64)
        for name in "KDRP"
    )
    if rectified:
        K, D, R = P.reshape(3, 4)[:, :3], np.zeros(0), np.eye(3)
    if not K.any():
        return None
    numbers = {"K": K, "D": D, "R": R, "P": P}
    return Document(
        source,
        {
            "distortion_model": "plumb_bob" if rectified else message.distortion_model,
            "image_width": str(message.width),
            "image_height": str(message.height),
            **{key: [repr(float(x)) for x in value.ravel()] for key, value in numbers.items()},
        },
    )
