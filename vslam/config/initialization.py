"""Thresholds of the first two keyframes of a monocular map."""

from __future__ import annotations

from pydantic import Field

from vslam.config.section import Section


class InitializationConfig(Section):
    """The first two keyframes of a monocular map [OS1, IV]."""

    min_features: int = Field(200, ge=20)
    """Number of features that a frame needs to become the first view. [own]"""
    window: float = Field(100.0, gt=0)
    """Search radius in the second view, in pixels. [OS1 IV, customary]"""
    match_distance: int = Field(50, ge=0, le=256)
    """Upper bound of the descriptor distance of a match, in bits. [OS1 IV, customary]"""
    match_ratio: float = Field(0.9, gt=0, le=1)
    """Upper bound of the ratio of the best to the second-best distance. [OS1 IV, customary]"""
    min_matches: int = Field(100, ge=8)
    """If the two views have fewer matches than this, another first view is taken.
    [OS1 IV, customary]"""
    draws: int = Field(300, ge=1)
    """Number of RANSAC draws for each of the two models. ORB-SLAM uses 200. [OS1 IV, own]"""
    homography_share: float = Field(0.45, gt=0, lt=1)
    """The homography is chosen if its share of the sum of both scores is above this; otherwise the
    fundamental matrix is. [OS1 IV, printed]"""
    max_error: float = Field(2.0, gt=0)
    """Upper bound of the reprojection error of an inlier, in pixels at octave 0.
    [OS1 IV, customary]"""
    min_parallax_deg: float = Field(1.0, gt=0)
    """Parallax that at least `min_points` points must have, in degrees. [OS1 IV, customary]"""
    min_points: int = Field(50, ge=8)
    """Number of triangulated points that must have that parallax. [OS1 IV, customary]"""
    min_point_share: float = Field(0.7, gt=0, le=1)
    """Share of the inliers of the model that must lie in front of both cameras. [OS1 IV, own]"""
    max_rival_share: float = Field(0.7, gt=0, le=1)
    """The motion is ambiguous, and refused, if the second-best motion explains more than this share
    of the points that the best one explains. [OS1 IV, customary]"""
    min_landmarks: int = Field(100, ge=8)
    """Number of landmarks that must remain after the first bundle adjustment.
    [OS1 IV, customary]"""
    median_depth: float = Field(15.0, gt=0)
    """Median depth that the first landmarks are scaled to, in map units. [own]"""
    max_rescaling: float = Field(10.0, gt=1)
    """Upper bound of the factor by which a sub-map is rescaled to keep the speed that the camera
    had before it was lost. [own]"""
    max_seconds: float = Field(1.5, gt=0)
    """Longest time between the two views, in seconds. [own]"""
