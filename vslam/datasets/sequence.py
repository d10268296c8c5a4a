"""What the pipeline needs of a data set: calibrated, timed stereo pairs, or the left eye alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vslam.camera import StereoCamera
from vslam.eyes import EachEye

Image = NDArray[np.uint8]


class Sequence(Protocol):
    """A rectified stereo sequence, or its left eye. Readers check everything but pixels before the
    first frame.

    Attributes:
        dataset: name of the data set, ``kitti`` for example.
        name: name of the sequence in it, ``00`` for example.
        camera: calibration of this sequence; ``camera.monocular`` where there is a left eye only.
        timestamps: ``(N,)`` float64 seconds, strictly increasing.
        ground_truth: ``(N, 4, 4)`` float64 ``T_wc`` or None.
    """

    @property
    def dataset(self) -> str: ...
    @property
    def name(self) -> str: ...
    @property
    def camera(self) -> StereoCamera: ...
    @property
    def timestamps(self) -> NDArray[np.float64]: ...
    @property
    def ground_truth(self) -> NDArray[np.float64] | None: ...

    def __len__(self) -> int: ...

    def read(self, index: int, each_eye: EachEye = map) -> tuple[Image, Image | None]:
        """Left and right image ``(H, W)`` uint8 of one frame, None for a monocular camera's right
        one. Safe to call from several threads.

        Args:
            index: of the frame.
            each_eye: how the images are decoded, both at once for example.

        Raises:
            UnreadableImageError: a file is damaged or of another size than the calibration.
        """
        ...


@dataclass(frozen=True)
class SequenceView:
    """Frames ``indices`` of another sequence: what --start, --every and --max-frames select."""

    base: Sequence
    indices: NDArray[np.int64]

    @property
    def dataset(self) -> str:
        return self.base.dataset

    @property
    def name(self) -> str:
        return self.base.name

    @property
    def camera(self) -> StereoCamera:
        return self.base.camera

    @property
    def timestamps(self) -> NDArray[np.float64]:
        return self.base.timestamps[self.indices]

    @property
    def ground_truth(self) -> NDArray[np.float64] | None:
        poses = self.base.ground_truth
        return None if poses is None else poses[self.indices]

    def __len__(self) -> int:
        return len(self.indices)

    def read(self, index: int, each_eye: EachEye = map) -> tuple[Image, Image | None]:
        return self.base.read(int(self.indices[index]), each_eye)
