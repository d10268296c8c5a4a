"""Functions that find image files, and that decode images and depth. Several readers use them."""

from __future__ import annotations

import re
from collections.abc import Callable
from collections.abc import Sequence as Several
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.models import Calibration
from vslam.datasets.association import Pairing
from vslam.datasets.frames import RawSource, Size, TimedFrame, decoded
from vslam.datasets.grey_levels import Levels, decode, levels_of_files
from vslam.datasets.times import Number, Timing
from vslam.support.errors import InputError, UnreadableImageError
from vslam.support.file_kinds import read_text, why_not_an_image
from vslam.support.untrusted import MOST_PIXELS, is_float_depth, is_image, read_npy, require_utf8
from vslam.types.camera import Camera, DepthImage, Image

# Distance in metres between the projector and the camera of a Kinect (ORB-SLAM2, section III-A).
_VIRTUAL_BASELINE = 0.08
# Correlation of the details of two images of which one is a copy, and least contrast of details in
# grey levels. The correlation of a copy is 0.89 after JPEG of quality 30. Without compression, it
# is at most 0.7 if one image is shifted by a pixel, and at most 0.3 for the pairs of KITTI, EuRoC
# and boofcv.
_SAME, _LEAST_DETAIL = 0.85, 2.0
_FARTHEST_MEDIAN_M = 200.0  # of a depth image in metres
_Time = TypeVar("_Time", bound=Number)


def checked_files(
    dataset: str,
    name: str,
    timestamps: NDArray[np.float64],
    ground_truth: NDArray[np.float64] | None,
    sides: Several[Several[Path]],
    depth_scale: DepthScale | None = None,
    pairing: Pairing | None = None,
    timing: Timing | None = None,
) -> RawSource:
    """Make a source of image files.

    This function checks that no file is empty, and decodes the images of the first frame.

    Args:
        dataset: kind of source, for example ``kitti``.
        name: name of the sequence.
        timestamps: ``(N,)`` float64 seconds.
        ground_truth: ``(N, 4, 4)`` float64 ``T_wc`` of the left camera; None without ground truth.
        sides: one or two lists of N files. The first list contains the left images. The second list
            contains the right images or the depth images.
        depth_scale: unit of the depth images; None if there are no depth images.
        pairing: how many images were paired by time; None if the images were not paired by time.
        timing: how the times were read.

    Raises:
        InputError: the left and the right images are the same.
        UnreadableImageError: a file is empty, the first frame cannot be decoded, or the first depth
            image is not one of depth in a known unit, or does not have the size of the first image.
    """
    for path in (path for side in sides for path in side):
        check_not_empty(path)
    depth = depth_scale is not None
    images = sides[:1] if depth else sides
    levels = levels_of_files([side[0] for side in images])
    first = [read_grey(side[0], levels) for side in images]
    sizes = tuple((image.shape[1], image.shape[0]) for image in first)
    if len(first) == 2 and same_images(first[0], first[1]) is not False:
        _refuse_same_images(sides[0], sides[1], levels)

    def frame(timestamp: float, *files: Path) -> TimedFrame:
        grey = [
            partial(_read_grey_of_size, size, levels, file)
            for size, file in zip(sizes, files, strict=False)
        ]
        decoders: list[Callable[[], Image | DepthImage]] = [*grey]
        if depth_scale is not None:
            decoders.append(partial(_read_depth, sizes[0], depth_scale, files[1]))
        return TimedFrame(
            timestamp,
            partial(decoded, decoders),
            sides=(grey[0], decoders[1]) if len(decoders) == 2 else None,
            file=files[0] if levels is None else None,
            colour=partial(read_colour, files[0], levels),
            name=files[0].name,
        )

    source = RawSource(
        dataset=dataset,
        name=name,
        sizes=sizes,
        depth=depth,
        stored=tuple(map(frame, timestamps.tolist(), *sides)),
        ground_truth=ground_truth,
        pairing=pairing,
        timing=timing,
    )
    if depth_scale is not None:
        source.read(0)
        _check_unit(depth_scale, sides[1][0])
    return source


