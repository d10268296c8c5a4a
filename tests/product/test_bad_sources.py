"""Sources that cannot be read are rejected with one sentence. A source that ends early is read."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from source_files import (
    LEFT,
    RIGHT,
    all_sources,
    open_from,
    run_source,
    source_path,
    write_bag,
    write_calibration,
    write_images,
    write_video,
)

from vslam.datasets import video
from vslam.datasets.frames import selected
from vslam.support.errors import InputError
from vslam.types.source_options import SourceOptions

FRAMES = 12


@pytest.fixture(scope="module")
def folder(corridor, tmp_path_factory) -> Path:
    return all_sources(tmp_path_factory.mktemp("sources"), corridor, FRAMES)


@pytest.fixture(scope="module")
def side_by_side(folder) -> SourceOptions:
    return SourceOptions(calib=(folder / "stereo.yaml",), side_by_side=True)


def refused(match: str, dataset: str, data: Path | str, options: SourceOptions, **more):
    with pytest.raises(InputError, match=match) as caught:
        open_from(dataset, data, options, **more)
    message = str(caught.value)
    assert message.endswith(".")
    assert "\n" not in message


def test_topics(folder):
    bag = folder / "ros1.bag"
    listed = "image topics are /cam0/image_raw, /cam1/image_raw"
    options = SourceOptions(topics=f"{LEFT},/cam9")
    refused(f"--topics /cam9: not in .*ros1.bag; {listed}", "bag", bag, options)
    twice = SourceOptions(topics=f"{LEFT},{LEFT}")
    refused(f"--topics {LEFT},{LEFT}: names one topic twice; {listed}", "bag", bag, twice)
    refused("or of the depth, or run with --sensor mono", "bag", bag, SourceOptions(topics=LEFT))
    refused(
        f"choose topics with --topics TOPIC; {listed}", "bag", bag, SourceOptions(), sensor="mono"
    )


def test_bags_without_what_is_needed(folder, corridor, tmp_path):
    refused("no calibration, and no camera_info", "bag", folder / "ros1.bag", SourceOptions())
    refused("no such file", "bag", tmp_path / "none.bag", SourceOptions())
    one = {LEFT: corridor.left[:2]}
    write_bag(tmp_path / "one.bag", "ros1", one, [0, 10**8])
    listed = "image topics are /cam0/image_raw; run with --sensor mono"
    refused(f"needs two image topics; {listed}", "bag", tmp_path / "one.bag", SourceOptions())
    write_bag(tmp_path / "empty.bag", "ros1", {}, [])
    refused("there are no image topics", "bag", tmp_path / "empty.bag", SourceOptions())
    write_bag(tmp_path / "unstamped.bag", "ros1", one, [0, 0])
    refused("no time stamps", "bag", tmp_path / "unstamped.bag", SourceOptions(), sensor="mono")


@pytest.mark.parametrize(
    ("flaw", "part"),
    [
        ("calibrated", "no calibration, and the camera matrix in /cam0/camera_info is 0"),
        ("baseline", "camera_info.*baseline"),
    ],
)
def test_a_useless_camera_info_is_not_read_where_there_is_a_calibration(
    folder, corridor, tmp_path, flaw, part
):
    pair = {LEFT: corridor.left[:2], RIGHT: corridor.right[:2]}
    flaws = {"camera": corridor.camera, flaw: False}
    write_bag(tmp_path / "a.bag", "ros1", pair, [0, 10**8], **flaws)
    refused(part, "bag", tmp_path / "a.bag", SourceOptions())
    options = SourceOptions(calib=(folder / "stereo.yaml",))
    source = open_from("bag", tmp_path / "a.bag", options)
    assert source.camera == corridor.camera


@pytest.mark.parametrize("realtime", [False, True])
def test_a_stream_that_ends_before_its_first_frame(folder, side_by_side, realtime):
    whole = open_from("video", folder / "pair.mkv", side_by_side)
    source = selected(replace(whole, n_expected=None), start=FRAMES)
    with pytest.raises(InputError, match=f"--start {FRAMES}: pair has no such frame"):
        run_source(source, realtime=realtime)


def test_bags_without_rosbags(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    refused(r"pip install 'vslam\[bag\]'", "bag", folder / "ros1.bag", SourceOptions())


@pytest.mark.parametrize("kind", ["ros1", "mcap", "ros2"])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.6])
def test_bags_cut_off(folder, tmp_path, kind, share):
    """A truncated bag has no index. The message says how to restore it."""
    source = source_path(folder, kind)
    source = next(source.glob("*.db3")) if source.is_dir() else source
    data = source.read_bytes()
    cut = tmp_path / source.name
    cut.write_bytes(data[: int(share * len(data))])
    refused("cut off", "bag", cut, SourceOptions(calib=(folder / "stereo.yaml",)))


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("ros1", "its index is incomplete\\); repair it with 'rosbag reindex'"),
        ("mcap", "it has no footer\\); repair it with 'mcap recover'"),
    ],
)
def test_the_end_that_a_bag_lacks(folder, tmp_path, kind, said):
    source = source_path(folder, kind)
    cut = tmp_path / source.name
    cut.write_bytes(source.read_bytes()[:-1])
    refused(rf"{cut}: the recording was cut off \({said}", "bag", cut, SourceOptions())


def test_a_folder_without_metadata(folder, tmp_path):
    refused("the folder contains no bag", "bag", tmp_path, SourceOptions())
    shutil.copytree(source_path(folder, "ros2"), tmp_path / "a")
    (tmp_path / "a" / "metadata.yaml").unlink()
    shutil.copy(next((tmp_path / "a").glob("*.db3")), tmp_path / "a" / "a_1.db3")
    refused("no metadata.yaml, .* 'ros2 bag reindex'", "bag", tmp_path / "a", SourceOptions())


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.bag", b"<html>not found</html>", "not a bag, because it does not begin like"),
        ("a.mcap", b"#ROSBAG V2.0\n" + b"a" * 99, "not a bag, because it does not begin like"),
        ("a.db3", b"a" * 99, "not a bag, because it does not begin like"),
        ("a.bag", b"#ROSBAG V1.2\n" + b"a" * 99, "Bag version 102 is not supported.*convert it"),
        ("a.mcap", b"\x89MCAP0\r\n" * 9, "cannot be read as a bag .*copy it again if it was"),
    ],
)
def test_a_file_that_is_whole_is_not_said_to_be_cut_off(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    refused(said, "bag", tmp_path / name, SourceOptions())
    with pytest.raises(InputError) as caught:
        open_from("bag", tmp_path / name)
    assert "cut off" not in str(caught.value)


def test_a_bag_damaged_in_the_middle_keeps_the_frames_before(folder, tmp_path):
    shutil.copytree(folder / "bag", tmp_path / "bag")
    file = next((tmp_path / "bag").glob("*.mcap"))
    data = bytearray(file.read_bytes())
    middle = int(len(data) * 0.6)
    data[middle : middle + len(data) // 10] = b"\xff" * (len(data) // 10)
    file.write_bytes(data)
    outcome = run_source(open_from("bag", tmp_path / "bag", SourceOptions()))
    assert 0 < len(outcome.trajectory) < FRAMES
    assert "damaged or cut off" in outcome.interrupted


def test_an_image_of_another_size_is_one_lost_frame(corridor, tmp_path):
    images = [*corridor.left[:2], corridor.left[2][:80], *corridor.left[3:5]]
    write_bag(tmp_path / "a.bag", "ros1", {LEFT: images}, [k * 10**8 for k in range(5)])
    options = SourceOptions(calib=(write_calibration(tmp_path / "c.yaml", corridor.camera),))
    outcome = run_source(open_from("bag", tmp_path / "a.bag", options, sensor="mono"))
    assert len(outcome.tracks) == 5
    assert len(outcome.skipped) == 1
    assert "480x80 pixels but the first image has 480x160" in outcome.skipped[0]


def test_calibrations(folder):
    path = folder / "pair.mkv"

    def options(name):
        return SourceOptions(calib=(folder / name,), side_by_side=True)

    sizes = "made for 240x80 pixels but the images have 480x160"
    refused(f"other.yaml: {sizes}", "video", path, options("other.yaml"))
    wide = "made for 480x160 pixels but the images have 960x160; use --side-by-side"
    refused(wide, "video", path, SourceOptions(calib=(folder / "mono.yaml",)), sensor="mono")
    refused(sizes, "images", folder / "images", SourceOptions(calib=(folder / "other.yaml",)))
    refused("right camera is missing", "video", path, options("mono.yaml"))
    refused(
        "no calibration; .*docs/howto/cameras.md", "video", path, SourceOptions(side_by_side=True)
    )


@pytest.mark.parametrize(("rows", "what"), [(0, "column"), (1, "column and row")])
def test_an_encoder_that_cuts_off_a_column_is_named(corridor, tmp_path, rows, what):
    """OpenCV's encoder cuts off a column of images with odd sizes."""
    images = [np.pad(image, ((0, rows), (0, 1))) for image in corridor.left[:3]]
    path = write_video(tmp_path / "a.mkv", images)
    camera = replace(corridor.camera, width=481, height=160 + rows)
    options = SourceOptions(calib=(write_calibration(tmp_path / "c.yaml", camera),))
    said = f"images have 480x160; an encoder seems to have cut off the last {what}; write this size"
    refused(said, "video", path, options, sensor="mono")


