"""Conditions of a comparison of loop detectors.

A *condition* is a change that is applied to the query images, such as a change in lighting. The
gallery images are not changed.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.perturbation import parse_perturbation
from vslam.support.errors import InputError, did_you_mean
from vslam_lab.sources.image_source import turn_homography

Image = NDArray[np.uint8]

KINDS = ("none", "light", "clipping", "viewpoint", "occlusion", "noise", "blur", "change", "all")
# For each condition, the perturbations of `vslam run --perturb` of which it consists. Their
# strengths are those at strength 1 of the condition.
_LAWS = {
    "light": {"brightness": 2.0, "gamma": 2.0},
    "occlusion": {"occlusion": 2.0},
    "noise": {"noise": 2.5},
    "blur": {"blur": 2.0},
}
_LAWS["all"] = {law: s / 2 for kind in _LAWS.values() for law, s in kind.items()}
_OTHER_LANE, _TURN = 3.2, 30.0  # metres and degrees of a change of viewpoint at strength 1
_CLIPPED = 0.6  # share of the pixels that become white, or black, at strength 1
# Time between images. The light changes within 2 s, so that the changes are independent.
_APART_S = 10.0


@dataclass(frozen=True)
class Condition:
    """A type of change that is applied to the query images, and its strength from 0 to 1."""

    kind: str
    strength: float = 0.0

    @property
    def name(self) -> str:
        """Name of the condition, for example ``none`` or ``viewpoint:0.5``."""
        return self.kind if self.kind == "none" else f"{self.kind}:{self.strength:g}"

    @property
    def view(self) -> float:
        """Strength of the change in viewpoint, from 0 to 1."""
        return {"viewpoint": self.strength, "all": self.strength / 2}.get(self.kind, 0.0)

    @property
    def lateral(self) -> tuple[float, float]:
        """Range of the camera's lateral offset in metres, positive to the right.

        Without a change in viewpoint, there is a small offset, because no two drives follow exactly
        the same line.
        """
        side = -_OTHER_LANE * self.view
        return (side, side) if self.view else (-0.3, 0.3)

    @property
    def heading(self) -> tuple[float, float]:
        """Range of the camera's rotation to either side in degrees."""
        turn = _TURN * self.view
        return (turn, turn) if self.view else (0.0, 3.0)

    @property
    def change(self) -> float:
        """Value of ``vslam synth --change`` with which the town is rendered."""
        strength = {"change": self.strength, "all": self.strength / 2}.get(self.kind)
        return 0.0 if strength is None else round(0.1 + 0.8 * strength, 3)


def parse_conditions(kinds: str, strengths: str) -> list[Condition]:
    """List the conditions under which loop detectors are compared.

    The first condition is ``none`` (unchanged images). It is followed by each type of change at
    each strength.

    Args:
        kinds: types of change, as names from ``KINDS`` that are separated by commas.
        strengths: numbers above 0 and up to 1, separated by commas.

    Raises:
        InputError: a type of change is unknown, or a strength is out of range.
    """
    names = [name.strip() for name in kinds.split(",") if name.strip()]
    if wrong := [name for name in names if name not in KINDS]:
        raise InputError(
            f"--perturb {wrong[0]}: unknown{did_you_mean(wrong[0], KINDS)}; choose from "
            f"{', '.join(KINDS)}."
        )
    try:
        levels = [float(text) for text in strengths.split(",") if text.strip()]
    except ValueError as error:
        raise InputError(f"--strengths {strengths}: give numbers separated by commas.") from error
    if not levels or not all(0.0 < level <= 1.0 for level in levels):
        raise InputError(f"--strengths {strengths}: must be above 0 and at most 1.")
    chosen = [Condition(name, level) for name in names if name != "none" for level in levels]
    return [Condition("none"), *dict.fromkeys(chosen)]


def apply(
    condition: Condition, images: Collection[Image], seed: int, *, rendered: bool
) -> list[Image]:
    """Apply the change of a condition to images. The random values differ between the images.

    Args:
        condition: type and strength of the change. The type ``change`` has no effect here, because
            it is applied when the town is rendered.
        images: ``(H, W)`` uint8 images.
        rendered: whether the images were already rendered with the change in viewpoint.
    """
    out = list(images)
    if condition.view and not rendered:
        out = [turned(image, _sign(seed, k) * condition.heading[0]) for k, image in enumerate(out)]
    if condition.kind == "clipping":
        out = [clipped(image, _CLIPPED * condition.strength, _sign(seed, k) > 0)
               for k, image in enumerate(out)]  # fmt: skip
    laws = _LAWS.get(condition.kind)
    if laws:
        spec = ",".join(
            f"{law}:{strength * condition.strength:g}" for law, strength in laws.items()
        )
        law = parse_perturbation(spec, seed)
        out = [law.apply(k, _APART_S * k, image, None)[0] for k, image in enumerate(out)]
    return out


def turned(image: Image, degrees: float) -> Image:
    """Warp an image as if the camera had been rotated to the right about its centre.

    Pixels that the original image does not show become black.
    """
    import cv2

    height, width = image.shape
    H = turn_homography(width, height, degrees)
    return np.asarray(cv2.warpPerspective(image, H, (width, height)), np.uint8)


def clipped(image: Image, share: float, bright: bool) -> Image:
    """Change the exposure so that a given share of the pixels becomes white, or else black."""
    grey = np.arange(256.0)
    if bright:
        white = max(float(np.quantile(image, 1.0 - share)), 1.0)
        curve = grey * (255.0 / white)
    else:
        black = min(float(np.quantile(image, share)), 254.0)
        curve = grey - black
    return np.clip(np.rint(curve), 0, 255).astype(np.uint8)[image]


def _sign(seed: int, k: int) -> float:
    return float(np.random.default_rng([seed, 30, k]).choice([-1.0, 1.0]))
