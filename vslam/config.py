"""All thresholds of the pipeline, with one class for each stage.

docs/reference/thresholds.md is generated from these classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from vslam.support.errors import InputError, did_you_mean, plain_reason

_Model = TypeVar("_Model", bound=BaseModel)


class Section(BaseModel):
    """A frozen group of thresholds. The docstring below each field describes the field.

    ``tools/threshold_table.py`` reads these docstrings from the source. Pydantic could do so itself
    (``use_attribute_docstrings``), but that would take 0.1 s at the start of every run.

    Each docstring ends with the source of the threshold in brackets. [own] means that both the rule
    and the value are our own. Otherwise, the brackets name the paper and section that give the
    rule, and then the source of the value. *Printed* values are printed in that section of the
    paper. *Customary* values are those of the programs of the ORB-SLAM family. *Own* values were
    chosen for vslam.

    OS1: Mur-Artal et al., ORB-SLAM, T-RO 2015. OS2: Mur-Artal and Tardós, ORB-SLAM2, T-RO 2017. ZS:
    Zhou and Sun, Sci Rep 15, 7644 (2025).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")


class OrbConfig(Section):
    """ORB extraction."""

    n_features: int = Field(2000, ge=100)
    """Features to extract from each image. More are more robust, but slower. [OS1 V-A, printed]"""
    n_levels: int = Field(8, ge=2, le=16)
    """Levels of the image pyramid. With more, a landmark can be matched over a larger range of
    distances. [OS1 V-A, printed]"""
    scale_factor: float = Field(1.2, gt=1.0, le=2.0)
    """Scale factor from one pyramid level to the next. [OS1 V-A, printed]"""
    fast_threshold: int = Field(12, ge=1, le=255)
    """FAST threshold, in grey levels. A larger one finds fewer, stronger corners. [OS1 V-A,
    customary]"""
    fast_threshold_min: int = Field(7, ge=1, le=255)
    """FAST threshold in cells where `fast_threshold` finds no corner, in grey levels. [OS1 V-A,
    customary]"""


class WeakImageConfig(Section):
    """Images with much noise or little contrast (docs/research/stress.md)."""

    noise_from: float = Field(5.0, ge=0)
    """An image is blurred from this standard deviation of its noise, in grey levels. Images without
    added noise have at most 2.5. [own]"""
    spikes_from: float = Field(0.04, ge=0, le=1)
    """A median filter is applied above this fraction of spikes: pixels much brighter or darker than
    both neighbours. [own]"""
    few_features: float = Field(0.5, ge=0, le=1)
    """Contrast is measured only in images with fewer features than this fraction of
    `orb.n_features`. [own]"""
    low_contrast: float = Field(6.0, ge=0)
    """Contrast is raised below this value, in grey levels (0: never). It is the median, over blocks
    of 16 x 16 pixels, of the standard deviation of the grey values. [own]"""


class StereoConfig(Section):
    """Stereo matching [OS2, III-A]."""

    clipped_from: int = Field(250, ge=1, le=255)
    """Pixels from this grey level are overexposed, and ignored when the gain is measured. Video of
    limited range (16 to 235) needs about 230. [own]"""
    black_below: float = Field(6.0, gt=0, le=255)
    """An image of a pair is black, and not used, if the 95 % quantile of its grey levels is below
    this and the other image has contrast. Video of limited range needs about 22. [own]"""
    close_depth_baselines: float = Field(40.0, gt=0)
    """Depth below which a stereo point is close, in baselines. Close points are mapped from one
    pair, most far ones triangulated from several keyframes. [OS2 III-A, printed]"""
    offset_sigma: float = Field(0.2, ge=0)
    """Prior standard deviation of the offset that all disparities have in common if they have one,
    in pixels. The motion of the camera reveals it (docs/research/motorway.md). With 0, none is
    estimated. [own]"""


