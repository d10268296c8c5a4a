"""Which kind of source somebody means, from what is there."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from vslam.datasets.euroc import is_euroc
from vslam.datasets.image_folders import has_images
from vslam.errors import InputError

_BAG_SUFFIXES = {".bag", ".mcap", ".db3"}
_URL = re.compile(r"[a-z][a-z0-9+.-]*://", re.IGNORECASE)

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
        lambda path: any(is_euroc(folder) for folder in (path, *path.glob("*/"))),
    ),
    ("tum", "a file rgb.txt", lambda path: (path / "rgb.txt").is_file()),
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
    if path.exists():
        for kind, _, holds in _KINDS:
            if holds(path):
                return kind
        looked = "; ".join(f"{what} ({kind})" for kind, what, _ in _KINDS)
        raise InputError(f"{data}: no data set that is known; looked for {looked}.")
    if data.isdecimal():
        return "camera"
    raise InputError(
        f"{data}: no such file or folder; name with --data a data set, a folder of images, a "
        "video, a bag, the number of a camera or a URL."
    )
