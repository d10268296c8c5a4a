"""Sequences of images as the cameras took them, rectified on the way in."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Several
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.models import Calibration
from vslam.calibration.rectification import Rectification, rectify
from vslam.camera import Camera, ImageMap
from vslam.datasets.depth_images import with_depth
from vslam.datasets.sequence import DepthImage, Image, Sequence
from vslam.errors import InputError


class RawSequence(Protocol):
    """A `Sequence` without its camera: the images need not be rectified.

    Attributes:
        ground_truth: ``(N, 4, 4)`` float64 ``T_wc`` of the left camera as it is, or None.
    """

    @property
    def dataset(self) -> str: ...
    @property
    def name(self) -> str: ...
    @property
    def timestamps(self) -> NDArray[np.float64]: ...
    @property
    def ground_truth(self) -> NDArray[np.float64] | None: ...

    def __len__(self) -> int: ...

    def read(
        self, index: int, image_map: ImageMap = map
    ) -> tuple[Image, Image | DepthImage | None]:
        """As `Sequence.read`, all images of one side of one size."""
        ...


@dataclass(frozen=True)
class RectifiedSequence:
    """See `rectified`."""

    raw: RawSequence
    rectification: Rectification  # its camera is that of the depth, too

    @property
    def dataset(self) -> str:
        return self.raw.dataset

    @property
    def name(self) -> str:
        return self.raw.name

    @property
    def camera(self) -> Camera:
        return self.rectification.camera

    @property
    def timestamps(self) -> NDArray[np.float64]:
        return self.raw.timestamps

    @property
    def ground_truth(self) -> NDArray[np.float64] | None:
        """Of the rectified left camera, which is turned but not moved."""
        if self.raw.ground_truth is None:
            return None
        T_wc = self.raw.ground_truth.copy()
        T_wc[:, :3, :3] = T_wc[:, :3, :3] @ self.rectification.R_left_rectified
        return T_wc

    def __len__(self) -> int:
        return len(self.raw)

    def read(
        self, index: int, image_map: ImageMap = map
    ) -> tuple[Image, Image | DepthImage | None]:
        """Rectified left and second image; see `Sequence.read`."""
        return rectify_images(self.rectification, *self.raw.read(index, image_map), image_map)


def rectified(raw: RawSequence, calibration: Calibration, *, depth: bool = False) -> Sequence:
    """A sequence whose images are rectified as they are read, the maps computed once.

    Where the images are rectified already they are handed on as they are.

    Args:
        depth: the second images are the depth of the first ones' pixels.

    Raises:
        InputError: the images are not of the calibrated size, there is no calibration of the
            right one, or as `vslam.calibration.rectification.rectify`.
        UnreadableImageError: the first frame cannot be read.
    """
    sizes = [(image.shape[1], image.shape[0]) for image in raw.read(0) if image is not None]
    return RectifiedSequence(raw, rectification_for(calibration, sizes, depth=depth))


def rectification_for(
    calibration: Calibration, sizes: Several[tuple[int, int]], *, depth: bool = False
) -> Rectification:
    """The rectification of images of one camera or two, by width and height of each one's.

    Args:
        depth: see `rectified`; depth has its pixels where the left image has them.

    Raises:
        InputError: see `rectified`.
    """
    if depth:
        alone = rectification_for(calibration, sizes[:1])
        return replace(alone, camera=with_depth(alone.camera, calibration))
    if len(sizes) == 1 and calibration.right is not None:
        calibration = calibration.left_alone()
    if len(sizes) == 2 and calibration.right is None:
        raise InputError(
            f"{calibration.source}: the calibration of the right camera is missing; give that of "
            "both, or run on the left camera alone with --sensor mono."
        )
    models = [model for model in (calibration.left, calibration.right) if model is not None]
    for model, (width, height) in zip(models, sizes, strict=True):
        if (model.width, model.height) != (width, height):
            fix = "take the calibration of these images"
            if (2 * model.width, model.height) == (width, height):
                fix = "say --side-by-side if each holds both of a stereo pair"
            raise InputError(
                f"{calibration.source}: made for {model.width}x{model.height} pixels but the "
                f"images have {width}x{height}; {fix}."
            )
    return rectify(calibration)


def rectify_images(
    rectification: Rectification,
    left: Image,
    second: Image | DepthImage | None,
    image_map: ImageMap = map,
) -> tuple[Image, Image | DepthImage | None]:
    """Both images rectified, or the left one where there is no second one; depth by
    the nearest pixel."""
    left_side: Callable[[], Image | DepthImage] = partial(rectification.left, left)
    if second is None:
        return np.asarray(left_side(), np.uint8), None
    second_side: Callable[[], Image | DepthImage]
    if rectification.camera.depth:
        second_side = partial(rectification.left_depth, second)
    else:
        second_side = partial(rectification.right, np.asarray(second, np.uint8))
    first, other = image_map(_call, [left_side, second_side])
    return np.asarray(first, np.uint8), other


def _call(function: Callable[[], Image | DepthImage]) -> Image | DepthImage:
    return function()