class DepthConfig(Section):
    """Depth images [OS2, III-A]."""

    min_metres: float = Field(0.1, gt=0)
    """Smaller depths, in metres, count as unknown. [own]"""
    max_metres: float = Field(100.0, gt=0)
    """Larger depths, in metres, count as unknown. [own]"""
    edge_radius: float = Field(4.0, ge=0)
    """A keypoint gets a depth only if the depths within this radius agree, in pixels at octave 0.
    The default is one pixel more than the radius of FAST's circle. [own]"""
    edge_ratio: float = Field(0.07, gt=0)
    """Depths around a keypoint agree if they differ by at most this fraction of the nearest.
    [own]"""


class AlignmentConfig(Section):
    """Alignment of matches to sub-pixel accuracy (Forster et al., ICRA 2014, III-B)."""

    min_correlation: float = Field(0.85, gt=0, le=1)
    """Least normalised cross-correlation of a patch with the image for a match to be aligned.
    [own]"""
    certainty: int = Field(4, ge=1, le=255)
    """Variance of a keypoint's position, divided by that of an aligned match. A larger ratio gives
    aligned matches more weight. [own]"""
    keyframes: int = Field(5, ge=1)
    """Number of the newest keyframes that keep patches. Landmarks that only older ones observe are
    aligned only at a known place. [own]"""


class TrackingConfig(Section):
    """Frame-to-map tracking."""

    method: Literal["auto", "orb", "patches"] = "auto"
    """`patches` searches for image patches of the landmarks (Forster et al., T-RO 2017), and
    extracts features only when a keyframe is due or too few patches are found. `orb` matches ORB
    features in every frame. `auto` is `orb` for one camera until an IMU tells its scale, and
    `patches` for all others. [own]"""
    patch_min_inliers: int = Field(40, ge=10)
    """Features are extracted if fewer patches than this agree with the pose. [own]"""
    patch_min_inlier_ratio: float = Field(0.8, ge=0, le=1)
    """Features are extracted if less than this fraction of the patches agrees with the pose, as
    among moving vehicles. [own]"""
    patch_retry_ratio: float = Field(0.86, ge=0, le=1)
    """If less than this fraction of the patches agrees with the pose, they are searched for again
    from the predicted pose, because sparse image alignment, which precedes the first search, may
    have followed moving objects. The result with more inliers is used. [own]"""
    motion_window: float = Field(7.0, gt=0)
    """Search radius for points of the previous frame, in pixels at octave 0. [OS1 V-B,
    customary]"""
    local_window: float = Field(2.5, gt=0)
    """Search radius for landmarks of the local map, in pixels at octave 0. [OS1 V-D, customary]"""
    sudden_min_inlier_ratio: float = Field(0.4, ge=0, le=1)
    """After a sudden motion, at least this fraction of the matches must be inliers, so that the
    camera is not tracked against a moving object. [own]"""
    local_keyframes: int = Field(80, ge=1)
    """Upper bound of the keyframes in the local map: those that share the most landmarks with the
    reference keyframe. [OS1 V-D, customary]"""
    min_stereo_start: int = Field(100, ge=10)
    """Stereo features that a frame needs to start a map. [OS2 III-B, own]"""
    min_inlier_ratio: float = Field(0.3, ge=0, le=1)
    """If less than this fraction of the matches with the previous frame are inliers, the frame is
    also tracked from the reference keyframe. [own]"""
    min_inliers: int = Field(30, ge=3)
    """A frame with fewer inliers than this in the local map is WEAK: its pose is used, but reported
    as uncertain. [OS1 V-D, customary]"""
    lost_frames_before_restart: int = Field(3, ge=1)
    """Lost frames after which a stereo or RGB-D camera starts a sub-map at the predicted pose.
    [own]"""
    young_keyframes: int = Field(5, ge=0)
    """With at most this many keyframes in the map, a stereo or RGB-D camera starts a sub-map after
    one lost frame. [own]"""
    monocular_lost_frames: int = Field(4, ge=1)
    """Lost frames after which a monocular camera starts a sub-map from two new views. [own]"""


