"""Folders, videos, bags and cameras: the same frames give the same run from every source."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import weakref
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
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
from test_security import png
from typer.testing import CliRunner

from vslam.cli.main import every_command
from vslam.datasets import open_sequence
from vslam.datasets.bag_messages import grey_of
from vslam.datasets.detection import detect_dataset
from vslam.datasets.frames import Source, TimedFrame, selected
from vslam.datasets.image_folders import open_images
from vslam.datasets.perturbation import parse_perturbation
from vslam.report.folder import create_run_folder
from vslam.run.options import RunOptions
from vslam.run.outcome import RunOutcome
from vslam.run.pipeline import run_sequence
from vslam.run.recorder import Recorder
from vslam.run.slam_run import begin
from vslam.support.errors import InputError
from vslam.types.camera import Camera
from vslam.types.features import TrackingState
from vslam.types.source_options import SourceOptions
from vslam_lab.towns.layouts import write_side_by_side

FRAMES = 12
STAMPS = [k * 10**8 for k in range(FRAMES)]
KINDS = ("images", "video", "ros1", "ros2", "mcap", "folder")


@pytest.fixture(scope="module")
def folder(corridor, tmp_path_factory) -> Path:
    return all_sources(tmp_path_factory.mktemp("sources"), corridor, FRAMES)


def opened(folder: Path, kind: str, **options):
    path = str(source_path(folder, kind))
    dataset = detect_dataset(path)
    assert dataset == (kind if kind in ("images", "video") else "bag")
    given = () if kind == "folder" else (folder / "stereo.yaml",)
    topics = f"{LEFT},{RIGHT}" if kind == "ros1" else ""
    chosen = SourceOptions(calib=given, side_by_side=dataset == "video", topics=topics)
    return open_from(dataset, path, chosen, **options)


@pytest.fixture(scope="module")
def expected(kitti_tree) -> RunOutcome:
    return run_source(
        open_sequence("kitti", kitti_tree, "00", max_frames=FRAMES), perturb="brightness"
    )


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_pixels_give_the_same_trajectory(folder, corridor, expected, kind):
    source = opened(folder, kind)
    assert source.camera == expected.sequence.camera
    assert source.n_expected == FRAMES
    for k, frame in enumerate(source.frames()):
        left, right = frame.read(map)
        assert np.array_equal(left, corridor.left[k])
        assert np.array_equal(right, corridor.right[k])
    outcome = run_source(source, perturb="brightness", threads=1 if kind == "video" else 2)
    assert not outcome.skipped
    assert outcome.interrupted is None
    assert {track.state for track in outcome.tracks} == {TrackingState.OK}
    assert outcome.trajectory.timestamps.tobytes() == expected.trajectory.timestamps.tobytes()
    assert outcome.trajectory.T_wc.tobytes() == expected.trajectory.T_wc.tobytes()


@pytest.mark.parametrize("kind", ["images", "video", "ros1"])
def test_selected_frames(folder, corridor, kind):
    source = opened(folder, kind, start=2, every=3, max_frames=3)
    assert source.n_expected == 3
    frames = list(source.frames())
    np.testing.assert_allclose([frame.timestamp for frame in frames], [0.2, 0.5, 0.8])
    for frame, k in zip(frames, (2, 5, 8), strict=True):
        assert np.array_equal(frame.read(map)[0], corridor.left[k])
    with pytest.raises(InputError, match="--start 12"):
        opened(folder, kind, start=12)


@pytest.mark.parametrize("kind", ["images", "video", "ros1"])
def test_the_left_camera_alone(folder, corridor, kind):
    source = opened(folder, kind, sensor="mono")
    assert source.camera.monocular
    left, right = next(source.frames()).read(map)
    assert np.array_equal(left, corridor.left[0])
    assert right is None


def test_a_video_that_loses_stays_close(corridor, tmp_path):
    beside = [np.hstack(pair) for pair in zip(corridor.left, corridor.right, strict=True)][:3]
    write_video(tmp_path / "pair.avi", beside, codec="MJPG")
    calib = write_calibration(tmp_path / "calib.yaml", corridor.camera)
    options = SourceOptions(calib=(calib,), side_by_side=True)
    source = open_from("video", tmp_path / "pair.avi", options)
    for k, frame in enumerate(source.frames()):
        error = np.subtract(frame.read(map)[1], corridor.right[k], dtype=float)
        assert np.abs(error).mean() < 4.0


def test_a_run_whose_clock_was_set_back_uses_and_counts_every_frame(folder):
    files = opened(folder, "images")

    def play():
        for k, frame in enumerate(files.stored):
            yield replace(frame, timestamp=frame.timestamp - 30.0 * (k >= 6))
            if k == 3:
                yield frame

    source = selected(replace(files, stored=(), play=play, timing=None))
    outcome = run_source(source)
    assert [track.state for track in outcome.tracks] == [TrackingState.OK] * FRAMES
    np.testing.assert_allclose(outcome.trajectory.timestamps, files.timestamps, atol=1e-9)
    assert outcome.n_left_out == 1
    (said,) = (warning for warning in outcome.warnings if "images" in warning)
    assert "1 frame left out (1 with the time of the frame before), the first after 0.300 s" in said
    assert "the clock was set back by 30 s after 0.500 s" in said


@pytest.mark.slow
def test_a_bag_in_real_time_has_every_frame(folder):
    outcome = run_source(opened(folder, "ros1"), realtime=True)
    assert len(outcome.tracks) == FRAMES
    np.testing.assert_allclose(outcome.trajectory.timestamps, np.array(STAMPS) / 1e9)


@pytest.mark.parametrize("kind", ["images", "video", "bgr8", "rgb8", "png"])
def test_colours(corridor, tmp_path, kind):
    tinted = [np.dstack([image, image // 2, 255 - image]) for image in corridor.left[:3]]
    calib = write_calibration(tmp_path / "left.yaml", corridor.camera, mono=True)
    options = SourceOptions(calib=(calib,), sensor="mono")
    if kind == "images":
        data = write_images(tmp_path, {"left": tinted}, ["0.1.png", "0.2.png", "0.3.png"]) / "left"
    elif kind == "video":
        data = write_video(tmp_path / "a.mkv", tinted)
    else:
        stamps = [k * 10**8 for k in range(1, 4)]
        data = write_bag(tmp_path / "a.bag", "ros1", {LEFT: tinted}, stamps, encoding=kind)
    source = open_from({"images": "images", "video": "video"}.get(kind, "bag"), data, options)
    for frame, image in zip(source.frames(), tinted, strict=True):
        assert np.array_equal(frame.colour(), image[..., ::-1])
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        assert np.abs(frame.read(map)[0].astype(int) - grey).max() <= 1


def test_a_grey_video_has_no_colours(folder, corridor):
    frame = next(opened(folder, "video").frames())
    assert np.array_equal(frame.colour(), corridor.left[0])


def test_images_without_a_partner_in_time_are_left_out(corridor, tmp_path):
    pair = {LEFT: corridor.left[:4], RIGHT: corridor.right[:4]}
    write_bag(tmp_path / "lag.bag", "ros1", pair, STAMPS[:4], lag=6_000_000, camera=corridor.camera)
    with pytest.raises(InputError, match=r"no images of .* have the same time"):
        open_from("bag", tmp_path / "lag.bag")


def test_a_bag_with_a_rectified_topic_uses_its_projection_matrix(corridor, tmp_path):
    pair = {"/a/image_rect": corridor.left[:2], "/b/image_rect": corridor.right[:2]}
    write_bag(tmp_path / "b.bag", "ros1", pair, STAMPS[:2], camera=corridor.camera)
    assert open_from("bag", tmp_path / "b.bag").camera == corridor.camera


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_are_told_apart(pattern):
    """A red surface is dark grey in every order of the filters. A blue surface is darker."""
    for colour, grey in (("r", 0.299), ("g", 0.587), ("b", 0.114)):
        tile = np.array([200 if c == colour else 0 for c in pattern], np.uint8).reshape(2, 2)
        pixels = np.tile(tile, (8, 8))
        message = SimpleNamespace(
            encoding=f"bayer_{pattern}8", width=16, height=16, step=16, is_bigendian=0,
            data=pixels.ravel(),
        )  # fmt: skip
        assert grey_of(message)[4:12, 4:12].mean() == pytest.approx(200 * grey, abs=2)


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (
            ["1403636579763555584.png", "1403636579813555456.png"],
            [1403636579.763555584, 0.049999872],
        ),
        (["1403636579763555.png", "1403636579813555.png"], [1403636579.763555, 0.05]),
        (["1403636579.5.png", "1403636580.25.png"], [1403636579.5, 0.75]),
        (["0.5.png", "12.5.png"], [0.5, 12.0]),
    ],
)
def test_times_in_names(corridor, tmp_path, names, times):
    write_images(tmp_path, {"cam0": corridor.left[:2]}, names)
    calib = write_calibration(tmp_path / "c.yaml", corridor.camera)
    found = open_from("images", tmp_path, SourceOptions(calib=(calib,)), sensor="mono")
    assert found.timestamps[0] == pytest.approx(times[0], abs=1e-6)
    assert np.diff(found.timestamps)[0] == pytest.approx(times[1], abs=1e-6)


def test_names_that_may_be_numbers_need_a_rate(corridor, tmp_path):
    write_images(tmp_path, {"": corridor.left[:3]}, ["312000.png", "312104.png", "312208.png"])
    said = "names that may be the numbers of frames.; give --fps, 9.62 if the names are millisec"
    with pytest.raises(InputError, match=said):
        open_images(tmp_path, sensor="mono")


@pytest.mark.parametrize(
    "names",
    [
        ["1403636102.1753", "1403636102.2", "1403636102.25", "1403636102.31"],
        ["a2", "a10", "b1", "b2"],
        ["9", "10", "99", "100"],
        ["left_9_x", "left_10_a", "left_10_b", "left_11"],
    ],
)
def test_images_come_in_the_order_of_times_or_numbers(corridor, tmp_path, names):
    write_images(tmp_path, {"": corridor.left[:4]}, [f"{name}.png" for name in names])
    found = open_images(tmp_path, fps=10.0, sensor="mono")
    assert [path.stem for path in found.sides[0]] == names


def test_sides_without_a_common_name_belong_together_by_order(corridor, tmp_path):
    write_images(tmp_path, {"left": corridor.left[:3]}, ["l8.png", "l9.png", "l10.png"])
    write_images(tmp_path, {"right": corridor.right[:3]}, ["r8.png", "r9.png", "r10.png"])
    found = open_images(tmp_path, fps=10.0)
    assert [path.stem for path in found.sides[0]] == ["l8", "l9", "l10"]
    assert [path.stem for path in found.sides[1]] == ["r8", "r9", "r10"]


def test_times_in_exif(corridor, tmp_path):
    from PIL import Image

    for k, subsec in enumerate(("25", "750")):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x9003: "2024:05:17 10:20:30", 0x9291: subsec})
        Image.fromarray(corridor.left[k]).save(tmp_path / f"IMG_{k}.jpg", exif=exif)
    calib = write_calibration(tmp_path / "c.yaml", corridor.camera)
    found = open_from("images", tmp_path, SourceOptions(calib=(calib,)), sensor="mono")
    assert np.diff(found.timestamps)[0] == pytest.approx(0.5, abs=1e-6)


def test_an_image_too_large_for_pillow_has_no_time_in_exif(tmp_path):
    """Above 179 million pixels, Pillow raises its own error, even if only EXIF data are read."""
    for k in range(2):
        (tmp_path / f"IMG_{k}.png").write_bytes(png(20_000, 20_000))
    calib = write_calibration(tmp_path / "c.yaml", Camera(60.0, 60.0, 31.5, 23.5, 0.2, 64, 48))
    with pytest.raises(InputError, match="no time stamps"):
        open_from("images", tmp_path, SourceOptions(calib=(calib,)), sensor="mono")


@pytest.mark.parametrize(
    "dates",
    [
        ["2011-09-26 13:02:25.250000123", "2011-09-26 13:02:25.350000000"],
        ["2011-09-26T13:02:25.25Z", "2011-09-26T13:02:25.35Z"],
        ["2011-09-26T15:02:25.250+02:00", "2011-09-26T15:02:25.350+02:00"],
    ],
)
def test_lists_of_dates(corridor, tmp_path, dates):
    write_images(tmp_path, {"a/data": corridor.left[:2]}, ["0.png", "1.png"])
    (tmp_path / "a/timestamps.txt").write_text("".join(f"{date}\n" for date in dates))
    options = SourceOptions(calib=(write_calibration(tmp_path / "c.yaml", corridor.camera),))
    source = open_from("images", tmp_path / "a/data", options, sensor="mono")
    np.testing.assert_allclose(source.timestamps - 1317042145.25, [0.0, 0.1], atol=2e-6)


def test_frames_a_second_come_before_all_other_times(folder):
    options = SourceOptions(calib=(folder / "stereo.yaml",), fps=4.0)
    source = open_from("images", folder / "images", options)
    np.testing.assert_allclose(source.timestamps, np.arange(FRAMES) / 4)
    options = SourceOptions(calib=(folder / "stereo.yaml",), fps=4.0, side_by_side=True)
    source = open_from("video", folder / "pair.mkv", options)
    times = [frame.timestamp for frame in source.frames()]
    np.testing.assert_allclose(times, np.arange(FRAMES) / 4)


@pytest.fixture
def served(folder):
    """The video at a URL."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    handler = partial(Quiet, directory=str(folder))
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/pair.mkv"
    server.shutdown()
    thread.join()
    server.server_close()


