"""Follows corners through the images of one uncalibrated camera.

The result are *chains*: a few keyframes each, between which the image moves by similar amounts, and
the positions of corners in them. Corners are followed from image to image with the tracker of Lucas
and Kanade in pyramids (Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker",
2001) of OpenCV. Because they drift, each keyframe aligns them to the first keyframe of their chain
(`vslam.calibration.affine_patches`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.calibration.affine_patches import Patches
from vslam.calibration.models import Array
from vslam.types.camera import Image

KEYFRAMES = 6
"""Number of keyframes of a chain."""

LARGEST = 960  # px, longer side of the images in which corners are followed
_CORNERS = 400  # that are followed in an image
_FEWEST = 60  # corners of a chain
_LEFT = 0.75
_STEP = 0.04  # median motion of the corners between two keyframes, in longer sides of the image
_LONGEST = 150  # frames of a chain; the error of a followed corner grows with every frame
_BACK_PX = 0.5  # distance by which a corner may miss its place when it is followed back [own]
_WINDOW, _LEVELS = (21, 21), 4
_EMPTY = np.zeros((2, 2), np.uint8)


@dataclass(frozen=True)
class Chain:
    """Positions of N corners in the keyframes of a chain.

    Attributes:
        time: seconds of the first keyframe.
        xy: ``(KEYFRAMES, N, 2)`` float64 pixels of the full image; NaN where a corner is lost. All
            corners are seen in the first three keyframes.
        flow: ``(KEYFRAMES, N, 2)`` float64 motion in pixels since the frame before; for the first
            keyframe, the motion to the frame after it.
    """

    time: float
    xy: Array
    flow: Array


def chains_of(images: Iterable[tuple[float, Image]]) -> Iterator[Chain]:
    """Follow corners through images, and yield the chains that they form, one after the other.

    Args:
        images: time in seconds and ``(H, W)`` uint8 image of each frame. All have one size.
    """
    before: Image | None = None
    start = time = 0.0
    xy, kept, found = np.zeros((0, 2), np.float32), np.zeros(0, int), [np.zeros((0, 2))]
    flows: list[Array] = []
    patches, deformed = Patches.around(_EMPTY, xy), np.zeros((0, 2, 2))
    n = 0
    for time, full in images:
        image, scale = _smaller(full)
        if before is not None and len(xy):
            moved, good = _followed(before, image, xy)
            flow = (moved - xy)[good]
            xy, kept = moved[good], kept[good]
            n += 1
            last = found[-1][kept]
            if not flows:
                flows.append(_spread(flow, kept, found[0]))
            shift = np.median(np.linalg.norm(xy - last, axis=1)) / max(image.shape)
            left = len(xy) / np.count_nonzero(~np.isnan(found[-1][:, 0]))
            if len(xy) < _FEWEST or n > _LONGEST:
                xy = xy[:0]
            elif shift >= _STEP or (left < _LEFT and shift >= _STEP / 4):
                aligned, deformed[kept], good = patches.aligned(image, kept, xy, deformed[kept])
                xy, kept, flow = aligned[good].astype(np.float32), kept[good], flow[good]
                found.append(_spread(xy, kept, found[0]))
                flows.append(_spread(flow, kept, found[0]))
            if len(found) == KEYFRAMES:
                chain = np.array(found)
                seen = ~np.isnan(chain[:3, :, 0]).any(axis=0)
                flow = np.array(flows)[:, seen] / scale
                yield Chain(start, (chain[:, seen] + 0.5) / scale - 0.5, flow)
                xy = xy[:0]
        if not len(xy):
            xy = _corners(image)
            kept, found, start, n = np.arange(len(xy)), [xy.astype(float)], time, 0
            flows = []
            patches, deformed = Patches.around(image, xy), np.tile(np.eye(2), (len(xy), 1, 1))
        before = image


def _spread(values: NDArray[np.floating], rows: NDArray[np.int64], like: Array) -> Array:
    found = np.full_like(like, np.nan)
    found[rows] = values
    return found


def _smaller(image: Image) -> tuple[Image, float]:
    scale = min(1.0, LARGEST / max(image.shape))
    if scale == 1.0:
        return image, 1.0
    size = round(scale * image.shape[1]), round(scale * image.shape[0])
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8), scale


def _corners(image: Image) -> NDArray[np.float32]:
    """Return ``(N, 2)`` corners, which are spread over the image."""
    apart = np.sqrt(image.size / _CORNERS) / 2.0
    found = cv2.goodFeaturesToTrack(image, 2 * _CORNERS, 0.003, apart)
    return np.zeros((0, 2), np.float32) if found is None else np.asarray(found[:, 0], np.float32)


def _followed(
    before: Image, image: Image, xy: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Follow corners to the next image. Those that do not come back to their place are not good."""
    follow: Any = cv2.calcOpticalFlowPyrLK
    moved, there, _ = follow(before, image, xy, None, winSize=_WINDOW, maxLevel=_LEVELS)
    again, back, _ = follow(image, before, moved, None, winSize=_WINDOW, maxLevel=_LEVELS)
    good = (there.ravel() == 1) & (back.ravel() == 1)
    good &= np.linalg.norm(again - xy, axis=1) < _BACK_PX
    height, width = image.shape
    good &= (moved >= 0).all(axis=1) & (moved <= (width - 1, height - 1)).all(axis=1)
    return moved, good
