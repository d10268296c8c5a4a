"""Depth from bags and folders. The same frames give the same run from every kind of source."""

from __future__ import annotations

from collections import namedtuple
from dataclasses import replace
from itertools import chain
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from conftest import StereoSequence, corridor_depth
from source_files import open_from, run_source, write_bag, write_calibration, write_images

from vslam.datasets.association import Pairing
from vslam.datasets.bag import _synchronised
from vslam.datasets.detection import detect_dataset
from vslam.support.errors import InputError
from vslam.types.camera import Camera
from vslam.types.source_options import SourceOptions

FRAMES = 8
COLOUR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
Stamp = namedtuple("Stamp", ["sec", "nanosec"])
NAMES = [f"{k}.png" for k in range(FRAMES)]
STAMPS = [k * 10**8 for k in range(FRAMES)]


@pytest.fixture(scope="module")
def depths(corridor: StereoSequence) -> list[np.ndarray]:
    """Depth in millimetres; 0 in the sky."""
    poses = corridor.T_wc[:FRAMES]
    metres = [corridor_depth(corridor.camera, T_wc) for T_wc in poses]
    return [np.rint(1000 * m).clip(0, 65535).astype(np.uint16) for m in metres]


@pytest.fixture(scope="module")
def calib(corridor, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("calib") / "left.yaml"
    return with_baseline(write_calibration(path, corridor.camera, mono=True), corridor.camera)


def with_baseline(path: Path, camera: Camera, more: str = "") -> Path:
    path.write_text(f'{path.read_text()[:-1]}, "virtual_baseline": {camera.baseline}{more}}}')
    return path


@pytest.fixture(scope="module")
def folders(corridor, depths, tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("folders")
    return write_images(root, {"rgb": corridor.left[:FRAMES], "depth": depths}, NAMES)


def opened(data: Path, calib: Path | None = None, **options):
    sensor = options.pop("sensor", None)
    given = SourceOptions(calib=() if calib is None else (calib,), **options)
    return open_from(detect_dataset(str(data)), data, given, sensor=sensor)


def refused(match: str, data: Path, calib: Path, **options):
    with pytest.raises(InputError, match=match) as caught:
        opened(data, calib, **options)
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith(".")


def write_depth(folder: Path, metres: list[np.ndarray], suffix: str) -> None:
    folder.mkdir(exist_ok=True)
    for k, image in enumerate(metres):
        path = folder / f"{k}{suffix}"
        if suffix == ".npy":
            np.save(path, image)
        else:
            assert cv2.imwrite(str(path), image)


@pytest.mark.parametrize("suffix", [".tiff", ".pfm", ".npy"])
def test_floating_point_depth_is_in_metres(corridor, depths, calib, tmp_path, suffix):
    metres = [(0.001 * depth).astype(np.float32) for depth in depths[:2]]
    for k, unknown in enumerate((np.nan, np.inf, -np.inf)):
        metres[1][0, k] = unknown
    write_images(tmp_path, {"rgb": corridor.left[:2]}, NAMES[:2])
    write_depth(tmp_path / "depth", metres, suffix)
    source = opened(tmp_path, calib, fps=10.0)
    assert source.camera.depth
    np.testing.assert_array_equal(source.read(0)[1], metres[0])
    np.testing.assert_array_equal(source.read(1)[1][0, :4], [0, 0, 0, metres[1][0, 3]])
    scaled = opened(tmp_path, calib, fps=10.0, depth_scale=2.0).read(0)[1]
    np.testing.assert_array_equal(scaled, metres[0] / 2)


def test_the_scale_of_a_calibration_is_that_of_integers(corridor, depths, tmp_path):
    path = write_calibration(tmp_path / "left.yaml", corridor.camera, mono=True)
    calib = with_baseline(path, corridor.camera, ', "depth_scale": 1000')
    write_images(tmp_path, {"rgb": corridor.left[:2]}, NAMES[:2])
    for suffix, images in ((".tiff", depths[:2]), (".tiff", [0.001 * d for d in depths[:2]])):
        write_depth(tmp_path / "depth", images, suffix)
        found = opened(tmp_path, calib, fps=10.0).read(1)[1]
        np.testing.assert_allclose(found, 0.001 * depths[1], rtol=1e-6)


def test_floating_point_depth_in_lists(corridor, depths, tmp_path):
    path = write_calibration(tmp_path / "calibration.yaml", corridor.camera, mono=True)
    with_baseline(path, corridor.camera)
    metres = [(0.001 * depth).astype(np.float32) for depth in depths[:2]]
    write_images(tmp_path, {"rgb": corridor.left[:2]}, NAMES[:2])
    write_depth(tmp_path / "depth", metres, ".tiff")
    for name, suffix in (("rgb", ".png"), ("depth", ".tiff")):
        lines = "".join(f"{k / 10},{name}\\{k}{suffix}\r\n" for k in range(2))
        text = f"timestamp,filename\r\n{lines}"
        (tmp_path / f"{name}.txt").write_bytes(
            text.encode("utf-16" if name == "rgb" else "utf-8-sig")
        )
    np.testing.assert_array_equal(opened(tmp_path).read(1)[1], metres[1])


def test_depth_that_is_no_depth(corridor, depths, calib, tmp_path):
    write_images(tmp_path, {"rgb": corridor.left[:1]}, NAMES[:1])
    write_depth(tmp_path / "depth", [1000.0 * depths[0].astype(np.float32)], ".tiff")
    refused("the median depth is .* m, as if it were in millimetres; give --depth-scale 1000",
            tmp_path, calib, fps=10.0)  # fmt: skip
    opened(tmp_path, calib, fps=10.0, depth_scale=1.0)
    write_depth(tmp_path / "depth", [(depths[0] >> 8).astype(np.uint8)], ".tiff")
    refused("8 bits and 1 channels, as a picture for viewing", tmp_path, calib, fps=10.0)
    write_depth(tmp_path / "depth", depths[:1], ".tiff")
    refused("unit of the depth images is unknown", tmp_path, calib, fps=10.0)


@pytest.fixture(scope="module")
def expected(folders, calib, corridor, depths):
    source = opened(folders, calib, fps=10.0, depth_scale=1000.0)
    assert source.camera == replace(corridor.camera, depth=True)
    for k in range(FRAMES):
        left, depth = source.read(k)
        assert np.array_equal(left, corridor.left[k])
        assert np.array_equal(depth, depths[k] * np.float32(0.001))
    outcome = run_source(source)
    assert all(track.state == "OK" for track in outcome.tracks)
    return outcome


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "16UC1 png"])
@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_a_bag_gives_the_trajectory_of_the_folders(
    corridor, depths, calib, expected, tmp_path, kind, encoding
):
    sides = {COLOUR: corridor.left[:FRAMES], DEPTH: depths}
    late = {"depth_encoding": encoding, "lag": 12_000_000, "padding": 4}
    source = opened(write_bag(tmp_path / "a.bag", kind, sides, STAMPS, **late), calib)
    assert source.camera == expected.sequence.camera
    outcome = run_source(source)
    assert outcome.trajectory.timestamps.tobytes() == expected.trajectory.timestamps.tobytes()
    assert outcome.trajectory.T_wc.tobytes() == expected.trajectory.T_wc.tobytes()


