"""Compressed bags are read, unless they decompress to too much data."""

from __future__ import annotations

import bz2
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from source_files import LEFT, RIGHT, write_bag

pytest.importorskip("rosbags", reason="pip install 'vslam[bag]'")
import lz4.frame
from rosbags.rosbag2 import reader as ros2

from vslam.datasets import bag_limits
from vslam.datasets.bag import open_bag
from vslam.support.errors import BrokenSourceError, InputError

KINDS = [("ros1", "bz2"), ("ros1", "lz4"), ("ros2", "file"), ("ros2", "message"),
         ("mcap", "storage"), ("folder", "storage")]  # fmt: skip
STAMPS = [10**8, 2 * 10**8, 3 * 10**8]


def images(shape: tuple[int, int] = (48, 64)) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, shape, dtype=np.uint8) for _ in STAMPS]


def compressed(folder: Path, kind: str, compression: str, sides: dict) -> Path:
    name = "a.bag" if kind == "ros1" else "a"
    return write_bag(folder / name, kind, sides, STAMPS, compression=compression)


def read_all(path: Path) -> list[np.ndarray]:
    return [frame.read(map) for frame in open_bag(path).frames()]


@pytest.mark.parametrize(("kind", "compression"), KINDS)
def test_compressed_bags_are_read(tmp_path: Path, kind: str, compression: str):
    left, right = images(), images()[::-1]
    path = compressed(tmp_path, kind, compression, {LEFT: left, RIGHT: right})
    frames = read_all(path)
    assert len(frames) == 3
    for (one, other), wanted in zip(frames, zip(left, right, strict=True), strict=True):
        assert np.array_equal(one, wanted[0])
        assert np.array_equal(other, wanted[1])


@pytest.mark.parametrize(("kind", "compression"), KINDS)
def test_what_unpacks_to_too_much_is_refused(tmp_path, monkeypatch, kind: str, compression: str):
    black = [np.zeros((1000, 1000), np.uint8)] * 3
    path = compressed(tmp_path, kind, compression, {LEFT: black, RIGHT: black})
    assert sum(p.stat().st_size for p in tmp_path.rglob("*") if p.is_file()) < 100_000
    monkeypatch.setattr(bag_limits, "MOST_BYTES", 500_000)
    free = shutil.disk_usage(tmp_path)._replace(free=bag_limits._FREE_BYTES + 10**6)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: free)
    with pytest.raises((InputError, BrokenSourceError), match=r"unpacks to more|does not fit"):
        read_all(path)


@pytest.mark.parametrize("count", ["many", "-3", "0", "2.5"])
def test_metadata_that_counts_no_messages(tmp_path: Path, count: str):
    path = write_bag(tmp_path / "a", "folder", {LEFT: images(), RIGHT: images()}, STAMPS)
    file = path / "metadata.yaml"
    text = re.sub(r"(?m)^(  - message_count:) 3$", rf"\1 {count}", file.read_text())
    assert text != file.read_text()
    file.write_text(text)
    assert open_bag(path).n_expected is None
    assert len(read_all(path)) == 3


@pytest.mark.parametrize(
    ("make", "compress"),
    [(bz2.BZ2Decompressor, bz2.compress), (lz4.frame.LZ4FrameDecompressor, lz4.frame.compress)],
    ids=["bz2", "lz4"],
)
def test_several_frames_count_together(make, compress):
    data = compress(b"a" * 600) + compress(b"b" * 600)
    assert bag_limits.unpack(make, data, 1200) == b"a" * 600 + b"b" * 600
    with pytest.raises(ValueError, match="more than"):
        bag_limits.unpack(make, data, 1199)
    with pytest.raises(ValueError, match="cut off"):
        bag_limits.unpack(make, compress(b"a" * 600)[:-12], 1200)


def test_a_library_that_cannot_be_limited_is_told(monkeypatch, caplog):
    monkeypatch.delattr(ros2, "zstd")
    bag_limits.limit_bags()
    assert "cannot limit the memory" in caplog.text


def test_limiting_twice_is_limiting_once():
    bag_limits.limit_bags()
    before = ros2.zstd
    bag_limits.limit_bags()
    assert ros2.zstd is before
