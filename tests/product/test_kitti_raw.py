"""Drives of KITTI raw: synchronised and rectified, or not, with grey or colour images."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from vslam.datasets.fixes import read_fixes
from vslam.datasets.kitti_raw import open_kitti_raw
from vslam.datasets.sources import open_source
from vslam.support.errors import InputError
from vslam.types.source_options import SourceOptions

SIZE, RAW_SIZE, FRAMES = (64, 32), (72, 40), 4
DRIVE = "2011_09_26_drive_0005_sync"
FIRST = 1317042145.25  # 2011-09-26 13:02:25.25 UTC
K = np.array([[50.0, 0, 30], [0, 50, 16], [0, 0, 1]])
K_RAW = np.array([[52.0, 0, 36], [0, 52, 20], [0, 0, 1]])
T_X = (0.0, -0.54, 0.06, -0.47)  # translation of each camera from camera 0


def line(key: str, values) -> str:
    return f"{key}: {' '.join(f'{x:e}' for x in np.ravel(values))}\n"


def write_drive(root: Path, name: str = DRIVE, size=SIZE, cameras=range(4)) -> Path:
    drive = root / name[:10] / name
    for camera in cameras:
        folder = drive / f"image_{camera:02}"
        (folder / "data").mkdir(parents=True)
        for k in range(FRAMES):
            image = np.random.default_rng(10 * camera + k).integers(0, 256, size[::-1], np.uint8)
            colour = image if camera < 2 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
            cv2.imwrite(str(folder / "data" / f"{k:010d}.png"), colour)
        stamps = [f"2011-09-26 13:02:25.{25 + 10 * k}0000123" for k in range(FRAMES)]
        (folder / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    text = "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.950000e-02\n"
    turn = cv2.Rodrigues(np.array([0.0, 0.02, 0.0]))[0]
    for camera, t_x in enumerate(T_X):
        n, t = f"{camera:02}", np.array([t_x, 0, 0])
        text += line(f"S_{n}", RAW_SIZE) + line(f"K_{n}", K_RAW)
        text += line(f"D_{n}", [-0.1, 0.01, 0, 0, 0])
        text += line(f"R_{n}", turn if camera % 2 else np.eye(3)) + line(f"T_{n}", t)
        text += line(f"S_rect_{n}", SIZE) + line(f"R_rect_{n}", np.eye(3))
        text += line(f"P_rect_{n}", np.column_stack([K, K @ t]))
    (drive.parent / "calib_cam_to_cam.txt").write_text(text)
    return drive


def refused(match: str, root: Path, name: str | None = None, **options) -> None:
    with pytest.raises(InputError, match=match) as caught:
        open_kitti_raw(root, name, **options)
    assert str(caught.value).endswith(".")
    assert "\n" not in str(caught.value)


def test_a_synchronised_drive_is_read_as_it_is(tmp_path):
    drive = write_drive(tmp_path)
    source = open_source(SourceOptions(data=str(drive)))
    assert (source.dataset, source.name, len(source)) == ("kitti_raw", DRIVE, FRAMES)
    camera = source.camera
    assert (camera.fx, camera.cx, camera.cy, camera.width) == (50, 30, 16, 64)
    assert camera.baseline == pytest.approx(0.54)
    np.testing.assert_allclose(source.timestamps - FIRST, 0.1 * np.arange(FRAMES), atol=2e-6)
    expected = np.random.default_rng(12).integers(0, 256, (32, 64), np.uint8)
    np.testing.assert_array_equal(source.read(2)[1], expected)
    assert open_source(SourceOptions(data=str(drive), sensor="mono")).camera.monocular


def test_drives_are_found_below_the_folders_of_dates(tmp_path):
    drive = write_drive(tmp_path)
    for root in (tmp_path, drive.parent):
        assert open_source(SourceOptions(data=str(root))).name == DRIVE
        assert open_source(SourceOptions(data=str(root), seq=DRIVE)).name == DRIVE
    other = write_drive(tmp_path, "2011_09_28_drive_0001_sync")
    refused(f"several sequences; choose one with --seq: {DRIVE}, {other.name}", tmp_path)
    assert open_kitti_raw(tmp_path, other.name).name == other.name
    refused("no drive of KITTI raw", other / "image_00/data")


def test_colour_images_have_their_own_baseline(tmp_path):
    drive = write_drive(tmp_path, cameras=(2, 3))
    source = open_kitti_raw(drive)
    assert source.camera.baseline == pytest.approx(0.53)
    shutil.rmtree(drive / "image_03")
    refused("image_03/data: no images of the right camera.*--sensor mono", drive)
    assert open_kitti_raw(drive, monocular=True).camera.fx == 50


def test_an_unrectified_drive_is_rectified(tmp_path):
    source = open_kitti_raw(write_drive(tmp_path, DRIVE.replace("sync", "extract"), RAW_SIZE))
    camera = source.camera
    assert (camera.width, camera.height) == RAW_SIZE
    assert camera.baseline == pytest.approx(0.54, abs=1e-3)
    raw = np.random.default_rng(0).integers(0, 256, RAW_SIZE[::-1], np.uint8)
    left = source.read(0)[0]
    assert left.shape == raw.shape
    assert not np.array_equal(left, raw)


def test_calibrations_elsewhere(tmp_path):
    drive = write_drive(tmp_path, cameras=(2, 3))
    moved = (drive.parent / "calib_cam_to_cam.txt").rename(tmp_path / "rig.txt")
    refused("calib_cam_to_cam.txt: the calibration is missing; .* --calib", drive)
    assert open_kitti_raw(drive, calib=[moved]).camera.baseline == pytest.approx(0.53)
    one = "{focal: [60, 60], centre: [31, 15]}"
    (tmp_path / "own.yaml").write_text(f"left: {one}\nright: {one}\nbaseline: 0.4\n")
    assert open_kitti_raw(drive, calib=[tmp_path / "own.yaml"]).camera.baseline == 0.4
    with pytest.raises(InputError, match="images of a drive of KITTI raw; open the drive with"):
        open_source(SourceOptions(data=str(drive / "image_02/data"), sensor="mono"))
    moved.rename(drive / "calib_cam_to_cam.txt")
    assert open_kitti_raw(drive).camera.baseline == pytest.approx(0.53)


def test_bad_drives(tmp_path):
    drive = write_drive(tmp_path, size=(60, 30))
    refused("made for images of 64x32 .rectified. or 72x40 pixels but .* 60x30", drive)
    stamps = drive / "image_00/timestamps.txt"
    lines = stamps.read_text().splitlines()
    stamps.write_text("\n".join(reversed(lines)))
    refused("timestamps.txt: 3 of 4 times are not later", drive)
    stamps.write_text(lines[0])
    refused("timestamps.txt: only 1 rows for 4 images", drive)
    stamps.unlink()
    refused("timestamps.txt: cannot read", drive)
    stamps.write_text("\n".join(lines))
    (drive / "image_01/data/0000000002.png").unlink()
    refused("4 left and 3 right images, .*; restore .*image_01/data/0000000002", drive)


def test_an_excerpt_keeps_the_times_of_its_numbers(tmp_path):
    drive = write_drive(tmp_path, cameras=(0, 1))
    for camera in (0, 1):
        (drive / f"image_{camera:02}/data/0000000000.png").unlink()
    times = open_kitti_raw(drive).timestamps - FIRST
    np.testing.assert_allclose(times, [0.1, 0.2, 0.3], atol=2e-6)


def test_fixes_have_the_clock_of_the_images(tmp_path):
    pytest.importorskip("pymap3d")
    drive = write_drive(tmp_path, cameras=(0, 1))
    packets = drive / "oxts/data"
    packets.mkdir(parents=True)
    for k in range(2):
        (packets / f"{k:010d}.txt").write_text(" ".join(["49.0", "8.4", "116.0", *["0.1"] * 27]))
    (drive / "oxts/timestamps.txt").write_text(
        "2011-09-26 13:02:25.260000000\n2011-09-26 13:02:25.360000000\n"
    )
    first_image = float(open_kitti_raw(drive).timestamps[0])
    dated = read_fixes(drive / "oxts", first_image=first_image)
    np.testing.assert_allclose(dated.times - FIRST, [0.01, 0.11], atol=2e-6)
    np.testing.assert_allclose(read_fixes(drive).times, [0.0, 0.1], atol=2e-6)
