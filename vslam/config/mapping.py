"""Thresholds of local mapping and bundle adjustment."""

from __future__ import annotations

from pydantic import Field

from vslam.config.section import Section


class MappingConfig(Section):
    """Local mapping and bundle adjustment."""

    neighbours: int = Field(10, ge=1)
    """Number of covisible keyframes that a new keyframe is triangulated with.
    [OS1 VI-C, customary]"""
    fuse_neighbours: int = Field(10, ge=1)
    """Number of covisible keyframes whose landmarks are fused with those of a new keyframe.
    [OS1 VI-C, customary]"""
    monocular_neighbours: int = Field(20, ge=1)
    """Replaces `neighbours` for a monocular camera. [OS1 VI-C, customary]"""
    min_baseline_ratio: float = Field(0.01, ge=0)
    """With a monocular camera, two keyframes are triangulated only if the distance between them is
    at least this share of the median depth. [OS1 VI-C, customary]"""
    min_parallax_cosine: float = Field(0.9998, gt=0, le=1)
    """Upper bound of the cosine of the parallax of a triangulated point. [OS1 VI-C, customary]"""
    epipolar_distance: int = Field(50, ge=0, le=256)
    """Upper bound of the descriptor distance when features are matched for triangulation, in bits.
    [OS1 VI-C, customary]"""
    fuse_distance: int = Field(50, ge=0, le=256)
    """Upper bound of the descriptor distance when landmarks are fused, in bits.
    [OS1 VI-C, customary]"""
    fuse_window: float = Field(3.0, gt=0)
    """Search radius when landmarks are fused, in pixels at octave 0. [OS1 VI-C, customary]"""
    min_stereo_points: int = Field(100, ge=0)
    """If fewer stereo features of a keyframe than this are close, this many of the nearest are
    mapped. [OS2 III-E, printed]"""
    min_found_ratio: float = Field(0.25, ge=0, le=1)
    """A recent landmark is culled if it is found in less than this share of the frames that should
    see it. [OS1 VI-B, printed]"""
    redundant_ratio: float = Field(0.9, gt=0, le=1)
    """A keyframe is culled if more than this share of its landmarks is redundant, that is, seen by
    three other keyframes as well. [OS1 VI-E, printed]"""
    min_shared: int = Field(15, ge=1)
    """Two keyframes are joined by a covisibility edge if they share at least this many landmarks.
    [OS1 III-D, printed]"""
    max_ba_keyframes: int = Field(60, ge=2)
    """Upper bound of the number of free keyframes in local bundle adjustment. [OS1 VI-D, own]"""
    ba_iterations: int = Field(10, ge=1)
    """Upper bound of the number of iterations of local bundle adjustment. The first pass, before
    the outliers are removed, has half as many. [OS1 VI-D, customary]"""
