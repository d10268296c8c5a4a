"""Folders, videos, bags and cameras: the same frames give the same run, whatever holds them."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
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
    run_source,
    source_path,
    write_bag,
    write_calibration,
    write_images,
    write_video,
)

from vslam.config import Config
from vslam.datasets import open_sequence
from vslam.datasets.bag_messages import grey_of
from vslam.datasets.detection import detect_dataset
from vslam.datasets.perturbation import parse_perturbation
from vslam.datasets.sources import SourceOptions, open_source
from vslam.datasets.stream import count_expected, timed_frames
from vslam.errors import InputError
from vslam.features import TrackingState
from vslam.run.outcome import RunOutcome, RunSettings
from vslam.run.pipeline import run_sequence
from vslam.run.recorder import NullRecorder

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
    topics = (LEFT, RIGHT) if kind == "ros1" else ()
    chosen = SourceOptions(given, side_by_side=dataset == "video", topics=topics)
    return open_source(dataset, path, "00", chosen, **options)


@pytest.fixture(scope="module")
def expected(kitti_tree) -> RunOutcome:
    return run_source(
        open_sequence("kitti", kitti_tree, "00", max_frames=FRAMES), perturb="brightness"
    )


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_pixels_give_the_same_trajectory(folder, corridor, expected, kind):
    source = opened(folder, kind)
    assert source.camera == expected.sequence.camera
    assert count_expected(source) == FRAMES
    for k, frame in enumerate(timed_frames(source)):
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
    assert count_expected(source) == 3
    frames = list(timed_frames(source))
    np.testing.assert_allclose([frame.timestamp for frame in frames], [0.2, 0.5, 0.8])
    for frame, k in zip(frames, (2, 5, 8), strict=True):
        assert np.array_equal(frame.read(map)[0], corridor.left[k])
    with pytest.raises(InputError, match="--start 12"):
        opened(folder, kind, start=12)


@pytest.mark.parametrize("kind", ["images", "video", "ros1"])
def test_the_left_camera_alone(folder, corridor, kind):
    source = opened(folder, kind, monocular=True)
    assert source.camera.monocular
    left, right = next(timed_frames(source)).read(map)
    assert np.array_equal(left, corridor.left[0])
    assert right is None


def test_a_video_that_loses_stays_close(corridor, tmp_path):
    beside = [np.hstack(pair) for pair in zip(corridor.left, corridor.right, strict=True)][:3]
    write_video(tmp_path / "pair.avi", beside, codec="MJPG")
    calib = write_calibration(tmp_path / "calib.yaml", corridor.camera)
    options = SourceOptions((calib,), side_by_side=True)
    source = open_source("video", str(tmp_path / "pair.avi"), "", options)
    for k, frame in enumerate(timed_frames(source)):
        error = np.subtract(frame.read(map)[1], corridor.right[k], dtype=float)
        assert np.abs(error).mean() < 4.0


def test_a_bag_in_real_time_has_every_frame(folder):
    outcome = run_source(opened(folder, "ros1"), realtime=True)
    assert len(outcome.tracks) == FRAMES
    np.testing.assert_allclose(outcome.trajectory.timestamps, np.array(STAMPS) / 1e9)


def test_images_without_a_partner_in_time_are_left_out(corridor, tmp_path):
    pair = {LEFT: corridor.left[:4], RIGHT: corridor.right[:4]}
    write_bag(tmp_path / "lag.bag", "ros1", pair, STAMPS[:4], lag=6_000_000, camera=corridor.camera)
    with pytest.raises(InputError, match="no images of one time"):
        open_source("bag", str(tmp_path / "lag.bag"), "", SourceOptions())


def test_a_bag_with_a_rectified_topic_uses_its_projection_matrix(corridor, tmp_path):
    pair = {"/a/image_rect": corridor.left[:2], "/b/image_rect": corridor.right[:2]}
    write_bag(tmp_path / "b.bag", "ros1", pair, STAMPS[:2], camera=corridor.camera)
    assert (
        open_source("bag", str(tmp_path / "b.bag"), "", SourceOptions()).camera == corridor.camera
    )


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_are_told_apart(pattern):
    """A red surface is dark grey, whatever the order of the filters; blue is darker."""
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
    found = open_source("images", str(tmp_path), "", SourceOptions((calib,)), monocular=True)
    assert found.timestamps[0] == pytest.approx(times[0], abs=1e-6)
    assert np.diff(found.timestamps)[0] == pytest.approx(times[1], abs=1e-6)


def test_times_in_exif(corridor, tmp_path):
    from PIL import Image

    for k, subsec in enumerate(("25", "750")):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x9003: "2024:05:17 10:20:30", 0x9291: subsec})
        Image.fromarray(corridor.left[k]).save(tmp_path / f"IMG_{k}.jpg", exif=exif)
    calib = write_calibration(tmp_path / "c.yaml", corridor.camera)
    found = open_source("images", str(tmp_path), "", SourceOptions((calib,)), monocular=True)
    assert np.diff(found.timestamps)[0] == pytest.approx(0.5, abs=1e-6)


def test_frames_a_second_come_before_all_other_times(folder):
    options = SourceOptions((folder / "stereo.yaml",), fps=4.0)
    source = open_source("images", str(folder / "images"), "", options)
    np.testing.assert_allclose(source.timestamps, np.arange(FRAMES) / 4)
    options = SourceOptions((folder / "stereo.yaml",), fps=4.0, side_by_side=True)
    source = open_source("video", str(folder / "pair.mkv"), "", options)
    times = [frame.timestamp for frame in timed_frames(source)]
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
    options = SourceOptions((folder / "stereo.yaml",), side_by_side=True)
    source = open_source("camera", served, "", options)
    assert (source.dataset, source.name) == ("camera", "127.0.0.1/pair.mkv")
    assert source.live
    assert count_expected(source) is None
    outcome = run_source(source, realtime=True)
    assert len(outcome.tracks) == FRAMES - 1  # the first image has told the size
    assert "no image came after 11" in outcome.interrupted
    assert np.all(np.diff(outcome.trajectory.timestamps) > 0)
    assert abs(outcome.trajectory.timestamps[0] - time.monotonic()) < 60.0


class FakeCamera:
    """In place of a device: films without end."""

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


def test_ctrl_c_is_the_regular_end_of_a_camera(folder, corridor, monkeypatch):
    FakeCamera.images = [np.hstack(p) for p in zip(corridor.left, corridor.right, strict=True)]
    monkeypatch.setattr(cv2, "VideoCapture", FakeCamera)
    options = SourceOptions((folder / "stereo.yaml",), side_by_side=True)
    source = open_source("camera", "0", "", options)
    settings = RunSettings(
        "camera", "0", "none", "none", "stereo", 0, 2, 0, 1, None, Config(), realtime=True
    )

    def on_frame(result):
        if result.index == 30:
            signal.raise_signal(signal.SIGINT)

    law = parse_perturbation("brightness", 0)
    outcome = run_sequence(source, law, settings, NullRecorder(), on_frame=on_frame)
    assert outcome.interrupted is None
    assert len(outcome.trajectory) == len(outcome.tracks) >= 31
    assert TrackingState.DROPPED in {track.state for track in outcome.tracks}


def test_command_line_finds_out_what_it_is_given(folder, tmp_path):
    calib = str(folder / "stereo.yaml")
    words = ["--data", str(folder / "pair.mkv"), "--side-by-side", "--calib", calib, "--no-record"]
    done = subprocess.run(
        [sys.executable, "-m", "vslam", "run", *words, "--detector", "none"],
        cwd=tmp_path, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert f"{FRAMES} done, 0 lost" in done.stdout
    run_folder = (tmp_path / "runs" / "latest").resolve()
    assert run_folder.name.endswith("-video-pair-none-none")
    report = json.loads((run_folder / "report.json").read_text())
    assert (report["dataset"], report["sequence"], report["frames"]) == ("video", "pair", FRAMES)
    assert (run_folder / "report.html").exists()
