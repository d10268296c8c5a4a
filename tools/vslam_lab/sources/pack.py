"""Writes image sources to one small file, and reads such a file.

The file is useful on machines that have too little space for the original images.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.loopclosure.siamese.images import Fit, Size
from vslam.support.errors import InputError, write_file
from vslam.support.untrusted import read_npz
from vslam_lab.sources.image_source import ImageSource


def write_pack(sources: list[ImageSource], path: Path, size: Size, fit: Fit) -> None:
    """Write the images and relations of image sources as one npz file (docs/howto/training.md). The
    images are stored as JPEG files at the input size of a network."""
    import cv2

    arrays: dict[str, NDArray] = {"count": np.array(len(sources))}
    for k, source in enumerate(sources):
        encoded = [
            cv2.imencode(".jpg", source.read(i, size, fit), (cv2.IMWRITE_JPEG_QUALITY, 85))[1]
            for i in range(len(source))
        ]
        arrays[f"{k}_text"] = np.array([source.name, source.family, *source.names])
        arrays[f"{k}_sizes"] = np.array([len(e) for e in encoded])
        arrays[f"{k}_bytes"] = np.concatenate([e.ravel() for e in encoded])
        arrays[f"{k}_relation"], arrays[f"{k}_unit"] = source.relation, source.unit
        if source.is_query is not None:
            arrays[f"{k}_is_query"] = source.is_query
        if source.times is not None:
            arrays[f"{k}_times"] = source.times
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)  # type: ignore[arg-type]
    write_file(path, content.getvalue())


def read_pack(path: Path) -> list[ImageSource]:
    """Read the image sources from a file that ``write_pack`` wrote.

    Raises:
        InputError: the file is missing or damaged.
    """
    content = read_npz(path, "a pack of places", "write it with 'vslam export places'")
    try:
        sources = []
        for k in range(int(content["count"])):
            name, family, *names = content[f"{k}_text"].tolist()
            ends = np.cumsum(content[f"{k}_sizes"])[:-1]
            images = tuple(np.split(content[f"{k}_bytes"], ends))
            relation, unit = content[f"{k}_relation"], content[f"{k}_unit"]
            # Only some sources have these, and packs of earlier versions have neither.
            is_query, times = content.get(f"{k}_is_query"), content.get(f"{k}_times")
            sources.append(
                ImageSource(
                    name, family, tuple(names), images, relation, unit,
                    is_query=is_query, times=times,
                )
            )  # fmt: skip
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(
            f"{path}: not a pack of places; write it with 'vslam export places'."
        ) from error
    return sources
