"""The two images of every closed loop, side by side, with the matches that verified it.

The report and the recording show these pictures. Only the small JPEGs of the keyframes and a few
matches are kept while the run goes on; a picture is drawn when it is asked for.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
from vslam.features import Features, TrackResult
from vslam.loopclosure.learned_localisation import project
from vslam.loops import LoopEdge
from vslam.map import NONE, Map
from vslam.run.recorder import NullRecorder
from vslam.trajectory import Trajectory

# Half the size: OpenCV averages 2x2 pixels five times faster than any other share of an image, and
# a keyframe of KITTI takes 0.5 ms and 15 kB.
_SCALE = 0.5
_KEYFRAME_QUALITY = 60
_MOST_KEYFRAMES = 2000  # 30 MB; after that, every second image of those kept is dropped
_MOST_MATCHES = 60  # more lines hide the images

_PANEL_WIDTH, _GUTTER = 640, 8  # pixels of a picture
_PICTURE_QUALITY = 80
_SUBPIXEL = 4  # OpenCV draws positions in 16ths of a pixel
_WHITE, _INK, _GREEN = (255, 255, 255), (33, 23, 17), (153, 211, 52)  # BGR
_LINE_OPACITY = 0.35


@dataclass(frozen=True)
class LoopPicture:
    """What the picture of a closed loop is drawn from.

    Attributes:
        query_frame: the frame of this run that closed the loop.
        match_frame: the earlier frame of this run that shows the same place.
        query_jpeg, match_jpeg: their left images, at half the size.
        query_xy, match_xy: ``(N, 2)`` float64, the pixels of the small images at which both see
            the same landmark; at most 60 landmarks, spread over the image of the query.
    """

    query_frame: int
    match_frame: int
    query_jpeg: bytes
    match_jpeg: bytes
    query_xy: NDArray[np.float64]
    match_xy: NDArray[np.float64]


class LoopPictures(NullRecorder):
    """Keeps the small image of each keyframe and, for each closed loop, what to draw.

    There is no picture of a loop whose earlier image is not kept: that of another drive, of the
    part of a run before it was resumed, or one that a very long run has dropped.

    Attributes:
        pictures: of the loops that were closed, in order.
    """

    def __init__(self) -> None:
        self.pictures: list[LoopPicture] = []
        self._jpegs: dict[int, bytes] = {}  # by frame
        self._camera: Camera | None = None

    def begin(self, camera: Camera, ground_truth: Trajectory | None) -> None:
        """See `vslam.run.recorder.Recorder.begin`."""
        self._camera = camera

    def keyframe(
        self,
        result: TrackResult,
        image: NDArray[np.uint8],
        features: Features,
        tracked: NDArray[np.bool_],
    ) -> None:
        """See `vslam.run.recorder.Recorder.keyframe`."""
        if len(self._jpegs) == _MOST_KEYFRAMES:
            self._jpegs = dict(list(self._jpegs.items())[::2])
        small = cv2.resize(image, None, fx=_SCALE, fy=_SCALE, interpolation=cv2.INTER_AREA)
        self._jpegs[result.index] = _jpeg(small, _KEYFRAME_QUALITY)

    def loops(self, edges: Collection[LoopEdge], map_: Map) -> None:
        """See `vslam.run.recorder.Recorder.loops`."""
        assert self._camera is not None
        for edge in edges:
            if not edge.accepted or map_.sessions[edge.match] != map_.session:
                continue
            query_frame, match_frame = map_.frames[edge.query], map_.frames[edge.match]
            query, match = self._jpegs.get(query_frame), self._jpegs.get(match_frame)
            if query is None or match is None:
                continue
            query_xy, match_xy = (_small(xy) for xy in loop_matches(map_, edge, self._camera))
            shown = spread(query_xy, _MOST_MATCHES)
            self.pictures.append(
                LoopPicture(
                    query_frame, match_frame, query, match, query_xy[shown], match_xy[shown]
                )
            )


def loop_matches(
    map_: Map, edge: LoopEdge, camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The pixels at which the two keyframes of a closed loop see the same landmarks.

    After the loop was closed, the features of the query that verified it observe the landmarks of
    the place. A landmark that the match does not observe itself, but another keyframe of the place
    does, is projected into the match. Features that lost their landmark in the bundle adjustment
    after the loop, and landmarks out of sight of the match, are left out.

    Args:
        map_: after the correction of the loop.
        edge: an accepted loop.
        camera: of the keyframes.

    Returns:
        ``(N, 2)`` float64 pixels in the image of the query, and ``(N, 2)`` in that of the match.
    """
    assert edge.features is not None
    a, of_match = map_.arrays, map_.rows(edge.match)
    rows = map_.rows(edge.query).start + edge.features.astype(np.int64)
    rows = rows[a.landmark[rows] != NONE]
    landmarks = a.landmark[rows]
    match_xy = project(a.xyz[landmarks], map_.keyframe_pose(edge.match), camera)
    row_of = {landmark: row for row, landmark in enumerate(a.landmark[of_match].tolist())}
    for k, landmark in enumerate(landmarks.tolist()):
        if landmark in row_of:
            match_xy[k] = a.xy[of_match][row_of[landmark]]
    in_sight = np.isfinite(match_xy[:, 0])
    return a.xy[rows[in_sight]].astype(np.float64), match_xy[in_sight]


