"""Reads folders of images: one folder, or two folders for stereo pairs or images with depth.

The two folders of a pair have a common parent folder and are named as in `PAIRS` or `DEPTH_PAIRS`.
Otherwise, the second folder is given by ``--right`` or ``--depth``.

Images with the same name form a pair. If the two folders have no name in common but the same number
of images, their images are paired in order. If the names of images and depth images are times, the
images are paired by time. The times of a pair are then less than 20 ms apart.

The times of the images are taken from the first of these sources that exists:

1. ``--fps``.
2. ``times.txt`` or ``timestamps.txt`` in the folder of the images or in its parent. Each line
   contains the time of one image, in seconds or as a date and time (ISO 8601). If the frame rate
   proves that the unit is ms, us or ns, the times are converted.
3. File names that are times. The unit is s, ms, us or ns. It follows from the date, or from the
   frame rate. Integers below 1,000,000,000 in small steps are treated as frame numbers.
4. ``DateTimeOriginal`` with ``SubSecTimeOriginal`` in the EXIF data of the images.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.association import DEPTH_NEAR_S, Pairing, associate
from vslam.datasets.frames import RawSource
from vslam.datasets.image_files import (
    checked_files,
    image_size,
    list_images,
    select_frames,
)
from vslam.datasets.times import (
    Timing,
    number_of,
    ordered_list,
    times_of_list,
    times_of_names,
)
from vslam.errors import InputError

PAIRS = (
    ("left", "right"),
    ("image_0", "image_1"),
    ("image_left", "image_right"),
    ("cam0", "cam1"),
    ("cam0/data", "cam1/data"),
    ("image_2", "image_3"),
    ("image_00/data", "image_01/data"),
    ("image_02/data", "image_03/data"),
)
DEPTH_PAIRS = (("rgb", "depth"), ("color", "depth"), ("colour", "depth"), ("image", "depth"))
_TIME_FILES = ("times.txt", "timestamps.txt")
_EXIF = 0x8769  # tags of EXIF 2.32
_DATE_TIME_ORIGINAL, _SUB_SEC_TIME_ORIGINAL = 0x9003, 0x9291
_FIX = "correct them, or give --fps"


def has_images(folder: Path) -> bool:
    """Return whether a folder contains images, or a pair of folders with images."""
    inside = (folder / left for left, _ in PAIRS + DEPTH_PAIRS)
    return any(list_images(place) for place in (folder, *inside))


@dataclass(frozen=True)
class ImageFolders:
    """The image files of a folder or of a pair of folders, in the order of their times.

    Attributes:
        name: name of the folder.
        timestamps: ``(N,)`` float64 seconds, increasing.
        sides: one or two lists of N image files. The first list has the images of the only or the
            left camera. The second list has the images of the right camera, or the depth images.
        depth: whether the second list has depth images.
        size: width and height of the first image.
        pairing: how many images were paired by time; None if the images were not paired by time.
        timing: how the times were read.
    """

    name: str
    timestamps: NDArray[np.float64]
    sides: tuple[tuple[Path, ...], ...]
    depth: bool
    size: tuple[int, int]
    pairing: Pairing | None = None
    timing: Timing | None = None

    def source(self, depth_scale: float | None) -> RawSource:
        """Make a source of the images.

        Args:
            depth_scale: depth image units per metre. It is needed only for depth images.

        Raises:
            InputError: there are depth images but no scale.
            UnreadableImageError: a file is empty, or the first frame cannot be decoded.
        """
        if self.depth and depth_scale is None:
            raise InputError(
                f"{self.sides[1][0].parent}: the unit of the depth images is unknown; give "
                "--depth-scale, 1000 for millimetres, or depth_scale in the calibration."
            )
        scale = depth_scale if self.depth else None
        return checked_files(
            "images", self.name, self.timestamps, None, self.sides, scale, self.pairing, self.timing
        )


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
        folder: folder of the images, or the folder that contains both folders of a pair.
        right: folder of the right images. If it is given, ``folder`` contains the left images.
        depth: folder of the depth images. If it is given, ``folder`` contains the images.
        fps: frames per second. If it is given, the time stamps of the images are not used.
        start, every, max_frames: read the frames ``start``, ``start + every`` and so on, at most
            ``max_frames`` frames.
        sensor: ``stereo``, ``rgbd`` or ``mono``. With ``mono``, only the left images are read. None
            reads all images that are found.

    Raises:
        InputError: there are no images or no second images, the images of the two folders do not
            match, or there are no usable times.
        UnreadableImageError: the first image cannot be decoded.
    """
    folder = Path(folder)
    right = None if right is None else Path(right)
    depth = None if depth is None else Path(depth)
    places, is_depth = _find_sides(folder, right, depth, sensor)
    listed = [_sorted_images(place) for place in places]
    files, pairing = _paired(listed, places, by_time=is_depth)
    if fps is not None:
        found, timing = [k / fps for k in range(len(files[0]))], Timing(str(places[0]))
    else:
        found, timing = _find_times(places[0], files[0])
    times, kept = ordered_list(found, timing, _FIX)
    selected = select_frames(folder, len(kept), start, every, max_frames)
    sides = tuple(tuple(side[k] for k in kept[selected]) for side in files)
    size, name = image_size(sides[0][0]), folder.resolve().name
    return ImageFolders(name, np.array(times)[selected], sides, is_depth, size, pairing, timing)