def test_compressed_inverse_depth(corridor, depths, calib, tmp_path):
    sides = {COLOUR: corridor.left[:2], DEPTH: depths[:2]}
    bag = write_bag(tmp_path / "a.bag", "ros1", sides, STAMPS[:2], depth_encoding="32FC1 png")
    first = next(opened(bag, calib).frames())
    found = first.read(map)[1]
    true = depths[0] / 1000.0
    assert np.array_equal(found > 0, true > 0)
    # Half a step of 500 / z - 3 is an error of z^2 / 1000.
    assert (abs(found - true) <= 1.01e-3 * true**2 + 1e-6).all()


def test_a_scale_comes_before_that_of_the_encoding(corridor, depths, calib, tmp_path):
    sides = {COLOUR: corridor.left[:2], DEPTH: depths[:2]}
    bag = write_bag(tmp_path / "a.bag", "ros1", sides, STAMPS[:2])
    first = next(opened(bag, calib, depth_scale=500.0).frames())
    np.testing.assert_allclose(first.read(map)[1], depths[0] / 500.0, rtol=1e-6)


def test_the_camera_info_of_the_images_is_enough(corridor, depths, tmp_path):
    sides = {COLOUR: corridor.left[:2], DEPTH: depths[:2]}
    bag = write_bag(tmp_path / "a.bag", "ros1", sides, STAMPS[:2], camera=corridor.camera)
    assert opened(bag).camera == replace(corridor.camera, baseline=0.08, depth=True)
    assert opened(bag, sensor="mono").camera == corridor.camera.left_camera()