def same_images(left: Image, right: Image) -> bool | None:
    """Return whether two images are copies of one image, perhaps with another encoding or gain.

    The details of copies correlate, even after a strong compression. Those of the two images of a
    stereo pair hardly correlate, because the images are shifted against each other.

    Returns:
        None if an image has too little detail to tell.
    """
    import cv2

    if left.shape != right.shape:
        return False
    a, b = (
        image - cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5) for image in (left, right)
    )
    contrast = float(np.std(a)), float(np.std(b))
    if min(contrast) < _LEAST_DETAIL:
        return None
    return float(np.mean(a * b)) > _SAME * contrast[0] * contrast[1]


def _refuse_same_images(left: Several[Path], right: Several[Path], levels: Levels | None) -> None:
    """Compare three pairs of images. If none of them differs, refuse them."""
    chosen = sorted({0, len(left) // 2, len(left) - 1})
    with suppress(UnreadableImageError):
        pairs = [(read_grey(left[k], levels), read_grey(right[k], levels)) for k in chosen]
        found = [same_images(*pair) for pair in pairs]
        if any(found) and False not in found:
            raise InputError(
                f"{right[0]}: shows the same image as {left[0]}, but the right camera's images are "
                "needed; give them, or run on one camera with --sensor mono."
            )


def image_size(path: Path) -> Size:
    """Return the width and height of an image file.

    Raises:
        UnreadableImageError: the file is missing or damaged.
    """
    height, width = read_grey(path).shape
    return width, height


def list_images(folder: Path, *, depth: bool = False) -> dict[str, Path]:
    """List the image files of a folder, sorted by name, as a dictionary from stems to files.

    The result is empty if there is no such folder.

    Args:
        depth: whether to list files of depth (NPY, PFM) if there are no images.

    Raises:
        InputError: a file name is not UTF-8, or two file names only differ in their suffixes.
    """
    if not folder.is_dir():
        return {}
    images: dict[str, Path] = {}
    there = sorted(folder.iterdir())
    wanted = is_float_depth if depth and not any(map(is_image, there)) else is_image
    for path in filter(wanted, there):
        require_utf8(path)
        if (other := images.setdefault(path.stem, path)) is not path:
            raise InputError(
                f"{path}: {other.name} in this folder has the same name but for the suffix; "
                "remove one of them."
            )
    return images


def read_image_list(
    path: Path, parsed: Callable[[str], tuple[_Time, str]], time: str, instead: str
) -> tuple[list[_Time], list[str]]:
    """Read the times and file names of images from a text file with one image per line.

    Lines that begin with # are comments. The first line may contain the headings of the columns.
    The times are in the unit and in the order of the file.

    Args:
        parsed: function that takes a line, and returns the time and the file name of the image. It
            must raise ValueError if the line is malformed.
        time: description of the time for error messages, such as "a time in seconds".
        instead: what the user can do if the file is missing, for error messages. It may be empty.

    Raises:
        InputError: the file is missing, empty or malformed.
    """
    if not path.is_file():
        raise InputError(
            f"{path}: the list of images is missing; restore it{instead and ', or '}{instead}."
        )
    lines = read_text(path, "a list of images").splitlines()
    times: list[_Time] = []
    names: list[str] = []
    headings = ""
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        if not headings and not times and line.strip()[0].isalpha():
            headings = line
            continue
        try:
            at, name = parsed(line)
        except ValueError:
            name = ""
        if not name:
            raise InputError(
                f"{path}: line {number} is not {time} and a file name ({line.strip()[:40]}); "
                "correct it."
            )
        times.append(at)
        names.append(name)
    if not times:
        raise InputError(f"{path}: the list of images is empty; restore it.")
    return times, names


def split_line(line: str) -> tuple[str, str]:
    """Split a line at its first spaces, comma or semicolon."""
    first, *rest = re.split(r"[\s,;]+", line.strip(), maxsplit=1)
    return first, "".join(rest)


def find_sequence(root: Path, name: str | None, is_sequence: Callable[[Path], bool]) -> Path | None:
    """Find the folder of a sequence: ``root``, or a folder one or two levels below it.

    Args:
        name: name of the sequence's folder. None finds ``root`` itself or, if it is not a sequence,
            the only sequence in it.
        is_sequence: function that tells whether a folder contains a sequence.

    Returns:
        The folder, or None if there is no sequence.

    Raises:
        InputError: no sequence has this name, or there are several sequences and ``name`` is None.
    """
    if name is not None and is_sequence(root / name):
        return root / name
    if is_sequence(root):
        own = root.resolve().name
        if name not in (None, own):
            raise InputError(
                f"--seq {name}: {root} is itself the sequence {own}; leave the option out, or name "
                "another folder with --data."
            )
        return root
    inside: list[Path] = []
    for level in ("*/", "*/*/"):
        inside = inside or sorted(path for path in root.glob(level) if is_sequence(path))
    chosen = [path for path in inside if name in (None, path.name)]
    if len(chosen) == 1:
        return chosen[0]
    if inside:
        wrong = f"{root}: several sequences" if name is None else f"{root / name}: no such sequence"
        names = ", ".join(path.name for path in inside)
        raise InputError(f"{wrong}; choose one with --seq: {names}.")
    return None


def check_not_empty(path: Path) -> None:
    """Check that a file exists and is not empty.

    Raises:
        UnreadableImageError: the file is missing or empty.
    """
    try:
        empty = path.stat().st_size == 0
    except (OSError, ValueError) as error:  # ValueError: a path with a zero byte
        raise UnreadableImageError(
            path, "no such file; restore it, or correct the list or --data."
        ) from error
    if empty:
        raise UnreadableImageError(path, "the file is empty; download it again.")


def read_grey(path: Path, levels: Levels | None = None) -> Image:
    """Decode an image file to ``(H, W)`` uint8.

    Colours are converted to grey as defined by ITU-R BT.601.

    Args:
        levels: the grey level of each 16-bit value. None keeps the upper eight bits.

    Raises:
        UnreadableImageError: the file is missing, damaged or larger than `MOST_PIXELS`.
    """
    import cv2

    from vslam.datasets.png import decode_png

    try:
        data = path.read_bytes()
        if (image := decode_png(data)) is not None:
            return image
        decoded = decode(data, cv2.IMREAD_GRAYSCALE, levels)
    except cv2.error as error:
        if "MAX_IMAGE" in str(error):
            raise UnreadableImageError(
                path, f"has more than {MOST_PIXELS / 1e6:.0f} million pixels; scale it down."
            ) from error
        decoded = None
    except (OSError, ValueError):  # ValueError: the path has a zero byte
        decoded = None
    if decoded is None:
        raise UnreadableImageError(path, _why_not_grey(path))
    return np.asarray(decoded, np.uint8)


def _why_not_grey(path: Path) -> str:
    if (pixels := _decode_unchanged(path)) is not None:
        return (
            f"an image of {pixels.dtype} values; convert it to 8 or 16 bits, or give its folder "
            "with --depth if these are depths."
        )
    return why_not_an_image(path)


def read_colour(path: Path, levels: Levels | None = None) -> NDArray[np.uint8]:
    """Decode an image file to ``(H, W, 3)`` uint8 red, green, blue, or ``(H, W)`` if it is grey.

    ``levels`` has the same meaning as for `read_grey`.

    Raises:
        UnreadableImageError: the file is missing, damaged or larger than `MOST_PIXELS`.
    """
    import cv2

    grey = read_grey(path, levels)  # raises if the file cannot be decoded
    decoded = decode(path.read_bytes(), cv2.IMREAD_ANYCOLOR, levels)
    if decoded is None or decoded.ndim == 2:
        return grey
    return np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), np.uint8)


