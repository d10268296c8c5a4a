"""Images reduced to thumbnails and correlated: a detector that was never trained on anything.

As the simple mode of cuVSLAM (libs/slam/vpr, version 17): a grey image about eight times smaller,
compared by zero-mean normalised cross-correlation, so that gain and offset do not matter. cuVSLAM
compares thumbnails in place; here, as in OpenRatSLAM (Ball et al., Autonomous Robots 2013), the
view may be shifted by a few pixels, and the score is the highest correlation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.loopbench.conditions import Image
from vslam.loopbench.detectors import DescribedImage

Float = NDArray[np.float32]

_WIDTH, _HEIGHT = 128, 48  # pixels
_ASIDE, _UP, _STEP = 8, 2, 2  # pixels of shift, and between the shifts tried
_FLAT = 1e-6  # length below which a thumbnail shows nothing


class ThumbnailScorer:
    """See :class:`vslam.loopbench.detectors.Scorer`."""

    name = "thumbnail"
    probability = False

    def store(self, gallery: list[DescribedImage]) -> Float:
        """Thumbnails ``(G, 48, 128)``."""
        return np.stack([thumbnail(one.image) for one in gallery])

    def scores(self, queries: list[DescribedImage], stored: Float) -> NDArray[np.float64]:
        """See :func:`correlations`."""
        return correlations(self.store(queries), stored)


def correlations(queries: Float, gallery: Float) -> NDArray[np.float64]:
    """``(Q, G)`` highest correlation of a query's middle with a part of that size, -1 to 1.

    Args:
        queries, gallery: thumbnails ``(N, 48, 128)``.
    """
    middle = _part(queries, 0, 0)
    best = np.full((len(queries), len(gallery)), -1.0, np.float32)
    for up in range(-_UP, _UP + 1, _STEP):
        for aside in range(-_ASIDE, _ASIDE + 1, _STEP):
            np.maximum(best, middle @ _part(gallery, up, aside).T, out=best)
    return best.astype(np.float64)


def thumbnail(image: Image) -> Float:
    """The image ``(H, W)`` in ``(48, 128)`` float32."""
    import cv2

    small = cv2.resize(image, (_WIDTH, _HEIGHT), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)


def _part(thumbnails: Float, up: int, aside: int) -> Float:
    """``(N, D)`` what lies that far from the middle, with mean 0 and length 1."""
    rows = thumbnails[
        :, _UP + up : _HEIGHT - _UP + up, _ASIDE + aside : _WIDTH - _ASIDE + aside
    ].reshape(len(thumbnails), -1)
    rows = rows - rows.mean(1, keepdims=True)
    length: Float = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.maximum(length, _FLAT)
