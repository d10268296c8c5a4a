"""Foxglove's messages in MCAP files, and MCAP files whose channels have several encodings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from source_files import open_from

pytest.importorskip("rosbags", reason="pip install 'vslam[bag]'")
from foxglove_files import Recorder, calibration, compressed, raw
from mcap.writer import CompressionType, IndexType
from rosbags.typesys import Stores, get_typestore

from vslam.datasets import bag_limits
from vslam.datasets.bag import open_bag
from vslam.support.errors import BrokenSourceError, InputError


def record_pair(recorder: Recorder, corridor, n: int = 3, kind: str = "CompressedImage") -> None:
    packed = compressed if kind == "CompressedImage" else raw
    for k in range(n):
        stamp = 10**18 + k * 10**8
        for side, (name, images) in enumerate((("l", corridor.left), ("r", corridor.right))):
            more = {"frame_id": name}
            calib = calibration(corridor.camera, side)
            recorder.send(f"/{name}/calibration", "CameraCalibration", stamp, **more, **calib)
            recorder.send(f"/{name}/image", kind, stamp + side, **more, **packed(images[k]))


def assert_is_pair(path: Path, corridor, n: int = 3) -> None:
    source = open_from("bag", path)
    assert source.camera == corridor.camera
    frames = list(source.frames())
    assert [frame.timestamp for frame in frames] == [1e9 + k / 10 for k in range(n)]
    for k, frame in enumerate(frames):
        left, right = frame.read(map)
        assert np.array_equal(left, corridor.left[k])
        assert np.array_equal(right, corridor.right[k])


@pytest.mark.parametrize("kind", ["CompressedImage", "RawImage"])
@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_foxglove_messages(corridor, tmp_path, encoding, kind):
    with Recorder(tmp_path / "a.mcap", encoding) as recorder:
        record_pair(recorder, corridor, kind=kind)
    assert_is_pair(tmp_path / "a.mcap", corridor)


def test_foxglove_depth_in_metres(corridor, tmp_path):
    metres = np.full(corridor.left[0].shape, 2.5, np.float32)
    metres[:9] = np.nan
    with Recorder(tmp_path / "a.mcap") as recorder:
        for k in range(2):
            stamp, frame = (k + 1) * 10**8, {"frame_id": "colour"}
            colour = raw(np.repeat(corridor.left[k][..., None], 3, axis=2))
            recorder.send("/a/image", "RawImage", stamp, **frame, **colour)
            recorder.send("/b/image", "RawImage", stamp, **frame, **raw(metres))
            calib = calibration(corridor.camera, 0)
            recorder.send("/a/camera_info", "CameraCalibration", stamp, **frame, **calib)
    source = open_from("bag", tmp_path / "a.mcap")
    assert source.camera.depth
    left, depth = next(source.frames()).read(map)
    assert np.array_equal(left, corridor.left[0])
    assert np.array_equal(depth, np.nan_to_num(metres))


@pytest.mark.parametrize(
    "options",
    [
        {"use_chunking": False},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.ZSTD},
        {"index_types": IndexType.NONE, "use_statistics": False, "repeat_channels": False,
         "repeat_schemas": False, "use_summary_offsets": False},
    ],
)  # fmt: skip
def test_every_layout_of_an_mcap_file(corridor, tmp_path, options):
    with Recorder(tmp_path / "a.mcap", **options) as recorder:
        record_pair(recorder, corridor)
    assert_is_pair(tmp_path / "a.mcap", corridor)


@pytest.mark.parametrize("profile", ["", "ros2", "x"])
def test_other_channels_do_not_matter(corridor, tmp_path, profile):
    with Recorder(tmp_path / "a.mcap", "protobuf", profile) as recorder:
        recorder.raw("/scan", 1, b"\0", "flatbuffer", "foxglove.LaserScan", "flatbuffer", b"\xff")
        recorder.raw("/log", 2, b"text")
        recorder.raw("/odd", 3, b"\x80", "cdr", "odd_msgs/msg/Odd", "ros2msg", b"no definition")
        record_pair(recorder, corridor)
    assert_is_pair(tmp_path / "a.mcap", corridor)


@pytest.mark.parametrize("ros", ["ros1", "ros2"])
def test_ros_messages_beside_other_encodings(corridor, tmp_path, ros):
    """The images are messages of ROS 2, or of ROS 1 as ``mcap convert`` writes them."""
    store = get_typestore(Stores.ROS1_NOETIC if ros == "ros1" else Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/Image"
    text, _ = store.generate_msgdef(kind, ros_version=int(ros[-1]))
    made = store.types
    counter = (0,) if ros == "ros1" else ()
    with Recorder(tmp_path / "a.mcap", profile=ros) as recorder:
        recorder.raw("/state", 1, b"{}", "json", "my.State", "jsonschema", b"{}")
        for k, pixels in enumerate(corridor.left[:3]):
            stamp = made["builtin_interfaces/msg/Time"](5, k * 10**8)
            header = made["std_msgs/msg/Header"](*counter, stamp, "")
            height, width = pixels.shape
            message = made[kind](header, height, width, "mono8", 0, width, pixels.ravel())
            write = store.serialize_ros1 if ros == "ros1" else store.serialize_cdr
            encoding, name = ("cdr", kind) if ros == "ros2" else ("ros1", "sensor_msgs/Image")
            data = bytes(write(message, kind))
            schema = name, f"{ros}msg", text.encode()
            recorder.raw("/a/image_raw", 2 + k, data, encoding, *schema)
    frames = list(open_bag(tmp_path / "a.mcap", sensor="mono").frames())
    assert [frame.timestamp for frame in frames] == [5.0, 5.1, 5.2]
    assert np.array_equal(frames[2].read(map)[0], corridor.left[2])


def test_a_file_without_images_says_what_it_holds(tmp_path):
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.raw("/video", 1, b"\0", "flatbuffer", "foxglove.CompressedVideo", "flatbuffer")
    said = r"there are no image topics \(vslam does not read foxglove.CompressedVideo \(flatbuffer"
    with pytest.raises(InputError, match=said):
        open_bag(tmp_path / "a.mcap", sensor="mono")


@pytest.mark.parametrize("compression", [CompressionType.LZ4, CompressionType.ZSTD])
def test_what_unpacks_to_too_much_is_refused(tmp_path, monkeypatch, compression):
    black = np.zeros((1000, 1000), np.uint8)
    with Recorder(tmp_path / "a.mcap", "protobuf", compression=compression) as recorder:
        for k in range(3):
            recorder.send("/a/image", "RawImage", 1 + k, frame_id="", **raw(black))
    assert (tmp_path / "a.mcap").stat().st_size < 50_000
    monkeypatch.setattr(bag_limits, "MOST_BYTES", 500_000)
    with pytest.raises((InputError, BrokenSourceError), match="unpacks to more"):
        open_bag(tmp_path / "a.mcap", sensor="mono")
