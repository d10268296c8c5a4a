"""Every threshold of the pipeline in one tree; docs/thresholds.md is made from it.

One file because whoever looks for a threshold, or tunes several, looks in one place.

A description ends with the source of the value: [own], or the paper and section of the rule and
what the value is: printed there, customary in the programs of the ORB-SLAM family, or our own.
OS1: Mur-Artal et al., ORB-SLAM, T-RO 2015. OS2: Mur-Artal and Tardós, ORB-SLAM2, T-RO 2017.
ZS: Zhou and Sun, Sci Rep 15, 7644 (2025).
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from vslam.errors import InputError


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class OrbConfig(_Section):
    """ORB extraction."""

    n_features: int = Field(2000, ge=100, description="Features per image. [OS1 V-A, printed]")
    n_levels: int = Field(8, ge=2, le=16, description="Pyramid levels. [OS1 V-A, printed]")
    scale_factor: float = Field(
        1.2,
        gt=1.0,
        le=2.0,
        description="Scale from one pyramid level to the next. [OS1 V-A, printed]",
    )
    fast_threshold: int = Field(
        12, ge=1, le=255, description="FAST threshold, grey levels. [OS1 V-A, customary]"
    )
    fast_threshold_min: int = Field(
        7,
        ge=1,
        le=255,
        description="FAST threshold of cells without a corner, grey levels. [OS1 V-A, customary]",
    )
    cell_size: int = Field(
        35,
        ge=16,
        description="Side of a cell of the adaptive threshold, pixels. [OS1 V-A, customary]",
    )


class WeakImageConfig(_Section):
    """Images with much noise or little contrast (docs/stress.md)."""

    noise_from: float = Field(
        5.0,
        ge=0,
        description="Deviation of the noise from which images are blurred, grey levels; "
        "undisturbed ones have at most 2.5. [own]",
    )
    noise_left: float = Field(
        4.0, gt=0, description="Noise that they are blurred to, grey levels. [own]"
    )
    max_blur: float = Field(3.5, gt=0, description="Deviation of that blur, at most, pixels. [own]")
    spikes_from: float = Field(
        0.04,
        ge=0,
        le=1,
        description="Pixels that stand out alone, share; above, a median filter takes them out. "
        "[own]",
    )
    few_features: float = Field(
        0.5, ge=0, le=1, description="Share of n_features; below, contrast is measured. [own]"
    )
    low_contrast: float = Field(
        6.0,
        ge=0,
        description="Deviation in blocks of 16 pixels, median; below, contrast is raised, grey "
        "levels; 0: never. [own]",
    )
    least_detail: float = Field(
        0.25,
        ge=0,
        description="Mean second difference over that deviation; below, the image is out of focus "
        "and stays as it is; sharp ones have 0.4 and more. [own]",
    )
    raised_contrast: float = Field(
        12.0, gt=0, description="What it is raised to: KITTI's on a bright day. [own]"
    )
    contrast_window: int = Field(
        33, ge=3, description="Side of the window that contrast is raised in, pixels. [own]"
    )
    flat_share: float = Field(
        0.25,
        gt=0,
        le=1,
        description="Contrast of flat parts, share of the median, below which they are not raised "
        "further. [own]",
    )
    least_contrast: float = Field(
        0.15, gt=0, description="The same in grey levels: what rounding leaves. [own]"
    )


class StereoConfig(_Section):
    """Stereo matching [OS2, III-A]."""

    max_descriptor_distance: int = Field(
        75,
        ge=0,
        le=256,
        description="Descriptor distance, upper bound, bits. [OS2 III-A, customary]",
    )
    sad_window: int = Field(
        5, ge=1, description="Half width of the SAD patch, pixels. [OS2 III-A, customary]"
    )
    sad_search: int = Field(
        5, ge=1, description="SAD search to each side, pixels. [OS2 III-A, customary]"
    )
    balance_from: float = Field(
        0.3,
        ge=0,
        description="Gain between the sides from which the darker one is brightened, stops. [own]",
    )
    max_gain_disagreement: float = Field(
        0.75,
        gt=0,
        description="Gain of dark pixels against that of bright ones, upper bound of what is a "
        "gain, stops. [own]",
    )
    close_depth_baselines: float = Field(
        40.0,
        gt=0,
        description="Depth below which a point is close, baselines. [OS2 III-A, printed]",
    )
    offset_sigma: float = Field(
        0.2,
        ge=0,
        description="Sigma of the offset of all disparities before the camera's motion tells it, "
        "pixels; 0: not looked for (docs/motorway.md). [own]",
    )
    offset_keyframes: int = Field(
        12, ge=3, description="Keyframes after which that offset is measured anew. [own]"
    )
    least_delay: float = Field(
        1.2e-3,
        gt=0,
        description="Difference between the measured delay of the right side and the calibration's "
        "from which the report warns, seconds (docs/stress.md). [own]",
    )
    delay_sigmas: float = Field(
        5.0, gt=0, description="The same in standard deviations of what was measured. [own]"
    )


class DepthConfig(_Section):
    """Depth images [OS2, III-A]."""

    min_metres: float = Field(
        0.1, gt=0, description="Depth below which a pixel's is unknown, metres. [own]"
    )
    max_metres: float = Field(
        100.0, gt=0, description="Depth above which a pixel's is unknown, metres. [own]"
    )
    edge_radius: float = Field(
        4.0,
        ge=0,
        description="Pixels at octave 0 around a keypoint that must have its depth: FAST's circle "
        "and one more. [own]",
    )
    edge_ratio: float = Field(
        0.07, gt=0, description="Range of depth there, share of the nearest; above, an edge. [own]"
    )


class AlignmentConfig(_Section):
    """Matches to a fraction of a pixel (Forster et al., ICRA 2014, III-B)."""

    iterations: int = Field(7, ge=1, description="Steps of Gauss-Newton, at most. [own]")
    max_shift: float = Field(
        2.0,
        gt=0,
        le=2.0,
        description="From the keypoint, in x and in y, pixels of its octave. [own]",
    )
    min_correlation: float = Field(
        0.85, gt=0, le=1, description="Cross-correlation of an aligned patch with the image. [own]"
    )
    certainty: int = Field(
        4,
        ge=1,
        le=255,
        description="How many times smaller the variance of an aligned match is than that of a "
        "keypoint. [own]",
    )
    keyframes: int = Field(5, ge=1, description="The newest ones, whose patches are kept. [own]")


class TrackingConfig(_Section):
    """Frame-to-map tracking."""

    match_distance: int = Field(
        100,
        ge=0,
        le=256,
        description="Descriptor distance, projection search, bits. [OS1 V-D, customary]",
    )
    match_ratio: float = Field(
        0.8,
        gt=0,
        le=1,
        description="Best over second-best distance, local map. [OS1 V-D, customary]",
    )
    reference_distance: int = Field(
        50,
        ge=0,
        le=256,
        description="Descriptor distance, reference keyframe, bits. [OS1 V-B, customary]",
    )
    reference_ratio: float = Field(
        0.7,
        gt=0,
        le=1,
        description="Best over second-best, reference keyframe. [OS1 V-B, customary]",
    )
    motion_window: float = Field(
        7.0,
        gt=0,
        description="Search radius at octave 0, previous frame, pixels. [OS1 V-B, customary]",
    )
    local_window: float = Field(
        2.5, gt=0, description="Search radius at octave 0, local map, pixels. [OS1 V-D, customary]"
    )
    depth_motion_window: float = Field(
        15.0, gt=0, description="motion_window of an RGB-D camera. [OS1 V-B, customary]"
    )
    depth_local_window: float = Field(
        5.0, gt=0, description="local_window of an RGB-D camera; ORB-SLAM2 has 7.5. [OS1 V-D, own]"
    )
    predicted_window: float = Field(
        7.0,
        gt=0,
        description="local_window where neither the previous frame nor the reference keyframe is "
        "recognised. [own]",
    )
    local_keyframes: int = Field(
        80, ge=1, description="Keyframes of the local map, at most. [OS1 V-D, customary]"
    )
    min_stereo_start: int = Field(
        100, ge=10, description="Stereo features that a map can start from. [OS2 III-B, own]"
    )
    min_inliers_motion: int = Field(
        20,
        ge=3,
        description="Inliers; with fewer, the reference keyframe is tried. [OS1 V-B, customary]",
    )
    min_inlier_ratio: float = Field(
        0.3,
        ge=0,
        le=1,
        description="Inliers over matches; below, the reference keyframe is tried. [own]",
    )
    min_inliers_frame: int = Field(
        10,
        ge=3,
        description="Inliers; with fewer, the local map is not tried. [OS1 V-B, customary]",
    )
    min_inliers: int = Field(
        30, ge=3, description="Inliers; with fewer, the frame is WEAK. [OS1 V-D, customary]"
    )
    min_inliers_lost: int = Field(
        15, ge=3, description="Inliers; with fewer, the frame is LOST. [own]"
    )
    depth_min_inlier_ratio: float = Field(
        0.2,
        ge=0,
        le=1,
        description="RGB-D: inliers over matches; below, the frame is LOST. [own]",
    )
    lost_frames_before_restart: int = Field(
        3, ge=1, description="Stereo: lost frames until a sub-map starts at the prediction. [own]"
    )
    young_keyframes: int = Field(
        5, ge=0, description="Stereo: keyframes up to which one lost frame is enough. [own]"
    )
    monocular_lost_frames: int = Field(
        4, ge=1, description="Monocular: lost frames until two views start a sub-map. [own]"
    )


class InitializationConfig(_Section):
    """The first two keyframes of a monocular map [OS1, IV]."""

    min_features: int = Field(200, ge=20, description="Features of the first view. [own]")
    window: float = Field(
        100.0, gt=0, description="Search radius in the second view, pixels. [OS1 IV, customary]"
    )
    match_distance: int = Field(
        50, ge=0, le=256, description="Descriptor distance, bits. [OS1 IV, customary]"
    )
    match_ratio: float = Field(
        0.9, gt=0, le=1, description="Best over second-best distance. [OS1 IV, customary]"
    )
    min_matches: int = Field(
        100,
        ge=8,
        description="Matches; with fewer, another first view is taken. [OS1 IV, customary]",
    )
    draws: int = Field(
        300, ge=1, description="RANSAC draws of each model; ORB-SLAM has 200. [OS1 IV, own]"
    )
    homography_share: float = Field(
        0.45,
        gt=0,
        lt=1,
        description="Share of both scores above which the homography wins. [OS1 IV, printed]",
    )
    max_error: float = Field(
        2.0,
        gt=0,
        description="Reprojection error of an inlier at octave 0, pixels. [OS1 IV, customary]",
    )
    min_parallax_deg: float = Field(
        1.0, gt=0, description="Parallax that min_points must have, degrees. [OS1 IV, customary]"
    )
    min_points: int = Field(
        50, ge=8, description="Triangulated points with that parallax. [OS1 IV, customary]"
    )
    min_point_share: float = Field(
        0.7,
        gt=0,
        le=1,
        description="Inliers of the model in front of both cameras, share. [OS1 IV, own]",
    )
    max_rival_share: float = Field(
        0.7,
        gt=0,
        le=1,
        description="Points of the second-best motion, share of the best. [OS1 IV, customary]",
    )
    min_landmarks: int = Field(
        100, ge=8, description="Landmarks after the first bundle adjustment. [OS1 IV, customary]"
    )
    median_depth: float = Field(
        15.0, gt=0, description="Median depth of the first landmarks, map units. [own]"
    )
    max_rescaling: float = Field(
        10.0,
        gt=1,
        description="Factor at most that matches a sub-map to the speed before it. [own]",
    )
    max_seconds: float = Field(
        1.5, gt=0, description="Longest time between the two views, seconds. [own]"
    )


class KeyframeConfig(_Section):
    """Keyframe decision [OS2, III-E]."""

    max_interval_s: float = Field(
        1.0, gt=0, description="Longest time without a keyframe, seconds. [OS1 V-E, customary]"
    )
    depth_max_interval_s: float = Field(
        0.3, gt=0, description="max_interval_s of an RGB-D camera, held in a hand. [own]"
    )
    min_tracked_close: int = Field(
        100, ge=0, description="Tracked close points; fewer are too few. [OS2 III-E, printed]"
    )
    min_new_close: int = Field(
        70,
        ge=0,
        description="Untracked close points; insert with more, if too few are tracked. "
        "[OS2 III-E, printed]",
    )
    min_kept_close: float = Field(
        0.2,
        ge=0,
        le=1,
        description="min_tracked_close where a keyframe brings fewer: share of what it brings "
        "(docs/motorway.md). [own]",
    )
    first_gain: float = Field(
        2.0,
        ge=0,
        description="Close points that a keyframe is taken to bring at first, of "
        "min_tracked_close. [own]",
    )
    gain_weight: float = Field(
        0.2, gt=0, le=1, description="Weight of the last keyframe in what one brings. [own]"
    )
    max_tracked_ratio: float = Field(
        0.75,
        gt=0,
        le=1,
        description="Tracked share of the reference keyframe's points; insert below. "
        "[OS1 V-E, customary]",
    )
    urgent_ratio: float = Field(
        0.25,
        gt=0,
        le=1,
        description="Tracked share below which insertion does not wait for mapping. "
        "[OS1 V-E, customary]",
    )
    monocular_ratio: float = Field(
        0.9, gt=0, le=1, description="max_tracked_ratio of a monocular camera. [OS1 V-E, printed]"
    )
    monocular_min_tracked: int = Field(
        100, ge=0, description="Monocular: with fewer tracked points, do not wait either. [own]"
    )
    monocular_urgent_ratio: float = Field(
        0.5, gt=0, le=1, description="urgent_ratio of a monocular camera. [own]"
    )
    known_after_s: float = Field(
        30.0, gt=0, description="Age from which a keyframe makes its place known, seconds. [own]"
    )
    known_ratio: float = Field(
        0.5,
        gt=0,
        description="Tracked share of an old keyframe's points; above, its place is known. [own]",
    )
    known_min_inliers: int = Field(
        50, ge=0, description="Landmarks tracked; fewer, and no place is known. [own]"
    )
    merge_after_frames: int = Field(
        2, ge=1, description="Frames after which local mapping is merged. [own]"
    )


class MappingConfig(_Section):
    """Local mapping and bundle adjustment."""

    neighbours: int = Field(
        10, ge=1, description="Covisible keyframes to triangulate with. [OS1 VI-C, customary]"
    )
    fuse_neighbours: int = Field(
        10, ge=1, description="Covisible keyframes to fuse with. [OS1 VI-C, customary]"
    )
    monocular_neighbours: int = Field(
        20,
        ge=1,
        description="Covisible keyframes to triangulate with, monocular. [OS1 VI-C, customary]",
    )
    min_baseline_ratio: float = Field(
        0.01, ge=0, description="Monocular: baseline over median depth. [OS1 VI-C, customary]"
    )
    min_parallax_cosine: float = Field(
        0.9998, gt=0, le=1, description="Cosine of the parallax, upper bound. [OS1 VI-C, customary]"
    )
    epipolar_distance: int = Field(
        50,
        ge=0,
        le=256,
        description="Descriptor distance, triangulation, bits. [OS1 VI-C, customary]",
    )
    fuse_distance: int = Field(
        50, ge=0, le=256, description="Descriptor distance, fusion, bits. [OS1 VI-C, customary]"
    )
    fuse_window: float = Field(
        3.0, gt=0, description="Search radius at octave 0, fusion, pixels. [OS1 VI-C, customary]"
    )
    min_found_ratio: float = Field(
        0.25,
        ge=0,
        le=1,
        description="Landmark culling: frames that find it over frames that should. "
        "[OS1 VI-B, printed]",
    )
    redundant_ratio: float = Field(
        0.9,
        gt=0,
        le=1,
        description="Keyframe culling: share of redundant landmarks. [OS1 VI-E, printed]",
    )
    min_shared: int = Field(
        15, ge=1, description="Shared landmarks of a covisibility edge. [OS1 III-D, printed]"
    )
    max_ba_keyframes: int = Field(
        60, ge=2, description="Free keyframes of local bundle adjustment. [OS1 VI-D, own]"
    )
    ba_iterations: int = Field(
        10,
        ge=1,
        description="Iterations of local bundle adjustment; half as many before. "
        "[OS1 VI-D, customary]",
    )


class SiameseConfig(_Section):
    """Learned loop detectors. [ZS]: Zhou and Sun, Sci Rep 15, 7644 (2025)."""

    threshold: float = Field(0.9, ge=0, le=1, description="Similarity of a loop. [ZS, printed]")
    offered: float = Field(
        0.1, ge=0, le=1, description="The same, where learned descriptors verify. [own]"
    )
    reranked: int = Field(
        20, ge=1, description="Most similar keyframes that local descriptors put in order. [own]"
    )
    max_candidates: int = Field(5, ge=1, description="Candidates of a query, best first. [own]")
    recent_keyframes: int = Field(
        10, ge=0, description="Newest keyframes that are no candidates. [own]"
    )
    min_shared: int = Field(
        15,
        ge=1,
        description="Shared landmarks that make two candidates one place. [OS1 III-D, printed]",
    )
    reach: float = Field(
        20.0,
        ge=0,
        description="Where local descriptors verify, only keyframes so near are compared, metres, "
        "and by a share of the drive since. [own]",
    )
    reach_share: float = Field(
        0.05,
        ge=0,
        description="Share of the drive that `reach` grows by: several times the drift of a stereo "
        "camera in a street, which is about one per cent. [own]",
    )
    monocular_reach_share: float = Field(
        0.3,
        ge=0,
        description="The same share in monocular maps, whose unit drifts: twice what KITTI 00 "
        "needs, where it drifts by a factor of 2.3. [own]",
    )
    reach_angle: float = Field(
        60.0,
        gt=0,
        le=180,
        description="Only keyframes that look within this angle of where the camera looks are "
        "compared, degrees: a place is not recognised from the side. [own]",
    )
    embedded_at_once: int = Field(
        8, ge=1, description="Keyframes that a query has the network see, the nearest. [own]"
    )
    fit: Literal["squash", "crop"] = Field(
        "squash", description="Input: whole image squashed, or its middle cropped. [own]"
    )


class VerificationConfig(_Section):
    """When a loop candidate is a revisit [OS1, VII-B; OS2, III-C]."""

    descriptors: Literal["usual", "orb", "learned", "both"] = Field(
        "usual",
        description="What verifies candidates, whichever detector proposed them: ORB, the "
        "network's local descriptors, or these where ORB fails (`both`); `usual` is `orb` for "
        "`bow`, `capsule-paper` and plug-ins, `both` for the other networks and `both`. [own]",
    )

    match_distance: int = Field(
        50, ge=0, le=256, description="Descriptor distance, bits. [OS1 VII-B, customary]"
    )
    match_ratio: float = Field(
        0.8, gt=0, le=1, description="Best over second-best distance. [OS1 VII-B, own]"
    )
    min_matches: int = Field(
        20, ge=3, description="Landmarks matched by descriptor. [OS1 VII-B, customary]"
    )
    max_draws: int = Field(600, ge=1, description="RANSAC draws, at most. [OS1 VII-B, own]")
    confidence: float = Field(
        0.99, gt=0, lt=1, description="Probability of one draw without outliers. [OS1 VII-B, own]"
    )
    min_consensus: int = Field(15, ge=6, description="Inliers of RANSAC. [OS1 VII-B, own]")
    place_keyframes: int = Field(
        10, ge=0, description="Covisible keyframes that form a place with the match. [own]"
    )
    first_window: float = Field(
        8.0, gt=0, description="Guided search, radius at octave 0, pixels. [OS1 VII-B, own]"
    )
    second_window: float = Field(
        4.0,
        gt=0,
        description="Guided search, radius of the second search, pixels. [OS1 VII-B, own]",
    )
    guided_distance: int = Field(
        64, ge=0, le=256, description="Descriptor distance, guided search, bits. [OS1 VII-B, own]"
    )
    min_inliers: int = Field(
        40, ge=6, description="Inliers after guided search. [OS1 VII-B, customary]"
    )
    min_inlier_ratio: float = Field(
        0.5, ge=0, le=1, description="Inliers over guided matches. [own]"
    )
    min_elsewhere: int = Field(
        15,
        ge=0,
        description="Inliers outside the third of the image that has the most. [own]",
    )
    min_cells: int = Field(8, ge=1, description="Cells with inliers, grid of 8 x 4. [own]")
    min_cell_ratio: float = Field(
        0.3,
        ge=0,
        le=1,
        description="Cells with inliers over cells where the place should appear. [own]",
    )
    min_seen_ratio: float = Field(
        0.07, ge=0, le=1, description="Landmarks of one side that the other sees, share. [own]"
    )
    max_distance: float = Field(
        15.0, gt=0, description="Distance between the two cameras, metres. [own]"
    )


class LearnedMatchingConfig(_Section):
    """Places matched by the network's local descriptors, where ORB fails."""

    max_candidates: int = Field(
        2, ge=1, description="Candidates tried of a keyframe or lost frame. [own]"
    )
    rated: int = Field(
        5,
        ge=0,
        description="Candidates of a detector without local descriptors whose likeness they say, "
        "at most. [own]",
    )
    views: int = Field(
        2, ge=1, description="Keyframes of the place that are matched, at most. [own]"
    )
    most_shared: float = Field(
        0.4,
        gt=0,
        le=1,
        description="Landmarks that a keyframe shares with one whose image is kept, of its own, "
        "from which on no network sees it. [own]",
    )
    min_alike: float = Field(
        0.35, ge=0, le=1, description="Likeness of two images that makes a try worth it. [own]"
    )
    rest: int = Field(
        8,
        ge=0,
        description="Keyframes after a vain try at which nothing less alike is tried. [own]",
    )
    more_alike: float = Field(
        1.1, ge=1, description="Ratio of likeness that makes a place worth a try before. [own]"
    )
    min_share: float = Field(
        0.1, ge=0, le=1, description="Coarse cells that one homography explains. [own]"
    )
    coarse_alike: float = Field(
        0.3, ge=-1, le=1, description="Cosine of coarse descriptors that match. [own]"
    )
    alike: float = Field(
        0.5, ge=-1, le=1, description="Cosine of fine descriptors that match. [own]"
    )
    reach: int = Field(
        5, ge=1, description="Window about a coarse match, fine cells to either side. [own]"
    )
    guided_reach: int = Field(
        3, ge=1, description="Window about a projected landmark, fine cells to either side. [own]"
    )
    sigma: float = Field(
        1.5, gt=0, description="Deviation of a match, pixels of the network's image. [own]"
    )
    max_draws: int = Field(1000, ge=1, description="RANSAC draws, at most. [own]")
    confidence: float = Field(
        0.99, gt=0, lt=1, description="Probability of one draw without outliers. [own]"
    )
    min_consensus: int = Field(40, ge=4, description="Inliers of RANSAC. [own]")
    min_consensus_ratio: float = Field(
        0.15, ge=0, le=1, description="Of these, share of the landmarks looked for. [own]"
    )
    min_inliers: int = Field(80, ge=6, description="Inliers after guided search. [own]")
    min_elsewhere: int = Field(
        40, ge=0, description="Inliers outside the third of the image that has the most. [own]"
    )
    min_seen_ratio: float = Field(
        0.3, ge=0, le=1, description="Landmarks of one side that the other sees, share. [own]"
    )
    fuse_pixels: float = Field(
        2.0,
        gt=0,
        description="From a landmark to the keypoint that observes it, at octave 0, pixels. [own]",
    )
    verified_memory: int = Field(
        10, ge=1, description="As of `consistency`, where fewer keyframes have an image. [own]"
    )