def test_each_image_gets_the_nearest_depth(corridor, depths, calib, tmp_path):
    """Like that of a Kinect, depth arrives at 30 Hz, 18 ms before and 15 ms after the images."""
    stamps = [k * 33_000_000 for k in range(FRAMES)]
    sides = {DEPTH: depths, COLOUR: corridor.left[:FRAMES]}
    bag = write_bag(tmp_path / "a.bag", "ros1", sides, stamps, lag=18_000_000)
    frames = list(opened(bag, calib).frames())
    assert len(frames) == FRAMES - 1  # the last image has no later depth
    for k, frame in enumerate(frames):
        assert np.array_equal(frame.read(map)[1], depths[k + 1] * np.float32(0.001))


def test_images_of_a_bag_without_depth_are_counted(corridor, depths, calib, tmp_path, caplog):
    """Each depth image is 95 ms late.

    It is near the next image as long as this image follows after 100 ms.
    """
    stamps = [k * 1_000_000 for k in (0, 100, 200, 300, 430, 560, 690, 820)]
    sides = {COLOUR: corridor.left[:FRAMES], DEPTH: depths}
    bag = write_bag(tmp_path / "a.bag", "ros1", sides, stamps, lag=95_000_000)
    source = opened(bag, calib)
    outcome = run_source(source)
    assert len(outcome.tracks) == 3
    assert not caplog.messages  # the summary of the run shows the warning
    said = outcome.warnings[0]
    assert said == (
        f"{bag}: 5 of 8 images are left out because no image of {DEPTH} is within 20 ms of them "
        f"(the nearest is 35 ms away); correct the time stamps if those of {DEPTH} are late, name "
        "other topics with --topics, or run with --sensor mono."
    )
    assert len(list(source.frames())) == 3
    assert source.pairing.warnings() == [said]  # the warning is about one reading, not about both
    assert opened(bag, calib, sensor="mono").pairing is None


def test_images_that_wait_too_long_for_depth_are_counted(tmp_path):
    def messages(topic, numbers):
        for k in numbers:
            yield topic, SimpleNamespace(header=SimpleNamespace(stamp=Stamp(k, 0)))

    pairing = Pairing(tmp_path, "depth", 0.02, "wait")
    read = chain(messages("rgb", range(40)), messages("depth", range(50)))
    assert len(list(_synchronised(read, ("rgb", "depth"), pairing))) == pairing.n_pairs == 32
    assert pairing.left_out == list(range(8))  # at most 32 images wait


@pytest.mark.parametrize("missing", [("rgb", 19), ("rgb", 20), ("depth", 19), ("depth", 20)])
def test_a_frame_that_is_missing_when_the_clock_is_set_back_costs_only_its_pair(missing, tmp_path):
    messages = [
        (topic, SimpleNamespace(header=SimpleNamespace(stamp=Stamp(100 + k - 50 * (k >= 20), 0))))
        for k in range(40)
        for topic in ("rgb", "depth")
        if (topic, k) != missing
    ]
    pairing = Pairing(tmp_path, "depth", 0.02, "wait")
    pairs = list(_synchronised(iter(messages), ("rgb", "depth"), pairing))
    assert len(pairs) == 39
    assert all(a.header.stamp == b.header.stamp for a, b in pairs)
    assert len(pairing.left_out) == (missing[0] == "depth")