class InitializationConfig(Section):
    """The first two keyframes of a monocular map [OS1, IV]."""

    min_features: int = Field(200, ge=20)
    """Features that a frame needs to be the first view. [own]"""
    min_matches: int = Field(100, ge=8)
    """With fewer matches than this, the second view replaces the first. [OS1 IV, customary]"""
    min_parallax_deg: float = Field(1.0, gt=0)
    """Parallax that 50 points must have, in degrees. A larger value needs a longer motion. [OS1 IV,
    customary]"""
    min_landmarks: int = Field(100, ge=8)
    """Landmarks that must remain after the first bundle adjustment. [OS1 IV, customary]"""
    median_depth: float = Field(15.0, gt=0)
    """Median depth to which the first landmarks are scaled, in map units. [own]"""
    max_seconds: float = Field(1.5, gt=0)
    """Longest time between the two views, in seconds. After it, the next frame replaces the first
    view. [own]"""


class KeyframeConfig(Section):
    """Keyframe decision [OS2, III-E]."""

    max_interval_s: float = Field(1.0, gt=0)
    """A keyframe is inserted if the last one is at least this old, in seconds. [OS1 V-E,
    customary]"""
    depth_max_interval_s: float = Field(0.3, gt=0)
    """Replaces `max_interval_s` for RGB-D cameras, which are usually hand-held, in seconds.
    [own]"""
    min_tracked_close: int = Field(100, ge=0)
    """A keyframe is inserted if the frame tracks fewer close points than this, and could add more
    than `min_new_close`. [OS2 III-E, printed]"""
    min_new_close: int = Field(70, ge=0)
    """A frame with fewer tracked close points must be able to add more new ones than this. [OS2
    III-E, printed]"""
    patch_kept_close: float = Field(0.4, ge=0, le=1)
    """A frame tracked by patches becomes a keyframe if it tracks less than this fraction of the
    close points that the first frame after the last keyframe tracked. [own]"""
    max_tracked_ratio: float = Field(0.75, gt=0, le=1)
    """A keyframe is inserted if the frame tracks less than this fraction of the landmarks of the
    reference keyframe. A larger fraction inserts more. [OS1 V-E, customary]"""
    monocular_ratio: float = Field(0.9, gt=0, le=1)
    """Replaces `max_tracked_ratio` for a monocular camera. [OS1 V-E, printed]"""
    known_after_s: float = Field(30.0, gt=0)
    """Age from which a keyframe is old, in seconds. At a known place, an old keyframe becomes the
    reference, and none is inserted. [own]"""
    known_ratio: float = Field(0.5, gt=0)
    """A place is known if the frame tracks at least this fraction of the landmarks of an old
    keyframe. A larger fraction inserts more keyframes at old places. [own]"""
    known_min_inliers: int = Field(50, ge=0)
    """Landmarks that a frame must track at a known place. [own]"""
    publish_after_frames: int = Field(2, ge=1)
    """Tracking uses the result of mapping this many frames after the keyframe, or at the next
    keyframe. With a smaller value, it waits for mapping more often. [own]"""


class MappingConfig(Section):
    """Local mapping and bundle adjustment."""

    neighbours: int = Field(10, ge=1)
    """Covisible keyframes with which a new keyframe triangulates landmarks. [OS1 VI-C,
    customary]"""
    epipolar_distance: int = Field(50, ge=0, le=256)
    """Upper bound of the descriptor distance for triangulation, in bits. [OS1 VI-C, customary]"""
    fuse_distance: int = Field(50, ge=0, le=256)
    """Upper bound of the descriptor distance between duplicate landmarks, in bits. [OS1 VI-C,
    customary]"""
    min_stereo_points: int = Field(100, ge=0)
    """A keyframe with fewer close stereo features than this maps its nearest ones, up to this
    number. [OS2 III-E, printed]"""
    redundant_ratio: float = Field(0.9, gt=0, le=1)
    """A keyframe is culled if more than this fraction of its landmarks are observed by at least
    three other keyframes each. A larger fraction keeps more keyframes. [OS1 VI-E, printed]"""
    max_ba_keyframes: int = Field(60, ge=2)
    """Upper bound of the keyframes that local bundle adjustment optimises. [OS1 VI-D, own]"""
    ba_iterations: int = Field(10, ge=1)
    """Upper bound of the iterations of local bundle adjustment. The first pass, before outliers are
    removed, has half as many. [OS1 VI-D, customary]"""