def test_a_rate_that_contradicts_the_video_is_said(folder, side_by_side, caplog):
    given = {"data": folder / "pair.mkv", "options": side_by_side}
    open_from("video", **given, fps=10.0)
    assert not caplog.messages
    open_from("video", **given, fps=25.0)
    (said,) = caplog.messages
    assert said == (
        f"{folder / 'pair.mkv'}: --fps 25 contradicts the video's own 10 frames per second;"
        " leave the option out unless the video is wrong."
    )


def test_videos(folder, tmp_path, side_by_side):
    path = folder / "pair.mkv"
    refused("--side-by-side .* or run with --sensor mono", "video", path, SourceOptions())
    refused("no such file", "video", tmp_path / "none.mp4", side_by_side)
    (tmp_path / "text.mp4").write_text("this is no video")
    refused("in a codec unknown to OpenCV", "video", tmp_path / "text.mp4",
            side_by_side)  # fmt: skip


def test_a_codec_that_nobody_knows(folder, tmp_path, side_by_side):
    data = (folder / "pair.mkv").read_bytes()
    assert b"FFV1" in data
    (tmp_path / "odd.mkv").write_bytes(data.replace(b"FFV1", b"QQQQ"))
    refused("codec|no image that can be decoded", "video", tmp_path / "odd.mkv", side_by_side)


