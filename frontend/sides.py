"""Compares the exposure of both images of a stereo pair, and balances them where they differ.

Stereo matching compares patches by the sum of absolute differences of their grey values. If one
image is darker by one stop, disparities are biased; at two stops they are useless, although no
frame is lost. Both cameras look at the same scene, so the gain between them follows from the
quantiles of all grey values.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import log2
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vslam.config import StereoConfig

Grey = NDArray[np.uint8]

_STRIDE = 8  # a few thousand pixels suffice to know quantiles to a grey level
_LOW, _HIGH = 0.05, 0.95
_WITHIN = 0.98  # upper quantile as a fraction of the share of pixels that are not overexposed
_LEAST_SHARE = 0.25  # least share of the pixels from which a gain is estimated
_LEAST_RANGE = 4.0  # grey levels; over a smaller range, rounding dominates the gain
_QUANTILES = 11  # compared between the two images
# The largest distance between the quantiles of the two images, as a fraction of their range: under
# a gain at most 0.07 for 95 % of the images of KITTI, at least 0.22 if only one image shows a sky.
_MOST_BENT = 0.12
_SEES = 16.0  # least range of the grey values of an image that is not black


@dataclass(frozen=True)
class Sides:
    """The difference in exposure between the two images of a pair.

    Attributes:
        darker_stops: by how many stops the right image is darker than the left one; 0 if they
            differ by less than the threshold, or if no gain explains the difference.
        black: the side that is black while the other is not; empty if there is none.
    """

    darker_stops: float = 0.0
    black: Literal["", "left", "right"] = ""


@dataclass
class ComparedSides:
    """What the comparisons of a drive showed.

    Attributes:
        n: number of comparisons.
        n_black_left, n_black_right: in how many of them one side was black.
        darker_stops: ``Sides.darker_stops`` where it was not 0.
    """

    n: int = 0
    n_black_left: int = 0
    n_black_right: int = 0
    darker_stops: list[float] = field(default_factory=list)

    def add(self, sides: Sides) -> None:
        """Add a comparison."""
        self.n += 1
        self.n_black_left += sides.black == "left"
        self.n_black_right += sides.black == "right"
        if sides.darker_stops:
            self.darker_stops.append(sides.darker_stops)

    def numbers(self) -> tuple[float, ...]:
        """The state as stored in a map file; ``of_numbers`` is the inverse."""
        return (self.n, self.n_black_left, self.n_black_right, *self.darker_stops)

    @classmethod
    def of_numbers(cls, numbers: tuple[float, ...]) -> ComparedSides:
        """The state that ``numbers`` returned.

        Raises:
            ValueError: ``numbers`` is too short.
        """
        n, left, right, *darker = numbers
        return cls(int(n), int(left), int(right), darker)


def compare_sides(left: Grey, right: Grey, config: StereoConfig) -> Sides:
    """Compare the exposure of both ``(H, W)`` uint8 images of a rectified pair."""
    ours, theirs = _shares(left), _shares(right)
    if _is_black(ours, theirs, config):
        return Sides(black="left")
    if _is_black(theirs, ours, config):
        return Sides(black="right")
    return Sides(_stops(ours, theirs, config))


def balanced(left: Grey, right: Grey, sides: Sides) -> tuple[Grey, Grey]:
    """Both images; if they differ by a gain, according to ``compare_sides``, the darker one is
    brightened."""
    stops = sides.darker_stops
    if stops > 0:
        return left, _brightened(right, left, stops)
    if stops < 0:
        return _brightened(left, right, -stops), right
    return left, right


def _shares(image: Grey) -> NDArray[np.float64]:
    """``(256,)`` cumulative histogram: share of the pixels that are at most as bright."""
    counts = np.bincount(image[::_STRIDE, ::_STRIDE].ravel(), minlength=256)
    return np.cumsum(counts) / counts.sum()


def _quantiles(shares: NDArray[np.float64], *at: float) -> list[float]:
    # Pixels of one grey value are taken to be spread evenly over it, so that quantiles vary
    # smoothly even if only few grey values occur.
    values: list[float] = np.interp(at, shares, np.arange(256) + 0.5).tolist()
    return values


def _is_black(side: NDArray[np.float64], other: NDArray[np.float64], config: StereoConfig) -> bool:
    low, high = _quantiles(side, _LOW, _HIGH)
    other_low, other_high = _quantiles(other, _LOW, _HIGH)
    if high >= config.black_below:
        return False
    return other_high - other_low > max(_SEES, 10.0 * (high - low))


def _stops(ours: NDArray[np.float64], theirs: NDArray[np.float64], config: StereoConfig) -> float:
    """Binary logarithm of the gain from ``theirs`` to ``ours``; 0 if it is below the threshold, or
    if dark and bright pixels do not agree on a gain. Both images are compared below an upper
    quantile that excludes the pixels that are overexposed in either of them."""
    below = config.clipped_from - 1
    top, dull = _HIGH, float(min(ours[below], theirs[below]))
    if dull <= top:
        top = _WITHIN * dull
    if top < _LOW + _LEAST_SHARE:
        return 0.0
    (a_low, a_high), (b_low, b_high) = (
        np.diff(_quantiles(shares, _LOW, (_LOW + top) / 2, top)).tolist()
        for shares in (ours, theirs)
    )
    least = min(a_low, b_low, a_high, b_high)
    if min(a_low + a_high, b_low + b_high) < _LEAST_RANGE or least <= 0:
        return 0.0
    gain = log2((a_low + a_high) / (b_low + b_high))
    if abs(gain) <= config.balance_from:
        return 0.0
    if least >= _LEAST_RANGE:  # over a smaller range, the halves differ by rounding
        low, high = log2(a_low / b_low), log2(a_high / b_high)
        # A few more bright pixels in one image stretch only its upper half, which is no gain.
        if min(low * np.sign(gain), high * np.sign(gain)) <= config.balance_from:
            return 0.0
        if abs(low - high) > config.max_gain_disagreement:
            return 0.0
    return gain if _proportional(ours, theirs, top) else 0.0


def _proportional(ours: NDArray[np.float64], theirs: NDArray[np.float64], top: float) -> bool:
    """Whether the quantiles up to ``top`` are proportional, as a gain makes them. If one image
    shows what the other does not, such as the sky beside a bridge, they are not."""
    at = np.linspace(_LOW, top, _QUANTILES)
    a, b = (np.array(_quantiles(shares, *at)) for shares in (ours, theirs))
    a, b = a - a[0], b - b[0]
    return bool(np.abs(a / a[-1] - b / b[-1]).max() <= _MOST_BENT)


def _brightened(dark: Grey, bright: Grey, stops: float) -> Grey:
    """The dark image, multiplied by ``2 ** stops`` and shifted so that its lower quantile is that
    of the bright image."""
    (low,), (target,) = _quantiles(_shares(dark), _LOW), _quantiles(_shares(bright), _LOW)
    table = (np.arange(256) + 0.5 - low) * 2.0**stops + target - 0.5
    return np.clip(np.rint(table), 0, 255).astype(np.uint8)[dark]