class ConsistencyConfig(_Section):
    """What makes verified candidates a loop [OS1, VII-A]."""

    min_keyframes: int = Field(
        2, ge=1, description="Keyframes in a row with this place; OS1: 3. [OS1 VII-A, own]"
    )
    max_gap: int = Field(
        1, ge=0, description="Keyframes in between without it; OS1: 0. [OS1 VII-A, own]"
    )
    min_shared: int = Field(
        30, ge=1, description="Shared landmarks that put a keyframe into a candidate's group. [own]"
    )
    min_verified: int = Field(2, ge=1, description="Verified keyframes that must agree. [own]")
    verified_memory: int = Field(
        5, ge=1, description="Keyframes during which a verified loop counts. [own]"
    )
    max_apart: float = Field(
        0.5, gt=0, description="Distance between agreeing loops, metres. [own]"
    )
    max_turn: float = Field(
        1.0, gt=0, description="Rotation between agreeing loops, degrees. [own]"
    )
    min_moved: float = Field(
        2.0,
        ge=0,
        description="At the end of a drive, distance of an earlier keyframe that may confirm a "
        "loop, metres: one next to the query would only repeat it. [own]",
    )


class RelocalizationConfig(_Section):
    """Finding a lost camera [OS1, V-C]."""

    match_distance: int = Field(
        50, ge=0, le=256, description="Descriptor distance, bits. [OS1 V-C, customary]"
    )
    match_ratio: float = Field(
        0.75, gt=0, le=1, description="Best over second-best distance. [OS1 V-C, customary]"
    )
    min_matches: int = Field(
        15, ge=4, description="Landmarks matched by descriptor. [OS1 V-C, customary]"
    )
    max_draws: int = Field(600, ge=1, description="RANSAC draws, at most. [OS1 V-C, own]")
    confidence: float = Field(
        0.99,
        gt=0,
        lt=1,
        description="Probability of one draw without outliers. [OS1 V-C, customary]",
    )
    min_consensus: int = Field(10, ge=4, description="Inliers of RANSAC. [OS1 V-C, customary]")
    first_window: float = Field(
        8.0, gt=0, description="Search radius at octave 0, first search, pixels. [OS1 V-C, own]"
    )
    min_inliers: int = Field(
        50, ge=6, description="Inliers of a frame that is found. [OS1 V-C, customary]"
    )
    min_elsewhere: int = Field(
        15, ge=0, description="Inliers outside the third of the image that has the most. [own]"
    )
    max_candidates: int = Field(5, ge=1, description="Places tried per lost frame. [own]")
    doubtful_gap: float = Field(
        1.5, gt=1, description="Time since the last tracked frame, usual ones, that is a gap. [own]"
    )
    doubtful_share: float = Field(
        0.5,
        ge=0,
        le=1,
        description="Tracked share of the reference; below, a frame after a gap is looked for in "
        "the whole map. [own]",
    )
    better: float = Field(
        1.5, ge=1, description="Ratio of inliers from which it is moved to where it is found. [own]"
    )
    neighbours: int = Field(20, ge=1, description="Keyframes whose landmarks are searched. [own]")


