"""Shared code of readers of image files: finding files, and decoding images and depth."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Several
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.models import Calibration
from vslam.camera import Camera, DepthImage, Image, ImageMap
from vslam.datasets.frames import Images, RawSource, Size, decoded, stored_frames
from vslam.errors import InputError, UnreadableImageError
from vslam.untrusted import MOST_PIXELS, require_utf8

# Distance in metres from a Kinect's projector to its camera (ORB-SLAM2, section III-A).
_VIRTUAL_BASELINE = 0.08
_SUFFIXES = {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".pgm", ".ppm"}


def checked_files(
    dataset: str,
    name: str,
    timestamps: NDArray[np.float64],
    ground_truth: NDArray[np.float64] | None,
    sides: Several[Several[Path]],
    depth_scale: float | None = None,
) -> RawSource:
    """Check all files, decode the first images and make a source of image files.

    Args:
        timestamps: ``(N,)`` float64 seconds.
        ground_truth: ``(N, 4, 4)`` float64 ``T_wc`` of the left camera, or None.
        sides: N files of the left camera alone, and N of the right one, or N depth images.
        depth_scale: units of the depth images per metre; None if there are none.

    Raises:
        UnreadableImageError: a file is empty, the first frame cannot be decoded, or depth has
            another size than the image or not 16 bits.
    """
    for path in (path for side in sides for path in side):
        check_not_empty(path)
    depth = depth_scale is not None
    sizes = tuple(image_size(side[0]) for side in (sides[:1] if depth else sides))
    grey = [partial(_read_grey_of, size) for size in sizes]
    readers: list[Callable[[Path], Image | DepthImage]] = [*grey]
    if depth_scale is not None:
        readers.append(partial(_read_depth, sizes[0], depth_scale))

    def read(index: int, image_map: ImageMap) -> Images:
        each = [partial(reader, side[index]) for reader, side in zip(readers, sides, strict=True)]
        return decoded(each, image_map)

    stored = stored_frames(timestamps, read, sides[0], read_colour)
    if len(sizes) == 2:
        stored = tuple(
            replace(frame, sides=(partial(grey[0], left), partial(grey[1], right)))
            for frame, left, right in zip(stored, *sides, strict=True)
        )
    source = RawSource(
        dataset=dataset,
        name=name,
        sizes=sizes,
        depth=depth,
        stored=stored,
        ground_truth=ground_truth,
    )
    if depth:
        source.read(0)
    return source


def image_size(path: Path) -> Size:
    """Width and height.

    Raises:
        UnreadableImageError: missing or damaged.
    """
    height, width = read_grey(path).shape
    return width, height


def list_images(folder: Path) -> dict[str, Path]:
    """Image files of a folder by stem, in the order of their names; empty if there is no folder.

    Raises:
        InputError: a file name is not UTF-8.
    """
    if not folder.is_dir():
        return {}
    images = [path for path in sorted(folder.iterdir()) if is_image(path)]
    for path in images:
        require_utf8(path)
    return {path.stem: path for path in images}


def is_image(path: Path) -> bool:
    """Whether a file has the suffix of an image format."""
    return path.suffix.lower() in _SUFFIXES and not path.name.startswith(".")


def find_sequence(root: Path, name: str | None, is_sequence: Callable[[Path], bool]) -> Path | None:
    """Folder of a sequence: one in ``root``, or ``root`` itself; None if there is no sequence.

    Args:
        name: name of the folder; None for ``root`` itself, or the only sequence in it.

    Raises:
        InputError: no sequence of this name, or several and no name.
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
    inside = sorted(p.name for p in root.iterdir() if is_sequence(p)) if root.is_dir() else []
    if name is None and len(inside) == 1:
        return root / inside[0]
    if inside:
        wrong = f"{root}: several sequences" if name is None else f"{root / name}: no such sequence"
        raise InputError(f"{wrong}; choose one with --seq: {', '.join(inside)}.")
    return None


