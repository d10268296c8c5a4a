"""All thresholds of the pipeline, with one class for each stage.

docs/reference/thresholds.md is generated from these classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from vslam.errors import InputError, did_you_mean, plain_reason

_Model = TypeVar("_Model", bound=BaseModel)


class Section(BaseModel):
    """A frozen group of thresholds; the docstring below each field describes it.

    ``tools/threshold_table.py`` reads these docstrings from the source. Pydantic could do so itself
    (``use_attribute_docstrings``), but that would take 0.1 s at the start of every run.

    A docstring ends with the source of the value in brackets: [own], or the paper and section of
    the rule and the status of the value: printed there, customary in the programs of the ORB-SLAM
    family, or our own.

    OS1: Mur-Artal et al., ORB-SLAM, T-RO 2015. OS2: Mur-Artal and Tardós, ORB-SLAM2, T-RO 2017.
    ZS: Zhou and Sun, Sci Rep 15, 7644 (2025).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")


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
    patch_kept_close: float = Field(0.4, ge=0, le=1)
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


class LoopConfig(Section):
    """Global bundle adjustment after a verified loop [OS1, VII]."""

    global_iterations: int = Field(10, ge=1)
    """Upper bound of the number of iterations of global bundle adjustment.
    [OS2 III-D, customary]"""
    observations_per_keyframe: int = Field(25000, ge=1)
    """The result of global bundle adjustment is merged one keyframe after its loop, and one more
    keyframe later for every this many observations in the problem. [own]"""


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


class PoseGraphConfig(Section):
    """The pose graph of a loop closure: how far each edge is trusted, and when a loop is refused.

    Drift is modelled as a random walk: its standard deviation grows with the square root of the
    distance travelled. With the default values it is 1.2 % after 400 m, nearly all of it caused by
    errors of rotation. A gap is an edge over frames in which tracking was lost and the motion was
    only predicted. Such an edge is weak if there was no prediction, or under the hypothesis that
    the camera was carried elsewhere meanwhile.
    """

    min_shared: int = Field(100, ge=1)
    """A covisibility edge belongs to the graph if its ends share at least this many landmarks.
    [OS1 III-D, printed]"""
    min_shared_tree: int = Field(15, ge=1)
    """An edge of the spanning tree across a restart of mapping is weak if its ends share fewer
    landmarks than this. [OS1 III-D, printed]"""
    translation_drift: float = Field(0.03, gt=0)
    """Standard deviation of odometry, in metres per square root of a metre. [own]"""
    rotation_drift: float = Field(0.001, gt=0)
    """Standard deviation of odometry, in radians per square root of a metre. [own]"""
    scale_drift: float = Field(0.01, gt=0)
    """Standard deviation of monocular odometry, in log scale per square root of a map unit.
    [own]"""
    min_length: float = Field(0.3, gt=0)
    """Shorter edges count as this long in the drift model, in metres. [own]"""
    loop_translation: float = Field(0.1, gt=0)
    """Standard deviation of a verified loop, in metres. [own]"""
    loop_rotation: float = Field(0.005, gt=0)
    """Standard deviation of a verified loop, in radians. [own]"""
    loop_scale: float = Field(0.02, gt=0)
    """Standard deviation of a verified loop, in log scale. [own]"""
    weak_scale: float = Field(3.0, gt=0)
    """Standard deviation of a weak edge, in log scale. [own]"""
    weak_translation: float = Field(100.0, gt=0)
    """Standard deviation of a weak edge, in metres. [own]"""
    weak_rotation: float = Field(1.0, gt=0)
    """Standard deviation of a weak edge, in radians. [own]"""
    gap_translation: float = Field(0.5, gt=0)
    """Standard deviation of a gap, as a share of the distance that was predicted. [own]"""
    gap_speed: float = Field(2.0, gt=0)
    """Lower bound of the standard deviation of a gap, in metres per second of its duration.
    [own]"""
    gap_rotation: float = Field(0.3, gt=0)
    """Standard deviation of a gap, in radians per second of its duration. [own]"""
    gap_scale: float = Field(0.3, gt=0)
    """Standard deviation of a gap, in log scale. [own]"""
    min_gap: float = Field(0.3, gt=0)
    """Shorter gaps count as this long, in seconds. [own]"""
    robust_scale: float = Field(3.0, gt=0)
    """Scale of the Cauchy loss on loops, in standard deviations. [own]"""
    iterations: int = Field(50, ge=1)
    """Upper bound of the number of Levenberg-Marquardt iterations. [own]"""
    max_loop_error: float = Field(30.0, gt=0)
    """A loop is refused if its chi-square after optimisation is above this. [own]"""
    max_strain: float = Field(60.0, gt=0)
    """A loop is refused if the chi-square of all other edges is above this times the number of
    closed loops. [own]"""


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


