"""Thresholds of loop verification: a candidate must be the same place, and others must agree."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from vslam.config.section import Section


class VerificationConfig(Section):
    """When a loop candidate is a revisit [OS1, VII-B; OS2, III-C]."""

    descriptors: Literal["usual", "orb", "learned", "both"] = "usual"
    """Descriptors that verify candidates, whichever detector proposed them: `orb`, `learned` (the
    network's local descriptors), or `both`, which uses the learned ones where ORB fails. `usual`
    means `orb` for `bow`, `capsule-paper` and plug-ins, and `both` for the other networks and the
    detector `both`. [own]"""
    match_distance: int = Field(50, ge=0, le=256)
    """Upper bound of the descriptor distance of a match, in bits. [OS1 VII-B, customary]"""
    match_ratio: float = Field(0.8, gt=0, le=1)
    """Upper bound of the ratio of the best to the second-best distance. [OS1 VII-B, own]"""
    min_matches: int = Field(20, ge=3)
    """Number of landmarks that must match by descriptor. [OS1 VII-B, customary]"""
    max_draws: int = Field(600, ge=1)
    """Upper bound of the number of RANSAC draws. [OS1 VII-B, own]"""
    confidence: float = Field(0.99, gt=0, lt=1)
    """Probability with which RANSAC must draw at least one sample without outliers.
    [OS1 VII-B, own]"""
    min_consensus: int = Field(15, ge=6)
    """Number of inliers that RANSAC must find. [OS1 VII-B, own]"""
    place_keyframes: int = Field(10, ge=0)
    """Number of covisible keyframes that form a place together with the matched one. [own]"""
    first_window: float = Field(8.0, gt=0)
    """Search radius of the first guided search, in pixels at octave 0. [OS1 VII-B, own]"""
    second_window: float = Field(4.0, gt=0)
    """Search radius of the second guided search, in pixels at octave 0. [OS1 VII-B, own]"""
    guided_distance: int = Field(64, ge=0, le=256)
    """Upper bound of the descriptor distance in guided search, in bits. [OS1 VII-B, own]"""
    min_inliers: int = Field(40, ge=6)
    """Number of inliers that must remain after guided search. [OS1 VII-B, customary]"""
    min_inlier_ratio: float = Field(0.5, ge=0, le=1)
    """Share of the matches of guided search that must be inliers. [own]"""
    min_elsewhere: int = Field(15, ge=0)
    """Number of inliers that must lie outside the third of the image with the most inliers.
    [own]"""
    min_cells: int = Field(8, ge=1)
    """Number of cells of a grid of 8 x 4 over the image that must have inliers. [own]"""
    min_cell_ratio: float = Field(0.3, ge=0, le=1)
    """Share of the cells in which the place should appear that must have inliers. [own]"""
    min_seen_ratio: float = Field(0.07, ge=0, le=1)
    """Share of the landmarks of each side that the other side must see. [own]"""
    max_distance: float = Field(15.0, gt=0)
    """Upper bound of the distance between the two cameras, in metres. [own]"""


class LearnedMatchingConfig(Section):
    """Places matched by the network's local descriptors, where ORB fails."""

    max_candidates: int = Field(2, ge=1)
    """Upper bound of the number of candidates that are tried for a keyframe or a lost frame.
    [own]"""
    rated: int = Field(5, ge=0)
    """If the detector has not rated its candidates by local descriptors, at most this many of them
    are rated before verification. [own]"""
    views: int = Field(2, ge=1)
    """Upper bound of the number of keyframes of a place that are matched. [own]"""
    most_shared: float = Field(0.4, gt=0, le=1)
    """The network does not process a keyframe that shares at least this share of its landmarks with
    a keyframe whose image is kept. [own]"""
    min_alike: float = Field(0.35, ge=0, le=1)
    """Two images are matched only if their similarity by local descriptors is at least this.
    [own]"""
    rest: int = Field(8, ge=0)
    """For this many keyframes after a failed attempt, only places that are more similar
    (`more_alike`) are tried. [own]"""
    more_alike: float = Field(1.1, ge=1)
    """A place is tried during this rest only if its similarity is at least this many times that of
    the failed attempt. [own]"""
    min_share: float = Field(0.1, ge=0, le=1)
    """Share of the coarse cells that one homography must explain. [own]"""
    coarse_alike: float = Field(0.3, ge=-1, le=1)
    """Lower bound of the cosine of two coarse descriptors that match. [own]"""
    alike: float = Field(0.5, ge=-1, le=1)
    """Lower bound of the cosine of two fine descriptors that match. [own]"""
    reach: int = Field(5, ge=1)
    """The fine match is searched for up to this far to each side of the coarse match, in fine
    cells. [own]"""
    guided_reach: int = Field(3, ge=1)
    """A landmark is searched for up to this far to each side of its projection, in fine cells.
    [own]"""
    sigma: float = Field(1.5, gt=0)
    """Standard deviation of the position of a match, in pixels of the network's image. [own]"""
    max_draws: int = Field(1000, ge=1)
    """Upper bound of the number of RANSAC draws. [own]"""
    confidence: float = Field(0.99, gt=0, lt=1)
    """Probability with which RANSAC must draw at least one sample without outliers. [own]"""
    min_consensus: int = Field(40, ge=4)
    """Number of inliers that RANSAC must find. [own]"""
    min_consensus_ratio: float = Field(0.15, ge=0, le=1)
    """Share of the landmarks searched for that RANSAC must find as inliers. [own]"""
    min_inliers: int = Field(80, ge=6)
    """Number of inliers that must remain after guided search. [own]"""
    min_elsewhere: int = Field(40, ge=0)
    """Number of inliers that must lie outside the third of the image with the most inliers.
    [own]"""
    min_seen_ratio: float = Field(0.3, ge=0, le=1)
    """Share of the landmarks of each side that the other side must see. [own]"""
    fuse_pixels: float = Field(2.0, gt=0)
    """Upper bound of the distance between a projected landmark and the keypoint that will observe
    it, in pixels at octave 0. [own]"""
    verified_memory: int = Field(10, ge=1)
    """Replaces `consistency.verified_memory`, if it is greater, where the images of keyframes are
    kept, since not every keyframe has one. [own]"""


class ConsistencyConfig(Section):
    """What makes verified candidates a loop [OS1, VII-A]."""

    min_keyframes: int = Field(2, ge=1)
    """Number of consecutive keyframes that must resemble the place. OS1 requires 3.
    [OS1 VII-A, own]"""
    max_gap: int = Field(1, ge=0)
    """Number of keyframes in between that may fail to resemble it. OS1 allows none.
    [OS1 VII-A, own]"""
    min_shared: int = Field(30, ge=1)
    """A keyframe belongs to the group of a candidate if they share at least this many landmarks.
    [own]"""
    min_verified: int = Field(2, ge=1)
    """Number of verified keyframes that must agree. [own]"""
    verified_memory: int = Field(5, ge=1)
    """A verified loop is remembered for this many keyframes. [own]"""
    max_apart: float = Field(0.5, gt=0)
    """Upper bound of the distance between loops that agree, in metres. [own]"""
    max_turn: float = Field(1.0, gt=0)
    """Upper bound of the rotation between loops that agree, in degrees. [own]"""
    min_moved: float = Field(2.0, ge=0)
    """At the end of a drive an earlier keyframe may confirm a loop only if it is at least this far
    from the query, in metres. A nearer one would only repeat the query. [own]"""
