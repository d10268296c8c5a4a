"""Draws pictures of closed loops. A picture shows the two images of a loop and their matches."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.loopclosure.learned_localisation import project
from vslam.types.camera import Camera
from vslam.types.loops import LoopEdge
from vslam.types.map import NONE, Map

_PANEL_WIDTH, _GUTTER = 640, 8  # width of a panel and of the space between panels, in pixels
_QUALITY = 80
_SUBPIXEL = 4  # fractional bits of the positions that OpenCV draws
_WHITE, _INK, _GREEN = (255, 255, 255), (33, 23, 17), (153, 211, 52)  # BGR
_LINE_OPACITY = 0.35


@dataclass(frozen=True)
class LoopPicture:
    """The data from which the picture of a closed loop is drawn.

    Attributes:
        query_frame: index of the frame of this run that closed the loop.
        match_frame: index of the earlier frame of this run that shows the same place.
        query_jpeg, match_jpeg: left images of these frames as JPEG, in grey and at reduced size.
        query_xy, match_xy: ``(N, 2)`` float64 positions (pixels) of the same landmarks in the two
            reduced images.
    """

    query_frame: int
    match_frame: int
    query_jpeg: bytes
    match_jpeg: bytes
    query_xy: NDArray[np.float64]
    match_xy: NDArray[np.float64]


def loop_matches(
    map_: Map, edge: LoopEdge, camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the positions of landmarks in the images of both keyframes of a closed loop.

    A landmark that the matched keyframe does not observe is projected into its image. If it lies
    outside this image, it is left out.

    Args:
        map_: the map after the correction of the loop.
        edge: an accepted loop.

    Returns:
        Two ``(N, 2)`` float64 arrays with the same N landmarks, in pixels: the positions in the
        image of the query keyframe, and the positions in the image of the matched keyframe.
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
    """Choose at most ``most`` of ``(N, 2)`` points, evenly spread, by farthest-point sampling.

    Returns:
        The indices of the chosen points.
    """
    if len(xy) <= most:
        return np.arange(len(xy))
    chosen = [0]
    distance = np.linalg.norm(xy - xy[0], axis=1)
    while len(chosen) < most:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(xy - xy[chosen[-1]], axis=1))
    return np.array(chosen)


def draw_picture(picture: LoopPicture) -> bytes:
    """Draw a closed loop as a JPEG.

    The earlier image is on the left, and the image that closed the loop is on the right. A line
    connects the two positions of each landmark.
    """
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
    # Chroma subsampling would desaturate thin lines.
    options = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    options += [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    return cv2.imencode(".jpg", canvas, options)[1].tobytes()


def _panel(jpeg: bytes) -> tuple[NDArray[np.uint8], float]:
    """Scale an image to the width of a panel, and return it with the scale factor."""
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    scale = _PANEL_WIDTH / image.shape[1]
    size = _PANEL_WIDTH, max(1, round(scale * image.shape[0]))
    grey = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR).astype(np.uint8, copy=False), scale


def _label(canvas: NDArray, text: str, left: int) -> None:
    font, size, margin = cv2.FONT_HERSHEY_SIMPLEX, 0.5, 7
    (width, height), _ = cv2.getTextSize(text, font, size, 1)
    right, bottom = left + width + 2 * margin, height + 2 * margin
    cv2.rectangle(canvas, (left, 0), (right, bottom), _INK, -1)
    cv2.putText(canvas, text, (left + margin, bottom - margin), font, size, _WHITE, 1, cv2.LINE_AA)


def _fixed(point: NDArray[np.float64]) -> tuple[int, int]:
    x, y = np.rint(point * 2**_SUBPIXEL).astype(int).tolist()
    return x, y