class Config(Section):
    """The whole configuration: each run writes it to ``config.json``, and --config reads it.

    A threshold has a dotted name, too: ``{"orb.n_features": 1000}`` is read like
    ``{"orb": {"n_features": 1000}}``.
    """

    orb: OrbConfig = OrbConfig()
    weak_images: WeakImageConfig = WeakImageConfig()
    stereo: StereoConfig = StereoConfig()
    depth: DepthConfig = DepthConfig()
    alignment: AlignmentConfig = AlignmentConfig()
    tracking: TrackingConfig = TrackingConfig()
    initialization: InitializationConfig = InitializationConfig()
    keyframes: KeyframeConfig = KeyframeConfig()
    mapping: MappingConfig = MappingConfig()
    verification: VerificationConfig = VerificationConfig()
    learned: LearnedMatchingConfig = LearnedMatchingConfig()
    consistency: ConsistencyConfig = ConsistencyConfig()
    relocalization: RelocalizationConfig = RelocalizationConfig()
    loops: LoopConfig = LoopConfig()
    bow: BowConfig = BowConfig()
    pose_graph: PoseGraphConfig = PoseGraphConfig()
    siamese: SiameseConfig = SiameseConfig()

    @model_validator(mode="before")
    @classmethod
    def _nest(cls, given: Any) -> Any:
        """Move thresholds given by their dotted names into their sections."""
        if not isinstance(given, dict):
            return given
        nested = {name: value for name, value in given.items() if "." not in str(name)}
        for name in [name for name in given if name not in nested]:
            section, _, key = name.partition(".")
            values = nested.get(section, {})
            if isinstance(values, dict):
                nested[section] = {**values, key: given[name]}
            else:
                nested[name] = given[name]  # refused as an unknown key
        return nested


def load_config(path: Path | str) -> Config:
    """Read a configuration from a JSON file; keys that it omits keep their defaults.

    Raises:
        InputError: the file is missing or is not JSON, a key is unknown, or a value is out of
            range.
    """
    return read_json(Config, Path(path), "configuration")


def as_config(given: Config | Mapping[str, Any], where: str = "config") -> Config:
    """Thresholds from a dictionary like the content of ``config.json``.

    Args:
        given: those that it omits keep their defaults; a ``Config`` is returned as it is.
        where: where they come from, for the messages.

    Raises:
        InputError: a key is unknown, or a value is out of range.
    """
    return checked(Config, given, where, "configuration")


def changed_thresholds(config: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The thresholds of a ``config.json`` that differ from the defaults, by dotted name.

    Args:
        config: thresholds by section; the file may be that of another version.
    """
    default = Config().model_dump()
    return {
        f"{section}.{name}": value
        for section, values in config.items()
        for name, value in values.items()
        if name not in default.get(section, {}) or value != default[section][name]
    }


def thresholds_in_words(changed: Mapping[str, Any], most: int = 3) -> str:
    """``orb.n_features=1000, 2 more in config.json``: at most so many by name."""
    words = [f"{name}={value}" for name, value in changed.items()]
    more = [f"{len(words) - most} more in config.json"] if len(words) > most else []
    return ", ".join(words[:most] + more)


def read_json(model: type[_Model], path: Path, what: str) -> _Model:
    """Read a file of thresholds or settings; keys that it omits keep their defaults.

    Args:
        model: what the file describes.
        path: the file.
        what: a name for its content, for the messages.

    Raises:
        InputError: the file is missing or is not JSON, a key is unknown, or a value is out of
            range.
    """
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot read the {what} ({error.strerror}).") from error
    return checked(model, text, str(path), what)


def checked(model: type[_Model], given: object, where: str, what: str) -> _Model:
    """Check thresholds or settings; those that are left out keep their defaults.

    Args:
        model: the class that describes the values and their ranges.
        given: JSON as bytes, a dictionary, or a model, which is returned as it is.
        where: the file or argument that the values come from, for error messages.
        what: what error messages call the values, such as ``thresholds``.

    Raises:
        InputError: as ``read_json``.
    """
    try:
        if isinstance(given, bytes):
            return model.model_validate_json(given)
        return model.model_validate(given)
    except ValidationError as error:
        raise InputError(f"{where}: {_fault(model, error, what)}.") from None


def _fault(model: type[BaseModel], error: ValidationError, what: str) -> str:
    """What is wrong with the first of the values that are."""
    first = error.errors()[0]
    place = [str(name) for name in first["loc"]]
    if first["type"] == "json_invalid":
        return f"the {what} is not JSON ({first['ctx']['error']}); correct the file"
    if first["type"] == "model_type":
        name = ".".join(place) or f"the {what}"
        return f'{name} must map names to values, as in {{"name": 1}}'
    why = plain_reason(first["msg"])
    if first["type"] in ("extra_forbidden", "invalid_key"):
        meant = _without_section(model, place) or did_you_mean(place[-1], _keys(model, place[:-1]))
        why = f"unknown key{meant}; correct or remove it"
    return f"{'.'.join(place)}: {why}"


def _without_section(model: type[BaseModel], place: list[str]) -> str:
    """A suggestion for a key that belongs into a section, and was given without one."""
    of = [section for section in model.model_fields if place[-1] in _keys(model, [section])]
    if len(place) > 1 or not of:
        return ""
    return f" (did you mean {' or '.join(f'{section}.{place[-1]}' for section in of)}?)"


def _keys(model: type[BaseModel], place: list[str]) -> list[str]:
    """The keys of a section of ``model``; none where a place is no section."""
    for name in place:
        field = model.model_fields.get(name)
        if field is None or not isinstance(field.annotation, type):
            return []
        if not issubclass(field.annotation, BaseModel):
            return []
        model = field.annotation
    return list(model.model_fields)
