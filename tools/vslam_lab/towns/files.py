"""Files of a rendered sequence: atomic writes, checksums, and a lock against other processes."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.support.errors import InputError
from vslam.support.lock_file import locked

_IMAGE_BYTES, _DEPTH_BYTES = 450_000, 330_000  # generous estimates of the size of one file
_RESERVE = 200_000_000  # bytes that must stay free
_SAMPLED = 5  # number of frames whose checksums are compared in a quick check


def frame_files(folder: Path, frame: int, depth: bool) -> list[Path]:
    """Return the files of a frame's left and right image, and of its depth image if ``depth``."""
    names = ("image_0", "image_1", *(("depth_0",) if depth else ()))
    return [folder / name / f"{frame:06d}.png" for name in names]


def checksum(paths: Collection[Path]) -> str:
    """Return the first 64 bits of the SHA-256 digest of the concatenated files, in hexadecimal."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def size(paths: Collection[Path]) -> int:
    """Return the total size of the files in bytes; -1 if a file is missing."""
    try:
        return sum(path.stat().st_size for path in paths)
    except FileNotFoundError:
        return -1


def damaged_frames(folder: Path, manifest: dict[str, Any], *, thorough: bool) -> list[int]:
    """Return the frames whose files differ from the manifest of a completely rendered sequence.

    Args:
        manifest: the ``checksums`` and ``sizes`` of the files of each frame.
        thorough: whether all checksums are compared. Otherwise, all sizes and a few checksums are
            compared.
    """
    sums, depth = manifest["checksums"], bool(manifest["depth"])
    sizes = manifest.get("sizes") or [None] * len(sums)
    frames = range(len(sums))
    sampled = set(frames if thorough else np.linspace(0, len(sums) - 1, _SAMPLED).astype(int))
    damaged = []
    for k in frames:
        paths = frame_files(folder, k, depth)
        found = size(paths)
        wrong_size = found < 0 or (sizes[k] is not None and found != sizes[k])
        if wrong_size or (k in sampled and checksum(paths) != sums[k]):
            damaged.append(k)
    return damaged


def write(path: Path, data: bytes) -> None:
    """Write a file atomically."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    part.write_bytes(data)
    os.replace(part, path)


def write_png(path: Path, image: NDArray[Any], level: int) -> None:
    """Write a PNG file atomically, with a compression level from 0 to 9."""
    data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, level])[1]
    write(path, data.tobytes())


def lock_of(folder: Path) -> AbstractContextManager[None]:
    """Lock the folder of a sequence, so that no other process writes to it.

    If another process has locked it, wait until that process is done.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    return locked(folder.with_name(f".{folder.name}.lock"), folder, "is rendering it", wait=True)


def check_disk(cache: Path, frames: int, depth: bool) -> None:
    """Check that the disk has enough space for a given number of stereo frames.

    Raises:
        InputError: there is not enough space.
    """
    needed = frames * (2 * _IMAGE_BYTES + (_DEPTH_BYTES if depth else 0))
    existing = cache
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    free = shutil.disk_usage(existing).free
    if frames and needed + _RESERVE > free:
        raise InputError(
            f"{cache}: rendering {frames} frames needs {needed / 1e9:.1f} GB and "
            f"{_RESERVE / 1e9:.1f} GB to spare but {free / 1e9:.1f} GB are free; "
            "free some space or set $VSLAM_CACHE to another disk."
        )


@contextmanager
def writing(cache: Path) -> Iterator[None]:
    """Convert errors of the file system in the ``with`` block to an `InputError`."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"{cache}: cannot be written ({error.strerror}); give another folder with "
            "$VSLAM_CACHE, or with --out of vslam synth."
        ) from error
