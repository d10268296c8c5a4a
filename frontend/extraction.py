"""Extracts the features of a stereo, RGB-D or monocular frame, also from dark or noisy images."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.frontend.depth import columns_of_depth
from vslam.frontend.masks import Mask
from vslam.frontend.orb import Extraction, build_pyramid, extract_at
from vslam.frontend.pose_alignment import coarse_levels
from vslam.frontend.sides import balanced, compare_sides
from vslam.frontend.stereo import StereoMatches, inliers_only, match_stereo
from vslam.frontend.weak_images import extract_in_any_light
from vslam.support.errors import UnreadableImageError
from vslam.support.workers import Job, Urgency, Workers
from vslam.types.camera import DepthImage, Image, ImageMap, check_images, check_mask
from vslam.types.context import Context
from vslam.types.features import Extracted, Features, Keypoints, Pyramid, Sides


class Corners(NamedTuple):
    """The features that a corner detector found in the images of a frame, and their stereo matches.

    Attributes:
        found: the features of the left image.
        matches: the stereo matches of ``found``; None if there is no right image.
        depth: ``(H, W)`` float32 depth image of an RGB-D camera, metres; None for other cameras.
        sides: result of comparing the exposure of the left and the right image; None without a
            right image.
        problem: why the second image could not be read, so that only the left image is used; None
            if there was no such problem.
    """

    found: Extraction
    matches: StereoMatches | None = None
    depth: DepthImage | None = None
    sides: Sides | None = None
    problem: str | None = None


class FrameImages:
    """The images of a frame, and their features. The second image (right image or depth image) is
    read, and the features are extracted, only when they are first needed. A frame that is tracked
    by patches needs neither.

    Attributes:
        left: ``(H, W)`` uint8.
        mask: the mask of the left image; None if all pixels are used.
        pyramid: the pyramid of the left image; None if frames are not tracked by patches.
        coarse: ``coarse_levels`` of ``pyramid``; None if ``pyramid`` is None.
    """

    def __init__(
        self,
        left: Image,
        read_second: Callable[[], Image | DepthImage | None],
        context: Context,
        image_map: ImageMap = map,
        mask: Mask | None = None,
    ) -> None:
        """Args:
        read_second: function that returns the right image or the depth image, or None if there
            is no second image. It raises UnreadableImageError if the image cannot be read.
        image_map: applies a function to both images, sequentially or in parallel."""
        self.left = left
        self.mask = mask
        self.pyramid: Pyramid | None = None
        self.coarse: Pyramid | None = None
        self._read_second = read_second
        self._context = context
        self._image_map = image_map
        self._started: Job[Corners] | None = None
        if context.tracks_patches:
            self.pyramid = build_pyramid(left, context.config.orb)
            self.coarse = coarse_levels(self.pyramid)

    def start_corners(self, workers: Workers) -> None:
        """Start computing ``corners`` in another thread, before the corners are needed."""
        if self._started is None:
            in_parallel = partial(workers.map, urgency=Urgency.CORNERS)
            find = partial(self._find_corners, in_parallel)
            self._started = workers.submit(find, Urgency.CORNERS)

    @cached_property
    def corners(self) -> Corners:
        """The features that a corner detector finds, and their stereo matches. The first access
        reads the second image (right image or depth image)."""
        started = self._started
        return self._find_corners(self._image_map) if started is None else started.result()

    @cached_property
    def extracted(self) -> Extracted:
        """The features of the frame, with their columns in the right image."""
        return matched(self.corners, self._context)

    def extracted_with(self, keypoints: Keypoints) -> Extracted:
        """Return the features of the frame, and additional features at the given positions and
        pyramid levels of the left image."""
        return matched(self.corners, self._context, keypoints)

    @cached_property
    def image(self) -> Image:
        """The ``(H, W)`` uint8 image that the features are extracted from, for place recognition.
        Masked pixels are filled (``Mask.filled``)."""
        return self.left if self.mask is None else self.mask.filled(self.left)

    def _find_corners(self, image_map: ImageMap) -> Corners:
        second, problem = None, None
        try:
            second = self._read_second()
        except UnreadableImageError as error:
            problem = str(error)
        found = find_corners(self.left, second, self._context, image_map, self.mask, self.pyramid)
        return found._replace(problem=problem)


def checked_images(
    left: Image,
    second: Image | DepthImage | None,
    mask: NDArray[np.uint8] | NDArray[np.bool_] | None,
    context: Context,
) -> FrameImages:
    """Copy the left image of a frame. The second image is not copied.

    Args:
        left, second, mask: see ``Slam.step``.

    Raises:
        ValueError: the images or the mask have the wrong size or type.
    """
    check_images(left, second, context.camera)
    of_left = None
    if mask is not None:
        check_mask(mask, context.camera)
        of_left = Mask.of(mask, context.config.orb)
    return FrameImages(np.array(left), lambda: second, context, mask=of_left)


def find_corners(
    left: Image,
    second: Image | DepthImage | None,
    context: Context,
    image_map: ImageMap = map,
    mask: Mask | None = None,
    pyramid: Pyramid | None = None,
) -> Corners:
    """Extract the features of each image and match them (the first step of extraction).

    Args:
        left: ``(H, W)`` uint8.
        second: ``(H, W)`` uint8 right image, or float32 depth image of an RGB-D camera in metres;
            None if there is only the left image.
        mask: the mask of the image whose features are tracked. Stereo matching needs no mask of the
            right image, because masked pixels of the left image have no features to match.
        pyramid: the pyramid of the left image, if it has already been built.
    """
    camera, config = context.camera, context.config
    allowed = None if mask is None else mask.levels
    if second is None:
        (found,) = extract_in_any_light([left], config, allowed=allowed, pyramid=pyramid)
        return Corners(found)
    if camera.depth:
        (found,) = extract_in_any_light([left], config, allowed=allowed, pyramid=pyramid)
        return Corners(found, depth=np.asarray(second, np.float32))
    right_image = np.asarray(second, np.uint8)
    sides = compare_sides(left, right_image, config.stereo)
    pair = balanced(left, right_image, sides)
    built = pyramid if pair[0] is left else None  # it may have been brightened
    found, right = extract_in_any_light(pair, config, image_map, allowed, built)
    return Corners(found, match_stereo(found, right, camera), sides=sides)


def matched(corners: Corners, context: Context, keypoints: Keypoints | None = None) -> Extracted:
    """Add features at given positions, and compute the columns of all features in the right image
    (the second step of extraction). There are no features if only the left image is black, because
    what seems to be a corner of a black image is noise.

    Args:
        keypoints: positions in the left image at which features are added (``extract_at``); None
            adds no features.
    """
    camera, config = context.camera, context.config
    found, matches, depth, sides, problem = corners
    if sides is not None and sides.black == "left":
        return Extracted(Features.none(), sides=sides)
    if keypoints is not None:
        more = extract_at(found, *keypoints)
        found, order = found.joined(more)
        if matches is not None:
            added = match_stereo(more, matches.right, camera)
            matches = matches.joined(added, order)
    if depth is not None:
        scale = context.scales[found.octave]
        u_right = columns_of_depth(found.xy, scale, depth, camera, config.depth)
        return Extracted(_features(found, u_right), found.pyramid, problem=problem)
    if matches is None:
        u_right = np.full(len(found.xy), np.nan, np.float32)
        return Extracted(_features(found, u_right), found.pyramid, problem=problem)
    u_right = inliers_only(matches, found.octave)
    return Extracted(_features(found, u_right), found.pyramid, sides=sides, problem=problem)


def _features(found: Extraction, u_right: NDArray[np.float32]) -> Features:
    return Features(found.xy, found.octave, found.angle, found.descriptors, u_right)
