"""``--calib auto``: the camera is estimated from followed corners, or its motion is refused."""

from __future__ import annotations

import json
import struct
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vslam.calibration.chain_adjustment import UNKNOWNS, Adjusted, Scenes
from vslam.calibration.chains import KEYFRAMES, Chain
from vslam.calibration.files import read_calibration
from vslam.calibration.from_motion import MotionFit, camera_from_chains, focal_sigma
from vslam.calibration.models import CameraModel, project
from vslam.datasets.quicktime import focal_length_35_mm
from vslam.support.errors import InputError
from vslam_lab.towns import Variation, route_named
from vslam_lab.towns.passes import Passes
from vslam_lab.towns.render import Renderer, sensor_image
from vslam_lab.towns.rooms import build_room

STREET = Path(__file__).parents[3] / "shared/data/kitti/sequences/00/image_0"
SIZE = (640, 480)
PINHOLE = CameraModel(430.0, 430.0, 319.5, 239.5, *SIZE, "pinhole", (-0.12, 0.03, 0.0, 0.0))
FISHEYE = CameraModel(250.0, 250.0, 319.5, 239.5, *SIZE, "fisheye", (0.02, -0.01, 0.0, 0.0))


def chain(
    model: CameraModel,
    seed: int,
    *,
    turn: float = 0.25,
    sideways: float = 0.6,
    ahead: float = 0.2,
    flat: bool = False,
    read_out: float = 0.0,
) -> Chain:
    """Project points of a room while the camera moves, with noise of 0.2 pixels."""
    rng = np.random.default_rng(seed)
    rays = rng.uniform(-1.0, 1.0, (300, 3)) * [1.6, 1.2, 0.0] + [0.0, 0.0, 1.0]
    points = rays * (4.0 if flat else rng.uniform(2.0, 9.0, (300, 1)))
    axis, way = rng.normal(size=3), rng.normal(size=3) * [sideways, sideways, 0.0]
    axis /= np.linalg.norm(axis)
    way[2] += ahead

    def seen(time: np.ndarray | float) -> np.ndarray:
        bend = np.sin(np.asarray(time) * 1.3)[..., None]
        R = Rotation.from_rotvec(turn * np.asarray(time)[..., None] * axis + 0.3 * turn * bend)
        moved = R.apply(points) + np.asarray(time)[..., None] * way
        return project(model, moved)

    xy, flow = [], []
    for time in np.linspace(0.0, 1.0, KEYFRAMES):
        step = rng.uniform(0.0, 0.08)  # between two frames: the camera moves unevenly
        at = seen(np.full(300, time))
        rows = (at[:, 1] - 239.5) / SIZE[1]
        xy.append(seen(time + read_out * step * rows))
        flow.append(xy[-1] - seen(time - step + read_out * step * rows))
    positions = np.array(xy) + rng.normal(0.0, 0.2, (KEYFRAMES, 300, 2))
    inside = ((positions > 0) & (positions < SIZE)).all(axis=2)
    positions[~inside] = np.nan
    kept = inside[:3].all(axis=0)
    return Chain(0.0, positions[:, kept], np.array(flow)[:, kept])


def found(model: CameraModel, n: int = 6, **motion) -> MotionFit:
    return camera_from_chains([chain(model, seed, **motion) for seed in range(n)], SIZE, "clip")


@pytest.mark.slow
@pytest.mark.parametrize("model", [PINHOLE, FISHEYE])
def test_focal_length_and_lens_are_found_within_the_stated_deviation(model):
    fit = found(model)
    assert fit.camera.lens == model.lens
    assert abs(fit.camera.fx / model.fx - 1.0) < max(3.0 * fit.sigma, 0.002)
    assert fit.sigma < 0.01
    assert fit.warnings() == []


def adjusted(focal: np.ndarray, told: np.ndarray) -> Adjusted:
    """Return the result of chains, each of which gives a logarithm of the focal length alone.

    Args:
        told: information of each chain.
    """
    information = np.zeros((len(focal), UNKNOWNS, UNKNOWNS))
    information[:, 0, 0] = told
    gradient = np.zeros((len(focal), UNKNOWNS))
    gradient[:, 0] = told * (focal - np.average(focal, weights=told))
    nothing = np.zeros(0)
    return Adjusted(
        PINHOLE, 0.0, Scenes(nothing, nothing, nothing), nothing, 0.0, information, gradient,
        np.r_[0.0, np.ones(UNKNOWNS - 1)], 0.09, 0.0,
    )  # fmt: skip


def test_twice_the_deviation_is_the_interval_of_student_for_the_mean_of_equal_chains():
    focal = np.array([0.01, -0.02, 0.03, 0.0])
    sigma = focal_sigma(adjusted(focal, np.full(4, 50.0)))
    interval = 3.182 * np.std(focal, ddof=1) / 2.0  # 0.975 of three degrees of freedom
    assert 2.0 * sigma == pytest.approx(interval, rel=0.025)  # 1.96 counts as two