def _find_sides(
    folder: Path, right: Path | None, depth: Path | None, sensor: str | None
) -> tuple[list[Path], bool]:
    """Return the folders of the images, and whether the second folder contains depth images."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a folder of images with --data.")
    if right is not None and depth is not None:
        raise InputError(f"--depth {depth}: contradicts --right; leave one of them out.")
    for second in (right, depth):
        if second is not None:
            return [folder, second], second is depth
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
        first, option = ("colour", "--depth") if sensor == "rgbd" else ("left", "--right")
        raise InputError(
            f"{folder}: found no pairs of images in {pairs}{_near_miss(folder)}; give the folder "
            f"of the {first} images with --data and the other folder with {option}, or run with "
            "--sensor mono."
        )
    return [folder], False


def _near_miss(folder: Path) -> str:
    """Describe an incomplete or misnamed pair of folders for an error message."""
    above = folder.resolve().parent
    for names in PAIRS + DEPTH_PAIRS:
        if all(list_images(above / name) for name in names) and folder.resolve().name in names:
            return f", but {above} has both (give it with --data)"
        sides = [bool(list_images(folder / name)) for name in names]
        if any(sides):
            there, missing = names if sides[0] else names[::-1]
            return f", but only {there} has images, {missing} has none"
    return ""


def _sorted_images(folder: Path) -> dict[str, Path]:
    """List the images of a folder by stem, in the order in which they were taken.

    If not all names are numbers, the images are sorted by the numbers in their names, so that 2
    comes before 10.
    """
    images = list_images(folder)
    if not images:
        raise InputError(f"{folder}: no images in this folder; give another.")

    def by_number(stem: str) -> list[tuple[str, int]]:
        return [(text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", stem)]

    numbers = {stem: number for stem in images if (number := number_of(stem)) is not None}
    ordered = sorted(numbers, key=numbers.__getitem__) if len(numbers) == len(images) else None
    return {stem: images[stem] for stem in ordered or sorted(images, key=by_number)}


def _paired(
    sides: list[dict[str, Path]], folders: list[Path], *, by_time: bool
) -> tuple[list[list[Path]], Pairing | None]:
    """Pair the files of two folders. Return the files of each folder in the order of the pairs."""
    first, *rest = sides
    for other in rest:
        if first.keys() == other.keys():
            return [[side[stem] for stem in first] for side in sides], None
        if by_time and (pairs := _paired_by_time(first, other)) is not None:
            return pairs
        if len(other) != len(first) or first.keys() & other.keys():
            raise InputError(
                f"{folders[1]}: {len(other)} images but {len(first)} in {folders[0]}, and "
                f"{min(first.keys() ^ other.keys())} is in only one of them; remove the images "
                "without a partner."
            )
    return [list(side.values()) for side in sides], None


def _paired_by_time(
    first: dict[str, Path], second: dict[str, Path]
) -> tuple[list[list[Path]], Pairing] | None:
    """Pair the files of two folders by the times in their names. None if a name is not a time."""
    files = [list(side.values()) for side in (first, second)]
    found = [
        times_of_names(list(side), files[k][0].parent) for k, side in enumerate((first, second))
    ]
    if None in found:
        return None
    colour, depth = (one[0] for one in found if one is not None)
    pairs = associate(colour, depth, DEPTH_NEAR_S)
    if not len(pairs[0]):
        raise InputError(
            f"{files[1][0].parent}: by the times in their names, no depth image is within 20 ms of "
            "an image; give folders of one recording."
        )
    fix = "correct the names if the times of one folder are late, or run with --sensor mono"
    pairing = Pairing(files[0][0].parent, "depth image", DEPTH_NEAR_S, fix)
    pairing.count(colour, pairs[0], depth)
    return [[side[k] for k in chosen] for side, chosen in zip(files, pairs, strict=True)], pairing


def _find_times(folder: Path, files: list[Path]) -> tuple[list[float], Timing]:
    """Find the times of images in seconds, in the order of the images."""
    for place in (folder, folder.parent):
        for name in _TIME_FILES:
            if (place / name).is_file():
                return _times_of_file(place / name, len(files))
    stems = [path.stem for path in files]
    named = [stem for stem in stems if number_of(stem) is not None]
    if (found := times_of_names(named, folder)) is not None:
        if len(named) < len(files):
            odd = next(path for path in files if path.stem not in named)
            raise InputError(f"{odd}: has no time, unlike {named[0]}; give --fps.")
        times, remarks = found
        return times.tolist(), Timing(str(folder), remarks)
    taken = [_time_of_exif(path) for path in files] if _time_of_exif(files[0]) is not None else []
    if None in taken:
        odd = files[taken.index(None)]
        raise InputError(f"{odd}: has no time, unlike {files[0].name}; give --fps.")
    if taken:
        return [time for time in taken if time is not None], Timing(str(folder))
    raise InputError(
        f"{folder}: the images have no time stamps (no {' or '.join(_TIME_FILES)}, none in their "
        "names or EXIF); give --fps."
    )


def _times_of_file(path: Path, n: int) -> tuple[list[float], Timing]:
    times, timing = times_of_list(path, _FIX)
    if len(times) != n:
        raise InputError(f"{path}: {len(times)} times for {n} images; write one line per image.")
    return times, timing


def _time_of_exif(path: Path) -> float | None:
    """Read the time in the EXIF data, as seconds since 1970 by the camera's clock."""
    from PIL import Image as PillowImage

    try:
        with PillowImage.open(path) as image:
            tags = image.getexif().get_ifd(_EXIF)
        day = datetime.strptime(str(tags[_DATE_TIME_ORIGINAL]), "%Y:%m:%d %H:%M:%S")
        fraction = float(f"0.{str(tags.get(_SUB_SEC_TIME_ORIGINAL, 0)).strip()}")
    except Exception:  # Pillow raises many kinds of errors
        return None
    return day.replace(tzinfo=UTC).timestamp() + fraction
