"""An untrained detector that correlates thumbnails of images.

As in the simple mode of cuVSLAM (libs/slam/vpr, version 17), grey images are reduced about eight
times and compared by zero-mean normalised cross-correlation, which ignores gain and offset. cuVSLAM
compares thumbnails without a shift; here, as in OpenRatSLAM (Ball et al., Autonomous Robots 2013),
the score is the highest correlation over shifts by a few pixels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.lab.loopbench.conditions import Image
from vslam.lab.loopbench.detectors import DescribedImage

Float = NDArray[np.float32]

_WIDTH, _HEIGHT = 128, 48  # pixels
_ASIDE, _UP, _STEP = 8, 2, 2  # largest shifts and step between shifts, pixels
_FLAT = 1.0  # norm, in grey levels, below which a part has no texture
_TOGETHER = 16  # queries compared at a time, to limit memory
# The 27 shifted parts of a thumbnail; the 14th is the middle, which is compared with all parts.
_PARTS = tuple(
    (slice(_UP + up, _HEIGHT - _UP + up), slice(_ASIDE + aside, _WIDTH - _ASIDE + aside))
    for up in range(-_UP, _UP + 1, _STEP)
    for aside in range(-_ASIDE, _ASIDE + 1, _STEP)
)
_MIDDLE = _PARTS[len(_PARTS) // 2]


class Gallery(NamedTuple):
    """``rows`` (G, 6144) f4 thumbnails minus their means; ``length`` (27, G) f4 norm of each part
    minus its own mean."""

    rows: Float
    length: Float


class ThumbnailScorer:
    """See :class:`vslam.lab.loopbench.detectors.Scorer`."""

    name = "thumbnail"
    probability = False

    def store(self, gallery: list[DescribedImage]) -> Gallery:
        """See :func:`remember`."""
        return remember(np.stack([thumbnail(one.image) for one in gallery]))

    def scores(self, queries: list[DescribedImage], stored: Gallery) -> NDArray[np.float64]:
        """See :func:`correlations`."""
        return correlations(np.stack([thumbnail(one.image) for one in queries]), stored)


def thumbnail(image: Image) -> Float:
    """Reduce an image ``(H, W)`` to ``(48, 128)`` float32."""
    import cv2

    small = cv2.resize(image, (_WIDTH, _HEIGHT), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)


def remember(thumbnails: Float) -> Gallery:
    """Precompute the data for correlation with thumbnails ``(G, 48, 128)``."""
    rows = _centred(thumbnails)
    length = [np.linalg.norm(_centred(thumbnails[:, y, x]), axis=1) for y, x in _PARTS]
    return Gallery(rows, np.maximum(np.stack(length), _FLAT))


def correlations(queries: Float, gallery: Gallery) -> NDArray[np.float64]:
    """``(Q, G)`` highest correlation, -1 to 1, of a query's middle with a part of an image.

    Args:
        queries: thumbnails ``(Q, 48, 128)``.
        gallery: result of :func:`remember`.
    """
    middle = _centred(queries[:, *_MIDDLE])
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), _FLAT)
    middle = middle.reshape(queries[:, *_MIDDLE].shape)
    best = [_best(middle[k : k + _TOGETHER], gallery) for k in range(0, len(middle), _TOGETHER)]
    return np.concatenate(best).astype(np.float64)


def _best(middle: Float, gallery: Gallery) -> Float:
    # The middle has mean 0, so the mean of the other part does not matter.
    laid = np.zeros((len(middle), len(_PARTS), _HEIGHT, _WIDTH), np.float32)
    for k, (y, x) in enumerate(_PARTS):
        laid[:, k, y, x] = middle
    product = laid.reshape(-1, _HEIGHT * _WIDTH) @ gallery.rows.T
    best: Float = (product.reshape(len(middle), len(_PARTS), -1) / gallery.length).max(1)
    return best


def _centred(images: Float) -> Float:
    """``(N, D)`` images, each with mean 0."""
    rows = images.reshape(len(images), -1)
    centred: Float = rows - rows.mean(1, keepdims=True)
    return centred
