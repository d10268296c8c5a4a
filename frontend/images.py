"""The images of a frame, as tracking sees them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from vslam.frontend.masks import Mask
from vslam.types.camera import Image
from vslam.types.features import Extracted, Keypoints, Pyramid


class Images(Protocol):
    """The images of a frame, whose features are extracted when they are first needed.

    Attributes:
        pyramid: the pyramid of the left image. None if frames are not tracked by patches.
        coarse: the small images of the frame (``coarse_levels``). None if ``pyramid`` is None.
        mask: the mask of the left image. None if all pixels are used.
    """

    pyramid: Pyramid | None
    coarse: Pyramid | None
    mask: Mask | None

    @property
    def extracted(self) -> Extracted:
        """The features of the frame."""
        ...

    def extracted_with(self, keypoints: Keypoints) -> Extracted:
        """Return the features of the frame, and additional features at the given positions and
        pyramid levels of the left image."""
        ...

    @property
    def image(self) -> Image | None:
        """The ``(H, W)`` uint8 left image for loop detectors. None if it is not available."""
        ...


@dataclass
class GivenFeatures:
    """The images of a frame whose features were extracted in advance (``Images``)."""

    extracted: Extracted
    image: Image | None = None
    pyramid: Pyramid | None = None
    coarse: Pyramid | None = None
    mask: Mask | None = None

    def extracted_with(self, keypoints: Keypoints) -> Extracted:
        return self.extracted
