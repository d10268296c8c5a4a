"""The images of keyframes as files, and the colours of landmarks in these images."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.maps.reconstruction import Reconstruction


def saved_images(
    images: Iterable[NDArray[np.uint8]], paths: Iterable[Path]
) -> Iterator[NDArray[np.uint8]]:
    """Write each image to its path as PNG, and yield it.

    Raises:
        OSError: a file cannot be written.
    """
    import cv2

    for image, path in zip(images, paths, strict=True):
        _, encoded = cv2.imencode(".png", image)
        path.write_bytes(encoded.tobytes())
        yield image


def landmark_colours(
    reconstruction: Reconstruction, images: Iterable[NDArray[np.uint8]]
) -> NDArray[np.uint8]:
    """``(L, 3)`` uint8 RGB of each landmark: the median of the pixels at its observations.

    Args:
        images: ``(H, W)`` grey image of each keyframe, in order.
    """
    r = reconstruction
    grey = np.empty(len(r.xy), np.uint8)
    for keyframe, image in zip(range(len(r.frames)), images, strict=True):
        seen = r.observations_of(keyframe)
        x, y = np.rint(r.xy[seen]).astype(np.int64).T
        grey[seen] = image[y.clip(0, image.shape[0] - 1), x.clip(0, image.shape[1] - 1)]
    order = np.lexsort((grey, r.landmark))
    counts = np.bincount(r.landmark, minlength=len(r.xyz))
    # The lower median, which is a grey value that was observed.
    middle = order[np.cumsum(counts) - counts + (counts - 1) // 2]
    return np.repeat(grey[middle, None], 3, axis=1)
