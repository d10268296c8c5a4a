"""Images with more than 8 bits are scaled by their range, which is the same for a whole drive."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from source_files import LEFT, RIGHT, open_from, write_bag, write_calibration, write_images

from vslam.datasets.bag_messages import grey_of, levels_of_messages
from vslam.datasets.grey_levels import levels_of, upper_bits
from vslam.datasets.image_files import read_grey
from vslam.datasets.sources import open_raw
from vslam.types.source_options import SourceOptions

N = 10


def deep(image: np.ndarray, frame: int = 0, *, low: int = 7000, step: int = 6) -> np.ndarray:
    """Return grey values as a camera with more than 8 bits stores them. Each frame is a little
    brighter than the one before it, as with a changing exposure."""
    return (low + 30 * frame + step * image.astype(np.int64)).astype(np.uint16)


@pytest.fixture(scope="module")
def sides(corridor):
    """The first frames of the corridor with 14 bits. The first pixel always has the value 7600."""
    both = {}
    for side, images in (("left", corridor.left), ("right", corridor.right)):
        both[side] = [deep(image, k) for k, image in enumerate(images[:N])]
        for image in both[side]:
            image[0, 0] = 7600
    return both


@pytest.fixture(scope="module")
def folder(corridor, sides, tmp_path_factory):
    path = tmp_path_factory.mktemp("deep")
    write_calibration(path / "stereo.yaml", corridor.camera)
    write_images(path, sides, [f"{k:06}.png" for k in range(N)])
    write_bag(path / "deep.mcap", "mcap", {LEFT: sides["left"], RIGHT: sides["right"]},
              [k * 10**8 for k in range(N)])  # fmt: skip
    return path


def opened(folder, kind: str, **options):
    given = SourceOptions(calib=(folder / "stereo.yaml",))
    if kind == "bag":
        return open_from("bag", folder / "deep.mcap", given, **options)
    return open_from("images", folder, given, fps=10.0, **options)


@pytest.mark.parametrize("kind", ["images", "bag"])
def test_fourteen_bits_keep_their_contrast(folder, corridor, sides, kind):
    first = next(opened(folder, kind).frames())
    for image, original in zip(first.read(map), (corridor.left[0], corridor.right[0]), strict=True):
        share = image[1:].astype(float).std() / original[1:].astype(float).std()
        assert share > 0.7
        assert np.mean((image == 0) | (image == 255)) < 0.01
    assert np.array_equal(first.colour(), first.read(map)[0])
    assert first.file is None


@pytest.mark.parametrize("kind", ["images", "bag"])
def test_a_value_has_one_level_in_all_frames_and_in_both_images(folder, kind):
    frames = [frame.read(map) for frame in opened(folder, kind).frames()]
    assert len({int(image[0, 0]) for pair in frames for image in pair}) == 1
    brightness = [float(left.mean()) for left, _ in frames]
    assert brightness[-1] > brightness[0] + 20  # the exposure is not evened out


@pytest.mark.parametrize("kind", ["images", "bag"])
def test_the_levels_do_not_depend_on_which_frames_are_selected(folder, kind):
    whole = [frame.read(map) for frame in opened(folder, kind).frames()]
    (part,) = [frame.read(map) for frame in opened(folder, kind, start=7, max_frames=1).frames()]
    assert np.array_equal(part, whole[7])


def write_deep_video(path, images: list[np.ndarray]) -> None:
    height, width = images[0].shape
    grey = [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    codec = cv2.VideoWriter_fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, codec, 10.0, (width, height), grey)
    assert writer.isOpened()
    for image in images:
        writer.write(image)
    writer.release()


def test_a_video_with_sixteen_bits(folder, corridor, sides, tmp_path):
    both = [np.hstack(pair) for pair in zip(*sides.values(), strict=True)]
    write_deep_video(tmp_path / "deep.mkv", both)
    given = SourceOptions(calib=(folder / "stereo.yaml",), side_by_side=True)
    frames = [f.read(map) for f in open_from("video", tmp_path / "deep.mkv", given).frames()]
    expected = [frame.read(map) for frame in opened(folder, "images").frames()]
    assert len(frames) == N
    for found, wanted in zip(frames, expected, strict=True):
        np.testing.assert_allclose(found, wanted, atol=8)  # other frames were sampled
    assert len({int(image[0, 0]) for pair in frames for image in pair}) == 1


def test_calibration_reads_the_same_images(folder):
    raw = open_raw(SourceOptions(data=str(folder), dataset="images", max_frames=1))
    assert np.array_equal(raw.read(0), opened(folder, "images").read(0))


def test_the_full_range_keeps_its_upper_bits(corridor, tmp_path):
    full = {
        side: [image.astype(np.uint16) << 8 | 77 for image in images[:2]]
        for side, images in (("left", corridor.left), ("right", corridor.right))
    }
    write_images(tmp_path, full, ["000000.png", "000001.png"])
    write_calibration(tmp_path / "stereo.yaml", corridor.camera)
    source = opened(tmp_path, "images")
    assert np.array_equal(source.read(0)[0], corridor.left[0])
    assert np.array_equal(read_grey(tmp_path / "left/000000.png"), corridor.left[0])


def test_colours_with_sixteen_bits(corridor, tmp_path):
    tinted = {
        side: [np.stack([deep(image, step=step) for step in (2, 4, 6)], axis=-1)]
        for side, image in (("left", corridor.left[0]), ("right", corridor.right[0]))
    }
    write_images(tmp_path, tinted, ["000000.tiff"])
    write_calibration(tmp_path / "stereo.yaml", corridor.camera)
    frame = opened(tmp_path, "images").stored[0]
    colour, grey = frame.colour(), frame.read(map)[0]
    assert np.ptp(grey) > 100
    red, blue = (float(colour[..., channel].mean()) for channel in (0, 2))
    assert red > blue + 20


def test_depth_beside_deep_images_stays_metric(corridor, tmp_path):
    depth = np.full(corridor.left[0].shape, 2500, np.uint16)
    write_images(tmp_path, {"rgb": [deep(corridor.left[0])], "depth": [depth]}, ["000000.png"])
    write_calibration(tmp_path / "mono.yaml", corridor.camera, mono=True)
    given = SourceOptions(calib=(tmp_path / "mono.yaml",), depth_scale=1000.0, fps=10.0)
    image, metres = open_from("images", tmp_path, given).read(0)
    assert np.ptp(image) > 100
    np.testing.assert_allclose(metres, 2.5)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_levels_cover_the_range_of_a_sensor(bits):
    scene = np.linspace(0.2, 0.45, 10_000).reshape(100, 100) * (2**bits - 1)
    image = np.rint(scene).astype(np.uint16)
    levels = levels_of([image])
    assert np.ptp(levels[image].astype(int)) > 200
    assert (np.diff(levels.astype(int)) >= 0).all()
    assert levels[image].min() > 0
    assert levels[image].max() < 255


def test_a_few_extreme_pixels_and_a_black_border_do_not_count():
    image = np.linspace(7000, 8500, 40_000).astype(np.uint16).reshape(200, 200)
    spoilt = image.copy()
    spoilt[::40, ::40] = 65535
    spoilt[:, :40] = 0
    expected, levels = levels_of([image]), levels_of([spoilt])
    inner = image[:, 40:]
    assert np.abs(levels[inner].astype(int) - expected[inner].astype(int)).max() < 20


def test_eight_bits_need_no_levels_and_are_not_spread():
    image = np.arange(100, 131, dtype=np.uint8).repeat(100).reshape(62, 50)
    assert levels_of([image]) is None
    assert np.ptp(levels_of([image.astype(np.uint16)])[image].astype(int)) < 2 * np.ptp(image)
    assert np.array_equal(levels_of([np.zeros((8, 8), np.uint16)]), upper_bits())


@pytest.mark.parametrize("encoding", ["mono10", "mono12", "mono16", "16UC1", "bayer_rggb12"])
def test_encodings_with_more_than_eight_bits(encoding):
    values = np.linspace(300, 900, 64 * 64).astype("<u2").reshape(64, 64)
    message = SimpleNamespace(
        encoding=encoding, width=64, height=64, step=128, is_bigendian=0,
        data=values.view(np.uint8).ravel(),
    )  # fmt: skip
    assert np.ptp(grey_of(message, levels_of_messages([message]))) > 150
    assert np.ptp(grey_of(message)) < 4


def test_a_compressed_image_with_sixteen_bits():
    values = np.linspace(300, 900, 64 * 64).astype(np.uint16).reshape(64, 64)
    data = cv2.imencode(".png", values)[1].ravel()
    message = SimpleNamespace(format="mono16; png compressed ", data=data)
    assert np.ptp(grey_of(message, levels_of_messages([message]))) > 150
    damaged = SimpleNamespace(format="png", data=data[:50])
    assert levels_of_messages([damaged]) is None
