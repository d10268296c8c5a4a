"""Messages about files that cannot be read say what these files are."""

from __future__ import annotations

import gzip
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from vslam.calibration.files import read_calibration
from vslam.datasets.detection import detect_dataset
from vslam.datasets.image_files import read_grey
from vslam.datasets.image_folders import open_images
from vslam.datasets.video import open_video
from vslam.support.errors import InputError
from vslam.support.file_kinds import identify, read_text, what_is_in

HEIC = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"
PAGE = b"\n<!DOCTYPE html>\n<html><body>Log in</body></html>\n"
OTHERS = {
    "a HEIC photo": (HEIC, "convert it to PNG"),
    "a pointer of Git LFS": (POINTER, "git lfs pull"),
    "a web page": (PAGE, "save the file that the page links to"),
    "a file compressed with gzip": (gzip.compress(b"a"), "unpack it"),
    "an OpenEXR image": (b"\x76\x2f\x31\x01\2\0\0\0", "32-bit floats"),
    "a RAW photo": (b"II*\0\x10\0\0\0CR\2\0", "develop it"),
    "a PDF document": (b"%PDF-1.7\n", "convert"),
}


def refusal(call, *args, **options) -> str:
    with pytest.raises(InputError) as caught:
        call(*args, **options)
    message = str(caught.value)
    assert message.endswith(".")
    assert "\n" not in message
    return message


def encoded(suffix: str, image: np.ndarray) -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


@pytest.mark.parametrize("name", OTHERS)
def test_a_file_of_another_kind_is_not_called_damaged(tmp_path, name):
    data, fix = OTHERS[name]
    path = tmp_path / "0.png"
    path.write_bytes(data)
    for call in (read_grey, lambda path: read_text(path, "a list"), open_video):
        options = {"monocular": True} if call is open_video else {}
        message = refusal(call, path, **options)
        assert name in message
        assert fix in message
        assert "damaged" not in message
        assert "again" not in message


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".webp", ".bmp"])
def test_an_image_that_is_cut_off_is_damaged(tmp_path, suffix):
    noise = np.random.default_rng(0).integers(0, 256, (40, 60), np.uint8)
    path = tmp_path / f"0{suffix}"
    path.write_bytes(encoded(suffix, noise))
    assert read_grey(path).shape == noise.shape
    path.write_bytes(path.read_bytes()[:40])
    kind = identify(path)
    assert kind is not None
    assert not kind.fix
    assert f"because {kind.name[2:]} is cut off or damaged; download it again" in refusal(
        read_grey, path
    )
    path.write_bytes(b"Not found\n")
    assert 'because it is a text ("Not found"); replace it' in refusal(read_grey, path)
    path.write_bytes(b"")
    assert "the file is missing or empty; download it again" in refusal(read_grey, path)
    path.write_bytes(b"\x05garbage")
    assert "damaged or not an image; download it again" in refusal(read_grey, path)


def test_an_image_of_floats_is_told_from_a_damaged_one(tmp_path):
    path = tmp_path / "0.tiff"
    path.write_bytes(encoded(".tiff", np.ones((4, 5), np.float32)))
    assert "an image of float32 values; convert it to 8 or 16 bits" in refusal(read_grey, path)


def test_archives_of_arrays_and_others(tmp_path):
    np.savez(tmp_path / "map.npz", a=np.zeros(3))
    assert "an archive of NumPy arrays (NPZ)" in refusal(detect_dataset, str(tmp_path / "map.npz"))
    with zipfile.ZipFile(tmp_path / "drive", "w") as archive:
        archive.writestr("left/0.png", b"")
    assert "a ZIP archive; unpack it" in refusal(detect_dataset, str(tmp_path / "drive"))
    assert "a ZIP archive; unpack it" in refusal(open_images, tmp_path / "drive", sensor="mono")
    np.save(tmp_path / "drive", np.zeros(3))
    assert "no such folder" in refusal(open_images, tmp_path / "none", sensor="mono")


def test_folders_say_what_they_hold(tmp_path):
    (tmp_path / "left").mkdir()
    assert what_is_in(tmp_path / "left") == ""
    for k in range(3):
        (tmp_path / "left" / f"{k}.heic").write_bytes(HEIC)
    (tmp_path / "left" / "notes.txt").write_text("a text")
    said = "but there are 3 files like 0.heic (a HEIC photo; convert it to PNG)"
    assert said in refusal(detect_dataset, str(tmp_path / "left"))
    assert "like left/0.heic (a HEIC" in refusal(detect_dataset, str(tmp_path))
    assert said in refusal(open_images, tmp_path / "left", sensor="mono")
    (tmp_path / "right").mkdir()
    (tmp_path / "right" / "0.png").write_bytes(encoded(".png", np.zeros((4, 5), np.uint8)))
    assert said in refusal(open_images, tmp_path)
    assert "a HEIC photo; convert" in refusal(detect_dataset, str(tmp_path / "left/0.heic"))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_texts_in_other_encodings(tmp_path, encoding):
    path = tmp_path / "a.yaml"
    text = "# 90\u00b0 lens\r\nleft: {size: [60, 40], focal: [50, 50], centre: [30, 20]}\r\n"
    path.write_bytes(text.encode(encoding))
    assert read_text(path, "a list") == text
    assert read_calibration([path]).left.fx == 50
    path.write_bytes(b"\0\1\2")
    assert "not a text file, or damaged; give a list" in refusal(read_text, path, "a list")
    assert "cannot read the file" in refusal(read_text, tmp_path, "a list")


def test_plain_texts_are_of_no_other_kind(tmp_path: Path):
    for text in ("BM 1 2", "P1: 1 0", "P0: 1 0", "PK,2", "1.0 rgb/1.png", "# comment", ""):
        (tmp_path / "a.txt").write_text(text)
        assert identify(tmp_path / "a.txt") is None
        assert read_text(tmp_path / "a.txt", "a list") == text
    assert identify(tmp_path / "none") is None
