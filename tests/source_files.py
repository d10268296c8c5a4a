"""Writes the same frames as every kind of source."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from vslam.datasets.frames import Source
from vslam.datasets.perturbation import parse_perturbation
from vslam.datasets.sources import open_source
from vslam.run.options import RunOptions
from vslam.run.outcome import RunOutcome
from vslam.run.pipeline import run_sequence
from vslam.run.recorder import Recorder
from vslam.run.slam_run import begin
from vslam.types.camera import Camera
from vslam.types.source_options import SourceOptions

NO_OPTIONS = SourceOptions()
LEFT, RIGHT = "/cam0/image_raw", "/cam1/image_raw"


def open_from(
    dataset: str, data: Path | str, options: SourceOptions = NO_OPTIONS, **more: object
) -> Source:
    given = {"dataset": dataset, "data": str(data), **more}
    return open_source(options.model_copy(update=given))


def write_calibration(
    path: Path, camera: Camera, *, mono: bool = False, scale: float = 1.0
) -> Path:
    """Write a calibration in vslam's own format, as JSON, which is valid YAML."""
    one = {
        "size": [round(scale * camera.width), round(scale * camera.height)],
        "focal": [camera.fx, camera.fy],
        "centre": [camera.cx, camera.cy],
    }
    both = {"left": one, "right": one, "baseline": camera.baseline}
    path.write_text(json.dumps({"left": one} if mono else both))
    return path


def write_images(folder: Path, sides: dict[str, list[np.ndarray]], names: list[str]) -> Path:
    for side, images in sides.items():
        (folder / side).mkdir(parents=True, exist_ok=True)
        for name, image in zip(names, images, strict=True):
            assert cv2.imwrite(str(folder / side / name), image)
    return folder


def write_video(
    path: Path, images: list[np.ndarray], fps: float = 10.0, codec: str = "FFV1"
) -> Path:
    """Write a video, which is lossless with the codec FFV1. Colour images are BGR."""
    height, width = images[0].shape[:2]
    fourcc, colour = cv2.VideoWriter_fourcc(*codec), images[0].ndim == 3
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, fps, (width, height), colour)
    assert writer.isOpened()
    for image in images:
        writer.write(image)
    writer.release()
    return path


def encoded(image: np.ndarray, encoding: str) -> np.ndarray:
    """Convert ``(H, W)`` grey values to the pixels of a ROS image with the same grey values.

    Depth in mm is converted as defined by REP 118.
    """
    if image.dtype == np.uint16:
        return image if encoding == "16UC1" else (image * np.float32(0.001)).astype("<f4")
    if encoding == "mono16":
        return image.astype("<u2") << 8 | 77
    if image.ndim == 3:
        return image[..., :: 1 if encoding == "bgr8" else -1]
    if encoding in ("bgr8", "rgb8"):
        return np.repeat(image[..., None], 3, axis=2)
    assert encoding in ("mono8", "8UC1")
    return image


def compressed(image: np.ndarray, kind: str) -> tuple[str, np.ndarray]:
    """Return the format and the bytes of a compressed image, or of depth in mm."""
    if kind == "png":
        return kind, cv2.imencode(".png", image)[1].ravel()
    a, b = np.float32(500.0), np.float32(-3.0)  # the PNG contains a / metres + b
    header = np.array([(1, a, b)], [("kind", "<i4"), ("a", "<f4"), ("b", "<f4")])
    if kind.startswith("32FC1"):
        with np.errstate(divide="ignore"):
            inverse = np.rint(a * np.float32(1000.0) / image + b)
        image = np.where(image > 0, inverse, 0).astype(np.uint16)
    data = np.frombuffer(header.tobytes() + cv2.imencode(".png", image)[1].tobytes(), np.uint8)
    return f"{kind.removesuffix(' png')}; compressedDepth png", data