def spread(xy: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """Which of ``(N, 2)`` points to show so that at most ``most`` cover the image evenly: each one
    is the point that lies farthest from those chosen before it."""
    if len(xy) <= most:
        return np.arange(len(xy))
    chosen = [0]
    distance = np.linalg.norm(xy - xy[0], axis=1)
    while len(chosen) < most:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(xy - xy[chosen[-1]], axis=1))
    return np.array(chosen)


def draw_picture(picture: LoopPicture) -> bytes:
    """The JPEG of a closed loop: the earlier image on the left, the one that closed the loop on the
    right, and a line for each match."""
    left, scale = _panel(picture.match_jpeg)
    right, _ = _panel(picture.query_jpeg)
    gutter = np.full((len(left), _GUTTER, 3), _WHITE, np.uint8)
    canvas = np.hstack([left, gutter, right])
    starts = scale * (picture.match_xy + 0.5) - 0.5
    ends = scale * (picture.query_xy + 0.5) - 0.5 + [_PANEL_WIDTH + _GUTTER, 0.0]
    pairs = [(_fixed(a), _fixed(b)) for a, b in zip(starts, ends, strict=True)]
    lines = canvas.copy()
    for a, b in pairs:
        cv2.line(lines, a, b, _GREEN, 1, cv2.LINE_AA, _SUBPIXEL)
    canvas = cv2.addWeighted(lines, _LINE_OPACITY, canvas, 1.0 - _LINE_OPACITY, 0.0)
    for point in (point for pair in pairs for point in pair):
        cv2.circle(canvas, point, 7 << (_SUBPIXEL - 1), _INK, -1, cv2.LINE_AA, _SUBPIXEL)
        cv2.circle(canvas, point, 5 << (_SUBPIXEL - 1), _GREEN, -1, cv2.LINE_AA, _SUBPIXEL)
    _label(canvas, f"frame {picture.match_frame}", 0)
    _label(canvas, f"frame {picture.query_frame}", _PANEL_WIDTH + _GUTTER)
    return _jpeg(canvas, _PICTURE_QUALITY)


def _small(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels of the small image; the centre of the first pixel is at 0 in both."""
    return _SCALE * (xy + 0.5) - 0.5


def _panel(jpeg: bytes) -> tuple[NDArray[np.uint8], float]:
    """A small image in the width of half a picture, and how many times larger it is there."""
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    scale = _PANEL_WIDTH / image.shape[1]
    size = _PANEL_WIDTH, max(1, round(scale * image.shape[0]))
    grey = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR).astype(np.uint8, copy=False), scale


def _label(canvas: NDArray, text: str, left: int) -> None:
    """Write a text into the upper left corner of a panel."""
    font, size, margin = cv2.FONT_HERSHEY_SIMPLEX, 0.5, 7
    (width, height), _ = cv2.getTextSize(text, font, size, 1)
    right, bottom = left + width + 2 * margin, height + 2 * margin
    cv2.rectangle(canvas, (left, 0), (right, bottom), _INK, -1)
    cv2.putText(canvas, text, (left + margin, bottom - margin), font, size, _WHITE, 1, cv2.LINE_AA)


def _fixed(point: NDArray[np.float64]) -> tuple[int, int]:
    x, y = np.rint(point * 2**_SUBPIXEL).astype(int).tolist()
    return x, y


def _jpeg(image: NDArray, quality: int) -> bytes:
    # Colours at full resolution, or thin lines would lose theirs.
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return cv2.imencode(".jpg", image, options)[1].tobytes()