def test_topics_of_bags_with_depth(corridor, depths, calib, tmp_path):
    two, small = {COLOUR: corridor.left[:2], DEPTH: depths[:2]}, [d[:80] for d in depths[:2]]
    more = {"/infra/image_raw": corridor.right[:2]}
    bag = write_bag(tmp_path / "more.bag", "ros1", two | more, STAMPS[:2])
    assert not opened(bag, calib, topics=COLOUR, sensor="mono").camera.depth
    assert opened(bag, calib, topics=f"{COLOUR},{DEPTH}").camera.depth
    refused("choose topics with --topics COLOUR,DEPTH; image topics are", bag, calib, sensor="rgbd")
    refused(f"{DEPTH} holds depth; give the topic", bag, calib, topics=f"{DEPTH},{COLOUR}")
    refused("encoding 'mono8' is not depth; known are 16UC1", bag, calib,
            topics=f"{COLOUR},/infra/image_raw", sensor="rgbd")  # fmt: skip
    other = write_bag(tmp_path / "s.bag", "ros1", {**two, DEPTH: small}, STAMPS[:2])
    refused("has 480x80 pixels but the .* have 480x160; .* registered", other, calib)
    alone = write_bag(tmp_path / "d.bag", "ros1", {DEPTH: depths[:2]}, STAMPS[:2])
    refused("stereo needs two image topics; image topics are /camera/aligned", alone, calib)


def test_folders_by_option_and_by_times(corridor, depths, calib, folders, tmp_path, caplog):
    times = [1403636579.76 + 0.1 * k for k in range(3)]
    write_images(tmp_path, {"a": corridor.left[:3]}, [f"{t:.6f}.png" for t in times])
    # The second depth image is missing, so that depth cannot be assigned by order.
    late = [f"{t + 0.008:.6f}.png" for t in (times[0], times[2])]
    write_images(tmp_path, {"b": [depths[0], depths[2]]}, late)
    source = opened(tmp_path / "a", calib, depth=tmp_path / "b", depth_scale=1000.0)
    np.testing.assert_allclose(source.timestamps, [times[0], times[2]])
    assert not caplog.messages
    (said,) = source.pairing.warnings()
    assert "1 of 3 images are left out because no depth image is within 20 ms" in said
    assert "(the nearest is 92 ms away); correct the names" in said
    assert np.array_equal(source.read(1)[1], depths[2] * np.float32(0.001))
    assert np.array_equal(source.read(1)[0], corridor.left[2])
    alone = opened(folders, calib, fps=10.0, sensor="mono")
    assert alone.read(0)[1] is None


def test_a_scale_out_of_the_calibration(folders, corridor, depths, tmp_path):
    path = write_calibration(tmp_path / "c.yaml", corridor.camera, mono=True)
    source = opened(
        folders, with_baseline(path, corridor.camera, ', "depth_scale": 1000'), fps=10.0
    )
    assert source.camera.baseline == corridor.camera.baseline
    np.testing.assert_array_equal(source.read(1)[1], depths[1] * np.float32(0.001))


def test_bad_folders_with_depth(corridor, depths, calib, folders, tmp_path):
    refused("the unit of the depth images is unknown; give --depth-scale", folders, calib,
            fps=10.0)  # fmt: skip
    options = {"fps": 10.0, "depth_scale": 1000.0}
    both = {"right": folders / "rgb", "depth": folders / "depth"}
    refused("--depth .*: contradicts --right", folders / "rgb", calib, **both, **options)
    write_images(tmp_path, {"rgb": corridor.left[:3]}, NAMES[:3])
    write_images(tmp_path, {"depth": depths[:2]}, NAMES[:2])
    pairing = opened(tmp_path, calib, **options).pairing
    assert (pairing.n_pairs, len(pairing.left_out)) == (2, 1)
    write_images(tmp_path, {"depth": [depths[0][:80], *depths[1:3]]}, NAMES[:3])
    refused("depth has 480x80 pixels but the colour image has 480x160", tmp_path, calib, **options)
    grey = cv2.convertScaleAbs(depths[0], alpha=0.01)
    write_images(tmp_path, {"depth": [grey, *depths[1:3]]}, NAMES[:3])
    refused("the depth has 8 bits and 1 channels", tmp_path, calib, **options)