def write_bag(
    path: Path,
    kind: str,
    sides: dict[str, list[np.ndarray]],
    stamps: list[int],
    *,
    encoding: str = "mono8",
    depth_encoding: str = "16UC1",
    camera: Camera | None = None,
    baseline: bool = True,
    calibrated: bool = True,
    lag: int = 0,
    padding: int = 0,
    compression: str = "",
    imu: dict[str, np.ndarray] | None = None,
) -> Path:
    """Write a bag with one topic for each side, and return the path to open.

    Args:
        kind: ``ros1``, ``ros2``, ``mcap``, or ``folder`` for a ROS 2 bag of MCAP files.
        stamps: timestamps in nanoseconds.
        encoding: encoding of the images, or ``png`` for compressed images.
        depth_encoding: ``16UC1`` or ``32FC1``, for sides with uint16 depth in mm. `` png`` is
            appended for compressed depth.
        camera: camera whose camera_info is written; None writes no camera_info.
        baseline: whether P of the right camera contains the baseline.
        calibrated: whether the camera_info is calibrated. Otherwise, it is all zero.
        lag: delay of the timestamps of the second side in nanoseconds.
        padding: number of bytes after each row.
        imu: ``(N, 7)`` inertial samples of each topic.
        compression: ``bz2`` or ``lz4`` for ROS 1; ``file``, ``message`` or ``storage`` for ROS 2.
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.SQLITE3 if kind == "ros2" else StoragePlugin.MCAP
    writer = Writer1(path) if kind == "ros1" else Writer2(path, version=8, storage_plugin=plugin)
    if compression and kind == "ros1":
        writer.set_compression(writer.CompressionFormat[compression.upper()])
    elif compression:
        writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    wanted = ("builtin_interfaces/msg/", "std_msgs/msg/", "sensor_msgs/msg/")
    types = {
        name.rpartition("/")[2]: made
        for package in reversed(wanted)
        for name, made in store.types.items()
        if name.startswith(package)
    }

    geometry = {
        name: store.types[f"geometry_msgs/msg/{name}"] for name in ("Quaternion", "Vector3")
    }

    def header(stamp: int):
        counter = {"seq": 0} if kind == "ros1" else {}
        time = types["Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        return types["Header"](stamp=time, frame_id="", **counter)

    def message(image: np.ndarray, stamp: int):
        kind = depth_encoding if image.dtype == np.uint16 else encoding
        if kind in ("png", "16UC1 png", "32FC1 png"):
            return types["CompressedImage"](header(stamp), *compressed(image, kind))
        pixels = encoded(image, kind)
        rows = pixels.reshape(len(image), -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
        return types["Image"](header(stamp), *image.shape[:2], kind, 0, rows.shape[1], rows.ravel())

    def info(side: int):
        P = np.array([camera.fx, 0, camera.cx, -side * camera.bf * baseline,
                      0, camera.fy, camera.cy, 0, 0, 0, 1, 0]) * calibrated  # fmt: skip
        K, R = np.delete(P, [3, 7, 11]), np.eye(3).ravel()
        region = types["RegionOfInterest"](0, 0, 0, 0, False)
        shape = (camera.height, camera.width)
        return types["CameraInfo"](
            header(stamps[0]), *shape, "plumb_bob", np.zeros(5), K, R, P, 0, 0, region
        )

    with writer:
        image_types = [
            f"sensor_msgs/msg/{'CompressedImage' if kind.endswith('png') else 'Image'}"
            for kind in (
                depth_encoding if images[0].dtype == np.uint16 else encoding
                for images in sides.values()
            )
        ]
        info_type = "sensor_msgs/msg/CameraInfo"
        connections = []
        for number, (topic, image_type) in enumerate(zip(sides, image_types, strict=True)):
            where = topic + "/compressed" * image_type.endswith("CompressedImage")
            connections.append(writer.add_connection(where, image_type, typestore=store))
            if camera is not None:
                where = topic.rpartition("/")[0] + "/camera_info"
                connection = writer.add_connection(where, info_type, typestore=store)
                writer.write(connection, stamps[0], serialize(info(number), info_type))
        for stamp, *images in zip(stamps, *sides.values(), strict=True):
            kinds = zip(connections, images, image_types, strict=True)
            for number, (connection, image, image_type) in enumerate(kinds):
                made = message(image, stamp + number * lag)
                writer.write(connection, stamp + number, serialize(made, image_type))
        imu_type = "sensor_msgs/msg/Imu"
        for topic, rows in (imu or {}).items():
            connection = writer.add_connection(topic, imu_type, typestore=store)
            for row in rows:
                stamp = round(1e9 * row[0])
                made = types["Imu"](
                    header(stamp), geometry["Quaternion"](0.0, 0.0, 0.0, 1.0), np.zeros(9),
                    geometry["Vector3"](*row[1:4]), np.zeros(9),
                    geometry["Vector3"](*row[4:]), np.zeros(9),
                )  # fmt: skip
                writer.write(connection, stamp, serialize(made, imu_type))
    return next(path.glob("*.mcap")) if kind == "mcap" else path


def all_sources(root: Path, corridor, n: int) -> Path:
    """Write the first frames of the corridor as every kind of source, with calibrations."""
    left, right = corridor.left[:n], corridor.right[:n]
    stamps = [k * 10**8 for k in range(n)]
    names = [f"{k}.png" for k in range(n)]  # 10 comes after 9
    write_images(root / "images", {"left": left, "right": right}, names)
    (root / "images" / "times.txt").write_text("".join(f"{k / 10}\n" for k in range(n)))
    write_video(root / "pair.mkv", [np.hstack(pair) for pair in zip(left, right, strict=True)])
    sides = {LEFT: left, RIGHT: right}
    write_bag(root / "ros1.bag", "ros1", sides, stamps, encoding="bgr8", lag=1000)
    write_bag(root / "ros2", "ros2", sides, stamps, encoding="mono16", padding=6)
    write_bag(root / "mcap", "mcap", sides, stamps, encoding="png")
    write_bag(root / "bag", "folder", sides, stamps, camera=corridor.camera)
    write_calibration(root / "stereo.yaml", corridor.camera)
    write_calibration(root / "mono.yaml", corridor.camera, mono=True)
    write_calibration(root / "other.yaml", corridor.camera, scale=0.5)
    return root


def source_path(root: Path, kind: str) -> Path:
    files = {"images": "images", "video": "pair.mkv", "ros1": "ros1.bag", "ros2": "ros2",
             "mcap": "mcap/mcap.mcap", "folder": "bag"}  # fmt: skip
    return root / files[kind]


def run_source(source, *, threads: int = 2, perturb: str = "none", **more) -> RunOutcome:
    settings = RunOptions(detector="none", perturb=perturb, threads=threads, **more)
    return run_sequence(begin(source, settings), parse_perturbation(perturb, 0), Recorder())
