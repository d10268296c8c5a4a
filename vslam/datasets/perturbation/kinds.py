"""The types of perturbations. vslam calls a kind of perturbation a law.

Some laws change one image at a time. Others need both images of a frame, or the scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.frames import Source
from vslam.support.errors import InputError
from vslam.types.camera import Camera, DepthImage, Image
from vslam.types.geometry import Matrix
from vslam.types.imu import ImuNoise

RandomStream = tuple[int, int]
"""The user's seed, and a number for the law. All seeds of the law begin with these two numbers."""

Law = Callable[[int, float, int, Image], Image]
"""A function ``(frame, t, side, image) -> image``, which returns an image of the same shape.

t is the time in seconds since the first frame. side is 0 for the left and 1 for the right image.
"""


@dataclass(frozen=True)
class Pair:
    """The images of one frame, which are passed from one perturbation to the next.

    Attributes:
        index: index of the frame.
        t: seconds since the first frame.
        left: left image, ``(H, W)`` uint8.
        second: right image, ``(H, W)`` uint8. For RGB-D, it is the depth image, ``(H, W)`` float32
            metres. None for a monocular source.
        clean: both images before any perturbation.
    """

    index: int
    t: float
    left: Image
    second: Image | DepthImage | None
    clean: tuple[Image, Image | DepthImage | None]

    @property
    def right(self) -> Image | None:
        """The right image; None if the source has none."""
        if self.second is None or self.second.dtype != np.uint8:
            return None
        return np.asarray(self.second, np.uint8)


PairLaw = Callable[[Pair], Pair]

ImuLaw = Callable[[Matrix, ImuNoise], Matrix]
"""A function ``(samples, noise) -> samples`` of all ``(N, 7)`` samples of an IMU, N > 1, and of the
densities of its noise."""


@dataclass(frozen=True)
class Scene:
    """Data of a source that a perturbation may use, in addition to the images of a frame.

    Attributes:
        camera: calibration of the source.
        times: ``(N,)`` seconds since the first frame; None if the source cannot seek.
        T_wc: ``(N, 4, 4)`` true camera poses, NaN where unknown; None if there are none.
        read: function that reads the images of the frame with a given index. None if the source
            cannot seek.
        imu: whether there are recorded samples of an IMU.
    """

    camera: Camera
    times: NDArray[np.float64] | None = None
    T_wc: NDArray[np.float64] | None = None
    read: Callable[[int], tuple[Image, Image | DepthImage | None]] | None = None
    imu: bool = False

    @classmethod
    def of(cls, source: Source) -> Scene:
        imu = source.imu is not None and not source.imu.live
        if not source.seekable:
            return cls(source.camera, imu=imu)
        times = source.timestamps
        return cls(source.camera, times - times[:1], source.ground_truth, source.read, imu)


Need = Literal["right", "depth", "neighbours", "imu"]
_UNMET: dict[Need, str] = {
    "right": "needs stereo images, but this source has no right image",
    "depth": "needs stereo or depth images, but this source has one camera",
    "neighbours": "needs the next frame, which a video, bag or camera cannot provide; use a data "
    "set or a folder of images",
    "imu": "needs the recorded samples of an IMU, which this source does not have",
}


def check_need(law: str, need: Need, scene: Scene) -> None:
    """Check that a source has the data that the perturbation ``law`` needs.

    Raises:
        InputError: the source does not have this data.
    """
    has = {
        "right": scene.camera.sensor == "stereo",
        "depth": not scene.camera.monocular,
        "neighbours": scene.read is not None,
        "imu": scene.imu,
    }
    if not has[need]:
        raise InputError(f"--perturb {law}: {_UNMET[need]}.")


@dataclass(frozen=True)
class SceneLaw:
    """A perturbation that needs data of the source. `bound_to` must be called before use."""

    name: str
    needs: tuple[Need, ...]
    make: Callable[[Scene], PairLaw]

    def bound_to(self, scene: Scene) -> PairLaw:
        """Return the perturbation for the source whose data ``scene`` contains.

        Raises:
            InputError: the source does not have the data that the perturbation needs.
        """
        for need in self.needs:
            check_need(self.name, need, scene)
        return self.make(scene)

    def __call__(self, pair: Pair) -> Pair:
        raise RuntimeError(f"{self.name} has no scene: call Perturbation.bound_to(source) first")


@dataclass(frozen=True)
class LawKind:
    """A kind of perturbation, from which a perturbation of any strength and seed can be made.

    Attributes:
        make: function that makes the perturbation: ``(strength, stream) -> Law``. If ``of_scene``
            is set, it is ``(strength, stream, scene) -> PairLaw``. If ``of_imu`` is set, it is
            ``(strength, stream) -> ImuLaw``.
        unit: unit of the strength.
        default: strength that is used if none is given.
        weakest: weakest strength that ``vslam stress`` tries.
        strongest: strongest strength that ``vslam stress`` tries. If small numbers have a large
            effect, as for the visibility in fog, ``strongest`` is smaller than ``weakest``.
        about: a description in a few words.
        least: smallest allowed strength.
        most: largest allowed strength.
        logarithmic: whether ``vslam stress`` compares strengths by their ratio instead of their
            difference.
        drawn: whether the effect is random, so that the images depend on the seed.
        needs: data that the source must have.
        of_scene: whether the perturbation needs data of the source, in addition to the images of a
            frame.
        sides: ``both`` if both images are changed, ``one`` for a fault of the stereo rig.
        of_imu: whether the perturbation changes the samples of the IMU instead of the images.
    """

    make: Callable[..., Law | PairLaw | ImuLaw]
    unit: str
    default: float
    weakest: float
    strongest: float
    about: str
    least: float = 0.0
    most: float = 10.0
    logarithmic: bool = False
    drawn: bool = True
    needs: tuple[Need, ...] = ()
    of_scene: bool = False
    sides: Literal["both", "one"] = "both"
    of_imu: bool = False

    def law(self, name: str, strength: float, stream: RandomStream) -> PairLaw | SceneLaw:
        if not self.of_scene:
            return EachSide(self.make(strength, stream))  # type: ignore[arg-type]
        return SceneLaw(name, self.needs, partial(self.make, strength, stream))  # type: ignore[arg-type]


@dataclass(frozen=True)
class EachSide:
    """Applies one perturbation to the left and the right image of a frame. Depth is not changed."""

    law: Law

    def __call__(self, pair: Pair) -> Pair:
        left = self.law(pair.index, pair.t, 0, pair.left)
        if pair.right is None:
            return replace(pair, left=left)
        return replace(pair, left=left, second=self.law(pair.index, pair.t, 1, pair.right))


def to_8_bits(values: NDArray[Any]) -> Image:
    """Round and clip values to uint8."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
