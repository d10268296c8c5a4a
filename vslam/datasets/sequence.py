"""What the pipeline needs of a data set: calibrated, timed stereo pairs, images with their depth,
or left images alone."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, DepthImage, Image, ImageMap

__all__ = ["DepthImage", "Image", "Sequence"]


class Sequence(Protocol):
    """A rectified stereo sequence, its left images, or images with depth. Readers check everything
    but pixels before the first frame.

    Attributes:
        dataset: name of the data set, ``kitti`` for example.
        name: name of the sequence in it, ``00`` for example.
        camera: calibration of this sequence; ``camera.sensor`` tells what ``read`` gives.
        timestamps: ``(N,)`` float64 seconds, strictly increasing.
        ground_truth: ``(N, 4, 4)`` float64 ``T_wc``, NaN for frames without one, or None.
    """

    @property
    def dataset(self) -> str: ...
    @property
    def name(self) -> str: ...
    @property
    def camera(self) -> Camera: ...
    @property
    def timestamps(self) -> NDArray[np.float64]: ...
    @property
    def ground_truth(self) -> NDArray[np.float64] | None: ...

    def __len__(self) -> int: ...

    def read(
        self, index: int, image_map: ImageMap = map
    ) -> tuple[Image, Image | DepthImage | None]:
        """Left and second image of one frame. Safe to call from several threads.

        The left one is ``(H, W)`` uint8. The second one is the right image, alike; or the depth of
        the left one's pixels, ``(H, W)`` float32 metres, 0 where unknown; or None (monocular).

        Args:
            index: of the frame.
            image_map: how the images are decoded, both at once for example.

        Raises:
            UnreadableImageError: a file is damaged or of another size than the calibration.
        """
        ...