def test_the_deviation_covers_the_truth_also_if_one_chain_tells_most():
    rng, told, within = np.random.default_rng(0), np.array([2500.0, 400.0, 400.0, 100.0]), []
    for _ in range(400):
        focal = rng.normal(size=4) / np.sqrt(told)
        sigma = focal_sigma(adjusted(focal, told))
        within.append(abs(np.average(focal, weights=told)) <= 2.0 * sigma)
    assert np.mean(within) > 0.93


def test_a_single_chain_has_no_deviation():
    assert focal_sigma(adjusted(np.zeros(1), np.ones(1))) == np.inf


@pytest.mark.slow
def test_a_rolling_shutter_is_recognised_and_does_not_bias_the_focal_length():
    fit = found(PINHOLE, read_out=0.8)
    assert fit.read_out == pytest.approx(0.8, abs=0.1)
    assert abs(fit.camera.fx / PINHOLE.fx - 1.0) < max(3.0 * fit.sigma, 0.002)
    assert "rolling shutter" in fit.warnings()[0]


@pytest.mark.slow
def test_a_zoom_is_recognised():
    wide, narrow = PINHOLE, replace(PINHOLE, fx=520.0, fy=520.0)
    chains = [chain(wide if k < 4 else narrow, k) for k in range(8)]
    fit = camera_from_chains(chains, SIZE, "clip")
    assert "the lens zooms" in fit.warnings()[0]
    assert fit.zoomed > 0.1


@pytest.mark.slow
def test_motion_that_does_not_tell_the_focal_length_is_refused_with_the_reason():
    with pytest.raises(InputError, match=r"^clip: the camera moves straight ahead"):
        found(PINHOLE, turn=0.0, sideways=0.0, ahead=0.9)
    with pytest.raises(InputError, match=r"^clip: corners cannot be followed.*cameras\.md"):
        camera_from_chains([], SIZE, "clip")


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    """A video of a walk through a room, with a focal length of 300 pixels."""
    file = tmp_path_factory.mktemp("clip") / "clip.avi"
    variation = Variation(5)
    route = route_named("room", variation)
    camera = replace(route.camera, width=384, height=288, fx=300.0, fy=300.0, cx=191.5, cy=143.5)
    town = build_room(route.land, variation)
    passes = Passes(route, town, variation)
    video = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (384, 288))
    with closing(Renderer(camera, town.atlas, town.sky)) as renderer:
        for k in range(0, 160, 2):
            (view,) = renderer.views(passes.at(k), route.T_wc[k])
            image = sensor_image(view.image, camera, yaw_rate=0.0, night=0.0, key=(5, k, 0))
            video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    video.release()
    return file


@pytest.mark.slow
def test_from_a_video_to_a_splat_in_two_commands_without_a_calibration(clip, tmp_path, call):
    code, _, err = call("run", clip, "--calib", "auto", "--no-record", "--out", tmp_path / "runs")
    assert code == 0, err
    folder = (tmp_path / "runs" / "latest").resolve()
    model = read_calibration([folder / "calibration.yaml"]).left
    assert model.fx == pytest.approx(300.0, rel=0.02)
    report = json.loads((folder / "report.json").read_text())
    assert any("focal length" in text for text in report["warnings"])
    code, _, err = call("export", "nerfstudio", folder)
    assert code == 0, err
    scene = json.loads((folder / "nerfstudio" / "transforms.json").read_text())
    assert len(scene["frames"]) > 5
    code, out, _ = call("calibrate", clip, "--auto", "--out", tmp_path / "camera.yaml")
    assert code == 0
    assert "standard deviation" in out
    assert read_calibration([tmp_path / "camera.yaml"]).left == model  # the same images


@pytest.mark.slow
@pytest.mark.skipif(not STREET.is_dir(), reason="KITTI sample absent")
def test_a_real_drive_whose_calibration_is_withheld(tmp_path, call):
    options = (
        "--calib",
        "auto",
        "--start",
        100,
        "--max-frames",
        120,
        "--fps",
        10,
        "--no-record",
        "--no-report",
    )
    code, _, err = call("run", STREET, *options, "--out", "runs", "--threads", 1)
    assert code == 0, err
    model = read_calibration([tmp_path / "runs" / "latest" / "calibration.yaml"]).left
    assert model.fx == pytest.approx(718.856, rel=0.04)
    assert call("export", "nerfstudio", "runs/latest")[0] == 0
    scene = json.loads((tmp_path / "runs" / "latest" / "nerfstudio/transforms.json").read_text())
    assert len(scene["frames"]) > 10


