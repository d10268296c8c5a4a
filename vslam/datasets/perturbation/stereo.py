"""Perturbations that faults of a stereo rig cause. They affect only one camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.perturbation.depth import disparity
from vslam.datasets.perturbation.kinds import (
    LawKind,
    Pair,
    PairLaw,
    RandomStream,
    Scene,
    to_8_bits,
)
from vslam.datasets.perturbation.motion import neighbours, optical_flow
from vslam.types.camera import Image


def _changing_only_right(change: Callable[[Pair, Image], Image]) -> PairLaw:
    def law(pair: Pair) -> Pair:
        right = pair.right
        return pair if right is None else replace(pair, second=change(pair, right))

    return law


def _gain(stops: float, stream: RandomStream, scene: Scene) -> PairLaw:
    gain = 2.0**-stops
    return _changing_only_right(lambda pair, right: to_8_bits(gain * right.astype(np.float32)))


def _desync(ms: float, stream: RandomStream, scene: Scene) -> PairLaw:
    """Delay the right image by moving its pixels along the optical flow to the next frame."""
    assert scene.times is not None
    assert scene.read is not None
    times, read = scene.times, scene.read

    def later(pair: Pair, right: Image) -> Image:
        previous, following = neighbours(scene, pair.index)
        other = following if following > pair.index else previous
        image = read(other)[1]
        if ms == 0 or other == pair.index or image is None:
            return right
        flow = optical_flow(np.asarray(pair.clean[1], np.uint8), np.asarray(image, np.uint8))
        share = 1e-3 * ms / float(times[other] - times[pair.index])
        return _moved(right, np.float32(share) * flow)

    return _changing_only_right(later)


def _baseline(percent: float, stream: RandomStream, scene: Scene) -> PairLaw:
    def longer(pair: Pair, right: Image) -> Image:
        left, clean = pair.clean[0], np.asarray(pair.clean[1], np.uint8)
        d = disparity(scene.camera, clean, left, mirrored=True)
        shift = np.stack([-np.float32(percent / 100.0) * d, np.zeros_like(d)], axis=2)
        return _moved(right, shift)

    return _changing_only_right(longer)


def _moved(image: Image, shift: NDArray[np.float32]) -> Image:
    """Move the pixels of an image by the ``(H, W, 2)`` displacements ``shift`` in pixels."""
    import cv2

    y, x = np.mgrid[0 : image.shape[0], 0 : image.shape[1]].astype(np.float32)
    moved = cv2.remap(
        image, x - shift[:, :, 0], y - shift[:, :, 1], cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return np.asarray(moved, np.uint8)


def _turned(axis: int) -> Callable[[float, RandomStream, Scene], PairLaw]:
    """Make a perturbation that turns the right camera about its x axis (0) or y axis (1)."""

    def make(arc_minutes: float, stream: RandomStream, scene: Scene) -> PairLaw:
        from scipy.spatial.transform import Rotation

        camera = scene.camera
        K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        R = Rotation.from_rotvec(np.eye(3)[axis] * np.radians(arc_minutes / 60.0)).as_matrix()
        H = K @ R.T @ np.linalg.inv(K)  # R turns the camera, so R.T turns the points

        def turn(pair: Pair, right: Image) -> Image:
            import cv2

            size = (camera.width, camera.height)
            turned = cv2.warpPerspective(right, H, size, borderMode=cv2.BORDER_REPLICATE)
            return np.asarray(turned, np.uint8)

        return _changing_only_right(turn)

    return make


def _black_in_some_seconds(
    side: Literal["left", "right"],
) -> Callable[[float, RandomStream, Scene], PairLaw]:
    def make(percent: float, stream: RandomStream, scene: Scene) -> PairLaw:
        def law(pair: Pair) -> Pair:
            dark = np.random.default_rng([*stream, int(pair.t)]).uniform() < percent / 100.0
            if not dark or pair.right is None:
                return pair
            if side == "left":
                return replace(pair, left=np.zeros_like(pair.left))
            return replace(pair, second=np.zeros_like(pair.right))

        return law

    return make


def _fault(
    make: Callable[[float, RandomStream, Scene], PairLaw],
    unit: str,
    default: float,
    strongest: float,
    about: str,
    *,
    drawn: bool = False,
    neighbours: bool = False,
    weakest: float = 0.0,
) -> LawKind:
    return LawKind(
        make, unit, default, weakest, strongest, about, least=0.0 if drawn else -strongest,
        most=strongest, drawn=drawn, of_scene=True, sides="one", logarithmic=weakest > 0,
        needs=("right", "neighbours") if neighbours else ("right",),
    )  # fmt: skip


KINDS = {
    "stereo_gain": _fault(_gain, "stops", 1.0, 8.0, "the right image is darker"),
    "desync": _fault(
        _desync, "ms", 20.0, 200.0, "the right image is late", neighbours=True, weakest=0.5
    ),
    "baseline": _fault(
        _baseline, "%", 2.0, 50.0, "the baseline is longer than calibrated", weakest=0.05
    ),
    "yaw": _fault(
        _turned(1), "arc minutes", 5.0, 300.0, "the right camera is turned right", weakest=0.1
    ),
    "pitch": _fault(
        _turned(0), "arc minutes", 5.0, 300.0, "the right camera is turned up", weakest=0.1
    ),
    "black_right": _fault(
        _black_in_some_seconds("right"),
        "%",
        30.0,
        100.0,
        "seconds in which the right image is black",
        drawn=True,
    ),
    "black_left": _fault(
        _black_in_some_seconds("left"),
        "%",
        10.0,
        100.0,
        "seconds in which the left image is black",
        drawn=True,
    ),
}