def _read_grey_of_size(size: Size, levels: Levels | None, path: Path) -> Image:
    image = read_grey(path, levels)
    if image.shape != size[::-1]:
        raise UnreadableImageError(
            path,
            f"has {size_text(image.shape)} pixels but the first image has {size[0]}x{size[1]}; "
            "replace it with the original.",
        )
    return image


def size_text(shape: tuple[int, ...]) -> str:
    """Format a shape ``(H, W)`` as the text ``WxH``."""
    return f"{shape[1]}x{shape[0]}"


def with_depth(camera: Camera, calibration: Calibration) -> Camera:
    """Return a camera for RGB-D images, with the virtual baseline of the calibration.

    If the calibration has no virtual baseline, the baseline of a Kinect is used.
    """
    baseline = calibration.virtual_baseline or _VIRTUAL_BASELINE
    return replace(camera, baseline=baseline, depth=True)


@dataclass(frozen=True)
class DepthScale:
    """The unit of depth images.

    Attributes:
        integers: units per metre of images of integers; None if it is unknown.
        floats: units per metre of images of floating-point numbers. None takes them for metres, and
            refuses an image that cannot be in metres.
    """

    integers: float | None
    floats: float | None = None


UNKNOWN_SCALE = DepthScale(None)


def depth_scale_of(given: float | None, usual: float | None) -> DepthScale:
    """Return the unit of depth images.

    Args:
        given: units per metre that the user gave for these images.
        usual: units per metre of the camera's images of integers.
    """
    return DepthScale(given or usual, given)