class VerificationConfig(Section):
    """Geometric verification of loop candidates [OS1, VII-B; OS2, III-C]."""

    descriptors: Literal["auto", "orb", "learned", "both"] = "auto"
    """What verifies loop candidates: `orb`, `learned` (local descriptors of the network), or `both`
    (learned ones where ORB fails). `auto` is `orb` for `bow`, `capsule-paper` and plug-ins, and
    `both` for all other detectors. [own]"""
    min_inliers: int = Field(40, ge=6)
    """Inliers that must remain after guided search. [OS1 VII-B, customary]"""
    max_distance: float = Field(15.0, gt=0)
    """Upper bound of the distance between the cameras of query and match, in metres. [own]"""


class LearnedMatchingConfig(Section):
    """Verification of loop candidates using learned local descriptors, where ORB fails."""

    max_candidates: int = Field(2, ge=1)
    """Upper bound of the candidates that are tried for a keyframe or a lost frame. [own]"""
    max_compared: int = Field(5, ge=0)
    """If the detector has not compared its candidates by local descriptors, this many of the best
    are compared before verification. [own]"""
    most_shared: float = Field(0.4, gt=0, le=1)
    """The image of a keyframe is not kept for the network if the keyframe shares at least this
    fraction of its landmarks with one whose image is kept. [own]"""
    min_similarity: float = Field(0.35, ge=0, le=1)
    """Least similarity by local descriptors for two images to be matched. [own]"""
    retry_interval: int = Field(8, ge=0)
    """Keyframes after a failed attempt during which `retry_factor` applies. [own]"""
    retry_factor: float = Field(1.1, ge=1)
    """After a failed attempt, a place is tried only if its similarity is at least this many times
    that of the failed attempt. [own]"""
    min_inliers: int = Field(80, ge=6)
    """Inliers that must remain after guided search. [own]"""
    verified_memory: int = Field(10, ge=1)
    """Replaces a smaller `consistency.verified_memory` in learned verification, because only some
    keyframes have an image. [own]"""


class ConsistencyConfig(Section):
    """Test whether several keyframes agree on a loop [OS1, VII-A]."""

    min_keyframes: int = Field(2, ge=1)
    """Consecutive keyframes that must resemble the place. OS1 requires 3. [OS1 VII-A, own]"""
    max_gap: int = Field(1, ge=0)
    """Keyframes that need not resemble the place between two that do. OS1 allows none. [OS1 VII-A,
    own]"""
    max_wrong: float = Field(3e-3, gt=0, le=0.5)
    """A loop is closed only if the probability that it is wrong is at most this, by its own
    evidence and that of a loop that agrees with it. [own]"""
    max_wrong_at_end: float = Field(1e-2, gt=0, le=0.5)
    """Replaces `max_wrong` at the end of a drive, when no further evidence can come. [own]"""
    verified_memory: int = Field(5, ge=1)
    """Keyframes for which a verified loop is remembered. [own]"""
    min_moved: float = Field(0.15, ge=0)
    """At the end of a drive, an earlier keyframe may confirm a loop only if its distance from the
    query is at least this fraction of the median depth of the matched landmarks. A nearer one would
    repeat the evidence of the query. [own]"""


