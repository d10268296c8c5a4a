"""Masks that belong to a source: which pixels of its left images are used.

As for COLMAP and OpenCV, a mask is black (0) where the image is not to be used and white (255)
elsewhere. It has the size of the images as they were taken, and is rectified like them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import starmap
from pathlib import Path

import numpy as np

from vslam.camera import Image
from vslam.datasets.frames import Source, TimedFrame
from vslam.datasets.image_files import list_images, read_grey, size_text
from vslam.errors import InputError, UnreadableImageError

ReadMask = Callable[[], Image]


def with_masks(source: Source, path: Path, *, start: int = 0, every: int = 1) -> Source:
    """A source whose frames have masks.

    Args:
        path: one mask for all images; or a folder with a mask for each image. These are named like
            the image files, with any suffix or with one more (``7.jpg.png``); if there are no image
            files, by the number of the frame in the video or bag.
        start, every: the frames that were selected from the source.

    Raises:
        InputError: there is no such file or folder, an image has no mask, or a mask is not black
            and white, has another size than the images or hides all of them. A mask that is wrong
            for a single image raises UnreadableImageError when it is read.
    """
    if not path.exists():
        raise InputError(f"--mask {path}: no such file or folder; name a mask or a folder of them.")
    find = _in_folder(source, path) if path.is_dir() else _for_all(source, path)

    def masked(index: int, frame: TimedFrame) -> TimedFrame:
        return replace(frame, mask=find(frame.name, start + every * index))

    if (play := source.play) is not None:
        return replace(source, play=lambda: starmap(masked, enumerate(play())))
    return replace(source, stored=tuple(starmap(masked, enumerate(source.stored))))


def _for_all(source: Source, path: Path) -> Callable[[str | None, int], ReadMask]:
    mask = _read(source, path)

    def read() -> Image:
        return mask

    return lambda name, number: read


def _in_folder(source: Source, folder: Path) -> Callable[[str | None, int], ReadMask]:
    files = list_images(folder)
    if not files:
        raise InputError(f"--mask {folder}: holds no images; name a folder with a mask for each.")
    _read(source, next(iter(files.values())))
    by_number = {int(stem): file for stem, file in files.items() if stem.isdecimal()}

    def find(name: str | None, number: int) -> ReadMask:
        if name is None:
            file, wanted = by_number.get(number), f"{number:06}.png for frame {number}"
        else:
            stem = Path(name).stem
            file, wanted = files.get(stem, files.get(name)), f"{stem}.png for the image {name}"
        if file is None:
            raise InputError(f"--mask {folder}: there is no {wanted}; add this mask.")
        return partial(_read, source, file)

    return find


def _read(source: Source, path: Path) -> Image:
    mask, width, height = read_grey(path), source.camera.width, source.camera.height
    if mask.shape != (height, width):
        size = size_text(mask.shape)
        why = f"{size} pixels where the images have {width}x{height}; give the mask their size."
        raise UnreadableImageError(path, why)
    grey = np.bincount(mask.ravel(), minlength=256)[1:255]
    if grey.any():
        value = 1 + int(grey.argmax())
        why = f"has pixels of {value}; make those to be used 255 (white) and the others 0 (black)."
        raise UnreadableImageError(path, why)
    if source.rectify_mask is not None:
        mask = source.rectify_mask(mask)
    if not mask.any():
        raise UnreadableImageError(path, "hides the whole image; make white what is to be used.")
    return mask
