"""Topics of bags are chosen by their content, and each image finds its camera_info."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from source_files import LEFT, RIGHT, open_from, write_bag

pytest.importorskip("rosbags", reason="pip install 'vslam[bag]'")
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from vslam.calibration.formats import read_ros
from vslam.datasets.bag import open_bag
from vslam.datasets.bag_messages import camera_info, depth_in
from vslam.datasets.bag_topics import camera_info_of
from vslam.datasets.sources import open_raw
from vslam.support.errors import InputError
from vslam.types.source_options import SourceOptions

WIDTH, HEIGHT = 64, 48
FOCAL, CENTRE = 50.0, (31.0, 24.0)
STORE = get_typestore(Stores.ROS1_NOETIC)
DEVICE = "/device_0/sensor_0"
COLOUR, DEPTH = "/device_0/sensor_1/Color_0/image/data", f"{DEVICE}/Depth_0/image/data"


def made(kind: str, *fields):
    return STORE.types[kind](*fields)


def header(frame: str, seconds: float = 0.0):
    stamp = made("builtin_interfaces/msg/Time", int(seconds), round(seconds % 1 * 1e9))
    return made("std_msgs/msg/Header", 0, stamp, frame)


def image(pixels: np.ndarray, encoding: str, frame: str, seconds: float):
    rows = pixels.reshape(len(pixels), -1).view(np.uint8)
    size = pixels.shape[:2]
    return made("sensor_msgs/msg/Image", header(frame, seconds), *size, encoding, 0,
                rows.shape[1], rows.ravel())  # fmt: skip


def info(
    *, focal=FOCAL, centre=CENTRE, size=(WIDTH, HEIGHT), bf=0.0, frame="", model="plumb_bob",
    projection=True, binning=(0, 0), roi=(0, 0, 0, 0),
):  # fmt: skip
    K = np.array([focal, 0, centre[0], 0, focal, centre[1], 0, 0, 1], np.float64)
    P = np.insert(K, [3, 6, 9], [-bf, 0, 0]) * projection
    R = np.eye(3).ravel() * projection
    region = made("sensor_msgs/msg/RegionOfInterest", *roi, False)
    return made("sensor_msgs/msg/CameraInfo", header(frame), size[1], size[0], model, np.zeros(5),
                K, R, P, *binning, region)  # fmt: skip


def write(path: Path, topics: dict[str, list]) -> Path:
    with Writer(path) as writer:
        for topic, sent in topics.items():
            kind = sent[0].__msgtype__
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for k, message in enumerate(sent):
                writer.write(connection, 1 + k, STORE.serialize_ros1(message, kind))
    return path


def grey(shape=(HEIGHT, WIDTH)) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, shape, np.uint8)


def depth() -> np.ndarray:
    """A slanted wall at 1.5 m, with holes, as (H, W) uint16 mm."""
    wall = (1500 + 3 * np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % 800).astype(np.uint16)
    wall[::7, ::5] = 0
    wall[:, :4] = 0
    return wall


def images(pixels: np.ndarray, encoding: str, frame: str = "0", lag: float = 0.0) -> list:
    return [image(pixels, encoding, frame, 100.0 + 0.1 * k + lag) for k in range(3)]


def transform(x: float):
    return made("geometry_msgs/msg/Transform", made("geometry_msgs/msg/Vector3", x, 0.0, 0.0),
                made("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0))  # fmt: skip


def recorded_by_realsense_viewer(**of_depth) -> dict[str, list]:
    """All topics are those of librealsense. Its camera_info has neither P nor R."""
    lens = {"projection": False, "model": "Inverse Brown Conrady"}
    return {
        f"{DEVICE}/Depth_0/info/camera_info": [info(**lens | of_depth)],
        f"{DEVICE}/option/Depth_Units/value": [made("std_msgs/msg/Float32", 0.0005)],
        f"{DEVICE}/option/Gain/value": [made("std_msgs/msg/Float32", 16.0)],
        DEPTH: [image(np.zeros_like(depth()), "mono16", "0", 99.0),
                *images(depth(), "mono16", lag=0.01)],
        "/device_0/sensor_1/Color_0/info/camera_info": [info(**lens)],
        COLOUR: images(grey((HEIGHT, WIDTH, 3)), "rgb8"),
    }  # fmt: skip


def test_a_bag_of_the_realsense_viewer(tmp_path):
    path = write(tmp_path / "a.bag", recorded_by_realsense_viewer())
    source = open_from("bag", path)
    camera = source.camera
    assert camera.depth
    assert (camera.fx, camera.cx, camera.cy) == (FOCAL, *CENTRE)
    frames = list(source.frames())
    assert len(frames) == 3
    np.testing.assert_allclose(frames[0].read(map)[1], depth() * 0.0005, rtol=1e-6)
    assert open_from("bag", path, sensor="mono").camera.fx == FOCAL


@pytest.mark.parametrize(
    ("of_depth", "apart", "why"),
    [
        ({"focal": 60.0}, None, r"its camera has focal lengths of 60 .* the images has .* of 50"),
        ({"centre": (28.0, 24.0)}, 0.0, r"its camera has .* the centre \(28, 24\) but .* \(31, 24"),
        ({"focal": 50.5}, 0.015, "its camera is 15 mm away from that of the images"),
        ({"focal": 50.5}, 0.0, None),
        ({}, 0.015, None),  # the same matrix, thus the same camera
    ],
)
def test_depth_of_another_camera_is_not_used(tmp_path, of_depth, apart, why):
    topics = recorded_by_realsense_viewer(**of_depth)
    if apart is not None:
        topics[COLOUR.replace("image/data", "tf/0")] = [transform(apart)]
        topics[DEPTH.replace("image/data", "tf/0")] = [transform(0.0)]
    path = write(tmp_path / "a.bag", topics)
    if why is None:
        assert open_from("bag", path).camera.depth
        return
    with pytest.raises(InputError, match=rf"is not registered .* because {why}.*; name depth"):
        open_from("bag", path)
    assert not open_from("bag", path, sensor="mono").camera.depth


def test_infrared_images_are_a_pair_at_the_distance_of_their_extrinsics(tmp_path):
    topics = recorded_by_realsense_viewer()
    for number, x in ((1, 0.0), (2, -0.055)):
        stream = f"{DEVICE}/Infrared_{number}"
        topics[f"{stream}/image/data"] = images(grey(), "mono8")
        topics[f"{stream}/info/camera_info"] = [info(projection=False, model="Brown Conrady")]
        topics[f"{stream}/tf/0"] = [transform(x)]
    path = write(tmp_path / "a.bag", topics)
    with pytest.raises(InputError, match=r"choose topics .*Depth_0/image/data \(depth\)"):
        open_from("bag", path)
    assert open_from("bag", path, sensor="stereo").camera.baseline == pytest.approx(0.055)
    assert open_from("bag", path, sensor="rgbd").camera.depth  # depth and colour
    swapped = SourceOptions(topics=f"{DEVICE}/Infrared_2/image/data,{DEVICE}/Infrared_1/image/data")
    with pytest.raises(InputError, match="swap the cameras"):
        open_from("bag", path, swapped)


@pytest.mark.parametrize(
    ("topics", "bf", "left"),
    [
        (("/a/image_raw", "/b/image_raw"), (3.0, 0.0), "/b/image_raw"),
        (("/a/image_raw", "/b/image_raw"), (0.0, 3.0), "/a/image_raw"),
        (("/my_right/image_raw", "/to_left/image_raw"), None, "/to_left/image_raw"),
    ],
)
def test_the_left_images_are_those_without_a_baseline(tmp_path, topics, bf, left):
    sent = {topic: images(grey() + np.uint8(k), "mono8") for k, topic in enumerate(topics)}
    calib = {}
    if bf is not None:
        for topic, each in zip(topics, bf, strict=True):
            sent[topic.replace("image_raw", "camera_info")] = [info(bf=each)]
    else:
        file = tmp_path / "c.yaml"
        one = f"{{size: [{WIDTH}, {HEIGHT}], focal: [50, 50], centre: [31, 24]}}"
        file.write_text(f"left: {one}\nright: {one}\nbaseline: 0.06\n")
        calib = {"calib": (file,)}
    source = open_from("bag", write(tmp_path / "a.bag", sent), **calib)
    assert source.camera.baseline == pytest.approx(0.06)
    wanted = grey() + np.uint8(topics.index(left))
    assert np.array_equal(next(source.frames()).read(map)[0], wanted)


def test_a_pair_without_a_baseline_names_calib(tmp_path):
    sent = {}
    for side in ("left", "right"):
        sent[f"/{side}/image_raw"] = images(grey(), "mono8")
        sent[f"/{side}/camera_info"] = [info()]
    path = write(tmp_path / "a.bag", sent)
    with pytest.raises(InputError, match=r"matrices contain no baseline.*with --calib"):
        open_from("bag", path)
    assert len(open_raw(SourceOptions(data=str(path))).sizes) == 2  # to calibrate the cameras


def test_a_camera_info_of_other_images_is_named(tmp_path):
    sent = {
        "/front/image_raw": images(grey(), "mono8", "front"),
        "/rear/camera_info": [info(frame="rear")],
    }
    path = write(tmp_path / "a.bag", sent)
    with pytest.raises(
        InputError, match=r"no camera_info .* belongs to /front/image_raw; there is"
    ):
        open_from("bag", path, sensor="mono")


@pytest.mark.parametrize(
    ("image", "frames", "infos", "wanted"),
    [
        # the namespace of ROS, also for rectified pairs, whose sides have one frame
        ("/r/image_rect", {"/l/image_rect": "l", "/r/image_rect": "l"},
         {"/l/camera_info": "l", "/r/camera_info": "l"}, "/r/camera_info"),
        ("/c/image_raw/compressed", {"/c/image_raw/compressed": "a"}, {"/c/camera_info": "b"},
         "/c/camera_info"),
        # the frame
        ("/y/raw", {"/x/raw": "a", "/y/raw": "b"}, {"/infos/1": "b", "/infos/2": "a"}, "/infos/1"),
        # the tree
        ("/d/s_0/Ir_2/image/data", {"/d/s_0/Ir_1/image/data": "0", "/d/s_0/Ir_2/image/data": "0"},
         {"/d/s_0/Ir_1/info/camera_info": "", "/d/s_0/Ir_2/info/camera_info": ""},
         "/d/s_0/Ir_2/info/camera_info"),
        ("/left_image", {"/left_image": "", "/right_image": ""},
         {"/left_info": "", "/right_info": ""}, "/left_info"),
        ("/usb/image", {"/usb/image": ""}, {"/info": ""}, "/info"),
        # none
        ("/d/Depth/image", {"/d/Depth/image": "", "/d/Color/image": ""}, {"/d/Color/info": ""},
         None),
        ("/a/image", {"/a/image": "a"}, {"/b/camera_info": "b"}, None),
        ("/a/image", {"/a/image": ""}, {}, None),
    ],
)  # fmt: skip
def test_each_image_finds_its_camera_info(image, frames, infos, wanted):
    sent = {
        topic: SimpleNamespace(header=SimpleNamespace(frame_id=f)) for topic, f in infos.items()
    }
    assert camera_info_of(image, frames, sent) == wanted


def test_a_folder_whose_metadata_name_another_encoding(tmp_path):
    pair = {LEFT: [grey(), grey() + np.uint8(1)], RIGHT: [grey() + np.uint8(2)] * 2}
    path = write_bag(tmp_path / "a", "ros2", pair, [10**8, 2 * 10**8])
    file = path / "metadata.yaml"
    text = file.read_text()
    file.write_text(text.replace("serialization_format: cdr", "serialization_format: json", 1))
    assert file.read_text() != text
    frames = list(open_bag(path).frames())
    assert np.array_equal(frames[1].read(map)[0], grey() + np.uint8(1))


def sixteen_bits(pixels: np.ndarray, encoding: str = "mono16"):
    return image(pixels.astype(np.uint16), encoding, "", 1.0)


def framed(pixels: np.ndarray) -> np.ndarray:
    pixels = pixels.copy()
    pixels[:5], pixels[:, -6:] = 0, 0
    return pixels


SMOOTH = np.add.outer(np.arange(HEIGHT), np.arange(WIDTH))


@pytest.mark.parametrize(
    ("pixels", "topic", "wanted"),
    [
        (depth(), "/a/image", True),
        (5 * depth(), "/a/image", True),
        (framed(700 + SMOOTH), "/depth/image", True),  # no depth in the sky
        (framed(7000 + 6 * SMOOTH), "/thermal/image", False),  # 14 bits, rectified
        (7000 + 6 * SMOOTH, "/depth_of_the_ocean/image", True),
        (grey().astype(np.uint16) << 8, "/a/image", False),
        (grey().astype(np.uint16) << 8, "/depth/ir", False),
        (16 * SMOOTH, "/a/image", False),
        (0 * SMOOTH, "/depth/image", None),
    ],
)
def test_depth_is_recognised_by_its_values(pixels, topic, wanted):
    assert depth_in(sixteen_bits(pixels), topic) is wanted


def test_binning_and_region_of_interest_move_the_matrices():
    """The sensor has 640x480 pixels. The images show a quarter of it, binned by two."""
    whole = {"focal": 500.0, "centre": (322.0, 244.0), "size": (640, 480), "bf": 60.0}
    region = info(**whole, binning=(2, 2), roi=(100, 120, 240, 320))
    for rectified in (False, True):
        document = camera_info(region, "a", rectified, (160, 120))
        model = read_ros([document], None).left
        assert (model.width, model.height) == (160, 120)
        assert (model.fx, model.fy, model.cx, model.cy) == (250.0, 250.0, 111.0, 62.0)
        assert document.matrix("P", 3, 4)[0, 3] == -30.0  # the same baseline
    # Images of the whole size are neither binned nor cut.
    document = camera_info(info(**whole, binning=(2, 2)), "a", False, (640, 480))
    assert read_ros([document], None).left.fx == 500.0


def test_a_binned_bag(tmp_path):
    sent = {}
    for side, bf in (("left", 0.0), ("right", 6.0)):
        whole = {"focal": 100.0, "centre": (62.0, 48.0), "size": (128, 96)}
        sent[f"/{side}/image_raw"] = images(grey(), "mono8")
        sent[f"/{side}/camera_info"] = [info(**whole, bf=bf, binning=(2, 2))]
    camera = open_from("bag", write(tmp_path / "a.bag", sent)).camera
    assert (camera.width, camera.fx, camera.cx) == (WIDTH, 50.0, 31.0)
    assert camera.baseline == pytest.approx(0.06)
