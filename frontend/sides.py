"""Whether both sides of a stereo rig see the same light, and what to do where they do not.

Patches of both images are compared grey value by grey value (SAD): a side that is a stop darker
moves disparities, one that is two stops darker ruins them, without a frame being lost. The gain
between the sides is that of the quantiles of all grey values: both look at the same scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log2
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vslam.config import StereoConfig

Grey = NDArray[np.uint8]

_STRIDE = 8  # a few thousand pixels tell quantiles to a grey level
_LOW, _HIGH = 0.05, 0.95
_WITHIN = 0.98  # of their share, so that no quantile lies on its edge
_LEAST_SHARE = 0.25  # of the pixels, for a gain to be told by
_LEAST_RANGE = 4.0  # grey levels: below that a quantile's rounding is the gain
_SEES = 16.0  # least range of the grey values of a side that shows something


@dataclass(frozen=True)
class Sides:
    """What sets the sides apart.

    Attributes:
        darker_stops: by how much the right side is darker than the left; 0 where they differ by
            less than the threshold, or not by a gain.
        black: the side that shows nothing while the other one does.
    """

    darker_stops: float = 0.0
    black: Literal["", "left", "right"] = ""


def compare_sides(left: Grey, right: Grey, config: StereoConfig) -> Sides:
    """Compare the light of both ``(H, W)`` images of a rectified pair."""
    ours, theirs = _shares(left), _shares(right)
    if _is_black(ours, theirs, config):
        return Sides(black="left")
    if _is_black(theirs, ours, config):
        return Sides(black="right")
    return Sides(_stops(ours, theirs, config))


def balanced(
    left: Grey, right: Grey, config: StereoConfig, sides: Sides | None = None
) -> tuple[Grey, Grey]:
    """Both images, the darker one brightened where a gain sets them apart; else as they are.

    Args:
        sides: what ``compare_sides`` says of them, if that is known.
    """
    stops = (sides or compare_sides(left, right, config)).darker_stops
    if stops > 0:
        return left, _brightened(right, left, stops)
    if stops < 0:
        return _brightened(left, right, -stops), right
    return left, right


def _shares(image: Grey) -> NDArray[np.float64]:
    """``(256,)`` share of the pixels that are at most as bright."""
    counts = np.bincount(image[::_STRIDE, ::_STRIDE].ravel(), minlength=256)
    return np.cumsum(counts) / counts.sum()


def _quantiles(shares: NDArray[np.float64], *at: float) -> list[float]:
    # Within a grey value pixels are spread evenly: quantiles of few grey values stay smooth.
    values: list[float] = np.interp(at, shares, np.arange(256) + 0.5).tolist()
    return values


def _is_black(side: NDArray[np.float64], other: NDArray[np.float64], config: StereoConfig) -> bool:
    low, high = _quantiles(side, _LOW, _HIGH)
    other_low, other_high = _quantiles(other, _LOW, _HIGH)
    if high >= config.black_below:
        return False
    return other_high - other_low > max(_SEES, 10.0 * (high - low))


def _stops(ours: NDArray[np.float64], theirs: NDArray[np.float64], config: StereoConfig) -> float:
    """Logarithm of the gain from theirs to ours, 0 where it is below the threshold or no gain
    explains dark and bright pixels alike. Pixels that are overexposed on
    either side are left out of both."""
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
    if least >= _LEAST_RANGE:  # below, halves differ by rounding
        low, high = log2(a_low / b_low), log2(a_high / b_high)
        # A few bright pixels more on one side stretch its upper half alone: that is no gain.
        if min(low * np.sign(gain), high * np.sign(gain)) <= config.balance_from:
            return 0.0
        if abs(low - high) > config.max_gain_disagreement:
            return 0.0
    return gain


def _brightened(dark: Grey, bright: Grey, stops: float) -> Grey:
    """Multiplied so, and shifted to the lower quantile of the bright side."""
    (low,), (target,) = _quantiles(_shares(dark), _LOW), _quantiles(_shares(bright), _LOW)
    table = (np.arange(256) + 0.5 - low) * 2.0**stops + target - 0.5
    return np.clip(np.rint(table), 0, 255).astype(np.uint8)[dark]
