"""Small images of some keyframes with their keypoints, for the page that people look at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.features import Features, TrackResult
from vslam.run.recorder import NullRecorder

_MOST = 96  # moments: about 1 MB of the page
_WIDTH = 360  # pixels
_QUALITY = 55
_MOST_POINTS = 400


@dataclass(frozen=True)
class Moment:
    """A keyframe as the page shows it.

    Attributes:
        frame: of the run.
        jpeg: its left image, 360 pixels wide or less.
        points: ``(N, 2)`` uint8 keypoints in 255ths of width and height.
        tracked: ``(N,)`` whether each is an inlier of the map.
    """

    frame: int
    jpeg: bytes
    points: NDArray[np.uint8]
    tracked: NDArray[np.bool_]


class MomentRecorder(NullRecorder):
    """Keeps every keyframe at first and, whenever there are too many, every second of those kept:
    what is kept depends on the keyframes alone, and lies evenly over a run of any length."""

    def __init__(self) -> None:
        self.moments: list[Moment] = []
        self._every = 1
        self._n_keyframes = 0

    def keyframe(
        self,
        result: TrackResult,
        image: NDArray[np.uint8],
        features: Features,
        tracked: NDArray[np.bool_],
    ) -> None:
        """See `vslam.run.recorder.Recorder.keyframe`."""
        if self._n_keyframes % self._every == 0:
            if len(self.moments) == _MOST:
                self.moments = self.moments[::2]
                self._every *= 2
            if self._n_keyframes % self._every == 0:
                self.moments.append(_moment(result.index, image, features, tracked))
        self._n_keyframes += 1


def _moment(
    frame: int, image: NDArray[np.uint8], features: Features, tracked: NDArray[np.bool_]
) -> Moment:
    import cv2

    height, width = image.shape
    size = min(width, _WIDTH), max(1, round(height * min(width, _WIDTH) / width))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    # Tracked ones first, evenly thinned out.
    order = np.argsort(~tracked, kind="stable")
    order = order[:: max(1, -(-len(order) // _MOST_POINTS))]
    share = features.xy[order] / np.array([width, height], np.float32)
    points = np.clip(np.rint(255 * share), 0, 255).astype(np.uint8)
    return Moment(frame, jpeg, points, tracked[order])
