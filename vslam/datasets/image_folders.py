"""Folders of images: one folder for a single camera, two for a stereo pair or images with depth.

A pair is two folders beside each other, named as in `PAIRS` or `DEPTH_PAIRS`, or given by
``--right`` or ``--depth``. Its images are paired by name. If no name occurs on both sides and both
have the same number of images, they are paired by order; images and depth images whose names are
different times are paired by time, within 20 ms. Times come from the first available of these:

1. ``--fps``;
2. ``times.txt`` or ``timestamps.txt``, in the folder of the images or its parent, with one line
   per image: its time in seconds;
3. file names that are times since 1970: seconds with a decimal point, or whole s, ms, us or ns,
   distinguished by their magnitude; smaller numbers are counters;
4. ``DateTimeOriginal`` with ``SubSecTimeOriginal`` in the images' EXIF.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.association import associate, warn_of_unpaired
from vslam.datasets.frames import RawSource
from vslam.datasets.image_files import (
    checked_files,
    image_size,
    list_images,
    select_frames,
)
from vslam.errors import InputError
from vslam.trajectory import read_table

PAIRS = (
    ("left", "right"),
    ("image_0", "image_1"),
    ("image_left", "image_right"),
    ("cam0", "cam1"),
    ("cam0/data", "cam1/data"),
)
DEPTH_PAIRS = (("rgb", "depth"), ("color", "depth"), ("colour", "depth"), ("image", "depth"))
_SLOWEST_S = 10.0  # between images; at a longer interval, tracking is impossible
_NEAR_S = 0.02  # as TUM's associate.py
_TIME_FILES = ("times.txt", "timestamps.txt")
_EXIF = 0x8769  # tags of EXIF 2.32
_DATE_TIME_ORIGINAL, _SUB_SEC_TIME_ORIGINAL = 0x9003, 0x9291
# The year 2001 in seconds. Smaller whole numbers are counters; the magnitude of larger ones
# determines their unit.
_FIRST_TIME = 1e9
_UNITS = ((1e17, 10**9), (1e14, 10**6), (1e11, 10**3), (_FIRST_TIME, 1))


def has_images(folder: Path) -> bool:
    """Whether a folder holds images, or a pair of folders with images."""
    inside = (folder / left for left, _ in PAIRS + DEPTH_PAIRS)
    return any(list_images(place) for place in (folder, *inside))


@dataclass(frozen=True)
class ImageFolders:
    """Files of a folder or of a pair of folders, in the order of their times.

    Attributes:
        name: name of the folder.
        sides: N image files each: left and right images, images and depth, or one camera's images.
        depth: whether the second side is the depth of the first one.
        size: width and height of the first image.
    """

    name: str
    timestamps: NDArray[np.float64]
    sides: tuple[tuple[Path, ...], ...]
    depth: bool
    size: tuple[int, int]

    def source(self, depth_scale: float | None) -> RawSource:
        """The images as a source.

        Args:
            depth_scale: units of the depth images per metre; needed only for depth images.

        Raises:
            InputError: there are depth images but no scale.
            UnreadableImageError: a file is empty, or the first frame cannot be decoded.
        """
        if not self.depth:
            return checked_files("images", self.name, self.timestamps, None, self.sides)
        if depth_scale is None:
            raise InputError(
                f"{self.sides[1][0].parent}: the unit of the depth images is unknown; give "
                "--depth-scale, 1000 for millimetres, or depth_scale in the calibration."
            )
        return checked_files("images", self.name, self.timestamps, None, self.sides, depth_scale)


def open_images(
    folder: Path | str,
    right: Path | str | None = None,
    *,
    depth: Path | str | None = None,
    fps: float | None = None,
    start: int = 0,
    every: int = 1,
    max_frames: int | None = None,
    sensor: str | None = None,
) -> ImageFolders:
    """Find the files of a folder of images, or of a pair of folders.

    Args:
        folder: folder of the images, or the folder that holds both folders of a pair.
        right: folder of the right images if ``folder`` holds the left ones.
        depth: folder of the depth images if ``folder`` holds the images.
        fps: frames per second, instead of time stamps.
        sensor: ``stereo``, ``rgbd``, or ``mono`` for the left images alone; None reads all images
            that are found.

    Raises:
        InputError: there are no images or no second images, the sides do not match, or there are
            no usable times.
        UnreadableImageError: the first image cannot be decoded.
    """
    folder = Path(folder)
    right = None if right is None else Path(right)
    depth = None if depth is None else Path(depth)
    places, is_depth = _find_sides(folder, right, depth, sensor)
    files = _matched([_sorted_images(place) for place in places], places, by_time=is_depth)
    n = len(files[0])
    times = np.arange(n) / fps if fps is not None else _find_times(places[0], files[0])
    if (bad := np.flatnonzero(np.diff(times) <= 0)).size:
        raise InputError(
            f"{files[0][bad[0] + 1]}: its time is not later than that of the image before it; "
            "repair the times, or give --fps."
        )
    chosen = select_frames(folder, n, start, every, max_frames)
    sides = tuple(tuple(side[k] for k in chosen) for side in files)
    size = image_size(sides[0][0])
    return ImageFolders(folder.resolve().name, times[chosen], sides, is_depth, size)


def _find_sides(
    folder: Path, right: Path | None, depth: Path | None, sensor: str | None
) -> tuple[list[Path], bool]:
    """Folders of the first and second images, and whether the second ones are depth."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; name a folder of images with --data.")
    if right is not None and depth is not None:
        raise InputError(f"--depth {depth}: contradicts --right; leave one of them out.")
    if right is not None or depth is not None:
        return [
            folder,
            *(place for place in (right, depth) if place is not None),
        ], depth is not None
    wanted = [(names, False) for names in PAIRS if sensor != "rgbd"]
    wanted += [(names, True) for names in DEPTH_PAIRS if sensor != "stereo"]
    n = 1 if sensor == "mono" else 2
    for names, is_depth in wanted:
        pair = [folder / name for name in names[:n]]
        if all(list_images(side) for side in pair):
            return pair, is_depth and n == 2
    if sensor != "mono":
        kinds = {None: PAIRS + DEPTH_PAIRS[:1], "stereo": PAIRS, "rgbd": DEPTH_PAIRS}[sensor]
        pairs = ", ".join(" and ".join(names) for names in kinds)
        option = (
            "that of the depth with --depth"
            if sensor == "rgbd"
            else ("that of the right ones with --right")
        )
        raise InputError(
            f"{folder}: images of a pair are looked for in {pairs}{_near_miss(folder)}; name the "
            f"folder of the first ones with --data and {option}, or run with --sensor mono."
        )
    return [folder], False


