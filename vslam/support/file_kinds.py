"""Tells what kind of file a file is, so that a message about an unreadable file is true.

A file that vslam cannot read is damaged only if it has no known format, or the format that was
expected.
"""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass
from pathlib import Path

from vslam.support.errors import InputError

_HEAD_BYTES = 512
_NO_TEXT = re.compile(r"[\0-\x08\x0e-\x1b]")
_TO_PNG = "convert it to PNG"
_DEVELOP = "develop it to PNG or TIFF"
_UNPACK = "unpack it"
_AS_SOURCE = "give it with --data"
_CONVERT = "convert its contents"


@dataclass(frozen=True)
class FileKind:
    """A kind of file.

    Attributes:
        name: the name with its article, such as "a ZIP archive".
        fix: what the user can do with such a file. It is empty for images that vslam reads.
        is_stream: whether it may be read as a video or bag.
    """

    name: str
    fix: str = ""
    is_stream: bool = False


_KINDS: tuple[tuple[int, bytes, FileKind], ...] = (  # position and value of the bytes that tell it
    (0, b"\x89PNG\r\n", FileKind("a PNG image")),
    (0, b"\xff\xd8\xff", FileKind("a JPEG image")),
    (8, b"CR\x02", FileKind("a RAW photo", _DEVELOP)),
    (0, b"II*\0", FileKind("a TIFF image")),
    (0, b"MM\0*", FileKind("a TIFF image")),
    (8, b"WEBP", FileKind("a WebP image")),
    *((14, size + b"\0\0\0", FileKind("a BMP image")) for size in (b"\x28", b"\x6c", b"\x7c")),
    *((0, f"P{k}\n".encode(), FileKind("a PNM image")) for k in range(1, 7)),
    (0, b"Pf\n", FileKind("a PFM image")),
    (0, b"GIF8", FileKind("a GIF image", _TO_PNG, True)),
    (0, b"\x76\x2f\x31\x01", FileKind("an OpenEXR image", "convert it to a TIFF of 32-bit floats")),
    (4, b"jP  \r\n", FileKind("a JPEG 2000 image", _TO_PNG)),
    (4, b"JXL \r\n", FileKind("a JPEG XL image", _TO_PNG)),
    (0, b"\xff\x0a", FileKind("a JPEG XL image", _TO_PNG)),
    *(
        (4, b"ftyp" + brand, FileKind("a HEIC photo", _TO_PNG))
        for brand in (b"hei", b"hev", b"mif1", b"msf1")
    ),
    (4, b"ftypavi", FileKind("an AVIF image", _TO_PNG)),
    (4, b"ftypcrx", FileKind("a RAW photo", _DEVELOP)),
    (0, b"FUJIFILMCCD-RAW", FileKind("a RAW photo", _DEVELOP)),
    *(
        (0, magic, FileKind("a RAW photo", _DEVELOP))
        for magic in (b"IIU\0", b"IIRO", b"IIRS", b"MMOR", b"FOVb", b"\0MRM")
    ),
    (4, b"ftyp", FileKind("an MP4 video", _AS_SOURCE, True)),
    (8, b"AVI ", FileKind("an AVI video", _AS_SOURCE, True)),
    (0, b"\x1a\x45\xdf\xa3", FileKind("a Matroska video", _AS_SOURCE, True)),
    (0, b"#ROSBAG V", FileKind("a bag of ROS 1", _AS_SOURCE, True)),
    (0, b"\x89MCAP0\r\n", FileKind("an MCAP file", _AS_SOURCE, True)),
    (0, b"SQLite format 3", FileKind("an SQLite database", _AS_SOURCE, True)),
    *((0, magic, FileKind("a ZIP archive", _UNPACK)) for magic in (b"PK\3\4", b"PK\5\6")),
    (0, b"\x1f\x8b", FileKind("a file compressed with gzip", _UNPACK)),
    (0, b"BZh", FileKind("a file compressed with bzip2", _UNPACK)),
    (0, b"\xfd7zXZ\0", FileKind("a file compressed with xz", _UNPACK)),
    (0, b"\x28\xb5\x2f\xfd", FileKind("a file compressed with Zstandard", _UNPACK)),
    (0, b"7z\xbc\xaf", FileKind("a 7z archive", _UNPACK)),
    (0, b"Rar!", FileKind("a RAR archive", _UNPACK)),
    (257, b"ustar", FileKind("a tar archive", _UNPACK)),
    (0, b"\x93NUMPY", FileKind("a NumPy array", _CONVERT)),
    (0, b"\x89HDF", FileKind("an HDF5 file", _CONVERT)),
    (0, b"MATLAB 5.0", FileKind("a MATLAB file", _CONVERT)),
    (0, b"PAR1", FileKind("a Parquet table", _CONVERT)),
    (0, b"%PDF", FileKind("a PDF document", _CONVERT)),
    (
        0,
        b"version https://git-lfs",
        FileKind("a pointer of Git LFS", "fetch the file itself with 'git lfs pull'"),
    ),
)
_NPZ = FileKind("an archive of NumPy arrays (NPZ)", _CONVERT)
_WEB_PAGE = FileKind("a web page", "save the file that the page links to, which may need a login")
_RAW_SUFFIXES = {".dng", ".nef", ".arw", ".pef", ".srw", ".nrw", ".3fr"}  # they begin like TIFF
_BOMS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"),
         (codecs.BOM_UTF16_BE, "utf-16"))  # fmt: skip