def test_a_camera_at_a_url(folder, served):
    options = SourceOptions(calib=(folder / "stereo.yaml",), side_by_side=True)
    source = open_from("camera", served, options)
    assert (source.dataset, source.name) == ("camera", "127.0.0.1/pair.mkv")
    assert source.live
    assert source.n_expected is None
    outcome = run_source(source, realtime=True)
    assert len(outcome.tracks) == FRAMES - 1  # the first image was used to find the image size
    assert "stopped after 11 images" in outcome.interrupted
    assert np.all(np.diff(outcome.trajectory.timestamps) > 0)
    assert abs(outcome.trajectory.timestamps[0] - time.monotonic()) < 60.0


class FakeCamera:
    """A camera that delivers frames without end."""

    images: list[np.ndarray]

    def __init__(self, *_):
        self.n = 0

    def isOpened(self):
        return True

    def read(self):
        time.sleep(0.005)
        self.n += 1
        return True, self.images[self.n % len(self.images)].copy()

    def release(self):
        pass


def test_colours_of_a_live_camera(corridor, tmp_path, monkeypatch):
    image = corridor.left[0]
    tinted = np.dstack([image, image // 2, 255 - image])
    FakeCamera.images = [tinted]
    monkeypatch.setattr(cv2, "VideoCapture", FakeCamera)
    calib = write_calibration(tmp_path / "left.yaml", corridor.camera, mono=True)
    source = open_from("camera", "0", SourceOptions(calib=(calib,), sensor="mono"))
    assert np.array_equal(next(source.frames()).colour(), tinted[..., ::-1])


def test_ctrl_c_is_the_regular_end_of_a_camera(folder, corridor, monkeypatch):
    FakeCamera.images = [np.hstack(p) for p in zip(corridor.left, corridor.right, strict=True)]
    monkeypatch.setattr(cv2, "VideoCapture", FakeCamera)
    options = SourceOptions(calib=(folder / "stereo.yaml",), side_by_side=True)
    source = open_from("camera", "0", options)
    settings = RunOptions(detector="none", threads=2, realtime=True)

    def on_frame(result):
        if result.index == 30:
            signal.raise_signal(signal.SIGINT)

    law = parse_perturbation("brightness", 0)
    outcome = run_sequence(begin(source, settings), law, Recorder(), on_frame=on_frame)
    assert outcome.interrupted is None
    assert len(outcome.trajectory) == len(outcome.tracks) >= 31
    assert TrackingState.DROPPED in {track.state for track in outcome.tracks}


@pytest.mark.slow
def test_command_line_finds_out_what_it_is_given(folder, tmp_path):
    calib = str(folder / "stereo.yaml")
    words = ["--data", str(folder / "pair.mkv"), "--side-by-side", "--calib", calib, "--no-record"]
    done = subprocess.run(
        [sys.executable, "-m", "vslam", "run", *words, "--detector", "none"],
        cwd=tmp_path, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert re.search(f"Lost frames +0 +of {FRAMES}", done.stdout)
    run_folder = (tmp_path / "runs" / "latest").resolve()
    assert run_folder.name.endswith("-video-pair-none-none")
    report = json.loads((run_folder / "report.json").read_text())
    assert (report["dataset"], report["sequence"], report["frames"]) == ("video", "pair", FRAMES)
    assert (run_folder / "report.html").exists()


def test_a_contact_sheet_of_a_video(folder, tmp_path):
    words = ["perturb", folder / "pair.mkv", "--side-by-side", "--calib", folder / "stereo.yaml"]
    words += ["--perturb", "blur", "--frames", "2", "--start", "3", "--out", tmp_path / "a.png"]
    done = CliRunner().invoke(every_command(), list(map(str, words)), catch_exceptions=False)
    assert f"frames 3, {FRAMES - 1}" in done.output
    assert cv2.imread(str(tmp_path / "a.png")).shape == (2 * (160 + 30), 4 * (480 + 8), 3)


@pytest.mark.slow
def test_a_stress_test_of_a_video(folder, tmp_path):
    """Perturbations that need later frames are left out."""
    words = ["stress", folder / "pair.mkv", "--side-by-side", "--calib", folder / "stereo.yaml"]
    words += ["--laws", "bias,desync", "--detectors", "none", "--seeds", "1", "--steps", "1"]
    words += ["--max-frames", "8", "--out", tmp_path / "stress"]
    done = CliRunner().invoke(every_command(), list(map(str, words)), catch_exceptions=False)
    assert "finished 1 of 1 searches" in done.output
    report = json.loads((tmp_path / "stress" / "stress.json").read_text())
    assert [(b["sequence"], b["law"]) for b in report["boundaries"]] == [("pair", "bias")]
    assert "desync: needs the next frame" in report["notes"][0]


def test_other_systems_are_not_tested_on_videos(folder, tmp_path):
    words = ["stress", folder / "pair.mkv", "--side-by-side", "--calib", folder / "stereo.yaml"]
    words += ["--systems", "mine", "--system", "mine=mine {folder} {out}", "--out", tmp_path / "a"]
    done = CliRunner().invoke(every_command(), list(map(str, words)))
    assert "--systems mine: other systems read KITTI's format" in str(done.exception)


def test_a_sequence_written_side_by_side_comes_back(kitti_tree, tmp_path):
    sequence = open_sequence("kitti", kitti_tree, "00", max_frames=5)
    calib = write_side_by_side(sequence, tmp_path / "new" / "town.mkv")
    assert calib == tmp_path / "new" / "town.yaml"
    options = SourceOptions(calib=(calib,), side_by_side=True)
    source = open_from("video", tmp_path / "new" / "town.mkv", options)
    assert source.camera == sequence.camera
    frames = list(source.frames())
    assert [frame.timestamp for frame in frames] == sequence.timestamps.tolist()
    for index, frame in enumerate(frames):
        assert all(map(np.array_equal, frame.read(map), sequence.read(index)))
    with pytest.raises(InputError, match="cannot be written as a video"):
        write_side_by_side(sequence, tmp_path / "town.odd")


class There:
    """The corridor forwards and backwards as a stream. Images in memory are counted."""

    def __init__(self, corridor):
        self.corridor = corridor
        self.alive, self.most = 0, 0

    def frames(self):
        for k, index in enumerate([*range(28), *range(26, 0, -1)] * 2):
            left, right = (side[index].copy() for side in (self.corridor.left, self.corridor.right))
            self.alive += 1
            weakref.finalize(left, self.gone)
            self.most = max(self.most, self.alive)
            yield TimedFrame(0.1 * k, lambda image_map, left=left, right=right: (left, right))

    def gone(self):
        self.alive -= 1


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_images_of_a_stream_are_let_go(corridor, threads):
    there = There(corridor)
    source = Source(dataset="video", name="there", camera=corridor.camera, play=there.frames)
    outcome = run_source(source, threads=threads)
    assert len(outcome.tracks) == 108
    assert there.most <= 2 * threads + 4


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="other systems always have a display")
def test_a_viewer_is_refused_before_the_run(folder, tmp_path):
    calib = str(folder / "stereo.yaml")
    words = ["--data", str(folder / "pair.mkv"), "--side-by-side", "--calib", calib]
    environment = {k: v for k, v in os.environ.items() if "DISPLAY" not in k}
    done = subprocess.run(
        [sys.executable, "-m", "vslam", "run", *words, "--view", "native"],
        cwd=tmp_path, capture_output=True, text=True, timeout=300, env=environment,
    )  # fmt: skip
    assert done.returncode == 2
    assert "there is no display here; use --view web" in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_run_of_a_url_has_a_folder_with_a_plain_name(tmp_path):
    name = "camera.local/live/" + 100 * "stream"
    folder = create_run_folder(tmp_path, "camera", name, "none", "bow")
    assert folder.parent == tmp_path
    assert "camera-camera.local_live_stream" in folder.name
    assert len(folder.name) < 120


@pytest.mark.slow
def test_swapped_sides_are_refused_with_the_way_to_swap_them(folder, tmp_path):
    left, right = (folder / "images" / side for side in ("left", "right"))
    words = [
        "run", str(right), "--right", str(left), "--calib", str(folder / "stereo.yaml"),
        "--fps", "10", "--detector", "none", "--no-record",
    ]  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-m", "vslam", *words],
        cwd=tmp_path, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 2
    said = " ".join(done.stderr.split())
    assert "Left and right are swapped: disparities are negative" in said
    assert f"--data {left} --right {right}" in said


def test_swapped_topics_of_a_bag_are_named(corridor, tmp_path):
    pair = {"/a/image_rect": corridor.left[:2], "/b/image_rect": corridor.right[:2]}
    write_bag(tmp_path / "b.bag", "ros1", pair, STAMPS[:2], camera=corridor.camera)
    with pytest.raises(InputError, match=r"the sides seem swapped.*--topics"):
        open_from("bag", tmp_path / "b.bag", SourceOptions(topics="/b/image_rect,/a/image_rect"),
        )  # fmt: skip