def _near_miss(folder: Path) -> str:
    """A hint for a user who names one side of a pair, or has only one side."""
    above = folder.resolve().parent
    for names in PAIRS + DEPTH_PAIRS:
        if all(list_images(above / name) for name in names) and folder.resolve().name in names:
            return f", and {above} has both (name that with --data)"
        sides = [bool(list_images(folder / name)) for name in names]
        if any(sides):
            there, missing = names if sides[0] else names[::-1]
            return f", but only {there} has images, {missing} has none"
    return ""


def _sorted_images(folder: Path) -> dict[str, Path]:
    """Images by stem: in the order of time if all names are times, else in natural order, which
    puts 2 before 10."""
    images = list_images(folder)
    if not images:
        raise InputError(f"{folder}: no images in this folder; name another.")

    def by_number(stem: str) -> list[tuple[str, int]]:
        return [(text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", stem)]

    times = {stem: _time_of_name(path) for stem, path in images.items()}
    timed = {stem: time for stem, time in times.items() if time is not None}
    ordered = sorted(timed, key=timed.__getitem__) if timed.keys() == times.keys() else None
    return {stem: images[stem] for stem in ordered or sorted(images, key=by_number)}


def _matched(
    sides: list[dict[str, Path]], folders: list[Path], *, by_time: bool
) -> list[list[Path]]:
    """The files of each side in order, the same number on both sides."""
    first, *rest = sides
    for other in rest:
        if first.keys() == other.keys():
            return [[side[stem] for stem in first] for side in sides]
        if by_time and (pairs := _near_in_time(first, other)) is not None:
            return pairs
        if len(other) != len(first) or first.keys() & other.keys():
            raise InputError(
                f"{folders[1]}: {len(other)} images but {len(first)} in {folders[0]}, "
                f"{min(first.keys() ^ other.keys())} on one side only; remove what has no partner."
            )
    return [list(side.values()) for side in sides]


def _near_in_time(first: dict[str, Path], second: dict[str, Path]) -> list[list[Path]] | None:
    """Files of both sides whose names are times near each other; None if names are not times."""
    files = [list(side.values()) for side in (first, second)]
    times = [[_time_of_name(path) for path in side] for side in files]
    if any(time is None for side in times for time in side):
        return None
    colour, depth = (np.array(side, np.float64) for side in times)
    pairs = associate(colour, depth, _NEAR_S)
    if not len(pairs[0]):
        raise InputError(
            f"{files[1][0].parent}: by the times in their names, no depth image is within 20 ms of "
            "an image; name folders of one recording."
        )
    warn_of_unpaired(files[0][0].parent, len(pairs[0]), len(colour))
    return [[side[k] for k in chosen] for side, chosen in zip(files, pairs, strict=True)]


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
        raise InputError(f"{path}: {len(times)} times for {n} images; write one line per image.")
    if n > 1 and (interval := float(np.median(np.diff(times)))) > _SLOWEST_S:
        raise InputError(
            f"{path}: the images are {interval:g} s apart, as if the times were in milliseconds or "
            "nanoseconds; write seconds, or give --fps."
        )
    return times


def _time_of_name(path: Path) -> float | None:
    """Seconds since 1970; None if the name is not a time."""
    if re.fullmatch(r"\d+\.\d+", path.stem):
        return float(path.stem)
    if path.stem.isdecimal():
        number = int(path.stem)
        for least, per_second in _UNITS:
            if number >= least:
                return number / per_second
    return None


def _time_of_exif(path: Path) -> float | None:
    """Seconds since 1970 by the camera's clock; None without EXIF."""
    from PIL import Image as PillowImage

    try:
        with PillowImage.open(path) as image:
            tags = image.getexif().get_ifd(_EXIF)
        day = datetime.strptime(str(tags[_DATE_TIME_ORIGINAL]), "%Y:%m:%d %H:%M:%S")
        fraction = float(f"0.{str(tags.get(_SUB_SEC_TIME_ORIGINAL, 0)).strip()}")
    except Exception:  # Pillow raises many kinds of errors
        return None
    return day.replace(tzinfo=UTC).timestamp() + fraction
