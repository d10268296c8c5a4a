"""Keeps small images of some keyframes for the report, and pictures of the closed loops."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.run.loop_pictures import LoopPicture, loop_matches, spread
from vslam.run.recorder import Recorder
from vslam.types.camera import Camera, Image
from vslam.types.features import TrackResult
from vslam.types.loops import LoopEdge
from vslam.types.map import Map
from vslam.types.trajectory import Trajectory

_MOST = 96  # images; they take about 1 MB of the page
_WIDTH = 360  # pixels, of an image
_QUALITY = 55
_MOST_POINTS = 400

# Images of closed loops have half the original size, because OpenCV averages 2x2 pixels five times
# faster than it scales by other factors. A keyframe of KITTI takes 0.2 ms and 15 kB.
_LOOP_SCALE = 0.5
_LOOP_QUALITY = 60
_MOST_LOOP_IMAGES = 2000  # 30 MB; if there are more, every second image is dropped
_MOST_MATCHES = 60  # more lines would hide the images


@dataclass(frozen=True)
class Moment:
    """The image of a keyframe and its keypoints, as the report shows them.

    Attributes:
        frame: index of the keyframe's frame in the run.
        jpeg: left image of the keyframe as JPEG, at most 360 pixels wide.
        points: ``(N, 2)`` uint8 positions of keypoints. The value 255 corresponds to the width or
            height of the image.
        tracked: ``(N,)`` bool, whether each keypoint is an inlier match of a landmark.
    """

    frame: int
    jpeg: bytes
    points: NDArray[np.uint8]
    tracked: NDArray[np.bool_]


class MomentRecorder(Recorder):
    """Keeps the images of at most 96 keyframes, which are spread evenly over the run.

    Whenever there are more than 96 images, every second image is dropped.
    """

    def __init__(self) -> None:
        self.moments: list[Moment] = []
        self._every = 1
        self._n_keyframes = 0

    def keyframe(self, result: TrackResult, image: Image, xy: NDArray, tracked: NDArray) -> None:
        if self._n_keyframes % self._every == 0:
            if len(self.moments) == _MOST:
                self.moments = self.moments[::2]
                self._every *= 2
            if self._n_keyframes % self._every == 0:
                self.moments.append(_moment(result.index, image, xy, tracked))
        self._n_keyframes += 1


def _moment(
    frame: int, image: Image, xy: NDArray[np.float32], tracked: NDArray[np.bool_]
) -> Moment:
    height, width = image.shape
    size = min(width, _WIDTH), max(1, round(height * min(width, _WIDTH) / width))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    # Tracked keypoints come first. Taking every n-th keypoint thins out both kinds evenly.
    order = np.argsort(~tracked, kind="stable")
    order = order[:: max(1, -(-len(order) // _MOST_POINTS))]
    share = xy[order] / np.array([width, height], np.float32)
    points = np.clip(np.rint(255 * share), 0, 255).astype(np.uint8)
    return Moment(frame, jpeg, points, tracked[order])


class LoopPictureRecorder(Recorder):
    """Keeps a small image of each keyframe, and the data for a picture of each closed loop.

    A loop has no picture if the image of its earlier keyframe was not kept. This is the case for
    images of earlier drives, for images from before a run was resumed, and for every second image
    of a very long run.

    Attributes:
        pictures: pictures of the closed loops, in order.
    """

    def __init__(self) -> None:
        self.pictures: list[LoopPicture] = []
        self._jpegs: dict[int, bytes] = {}  # image by frame
        self._camera: Camera | None = None

    def begin(self, camera: Camera, ground_truth: Trajectory | None) -> None:
        self._camera = camera

    def keyframe(self, result: TrackResult, image: Image, xy: NDArray, tracked: NDArray) -> None:
        if len(self._jpegs) == _MOST_LOOP_IMAGES:
            self._jpegs = dict(list(self._jpegs.items())[::2])
        s = _LOOP_SCALE
        small = cv2.resize(image, None, fx=s, fy=s, interpolation=cv2.INTER_AREA)
        jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _LOOP_QUALITY])[1]
        self._jpegs[result.index] = jpeg.tobytes()

    def loops(self, edges: Collection[LoopEdge], map_: Map) -> None:
        assert self._camera is not None
        for edge in edges:
            if not edge.accepted or map_.sessions[edge.match] != map_.scalars.session:
                continue
            query_frame, match_frame = map_.frames[[edge.query, edge.match]].tolist()
            query, match = self._jpegs.get(query_frame), self._jpegs.get(match_frame)
            if query is None or match is None:
                continue
            xy = np.stack(loop_matches(map_, edge, self._camera))
            xy = _LOOP_SCALE * (xy[:, spread(xy[0], _MOST_MATCHES)] + 0.5) - 0.5
            picture = LoopPicture(query_frame, match_frame, query, match, xy[0], xy[1])
            self.pictures.append(picture)