def test_auto_calibrates_one_recorded_camera(clip, call):
    for options, what in (
        (["--side-by-side"], "one camera"),
        (["--dataset", "synthetic"], "has its own calibration"),
        (["--dataset", "camera"], "record a video"),
    ):
        code, _, err = call("run", clip, "--calib", "auto", *options)
        assert code == 2
        assert what in err


def test_exif_tells_the_focal_length_where_the_motion_does_not(tmp_path, call):
    from PIL import Image

    (tmp_path / "still").mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8)
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28  # mm, equivalent for a diagonal of 43.27 mm
    for k in range(4):
        Image.fromarray(noise).save(tmp_path / "still" / f"{k}.jpg", exif=exif)
    words = ("calibrate", "still", "--fps", "10", "--auto", "--out", "camera.yaml")
    code, out, _ = call(*words)
    assert code == 0
    assert "from EXIF" in out
    assert read_calibration([tmp_path / "camera.yaml"]).left.fx == pytest.approx(51.77, abs=0.01)
    for file in (tmp_path / "still").iterdir():
        Image.fromarray(noise).save(file)
    code, _, err = call(*words)
    assert code == 2
    assert "still: --calib auto: corners cannot be followed" in err


def atom(kind: bytes, content: bytes) -> bytes:
    return (8 + len(content)).to_bytes(4, "big") + kind + content


def quicktime(kind: int, value: bytes, *, mp4: bool = False) -> bytes:
    """Return a video without images, whose track states a focal length as the second value."""
    names = b"com.apple.quicktime.make", b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
    keys = bytes(4) + (2).to_bytes(4, "big") + b"".join(atom(b"mdta", name) for name in names)
    values = (1, b"vslam"), (kind, value)
    ilst = b"".join(
        atom((k + 1).to_bytes(4, "big"), atom(b"data", one.to_bytes(4, "big") + bytes(4) + text))
        for k, (one, text) in enumerate(values)
    )
    handler = atom(b"hdlr", bytes(8) + b"mdta" + bytes(12))
    meta = bytes(4 if mp4 else 0) + handler + atom(b"keys", keys) + atom(b"ilst", ilst)
    track = atom(b"trak", atom(b"tkhd", bytes(84)) + atom(b"meta", meta))
    large = (1).to_bytes(4, "big") + b"mdat" + (16 + 5).to_bytes(8, "big") + bytes(5)
    return atom(b"ftyp", b"qt  ") + large + atom(b"moov", atom(b"mvhd", bytes(100)) + track)


def test_videos_state_their_focal_length_as_text_or_number(tmp_path):
    file = tmp_path / "clip.mov"
    for kind, value in (
        (1, b"27"),
        (1, b"27.00mm"),
        (21, bytes([27])),
        (22, bytes([0, 27])),
        (23, struct.pack(">f", 27.0)),
        (24, struct.pack(">d", 27.0)),
    ):
        for mp4 in (False, True):
            file.write_bytes(quicktime(kind, value, mp4=mp4))
            assert focal_length_35_mm(file) == 27.0


def test_damaged_videos_state_no_focal_length(tmp_path):
    file, whole = tmp_path / "clip.mov", quicktime(21, bytes([27]))
    for n in range(len(whole)):
        file.write_bytes(whole[:n])
        assert focal_length_35_mm(file) is None
    for kind, value in (
        (1, b"wide"),
        (1, b"nan"),
        (1, b"-27"),
        (1, b"\xff"),
        (23, b"1"),
        (99, b"1"),
    ):
        file.write_bytes(quicktime(kind, value))
        assert focal_length_35_mm(file) is None
    for at in range(len(whole)):  # must not raise, and not run on for ever
        changed = bytearray(whole)
        changed[at] ^= 0xFF
        file.write_bytes(changed)
        focal_length_35_mm(file)


def test_a_video_tells_the_focal_length_where_the_motion_does_not(tmp_path, call):
    file = tmp_path / "still.mp4"
    video = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (64, 48))
    for _ in range(6):
        video.write(np.full((48, 64, 3), 90, np.uint8))
    video.release()
    whole, stated = file.read_bytes(), quicktime(21, bytes([28]))
    stated = stated[stated.index(b"trak") - 4 :]
    moov = whole.rindex(b"moov") - 4  # the last atom
    size = int.from_bytes(whole[moov : moov + 4], "big")
    assert moov + size == len(whole)
    meta = stated[8 + 92 :]
    file.write_bytes(whole[:moov] + atom(b"moov", whole[moov + 8 :] + meta))
    code, out, _ = call("calibrate", file, "--auto", "--out", tmp_path / "camera.yaml")
    assert code == 0
    assert "standard deviation 10.0 %" in out
    assert "from the video" in out
    assert read_calibration([tmp_path / "camera.yaml"]).left.fx == pytest.approx(51.77, abs=0.01)