class LoopConfig(_Section):
    """Closing a verified loop [OS1, VII]."""

    global_iterations: int = Field(
        10, ge=1, description="Iterations of global bundle adjustment. [OS2 III-D, customary]"
    )
    observations_per_keyframe: int = Field(
        25000,
        ge=1,
        description="Observations per keyframe until global adjustment is merged. [own]",
    )


class BowConfig(_Section):
    """Loop candidates by bag of words [OS1, III-E and VII-A]."""

    min_shared: int = Field(
        15, ge=1, description="Shared landmarks of neighbours. [OS1 III-D, printed]"
    )
    exclude_recent: int = Field(
        20, ge=1, description="Newest keyframes that are no candidates, query included. [own]"
    )
    common_words_ratio: float = Field(
        0.8,
        ge=0,
        le=1,
        description="Common words, share of the most of any keyframe. [OS1 III-E, customary]",
    )
    group_size: int = Field(
        10, ge=0, description="Best covisible keyframes in a group. [OS1 III-E, customary]"
    )
    group_score_ratio: float = Field(
        0.75, ge=0, le=1, description="Group's score over the best group's. [OS1 III-E, printed]"
    )
    max_groups: int = Field(30, ge=1, description="Groups formed, best keyframe first. [own]")


class PoseGraphConfig(_Section):
    """Pose graph behind a loop closure: what edges are trusted with, and when a loop is refused.

    Drift is modelled as a random walk, its deviation growing with the root of the path. At these
    values 400 m of odometry may be off by 1.2 % (one sigma), nearly all of it by rotation.
    """

    min_shared: int = Field(
        100,
        ge=1,
        description="Shared landmarks of a strong covisibility edge. [OS1 III-D, printed]",
    )
    min_shared_tree: int = Field(
        15,
        ge=1,
        description="Shared landmarks; with fewer, a tree edge past a restart is weak. "
        "[OS1 III-D, printed]",
    )
    translation_drift: float = Field(
        0.03, gt=0, description="Sigma of odometry, metres per root of a metre. [own]"
    )
    rotation_drift: float = Field(
        0.001, gt=0, description="Sigma of odometry, radians per root of a metre. [own]"
    )
    scale_drift: float = Field(
        0.01, gt=0, description="Sigma of monocular odometry, log scale per root of a unit. [own]"
    )
    min_length: float = Field(
        0.3, gt=0, description="Shortest length that an edge counts with, metres. [own]"
    )
    loop_translation: float = Field(
        0.1, gt=0, description="Sigma of a verified loop, metres. [own]"
    )
    loop_rotation: float = Field(
        0.005, gt=0, description="Sigma of a verified loop, radians. [own]"
    )
    loop_scale: float = Field(0.02, gt=0, description="Sigma of a verified loop, log scale. [own]")
    weak_scale: float = Field(3.0, gt=0, description="Sigma of a weak edge, log scale. [own]")
    weak_translation: float = Field(100.0, gt=0, description="Sigma of a weak edge, metres. [own]")
    weak_rotation: float = Field(1.0, gt=0, description="Sigma of a weak edge, radians. [own]")
    gap_translation: float = Field(
        0.5, gt=0, description="Sigma of a gap, share of the distance predicted. [own]"
    )
    gap_speed: float = Field(
        2.0, gt=0, description="Sigma of a gap, at least, metres per second. [own]"
    )
    gap_rotation: float = Field(0.3, gt=0, description="Sigma of a gap, radians per second. [own]")
    gap_scale: float = Field(0.3, gt=0, description="Sigma of a gap, log scale. [own]")
    min_gap: float = Field(
        0.3, gt=0, description="Shortest time that a gap counts with, seconds. [own]"
    )
    robust_scale: float = Field(
        3.0, gt=0, description="Scale of the Cauchy loss on loops, sigmas. [own]"
    )
    iterations: int = Field(50, ge=1, description="Levenberg-Marquardt iterations, at most. [own]")
    max_loop_error: float = Field(
        30.0, gt=0, description="Chi-square of a loop, upper bound. [own]"
    )
    max_strain: float = Field(
        60.0, gt=0, description="Chi-square of all other edges per closed loop, upper bound. [own]"
    )


class Config(_Section):
    """The whole configuration, written to ``config.json`` of each run and read by --config."""

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


def load_config(path: Path) -> Config:
    """Read a configuration in JSON; keys left out keep their defaults.

    Raises:
        InputError: missing file, no JSON, unknown key or value out of range.
    """
    try:
        return Config.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot read the configuration ({error.strerror}).") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "file"
        raise InputError(f"{path}: {where}: {first['msg']}.") from error
