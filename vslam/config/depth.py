"""Thresholds of depth, from stereo matching or from depth images."""

from __future__ import annotations

from pydantic import Field

from vslam.config.section import Section


class StereoConfig(Section):
    """Stereo matching [OS2, III-A]."""

    max_descriptor_distance: int = Field(75, ge=0, le=256)
    """Upper bound of the descriptor distance of a match, in bits. [OS2 III-A, customary]"""
    sad_window: int = Field(5, ge=1)
    """Half width of the patch that is compared by its sum of absolute differences, in pixels of the
    keypoint's octave. [OS2 III-A, customary]"""
    sad_search: int = Field(5, ge=1)
    """The patch is searched for up to this far to each side, in pixels of the keypoint's octave.
    [OS2 III-A, customary]"""
    balance_from: float = Field(0.3, ge=0)
    """The darker image is brightened if the gain between the two images is above this, in stops.
    [own]"""
    max_gain_disagreement: float = Field(0.75, gt=0)
    """A difference in brightness counts as a gain only if the gains of dark and of bright pixels
    differ by at most this, in stops. [own]"""
    clipped_from: int = Field(250, ge=1, le=255)
    """A pixel is overexposed, and ignored when the gain is measured, if its grey value is at least
    this. Video of limited range (16 to 235) needs about 230. [own]"""
    black_below: float = Field(6.0, gt=0, le=255)
    """An image is black, and not used, if its 95 % quantile is below this while the other image has
    contrast, in grey levels. Video of limited range (16 to 235) needs about 22. [own]"""
    close_depth_baselines: float = Field(40.0, gt=0)
    """A point is close if its depth is below this, in baselines. [OS2 III-A, printed]"""
    offset_sigma: float = Field(0.2, ge=0)
    """Prior standard deviation of the common offset of all disparities, which is estimated from the
    motion of the camera, in pixels; 0 disables the estimation (docs/research/motorway.md). [own]"""
    offset_keyframes: int = Field(12, ge=3)
    """The offset is measured again after this many keyframes. [own]"""
    least_delay: float = Field(1.2e-3, gt=0)
    """The report warns if the measured delay of the right camera differs from the calibration's by
    more than this, in seconds, and by more than `delay_sigmas` (docs/research/stress.md). [own]"""
    delay_sigmas: float = Field(5.0, gt=0)
    """That difference must also exceed this many standard deviations of the measured delay.
    [own]"""


class DepthConfig(Section):
    """Depth images [OS2, III-A]."""

    min_metres: float = Field(0.1, gt=0)
    """The depth of a pixel is unknown if it is below this, in metres. [own]"""
    max_metres: float = Field(100.0, gt=0)
    """The depth of a pixel is unknown if it is above this, in metres. [own]"""
    edge_radius: float = Field(4.0, ge=0)
    """A keypoint gets a depth only if the depths within this radius agree, in pixels at octave 0.
    It is one pixel more than the radius of FAST's circle. [own]"""
    edge_ratio: float = Field(0.07, gt=0)
    """A keypoint lies on a depth edge, and gets no depth, if the range of the depths around it is
    above this share of the nearest depth. [own]"""
