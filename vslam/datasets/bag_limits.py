"""Limits the decompressed size of bags, because rosbags and mcap set no limit.

Without a limit, a bag of a few kilobytes could decompress to gigabytes. rosbags looks up its
decompression functions in tables, and mcap in two modules. This module replaces these functions
with functions that stop at a limit.
"""

from __future__ import annotations

import bz2
import logging
import shutil
import tempfile
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Protocol

MOST_BYTES = 2**29
"""Largest size of a decompressed chunk or message in bytes.

It is enough for an image of `vslam.support.untrusted.MOST_PIXELS` with four bytes per pixel.
Recorders write chunks of 0.8 to 4 MB.
"""

_FREE_BYTES = 2**30  # disk space that must remain free after a whole bag is decompressed
_log = logging.getLogger(__name__)


class _Decompressor(Protocol):
    eof: bool
    unused_data: bytes

    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


def limit_bags() -> None:
    """Make rosbags and mcap reject chunks, messages and files that are too large to decompress."""
    import lz4.frame
    from mcap import stream_reader
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader, storage_mcap

    ros2: Any = reader
    try:
        zstd = ros2.zstd
        if isinstance(zstd, SimpleNamespace):
            return
        kinds: dict[str, Callable[[], Any]] = {
            "bz2": bz2.BZ2Decompressor,
            "lz4": lz4.frame.LZ4FrameDecompressor,
            "zstd": zstd.ZstdDecompressor,
        }
        ros1.decompressors.update({name: _limited(kinds[name]) for name in ("bz2", "lz4")})
        storage_mcap.DECOMPRESSORS.update(
            {name: _limited_by_size(kinds[name]) for name in ("lz4", "zstd")}
        )

        mcap: Any = stream_reader
        mcap.lz4 = SimpleNamespace(decompress=_limited(kinds["lz4"]))
        mcap.zstandard = SimpleNamespace(decompress=_limited_by_size(kinds["zstd"]))

        def opened(file: Any, mode: str) -> _LimitedFile:
            return _LimitedFile(zstd.open(file, mode))

        ros2.zstd = SimpleNamespace(decompress=_limited(kinds["zstd"]), open=opened)
    except AttributeError as error:
        _log.warning(
            "cannot limit the memory that this version of rosbags uses (%s); a damaged bag may "
            "exhaust it",
            error,
        )


def unpack(make: Callable[[], _Decompressor], data: bytes, most: int) -> bytes:
    """Decompress ``data``, which consists of one or more compressed frames.

    Raises:
        ValueError: the result exceeds ``most`` bytes, or the data is truncated.
    """
    parts: list[bytes] = []
    room = most
    while data:
        decompressor = make()
        parts.append(decompressor.decompress(data, max_length=room + 1))
        room -= len(parts[-1])
        if room < 0:
            raise ValueError(f"a chunk unpacks to more than {most / 2**20:.0f} MB")
        if not decompressor.eof:
            raise ValueError("a compressed chunk is cut off")
        data = decompressor.unused_data or b""
    return parts[0] if len(parts) == 1 else b"".join(parts)


def _limited(make: Callable[[], _Decompressor]) -> Callable[[bytes], bytes]:
    return lambda data: unpack(make, data, MOST_BYTES)


def _limited_by_size(make: Callable[[], _Decompressor]) -> Callable[[bytes, int], bytes]:
    """``size`` is the decompressed size that the bag states."""
    return lambda data, size: unpack(make, data, min(size, MOST_BYTES))


class _LimitedFile:
    """A compressed bag that rosbags unpacks into a temporary folder while the disk has space."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self._left = shutil.disk_usage(tempfile.gettempdir()).free - _FREE_BYTES

    def __enter__(self) -> _LimitedFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, size: int = -1) -> bytes:
        data: bytes = self._file.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise ValueError(f"the unpacked bag does not fit into {tempfile.gettempdir()}")
        return data