class RelocalizationConfig(Section):
    """Relocalisation of a lost camera [OS1, V-C]."""

    min_inliers: int = Field(50, ge=6)
    """Inliers that a frame needs to be relocalised. [OS1 V-C, customary]"""
    min_elsewhere: int = Field(15, ge=0)
    """Inliers that must lie outside the vertical strip, a third of the image wide, that contains
    the most. [own]"""
    max_candidates: int = Field(5, ge=1)
    """Upper bound of the places that are tried for a lost frame. [own]"""
    doubtful_gap: float = Field(1.5, gt=1)
    """A frame comes after a gap if the time since the last tracked frame exceeds the usual interval
    by more than this factor. [own]"""
    doubtful_share: float = Field(0.5, ge=0, le=1)
    """A frame is doubtful, and the whole map is searched, if it tracks less than this fraction of
    the landmarks of the reference keyframe, and also comes after a gap, was not predicted, or
    tracks less than this fraction of the number of landmarks in the previous frame. [own]"""
    better: float = Field(1.5, ge=1)
    """The pose of this search is used only if it has more than this many times as many inliers as
    the tracked pose. [own]"""


class LoopConfig(Section):
    """Closing a verified loop, and global bundle adjustment afterwards [OS1, VII]."""

    kidnapped: float = Field(1e-3, ge=0)
    """A loop that is right only if the camera was carried away while it was lost is closed only if
    the probability that the loop is wrong is at most this. [own]"""
    overwhelming: float = Field(1e-6, ge=0)
    """A loop that contradicts the odometry is closed nevertheless if the probability that the loop
    is wrong is at most this. [own]"""

    global_iterations: int = Field(10, ge=1)
    """Upper bound of the iterations of global bundle adjustment. [OS2 III-D, customary]"""
    min_revisits: int = Field(5, ge=1)
    """When the camera leaves old places, and at the end, the map is adjusted again if at least this
    many frames have measured them since the last adjustment: new keyframes that observe an old
    place, and frames whose reference is an old keyframe. [own]"""
    revisits_share: float = Field(0.1, ge=0)
    """At old places, the map is adjusted again when these frames reach this fraction of the number
    of keyframes. [own]"""


class BowConfig(Section):
    """Loop candidates from a bag of words [OS1, III-E and VII-A]."""

    exclude_recent: int = Field(20, ge=1)
    """Number of the newest keyframes, including the query, that are never candidates. [own]"""
    group_size: int = Field(10, ge=0)
    """Upper bound of the most covisible keyframes with which a candidate forms a group. [OS1 III-E,
    customary]"""
    max_groups: int = Field(30, ge=1)
    """Upper bound of the groups, which are formed around the candidates with the highest scores.
    [own]"""


class PoseGraphConfig(Section):
    """The pose graph of a loop closure: weights of the edges, and when a loop is rejected.

    An edge with a larger standard deviation has less weight. Drift is modelled as a random walk,
    whose standard deviation grows with the square root of the distance travelled: 1.2 % after 400 m
    with the defaults, nearly all of it from errors of rotation.

    An edge across a loss of tracking is a gap: the motion is only predicted. It gets a small weight
    if nothing could be predicted, and under the hypothesis that the camera was carried elsewhere.
    """

    min_shared: int = Field(100, ge=1)
    """Landmarks that two keyframes must share to have a covisibility edge in the graph. [OS1 III-D,
    printed]"""
    translation_drift: float = Field(0.03, gt=0)
    """Standard deviation of translational drift, in metres per square root of a metre. [own]"""
    rotation_drift: float = Field(0.001, gt=0)
    """Standard deviation of rotational drift, in radians per square root of a metre, with a focal
    length of at least 700 pixels. It is inversely proportional to shorter ones. [own]"""
    loop_inflation: float = Field(1.5, gt=0)
    """Factor on the covariance of a verified loop, which lacks the errors of the landmarks
    (docs/research/uncertainty.md). [own]"""
    robust_scale: float = Field(3.0, gt=0)
    """Scale of the Cauchy loss on loops, in standard deviations. A smaller one reduces the
    influence of loops that contradict the other edges. [own]"""
    max_loop_error: float = Field(30.0, gt=0)
    """A loop with a greater chi-square after optimisation is rejected. [own]"""
    max_strain: float = Field(60.0, gt=0)
    """A loop is rejected if the chi-square of all other edges exceeds this number times the number
    of closed loops. [own]"""


