"""Every threshold of the pipeline in one tree, with its unit and source.

Sources: [ORB] Rublee et al., ICCV 2011; [OS1] Mur-Artal et al., ORB-SLAM, T-RO 2015;
[OS2] Mur-Artal and Tardós, ORB-SLAM2, T-RO 2017; [own] measured here, see docs/design.md.
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

    n_features: int = Field(2000, ge=100, description="Features for each image. [OS2, IV-A]")
    n_levels: int = Field(8, ge=2, le=16, description="Pyramid levels. [OS1, V-A]")
    scale_factor: float = Field(1.2, gt=1.0, le=2.0, description="Between levels. [OS1, V-A]")
    fast_threshold: int = Field(12, ge=1, le=255, description="FAST threshold, grey levels.")
    fast_threshold_min: int = Field(
        7, ge=1, le=255, description="Threshold in cells where the first finds nothing. [OS1, V-A]"
    )
    cell_size: int = Field(35, ge=16, description="Cell of the adaptive threshold, pixels.")


class StereoConfig(_Section):
    """Stereo matching [OS2, III-A]."""

    max_descriptor_distance: int = Field(75, ge=0, le=256, description="Hamming distance, bits.")
    sad_window: int = Field(5, ge=1, description="Half width of the SAD patch, pixels.")
    sad_search: int = Field(5, ge=1, description="Search of the SAD refinement, pixels each way.")
    close_depth_baselines: float = Field(
        40.0, gt=0, description="Close: depth below this many baselines. [OS2, III-A]"
    )


class TrackingConfig(_Section):
    """Frame-to-map tracking."""

    match_distance: int = Field(100, ge=0, le=256, description="Projection search, bits. [OS1]")
    match_ratio: float = Field(0.8, gt=0, le=1, description="Best over second best. [OS1, V-D]")
    reference_distance: int = Field(50, ge=0, le=256, description="Brute-force search, bits.")
    reference_ratio: float = Field(0.7, gt=0, le=1, description="Brute-force search. [OS1]")
    motion_window: float = Field(7.0, gt=0, description="Radius at octave 0, pixels. [OS2]")
    local_window: float = Field(2.5, gt=0, description="Radius in the local map, pixels. [OS1]")
    local_keyframes: int = Field(80, ge=1, description="Keyframes of the local map. [OS1]")
    min_stereo_start: int = Field(
        100, ge=10, description="Stereo features that a map can start from. [own]"
    )
    min_inliers_motion: int = Field(20, ge=3, description="Below: try the reference keyframe.")
    min_inlier_ratio: float = Field(
        0.3, ge=0, le=1, description="Of the motion matches; below: likewise. [own]"
    )
    min_inliers_frame: int = Field(10, ge=3, description="Below, the local map is not tried. [OS1]")
    min_inliers: int = Field(30, ge=3, description="Below, the frame is WEAK. [OS1]")
    min_inliers_lost: int = Field(15, ge=3, description="Below, the frame is LOST. [own]")
    lost_frames_before_restart: int = Field(
        3, ge=1, description="Lost this long, mapping restarts at the predicted pose. [own]"
    )
    young_keyframes: int = Field(
        5, ge=0, description="Stereo: with no more in all, one lost frame restarts. [own]"
    )
    monocular_lost_frames: int = Field(
        4, ge=1, description="Monocular, whatever the age: after this, two views anew. [own]"
    )


class InitializationConfig(_Section):
    """The first two keyframes of a monocular map [OS1, IV]."""

    min_features: int = Field(200, ge=20, description="Of a frame to begin with. [own]")
    window: float = Field(100.0, gt=0, description="Search in the second frame, pixels. [OS1]")
    match_distance: int = Field(50, ge=0, le=256, description="Descriptor search, bits. [OS1]")
    match_ratio: float = Field(0.9, gt=0, le=1, description="Best over second best. [OS1]")
    min_matches: int = Field(100, ge=8, description="Below, begin with another frame. [OS1]")
    draws: int = Field(300, ge=1, description="RANSAC draws of each model; OS1 has 200. [own]")
    homography_share: float = Field(
        0.45, gt=0, lt=1, description="Of both scores; above, the homography is taken. [OS1, IV]"
    )
    max_error: float = Field(2.0, gt=0, description="Reprojection at octave 0, pixels. [OS1]")
    min_parallax_deg: float = Field(
        1.0, gt=0, description="That min_points must have; OS1: 1 degree. [OS1]"
    )
    min_points: int = Field(50, ge=8, description="Triangulated with that parallax. [OS1]")
    min_point_share: float = Field(
        0.7, gt=0, le=1, description="Of the model's inliers in front of both cameras. [own]"
    )
    max_rival_share: float = Field(
        0.7, gt=0, le=1, description="Of the best motion's points, for the second best. [OS1]"
    )
    min_landmarks: int = Field(100, ge=8, description="After the first bundle adjustment. [OS1]")
    median_depth: float = Field(
        15.0, gt=0, description="Of the first landmarks: makes the unit of the map. [own]"
    )
    max_rescaling: float = Field(
        10.0,
        gt=1,
        description="Of a sub-map, to go on at the speed before; beyond, it tells nothing. [own]",
    )
    max_seconds: float = Field(
        1.5, gt=0, description="Between the two keyframes; then begin with another frame. [own]"
    )


class KeyframeConfig(_Section):
    """Keyframe decision [OS2, III-E]."""

    max_interval_s: float = Field(1.0, gt=0, description="Never longer between keyframes.")
    min_tracked_close: int = Field(100, ge=0, description="Tracked close points below this and")
    min_new_close: int = Field(70, ge=0, description="this many untracked: insert. [OS2, III-E]")
    max_tracked_ratio: float = Field(
        0.75, gt=0, le=1, description="Of the points the reference keyframe tracks. [OS1, V-E]"
    )
    urgent_ratio: float = Field(
        0.25, gt=0, le=1, description="Below this ratio, do not wait for local mapping. [OS2]"
    )
    monocular_ratio: float = Field(
        0.9, gt=0, le=1, description="max_tracked_ratio of a monocular camera. [OS1, V-E]"
    )
    monocular_min_tracked: int = Field(
        100, ge=0, description="Points; below, a monocular camera does not wait either. [own]"
    )
    monocular_urgent_ratio: float = Field(
        0.5, gt=0, le=1, description="urgent_ratio of a monocular camera. [own]"
    )
    merge_after_frames: int = Field(
        2, ge=1, description="Local mapping is merged this many frames later. [own]"
    )


class MappingConfig(_Section):
    """Local mapping and bundle adjustment."""

    neighbours: int = Field(10, ge=1, description="Covisible keyframes triangulated with. [OS2]")
    fuse_neighbours: int = Field(10, ge=1, description="Covisible keyframes fused with. [OS2]")
    monocular_neighbours: int = Field(
        20, ge=1, description="Covisible keyframes triangulated with, monocular. [OS1]"
    )
    min_baseline_ratio: float = Field(
        0.01, ge=0, description="Monocular baseline over median depth, to triangulate. [OS1]"
    )
    min_parallax_cosine: float = Field(0.9998, gt=0, le=1, description="Triangulation. [OS1]")
    epipolar_distance: int = Field(50, ge=0, le=256, description="Triangulation, bits. [OS1]")
    fuse_distance: int = Field(50, ge=0, le=256, description="Fusion, bits. [OS1]")
    fuse_window: float = Field(3.0, gt=0, description="Radius at octave 0, pixels. [OS1]")
    min_found_ratio: float = Field(0.25, ge=0, le=1, description="Landmark culling. [OS1, VI-B]")
    redundant_ratio: float = Field(0.9, gt=0, le=1, description="Keyframe culling. [OS1, VI-E]")
    min_shared: int = Field(15, ge=1, description="Landmarks that make a covisibility edge. [OS1]")
    max_ba_keyframes: int = Field(60, ge=2, description="Free keyframes in local BA. [own]")
    ba_iterations: int = Field(10, ge=1, description="Levenberg-Marquardt iterations at most.")


class SiameseConfig(_Section):
    """Learned loop detectors. [ZS]: Zhou and Sun, Sci Rep 15, 7644 (2025)."""

    threshold: float = Field(0.9, ge=0, le=1, description="Similarity of a loop. [ZS]")
    max_candidates: int = Field(5, ge=1, description="Candidates of a query, best first. [own]")
    recent_keyframes: int = Field(10, ge=0, description="Newest keyframes never asked. [own]")
    min_shared: int = Field(
        15, ge=1, description="Landmarks shared with a better candidate: the same place. [OS1]"
    )
    fit: Literal["squash", "crop"] = Field(
        "squash", description="Whole view squashed into the network's input, or its middle. [own]"
    )


class VerificationConfig(_Section):
    """When a loop candidate is a revisit [OS1, VII-B; OS2, III-C]."""

    match_distance: int = Field(50, ge=0, le=256, description="Descriptor search, bits. [OS1]")
    match_ratio: float = Field(0.8, gt=0, le=1, description="Best over second best. [OS1]")
    min_matches: int = Field(20, ge=3, description="Landmarks matched by descriptor. [OS1, VII-B]")
    max_draws: int = Field(600, ge=1, description="RANSAC draws. [own]")
    confidence: float = Field(0.99, gt=0, lt=1, description="That RANSAC missed nothing. [OS1]")
    min_consensus: int = Field(15, ge=6, description="Inliers of RANSAC. [own]")
    place_keyframes: int = Field(
        10, ge=0, description="Covisible keyframes that make up a place with the match. [own]"
    )
    first_window: float = Field(8.0, gt=0, description="Guided search, radius in pixels. [OS1]")
    second_window: float = Field(4.0, gt=0, description="Its repetition, likewise. [own]")
    guided_distance: int = Field(64, ge=0, le=256, description="Guided search, bits. [own]")
    min_inliers: int = Field(40, ge=6, description="After guided search. [OS1, VII-B]")
    min_inlier_ratio: float = Field(
        0.5, ge=0, le=1, description="Of the guided matches that fit one pose. [own]"
    )
    min_elsewhere: int = Field(
        15,
        ge=0,
        description="Inliers outside the third of the image, as a strip, with the most. [own]",
    )
    min_cells: int = Field(
        8, ge=1, description="Cells of a grid of 8 x 4 over the image that hold inliers. [own]"
    )
    min_cell_ratio: float = Field(
        0.3, ge=0, le=1, description="Of the cells where the place should appear. [own]"
    )
    min_seen_ratio: float = Field(
        0.07, ge=0, le=1, description="Of a keyframe's landmarks that the other must see. [own]"
    )
    max_distance: float = Field(15.0, gt=0, description="Between the two cameras, metres. [own]")


class ConsistencyConfig(_Section):
    """What makes verified candidates a loop [OS1, VII-A]."""

    min_keyframes: int = Field(
        2, ge=1, description="Keyframes in a row that a place must resemble; OS1 has 3. [own]"
    )
    max_gap: int = Field(1, ge=0, description="Keyframes in between that may not. [own]")
    min_shared: int = Field(
        30, ge=1, description="Landmarks that make a keyframe part of a candidate's group. [own]"
    )
    min_verified: int = Field(2, ge=1, description="Verified keyframes that must agree. [own]")
    verified_memory: int = Field(5, ge=1, description="Keyframes that a verified one counts. [own]")
    max_apart: float = Field(0.5, gt=0, description="Of agreeing loops, metres. [own]")
    max_turn: float = Field(1.0, gt=0, description="Of agreeing loops, degrees. [own]")


class RelocalizationConfig(_Section):
    """Finding a lost camera [OS1, V-C]."""

    match_distance: int = Field(50, ge=0, le=256, description="Descriptor search, bits. [OS1]")
    match_ratio: float = Field(0.75, gt=0, le=1, description="Best over second best. [OS1]")
    min_matches: int = Field(15, ge=4, description="Landmarks matched by descriptor. [OS1]")
    max_draws: int = Field(600, ge=1, description="RANSAC draws. [own]")
    confidence: float = Field(0.99, gt=0, lt=1, description="That RANSAC missed nothing. [OS1]")
    min_consensus: int = Field(10, ge=4, description="Inliers of RANSAC. [OS1]")
    first_window: float = Field(8.0, gt=0, description="Projection search, pixels. [OS1]")
    min_inliers: int = Field(50, ge=6, description="Of the frame once it is found. [OS1]")
    min_elsewhere: int = Field(
        15, ge=0, description="Of these, outside the third of the image with the most. [own]"
    )
    max_candidates: int = Field(5, ge=1, description="Places tried for each lost frame. [own]")
    neighbours: int = Field(20, ge=1, description="Keyframes whose landmarks are searched. [own]")


class LoopConfig(_Section):
    """Closing a verified loop [OS1, VII]."""

    global_iterations: int = Field(
        10, ge=1, description="Of global bundle adjustment, at most. [OS2]"
    )
    observations_per_keyframe: int = Field(
        25000,
        ge=1,
        description="Global bundle adjustment is merged after one keyframe for so many. [own]",
    )


class BowConfig(_Section):
    """Loop candidates by bag of words [OS1, III-E and VII-A]."""

    min_shared: int = Field(15, ge=1, description="Landmarks that make neighbours. [OS1, III-D]")
    exclude_recent: int = Field(
        20, ge=1, description="The query and the keyframes before it, so many in all. [own]"
    )
    common_words_ratio: float = Field(
        0.8, ge=0, le=1, description="Of the most words that any keyframe shares. [OS1]"
    )
    group_size: int = Field(
        10, ge=0, description="Best covisible keyframes that add to a group's score. [OS1]"
    )
    group_score_ratio: float = Field(
        0.75, ge=0, le=1, description="Of the best group's score. [OS1, III-E]"
    )
    max_groups: int = Field(
        30, ge=1, description="Keyframes whose group is counted, best first: bounds work. [own]"
    )
    direct_level: int = Field(
        2, ge=1, le=10, description="Level of the direct index, root 0: about k^2 nodes. [own]"
    )


class PoseGraphConfig(_Section):
    """Pose graph behind a loop closure: what edges are trusted with, and when a loop is refused.

    Drift is modelled as a random walk, its deviation growing with the root of the path. At these
    values 400 m of odometry may be off by 1.2 % (one sigma), nearly all of it by rotation.
    """

    min_shared: int = Field(
        100, ge=1, description="Landmarks that make a strong covisibility edge. [OS1, III-D]"
    )
    min_shared_tree: int = Field(
        15, ge=1, description="Below, a tree edge past a restart of tracking is weak. [OS1, III-D]"
    )
    translation_drift: float = Field(0.03, gt=0, description="m per root of a metre. [own]")
    rotation_drift: float = Field(0.001, gt=0, description="rad per root of a metre. [own]")
    scale_drift: float = Field(
        0.01, gt=0, description="Of a monocular map, logarithm per root of a unit. [own]"
    )
    min_length: float = Field(
        0.3, gt=0, description="No edge is trusted as if it were shorter than this, m. [own]"
    )
    loop_translation: float = Field(0.1, gt=0, description="Sigma of a verified loop, m. [own]")
    loop_rotation: float = Field(0.005, gt=0, description="Sigma of a verified loop, rad. [own]")
    loop_scale: float = Field(0.02, gt=0, description="Sigma of a verified loop, log. [own]")
    weak_scale: float = Field(3.0, gt=0, description="Sigma where tracking was lost, log. [own]")
    weak_translation: float = Field(
        100.0, gt=0, description="Sigma where tracking was lost, m. [own]"
    )
    weak_rotation: float = Field(1.0, gt=0, description="Sigma where tracking was lost, rad. [own]")
    gap_translation: float = Field(
        0.5, gt=0, description="Where the camera drove on lost: of the way predicted. [own]"
    )
    gap_speed: float = Field(2.0, gt=0, description="The same, at least, m per second. [own]")
    gap_rotation: float = Field(0.3, gt=0, description="The same, rad per second. [own]")
    gap_scale: float = Field(0.3, gt=0, description="The same, log: speeds change. [own]")
    min_gap: float = Field(0.3, gt=0, description="No gap is taken for shorter, s. [own]")
    robust_scale: float = Field(3.0, gt=0, description="Of the Cauchy loss on loops, sigmas. [own]")
    iterations: int = Field(50, ge=1, description="Levenberg-Marquardt iterations at most.")
    max_loop_error: float = Field(
        30.0, gt=0, description="Chi-square of a loop beyond which it is contradicted. [own]"
    )
    max_strain: float = Field(
        60.0, gt=0, description="Chi-square of the drift that closing one loop may imply. [own]"
    )


class Config(_Section):
    """The whole configuration, written to ``config.json`` of each run and read by --config."""

    orb: OrbConfig = OrbConfig()
    stereo: StereoConfig = StereoConfig()
    tracking: TrackingConfig = TrackingConfig()
    initialization: InitializationConfig = InitializationConfig()
    keyframes: KeyframeConfig = KeyframeConfig()
    mapping: MappingConfig = MappingConfig()
    verification: VerificationConfig = VerificationConfig()
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
