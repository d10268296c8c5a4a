"""Decodes 8-bit grey PNG files, such as those of rectified stereo sequences, at high speed.

PNG predicts every pixel from its neighbours above and on the left, and stores only the difference.
This is called a line filter. OpenCV's decoder needs as much time to undo these filters as to
decompress the data, because every pixel depends on the pixel on its left.

This decoder decodes 32 lines at once. In each line, decoding is one pixel behind the line above it.
A vector register holds one pixel of each line.

Some filters predict each pixel from at most one neighbour. If a block of lines has only such
filters, it is decoded line by line, because this is faster. All files that OpenCV writes have only
such filters.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import inline, inner_kernel, kernel
from vslam.support.untrusted import MOST_PIXELS

SIGNATURE = b"\x89PNG\r\n\x1a\n"
GREY_8_BITS = (8, 0, 0, 0, 0)  # depth, colour type, compression, filter method, no interlacing
# Chunks that do not change pixels. Files with other chunks are not decoded here, because such a
# chunk may change pixels (transparency, orientation, animation).
WITHOUT_EFFECT = {b"gAMA", b"cHRM", b"sRGB", b"pHYs", b"tIME", b"tEXt", b"bKGD"}
LANES = 32  # lines decoded at once
_CHECK_SUM, _CHUNK, _NEXT_CHUNK = map(struct.Struct, (">I", ">I4s", ">II4s"))
_WIDEST = 1 << 15  # largest number of pixels per line; the buffers need 65 bytes for each of them


def decode_png(data: bytes) -> NDArray[np.uint8] | None:
    """Decode a PNG file of 8-bit grey levels to ``(H, W)`` uint8, exactly as libpng does.

    Returns None if the file has a different format, is interlaced, or is damaged according to its
    checksums.
    """
    import deflate

    try:
        size, compressed = _contents(data)
        height, width = size
        filtered = deflate.zlib_decompress(compressed, height * (width + 1))
    except (ValueError, struct.error, deflate.DeflateError):
        return None
    if len(filtered) != height * (width + 1):
        return None
    image = np.empty((height, width), np.uint8)
    lines = np.frombuffer(filtered, np.uint8).reshape(height, width + 1)
    return image if unfilter(lines, image) else None


def _contents(data: bytes) -> tuple[tuple[int, int], bytes]:
    """Read the height, the width and the compressed image data of a PNG file."""
    chunks = _chunks(data)
    kind, header = next(chunks, (b"", b""))
    width, height, *form = struct.unpack(">II5B", header)
    if kind != b"IHDR" or tuple(form) != GREY_8_BITS:
        raise ValueError("not a PNG of 8-bit grey levels without interlacing")
    if not 0 < width * height <= MOST_PIXELS or width > _WIDEST:
        raise ValueError("too large, or empty")
    parts: list[memoryview] = []
    for kind, body in chunks:
        if kind == b"IDAT":
            parts.append(body)
        elif kind not in WITHOUT_EFFECT:
            raise ValueError(f"unknown chunk {kind!r}")
    return (height, width), b"".join(parts)


def _chunks(data: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Yield the kind and the contents of every chunk of a PNG file except the last chunk."""
    import deflate

    if not data.startswith(SIGNATURE):
        raise ValueError("not a PNG file")
    view = memoryview(data)
    at = len(SIGNATURE)
    length, kind = _CHUNK.unpack_from(data, at)
    while True:
        end = at + 8 + length
        if kind == b"IEND":
            if _CHECK_SUM.unpack_from(data, end) != (deflate.crc32(view[at + 4 : end]),):
                raise ValueError("wrong checksum")
            return
        expected, next_length, next_kind = _NEXT_CHUNK.unpack_from(data, end)
        if deflate.crc32(view[at + 4 : end]) != expected:
            raise ValueError("wrong checksum")
        yield kind, view[at + 8 : end]
        at, length, kind = end + 4, next_length, next_kind


def is_cut_off(data: bytes) -> bool:
    """Return whether a PNG file is truncated, so that one of its chunks is incomplete.

    libpng would allocate the stated length of the chunk, up to 2 GB, before it reads the chunk.
    """
    at = len(SIGNATURE)
    while data.startswith(SIGNATURE) and at + _CHUNK.size <= len(data):
        length, kind = _CHUNK.unpack_from(data, at)
        at += _CHUNK.size + length + _CHECK_SUM.size
        if at > len(data):
            return True
        if kind == b"IEND":
            return False
    return False


def decode_with_opencv(data: bytes, flags: int) -> NDArray[Any] | None:
    """Decode an image file of any format using ``cv2.imdecode``; None if it cannot be decoded.

    Raises:
        cv2.error: the image is too large, or the file is empty.
    """
    import cv2

    return None if is_cut_off(data) else cv2.imdecode(np.frombuffer(data, np.uint8), flags)


