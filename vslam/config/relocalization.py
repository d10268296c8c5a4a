"""Thresholds of relocalisation: finding a lost camera in the map."""

from __future__ import annotations

from pydantic import Field

from vslam.config.section import Section


class RelocalizationConfig(Section):
    """Relocalisation of a lost camera [OS1, V-C]."""

    match_distance: int = Field(50, ge=0, le=256)
    """Upper bound of the descriptor distance of a match, in bits. [OS1 V-C, customary]"""
    match_ratio: float = Field(0.75, gt=0, le=1)
    """Upper bound of the ratio of the best to the second-best distance. [OS1 V-C, customary]"""
    min_matches: int = Field(15, ge=4)
    """Number of landmarks that must match by descriptor. [OS1 V-C, customary]"""
    max_draws: int = Field(600, ge=1)
    """Upper bound of the number of RANSAC draws. [OS1 V-C, own]"""
    confidence: float = Field(0.99, gt=0, lt=1)
    """Probability with which RANSAC shall draw at least one sample without outliers.
    [OS1 V-C, customary]"""
    min_consensus: int = Field(10, ge=4)
    """Number of inliers that RANSAC must find. [OS1 V-C, customary]"""
    first_window: float = Field(8.0, gt=0)
    """Search radius of the first guided search, in pixels at octave 0. [OS1 V-C, own]"""
    min_inliers: int = Field(50, ge=6)
    """A frame counts as found if it has at least this many inliers. [OS1 V-C, customary]"""
    min_elsewhere: int = Field(15, ge=0)
    """Number of inliers that must lie outside the third of the image with the most inliers.
    [own]"""
    max_candidates: int = Field(5, ge=1)
    """Upper bound of the number of places that are tried for a lost frame. [own]"""
    doubtful_gap: float = Field(1.5, gt=1)
    """A frame comes after a gap if the time since the last tracked frame is above this multiple of
    the usual interval between frames. [own]"""
    doubtful_share: float = Field(0.5, ge=0, le=1)
    """A frame is in doubt if it tracks less than this share of the landmarks of the reference
    keyframe and also comes after a gap, could not be predicted, or tracks less than this share of
    what the previous frame tracked. It is then searched for in the whole map. [own]"""
    better: float = Field(1.5, ge=1)
    """A frame in doubt is moved to the place where it was found if it has more than this many times
    as many inliers there. [own]"""
    neighbours: int = Field(20, ge=1)
    """Number of keyframes around the place whose landmarks are searched for. [own]"""