def select_frames(
    source: Path, n: int, start: int, every: int, max_frames: int | None
) -> NDArray[np.int64]:
    """Numbers of the frames that ``start``, ``every`` and ``max_frames`` select from n > 0 frames.

    Raises:
        InputError: options out of range, or a start beyond the last frame of ``source``.
    """
    if start < 0 or every < 1 or (max_frames is not None and max_frames < 1):
        raise InputError("--start must be at least 0, --every and --max-frames at least 1.")
    if start >= n:
        raise InputError(f"--start {start}: {source} has {n} frames; choose at most {n - 1}.")
    return np.arange(start, n, every)[:max_frames]


def check_not_empty(path: Path) -> None:
    """Refuse a file without contents.

    Raises:
        UnreadableImageError: the file is empty, missing, or a link to nowhere.
    """
    try:
        empty = path.stat().st_size == 0
    except (OSError, ValueError) as error:  # ValueError: a path with a zero byte
        raise UnreadableImageError(path, "no such file; unpack the data again.") from error
    if empty:
        raise UnreadableImageError(path, "the file is empty; download it again.")


def read_grey(path: Path) -> Image:
    """Decode an image file: ``(H, W)`` uint8. Colours are converted to grey by ITU-R BT.601; of
    16 bits, the upper eight are used.

    Raises:
        UnreadableImageError: missing, damaged or larger than `MOST_PIXELS`.
    """
    import cv2

    from vslam.datasets.png import decode_png, decode_with_opencv

    try:
        data = path.read_bytes()
        if (image := decode_png(data)) is not None:
            return image
        decoded = decode_with_opencv(data, cv2.IMREAD_GRAYSCALE)
    except cv2.error as error:
        if "MAX_IMAGE" in str(error):
            raise UnreadableImageError(
                path, f"has more than {MOST_PIXELS / 1e6:.0f} million pixels; scale it down."
            ) from error
        decoded = None
    except (OSError, ValueError):  # ValueError: the path has a zero byte
        decoded = None
    if decoded is None:
        raise UnreadableImageError(path, "cannot be decoded; download the file again.")
    return np.asarray(decoded, np.uint8)


def read_colour(path: Path) -> NDArray[np.uint8]:
    """Decode an image file: ``(H, W, 3)`` uint8 red, green, blue, or ``(H, W)`` if it is grey.

    Raises:
        UnreadableImageError: as `read_grey`.
    """
    import cv2

    from vslam.datasets.png import decode_with_opencv

    grey = read_grey(path)  # refuses what cannot be decoded
    decoded = decode_with_opencv(path.read_bytes(), cv2.IMREAD_ANYCOLOR)
    if decoded is None or decoded.ndim == 2:
        return grey
    return np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), np.uint8)


def _read_grey_of(size: Size, path: Path) -> Image:
    """As `read_grey`, and check that the image has the size of the first one."""
    image = read_grey(path)
    if image.shape != size[::-1]:
        raise UnreadableImageError(
            path,
            f"{size_text(image.shape)} pixels where the first image has {size[0]}x{size[1]}; "
            "replace it by the original.",
        )
    return image


def size_text(shape: tuple[int, ...]) -> str:
    """A shape ``(H, W)`` as the text ``WxH``."""
    return f"{shape[1]}x{shape[0]}"


def with_depth(camera: Camera, calibration: Calibration) -> Camera:
    """Give an RGB-D camera the calibration's virtual baseline, or that of a Kinect."""
    baseline = calibration.virtual_baseline or _VIRTUAL_BASELINE
    return replace(camera, baseline=baseline, depth=True)


def _read_depth(size: Size, scale: float, path: Path) -> DepthImage:
    import cv2

    from vslam.datasets.png import decode_with_opencv

    try:
        image = decode_with_opencv(path.read_bytes(), cv2.IMREAD_UNCHANGED)
    except (OSError, ValueError, cv2.error):
        image = None
    if image is None:
        raise UnreadableImageError(path, "cannot be decoded; download the file again.")
    if image.dtype != np.uint16 or image.ndim != 2:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise UnreadableImageError(
            path,
            f"depth of {8 * image.dtype.itemsize} bits and {channels} channels, but it must be one "
            "channel of 16 bits; take the original.",
        )
    if image.shape != size[::-1]:
        raise UnreadableImageError(
            path,
            f"depth has {size_text(image.shape)} pixels but the colour image has "
            f"{size[0]}x{size[1]}; take depth that is registered to the colour images.",
        )
    return np.asarray(image, np.uint16) * np.float32(1.0 / scale)
