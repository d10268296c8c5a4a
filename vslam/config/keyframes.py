"""Thresholds that decide which frames become keyframes."""

from __future__ import annotations

from pydantic import Field

from vslam.config.section import Section


class KeyframeConfig(Section):
    """Keyframe decision [OS2, III-E]."""

    max_interval_s: float = Field(1.0, gt=0)
    """Longest time without a keyframe, in seconds. [OS1 V-E, customary]"""
    depth_max_interval_s: float = Field(0.3, gt=0)
    """Replaces `max_interval_s` for an RGB-D camera, which is usually hand-held, in seconds.
    [own]"""
    min_tracked_close: int = Field(100, ge=0)
    """A keyframe is inserted if fewer close points than this are tracked and more than
    `min_new_close` are not. [OS2 III-E, printed]"""
    min_new_close: int = Field(70, ge=0)
    """Such a keyframe is inserted only if more close points than this are not tracked.
    [OS2 III-E, printed]"""
    min_kept_close: float = Field(0.2, ge=0, le=1)
    """Where a keyframe adds fewer close points than `min_tracked_close` on average, this share of
    that average replaces `min_tracked_close` (docs/research/motorway.md). [own]"""
    first_gain: float = Field(2.0, ge=0)
    """Number of close points that a keyframe is assumed to add before this has been observed, as a
    multiple of `min_tracked_close`. [own]"""
    gain_weight: float = Field(0.2, gt=0, le=1)
    """Weight of the latest keyframe in the running mean of the number of close points that a
    keyframe adds. [own]"""
    patch_kept_close: float = Field(0.3, ge=0, le=1)
    """A keyframe is also inserted if patches find less than this share of the close points that
    were tracked in the first frame after the last keyframe. [own]"""
    patch_lead_frames: int = Field(2, ge=0)
    """A keyframe that was tracked by patches is planned this many frames ahead, so that its
    features can be extracted meanwhile. [own]"""
    max_tracked_ratio: float = Field(0.75, gt=0, le=1)
    """A keyframe is inserted if the frame tracks less than this share of the points of the
    reference keyframe. [OS1 V-E, customary]"""
    urgent_ratio: float = Field(0.25, gt=0, le=1)
    """If the tracked share is below this, a keyframe is inserted even while local mapping is busy.
    [OS1 V-E, customary]"""
    monocular_ratio: float = Field(0.9, gt=0, le=1)
    """Replaces `max_tracked_ratio` for a monocular camera. [OS1 V-E, printed]"""
    monocular_min_tracked: int = Field(100, ge=0)
    """With a monocular camera, a keyframe is also inserted while local mapping is busy if fewer
    points than this are tracked. [own]"""
    monocular_urgent_ratio: float = Field(0.5, gt=0, le=1)
    """Replaces `urgent_ratio` for a monocular camera. [own]"""
    known_after_s: float = Field(30.0, gt=0)
    """A place can be known only if a keyframe of it is at least this old, in seconds. [own]"""
    known_ratio: float = Field(0.5, gt=0)
    """A place is known if the frame tracks at least this share of the points of an old keyframe.
    [own]"""
    known_min_inliers: int = Field(50, ge=0)
    """The place of a frame can be known only if the frame tracks at least this many landmarks.
    [own]"""
    merge_after_frames: int = Field(2, ge=1)
    """The result of the local mapping of a keyframe is merged this many frames later. [own]"""
