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
_LOW, _MIDDLE, _HIGH = 0.05, 0.5, 0.95
_CLIPPED = 250.0  # where the upper quantile is white, the lower half tells the gain
_LEAST_RANGE = 4.0  # grey levels: below that a quantile's rounding is the gain
_LEAST_HALF = 2.0  # of a dark side beside one that reaches white
_BLACK, _SEES = 6.0, 16.0  # upper quantile of a black side, range of grey values of one that sees


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
    ours, theirs = _quantiles(left), _quantiles(right)
    if _is_black(ours, theirs):
        return Sides(black="left")
    if _is_black(theirs, ours):
        return Sides(black="right")
    stops = _stops(ours, theirs, config.max_gain_disagreement)
    return Sides(stops if abs(stops) > config.balance_from else 0.0)


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


def _quantiles(image: Grey) -> tuple[float, float, float]:
    counts = np.bincount(image[::_STRIDE, ::_STRIDE].ravel(), minlength=256)
    share = np.cumsum(counts) / counts.sum()
    # Within a grey value pixels are spread evenly: quantiles of few grey values stay smooth.
    low, middle, high = np.interp((_LOW, _MIDDLE, _HIGH), share, np.arange(256) + 0.5)
    return float(low), float(middle), float(high)


def _is_black(side: tuple[float, float, float], other: tuple[float, float, float]) -> bool:
    return side[2] < _BLACK and other[2] - other[0] > max(_SEES, 10.0 * (side[2] - side[0]))


def _stops(
    ours: tuple[float, float, float], theirs: tuple[float, float, float], tolerance: float
) -> float:
    """Logarithm of the gain from theirs to ours, 0 where no gain explains both halves."""
    halves = [(q[1] - q[0], q[2] - q[1]) for q in (ours, theirs)]
    if max(ours[2], theirs[2]) >= _CLIPPED:
        (a, _), (b, _) = halves
        return log2(a / b) if min(a, b) > _LEAST_HALF else 0.0
    (a_low, a_high), (b_low, b_high) = halves
    least = min(a_low, b_low, a_high, b_high)
    if min(a_low + a_high, b_low + b_high) < _LEAST_RANGE or least <= 0:
        return 0.0
    disagreement = abs(log2(a_low / b_low) - log2(a_high / b_high))
    if least >= _LEAST_RANGE and disagreement > tolerance:  # below, halves differ by rounding
        return 0.0
    return log2((a_low + a_high) / (b_low + b_high))


def _brightened(dark: Grey, bright: Grey, stops: float) -> Grey:
    """Multiplied so, and shifted to the lower quantile of the bright side."""
    low, target = _quantiles(dark)[0], _quantiles(bright)[0]
    table = (np.arange(256) + 0.5 - low) * 2.0**stops + target - 0.5
    return np.clip(np.rint(table), 0, 255).astype(np.uint8)[dark]
