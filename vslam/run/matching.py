"""Matches two images without assumptions about the poses of the cameras.

A run searches for stereo matches only in the same rows, but a check of the rectification must
search the whole image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.config import Config
from vslam.frontend.weak_images import is_faint, with_contrast
from vslam.types.camera import Image

_FEATURES = 2000
_CONFIG = Config.model_validate({"orb": {"n_features": _FEATURES}})
_MAX_DISTANCE = 64  # bits, of 256; TH_LOW of ORB-SLAM2 is 50
_EPIPOLAR_PX = 1.5
_REFINED_PX = 3.0  # largest refinement; keypoints of coarse octaves can be this inaccurate
_WINDOW = (15, 15)
_MIN_MATCHES = 12
_ANOTHER_VIEW = 0.25  # least median motion between two different views, relative to the image width


@dataclass(frozen=True)
class Matches:
    """Positions of the same N points in two images, accurate to about 0.1 px.

    Attributes:
        left, right: ``(N, 2)`` float32 positions in pixels.
    """

    left: NDArray[np.float32]
    right: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.left)


@dataclass(frozen=True)
class Described:
    """An ``(H, W)`` uint8 image with its ORB features.

    Attributes:
        xy: ``(N, 2)`` float32 positions in pixels.
        descriptors: ``(N, 32)`` uint8.
    """

    image: Image
    xy: NDArray[np.float32]
    descriptors: NDArray[np.uint8]


def describe(image: Image, n_features: int = _FEATURES) -> Described:
    """Extract at most ``n_features`` ORB features."""
    keypoints, descriptors = cv2.ORB.create(n_features).detectAndCompute(image, None)
    if descriptors is None:
        return Described(image, np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8))
    xy = np.array([keypoint.pt for keypoint in keypoints], np.float32)
    return Described(image, xy, np.asarray(descriptors, np.uint8))


def match_images(left: Image, right: Image) -> Matches:
    """Match two images as `match_described` does, with 2000 features each.

    The contrast of faint images is raised first, as in a run.
    """
    images = describe(left), describe(right)
    if is_faint((left, right), (len(images[0].xy), len(images[1].xy)), _CONFIG):
        clear = [with_contrast(image) for image in (left, right)]
        images = describe(clear[0]), describe(clear[1])
    return match_described(*images)


def match_described(left: Described, right: Described) -> Matches:
    """Find ORB matches that satisfy one epipolar geometry, and refine them using optical flow.

    If fewer than twelve matches are found, the result contains no matches.
    """
    none = Matches(np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32))
    if len(left.xy) < _MIN_MATCHES or len(right.xy) < _MIN_MATCHES:
        return none
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    found = matcher.match(left.descriptors, right.descriptors)
    found = [match for match in found if match.distance <= _MAX_DISTANCE]
    if len(found) < _MIN_MATCHES:
        return none
    a = left.xy[[match.queryIdx for match in found]]
    b = right.xy[[match.trainIdx for match in found]]
    refined, tracked, _ = cv2.calcOpticalFlowPyrLK(
        left.image, _with_contrast_of(right.image, left.image), a, b.copy(),
        winSize=_WINDOW, maxLevel=0, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    near = (tracked.ravel() == 1) & (np.linalg.norm(refined - b, axis=1) < _REFINED_PX)
    a, b = a[near], refined[near]
    if len(a) < _MIN_MATCHES:
        return none
    _, inliers = cv2.findFundamentalMat(a, b, cv2.FM_RANSAC, _EPIPOLAR_PX, 0.999)
    if inliers is None or inliers.sum() < _MIN_MATCHES:
        return none
    kept = inliers.ravel() == 1
    return Matches(a[kept], b[kept])


def count_views(images: Sequence[Image]) -> int:
    """Count the clearly different views in a sequence of images."""
    views: list[Image] = []
    for image in images:
        if not any(_same_view(image, view) for view in views):
            views.append(image)
    return len(views)


def _same_view(image: Image, other: Image) -> bool:
    matches = match_images(image, other)
    moved = np.linalg.norm(matches.left - matches.right, axis=1)
    return len(matches) > 0 and float(np.median(moved)) < _ANOTHER_VIEW * image.shape[1]


def joined(several: list[Matches]) -> Matches:
    """Join the matches of one or more image pairs."""
    return Matches(
        np.concatenate([matches.left for matches in several]),
        np.concatenate([matches.right for matches in several]),
    )


def _with_contrast_of(image: Image, model: Image) -> Image:
    """Give an image the mean and the contrast of ``model``, as optical flow assumes."""
    (mean, spread), (wanted, contrast) = (
        (float(mean[0, 0]), float(spread[0, 0]))
        for mean, spread in map(cv2.meanStdDev, (image, model))
    )
    gain = contrast / max(spread, 1.0)
    return np.asarray(cv2.addWeighted(image, gain, image, 0.0, wanted - gain * mean), np.uint8)