def test_a_video_cut_off_keeps_the_frames_before(folder, tmp_path, side_by_side):
    data = (folder / "pair.mkv").read_bytes()
    (tmp_path / "cut.mkv").write_bytes(data[: int(0.6 * len(data))])
    outcome = run_source(open_from("video", tmp_path / "cut.mkv", side_by_side))
    assert 4 <= len(outcome.trajectory) <= 8
    assert "the video ends after" in outcome.interrupted
    assert not outcome.interrupted.endswith(".")


def test_a_video_without_time_stamps(folder, monkeypatch, side_by_side):
    def unstamped(path):
        capture = cv2.VideoCapture(path)
        return SimpleNamespace(
            grab=capture.grab,
            retrieve=capture.retrieve,
            release=capture.release,
            get=lambda key: 0.0 if key == cv2.CAP_PROP_POS_MSEC else capture.get(key),
        )

    monkeypatch.setattr(video, "open_capture", unstamped)
    path = folder / "pair.mkv"
    refused("no time stamps; give --fps", "video", path, side_by_side)
    options = SourceOptions(calib=side_by_side.calib, side_by_side=True, fps=10.0)
    assert len(list(open_from("video", path, options).frames())) == FRAMES


def test_folders_of_images(folder, corridor, tmp_path):
    options = SourceOptions(calib=(folder / "stereo.yaml",))
    write_images(tmp_path, {"left": corridor.left[:3]}, ["0.png", "1.png", "2.png"])
    refused("left and right, image_0 and image_1", "images", tmp_path, options)
    refused("but only left has images, right has none", "images", tmp_path, options)
    write_images(tmp_path, {"right": corridor.right[:2]}, ["a.png", "b.png"])
    refused("names of its 2 images and of the 3 images in .* do not tell which", "images", tmp_path,
            options)  # fmt: skip
    for name in ("a", "b"):
        (tmp_path / f"right/{name}.png").unlink()
    write_images(tmp_path, {"right": corridor.right[:3]}, ["0.png", "1.png", "2.png"])
    refused("no time stamps .* give --fps", "images", tmp_path, options)
    times = tmp_path / "times.txt"
    times.write_text("0.0\n0.1\n")
    refused("times.txt: 2 times for 3 images", "images", tmp_path, options)
    times.write_text("0\n1\n2\n")
    refused("0, 1, 2, ... look like the numbers of frames, .* --fps", "images", tmp_path, options)
    times.write_text("0.0\n0.2\n0.1\n")
    refused("1 of 3 times are not later .*time 3 .* give --fps", "images", tmp_path, options)
    refused("no such folder", "images", tmp_path / "none", options)
    refused(f"but {tmp_path} has both .give it", "images", tmp_path / "left", options)
    (tmp_path / "calib.txt").write_text("P0: 1")
    refused("sequence of KITTI; .* --seq", "images", tmp_path, SourceOptions(fps=10.0))
    options = SourceOptions(calib=(folder / "stereo.yaml",), right=tmp_path)
    refused("no images in this folder", "images", tmp_path / "left", options)
    (tmp_path / "left/2.jpg").touch()
    same = r"2.png: 2.jpg in this folder has the same name but for the suffix; remove one"
    refused(same, "images", tmp_path, SourceOptions(calib=(folder / "stereo.yaml",)))


