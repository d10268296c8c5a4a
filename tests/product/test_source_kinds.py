"""Detection of the kind of a source from its files."""

from __future__ import annotations

import pytest

from vslam.datasets.detection import detect_dataset
from vslam.support.errors import InputError


@pytest.mark.parametrize(
    ("data", "dataset"),
    [
        ("drive.mp4", "video"),
        ("drive.bag", "bag"),
        ("drive.MCAP", "bag"),
        ("drive_0.db3", "bag"),
        ("0", "camera"),
        ("rtsp://user:secret@host:554/stream/1", "camera"),
    ],
)
def test_files_devices_and_urls(tmp_path, monkeypatch, data, dataset):
    monkeypatch.chdir(tmp_path)
    if dataset != "camera":
        (tmp_path / data).touch()
    assert detect_dataset(data) == dataset


@pytest.mark.parametrize(
    ("file", "dataset"),
    [
        ("sequences/00/image_0/000000.png", "kitti"),
        ("dataset/sequences/00/times.txt", "kitti"),
        ("image_00/data/0000000000.png", "kitti_raw"),
        ("2011_09_26/2011_09_26_drive_0005_sync/image_02/data/0.png", "kitti_raw"),
        ("mav0/cam0/data.csv", "euroc"),
        ("V1_01_easy/mav0/cam0/data.csv", "euroc"),
        ("rgb.txt", "tum"),
        ("rgbd_dataset_freiburg1_desk/rgb.txt", "tum"),
        ("1.png", "images"),
        ("image_0/1.jpg", "images"),
        ("cam0/data/1.png", "images"),
        ("image_2/1.png", "images"),
        ("rgb/1.png", "images"),
        ("metadata.yaml", "bag"),
    ],
)
def test_folders(tmp_path, file, dataset):
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).touch()
    assert detect_dataset(str(tmp_path)) == dataset


def test_what_is_not_known_is_told_what_was_looked_for(tmp_path):
    with pytest.raises(InputError, match="the folder is empty; give another one"):
        detect_dataset(str(tmp_path))
    (tmp_path / "1.png").touch()
    with pytest.raises(InputError, match="a single image; give its folder"):
        detect_dataset(str(tmp_path / "1.png"))
    (tmp_path / "1.png").rename(tmp_path / "notes.txt")
    with pytest.raises(InputError) as caught:
        detect_dataset(str(tmp_path))
    for word in ("sequences", "mav0", "rgb.txt", "metadata.yaml", "left/", "video"):
        assert word in str(caught.value)
    with pytest.raises(InputError, match=r"notes.txt: not images; give a folder"):
        detect_dataset(str(tmp_path / "notes.txt"))
    (tmp_path / "notes.txt").rename(tmp_path / "drive.tar.gz")
    with pytest.raises(InputError, match="an archive; unpack it"):
        detect_dataset(str(tmp_path / "drive.tar.gz"))
    (tmp_path / "drive" / "left").mkdir(parents=True)
    (tmp_path / "drive" / "left" / "1.png").touch()
    with pytest.raises(InputError, match=r"but .*drive looks like images \(name that folder\)"):
        detect_dataset(str(tmp_path))
    (tmp_path / "sequences" / "00").mkdir(parents=True)
    with pytest.raises(InputError, match="looks like kitti"):
        detect_dataset(str(tmp_path / "sequences"))
    with pytest.raises(InputError, match="no such file or folder"):
        detect_dataset(str(tmp_path / "nothing.mp4"))
