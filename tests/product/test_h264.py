"""Videos as phones and cameras write them: H.264 in MP4, at variable frame rates, or truncated."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from source_files import open_from, run_source, write_calibration

from vslam.support.errors import InputError
from vslam.types.source_options import SourceOptions

av = pytest.importorskip("av")

FRAMES = 24
TICKS = 90_000  # per second


def write_h264(path: Path, images, times, *, options=None, container=None) -> Path:
    """Write a video that is lossless except for its colours. ``times`` are in seconds."""
    height, width = images[0].shape
    with av.open(str(path), "w", options=container or {}) as file:
        stream = file.add_stream("libx264", rate=30, options={"crf": "1"} | (options or {}))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, TICKS)
        for image, time in zip(images, times, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="gray").reformat(format="yuv420p")
            frame.pts, frame.time_base = round(time * TICKS), Fraction(1, TICKS)
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return path


@pytest.fixture(scope="module")
def options(corridor, tmp_path_factory) -> SourceOptions:
    path = tmp_path_factory.mktemp("calib") / "c.yaml"
    return SourceOptions(calib=(write_calibration(path, corridor.camera),), side_by_side=True)


@pytest.fixture(scope="module")
def beside(corridor) -> list[np.ndarray]:
    pairs = zip(corridor.left, corridor.right, strict=True)
    return [np.hstack(pair) for pair in pairs][:FRAMES]


def opened(path: Path, options: SourceOptions):
    return open_from("video", path, options)


@pytest.mark.slow
def test_a_video_as_encoders_write_it(corridor, beside, options, tmp_path):
    """The order in which frames are stored differs from the order in which they are shown."""
    times = np.arange(FRAMES) / 10
    path = write_h264(tmp_path / "a.mp4", beside, times, options={"bf": "3"})
    source = opened(path, options)
    assert source.n_expected == FRAMES
    frames = list(source.frames())
    np.testing.assert_allclose([frame.timestamp for frame in frames], times, atol=1e-5)
    for k, frame in enumerate(frames):
        for image, true in zip(frame.read(map), (corridor.left[k], corridor.right[k]), strict=True):
            assert np.abs(image.astype(int) - true).mean() < 1.5
    outcome = run_source(source)
    assert all(track.state == "OK" for track in outcome.tracks)


@pytest.mark.slow
def test_a_rate_that_varies(beside, options, tmp_path):
    steps = np.resize([0.033, 0.041, 0.1, 0.02], FRAMES - 1)
    times = np.concatenate([[0.0], np.cumsum(steps)])
    path = write_h264(tmp_path / "vfr.mp4", beside, times)
    found = [frame.timestamp for frame in opened(path, options).frames()]
    np.testing.assert_allclose(found, times, atol=1e-4)


@pytest.mark.slow
def test_a_file_cut_off_has_no_index(beside, options, tmp_path):
    data = write_h264(tmp_path / "a.mp4", beside, np.arange(FRAMES) / 10).read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) * 3 // 5])
    with pytest.raises(InputError, match=r"cut.mp4: not a video, truncated, or in a codec"):
        opened(tmp_path / "cut.mp4", options)


@pytest.mark.slow
def test_a_file_in_fragments_keeps_the_frames_before_the_cut(beside, options, tmp_path):
    fragments = {"movflags": "frag_keyframe+empty_moov"}
    path = write_h264(
        tmp_path / "a.mp4", beside, np.arange(FRAMES) / 10, options={"g": "4"}, container=fragments
    )
    data = path.read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) * 3 // 5])
    found = list(opened(path, options).frames())
    assert len(found) == FRAMES
    source = opened(tmp_path / "cut.mp4", options)
    outcome = run_source(source)
    assert FRAMES // 4 < len(outcome.trajectory) < FRAMES


def test_a_video_without_frames(options, tmp_path):
    with av.open(str(tmp_path / "none.mp4"), "w") as file:
        stream = file.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 480, 160, "yuv420p"
        file.mux(stream.encode())
    with pytest.raises(InputError, match=r"none.mp4: ") as caught:
        opened(tmp_path / "none.mp4", options)
    assert "\n" not in str(caught.value)


def test_sound_alone(options, tmp_path):
    with av.open(str(tmp_path / "sound.mp4"), "w") as file:
        stream = file.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.float32), "fltp", "mono")
        frame.sample_rate, frame.pts = 44100, 0
        file.mux(stream.encode(frame))
        file.mux(stream.encode())
    with pytest.raises(InputError, match="not a video, truncated, or in a codec"):
        opened(tmp_path / "sound.mp4", options)
