"""Folders of images: one of a single camera, two of a stereo pair.

A pair is two folders beside each other (`PAIRS` of names), or one named with ``--right``. Its
images belong together by their names, or by their order where no name is on both sides and both
have equally many. Times are taken from the first of these that is there:

1. ``--fps``;
2. ``times.txt`` or ``timestamps.txt``, in the folder of the images or the one above: a time in
   seconds a line, for every image;
3. names that are times since 1970: whole seconds, or ms, us or ns, told by their size, or seconds
   with a point; smaller numbers are counters;
4. ``DateTimeOriginal`` with ``SubSecTimeOriginal`` in the images' EXIF.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.image_files import ImageFiles, checked_files, list_images, select_frames
from vslam.errors import InputError
from vslam.trajectory import read_table

PAIRS = (
    ("left", "right"),
    ("image_0", "image_1"),
    ("image_left", "image_right"),
    ("cam0", "cam1"),
    ("cam0/data", "cam1/data"),
)
_TIME_FILES = ("times.txt", "timestamps.txt")
_EXIF = 0x8769  # tags of EXIF 2.32
_DATE_TIME_ORIGINAL, _SUB_SEC_TIME_ORIGINAL = 0x9003, 0x9291
# The year 2001 in seconds: a whole number below is a counter; above, its size tells the unit.
_FIRST_TIME = 1e9
_UNITS = ((1e17, 10**9), (1e14, 10**6), (1e11, 10**3), (_FIRST_TIME, 1))


def has_images(folder: Path) -> bool:
    """Whether a folder holds images, or a pair of folders with some."""
    return any(list_images(place) for place in (folder, *(folder / left for left, _ in PAIRS)))


def open_images(
    folder: Path,
    right: Path | None = None,
    *,
    fps: float | None = None,
    start: int = 0,
    every: int = 1,
    max_frames: int | None = None,
    monocular: bool = False,
) -> ImageFiles:
    """Open a folder of images, or a pair of folders.

    Args:
        folder: of the images, or of both folders of a pair.
        right: folder of the right images where ``folder`` has the left ones.
        fps: frames a second, in place of time stamps.

    Raises:
        InputError: no images, no right ones, sides that do not match, or no usable times.
        UnreadableImageError: a file is empty, or the first frame cannot be decoded.
    """
    sides = _find_sides(folder, right, monocular)
    files = _matched([_sorted_images(side) for side in sides], sides)
    n = len(files[0])
    times = np.arange(n) / fps if fps is not None else _find_times(sides[0], files[0])
    if (bad := np.flatnonzero(np.diff(times) <= 0)).size:
        raise InputError(
            f"{files[0][bad[0] + 1]}: its time is not later than that of the image before it; "
            "repair the times, or give --fps."
        )
    chosen = select_frames(folder, n, start, every, max_frames)
    selected = [tuple(side[k] for k in chosen) for side in files]
    return checked_files("images", folder.resolve().name, times[chosen], None, selected)


def _find_sides(folder: Path, right: Path | None, monocular: bool) -> list[Path]:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; name a folder of images with --data.")
    if right is not None:
        return [folder] if monocular else [folder, right]
    for names in PAIRS:
        pair = [folder / name for name in names]
        if all(list_images(side) for side in pair[: 1 if monocular else 2]):
            return pair[: 1 if monocular else 2]
    if not monocular:
        pairs = ", ".join(" and ".join(names) for names in PAIRS)
        raise InputError(
            f"{folder}: images of a left and a right camera are looked for in {pairs}; name the "
            "folder of the right ones with --right, or run with --sensor mono."
        )
    return [folder]


def _sorted_images(folder: Path) -> dict[str, Path]:
    """By stem: in the order of time where all names are times, else of the words and numbers in
    the names, 2 before 10."""
    images = list_images(folder)
    if not images:
        raise InputError(f"{folder}: no images in this folder; name another.")

    def by_number(stem: str) -> list[tuple[str, int]]:
        return [(text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", stem)]

    times = {stem: _time_of_name(path) for stem, path in images.items()}
    timed = {stem: time for stem, time in times.items() if time is not None}
    ordered = sorted(timed, key=timed.__getitem__) if timed.keys() == times.keys() else None
    return {stem: images[stem] for stem in ordered or sorted(images, key=by_number)}


def _matched(sides: list[dict[str, Path]], folders: list[Path]) -> list[list[Path]]:
    """The files of each side in order, as many of one as of the other."""
    first, *rest = sides
    for other in rest:
        if first.keys() == other.keys():
            return [[side[stem] for stem in first] for side in sides]
        if len(other) != len(first) or first.keys() & other.keys():
            raise InputError(
                f"{folders[1]}: {len(other)} images but {len(first)} in {folders[0]}, "
                f"{min(first.keys() ^ other.keys())} on one side only; remove what has no partner."
            )
    return [list(side.values()) for side in sides]


def _find_times(folder: Path, files: list[Path]) -> NDArray[np.float64]:
    for place in (folder, folder.parent):
        for name in _TIME_FILES:
            if (place / name).is_file():
                return _times_of_file(place / name, len(files))
    ways: tuple[Callable[[Path], float | None], ...] = (_time_of_name, _time_of_exif)
    for way in ways:
        if way(files[0]) is not None:
            times = [way(path) for path in files]
            missing = next((p for p, t in zip(files, times, strict=True) if t is None), None)
            if missing is not None:
                raise InputError(f"{missing}: no time, unlike {files[0].name}; give --fps.")
            return np.array(times, np.float64)
    raise InputError(
        f"{folder}: the images have no time stamps (no {' or '.join(_TIME_FILES)}, none in their "
        "names or EXIF); give --fps."
    )


def _times_of_file(path: Path, n: int) -> NDArray[np.float64]:
    times = read_table(path, (1,), "a time in seconds")[:, 0]
    if len(times) != n:
        raise InputError(f"{path}: {len(times)} times for {n} images; write one a line for each.")
    return times


def _time_of_name(path: Path) -> float | None:
    """Seconds since 1970, None where the name is no time."""
    if re.fullmatch(r"\d+\.\d+", path.stem):
        return float(path.stem)
    if path.stem.isdecimal():
        number = int(path.stem)
        for least, per_second in _UNITS:
            if number >= least:
                return number / per_second
    return None


def _time_of_exif(path: Path) -> float | None:
    """Seconds since 1970 by the camera's clock, None without EXIF."""
    from PIL import Image as PillowImage

    try:
        with PillowImage.open(path) as image:
            tags = image.getexif().get_ifd(_EXIF)
        day = datetime.strptime(str(tags[_DATE_TIME_ORIGINAL]), "%Y:%m:%d %H:%M:%S")
        fraction = float(f"0.{str(tags.get(_SUB_SEC_TIME_ORIGINAL, 0)).strip()}")
    except (OSError, KeyError, ValueError):
        return None
    return day.replace(tzinfo=UTC).timestamp() + fraction
