"""Reads folders of images: one folder, or two folders for stereo pairs or images with depth.

The two folders of a pair have a common parent folder and are named as in `PAIRS` or `DEPTH_PAIRS`.
Otherwise, the second folder is given by ``--right`` or ``--depth``. All images may also be in one
folder if their names tell them apart, such as ``left_0001`` and ``right_0001``.

Images with the same name form a pair. Otherwise, images are paired by the numbers or times in their
names (`vslam.datasets.names.pair_names`). If the names of images and depth images are times, the
times of a pair are less than 20 ms apart. Images without a partner are left out and counted.

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
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.association import DEPTH_NEAR_S, Pairing, associate
from vslam.datasets.frames import RawSource, selection
from vslam.datasets.image_files import (
    UNKNOWN_SCALE,
    DepthScale,
    checked_files,
    image_size,
    list_images,
)
from vslam.datasets.names import group_names, pair_names, role_of, sides_by_name
from vslam.datasets.times import (
    Timing,
    number_of,
    ordered_list,
    times_of_list,
    times_of_names,
)
from vslam.support.errors import InputError
from vslam.support.file_kinds import identify, what_is_in

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
_CLOCKS_DIFFER = 0.2  # least difference between two clocks that is reported, in `ClockPairs.within`
_EXAMINED = 8  # number of images whose headers are compared
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

    def source(self, depth_scale: DepthScale = UNKNOWN_SCALE) -> RawSource:
        """Make a source of the images.

        Args:
            depth_scale: unit of the depth images, if there are any.

        Raises:
            UnreadableImageError: a file is empty, the first frame cannot be decoded, or the unit of
                its depth is unknown.
        """
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
    places, images, is_depth = _find_sides(folder, right, depth, sensor)
    listed = [_sorted_images(side) for side in images]
    _check_kinds(places, listed if not is_depth else listed[:1])
    pairs, pairing = _paired(listed, places, depth=is_depth)
    first = list(listed[0].values())
    if fps is not None:
        found, timing = [k / fps for k in range(len(first))], Timing(str(places[0]))
    else:
        found, timing = _find_times(places[0], first)
    times, kept = ordered_list([found[k] for k in pairs[0]], timing, _FIX)
    selected = selection(folder, len(kept), start, every, max_frames)
    files = [list(side.values()) for side in listed]
    sides = tuple(
        tuple(side[k] for k in rows[kept[selected]])
        for side, rows in zip(files, pairs, strict=True)
    )
    size, name = image_size(sides[0][0]), folder.resolve().name
    return ImageFolders(name, np.array(times)[selected], sides, is_depth, size, pairing, timing)


def _find_sides(
    folder: Path, right: Path | None, depth: Path | None, sensor: str | None
) -> tuple[list[Path], list[dict[str, Path]], bool]:
    """Return the folder and the images of each side, and whether the second side is depth."""
    _require_folder(folder)
    if right is not None and depth is not None:
        raise InputError(f"--depth {depth}: contradicts --right; leave one of them out.")
    for second in (right, depth):
        if second is not None:
            if second.resolve() == folder.resolve():
                raise InputError(
                    f"--{'depth' if second is depth else 'right'} {second}: is also the folder of "
                    "--data; give the folder of the other images, or leave the option out."
                )
            is_depth = second is depth
            images = [_images(folder), _images(second, depth=is_depth)]
            return [folder, second], images, is_depth
    wanted = [(names, False) for names in PAIRS if sensor != "rgbd"]
    wanted += [(names, True) for names in DEPTH_PAIRS if sensor != "stereo"]
    n = 1 if sensor == "mono" else 2
    for names, is_depth in wanted:
        pair = [folder / name for name in names[:n]]
        images = [list_images(side, depth=is_depth and k == 1) for k, side in enumerate(pair)]
        if all(images):
            return pair, images, is_depth and n == 2
    together = list_images(folder)
    if (found := sides_by_name(list(together), sensor)) is not None:
        sides, is_depth = found
        return [folder] * len(sides), [{k: together[k] for k in side} for side in sides], is_depth
    if sensor != "mono":
        kinds = {None: PAIRS + DEPTH_PAIRS[:1], "stereo": PAIRS, "rgbd": DEPTH_PAIRS}[sensor]
        pairs = ", ".join(" and ".join(names) for names in kinds)
        first, option = ("colour", "--depth") if sensor == "rgbd" else ("left", "--right")
        raise InputError(
            f"{folder}: found no pairs of images in {pairs}{_near_miss(folder)}; give the folder "
            f"of the {first} images with --data and the other folder with {option}, or run with "
            "--sensor mono."
        )
    return [folder], [_images(folder)], False


def _require_folder(folder: Path) -> None:
    if folder.is_dir():
        return
    kind = identify(folder)
    what = "no such folder" if not folder.exists() else f"{kind.name if kind else 'a file'}"
    fix = f"{kind.fix}, and give" if kind and kind.fix else "give"
    raise InputError(f"{folder}: {what}; {fix} a folder of images.")


def _near_miss(folder: Path) -> str:
    """Describe an incomplete or misnamed pair of folders for an error message."""
    above = folder.resolve().parent
    for names in PAIRS + DEPTH_PAIRS:
        if all(list_images(above / name) for name in names) and folder.resolve().name in names:
            return f", but {above} has both (give it with --data)"
        sides = [bool(list_images(folder / name)) for name in names]
        if any(sides):
            there, missing = names if sides[0] else names[::-1]
            inside = what_is_in(folder / missing)
            return f", but only {there} has images, {missing} has none{inside}"
    return what_is_in(folder)


def _images(folder: Path, *, depth: bool = False) -> dict[str, Path]:
    _require_folder(folder)
    if images := list_images(folder, depth=depth):
        return images
    raise InputError(f"{folder}: no images in this folder{what_is_in(folder)}; give another.")


def _sorted_images(images: dict[str, Path]) -> dict[str, Path]:
    """Sort images, which are listed by stem, by the order in which they were taken.

    If not all names are numbers, the images are sorted by the numbers in their names, so that 2
    comes before 10.
    """

    def by_number(stem: str) -> list[tuple[str, int]]:
        return [(text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", stem)]

    numbers = {stem: number for stem in images if (number := number_of(stem)) is not None}
    ordered = sorted(numbers, key=numbers.__getitem__) if len(numbers) == len(images) else None
    return {stem: images[stem] for stem in ordered or sorted(images, key=by_number)}


@dataclass(frozen=True)
class _Kind:
    """What the header and the name of an image file tell. A ``deep`` image has more than 8 bits.

    ``second`` is ``right`` or ``depth`` if the name tells that the image is the second of a pair.
    """

    size: tuple[int, int]
    colour: bool
    deep: bool
    second: str

    def __str__(self) -> str:
        colour, bits = "colour" if self.colour else "grey", 16 if self.deep else 8
        return f"{self.size[0]}x{self.size[1]}, {colour}, {bits} bits"


def _check_kinds(folders: list[Path], sides: list[dict[str, Path]]) -> None:
    """Check that the images of a side are of one kind, and that two sides can be a stereo pair.

    Only the headers of a few files are read. If all names are alike, images may differ in size and
    colour: a run skips images of another size.
    """
    firsts: list[tuple[Path, _Kind]] = []
    for images in sides:
        groups = [names for names in group_names(list(images)).values() if len(names) > 1]
        by_name = _kinds([images[names[0]] for names in groups[:_EXAMINED]])
        first = _kinds(list(images.values())[:_EXAMINED])
        found = _different(by_name, lambda kind: kind) or _different(first, lambda kind: kind.deep)
        if found is not None:
            raise InputError(
                f"{found[0][0].parent}: {' and '.join(f'{p.name} ({k})' for p, k in found)} are "
                "images of different kinds; move the images of each kind to a folder of their own."
            )
        firsts += first[:1]
    if len(sides) == 2 and (found := _different(firsts, lambda kind: kind.deep)) is not None:
        raise InputError(
            f"{folders[1]}: {' and '.join(f'{p.name} ({k})' for p, k in found)} are not a stereo "
            "pair; give depth images with --depth, and save stereo images with equal bits."
        )


def _different(
    kinds: list[tuple[Path, _Kind]], part: Callable[[_Kind], object]
) -> list[tuple[Path, _Kind]] | None:
    """Return the first image, and the first image that differs from it; None if none differs."""
    other = next((one for one in kinds if part(one[1]) != part(kinds[0][1])), None)
    return None if other is None else [kinds[0], other]


def _kinds(paths: list[Path]) -> list[tuple[Path, _Kind]]:
    """Read the headers of image files. Files that Pillow cannot read are left out."""
    from PIL import Image as PillowImage

    found = []
    for path in paths:
        with suppress(Exception), PillowImage.open(path) as image:  # many kinds of errors
            mode = image.mode
            colour = mode not in ("1", "L", "LA", "F") and mode[0] != "I"
            role = role_of(path.stem)
            second = role if role in ("right", "depth") else ""
            found.append((path, _Kind(image.size, colour, mode[0] in "IF", second)))
    return found


def _paired(
    sides: list[dict[str, Path]], folders: list[Path], *, depth: bool
) -> tuple[list[NDArray[np.int64]], Pairing | None]:
    """Pair the images of two folders.

    Returns:
        The indices of the images of each folder, in the order of the pairs. The pairing is None if
        there is only one folder, or if both folders contain the same names.
    """
    first, *rest = sides
    if not rest or first.keys() == rest[0].keys():
        at = [{stem: k for k, stem in enumerate(side)} for side in sides]
        return [np.array([index[stem] for stem in first]) for index in at], None
    times = [
        time
        for side, folder in zip(sides, folders, strict=True)
        if (time := _times_of_names(list(side), folder)) is not None
    ]
    timed = len(times) == 2
    if depth and timed:
        return _paired_by_time(folders, *times)
    seconds = (times[0].tolist(), times[1].tolist()) if timed else None
    pairs = pair_names(list(first), list(rest[0]), seconds)
    if pairs is None:
        raise InputError(
            f"{folders[1]}: the names of its {len(rest[0])} images and of the {len(first)} images "
            f"in {folders[0]} do not tell which images were taken together; give the images of a "
            "pair the same number."
        )
    fix = "restore the missing files, or run with --sensor mono"
    partner, late_s = "depth image" if depth else "right image", 0.0
    if timed and abs(pairs.offset) > _CLOCKS_DIFFER * pairs.within:
        late_s = float(np.median(times[1][pairs.second] - times[0][pairs.first]))
    pairing = Pairing(folders[0], partner, 0.0, fix, late_s=late_s)
    pairing.count_names(pairs, len(first), len(rest[0]))
    return [pairs.first, pairs.second], pairing


def _times_of_names(names: list[str], folder: Path) -> NDArray[np.float64] | None:
    """Read names as ``(N,)`` times in seconds. None if they are no times, or if these are wrong."""
    with suppress(InputError):
        found = times_of_names(names, folder)
        return None if found is None else found[0]
    return None


def _paired_by_time(
    folders: list[Path], images: NDArray[np.float64], depth: NDArray[np.float64]
) -> tuple[list[NDArray[np.int64]], Pairing]:
    """Pair images with depth images by the times in their names, in seconds."""
    pairs = associate(images, depth, DEPTH_NEAR_S)
    if not len(pairs[0]):
        raise InputError(
            f"{folders[1]}: by the times in their names, no depth image is within 20 ms of an "
            "image; give folders of one recording."
        )
    fix = "correct the names if the times of one folder are late, or run with --sensor mono"
    pairing = Pairing(folders[0], "depth image", DEPTH_NEAR_S, fix)
    pairing.count(images, pairs[0], depth)
    return list(pairs), pairing


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
    why, example = "none in their names or EXIF", ""
    if len(named) == len(files):
        why = "none in EXIF, and names that may be the numbers of frames"
        step = float(np.median(np.diff(np.array(named, np.float64)))) if len(files) > 1 else 1.0
        if step > 1.0:
            example = f", {1e3 / step:.3g} if the names are milliseconds"
    raise InputError(
        f"{folder}: the images have no time stamps (no {' or '.join(_TIME_FILES)}, {why}); give "
        f"--fps{example}."
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
