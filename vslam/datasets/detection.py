"""Which kind of source somebody means, from what is there."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from vslam.datasets.euroc import is_euroc
from vslam.datasets.image_files import is_image
from vslam.datasets.image_folders import has_images
from vslam.errors import InputError

_BAG_SUFFIXES = {".bag", ".mcap", ".db3"}
_URL = re.compile(r"[a-z][a-z0-9+.-]*://", re.IGNORECASE)


def _within(folder: Path) -> tuple[Path, ...]:
    """A folder and those in it: a data set may hold several sequences."""
    return (folder, *(path for path in folder.glob("*") if path.is_dir()))


# In this order: the folders of data sets hold images, too.
_KINDS: tuple[tuple[str, str, Callable[[Path], bool]], ...] = (
    (
        "kitti",
        "a folder 'sequences'",
        lambda path: any((path / name).is_dir() for name in ("sequences", "dataset/sequences")),
    ),
    (
        "euroc",
        "a folder 'mav0'",
        lambda path: any(is_euroc(folder) for folder in _within(path)),
    ),
    (
        "tum",
        "a file rgb.txt",
        lambda path: any((folder / "rgb.txt").is_file() for folder in _within(path)),
    ),
    (
        "bag",
        f"a file {', '.join(sorted(_BAG_SUFFIXES))} or metadata.yaml",
        lambda path: path.suffix.lower() in _BAG_SUFFIXES or (path / "metadata.yaml").is_file(),
    ),
    ("images", "images, in it or in left/ and right/", has_images),
    ("video", "any other file, as a video", Path.is_file),
)


def detect_dataset(data: str) -> str:
    """The ``--dataset`` that a folder, a file, the number of a device or a URL belongs to.

    Raises:
        InputError: nothing there, or nothing known.
    """
    if _URL.match(data):
        return "camera"
    path = Path(data)
    if path.is_file() and is_image(path):
        raise InputError(f"{data}: one image; name the folder that it is in with --data.")
    if path.is_dir() and not any(path.iterdir()):
        raise InputError(f"{data}: the folder is empty; name another one with --data.")
    if path.exists():
        for kind, _, holds in _KINDS:
            if holds(path):
                return kind
        looked = "; ".join(f"{what} ({kind})" for kind, what, _ in _KINDS)
        raise InputError(
            f"{data}: no data set that is known; name its kind with --dataset; looked for {looked}."
        )
    if data.isdecimal():
        return "camera"
    raise InputError(
        f"{data}: no such file or folder; name with --data a data set, a folder of images, a "
        "video, a bag, the number of a camera or a URL."
    )
