"""Detects the kind of a source (a data set, folder, video, bag or camera) from its files."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from vslam.datasets.euroc import is_euroc
from vslam.datasets.image_folders import has_images
from vslam.datasets.kitti_raw import is_kitti_raw
from vslam.datasets.tum import is_tum
from vslam.support.errors import InputError
from vslam.support.file_kinds import identify, what_is_in
from vslam.support.untrusted import is_image

_BAG_SUFFIXES = {".bag", ".mcap", ".db3"}
_TEXTS = {".txt", ".csv", ".yaml", ".yml", ".json", ".md", ".py", ".html"}
_ARCHIVES = {".zip", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".zst", ".7z", ".rar"}
_URL = re.compile(r"[a-z][a-z0-9+.-]*://", re.IGNORECASE)


def _with_subfolders(folder: Path) -> tuple[Path, ...]:
    return (folder, *(path for path in folder.glob("*") if path.is_dir()))


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag of ROS, which may be a file or a folder."""
    return path.suffix.lower() in _BAG_SUFFIXES or (path / "metadata.yaml").is_file()


# The first kind whose test succeeds is chosen. The order matters: the folders of data sets also
# contain images, so that folders of images must come last.
_KINDS: tuple[tuple[str, str, Callable[[Path], bool]], ...] = (
    (
        "kitti",
        "a folder 'sequences'",
        lambda path: any((path / name).is_dir() for name in ("sequences", "dataset/sequences")),
    ),
    (
        "kitti_raw",
        "a folder 'image_00/data' or 'image_02/data'",
        lambda path: any(
            is_kitti_raw(folder) for folder in (*_with_subfolders(path), *path.glob("*/*/"))
        ),
    ),
    (
        "euroc",
        "a folder 'mav0'",
        lambda path: any(is_euroc(folder) for folder in _with_subfolders(path)),
    ),
    (
        "tum",
        "a file rgb.txt",
        lambda path: any(is_tum(folder) for folder in _with_subfolders(path)),
    ),
    (
        "bag",
        f"a file {', '.join(sorted(_BAG_SUFFIXES))} or metadata.yaml",
        is_bag,
    ),
    ("images", "images (png, jpg, ...) in the folder or in left/ and right/", has_images),
    ("video", "any other file, as a video", Path.is_file),
)


def detect_dataset(data: str) -> str:
    """Detect which value of ``--dataset`` applies to a folder, a file, a device number or a URL.

    Raises:
        InputError: there is no such file or folder, or its kind is not recognised.
    """
    if _URL.match(data):
        return "camera"
    path = Path(data)
    if path.is_file() and is_image(path):
        raise InputError(f"{data}: a single image; give its folder with --data.")
    kind = identify(path)
    if kind is not None and kind.fix and not kind.is_stream:
        raise InputError(f"{data}: {kind.name}; {kind.fix}, and give the images with --data.")
    if path.is_file() and path.suffix.lower() in _ARCHIVES:
        raise InputError(f"{data}: an archive; unpack it and give the folder with --data.")
    if path.is_file() and path.suffix.lower() in _TEXTS:
        raise InputError(
            f"{data}: not images; give a folder of images, a video or a bag with --data."
        )
    if path.is_dir() and not any(path.iterdir()):
        raise InputError(f"{data}: the folder is empty; give another one with --data.")
    if path.exists():
        dataset = _kind_of(path)
        if dataset is not None:
            return dataset
        looked = "; ".join(f"{what} ({kind})" for kind, what, _ in _KINDS)
        raise InputError(
            f"{data}: not a known data set{_nearest(path) or what_is_in(path)}; give its kind "
            f"with --dataset. Looked for {looked}."
        )
    if data.isdecimal():
        return "camera"
    raise InputError(
        f"{data}: no such file or folder; with --data, give a data set, a folder of images, a "
        "video, a bag, the number of a camera or a URL."
    )


def _kind_of(path: Path) -> str | None:
    return next((kind for kind, _, holds in _KINDS if holds(path)), None)


def _nearest(path: Path) -> str:
    """Name a data set in the parent folder or in a subfolder, for an error message."""
    if path.resolve().name == "sequences":
        return f", but {path.resolve().parent} looks like kitti (name that folder)"
    for inside in sorted(path.glob("*")):
        with suppress(OSError):  # a folder that this user may not read
            if inside.is_dir() and (kind := _kind_of(inside)) is not None:
                return f", but {inside} looks like {kind} (name that folder)"
    return ""