class SiameseConfig(Section):
    """Loop candidates from a Siamese network [ZS]."""

    threshold: float = Field(0.9, ge=0, le=1)
    """Similarity from which a keyframe is a loop candidate. [ZS, printed]"""
    offered: float = Field(0.1, ge=0, le=1)
    """Replaces `threshold` if learned descriptors verify the candidates. A smaller value proposes
    more. [own]"""
    max_candidates: int = Field(5, ge=1)
    """Upper bound of the candidates of a query. The best are kept. [own]"""
    recent_keyframes: int = Field(10, ge=0)
    """Number of the newest keyframes that are never candidates. [own]"""
    reach: float = Field(20.0, ge=0)
    """If learned descriptors verify, a query is compared only with keyframes within this distance,
    in metres, increased by `reach_share`. [own]"""
    reach_share: float = Field(0.05, ge=0)
    """Fraction of the distance travelled since the keyframe. The default is several times the drift
    of a stereo camera in a street, about 1 %. [own]"""
    monocular_reach_share: float = Field(0.3, ge=0)
    """Replaces both values in monocular maps, whose scale drifts: the query is compared only with
    keyframes nearer than this fraction of the distance travelled since them. The default is twice
    what KITTI 00 needs, where the scale drifts by a factor of 2.3. [own]"""
    reach_angle: float = Field(60.0, gt=0, le=180)
    """The query is compared only with keyframes whose viewing direction differs by at most this, in
    degrees. The detectors do not recognise a place from behind or from the side. [own]"""
    reach_speedup: float = Field(5.0, ge=0)
    """A lost camera is assumed to be at most this many times as fast as the mean of the drive.
    Learned descriptors do not try keyframes that it cannot have reached. [own]"""
    embedded_at_once: int = Field(8, ge=1)
    """Upper bound of the keyframes that the network processes for a query, the nearest first.
    [own]"""
    fit: Literal["squash", "crop"] = "squash"
    """How an image is fitted to the network's input: `squash` scales all of it, `crop` cuts out its
    middle. [own]"""


class Config(Section):
    """All thresholds of the pipeline.

    Each run writes its thresholds to ``config.json``. The option ``--config`` reads such a file.

    A threshold can also be given by its dotted name: ``{"orb.n_features": 1000}`` means the same as
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
        """Move thresholds with dotted names into their sections."""
        if not isinstance(given, dict):
            return given
        nested = {name: value for name, value in given.items() if "." not in str(name)}
        for name in [name for name in given if name not in nested]:
            section, _, key = name.partition(".")
            values = nested.get(section, {})
            if isinstance(values, dict):
                nested[section] = {**values, key: given[name]}
            else:
                nested[name] = given[name]  # validation reports it as an unknown key
        return nested


PRESETS: Mapping[str, Mapping[str, Any]] = {
    "fast": {
        "orb.n_features": 1200,
        "keyframes.patch_kept_close": 0.3,
        "keyframes.publish_after_frames": 3,
        "mapping.neighbours": 5,
    }
}
"""Thresholds by the name of the preset, and by dotted name. ``fast`` trades accuracy for speed
(docs/research/performance.md)."""


def load_config(path: Path | str) -> Config:
    """Read thresholds from a JSON file. Keys that the file omits keep their defaults.

    Raises:
        InputError: the file is missing or is not JSON, a key is unknown, or a value is out of
            range.
    """
    return read_json(Config, Path(path), "configuration")


def as_config(given: Config | Mapping[str, Any] | str, where: str = "config") -> Config:
    """Check thresholds that are given as a dictionary, in the form of ``config.json``, or by the
    name of a preset.

    Args:
        given: thresholds by section or by dotted name, or a name from ``PRESETS``. Thresholds that
            are left out keep their defaults. A ``Config`` is returned unchanged.
        where: the file or argument that the thresholds come from, for error messages.

    Raises:
        InputError: a preset or a key is unknown, or a value is out of range.
    """
    if isinstance(given, str):
        given = preset(given, where)
    return checked(Config, given, where, "configuration")


def preset(name: str, where: str, sought: str = "preset") -> Mapping[str, Any]:
    """Return the thresholds of a preset, by dotted name.

    Args:
        where: the argument that contains the name, for error messages.
        sought: what the name may stand for, for error messages.

    Raises:
        InputError: there is no such preset.
    """
    if name not in PRESETS:
        raise InputError(
            f"{where}: there is no {sought} {name!r}{did_you_mean(name, PRESETS)}; the presets "
            f"are: {', '.join(PRESETS)}."
        )
    return PRESETS[name]


def changed_thresholds(config: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the thresholds that differ from the defaults, by dotted name.

    Args:
        config: the content of a ``config.json``, with thresholds by section. It may come from
            another version of vslam.
    """
    default = Config().model_dump()
    return {
        f"{section}.{name}": value
        for section, values in config.items()
        for name, value in values.items()
        if name not in default.get(section, {}) or value != default[section][name]
    }