@kernel
def unfilter(lines, image):
    """Undo the line filters of a decompressed image.

    The lines are decoded in blocks of `LANES`. Each step decodes one pixel of every line of the
    block. In each line, decoding is one pixel behind the line above it, so that the neighbours that
    predict a pixel are already decoded.

    Args:
        lines: ``(H, W + 1)`` uint8. Each line begins with the number of its filter.
        image: ``(H, W)`` uint8, output.

    Returns:
        False if a line has an unknown filter, otherwise True.
    """
    height, width = image.shape
    n = np.uintp(width)
    steps = width + LANES - 1
    # A lane is the part of a vector register that decodes one line of the block. Both arrays store
    # the lanes of each step side by side. ``decoded`` has an additional first lane, which contains
    # the line above the block. It begins with two steps of zeros, which are the pixels left of the
    # image.
    coded = np.zeros(steps * LANES, np.uint8)
    decoded = np.zeros((steps + 2) * (LANES + 1), np.uint8)
    left, above = np.zeros(LANES, np.int16), np.zeros(LANES, np.int16)
    corner = np.zeros(LANES, np.int16)
    is_average = np.zeros(LANES, np.bool_)
    for first in range(0, height, LANES):
        count = min(LANES, height - first)
        if largest_filter(lines[first : first + count]) <= 2:
            for y in range(first, first + count):
                add_prediction(lines[y], image[max(y - 1, 0)], image[y], y == 0)
            continue
        for lane in range(count):
            line = lines[first + lane]
            if not choose_filter(line[0], lane, left, above, corner, is_average):
                return False
            skewed = coded[lane * (LANES + 1) :]
            for x in range(n):
                skewed[x * np.uintp(LANES)] = line[x + np.uintp(1)]
        if first > 0:
            line_above = image[first - 1]
            for x in range(n):
                decoded[(x + np.uintp(1)) * np.uintp(LANES + 1)] = line_above[x]
        advance(coded, decoded, left, above, corner, is_average, steps)
        for lane in range(count):
            target = image[first + lane]
            skewed = decoded[(lane + 2) * (LANES + 1) + lane + 1 :]
            for x in range(n):
                target[x] = skewed[x * np.uintp(LANES + 1)]
    return True


@inner_kernel
def largest_filter(lines):
    """Return the largest filter number of the lines."""
    largest = np.uint8(0)
    for y in range(len(lines)):
        largest = max(largest, lines[y, 0])
    return largest


@inner_kernel
def add_prediction(line, line_above, out, is_first):
    """Decode a line that has the filter None, Sub or Up."""
    n, one = np.uintp(len(out)), np.uintp(1)
    if line[0] == 1:
        value = np.uint8(0)
        for x in range(n):
            value = np.uint8(value + line[x + one])
            out[x] = value
    elif line[0] == 2 and not is_first:
        for x in range(n):
            out[x] = np.uint8(line[x + one] + line_above[x])
    else:
        for x in range(n):
            out[x] = line[x + one]


@inline
def choose_filter(number, lane, left, above, corner, is_average):
    """Set the masks of one line of a block for its filter (PNG specification, section 9.2).

    The masks select which neighbours Paeth's predictor uses. The filters Sub and Up are special
    cases of this predictor. If the pixels above are set to zero, it predicts the left pixel (Sub).
    If the left pixels are set to zero, it predicts the pixel above (Up).

    Returns:
        Whether the filter is known.
    """
    left[lane] = 255 if number == 1 or number == 4 else 0
    above[lane] = 255 if number == 2 or number == 4 else 0
    corner[lane] = 255 if number == 4 else 0
    is_average[lane] = number == 3
    return number <= 4


@inner_kernel
def advance(coded, decoded, left, above, corner, is_average, steps):
    """Decode a block of lines. Each step decodes one pixel of every line (see `unfilter`)."""
    lanes, row, one = np.uintp(LANES), np.uintp(LANES + 1), np.uintp(1)
    for step in range(np.uintp(steps)):
        before = decoded[step * row : (step + one) * row]  # two steps ago
        last = decoded[(step + one) * row : (step + np.uintp(2)) * row]
        out = decoded[(step + np.uintp(2)) * row + one : (step + np.uintp(3)) * row]
        code = coded[step * lanes : (step + one) * lanes]
        for lane in range(lanes):
            a_all, b_all = np.int16(last[lane + one]), np.int16(last[lane])
            a, b = np.int16(a_all & left[lane]), np.int16(b_all & above[lane])
            c = np.int16(np.int16(before[lane]) & corner[lane])
            from_c_b, from_c_a = np.int16(b - c), np.int16(a - c)
            error_a, error_b = np.int16(abs(from_c_b)), np.int16(abs(from_c_a))
            error_c = np.int16(abs(np.int16(from_c_a + from_c_b)))
            other = b if error_b <= error_c else c
            predicted = a if (error_a <= error_b) & (error_a <= error_c) else other
            average = np.int16(np.int16(a_all + b_all) >> 1)
            predicted = average if is_average[lane] else predicted
            out[lane] = np.uint8(np.int16(code[lane]) + predicted)
