"""Compares the exposure of the two images of a stereo pair, and brightens the darker one.

Stereo matching compares patches by the sum of absolute differences of their grey values. If one
image is darker by one stop, disparities are biased. If it is darker by two stops, disparities are
useless, although no frame is lost. Both cameras look at the same scene. The gain between the images
can therefore be estimated from the quantiles of all grey values.
"""

from __future__ import annotations

from math import log2

import numpy as np
from numpy.typing import NDArray

from vslam.config import StereoConfig
from vslam.types.features import Sides
from vslam.types.states import ComparedSides

# The darker image of a stereo pair is brightened before stereo matching if the gain between the
# two images is above this value, in stops (factors of two). [own]
_BALANCE_FROM = 0.3
# A difference in brightness counts as a gain only if the gains of dark and of bright pixels
# differ by at most this value, in stops. [own]
_MAX_GAIN_DISAGREEMENT = 0.75

Grey = NDArray[np.uint8]

_STRIDE = 8  # a few thousand pixels determine the quantiles to within a grey level
_LOW, _HIGH = 0.05, 0.95  # quantiles between which the images are compared
_BELOW_CLIPPED = 0.98  # upper quantile, in multiples of the share of unclipped pixels
_MIN_SHARE = 0.25  # least share of the pixels that a gain is estimated from
_MIN_RANGE = 4.0  # grey levels; over a smaller range, rounding dominates the gain
_N_QUANTILES = 11  # number of quantiles that are compared between the two images
# Largest difference between the quantiles of the two images, each scaled to a range of 1. If the
# images differ by a gain, the difference is at most 0.07 for 95 % of the images of KITTI. If only
# one image shows the sky, the difference is at least 0.22.
_MAX_DEVIATION = 0.12
_MIN_VISIBLE_RANGE = 16.0  # least range of the grey values of an image that is not black


def with_pair(compared: ComparedSides, sides: Sides) -> ComparedSides:
    """Add a stereo pair to the summary of a drive."""
    darker = (sides.darker_stops,) if sides.darker_stops else ()
    return ComparedSides(
        compared.n + 1,
        compared.n_black_left + (sides.black == "left"),
        compared.n_black_right + (sides.black == "right"),
        compared.darker_stops + darker,
    )


def compare_sides(left: Grey, right: Grey, config: StereoConfig) -> Sides:
    """Compare the exposure of the two ``(H, W)`` uint8 images of a rectified pair."""
    shares_l, shares_r = _shares(left), _shares(right)
    if _is_black(shares_l, shares_r, config):
        return Sides(black="left")
    if _is_black(shares_r, shares_l, config):
        return Sides(black="right")
    return Sides(_stops(shares_l, shares_r, config))


def balanced(left: Grey, right: Grey, sides: Sides) -> tuple[Grey, Grey]:
    """Brighten the darker image of a stereo pair by the gain that ``compare_sides`` found. Returns
    the left and the right image."""
    stops = sides.darker_stops
    if stops > 0:
        return left, _brightened(right, left, stops)
    if stops < 0:
        return _brightened(left, right, -stops), right
    return left, right


def _shares(image: Grey) -> NDArray[np.float64]:
    """Compute the ``(256,)`` cumulative histogram of an image. Entry i is the fraction of the
    pixels whose grey value is at most i."""
    counts = np.bincount(image[::_STRIDE, ::_STRIDE].ravel(), minlength=256)
    return np.cumsum(counts) / counts.sum()


def _quantiles(shares: NDArray[np.float64], *at: float) -> list[float]:
    # Pixels with the same grey value are assumed to be spread evenly between this value and the
    # next one. Quantiles then vary smoothly even if the image has only a few grey values.
    values: list[float] = np.interp(at, shares, np.arange(256) + 0.5).tolist()
    return values


def _is_black(side: NDArray[np.float64], other: NDArray[np.float64], config: StereoConfig) -> bool:
    low, high = _quantiles(side, _LOW, _HIGH)
    other_low, other_high = _quantiles(other, _LOW, _HIGH)
    if high >= config.black_below:
        return False
    return other_high - other_low > max(_MIN_VISIBLE_RANGE, 10.0 * (high - low))


def _stops(left: NDArray[np.float64], right: NDArray[np.float64], config: StereoConfig) -> float:
    """Estimate the gain from the right to the left image, in stops, from their cumulative
    histograms.

    The result is 0 if the gain is below the threshold, or if dark and bright pixels have different
    gains. Quantiles that are overexposed in either image are not compared.
    """
    below = config.clipped_from - 1
    top, unclipped = _HIGH, float(min(left[below], right[below]))
    if unclipped <= top:
        top = _BELOW_CLIPPED * unclipped
    if top < _LOW + _MIN_SHARE:
        return 0.0
    (l_low, l_high), (r_low, r_high) = (
        np.diff(_quantiles(shares, _LOW, (_LOW + top) / 2, top)).tolist()
        for shares in (left, right)
    )
    least = min(l_low, r_low, l_high, r_high)
    if min(l_low + l_high, r_low + r_high) < _MIN_RANGE or least <= 0:
        return 0.0
    gain = log2((l_low + l_high) / (r_low + r_high))
    if abs(gain) <= _BALANCE_FROM:
        return 0.0
    if least >= _MIN_RANGE:  # over a smaller range, the gains of both halves differ by rounding
        low, high = log2(l_low / r_low), log2(l_high / r_high)
        # If one image has more bright pixels, only its upper half is stretched. This is not a gain.
        if min(low * np.sign(gain), high * np.sign(gain)) <= _BALANCE_FROM:
            return 0.0
        if abs(low - high) > _MAX_GAIN_DISAGREEMENT:
            return 0.0
    return gain if _proportional(left, right, top) else 0.0


def _proportional(left: NDArray[np.float64], right: NDArray[np.float64], top: float) -> bool:
    """Return whether the quantiles of both images up to ``top`` are proportional, as they are if
    the images differ only by a gain. They are not proportional if, for example, only one of the
    images shows the sky beside a bridge."""
    at = np.linspace(_LOW, top, _N_QUANTILES)
    a, b = (np.array(_quantiles(shares, *at)) for shares in (left, right))
    a, b = a - a[0], b - b[0]
    return bool(np.abs(a / a[-1] - b / b[-1]).max() <= _MAX_DEVIATION)


def _brightened(dark: Grey, bright: Grey, stops: float) -> Grey:
    """Multiply the grey values of the darker image by ``2 ** stops``, and shift them so that both
    images have the same lower quantile."""
    (low,), (target,) = _quantiles(_shares(dark), _LOW), _quantiles(_shares(bright), _LOW)
    table = (np.arange(256) + 0.5 - low) * 2.0**stops + target - 0.5
    return np.clip(np.rint(table), 0, 255).astype(np.uint8)[dark]
