"""Limits on the memory that this process allocates when it reads untrusted files.

A small file can declare huge content, such as an image of 100,000 x 100,000 pixels or a zip member
that unpacks to 100 GB. The declared size is checked before memory is allocated.
"""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from vslam.support.errors import InputError

if TYPE_CHECKING:  # `vslam --help` loads this module and must not load NumPy
    from numpy.typing import NDArray

MOST_PIXELS = 2**27
"""Largest number of pixels of an image file (11,585 x 11,585). OpenCV itself allows eight times as
many pixels."""

_IMAGE_SUFFIXES = {
    ".png",
    ".jpg",
    ".jpeg",
    ".webp",
    ".bmp",
    ".tif",
    ".tiff",
    ".pgm",
    ".ppm",
    ".pnm",
}
_DEPTH_SUFFIXES = {".npy", ".pfm"}
_OPENCV_LIMIT = "OPENCV_IO_MAX_IMAGE_PIXELS"
_ANY_SIZE = 2**27  # bytes; any archive may unpack to this size
_MOST_PACKED = 20  # a larger archive must have at least 1/20 of its unpacked size
ARCHIVE_ERRORS = (
    EOFError, ValueError, KeyError, RuntimeError, OverflowError, zlib.error,
    zipfile.BadZipFile, zipfile.LargeZipFile,
)  # fmt: skip
"""Exceptions that NumPy, zipfile and zlib raise for a file that is not an archive of arrays, is
damaged or encrypted, or has an unknown compression method."""


def is_image(path: Path) -> bool:
    """Return whether a file has the suffix of an image format. Hidden files are no images."""
    return path.suffix.lower() in _IMAGE_SUFFIXES and not path.name.startswith(".")


def is_float_depth(path: Path) -> bool:
    """Return whether a file has the suffix of a format that often stores depth as floats."""
    return path.suffix.lower() in _DEPTH_SUFFIXES and not path.name.startswith(".")


def limit_images() -> None:
    """Make OpenCV reject images whose header declares more than ``MOST_PIXELS`` pixels.

    Call this function before OpenCV is imported, because OpenCV reads the limit at import.
    """
    os.environ.setdefault(_OPENCV_LIMIT, str(MOST_PIXELS))


def require_utf8(path: Path) -> None:
    """Check that a file name can be written into text files such as reports.

    Raises:
        InputError: the name is not UTF-8.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        shown = os.fsencode(path).decode(errors="replace")
        raise InputError(f"{shown}: this name is not UTF-8; rename it.") from None


def read_npz(path: Path, what: str, fix: str = "give another file") -> dict[str, NDArray[Any]]:
    """Read all arrays of an npz file. Python objects (pickles) are rejected.

    Args:
        what: the kind of file that is expected, with an article ("a map"), for error messages.
        fix: what the user can do, for error messages.

    Raises:
        InputError: the file is missing, damaged or not an npz file, or its arrays do not fit into
            the memory of this machine.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            _check_size(path, archive, what)
            return {
                member.filename.removesuffix(".npy"): _read_member(archive, member)
                for member in archive.infolist()
            }
    except InputError:
        raise
    except (OSError, *ARCHIVE_ERRORS) as error:
        why = error.strerror if isinstance(error, OSError) else None
        raise InputError(
            f"{path}: not {what} ({why or error or type(error).__name__}); {fix}."
        ) from error


def read_json(array: NDArray[Any]) -> Any:
    """Parse the JSON in an array of bytes.

    Raises:
        ValueError: the array does not hold bytes, or the bytes are not JSON.
    """
    if array.dtype != "uint8" or array.ndim != 1:  # bytes() of a number n would be n zeros
        raise ValueError("the header is not text")
    return json.loads(array.tobytes())


def require_memory(path: Path, what: str) -> None:
    """Check that unpacking an archive will not take too much memory.

    Files that are not archives are accepted.

    Raises:
        InputError: the unpacked archive would be too large.
    """
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            _check_size(path, archive, what)


def _check_size(path: Path, archive: zipfile.ZipFile, what: str) -> None:
    import psutil

    needed = sum(member.file_size for member in archive.infolist())
    packed = path.stat().st_size
    if needed > max(_ANY_SIZE, _MOST_PACKED * packed):
        raise InputError(
            f"{path}: unpacks from {packed / 2**20:.1f} MB to {needed / 2**20:.0f} MB, so it is "
            f"probably not {what}; give another file."
        )
    there = psutil.virtual_memory().available
    if needed > there:
        raise InputError(
            f"{path}: unpacks to {needed / 2**30:.1f} GB, but only {there / 2**30:.1f} GB of "
            f"memory are free; free some memory, or give another file if this is not {what}."
        )


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    with archive.open(member) as file:
        return read_npy(file, member.file_size, member.filename)


def read_npy(file: IO[bytes], size: int, name: str) -> NDArray[Any]:
    """Read the array of an npy file. Python objects (pickles) are rejected.

    Args:
        size: size of the file in bytes.
        name: name of the file, for error messages.

    Raises:
        ValueError: the file is not as long as its header says, holds Python objects, or has an
            unknown version of the format.
    """
    import numpy as np

    layout = np.lib.format
    readers = {(1, 0): layout.read_array_header_1_0, (2, 0): layout.read_array_header_2_0}
    version = layout.read_magic(file)
    if version not in readers:
        raise ValueError(f"npy format {version} in {name}")
    shape, fortran, dtype = readers[version](file)
    if dtype.hasobject:
        raise ValueError(f"{name} holds Python objects")
    count = 1
    for length in shape:
        count *= int(length)
    if min(shape, default=0) < 0 or count * dtype.itemsize != size - file.tell():
        raise ValueError(f"{name} is not as long as its header says")
    array = np.frombuffer(file.read(), dtype, count) if count else np.zeros(0, dtype)
    ordered = array.reshape(shape[::-1]).T if fortran else array.reshape(shape)
    return ordered.copy()  # writable and C-contiguous