def _check_unit(scale: DepthScale, path: Path) -> None:
    """Raise an `InputError` if floating-point depth is too large to be in metres."""
    image = _decode_unchanged(path)
    if image is None or image.dtype.kind != "f" or scale.floats is not None:
        return
    known = image[np.isfinite(image) & (image > 0)]
    if known.size and (median := float(np.median(known))) > _FARTHEST_MEDIAN_M:
        raise UnreadableImageError(
            path,
            f"the median depth is {median:.0f} m, as if it were in millimetres; give "
            "--depth-scale 1000, or 1 if it is in metres.",
        )


def _read_depth(size: Size, scale: DepthScale, path: Path) -> DepthImage:
    image = _decode_unchanged(path)
    if image is None:
        raise UnreadableImageError(path, why_not_an_image(path))
    if image.ndim != 2 or (image.dtype.kind != "f" and image.dtype.itemsize == 1):
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise UnreadableImageError(
            path,
            f"the depth has {8 * image.dtype.itemsize} bits and {channels} channels, as a picture "
            "for viewing has; give the depth itself, as 16-bit integers or as floats of one "
            "channel.",
        )
    if image.shape != size[::-1]:
        raise UnreadableImageError(
            path,
            f"the depth has {size_text(image.shape)} pixels but the colour image has "
            f"{size[0]}x{size[1]}; take depth that is registered to the colour images.",
        )
    if image.dtype.kind == "f":
        metres = image.astype(np.float32) * np.float32(1.0 / (scale.floats or 1.0))
        return np.where(np.isfinite(metres), metres, np.float32(0.0))
    if scale.integers is None:
        raise UnreadableImageError(
            path,
            "the unit of the depth images is unknown; give --depth-scale, 1000 for millimetres, or "
            "depth_scale in the calibration.",
        )
    return image.astype(np.float32) * np.float32(1.0 / scale.integers)


def _decode_unchanged(path: Path) -> NDArray[Any] | None:
    """Decode an image or NPY file without changing its values; None if it cannot be decoded."""
    import cv2

    from vslam.datasets.png import decode_with_opencv

    try:
        data = path.read_bytes()
        if path.suffix.lower() == ".npy":
            image = np.squeeze(read_npy(BytesIO(data), len(data), path.name))
            return image if image.ndim in (2, 3) and image.dtype.kind in "uif" else None
        return decode_with_opencv(data, cv2.IMREAD_UNCHANGED)
    except (OSError, ValueError, cv2.error):
        return None
