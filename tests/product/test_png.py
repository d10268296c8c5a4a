"""vslam's PNG decoder gives the same pixels as OpenCV, or leaves the file to OpenCV."""

from __future__ import annotations

import resource
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from vslam.datasets.image_files import check_not_empty, read_grey
from vslam.datasets.png import SIGNATURE, decode_png, is_cut_off
from vslam.support.errors import UnreadableImageError


def picture(height, width):
    """Make a smooth image with noise.

    Some patches are black or white, so that predictors give equal values.
    """
    rng = np.random.default_rng(height * 1000 + width)
    y, x = np.mgrid[:height, :width]
    image = 120 + 60 * np.sin(x / 9.0) + 50 * np.cos(y / 7.0) + rng.normal(0, 6, (height, width))
    image[(x // 16 + y // 16) % 5 == 0] = 255
    image[(x // 16 + y // 16) % 7 == 0] = 0
    return np.clip(image, 0, 255).astype(np.uint8)


def chunk(kind, body, *, damaged=False):
    check = zlib.crc32(kind + body) ^ damaged
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", check)


def header(image, depth=8, colour=0, interlaced=0):
    height, width = image.shape
    return chunk(b"IHDR", struct.pack(">II5B", width, height, depth, colour, 0, 0, interlaced))


def filtered(image, filters):
    """Filter the lines of an image as in the PNG specification, section 9.

    The number of the filter precedes each line.
    """
    padded = np.zeros((image.shape[0] + 1, image.shape[1] + 1), np.int64)
    padded[1:, 1:] = image
    a, b, c = padded[1:, :-1], padded[:-1, 1:], padded[:-1, :-1]
    p = a + b - c
    errors = np.stack([abs(p - a), abs(p - b), abs(p - c)])
    paeth = np.choose(np.argmin(errors, axis=0), [a, b, c])  # the first one if several are equal
    predictions = np.stack([np.zeros_like(a), a, b, (a + b) // 2, paeth])
    lines = (image - predictions[filters, np.arange(len(image))]) % 256
    return np.column_stack([filters, lines]).astype(np.uint8).tobytes()


def png(image, data, pieces=1, between=b""):
    size = -(-len(data) // pieces)
    parts = [chunk(b"IDAT", data[k : k + size]) for k in range(0, len(data), size)]
    return SIGNATURE + header(image) + between + b"".join(parts) + chunk(b"IEND", b"")


def by_opencv(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)


@pytest.mark.parametrize("filters", [[0], [1], [2], [3], [4], [0, 1, 2, 3, 4], [4, 3, 4, 1, 2]])
@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (33, 31), (97, 131)])
def test_every_filter_gives_the_pixels_that_were_filtered(filters, shape):
    image = picture(*shape)
    of_lines = np.resize(filters, len(image))
    data = png(image, zlib.compress(filtered(image, of_lines)), pieces=3)
    np.testing.assert_array_equal(decode_png(data), image)
    np.testing.assert_array_equal(by_opencv(data), image)


def test_files_written_by_opencv_are_read_here():
    image = picture(376, 500)
    done, data = cv2.imencode(".png", image)
    assert done
    np.testing.assert_array_equal(decode_png(data.tobytes()), image)


def test_chunks_that_change_no_pixel_are_passed_over_and_others_are_left_to_opencv():
    image = picture(20, 30)
    data = zlib.compress(filtered(image, np.ones(20, int)))
    plain = png(image, data, between=chunk(b"pHYs", bytes(9)) + chunk(b"tEXt", b"a\0b"))
    np.testing.assert_array_equal(decode_png(plain), image)
    transparent = png(image, data, between=chunk(b"tRNS", struct.pack(">H", 7)))
    assert decode_png(transparent) is None


def test_other_forms_are_left_to_opencv():
    image = picture(20, 30)
    data = zlib.compress(filtered(image, np.zeros(20, int)))
    body = chunk(b"IDAT", data) + chunk(b"IEND", b"")
    for form in ({"depth": 4}, {"colour": 2}, {"colour": 3}, {"interlaced": 1}):
        assert decode_png(SIGNATURE + header(image, **form) + body) is None
    for other in (np.dstack([image] * 3), image.astype(np.uint16) * 257):
        assert decode_png(cv2.imencode(".png", other)[1].tobytes()) is None
    assert decode_png(cv2.imencode(".bmp", image)[1].tobytes()) is None


def test_a_file_without_a_header_is_none():
    assert decode_png(SIGNATURE + chunk(b"IEND", b"")) is None


def test_a_line_too_wide_for_the_buffers_is_left_to_opencv():
    for width, found in ((1 << 15, True), ((1 << 15) + 1, False)):
        image = np.full((1, width), 7, np.uint8)
        data = png(image, zlib.compress(b"\0" + image.tobytes()))
        np.testing.assert_array_equal(by_opencv(data), image)
        assert (decode_png(data) is not None) is found


def test_damaged_image_data_is_not_taken_for_an_image():
    image = picture(20, 30)
    lines = filtered(image, np.full(20, 4))
    good = zlib.compress(lines)
    unknown_filter = bytearray(lines)
    unknown_filter[31 * 7] = 5
    for data in (
        zlib.compress(lines[:-1]),
        zlib.compress(lines + b"\0"),
        zlib.compress(bytes(unknown_filter)),
        good[:-1] + bytes([good[-1] ^ 1]),  # its own check sum
        good[:-8],
    ):
        assert decode_png(png(image, data)) is None
    for start, end in ((0, 8), (8, 33), (33, -12), (-12, None)):  # signature, header, data, end
        whole = png(image, good)
        assert decode_png(whole[:start] + whole[len(whole) if end is None else end :]) is None
    wrong = SIGNATURE + header(image) + chunk(b"IDAT", good, damaged=True) + chunk(b"IEND", b"")
    assert decode_png(wrong) is None


def test_no_mutation_is_accepted_with_other_pixels_than_opencvs():
    image = picture(24, 40)
    whole = png(image, zlib.compress(filtered(image, np.resize([4, 1, 2, 3], 24))), pieces=2)
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(2000):
        data = bytearray(whole)
        kind = rng.integers(3)
        at = int(rng.integers(len(data)))
        if kind == 0:
            data[at] ^= int(1 << rng.integers(8))
        elif kind == 1:
            del data[at:]
        else:
            del data[at : at + int(rng.integers(1, 30))]
        here = decode_png(bytes(data))
        refused += here is None
        if here is not None:
            np.testing.assert_array_equal(by_opencv(bytes(data)), here)
    assert refused > 1900


@pytest.mark.parametrize("keep", [0.3, 0.9])
def test_a_cut_file_is_named(tmp_path, keep):
    image = picture(60, 80)
    data = png(image, zlib.compress(filtered(image, np.full(60, 4))))
    path = tmp_path / "000007.png"
    path.write_bytes(data)
    np.testing.assert_array_equal(read_grey(path), image)
    path.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(UnreadableImageError, match=r"000007\.png: cannot be decoded"):
        read_grey(path)


def test_an_image_with_a_wrong_check_sum_is_named(tmp_path):
    image = picture(60, 80)
    data = bytearray(png(image, zlib.compress(filtered(image, np.full(60, 4)))))
    data[len(data) // 2] ^= 16
    path = tmp_path / "000008.png"
    path.write_bytes(data)
    with pytest.raises(UnreadableImageError, match=r"000008\.png: cannot be decoded"):
        read_grey(path)


def test_a_chunk_that_is_longer_than_the_file_is_seen_and_takes_no_memory(tmp_path):
    """OpenCV would allocate 2 GB for such a chunk."""
    grey = np.random.default_rng(0).integers(0, 256, (48, 64), dtype=np.uint8)
    data = cv2.imencode(".png", grey)[1].tobytes()
    at = data.index(b"IDAT") - 4
    promising = data[:at] + (2**31 - 1).to_bytes(4, "big") + data[at + 4 :]
    assert [is_cut_off(x) for x in (data, data + b"more", promising, data[:-1])] == [
        False, False, True, True,
    ]  # fmt: skip
    path = tmp_path / "a.png"
    path.write_bytes(promising)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(UnreadableImageError, match="cannot be decoded"):
        read_grey(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB


def test_a_path_with_a_zero_byte_is_no_file():
    for read in (read_grey, check_not_empty):
        with pytest.raises(UnreadableImageError):
            read(Path("a\0.png"))
