"""Thresholds of feature extraction and of the treatment of weak images."""

from __future__ import annotations

from pydantic import Field

from vslam.config.section import Section


class OrbConfig(Section):
    """ORB extraction."""

    n_features: int = Field(2000, ge=100)
    """Number of features extracted from each image. [OS1 V-A, printed]"""
    n_levels: int = Field(8, ge=2, le=16)
    """Number of levels of the image pyramid. [OS1 V-A, printed]"""
    scale_factor: float = Field(1.2, gt=1.0, le=2.0)
    """Scale factor from one pyramid level to the next. [OS1 V-A, printed]"""
    fast_threshold: int = Field(12, ge=1, le=255)
    """FAST threshold, in grey levels. [OS1 V-A, customary]"""
    fast_threshold_min: int = Field(7, ge=1, le=255)
    """FAST threshold in cells where `fast_threshold` finds no corner, in grey levels.
    [OS1 V-A, customary]"""
    cell_size: int = Field(35, ge=16)
    """Side of the square cells in which the FAST threshold adapts, in pixels.
    [OS1 V-A, customary]"""


class WeakImageConfig(Section):
    """Images with much noise or little contrast (docs/research/stress.md)."""

    noise_from: float = Field(5.0, ge=0)
    """Images are blurred if the standard deviation of their noise is at least this, in grey levels.
    Undisturbed images have at most 2.5. [own]"""
    noise_left: float = Field(4.0, gt=0)
    """Standard deviation of the noise that this blur is meant to leave, in grey levels. [own]"""
    max_blur: float = Field(3.5, gt=0)
    """Upper bound of the standard deviation of the blur, in pixels. [own]"""
    spikes_from: float = Field(0.04, ge=0, le=1)
    """A median filter is applied if more than this share of the pixels stand out from both
    neighbours. [own]"""
    few_features: float = Field(0.5, ge=0, le=1)
    """Contrast is measured only in images that yield fewer features than this share of
    `orb.n_features`. [own]"""
    low_contrast: float = Field(6.0, ge=0)
    """Contrast is raised if it is below this, in grey levels; 0 never raises it. The contrast of an
    image is the median, over its blocks of 16 x 16 pixels, of the standard deviation of their grey
    values. [own]"""
    least_detail: float = Field(0.25, ge=0)
    """An image is out of focus, and its contrast is not raised, if its mean absolute second
    difference is below this share of its contrast. Sharp images have 0.4 and more. [own]"""
    raised_contrast: float = Field(12.0, gt=0)
    """Standard deviation that contrast is raised to, in grey levels. KITTI's images have it on a
    bright day. [own]"""
    contrast_window: int = Field(33, ge=3)
    """Side of the window in which contrast is raised, in pixels. [own]"""
    flat_share: float = Field(0.25, gt=0, le=1)
    """Bounds the gain in flat parts of the image: their contrast counts as at least this share of
    the median over the image. [own]"""
    least_contrast: float = Field(0.15, gt=0)
    """The contrast of flat parts also counts as at least this, in grey levels, which is what
    rounding alone causes. [own]"""