def _head(path: Path) -> bytes:
    """Read the first bytes of a file; none if it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except (OSError, ValueError):  # ValueError: the path has a zero byte
        return b""


def identify(path: Path) -> FileKind | None:
    """Tell the kind of a file from its first bytes; None for plain text and unknown contents."""
    head = _head(path)
    if head and path.suffix.lower() in _RAW_SUFFIXES:
        return FileKind("a RAW photo", _DEVELOP)
    found = next((kind for at, magic, kind in _KINDS if head.startswith(magic, at)), None)
    if found is not None and head.startswith(b"PK\x03\x04"):
        first_member = head[30 : 30 + int.from_bytes(head[26:28], "little")]
        return _NPZ if first_member.endswith(b".npy") else found
    if head.lstrip(codecs.BOM_UTF8 + b" \t\r\n").lower().startswith((b"<!doctype html", b"<html")):
        return _WEB_PAGE
    return found


def why_not_an_image(path: Path) -> str:
    """Say why a file, which no decoder accepts, is not an image, for an UnreadableImageError."""
    if (kind := identify(path)) is not None:
        if kind.fix:
            return f"{kind.name}, which is not read as an image; {kind.fix}."
        return (
            f"cannot be decoded, because {kind.name[2:]} is cut off or damaged; download it again."
        )
    head = _head(path)
    if not head:
        return "the file is missing or empty; download it again."
    if head.isascii() and not _NO_TEXT.search(begin := head.decode()):
        begin = " ".join(begin.split())[:40]
        return f'cannot be decoded, because it is a text ("{begin}"); replace it.'
    return "cannot be decoded, because it is damaged or not an image; download it again."


def what_is_in(folder: Path) -> str:
    """Describe the files in a folder without readable images and in its subfolders.

    Returns:
        Text for a message, such as ``, but there are 12 files like a.heic (a HEIC photo; convert it
        to PNG)``. It is empty if there are no such files.
    """
    files = sorted(path for level in ("*", "*/*") for path in folder.glob(level) if path.is_file())
    for path in {path.suffix: path for path in files[::-1]}.values():
        if (kind := identify(path)) is not None and kind.fix:
            n = sum(other.suffix == path.suffix for other in files)
            like = f"are {n} files like" if n > 1 else "is"
            return f", but there {like} {path.relative_to(folder)} ({kind.name}; {kind.fix})"
    return ""


def read_text(path: Path, wanted: str) -> str:
    """Read a text file in UTF-8, UTF-16 with a byte order mark, or Latin-1.

    Args:
        wanted: what the file should be, with an article, for messages.

    Raises:
        InputError: the file is missing, unreadable or no text.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{path}: cannot read the file ({error.strerror}); give {wanted}."
        ) from error
    if (kind := identify(path)) is not None:
        raise InputError(f"{path}: {kind.name} instead of {wanted}; {kind.fix or 'replace it'}.")
    encoding = next((name for mark, name in _BOMS if data.startswith(mark)), "utf-8")
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    if _NO_TEXT.search(text):
        raise InputError(
            f"{path}: not a text file, or damaged; give {wanted}, or download the file again."
        )
    return text