def with_preset(changed: Mapping[str, Any]) -> dict[str, Any]:
    """Replace the thresholds of a preset with one entry, such as ``{"preset": "fast"}``.

    Args:
        changed: thresholds by dotted name. If they do not contain a whole preset, they are returned
            as they are.
    """
    for name, thresholds in PRESETS.items():
        if thresholds.items() <= changed.items():
            others = {key: changed[key] for key in changed if key not in thresholds}
            return {"preset": name, **others}
    return dict(changed)


def thresholds_in_words(changed: Mapping[str, Any], most: int = 3) -> str:
    """Describe thresholds in a short text, such as ``orb.n_features=1000, 2 more in config.json``.

    Args:
        changed: thresholds by dotted name. A preset is described by its name.
        most: greatest number of thresholds that are listed. The others are only counted.
    """
    words = [f"{name}={value}" for name, value in with_preset(changed).items()]
    more = [f"{len(words) - most} more in config.json"] if len(words) > most else []
    return ", ".join(words[:most] + more)


def read_json(model: type[_Model], path: Path, what: str) -> _Model:
    """Read a JSON file of thresholds or settings. Keys that the file omits keep their defaults.

    Args:
        what: the name of the content in error messages, such as ``configuration``.

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
    """Check thresholds or settings. Values that are left out keep their defaults.

    Args:
        given: JSON as bytes, a dictionary, or a model, which is returned unchanged.
        where: the file or argument that the values come from, for error messages.
        what: the name of the values in error messages, such as ``thresholds``.

    Raises:
        InputError: the JSON cannot be parsed, a key is unknown, or a value is out of range.
    """
    try:
        if isinstance(given, bytes):
            return model.model_validate_json(given)
        return model.model_validate(given)
    except ValidationError as error:
        raise InputError(f"{where}: {_fault(model, error, what)}.") from None


def _fault(model: type[BaseModel], error: ValidationError, what: str) -> str:
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
    """Suggest the full name of a key that was given without its section, if a section has it."""
    sections = [section for section in model.model_fields if place[-1] in _keys(model, [section])]
    if len(place) > 1 or not sections:
        return ""
    return f" (did you mean {' or '.join(f'{section}.{place[-1]}' for section in sections)}?)"


def _keys(model: type[BaseModel], place: list[str]) -> list[str]:
    """Return the names of the keys in the section of ``model`` at ``place``, if there is one."""
    for name in place:
        field = model.model_fields.get(name)
        if field is None or not isinstance(field.annotation, type):
            return []
        if not issubclass(field.annotation, BaseModel):
            return []
        model = field.annotation
    return list(model.model_fields)
