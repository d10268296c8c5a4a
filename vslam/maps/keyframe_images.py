"""The images of keyframes as files, and the colours that landmarks have in them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.maps.reconstruction import Reconstruction


def save_image(image: NDArray[np.uint8], path: Path) -> None:
    """Write an image as PNG.

    Raises:
        OSError: the file cannot be written.
    """
    import cv2

    _, encoded = cv2.imencode(".png", image)
    path.write_bytes(encoded.tobytes())


def landmark_colours(
    reconstruction: Reconstruction, images: Iterable[NDArray[np.uint8]]
) -> NDArray[np.uint8]:
    """``(L, 3)`` RGB of each landmark: the median over its observations, of the pixel observed.

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
    # Of an even number the lower one of both in the middle: a grey that was seen.
    middle = order[np.cumsum(counts) - counts + (counts - 1) // 2]
    return np.repeat(grey[middle, None], 3, axis=1)
