"""Thresholds of frame-to-map tracking and of the alignment of its matches."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from vslam.config.section import Section


class TrackingConfig(Section):
    """Frame-to-map tracking."""

    method: Literal["auto", "orb", "patches"] = "auto"
    """How frames are tracked: `orb` matches ORB features in every frame; `patches` looks for image
    patches of the landmarks, and extracts features only where a keyframe is due or patches fail
    (Forster et al., T-RO 2017); `auto` takes `patches` for stereo cameras and `orb` for the others.
    RGB-D cameras are never tracked by patches. [own]"""
    patch_min_inliers: int = Field(40, ge=10)
    """Features are extracted for a frame in which fewer patches than this are found. [own]"""
    patch_min_inlier_ratio: float = Field(0.5, ge=0, le=1)
    """Features are extracted for a frame of whose patches a smaller share than this agrees on a
    pose. [own]"""
    match_distance: int = Field(100, ge=0, le=256)
    """Upper bound of the descriptor distance when landmarks are matched near their projections, in
    bits. [OS1 V-D, customary]"""
    match_ratio: float = Field(0.8, gt=0, le=1)
    """Upper bound of the ratio of the best to the second-best distance when the local map is
    matched. [OS1 V-D, customary]"""
    reference_distance: int = Field(50, ge=0, le=256)
    """Upper bound of the descriptor distance when a frame is matched with the reference keyframe,
    in bits. [OS1 V-B, customary]"""
    reference_ratio: float = Field(0.7, gt=0, le=1)
    """Upper bound of the ratio of the best to the second-best distance when a frame is matched with
    the reference keyframe. [OS1 V-B, customary]"""
    motion_window: float = Field(7.0, gt=0)
    """Search radius when the points of the previous frame are matched, in pixels at octave 0.
    [OS1 V-B, customary]"""
    local_window: float = Field(2.5, gt=0)
    """Search radius when the local map is matched, in pixels at octave 0. [OS1 V-D, customary]"""
    depth_motion_window: float = Field(15.0, gt=0)
    """Replaces `motion_window` for an RGB-D camera, in pixels at octave 0. [OS1 V-B, customary]"""
    depth_local_window: float = Field(5.0, gt=0)
    """Replaces `local_window` for an RGB-D camera, in pixels at octave 0. ORB-SLAM2 uses 7.5.
    [OS1 V-D, own]"""
    predicted_window: float = Field(7.0, gt=0)
    """Replaces `local_window` for a frame in which neither the previous frame nor the reference
    keyframe is recognised, in pixels at octave 0. [own]"""
    local_keyframes: int = Field(80, ge=1)
    """Upper bound of the number of keyframes in the local map. [OS1 V-D, customary]"""
    min_stereo_start: int = Field(100, ge=10)
    """Number of stereo features that a frame needs to start a map. [OS2 III-B, own]"""
    min_inliers_motion: int = Field(20, ge=3)
    """If tracking from the previous frame has fewer inliers than this, the reference keyframe is
    tried. [OS1 V-B, customary]"""
    min_inlier_ratio: float = Field(0.3, ge=0, le=1)
    """If tracking from the previous frame has a smaller share of inliers among its matches than
    this, the reference keyframe is tried. [own]"""
    min_inliers_frame: int = Field(10, ge=3)
    """The local map is not tried for a frame with fewer inliers than this. [OS1 V-B, customary]"""
    min_inliers: int = Field(30, ge=3)
    """A frame with fewer inliers than this in the local map is WEAK. [OS1 V-D, customary]"""
    min_inliers_lost: int = Field(15, ge=3)
    """A frame with fewer inliers than this in the local map is LOST. [own]"""
    depth_min_inlier_ratio: float = Field(0.2, ge=0, le=1)
    """A frame of an RGB-D camera is LOST if the share of inliers among its matches is below this.
    [own]"""
    lost_frames_before_restart: int = Field(3, ge=1)
    """Number of lost frames after which a stereo or RGB-D camera starts a sub-map at the predicted
    pose. [own]"""
    young_keyframes: int = Field(5, ge=0)
    """A map with at most this many keyframes is young; there a stereo or RGB-D camera starts a
    sub-map after a single lost frame. [own]"""
    monocular_lost_frames: int = Field(4, ge=1)
    """Number of lost frames after which a monocular camera starts a sub-map from two new views.
    [own]"""


class AlignmentConfig(Section):
    """Alignment of matches to sub-pixel accuracy (Forster et al., ICRA 2014, III-B)."""

    iterations: int = Field(7, ge=1)
    """Upper bound of the number of Gauss-Newton iterations. [own]"""
    max_shift: float = Field(2.0, gt=0, le=2.0)
    """Upper bound of the shift from the keypoint, in x and in y, in pixels of its octave. [own]"""
    min_correlation: float = Field(0.85, gt=0, le=1)
    """Lower bound of the normalised cross-correlation of an aligned patch with the image. [own]"""
    certainty: int = Field(4, ge=1, le=255)
    """Ratio of the variance of a keypoint's position to that of an aligned match. [own]"""
    keyframes: int = Field(5, ge=1)
    """Patches are kept for this many of the newest keyframes. [own]"""
