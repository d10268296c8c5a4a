"""The images of keyframes as files, and the colours of landmarks in these images."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.maps.reconstruction import Reconstruction

_LUMA = np.array([299, 587, 114])  # ITU-R BT.601, in thousandths


def save_image(image: NDArray[np.uint8], path: Path) -> None:
    """Write an image as PNG.

    Args:
        image: ``(H, W)`` grey or ``(H, W, 3)`` red, green, blue.

    Raises:
        OSError: the file cannot be written.
    """
    import cv2

    if image.ndim == 3:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), np.uint8)
    _, encoded = cv2.imencode(".png", image)
    path.write_bytes(encoded.tobytes())


def landmark_colours(
    reconstruction: Reconstruction, images: Iterable[NDArray[np.uint8]]
) -> NDArray[np.uint8]:
    """``(L, 3)`` uint8 RGB of each landmark, from the observation of median brightness.

    Args:
        images: ``(H, W)`` grey or ``(H, W, 3)`` red, green, blue image of each keyframe, in order.
    """
    r = reconstruction
    colours = np.empty((len(r.xy), 3), np.uint8)
    for keyframe, image in zip(range(len(r.frames)), images, strict=True):
        seen = r.observations_of(keyframe)
        x, y = np.rint(r.xy[seen]).astype(np.int64).T
        pixels = image[y.clip(0, image.shape[0] - 1), x.clip(0, image.shape[1] - 1)]
        colours[seen] = pixels.reshape(len(pixels), -1)
    order = np.lexsort((colours @ _LUMA, r.landmark))
    counts = np.bincount(r.landmark, minlength=len(r.xyz))
    # The lower median, which is a colour that was observed.
    middle = order[np.cumsum(counts) - counts + (counts - 1) // 2]
    return colours[middle]
