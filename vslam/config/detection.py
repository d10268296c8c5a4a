"""Thresholds of the loop detectors, which propose candidates."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from vslam.config.section import Section


class BowConfig(Section):
    """Loop candidates by bag of words [OS1, III-E and VII-A]."""

    min_shared: int = Field(15, ge=1)
    """Two keyframes are neighbours if they share at least this many landmarks.
    [OS1 III-D, printed]"""
    exclude_recent: int = Field(20, ge=1)
    """This many of the newest keyframes, the query among them, are never candidates. [own]"""
    common_words_ratio: float = Field(0.8, ge=0, le=1)
    """The number of words that a candidate shares with the query must be at least this fraction of
    the largest such number of any keyframe. [OS1 III-E, customary]"""
    group_size: int = Field(10, ge=0)
    """This many of the best covisible keyframes of a candidate may join its group.
    [OS1 III-E, customary]"""
    group_score_ratio: float = Field(0.75, ge=0, le=1)
    """A group is kept if its score is at least this share of the best group's.
    [OS1 III-E, printed]"""
    max_groups: int = Field(30, ge=1)
    """Upper bound of the number of groups, which are formed around the best keyframes first.
    [own]"""


class SiameseConfig(Section):
    """Loop candidates by a network [ZS]."""

    threshold: float = Field(0.9, ge=0, le=1)
    """A keyframe is a loop candidate if its similarity is at least this. [ZS, printed]"""
    offered: float = Field(0.1, ge=0, le=1)
    """Replaces `threshold` where learned descriptors verify the candidates. [own]"""
    reranked: int = Field(20, ge=1)
    """This many of the most similar keyframes are re-ranked by local descriptors. [own]"""
    max_candidates: int = Field(5, ge=1)
    """Upper bound of the number of candidates of a query; the best ones are kept. [own]"""
    recent_keyframes: int = Field(10, ge=0)
    """This many of the newest keyframes are never candidates. [own]"""
    min_shared: int = Field(15, ge=1)
    """Two candidates show the same place if they share at least this many landmarks.
    [OS1 III-D, printed]"""
    reach: float = Field(20.0, ge=0)
    """Where learned descriptors verify the candidates, the query is compared only with keyframes
    within this distance, in metres. The distance grows by `reach_share` of the way driven since
    the keyframe. [own]"""
    reach_share: float = Field(0.05, ge=0)
    """Share of the way driven since the keyframe by which `reach` grows. It is several times the
    drift of a stereo camera in a street, which is about one per cent. [own]"""
    monocular_reach_share: float = Field(0.3, ge=0)
    """Replaces `reach` and `reach_share` in monocular maps, whose scale is unknown and drifts: the
    query is compared only with keyframes nearer than this share of the way driven since the
    keyframe. The default is twice what KITTI 00 needs, where the scale drifts by a factor of 2.3.
    [own]"""
    reach_angle: float = Field(60.0, gt=0, le=180)
    """The query is compared only with keyframes whose viewing directions differ from its own by at
    most this, in degrees: no place is recognised from behind or from the side. [own]"""
    embedded_at_once: int = Field(8, ge=1)
    """Upper bound of the number of keyframes that the network processes for one query; the nearest
    ones are taken. [own]"""
    fit: Literal["squash", "crop"] = "squash"
    """How an image is brought to the network's input size: `squash` scales the whole image, `crop`
    cuts out its middle. [own]"""