def test_cameras(tmp_path, monkeypatch, side_by_side):
    refused("camera 77: no such device", "camera", "77", side_by_side)
    url = "http://me:word@127.0.0.1:9/a"
    refused("camera 127.0.0.1/a: cannot be opened", "camera", url, side_by_side)
    refused("--side-by-side .* or run with --sensor mono", "camera", "77", SourceOptions())
    (tmp_path / "video77").touch()
    monkeypatch.setattr(video, "_DEVICES", tmp_path)
    refused("the device is busy or not a camera; close other", "camera", "77", side_by_side)
    refused("no such device; there are 77", "camera", "76", side_by_side)


@pytest.mark.parametrize(
    ("dataset", "options", "part"),
    [
        ("kitti", {"topics": "/a"}, "--topics: only for --dataset bag, not kitti"),
        ("bag", {"fps": 10.0}, "--fps: only for --dataset images or video"),
        ("images", {"side_by_side": True}, "--side-by-side: only for --dataset video or camera"),
        ("video", {"right": Path("r")}, "--right: only for --dataset images"),
    ],
)
def test_options_of_other_sources(dataset, options, part):
    refused(part, dataset, "nowhere", SourceOptions(**options))


def test_options_of_a_second_image_with_the_left_camera_alone():
    nowhere, scale = SourceOptions(right=Path("r")), SourceOptions(depth_scale=1000.0)
    refused("--right: contradicts --sensor mono", "images", "nowhere", nowhere, sensor="mono")
    refused("--depth-scale: contradicts --sensor", "tum", "nowhere", scale, sensor="mono")


def test_another_sensor(folder, kitti_tree):
    options = SourceOptions(calib=(folder / "stereo.yaml",))
    images = folder / "images"
    refused("rgb and depth, .* with --depth", "images", images, options, sensor="rgbd")
    refused("rgbd needs an image topic and one of depth; image topics are /cam0", "bag",
            folder / "ros1.bag", options, sensor="rgbd")  # fmt: skip
    with pytest.raises(InputError, match="--sensor rgbd: 00 has the sensor stereo"):
        open_from("kitti", kitti_tree, SourceOptions(), sensor="rgbd")


@pytest.mark.parametrize("dataset", ["images", "video", "bag", "camera"])
def test_only_data_sets_have_sequences(dataset):
    with pytest.raises(InputError, match=f"--seq 05: only for data sets, not {dataset}; leave it"):
        open_from(dataset, "nowhere", seq="05")
