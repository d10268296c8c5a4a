"""Adds masks to the left images of a source. A mask selects the pixels that are used.

As in COLMAP and OpenCV, the pixels to ignore are black (0) in the mask. All other pixels are white
(255). A mask has the size of the original images. It is rectified in the same way as the images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import starmap
from pathlib import Path

import numpy as np

from vslam.datasets.frames import Source, TimedFrame
from vslam.datasets.image_files import list_images, read_grey, size_text
from vslam.support.errors import InputError, UnreadableImageError
from vslam.types.camera import Image

ReadMask = Callable[[], Image]


def with_masks(source: Source, path: Path, *, start: int = 0, every: int = 1) -> Source:
    """Add masks to the frames of a source.

    Args:
        path: one mask for all images, or a folder with a mask for each image. The mask of the image
            ``7.jpg`` may be named ``7.png``, ``7.jpg.png``, or ``7`` with a different suffix. For a
            video or bag, the name of a mask is the number of the frame.
        start: if ``source`` is a selection of frames, the index of the first selected frame.
        every: step with which the frames were selected.

    Raises:
        InputError: there is no such file or folder, or a frame has no mask.
        UnreadableImageError: the first mask is not black and white, its size differs from that of
            the images, or it hides all pixels. The other masks are checked when they are read.
    """
    if not path.exists():
        raise InputError(f"--mask {path}: no such file or folder; give a mask or a folder of them.")
    find = _masks_in(source, path) if path.is_dir() else _one_mask(source, path)

    def masked(index: int, frame: TimedFrame) -> TimedFrame:
        return replace(frame, mask=find(frame.name, start + every * index))

    if (play := source.play) is not None:
        return replace(source, play=lambda: starmap(masked, enumerate(play())))
    return replace(source, stored=tuple(starmap(masked, enumerate(source.stored))))


def _one_mask(source: Source, path: Path) -> Callable[[str | None, int], ReadMask]:
    mask = _read(source, path)
    return lambda name, number: lambda: mask


def _masks_in(source: Source, folder: Path) -> Callable[[str | None, int], ReadMask]:
    files = list_images(folder)
    if not files:
        raise InputError(f"--mask {folder}: holds no masks; give a folder with one for each image.")
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
    mask, camera = read_grey(path), source.camera
    width, height = camera.width, camera.height
    if camera.quarter_turns:  # the original images are not turned yet
        width, height = height, width
    if mask.shape != (height, width):
        size = size_text(mask.shape)
        why = f"has {size} pixels but the images have {width}x{height}; give the mask this size."
        raise UnreadableImageError(path, why)
    grey = np.bincount(mask.ravel(), minlength=256)[1:255]
    if grey.any():
        value = 1 + int(grey.argmax())
        why = f"has pixels of value {value}, but may only hold 0 (ignored) and 255 (used)."
        raise UnreadableImageError(path, why)
    if source.rectify_mask is not None:
        mask = source.rectify_mask(mask)
    if not mask.any():
        raise UnreadableImageError(path, "hides the whole image; paint used pixels white (255).")
    return mask
