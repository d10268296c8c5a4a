"""Extracts the features of a frame from its images: stereo, RGB-D or monocular, in any light."""

from __future__ import annotations

from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from vslam.camera import DepthImage, Image, ImageMap
from vslam.features import Extracted, Features, Keypoints, Pyramid, Side
from vslam.frontend.depth import columns_of_depth
from vslam.frontend.orb import Extraction, build_pyramid, with_keypoints
from vslam.frontend.pose_alignment import coarse_levels
from vslam.frontend.side_delay import row_offsets
from vslam.frontend.sides import Sides, balanced, compare_sides
from vslam.frontend.stereo import match_stereo
from vslam.frontend.tracking import TrackingContext
from vslam.frontend.weak_images import extract_in_any_light


class FrameImages:
    """The images of one moment. Their features are extracted when they are first asked for: a frame
    that is tracked by patches needs none.

    Attributes:
        left: ``(H, W)`` uint8.
        pyramid: of the left image; None if frames are not tracked by patches.
        coarse: ``coarse_levels`` of that pyramid, or None.
    """

    def __init__(
        self,
        left: Image,
        second: Image | DepthImage | None,
        context: TrackingContext,
        image_map: ImageMap = map,
        sides: Sides | None = None,
    ) -> None:
        """For the arguments see ``extract_features``."""
        self.left = left
        self.pyramid: Pyramid | None = None
        self.coarse: Pyramid | None = None
        self._second = second
        self._extract = partial(extract_features, left, second, context, image_map, sides)
        if context.tracks_patches:
            self.pyramid = build_pyramid(left, context.config.orb)
            self.coarse = coarse_levels(self.pyramid)

    @cached_property
    def extracted(self) -> Extracted:
        """The features."""
        return self._extract()

    def extracted_with(self, keypoints: Keypoints) -> Extracted:
        """The features, and others at given positions of the left image."""
        return self._extract(keypoints=keypoints)

    @property
    def image(self) -> Image:
        """``(H, W)`` uint8 that the features are extracted from."""
        if self.extracted.side == Side.LEFT:
            return self.left
        return np.array(self._second, np.uint8)  # a copy: the right image is the caller's


def extract_features(
    left: NDArray[np.uint8],
    second: NDArray[np.uint8] | NDArray[np.float32] | None,
    context: TrackingContext,
    image_map: ImageMap = map,
    sides: Sides | None = None,
    keypoints: Keypoints | None = None,
) -> Extracted:
    """ORB features of the left image with their columns in the right image. If the left image is
    black, the features are extracted from the right image and have no columns in the other one.

    A pure function: the result does not depend on ``image_map``.

    Args:
        left: ``(H, W)`` uint8.
        second: ``(H, W)``: the right image, uint8; for an RGB-D camera the depth in metres,
            float32; None for a single image, whose features have no column in a right image.
        image_map: applies a function to both images, in turn or in parallel.
        sides: the result of ``compare_sides``; None computes it.
        keypoints: positions at which the left image gets features, too (``with_keypoints``).
    """
    camera, config = context.camera, context.config
    if second is None:
        return _extract_alone(left, context, Side.LEFT, keypoints)
    if camera.depth:
        (found,) = extract_in_any_light([left], config)
        scale, depth = context.scales[found.octave], np.asarray(second, np.float32)
        u_right = columns_of_depth(found.xy, scale, depth, camera, config.depth)
        # No pyramid, so the frame is not aligned: depth cameras have a rolling shutter, which
        # moves points by more than alignment corrects.
        return Extracted(_features(found, u_right))
    right_image = np.asarray(second, np.uint8)
    sides = sides or compare_sides(left, right_image, config.stereo)
    if sides.black == "left":
        return _extract_alone(right_image, context, Side.RIGHT)
    pair = balanced(left, right_image, config.stereo, sides)
    found, right = extract_in_any_light(pair, config, image_map)
    if keypoints is not None:
        found = with_keypoints(found, *keypoints)
    u_right = match_stereo(found, right, camera, config.stereo)
    rows = row_offsets(found, right, u_right, config.stereo)
    return Extracted(_features(found, u_right), found.pyramid, rows)


def _extract_alone(
    image: Image, context: TrackingContext, side: Side, keypoints: Keypoints | None = None
) -> Extracted:
    """Features of a single image, without columns in a second one."""
    (found,) = extract_in_any_light([image], context.config)
    if keypoints is not None:
        found = with_keypoints(found, *keypoints)
    u_right = np.full(len(found.xy), np.nan, np.float32)
    return Extracted(_features(found, u_right), found.pyramid, side=side)


def _features(found: Extraction, u_right: NDArray[np.float32]) -> Features:
    return Features(found.xy, found.octave, found.angle, found.descriptors, u_right)
