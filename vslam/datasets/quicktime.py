"""Reads the focal length that phones write into videos (QuickTime and MP4 files).

A file consists of atoms: a size, a type of four letters and a content, which may consist of atoms
(Apple, "QuickTime File Format"). The atom ``meta`` of the movie or of a track lists the names of
its values in ``keys``, and their values, by the place of the name, in ``ilst``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

_NAME = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
_LARGEST = 1 << 26  # bytes of the list of frames and all metadata; it is 1 MB for an hour
_TEXT, _SIGNED, _UNSIGNED = 1, 21, 22
_FLOATS = {23: ">f", 24: ">d"}


def focal_length_35_mm(file: Path) -> float | None:
    """Return the focal length in mm that a video states, as the equivalent for film of 36x24 mm.
    None if it states none.

    Raises:
        OSError: the file cannot be read.
    """
    movie = _movie(file)
    for meta in _all_meta(movie):
        try:
            value = _value(meta)
        except (struct.error, ValueError):
            continue
        if value is not None and 0.0 < value < float("inf"):
            return value
    return None


def _movie(file: Path) -> bytes:
    """Return the content of the atom ``moov``, empty if there is none."""
    with file.open("rb") as stream:
        end = stream.seek(0, 2)
        at = 0
        while at + 8 <= end:
            stream.seek(at)
            head = stream.read(16)
            size, kind = struct.unpack(">I4s", head[:8])
            begin = 8
            if size == 1 and len(head) == 16:
                size, begin = int.from_bytes(head[8:], "big"), 16
            size = end - at if size == 0 else size
            if size < begin:
                break
            if kind == b"moov":
                stream.seek(at + begin)
                return stream.read(min(size - begin, _LARGEST))
            at += size
    return b""


def _atoms(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield the types and the contents of atoms, up to one that is damaged."""
    at = 0
    while at + 8 <= len(content):
        size, kind = struct.unpack_from(">I4s", content, at)
        if not 8 <= size <= len(content) - at:
            return
        yield kind, content[at + 8 : at + size]
        at += size


def _all_meta(movie: bytes) -> Iterator[bytes]:
    """Yield the contents of the atoms ``meta`` of a movie and of its tracks."""
    parts = list(_atoms(movie))
    of_tracks = [atom for kind, part in parts if kind == b"trak" for atom in _atoms(part)]
    for kind, part in parts + of_tracks:
        if kind == b"meta":
            # In MP4 files, a version comes first.
            yield part if part[4:8] == b"hdlr" else part[4:]


def _value(meta: bytes) -> float | None:
    parts = dict(_atoms(meta))
    keys, at, place = parts.get(b"keys", b""), 8, 0
    while at + 8 <= len(keys):
        size = int.from_bytes(keys[at : at + 4], "big")
        place += 1
        if size < 8:
            return None
        if keys[at + 8 : at + size] == _NAME:
            item = dict(_atoms(parts.get(b"ilst", b""))).get(place.to_bytes(4, "big"), b"")
            return _number(dict(_atoms(item)).get(b"data", b""))
        at += size
    return None


def _number(data: bytes) -> float | None:
    """Return the number in an atom ``data``: a type, a language, and the value."""
    kind, value = int.from_bytes(data[:4], "big"), data[8:]
    if kind == _TEXT:
        return float(value.decode().strip().removesuffix("mm"))
    if kind in (_SIGNED, _UNSIGNED):
        return float(int.from_bytes(value[:8], "big", signed=kind == _SIGNED))
    return float(struct.unpack(_FLOATS[kind], value)[0]) if kind in _FLOATS else None
